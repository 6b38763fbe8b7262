"""Compressive calibration: photographs of bead slides at unknown places, no stage (Kuo 2020, sec. 5.4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from calibration_routines.optics.photograph import Photograph, photograph, photograph_findings
from calibration_routines.procedure import (
    MM,
    CalibrationError,
    Checked,
    Listener,
    Outcome,
    Outlook,
    Procedure,
    Routine,
    Size,
)
from calibration_routines.psf.analysis import binned
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.sampling import known
from instrument.bench.bench import Bench
from instrument.files.atomic import named_by_worth, require_new
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError, OperatorNeededError, SettingsError, count
from instrument.files.images import write_image
from instrument.runs.run_control import RunControl
from instrument.runs.writer import dated_name, free_name
from recon.base.declare import RARE, option
from recon.blind import BlindResult, BlindSettings, calibrate_from_beads
from recon.types import Calibration, Geometry

Floats = npt.NDArray[np.float32]
Progress = Callable[[str, float], object]

BEADS_FOLDER = "calibration-beads"
"""Where the command line writes the calibration."""
SLIDE_FILE = "beads.tif"
"""Of a photograph of a slide, in its run's folder: no scene to reconstruct."""
MANY_PX = 1_000_000
"""Pixels beyond which solving takes long."""
BIN_FIRST = (
    "Note: images of more than a megapixel take long to solve; bin them until a spot of the pattern covers "
    "about two pixels."
)


@runtime_checkable
class SlideChanger(Protocol):
    """A shared part that can put another slide of beads before the camera: the simulated world."""

    @property
    def slide_z_um(self) -> float:
        """How far from the diffuser its slides are."""

    def change_slide(self, number: int) -> None:
        """Show slide ``number``; each has its beads at other places."""


_TAKES, _SHORTER = 3, 0.7
"""Times that a slide which saturates is photographed, and the share of the exposure each time."""
_SOLVER = BlindSettings()
_DEFLECTION_DEG = 1.0  # by which the diffuser bends light, for the window


@dataclass(frozen=True, kw_only=True)
class BeadSlides(Checked):
    """What to photograph, and how to solve it."""

    z_um: float | None = option(
        None,
        **MM,
        flags=("--z",),
        above=0,
        label="Depth",
        help="Depth of the slide, from the diffuser.",
        default_words="where the simulated bench has it; else it must be given",
    )
    images: int = option(
        9, least=2, label="Photographs", help="Photographs to take, the slide moved by any amount in between."
    )
    average: int = option(4, least=1, label="Frames a photograph", help="Frames a photograph, averaged.")
    binning: int = option(1, least=1, help="Software binning, on top of the camera's.")
    grid: Size = option(
        Size(*_SOLVER.grid),
        flags=("--psfs",),
        metavar="RxC",
        label="PSFs",
        help="Rows and columns of PSFs over the field.",
        parse=Size.of,
    )
    rank: int = option(
        max(_SOLVER.ranks),
        least=1,
        label="Highest rank",
        help="Highest rank tried with beads on the pixel grid; raised step by step up to this.",
    )
    degree: int = option(
        _SOLVER.degree,
        least=0,
        most=2,
        help="How PSFs vary over the field in the end: 0 not, 1 linearly, 2 quadratically.",
        group=RARE,
    )
    iterations: int = option(
        _SOLVER.iterations,
        least=1,
        flags=("--iterations", "-n"),
        help="Of each half-step.",
        group=RARE,
    )
    tau: float = option(
        _SOLVER.tau, label="Sparsity", help="Weight of the beads' sparsity, relative.", group=RARE
    )
    reach: float = option(_SOLVER.reach, help="Part of the sensor's field that the PSFs span.", group=RARE)
    window_px: Size | None = option(
        None,
        flags=("--window",),
        metavar="HxW",
        label="Window",
        help="Height and width that hold the whole pattern, binned pixels.",
        default_words="from the aperture",
        parse=Size.of,
        group=RARE,
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FOLDER",
        label="Folder",
        help="Where the calibration goes.",
        default_words=f"{BEADS_FOLDER}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Replace a calibration that exists.")

    def planned(self, bench: Bench) -> BeadSlides:
        """Return them with their depth filled in, where the simulated world knows it."""
        changer = _slide_changer(bench)
        return self if self.z_um is not None or changer is None else replace(self, z_um=changer.slide_z_um)

    @property
    def distance_um(self) -> float:
        """The depth; SettingsError where nobody has said it."""
        if self.z_um is None:
            raise SettingsError(
                [("z_um", "the slide's distance from the diffuser, which nothing else tells")]
            )
        return self.z_um

    @property
    def solver(self) -> BlindSettings:
        """How the images are solved."""
        return BlindSettings(
            grid=self.grid.shape,
            ranks=tuple(range(1, self.rank + 1)),
            iterations=self.iterations,
            degree=self.degree,
            tau=self.tau,
            reach=self.reach,
        )

    def refuse_existing(self) -> None:
        """Refuse to write over a calibration that nobody allowed to be replaced."""
        if self.out is not None:
            require_new(self.out, overwrite=self.overwrite)

    def record(self) -> dict[str, Any]:
        """Return what is kept of it with a calibration."""
        taken = {name: getattr(self, name) for name in ("z_um", "images", "average", "binning")}
        window = None if self.window_px is None else self.window_px.shape
        return {**taken, "window_px": window, "solver": asdict(self.solver)}


_FILES = "With image files"


@dataclass(frozen=True, kw_only=True)
class BeadFiles:
    """What is not known of photographs that were taken elsewhere."""

    dark: float = option(0.0, least=0, help="The dark level, counts.", group=_FILES)
    pixel_um: float | None = option(
        None, unit="um", above=0, help="Pixel pitch.", default_words="not known", group=_FILES
    )
    distance_mm: float | None = option(
        None, unit="mm", above=0, help="From diffuser to sensor.", default_words="not known", group=_FILES
    )


@dataclass(frozen=True, slots=True)
class BeadCalibration:
    """PSFs from bead images."""

    calibration: Calibration
    result: BlindResult
    runs: tuple[Path, ...] = ()
    """Of the photographs, each with what was solved; none where they came from files."""
    findings: tuple[str, ...] = ()
    """What is wrong with the photographs, in words."""


@dataclass(frozen=True, slots=True)
class BeadPhotographs:
    """What was photographed of slides of beads."""

    images: Floats
    """(n_images, height, width): dark frame subtracted, colours averaged, binned."""
    runs: tuple[Path, ...] = ()
    findings: tuple[str, ...] = ()
    """What is wrong with place and other light in them."""


def _slide_changer(bench: Bench) -> SlideChanger | None:
    return next((part for part in bench.shared.values() if isinstance(part, SlideChanger)), None)


def photograph_slides(
    bench: Bench, slides: BeadSlides, folder: Path | None, control: RunControl, listener: Listener
) -> BeadPhotographs:
    """Photograph a slide of beads several times, moved in between by the simulated world or the operator.

    A slide that saturates is photographed again, shorter, and those after it as short: a bead's brightness is
    free anyway. The listener is told.

    Raises OperatorNeededError when the slide has to be moved by hand and nobody can be asked;
    CalibrationError when an image saturates still, the last time or at the camera's shortest exposure.
    """
    if _slide_changer(bench) is None and bench.ask is None:
        raise OperatorNeededError(
            "The bead slide must be moved by hand between photographs, and there is no terminal to ask at. "
            "Photograph it with snap, and give the images: calibrate beads FILE FILE ..."
        )
    photographs: list[Photograph] = []
    try:
        _photograph_each(bench, slides, folder, control, listener, photographs)
    except BaseException as error:
        if photographs:
            kept = ", ".join(str(one.run.path) for one in photographs)
            error.add_note(f"{count(len(photographs), 'slide')} photographed before: {kept}")
        raise
    return BeadPhotographs(
        mean_images([one.measurement for one in photographs]),
        tuple(one.run.path for one in photographs),
        photograph_findings(photographs),
    )


def _photograph_each(
    bench: Bench,
    slides: BeadSlides,
    folder: Path | None,
    control: RunControl,
    listener: Listener,
    photographs: list[Photograph],
) -> None:
    """Photograph slide after slide; ``photographs`` has those that are done, whatever happens."""
    changer, ask = _slide_changer(bench), bench.ask
    exposure_ms: float | None = None
    shortest_ms = bench.camera.exposure_limits_ms[0]
    for number in range(slides.images):
        control.check()
        if changer is not None:
            changer.change_slide(number)
        elif ask is not None:
            ask(f"Photograph {number + 1} of {slides.images}: move the bead slide somewhere else.")
        if exposure_ms is None:
            # Slides differ in brightness where beads overlap: leave room.
            exposure_ms = expose_scene(bench, target=0.5).exposure_ms
        for take in range(1, _TAKES + 1):
            taken = photograph(
                bench,
                exposure_ms,
                folder,
                average=slides.average,
                dark_frames=4,
                binning=slides.binning,
                control=control,
                listener=listener,
            )
            shorter_ms = max(_SHORTER * exposure_ms, shortest_ms)
            if taken.saturated_pixels == 0 or take == _TAKES or not shorter_ms < exposure_ms:
                break
            listener.said(
                f"Photograph {number + 1} saturates in {taken.saturated_pixels} pixels at {exposure_ms:.4g} "
                f"ms: it is taken again at {shorter_ms:.4g} ms, and those that follow as short."
            )
            exposure_ms = shorter_ms
        if taken.saturated_pixels > 0:
            least = ", the camera's shortest exposure" if exposure_ms <= shortest_ms else ""
            raise CalibrationError(
                f"Photograph {number + 1} saturates in {taken.saturated_pixels} pixels, taken {take} "
                f"{'time' if take == 1 else 'times'}, at {exposure_ms:.4g} ms{least}: dim the light or "
                "spread the beads, and start again. " + " ".join(taken.findings)
            )
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "binning": slides.binning}
        file = named_by_worth(taken.run.path / SLIDE_FILE, doubted=bool(taken.findings))
        write_image(file, taken.measurement, facts | {"dark": "taken off"})
        photographs.append(taken)


def calibrate_beads(
    images: Floats,
    slides: BeadSlides,
    geometry: Geometry,
    *,
    provenance: dict[str, Any] | None = None,
    progress: Progress | None = None,
) -> BeadCalibration:
    """Recover a calibration from bead images, (n_images, height, width), dark frame subtracted.

    ``geometry`` is that of the images' pixels: ``diffuser_distance_mm`` and ``pixel_pitch_um`` place the
    PSFs, ``aperture_mm`` gives the window where none is named.

    Raises BenchError when the geometry lacks what is needed; InputError when the images cannot be solved.
    """
    pitch_um, distance_mm = needed_geometry(geometry)
    z_um = slides.distance_um
    window = window_for(slides, geometry, (images.shape[1], images.shape[2]))
    result = calibrate_from_beads(images, window, slides.solver, on_progress=progress)
    object_um = pitch_um * z_um / (1e3 * distance_mm)
    places = [(-column * object_um, -row * object_um, z_um) for row, column in result.points]
    record = {
        "made_by": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "method": "beads at unknown places, blind deconvolution (Kuo 2020, Eqs. 5.11-5.13)",
        "slides": slides.record(),
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


def needed_geometry(geometry: Geometry) -> list[float]:
    """Return ``pixel_pitch_um`` and ``diffuser_distance_mm``; BenchError when one is not known."""
    return known(
        geometry,
        "pixel_pitch_um",
        "diffuser_distance_mm",
        what="Where the PSFs belong follows",
        otherwise=" (or --pixel-um and --distance-mm with files)",
    )


def window_for(slides: BeadSlides, geometry: Geometry, shape: tuple[int, int]) -> tuple[int, int]:
    """Return height and width in which a PSF is looked for, at most the images' ``shape``.

    Unless given, the aperture's shadow at the slides' depth, and what is bent beyond it. Raises BenchError
    where the aperture, the distance d or the pitch are not known for that.
    """
    if slides.window_px is not None:
        window = slides.window_px.shape
    else:
        aperture_mm, distance_mm, pitch_um = known(
            geometry,
            "aperture_mm",
            "diffuser_distance_mm",
            "pixel_pitch_um",
            what="How large the pattern is follows",
            otherwise=", or the window with --window",
        )
        bent_um = 2e3 * distance_mm * np.tan(np.deg2rad(_DEFLECTION_DEG))
        height, width = (
            int((1e3 * side * (1 + 1e3 * distance_mm / slides.distance_um) + bent_um) / pitch_um) // 2 * 2 + 1
            for side in aperture_mm
        )
        window = height, width
    return min(window[0], shape[0]), min(window[1], shape[1])


def mean_images(frames: Sequence[npt.NDArray[Any]]) -> Floats:
    """Stack grey or colour images of one shape as float32, colours averaged.

    Raises BenchError when shapes differ.
    """
    grey = [image if image.ndim == 2 else image.mean(axis=-1) for image in frames]
    shapes = {image.shape for image in grey}
    if len(shapes) != 1:
        found = ", ".join(f"{h} x {w}" for h, w in sorted(shapes))
        raise BenchError(f"The images differ in size ({found}); all must come from one camera setting.")
    return np.stack(grey).astype(np.float32)


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class BeadProcedure(Procedure):
    """Photograph bead slides and recover PSFs from them, without a stage.

    The slide is moved in between by the simulated bench, or by the operator, who is asked.
    """

    slides: BeadSlides

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse what cannot be solved because the optics are not known, or saved."""
        self.slides.refuse_existing()
        slides = self.slides.planned(bench)
        geometry = binned(bench.geometry, slides.binning)
        frame = bench.camera.frame_shape[0] // slides.binning, bench.camera.frame_shape[1] // slides.binning
        frames = slides.images * (slides.average + 4)
        return Outlook(
            (
                f"{slides.images} photographs of {slides.average} frames, each with 4 dark frames: {frames} "
                "frames; the slide is moved in between",
                *psf_lines(slides, geometry, frame),
            )
        )

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Photograph, solve, and save the calibration."""
        slides = self.slides.planned(bench)
        geometry = binned(bench.geometry, slides.binning)
        facts: dict[str, Any] = {"bench": bench.label, "simulated": bool(bench.simulated_kinds)}
        listener.step("photographing bead slides")
        taken = photograph_slides(bench, slides, folder, control, listener)
        listener.step("blind deconvolution")

        def solving(_words: str, done: float) -> None:
            control.check()
            listener.share(done, 1.0)

        facts |= {"runs": [run.name for run in taken.runs]}
        solved = calibrate_beads(taken.images, slides, geometry, provenance=facts, progress=solving)
        solved = replace(solved, runs=taken.runs, findings=taken.findings)
        out = slides.out or free_name(folder or bench.config.data_folder, dated_name("bead calibration"))
        return save_beads(solved, slides, out)


def psf_lines(slides: BeadSlides, geometry: Geometry, shape: tuple[int, ...]) -> tuple[str, ...]:
    """Return which PSFs will be recovered from images of a shape, in words.

    Raises BenchError when they cannot be, because the optics are not known.
    """
    needed_geometry(geometry)
    height, width = window_for(slides, geometry, (shape[0], shape[1]))
    rows, columns = slides.grid.shape
    words = (
        f"{rows} x {columns} PSFs of {height} x {width} pixels at z = {slides.distance_um / 1e3:g} mm, over "
        f"{slides.reach:.0%} of the field of {shape[0]} x {shape[1]} pixels"
    )
    return (words, BIN_FIRST) if shape[0] * shape[1] > MANY_PX else (words,)


def save_beads(solved: BeadCalibration, slides: BeadSlides, out: Path) -> Outcome:
    """Save a calibration from bead images."""
    doubted = bool(solved.findings)
    named = named_by_worth(out, doubted=doubted, overwrite=slides.overwrite)
    path = save_calibration(solved.calibration, named, overwrite=slides.overwrite)
    return Outcome(
        verdict=(*(f"Quality: {words}" for words in solved.findings), *bead_lines(solved)),
        good=not doubted,
        runs=solved.runs,
        calibration=path,
        result=solved,
    )


def bead_lines(done: BeadCalibration) -> list[str]:
    """Return what the bead images gave, in lines."""
    result = done.result
    misfits, between = (", ".join(f"{m:.3f}" for m in ms) for ms in (result.misfits, result.point_misfits))
    simulated = bool(done.calibration.provenance.get("simulated"))
    return [
        *(["SIMULATED: the photographs come from the simulated bench"] if simulated else []),
        f"Beads found: {', '.join(map(str, done.calibration.quality['beads_found']))}",
        f"Misfit by rank: {misfits} with beads on the pixel grid ({result.stopped});",
        f"  {between} with beads between pixels, PSFs of rank {result.rank}",
    ]


ROUTINES = (
    Routine(
        name="beads",
        title="Bead slides",
        help="Recover PSFs over the field from a few photographs of some twenty beads at unknown places: "
        "no stage is needed.",
        details="Blind deconvolution under a rank constraint that is raised step by step (Kuo 2020, Eqs. "
        "5.11-5.13). Between photographs the slide is moved by any amount: the operator is asked, "
        "or the simulated bench does it. Brightness and absolute place of the beads stay unknown: "
        "every PSF has unit light, their mean is centred.",
        options=BeadSlides,
        procedure=BeadProcedure,
        examples=(
            "diffuserbench calibrate beads --binning 4             photographs 9 slides, then solves",
            "diffuserbench calibrate beads --binning 4 --dry-run   only says what it would do",
            "diffuserbench calibrate beads --z 2.5 slide-*.tif --pixel-um 11.6 --distance-mm 3.8 "
            "--window 221x221",
        ),
        file=BEADS_FOLDER,
    ),
)
"""Row of :data:`calibration_routines.procedure.routines`."""
