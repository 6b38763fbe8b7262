"""Compressive calibration: photographs of bead slides at unknown places, no stage (Kuo 2020, sec. 5.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from calibration_routines.errors import CalibrationError
from calibration_routines.optics.photograph import expose_scene, photograph
from calibration_routines.psf.analysis import binned
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError, OperatorNeededError, SettingsError
from instrument.runs.run_control import RunControl
from instrument.runs.runner import RunProgress
from recon.blind import BlindResult, BlindSettings, calibrate_from_beads
from recon.types import Calibration, Geometry

Floats = npt.NDArray[np.float32]
Ask = Callable[[str], None]
Progress = Callable[[str, float], object]

MANY_PX = 1_000_000
"""Pixels beyond which solving takes long."""
BIN_FIRST = (
    "Note: images of more than a megapixel take long to solve; bin them until a spot of the pattern covers "
    "about two pixels."
)


@runtime_checkable
class SlideChanger(Protocol):
    """A shared part that can put another slide of beads before the camera: the simulated world."""

    def change_slide(self, number: int) -> None:
        """Show slide ``number``; each has its beads at other places."""


@dataclass(frozen=True, slots=True)
class BeadSlides:
    """What to photograph, and how to solve it.

    Attributes
    ----------
    z_um : float
        Depth of the slide.
    images : int
        Photographs, the slide moved by any amount in between (Kuo 2020: 9).
    average : int
        Frames a photograph.
    binning : int
        Software binning, on top of the camera's.
    window_px : (int, int) or None
        Height and width that hold the whole pattern, binned pixels; None: from the aperture.
    solver : BlindSettings
    """

    z_um: float
    images: int = 9
    average: int = 4
    binning: int = 1
    window_px: tuple[int, int] | None = None
    solver: BlindSettings = field(default_factory=BlindSettings)

    def __post_init__(self) -> None:
        problems = []
        if not 0 < self.z_um < np.inf:
            problems.append(
                ("z_um", f"the slide lies in front of the diffuser: z above 0, not {self.z_um / 1e3:g} mm")
            )
        if self.images < 2:
            problems.append(("images", f"{self.images} photograph: at least 2 are needed, 9 are usual"))
        if problems:
            raise SettingsError(problems)


@dataclass(frozen=True, slots=True)
class BeadCalibration:
    """PSFs from bead images."""

    calibration: Calibration
    result: BlindResult


def photograph_slides(
    bench: Bench,
    slides: BeadSlides,
    folder: Path | str | None = None,
    *,
    ask: Ask | None = None,
    progress: Progress | None = None,
    on_progress: RunProgress | None = None,
    control: RunControl | None = None,
) -> Floats:
    """Photograph a slide of beads several times, moved in between by the simulated world or the operator.

    ``progress`` is called with words and the share done before each photograph, ``on_progress`` with the
    run's status after each of its frames; ``control`` pauses, aborts or stops from another thread.

    Returns
    -------
    ndarray, float32, (n_images, height, width)
        Dark frame subtracted, colours averaged, binned.

    Raises
    ------
    OperatorNeededError
        When the slide has to be moved by hand and nobody can be asked.
    CalibrationError
        When an image saturates.
    """
    changer = next((part for part in bench.shared.values() if isinstance(part, SlideChanger)), None)
    if changer is None and ask is None:
        raise OperatorNeededError(
            "The bead slide must be moved by hand between photographs, and there is no terminal to ask at. "
            "Photograph it with snap, and give the images: calibrate beads FILE FILE ..."
        )
    exposure_ms: float | None = None
    images = []
    for number in range(slides.images):
        if control is not None:
            control.check()
        if progress is not None:
            progress(f"photograph {number + 1}", number / slides.images)
        if changer is not None:
            changer.change_slide(number)
        elif ask is not None:
            ask(f"Photograph {number + 1} of {slides.images}: move the bead slide somewhere else.")
        if exposure_ms is None:
            # Slides differ in brightness where beads overlap: leave room.
            exposure_ms = expose_scene(bench, target=0.5).exposure_ms
        taken = photograph(
            bench,
            exposure_ms,
            folder,
            average=slides.average,
            dark_frames=4,
            binning=slides.binning,
            on_progress=on_progress,
            control=control,
        )
        if taken.saturated_pixels > 0:
            raise CalibrationError(
                f"Photograph {number + 1} saturates in {taken.saturated_pixels} pixels: dim the light or "
                "spread the beads, and start again."
            )
        light = taken.measurement
        images.append(light if light.ndim == 2 else light.mean(axis=-1))
    return np.stack(images).astype(np.float32)


def calibrate_beads(
    images: Floats,
    slides: BeadSlides,
    geometry: Geometry,
    *,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> BeadCalibration:
    """Recover a calibration from bead images.

    Parameters
    ----------
    images : ndarray, float32, (n_images, height, width)
        Dark frame subtracted.
    slides : BeadSlides
    geometry : Geometry
        Of the images' pixels. ``diffuser_distance_mm`` and ``pixel_pitch_um`` place the PSFs;
        ``aperture_mm`` gives the window where none is named.

    Raises
    ------
    BenchError
        When the geometry lacks what is needed.
    InputError
        When the images cannot be solved.
    """
    pitch_um, distance_mm = needed_geometry(geometry)
    window = window_for(slides, geometry, (images.shape[1], images.shape[2]))
    result = calibrate_from_beads(images, window, slides.solver, progress=progress)
    object_um = pitch_um * slides.z_um / (1e3 * distance_mm)
    places = [(-column * object_um, -row * object_um, slides.z_um) for row, column in result.points]
    record = {
        "made_by": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "method": "beads at unknown places, blind deconvolution (Kuo 2020, Eqs. 5.11-5.13)",
        "slides": asdict(slides),
        **(provenance or {}),
    }
    calibration = Calibration(
        psfs=np.ascontiguousarray(result.on_sensor()[:, None]),
        source_positions_um=np.array(places),
        geometry=geometry,
        quality={
            "rank": result.rank,
            "misfits": list(result.misfits),
            "point_misfits": list(result.point_misfits),
            "stopped": result.stopped,
            "beads_found": [len(beads) for beads in result.beads],
        },
        provenance=record,
    )
    return BeadCalibration(calibration, result)


def needed_geometry(geometry: Geometry) -> tuple[float, float]:
    """Return ``pixel_pitch_um`` and ``diffuser_distance_mm``.

    Raises
    ------
    BenchError
        When one is not known.
    """
    pitch_um, distance_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
    if pitch_um is None or distance_mm is None:
        raise BenchError(
            "Where the PSFs belong follows from pixel_pitch_um and diffuser_distance_mm: give them in "
            "[geometry] of bench.toml (or --pixel-um and --distance-mm with files)."
        )
    return pitch_um, distance_mm


def window_for(slides: BeadSlides, geometry: Geometry, shape: tuple[int, int]) -> tuple[int, int]:
    """Return height and width in which a PSF is looked for, at most the images' ``shape``.

    Raises
    ------
    BenchError
        When it neither is given nor follows from the geometry.
    """
    height, width = slides.window_px or window_of(geometry, slides.z_um)
    return min(height, shape[0]), min(width, shape[1])


def bench_geometry(bench: Bench, slides: BeadSlides) -> Geometry:
    """Return the geometry of the slides' binned pixels."""
    return binned(bench.geometry, slides.binning)


def window_of(geometry: Geometry, z_um: float, deflection_deg: float = 1.0) -> tuple[int, int]:
    """Return the pixels that hold a PSF: the aperture's shadow at a depth, and what is bent beyond it.

    Raises
    ------
    BenchError
        When the aperture, the distance d or the pitch are not known.
    """
    if None in (geometry.aperture_mm, geometry.diffuser_distance_mm, geometry.pixel_pitch_um):
        raise BenchError(
            "How large the pattern is follows from aperture_mm, diffuser_distance_mm and pixel_pitch_um: "
            "give them in [geometry] of bench.toml, or the window with --window."
        )
    assert geometry.aperture_mm is not None
    assert geometry.diffuser_distance_mm is not None
    assert geometry.pixel_pitch_um is not None
    distance_um = 1e3 * geometry.diffuser_distance_mm
    bent_um = 2 * distance_um * np.tan(np.deg2rad(deflection_deg))
    height, width = (
        int((1e3 * side * (1 + distance_um / z_um) + bent_um) / geometry.pixel_pitch_um) // 2 * 2 + 1
        for side in geometry.aperture_mm
    )
    return height, width


def mean_images(frames: Sequence[npt.NDArray[Any]]) -> Floats:
    """Stack grey or colour images of one shape as float32, colours averaged.

    Raises
    ------
    BenchError
        When shapes differ.
    """
    grey = [image if image.ndim == 2 else image.mean(axis=-1) for image in frames]
    shapes = {image.shape for image in grey}
    if len(shapes) != 1:
        found = ", ".join(f"{h} x {w}" for h, w in sorted(shapes))
        raise BenchError(f"The images differ in size ({found}); all must come from one camera setting.")
    return np.stack(grey).astype(np.float32)


__all__ = [
    "BIN_FIRST",
    "MANY_PX",
    "BeadCalibration",
    "BeadSlides",
    "SlideChanger",
    "bench_geometry",
    "calibrate_beads",
    "mean_images",
    "needed_geometry",
    "photograph_slides",
    "window_for",
    "window_of",
]
