"""What ``diffuserbench hologram`` says."""

from __future__ import annotations

import typer

from instrument.display.hologram_job import HologramResult
from recon.holography import HologramOptions


def tell(label: str, result: HologramResult, options: HologramOptions) -> None:
    """Say how good the hologram is, for which grid, envelope and frame count."""
    history = result.hologram.history
    typer.echo(
        f"{label}: {history[-1].iteration} iterations, {result.hologram.seconds:.1f} s: "
        f"{result.hologram.stop_reason}"
    )
    for plane, score in enumerate(result.scores):
        name = f"  plane {plane + 1}: " if len(result.scores) > 1 else "  seen: "
        typer.echo(
            f"{name}{score.psnr_db:.2f} dB, SSIM {score.ssim:.3f}; "
            f"middle quarter {score.crop_psnr_db:.2f} dB, SSIM {score.crop_ssim:.3f}"
        )
    typer.echo(
        f"  (computed on the alias-free grid, envelope {options.envelope}, {options.frames} frame(s), "
        "through the eye's low-pass)"
    )
