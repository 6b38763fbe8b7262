"""``diffuserbench demo``: the main job, start to end, on the simulated bench."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape

from calibration_routines.demo import DemoResult, DemoSettings, run_demo
from instrument.cli.app import App, examples
from instrument.cli.calibrate import TerminalListener

app = App()


@app.command(epilog=examples("diffuserbench demo", "diffuserbench demo --out /tmp/demos"))
def demo(
    options: DemoSettings,
    out: Annotated[
        Path, typer.Option("--out", "-o", metavar="FOLDER", help="Where the demo's folder is made.")
    ] = Path("runs"),
) -> None:
    """Calibrate a SIMULATED lensless camera, photograph scenes with it, reconstruct and judge what comes out.

    Homes the stage, places the point source, exposes without saturating, takes dark frames, sweeps the source
    along the axis, checks the PSFs; photographs a picture on a screen in three colours and lights in a
    volume, reconstructs both, compares them with the ground truth, charts what methods cost against how good
    they are, and writes everything into one folder. Motion and exposures are ten times as fast as on a real
    bench. Ctrl-C stops it at any moment, the bench safe.
    """
    with _Terminal(Console(highlight=False)) as listener:
        result = run_demo(out, listener, options)
    listener.verdict(result)


class _Terminal(TerminalListener):
    """Shows on the terminal what the demo does, and prints what it says on the way."""

    def said(self, words: str) -> None:
        """Print it."""
        self.print([words])

    def verdict(self, result: DemoResult) -> None:
        self._console.print("\nSeconds")
        for name, seconds in result.seconds.items():
            self._console.print(f"  {seconds:6.1f}  {name}")
        self._console.print(f"  {sum(result.seconds.values()):6.1f}  in all")
        self._console.print("\nFiles (SIMULATED data)")
        for name, path in result.files.items():
            self._say(f"  {name:<30} {path}")
        comparison, placed = result.comparison, result.placed
        self._console.print()
        for name, solved in (("Picture", result.reconstruction), ("Volume", result.volume)):
            self._say(
                f"{name}: {solved.solver} with {solved.prior}, {len(solved.history)} iterations in "
                f"{solved.seconds:.1f} s; stopped because {solved.stop_reason}."
            )
            for warning in solved.warnings:
                self._say(f"Note: {warning}")
        self._say(
            f"Lights: {placed.in_plane} of {len(placed.planes)} found within half a plane of their depth."
        )
        self._say(
            f"PSNR {comparison.psnr_db:.2f} dB, SSIM {comparison.ssim:.3f} against the ground truth: inside "
            "the screen, in linear light, after one least-squares scale factor, brightness over the field "
            "corrected by the measured response."
        )

    def _say(self, text: str) -> None:
        self._console.print(escape(text), soft_wrap=True)
