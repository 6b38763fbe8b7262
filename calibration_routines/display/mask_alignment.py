"""Find the scattering mask's pose by spots on the camera, and move the stage to take out what it can.

Kuo 2020, Sec. 7.4, hill-climbs the brightness of one spot, which is felt only within one SLM pixel. Here
nothing moves at first: each picture holds many spots, each computed for another hypothesis about the pose.

1. The mask's own speckle (blank SLM) registers the camera.
2. Search: shift in steps of one SLM pixel, at a few depths; the spots that stand out are candidates, tried
   with rotations and scales, then on finer grids (:mod:`~calibration_routines.display.mask_search`).
3. Refinement: pairs of spots on either side of the pose, a pair a parameter; all eight parameters in one
   step (:mod:`~calibration_routines.display.mask_search`).
4. The stage: a small move and back tells which way its axes go and how well it comes back; then it takes out
   shift, depth, rotation and significant tilts, until a further move promises less than that repeatability
   (:mod:`~calibration_routines.display.mask_stage`).
5. Sections of the SLM make spots of their own: their shifts give the smooth rest of the displacement, which
   stays in the model. All light of the same pictures, speckle between the spots included, then tells place,
   depth and tilts 11 to 30 times better (:mod:`recon.holography.place`). A last move takes out what spots
   could not tell, all light says where that ended, and 3 once more checks it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.display.display_io import DisplayBench, approach_from_below, require_slm, writable
from calibration_routines.display.kept_frames import KeptFrames, kept_words
from calibration_routines.display.mask_search import (
    ALIGNMENT_FILE,
    STEADY_FRAMES,
    AlignmentFailedError,
    AlignmentSession,
    AlignmentSettings,
    Measured,
    fit_photographs,
    measure_sections,
    photograph_sections,
    refine_pose,
    search_pose,
)
from calibration_routines.display.mask_stage import MaskStage, PlacementCost
from calibration_routines.planned import home_if_needed
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.routine import Routine
from calibration_routines.scatter import STEADY, Scatter
from drivers.errors import StoppedError
from instrument.bench.bench import Bench
from instrument.display.alignment import Alignment, save_alignment
from instrument.display.bench_display import bench_display
from instrument.files.atomic import named_by_worth, require_new
from instrument.files.record import plain
from instrument.files.slm_image import load_slm_correction
from instrument.runs.run_control import EndedEarlyError, RunControl
from recon.arrays import Float64Array
from recon.errors import InputError
from recon.holography import Display
from recon.holography.camera_map import CameraMap
from recon.holography.place import FittedPlace
from recon.holography.pose import NAMES, Pose
from recon.holography.sections import SmoothField

__all__ = ["AlignmentFailedError", "AlignmentReport", "AlignmentSettings", "MaskAlignment"]


Field = Float64Array

LAST_MOVES = 2
LAST_PICTURES = 4
"""Photographs of sections' spots after a last move."""
WORTH_DB = 0.02
"""What depth has to cost a hologram to be moved against once more."""
_DEEP = [NAMES.index(name) for name in ("z_um", "pitch_mrad", "yaw_mrad")]
_SURE = 5.0  # standard deviations
_APART_PX = 0.5  # mask pixels


@dataclass(slots=True)
class AlignmentReport:
    """What was found."""

    pose: Pose
    """What is left, with the stage where it ended; holograms are to be computed with it."""
    error: Float64Array
    """(8,): standard uncertainty of each parameter."""
    rest: Float64Array
    """(rows, columns, 2): smooth displacement beyond the pose's, on the nodes of
    :meth:`Pose.displacement`, mask pixels."""
    efficiency: float
    """Brightness of spots at the pose over the model's ideal (the display's DC term taken off)."""
    psnr_lost_db: float
    """What a hologram computed with the result is expected to lose to what remains unknown or cannot be
    modelled: uncertainties, distance, tilts."""
    repeatability_db: float
    """What a hologram would lose to the difference between two visits of the same place; nan where the stage
    was not moved."""
    found_at: Pose
    """What was found before the stage moved."""
    directions: dict[str, int]
    """As tested; -1 goes against its name."""
    frames: int
    mask_shape: tuple[int, int]
    """Of the mask, in its pixels."""
    camera: CameraMap
    brightness_per_ms: float
    """Camera counts a millisecond for the mean intensity."""
    scatter: Scatter = STEADY
    """Of pictures of the blank SLM."""
    apart_px: float = 0.0
    """Distance of the shifts that spots of the whole SLM and of its sections tell, mask pixels."""
    lobe_px: float = float("inf")
    """Half width of a spot, camera pixels."""
    log: list[str] = field(default_factory=list)
    efficiencies: list[tuple[int, float]] = field(default_factory=list)
    """Frames taken and efficiency after each step."""

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong with light and place, in words."""
        found = []
        if self.scatter.motion_px > self.lobe_px:
            found.append(
                f"the picture shakes by {self.scatter.motion_px:.2f} pixels from frame to frame, more than a "
                f"spot's half width ({self.lobe_px:.2f}): clamp camera and lenses, take the table off what "
                "vibrates, and align again."
            )
        if self.apart_px > max(_SURE * float(np.hypot(*self.error[:2])), _APART_PX):
            found.append(
                f"spots of the whole SLM and of its sections tell shifts {self.apart_px:.2f} mask pixels "
                "apart: something moved or the light changed meanwhile. Align again."
            )
        return tuple(found)

    def displacement(self, mask_shape: tuple[int, int]) -> Float64Array:
        """Return the displacement field for :class:`recon.holography.Display`."""
        return self.pose.displacement(mask_shape) + self.rest


class MaskAlignment:
    """Runs the procedure on an open bench; what is known of the display's displacement is not used.

    What is found is said to the listener, and every picture of spots shown; it may raise to end the
    alignment.
    """

    def __init__(
        self,
        io: DisplayBench,
        display: Display,
        settings: AlignmentSettings | None = None,
        listener: Listener | None = None,
    ) -> None:
        self.io = io
        self.settings = settings or AlignmentSettings()
        self.session = AlignmentSession(io, display, self.settings, listener or Listener())
        self._cost = PlacementCost(self.session.display)
        self._repeatability_db = float("nan")
        self._directions: dict[str, int] = {}

    def run(self) -> AlignmentReport:
        """Align; returns what was found and leaves the stage at the best pose.

        Raises AlignmentFailedError when the pose was not found or too many frames would be needed, with
        the stage back where it was; DeviceError when a device fails or a move is refused, with the stage
        where that left it. What else ends it leaves the stage where it is, and says where.
        """
        stage = self.io.bench.stage
        start = stage.commanded_position() if stage is not None else {}
        try:
            return self._run()
        except (AlignmentFailedError, InputError) as error:
            if stage is not None and stage.commanded_position() != start:
                approach_from_below(stage, start)
            if isinstance(error, InputError):
                raise AlignmentFailedError(str(error)) from error
            raise
        except (EndedEarlyError, StoppedError, KeyboardInterrupt, SystemExit) as error:
            if stage is not None:
                here = stage.commanded_position()
                moved = f"moved from {_told(start)}" if here != start else "not moved"
                error.add_note(f"The stage stands at {_told(here)} ({moved}).")
            raise

    def _run(self) -> AlignmentReport:
        session, settings = self.session, self.settings
        stage = MaskStage(session, self.io.bench.stage) if self.io.bench.stage and settings.moves else None
        if stage is not None:
            stage.go(stage.position)  # from below, as every place from now on
        session.register()
        found = refine_pose(session, search_pose(session), 3)
        found_at = found.pose
        if stage is not None:
            session.check(found.efficiency, floor=0.15)
            found = self._move(stage, found)
        smooth, _ = measure_sections(session, found.pose)
        pose, rest = _place(found.pose, smooth, session.display.mask.shape)
        fitted, pose, rest = self._fitted(pose, rest)
        if stage is not None and "z_um" in stage.direction and fitted is not None:
            fitted, pose, rest = self._settled(stage, fitted, pose, rest)
        session.spots.maker.rest = rest
        last = refine_pose(session, pose, settings.refinements, quick=0)
        session.check(last.efficiency)
        # All light sees the mask's place best, then sections its displacement, and probes of the whole SLM.
        smooth = smooth if fitted is None else fitted.field
        values, error = pose.vector(), smooth.error.copy()
        apart = float(np.hypot(*(last.pose.vector() - values)[:2]))
        if fitted is None:
            values[_DEEP], error[_DEEP] = last.pose.vector()[_DEEP], last.error[_DEEP]
        else:
            error[_DEEP] = fitted.deep_error
        pose = Pose(*(float(v) for v in values))
        scatter = session.scatter()
        return AlignmentReport(
            pose,
            error,
            rest,
            last.efficiency,
            self._cost.lost_db(pose, error[_DEEP], rest, smooth.modes),
            self._repeatability_db,
            found_at,
            self._directions,
            self.io.frames,
            session.display.mask.shape,
            session.spots.camera,
            session.spots.mean_per_ms,
            scatter,
            apart,
            min(session.spots.lobes_px),
            session.log,
            session.efficiencies,
        )

    def _fitted(self, pose: Pose, rest: Field) -> tuple[FittedPlace | None, Pose, Field]:
        """Fit all light of the last pictures; returns the place, as it was where they do not tell it."""
        fitted = fit_photographs(self.session, pose, rest)
        if fitted is None:
            return None, pose, rest
        smooth = replace(fitted.field, rest=rest + fitted.field.rest)
        return fitted, *_place(fitted.pose, smooth, self.session.display.mask.shape)

    def _settled(
        self, stage: MaskStage, fitted: FittedPlace, pose: Pose, rest: Field
    ) -> tuple[FittedPlace, Pose, Field]:
        """Take out what all light tells and spots did not: depth first of all.

        Tilts stay: where the SLM is not flat, all light takes that for them, and they cost next to nothing.
        """
        session = self.session
        for _ in range(LAST_MOVES if self.settings.moves else 0):
            costs_db = self._cost.of_depth_db(pose, rest)
            session.say(f"all light: {pose.z_um:+.1f} um of depth are left and cost {costs_db:.2f} dB")
            needed = 1 + LAST_PICTURES + self.settings.refinements + STEADY_FRAMES
            if costs_db < WORTH_DB or session.frames_left < needed:
                break
            error = fitted.field.error.copy()
            error[_DEEP] = fitted.deep_error[0], np.inf, np.inf
            expected = stage.take_out(Measured(pose, error, 1.0))
            if expected is None:
                break
            session.register()
            photograph_sections(session, expected, rest, LAST_PICTURES)
            again, pose, rest = self._fitted(expected, rest)
            if again is None:
                raise AlignmentFailedError(
                    "Alignment failed: after its last move the mask is not where the stage was asked to "
                    "bring it. Check that the mask is fixed and the stage holds its place, and align again."
                )
            fitted = again
        return fitted, pose, rest

    def _move(self, stage: MaskStage, at: Measured) -> Measured:
        """Take out what the stage can, as long as that promises more than its repeatability."""
        session, cost = self.session, self._cost
        at, apart = stage.test(at)
        self._directions = stage.direction
        self._repeatability_db = cost.of_difference_db(stage.removable(at.pose), apart)
        session.say(f"repeatability: {self._repeatability_db:.2f} dB")
        visited = [(cost.psnr_db(at.pose), at, stage.position)]
        for move in range(self.settings.moves):
            psnr, at, _ = visited[-1]
            promised = cost.in_place(stage.removable(at.pose))
            session.say(f"a move promises {promised - psnr:+.2f} dB")
            if promised - psnr <= self._repeatability_db:
                break
            if session.frames_left < self.settings.last_frames + 8:
                session.say("no frames are left for another move")
                break
            expected = stage.take_out(at)
            if expected is None:
                break
            session.register()
            at = refine_pose(session, expected, 4)
            visited.append((cost.psnr_db(at.pose), at, stage.position))
            session.say(f"stage move {move + 1}: efficiency {at.efficiency:.2f}")
        best = max(visited, key=lambda place: place[0])
        if best is not visited[-1]:
            session.say("back to the best place")
            stage.go(best[2])
            session.register()
            return refine_pose(session, best[1].pose, 2, quick=0)
        return visited[-1][1]


def _told(place: Mapping[str, float]) -> str:
    return ", ".join(f"{name} {value:.5g}" for name, value in place.items())


def _place(pose: Pose, smooth: SmoothField, mask_shape: tuple[int, int]) -> tuple[Pose, Float64Array]:
    """Add a smooth field to a pose; the pose's own distortion becomes part of the rest."""
    plain = pose.with_(cubic=0.0)
    rest = smooth.rest + pose.displacement(mask_shape) - plain.displacement(mask_shape)
    return plain.plus(smooth.change), rest


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class AlignmentProcedure(Procedure):
    """Find the scattering mask by spots, move it to its place, keep what is left."""

    settings: AlignmentSettings = field(default_factory=AlignmentSettings)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without phase SLM or mask, an endless search, files that exist or are wrong."""
        slm = require_slm(bench, "a mask is aligned by the spots of a phase SLM in their place")
        if (out := self.settings.out) is not None:
            for file in (out, out.with_suffix(".png")):
                require_new(file, overwrite=self.settings.overwrite)
        if self.settings.slm_calibration is not None:
            load_slm_correction(self.settings.slm_calibration)
        display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
        self.settings.require(display)
        moves, most = self.settings.moves, self.settings.most_frames(display)
        return Outlook(
            (
                f"Mask of {display.mask.shape[0]} x {display.mask.shape[1]} pixels, searched for within "
                f"±{self.settings.reach:g} of its pixels and ±{self.settings.depth_um:g} µm",
                f"{most} frames at most, {self.settings.search_pictures(display)} of them to search; "
                + (f"the stage moves {moves} times at most" if moves and bench.stage else "nothing moves"),
                kept_words(bench, most, self.settings.again, folder),
            )
        )

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Align, and save the alignment with its picture."""
        slm, settings = require_slm(bench), self.settings
        out = writable(bench, folder, settings.out, "alignment")
        correction = load_slm_correction(settings.slm_calibration) if settings.slm_calibration else None
        display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
        most = settings.most_frames(display)
        with KeptFrames(bench, folder, "align mask", settings) as kept:
            io = DisplayBench(
                bench,
                bench.config.display.slm_binning,
                correction,
                check=control.check,
                on_frame=lambda frames: listener.share(frames, most, at_most=True),
                kept=kept,
            )
            if settings.moves:
                home_if_needed(bench, listener)
            listener.step("aligning the mask")
            report = MaskAlignment(io, display, settings, listener).run()
        alignment = alignment_of(report, bench, display.mask.shape)
        bench.stop()
        doubted = bool(report.findings)
        out = named_by_worth(out, doubted=doubted, overwrite=settings.overwrite)
        figure = out.with_suffix(".png")
        save_alignment(out, alignment, _facts(report, bench))
        from instrument.display.hologram_files import (
            write_alignment_figure,  # matplotlib, only where it is drawn
        )

        write_alignment_figure(
            figure,
            report.pose.displacement(display.mask.shape),
            report.rest,
            display.mask.shape,
            report.efficiencies,
            "Mask alignment",
            simulated=alignment.simulated,
        )
        return Outcome(
            verdict=tuple(alignment_lines(report, simulated=alignment.simulated)),
            good=not doubted,
            runs=kept.paths,
            calibration=out,
            files=(figure,),
            result=report,
        )


def alignment_lines(report: AlignmentReport, *, simulated: bool) -> list[str]:
    """Return what was found and what it costs, in lines."""
    mark = " (SIMULATED)" if simulated else ""
    lines = [f"Quality: {words}" for words in report.findings]
    spots = f"spots at {100 * report.efficiency:.0f} % of the ideal"
    lines += [f"Aligned with {report.frames} frames{mark}: {spots}"]
    for name, value, error in zip(NAMES, report.pose.vector(), report.error, strict=True):
        if name != "cubic":  # part of the smooth rest
            lines.append(f"  {name:<12}{value:+10.4f} +- {error:.4f}")
    size = np.hypot(report.rest[..., 0], report.rest[..., 1])
    lines.append(f"  smooth rest {np.sqrt(np.mean(size**2)):.2f} mask pixels rms, {size.max():.2f} at most")
    lines.append(
        f"  what remains costs a hologram about {report.psnr_lost_db:.2f} dB"
        + (
            ""
            if np.isnan(report.repeatability_db)
            else f"; spots see two visits of a place {report.repeatability_db:.2f} dB apart"
        )
    )
    reversed_axes = [name for name, direction in report.directions.items() if direction < 0]
    if reversed_axes:
        lines.append(f"  these axes go against their names: {', '.join(reversed_axes)}")
    return lines


def alignment_of(report: AlignmentReport, bench: Bench, mask_shape: tuple[int, int]) -> Alignment:
    """Return what is kept of an alignment."""
    return Alignment(
        report.pose,
        dict(zip(NAMES, map(float, report.error), strict=True)),
        report.rest,
        report.efficiency,
        bench.stage.commanded_position() if bench.stage else {},
        mask_shape,
        bool(bench.simulated_kinds),
        psnr_lost_db=report.psnr_lost_db,
    )


def _facts(report: AlignmentReport, bench: Bench) -> dict[str, Any]:
    return {
        "bench": bench.label,
        "frames": report.frames,
        "found_at": asdict(report.found_at),
        "repeatability_db": None if np.isnan(report.repeatability_db) else report.repeatability_db,
        "axis_directions": report.directions,
        "camera_residual_px": report.camera.residual_px,
        "scatter": plain(report.scatter),
        "findings": list(report.findings),
        "log": report.log,
    }


ROUTINES = (
    Routine(
        name="mask",
        title="Mask alignment",
        help="Find the mask's pose by spots on the camera, move the stage, and store what is left as an "
        "alignment.",
        details="The camera must see the whole field of view. The search moves nothing. Then a small move "
        "and back tells which way the stage's axes go and how well it comes back (it is homed "
        "before); it takes out shift, distance, rotation and clear tilts until a move promises "
        "less than that. What stays is measured section by section. Give the file to hologram "
        "--alignment.",
        options=AlignmentSettings,
        procedure=AlignmentProcedure,
        needs=("slm",),
        tried_on="display",
        examples=(
            "diffuserbench align mask --bench display.toml",
            "diffuserbench align mask --reach 30 --depth-um 300 --moves 0",
        ),
        file=ALIGNMENT_FILE,
        command="align",
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
