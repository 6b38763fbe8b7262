"""The demo's picture as it is judged and shown: brightness corrected, cut to the screen, the right way up.

Also the demo's files: raw frame, picture, ground truth, and one figure of everything.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from drivers.simulated.world import SimulatedWorld
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.images import write_image
from recon import Reconstruction
from recon.base.metrics import psnr, scale_to, ssim
from recon.solvers.base import IterationRecord

if TYPE_CHECKING:
    from calibration_routines.demo import DemoSettings, Measured


Float = npt.NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Field:
    """The rows and columns of a reconstruction that show the scene."""

    rows: slice
    columns: slice

    def of(self, image: Float) -> Float:
        """Cut the field out of an image on the reconstruction's grid."""
        return image[self.rows, self.columns]


@dataclass(frozen=True, slots=True)
class Comparison:
    """How close a picture is to the truth, inside a field."""

    psnr_db: float
    ssim: float
    """With the truth's maximum as peak."""
    scale: float
    """The one factor by which the picture was multiplied: least squares, no offset."""


def scene_field(
    shape: tuple[int, int], centre: tuple[int, int], size_um: tuple[float, float], object_pitch_um: float
) -> Field:
    """Return the pixels that lie wholly inside a scene centred on the axis.

    Parameters
    ----------
    shape, centre : (int, int)
        Of the reconstruction's grid; ``centre`` is the pixel on the axis.
    size_um : (float, float)
        Height and width of the scene.
    object_pitch_um : float
        Pitch of the reconstruction in the scene's plane.
    """
    slices = []
    for n, middle, size in zip(shape, centre, size_um, strict=True):
        reach = int(np.floor(size / 2 / object_pitch_um - 0.5))
        slices.append(slice(max(0, middle - reach), min(n, middle + reach + 1)))
    return Field(slices[0], slices[1])


def compare(image: Float, truth: Float, field: Field) -> Comparison:
    """Compare a reconstruction with the truth on the same grid, inside ``field``."""
    seen, true = field.of(image), field.of(truth)
    scale = scale_to(seen, true)
    return Comparison(psnr(scale * seen, true), ssim(scale * seen, true), scale)


_LOOK_EVERY_S = 0.05


class Viewer:
    """Knows the reconstruction's grid, the truth on it, and the response over the field.

    Attributes
    ----------
    truth : ndarray, float32, (height, width)
        The scene's radiance on the reconstruction's grid, upside down as the reconstruction is.
    field : Field
        The pixels that show the screen.
    object_pitch_um : float
        Pitch of the reconstruction in the scene's plane.
    seconds, psnr_db : list of float
        The reconstruction's way to its result, filled in while it runs.
    """

    def __init__(self, world: SimulatedWorld, settings: DemoSettings, measured: Measured) -> None:
        geometry = measured.calibration.calibration.geometry
        height, width = measured.photo.measurement.shape[:2]
        shape = (height, width)
        pitch, d_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
        if pitch is None or d_mm is None:
            raise ValueError("The demo's bench knows its pixel pitch and the distance d.")
        z_um = settings.scene_z_um
        self.object_pitch_um = pitch * z_um / (1e3 * d_mm)
        self.truth = np.asarray(world.ground_truth(shape, pitch), np.float32)
        self.field = scene_field(
            shape, (shape[0] // 2, shape[1] // 2), settings.scene_size_um, self.object_pitch_um
        )
        self._response = measured.response.on_grid(shape, pitch, 1e3 * d_mm, lambertian=True)
        self.seconds: list[float] = []
        self.psnr_db: list[float] = []

    def picture(self, image: Float) -> Float:
        """Return a reconstruction with the brightness lost off the axis restored."""
        corrected: Float = image / self._response
        return corrected

    def upright(self, image: Float, margin: int = 0) -> Float:
        """Return the field of an image, and ``margin`` pixels around it, the right way up."""
        rows, columns = (
            slice(max(0, part.start - margin), part.stop + margin)
            for part in (self.field.rows, self.field.columns)
        )
        return np.ascontiguousarray(image[rows, columns][::-1, ::-1])

    def watch(
        self, advance: Callable[[float], None]
    ) -> Callable[[IterationRecord, Callable[[], Float]], object]:
        """Return a callback for the reconstruction that records its error over time."""

        def look(record: IterationRecord, image: Callable[[], Float]) -> None:
            if not self.seconds or record.seconds - self.seconds[-1] >= _LOOK_EVERY_S:
                self.seconds.append(record.seconds)
                self.psnr_db.append(compare(self.picture(image()[0]), self.truth, self.field).psnr_db)
                advance(record.seconds)

        return look


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
