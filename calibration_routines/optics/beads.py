"""Compressive calibration: photographs of bead slides at unknown places, no stage (Kuo 2020, sec. 5.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from importlib.metadata import version
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.optics.bead_photographs import (
    BEADS,
    BEADS_FOLDER,
    SLIDE,
    BeadSlides,
    photograph_slides,
    show_slide_again,
    went_on,
)
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import binned
from calibration_routines.psf.sampling import known
from calibration_routines.purpose import CalibrationError
from calibration_routines.routine import Routine
from instrument.bench.bench import Bench
from instrument.bench.camera_settings import restore_camera
from instrument.files import kept_times
from instrument.files.atomic import named_by_worth
from instrument.files.calibration_file import save_calibration
from instrument.files.record import plain
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from instrument.runs.writer import dated_name, free_name
from recon.arrays import Float32Array
from recon.base.declare import option
from recon.blind import BlindResult, calibrate_from_beads
from recon.blind.made_up import LEAST_ALIKE, MOST_BEADS
from recon.blind.work import blind_work
from recon.types import Calibration, Geometry

Progress = Callable[[str, float], object]

MANY_PX = 1_000_000
"""Pixels beyond which solving takes long."""
BIN_FIRST = (
    "Note: images of more than a megapixel take long to solve; bin them until a spot of the pattern covers "
    "about two pixels."
)


_DEFLECTION_DEG = 1.0  # by which the diffuser bends light, for the window
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
    """What is wrong with the photographs and the PSFs, in words."""


def calibrate_beads(
    images: Float32Array,
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
    findings = made_up_findings(result, slides.binning)
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
            "halves_alike": result.halves_alike,
            "findings": list(findings),
            "good": not findings,
        },
        provenance=record,
    )
    return BeadCalibration(calibration, result, findings=findings)


def made_up_findings(result: BlindResult, binning: int) -> tuple[str, ...]:
    """Return what tells that PSFs and beads are made up, in words."""
    finer = "bin less" if binning > 1 else "take smaller pixels, if these were binned"
    findings = []
    if result.halves_alike < LEAST_ALIKE:
        findings.append(
            f"either half of the photographs gives another PSF: {result.halves_alike:.2f} alike "
            f"({LEAST_ALIKE:g} expected), so that it is made up in part. Spots of the pattern smaller than "
            f"two pixels are the usual reason: {finer}. Else: more photographs, more light, some twenty "
            "beads in each."
        )
    fewest, *_, most = sorted(map(len, result.beads))
    if np.median([len(beads) for beads in result.beads]) > MOST_BEADS:
        findings.append(
            f"{fewest} to {most} beads were found in a photograph: more than {MOST_BEADS} are not told "
            "apart, and PSFs off the axis come out wrong. Put some twenty on the slide; where it had no "
            "more, take more photographs."
        )
    return tuple(findings)


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


SLIDES, SOLVING = "photographing bead slides", "blind deconvolution"


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
        needed_geometry(geometry)
        window = window_for(slides, geometry, frame)
        light = kept_times.photographed_by(SLIDES, 1e-6 * prod(bench.camera.frame_shape[:2]))
        work = (
            (SLIDE, slides.images * light if bench.simulated_kinds else 0.0),
            (SOLVING, blind_work((slides.images, *frame), window, slides.solver).total),
        )
        return Outlook(
            (
                f"{slides.images} photographs of {slides.average} frames, each with 4 dark frames: {frames} "
                "frames; the slide is moved in between",
                *psf_lines(slides, geometry, frame),
            ),
            work=work,
        )

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Photograph, solve, and save the calibration."""
        return _photograph_and_solve(bench, self.slides.planned(bench), folder, control, listener)


def _photograph_and_solve(
    bench: Bench,
    slides: BeadSlides,
    folder: Path | None,
    control: RunControl,
    listener: Listener,
    begun: Run | None = None,
) -> Outcome:
    """Photograph the slides that are left after ``begun``, solve all, and save the calibration."""
    geometry = binned(bench.geometry, slides.binning)
    facts: dict[str, Any] = {"bench": bench.label, "simulated": bool(bench.simulated_kinds)}
    listener.step(SLIDES)
    taken = photograph_slides(bench, slides, folder, control, listener, begun)
    shape = taken.images.shape[0], taken.images.shape[1], taken.images.shape[2]
    kept_times.counted(blind_work(shape, window_for(slides, geometry, shape[1:]), slides.solver).total)
    listener.step(SOLVING)

    def solving(_words: str, done: float) -> None:
        control.check()
        listener.share(done, 1.0)

    facts |= {"runs": [run.name for run in taken.runs]}
    solved = calibrate_beads(taken.images, slides, geometry, provenance=facts, progress=solving)
    findings = (*taken.findings, *solved.findings)
    kept = {"scatter": plain(taken.scatter), "findings": list(findings), "good": not findings}
    calibration = replace(solved.calibration, quality={**solved.calibration.quality, **kept})
    solved = replace(solved, calibration=calibration, runs=taken.runs, findings=findings)
    out = slides.out or free_name(folder or bench.config.data_folder, dated_name("bead calibration"))
    outcome = save_beads(solved, slides, out)
    if outcome.calibration is not None:
        went_on(taken.runs[-1], outcome.calibration)
    return outcome


def _finish(run: Run, bench: Bench | None, control: RunControl, listener: Listener) -> Outcome:
    """Go on with slides whose newest photograph is whole: beside its run, with the camera as it was.

    Raises CalibrationError where no bench is open.
    """
    if bench is None:
        raise CalibrationError(f"{run.path} goes on with photographs: open the bench for it.")
    slides = BEADS.read(run.path).slides
    slides.refuse_existing()
    restore_camera(bench.camera, run.provenance["camera"])
    return _photograph_and_solve(bench, slides, run.path.parent, control, listener, run)


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
        f"PSFs from either half of the photographs: {result.halves_alike:.3f} alike",
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
        purpose=BEADS,
        finish=_finish,
        restore=show_slide_again,
        finish_takes_frames=True,
        examples=(
            "diffuserbench calibrate beads --binning 4             photographs 9 slides, then solves",
            "diffuserbench calibrate beads --binning 4 --dry-run   only says what it would do",
            "diffuserbench calibrate beads --z 2.5 slide-*.tif --pixel-um 11.6 --distance-mm 3.8 "
            "--window 221x221",
        ),
        file=BEADS_FOLDER,
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
