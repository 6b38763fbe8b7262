"""The demo's files: raw frame, picture, ground truth, and one figure of everything."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calibration_routines.demo.demo_picture import Viewer
from calibration_routines.demo.demo_settings import DemoSettings
from calibration_routines.optics.comparison import Comparison
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.images import write_image
from recon import Reconstruction

if TYPE_CHECKING:
    from calibration_routines.demo.demo import Measured

Float = npt.NDArray[np.float32]
_SCREEN_GAMMA = 1 / 2.2  # light to the levels of a screen
_MARGIN = 4  # dark pixels shown around the picture


def write_pictures(
    place: Path,
    settings: DemoSettings,
    measured: Measured,
    result: Reconstruction,
    viewer: Viewer,
    comparison: Comparison,
) -> dict[str, Path]:
    """Write the demo's pictures into its folder; returns what is where."""
    picture = comparison.scale * viewer.upright(viewer.picture(result.image), _MARGIN)
    truth = viewer.upright(viewer.truth, _MARGIN)
    files = {
        "summary figure": place / "summary.png",
        "picture": place / "picture.png",
        "picture, linear float32": place / "picture.tif",
        "ground truth, linear float32": place / "ground-truth.tif",
        "raw frame": place / "raw.tif",
        "calibration": measured.calibration.path,
    }
    write_image(files["raw frame"], measured.photo.raw)
    write_image(files["picture, linear float32"], picture.astype(np.float32))
    write_image(files["ground truth, linear float32"], truth.astype(np.float32))
    levels = 255 * np.clip(picture / viewer.truth.max(), 0, 1) ** _SCREEN_GAMMA
    write_image(files["picture"], np.round(levels).astype(np.uint8))
    summary = _summary(settings, measured, result, viewer, comparison, picture, truth)
    save_figure(summary_figure(summary), files["summary figure"])
    return files


def _summary(
    settings: DemoSettings,
    measured: Measured,
    result: Reconstruction,
    viewer: Viewer,
    comparison: Comparison,
    picture: Float,
    truth: Float,
) -> Summary:
    calibration = measured.calibration.calibration
    psf = calibration.psfs[settings.scene_plane, 0]
    pitch_mm = (calibration.geometry.pixel_pitch_um or 0.0) / 1e3
    z_mm = settings.scene_z_um / 1e3
    object_mm = viewer.object_pitch_um / 1e3
    raw = measured.photo.raw.astype(np.float32)
    raw_pitch_mm = pitch_mm / settings.binning
    white = float(truth.max())
    corner = _corner(calibration.psfs[0, 0])
    height, width = result.image.shape[:2]
    return Summary(
        title="One photograph without a lens",
        simulated=True,
        panels=(
            Panel(
                "Point spread function",
                psf,
                f"source at {z_mm:.0f} mm",
                pitch_mm,
                0.6,
                float(np.percentile(psf, 99.7)),
            ),
            Panel(
                "Raw frame",
                raw,
                f"{raw.shape[1]} x {raw.shape[0]} pixels, {measured.photo.exposure_ms:.0f} ms",
                raw_pitch_mm,
                1.0,
                float(raw.max()),
            ),
            Panel(
                "Reconstruction",
                picture,
                f"PSNR {comparison.psnr_db:.1f} dB, SSIM {comparison.ssim:.2f}",
                object_mm,
                _SCREEN_GAMMA,
                white,
            ),
            Panel("Ground truth", truth, f"a screen at {z_mm:.0f} mm", object_mm, _SCREEN_GAMMA, white),
        ),
        sweep=[
            Panel(f"{z_um / 1e3:.0f} mm", image[0][corner], gamma=0.6)
            for z_um, image in zip(calibration.source_positions_um[:, 2], calibration.psfs, strict=True)
        ],
        sweep_title="Axial sweep: lower right corner of the pattern, which grows as the source comes nearer",
        convergence=Convergence(
            viewer.seconds, viewer.psnr_db, "PSNR over time (dB)", f"{comparison.psnr_db:.1f} dB"
        ),
        lines=(
            ("bench", measured.bench_label.split(" (")[0] + f", preset {settings.preset}, SIMULATED"),
            ("calibration", f"{settings.planes} planes, {settings.average} frames each"),
            ("photograph", f"{settings.average} frames averaged, default noise"),
            (
                "picture on the screen",
                f"{truth.shape[1] - 2 * _MARGIN} x {truth.shape[0] - 2 * _MARGIN} pixels",
            ),
            (
                "reconstruction",
                f"{result.solver} + {result.prior}, {width} x {height}, {len(result.history)} iterations",
            ),
            ("compared", "inside the screen, linear light, one scale factor"),
        ),
    )


def _corner(psf: Float) -> tuple[slice, slice]:
    """Return a wide box around the lower right corner of a PSF's support."""
    box = []
    for axis, reach in ((1, len(psf) // 10), (0, len(psf) // 6)):
        profile = psf.sum(axis=axis)
        edge = int(np.searchsorted(np.cumsum(profile), 0.995 * profile.sum()))
        box.append(slice(max(0, edge - reach), min(len(profile), edge + reach // 5)))
    return box[0], box[1]
