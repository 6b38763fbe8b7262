"""How well the stage goes where it is told: play, repeatability, scale and lost steps, told by the PSF.

Around one place each axis goes to and fro by a reach: from below to the place, above it, back to the place
from above, below it. The pattern moves by ``-(x, y) d / z`` (Kuo 2020, Eq. 3.1) and its size goes with
``1 + d / z`` (Eq. 5.2), so that every picture tells where the source truly was, from the first one. Place
from below against place from above is the play; the same from one side, again and again, the repeatability; a
way up, the scale; the last return, lost steps.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy import ndimage

from calibration_routines.options import MM, Checked
from calibration_routines.planned import home_if_needed, outlook_of
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.psf.analysis import dark_model, late_hot_lines, light_of
from calibration_routines.psf.exposure import expose_source
from calibration_routines.psf.sampling import known, source_limits
from calibration_routines.psf.sweep_plan import DARK
from calibration_routines.purpose import CalibrationError, Purpose, completed
from calibration_routines.routine import Routine
from calibration_routines.scatter import Scatter, compare, growth, pooled, reduction
from instrument.bench.bench import Bench
from instrument.files.errors import BenchError, SettingsError
from instrument.files.record import RecordFormat, plain
from instrument.plan import OFF, SOURCE, Part, Plan, check
from instrument.plan.positions import StagePoints
from instrument.runs.acquire import abilities_of
from instrument.runs.results import STAGE_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.base.declare import RARE, option
from recon.camera.registration import moved
from recon.types import Geometry

Float = Float32Array

_AXES = ("x_um", "y_um", "z_um")
_TURN = ("up", "above", "down", "below")
"""Visits of one turn of an axis: the place from below, above it, the place from above, below it."""
_DISTANCES = 3.0  # of d, where the source is put: near enough for the size to tell the depth
_REACH_PX, _REACH_PART = 30.0, 0.05  # of the pattern's way, and of the axis' travel: the reach by itself
_PLAY_PART = 0.8  # of the reach: a play so large was not seen whole
_SCALE_ERROR = {"x_um": 0.02, "y_um": 0.02, "z_um": 0.06}
"""Beyond it the scale is called wrong. What the diffuser bends does not grow with ``1 + d / z``: along z a
right scale reads up to 3 % off."""
_NOTICED_PX = 0.2  # a play that moves the pattern by less is not called one
_SURE = 4.0  # standard errors


@dataclass(frozen=True, kw_only=True)
class StageCheck(Checked):
    """What is measured."""

    z_um: float | None = option(
        None,
        **MM,
        flags=("--z",),
        above=0,
        label="Distance",
        help="Of the place that the axes move about, from the diffuser; as near to that as the stage gets.",
        default_words="three times the sensor's distance",
    )
    reach_um: float | None = option(
        None,
        unit="um",
        above=0,
        help="How far each axis goes to both sides; more than its play.",
        default_words="a twentieth of travel, 30 pixels",
    )
    turns: int = option(4, least=2, help="Times that each axis goes to and fro.")
    average: int = option(2, least=1, label="Frames a place", help="Frames a place, averaged.")
    dark_frames: int = option(4, least=1, help="Dark frames, at the beginning and at the end.", group=RARE)


@dataclass(frozen=True, slots=True)
class AxisPlay:
    """One axis, in its unit, um."""

    name: str
    play_um: float
    """Way that the source stays behind when the direction turns."""
    play_error_um: float
    repeatability_um: float
    """Standard deviation of a place from below, again and again."""
    scale_error: float
    """True way over the way that the stage says, less one, if d and z are what the bench says."""
    slip_um: float
    """How far the last return to the place from below is off the first."""


@dataclass(frozen=True, slots=True)
class StagePlay:
    """What was found of a stage."""

    axes: tuple[AxisPlay, ...]
    scatter: Scatter
    """Of the averaged frames."""
    z_um: float
    reach_um: float
    noticed_um: float
    """What moves the pattern by enough to be called a play."""
    configured: Mapping[str, float] = field(default_factory=dict)
    """Play that bench.toml has."""
    bench: str = ""
    simulated: bool = False
    late_hot: int = 0
    """Pixels that turned hot meanwhile; they were replaced like the others."""

    @property
    def play(self) -> dict[str, float]:
        """Play of the axes that have any, for ``[stage]`` of bench.toml."""
        return {a.name: float(f"{a.play_um:.3g}") for a in self.axes if a.play_um > _SURE * a.play_error_um}

    @property
    def findings(self) -> tuple[str, ...]:
        """What is wrong, in words."""
        found = [*self.scatter.findings("place")]
        for axis in self.axes:
            name, kept = axis.name.split("_")[0], self.configured.get(axis.name, 0.0)
            if axis.play_um > 1.5 * max(kept, 2 * axis.repeatability_um, self.noticed_um):
                found.append(
                    f"{name} has a play of {axis.play_um:.4g} um and bench.toml says {kept:g}: put the line "
                    "below into its [stage] table, and sweeps come to every place from one side."
                    if axis.name in self.play
                    else f"{name} stayed behind by {axis.play_um:.3g} +- {axis.play_error_um:.2g} um, too "
                    "unsteadily for a play: look for slips and a loose source, and measure again."
                )
            if abs(axis.slip_um) > _SURE * max(axis.repeatability_um, axis.play_error_um) + 2.0:
                found.append(
                    f"{name} came back {abs(axis.slip_um):.4g} um off its first place: it loses steps, or "
                    "the source slipped. Lower its speed, look at the coupling, clamp the source."
                )
            if abs(axis.scale_error) > _SCALE_ERROR[axis.name]:
                found.append(
                    f"{name} goes {abs(axis.scale_error):.1%} too "
                    f"{'far' if axis.scale_error > 0 else 'little'} for d and z as "
                    "configured: check its steps per millimetre, d, and the source's distance."
                )
        return tuple(found)


@dataclass(frozen=True, slots=True)
class StageRecord:
    """What the stage is judged with besides the frames."""

    z_um: float
    reach_um: float
    turns: int
    axes: tuple[str, ...]
    place: dict[str, float]
    """Where the stage was, by axis name."""
    geometry: Geometry
    configured: dict[str, float]
    bench: str
    simulated: bool


STAGE = Purpose(
    StageRecord,
    "stage_check.json",
    STAGE_FILE,
    RecordFormat("diffuserbench stage check", "run of calibrate stage", restore="The frames beside it stay."),
)
_RESULT = RecordFormat("diffuserbench stage", "stage's play")


def planned(bench: Bench, asked: StageCheck) -> StageRecord:
    """Return where the axes will move; raises BenchError, SettingsError where they cannot."""
    if bench.stage is None:
        raise BenchError(f"{bench.config.label} has no [stage] to measure.")
    pitch_um, d_mm = known(
        bench.geometry, "pixel_pitch_um", "diffuser_distance_mm", what="How far the source moved follows"
    )
    limits = source_limits(bench)
    axes = tuple(name for name in _AXES if name in limits)
    low, high = limits.get("z_um", (bench.source_position_um[2],) * 2)
    z_um = asked.z_um or float(np.clip(_DISTANCES * 1e3 * d_mm, low + 0.1 * (high - low), high))
    travels = [limits[name][1] - limits[name][0] for name in axes]
    auto_um = min(_REACH_PART * min(travels), _REACH_PX * pitch_um * z_um / (1e3 * d_mm))
    reach_um = asked.reach_um or float(f"{auto_um:.2g}")
    wrong = []
    for name, at in zip(_AXES, (0.0, 0.0, z_um), strict=True):
        if name in limits and not limits[name][0] <= at - reach_um <= at + reach_um <= limits[name][1]:
            ends = " to ".join(f"{end / 1e3:g}" for end in limits[name])
            words = (
                f"{name[0]} would go {at / 1e3:g} mm -+ {reach_um:g} um, beyond the stage's {ends} mm: "
                "choose another place or a smaller reach"
            )
            wrong.append(("z_um" if name == "z_um" else "reach_um", words))
    if wrong:
        raise SettingsError(wrong)
    place = bench.source_mount.target(
        *(at if name in axes else None for name, at in zip(_AXES, (0.0, 0.0, z_um), strict=True))
    )
    return StageRecord(
        z_um,
        reach_um,
        asked.turns,
        axes,
        place,
        bench.geometry,
        dict(bench.play),
        bench.label,
        bool(bench.simulated_kinds),
    )


def stage_plan(record: StageRecord, asked: StageCheck, exposure_ms: float) -> Plan:
    """Return the plan: dark frames; of each axis its turns; a last return of it from below; dark frames.

    Those at the end tell which pixels turned hot meanwhile.
    """

    def visit(label: str, axes: tuple[str, ...], off_um: float) -> Part:
        places = {name: at + (off_um if name in axes else 0.0) for name, at in record.place.items()}
        return Part(
            label=label,
            positions=StagePoints(points=(places,)),
            light=(SOURCE,),
            exposures_ms=(exposure_ms,),
            repeats=asked.average,
        )

    reach = record.reach_um
    dark = Part(label=DARK, light=(OFF,), exposures_ms=(exposure_ms,), repeats=asked.dark_frames)
    parts = [dark]
    parts.append(visit("start", record.axes, -reach))
    for name in record.axes:
        parts.append(visit("start", (name,), -reach))
        for _ in range(record.turns):
            for label, off_um in zip(_TURN, (0.0, reach, 0.0, -reach), strict=True):
                parts.append(visit(f"{name} {label}", (name,), off_um))
        parts.append(visit(f"{name} last", (), 0.0))
    parts.append(dark)
    return Plan(label="stage check", parts=tuple(parts))


def _come_again(run: Run, bench: Bench, first: int) -> None:
    """Go where the stage was before a step, on the way that it came: homed, its axes lie otherwise."""
    assert run.plan is not None
    assert bench.stage is not None
    places = [dict(step.stage) for step in run.plan.steps() if step.index < first and step.stage]
    ways = [place for number, place in enumerate(places) if number == 0 or place != places[number - 1]]
    for place in (*ways[:1], *ways[-2:]):  # all axes from below; then this one as it went
        bench.stage.move_to(place)


def _finish(run: Run, _bench: Bench | None, _control: RunControl, listener: Listener) -> Outcome:
    """Judge the stage by a complete run; CalibrationError when the pattern or a play is not seen whole."""
    listener.step("analysing")
    record = STAGE.read(run.path)
    with STAGE.analysed(run.path):
        found = judged(run, record)
    file = STAGE.place(run.path, doubted=bool(found.scatter.findings()))
    _RESULT.write(file, plain(found) | {"play": found.play, "findings": list(found.findings)})
    return Outcome(
        verdict=tuple(stage_lines(found)),
        good=not found.findings,
        runs=(run.path,),
        files=(file,),
        result=found,
    )


def judged(run: Run, record: StageRecord) -> StagePlay:
    """Return what the frames of a run tell of the stage."""
    dark = dark_model(run)
    parts: dict[int, list[int]] = {}
    labels: dict[int, str] = {}
    for step in run.plan.steps() if run.plan is not None else ():
        if step.label != DARK and step.label != "start":
            parts.setdefault(step.part, []).append(step.index)
            labels[step.part] = step.label
    steady = {part: light_of(run, indices, dark) for part, indices in parts.items()}
    axes = []
    for name in record.axes:
        visits: dict[str, list[Float]] = {}
        for part, one in steady.items():
            axis, what = labels[part].split()
            if axis == name:
                visits.setdefault(what, []).append(one.mean)
        axes.append(_axis(name, visits, record))
    scatter = pooled([one.scatter for one in steady.values()])
    return StagePlay(
        tuple(axes),
        scatter,
        record.z_um,
        record.reach_um,
        _NOTICED_PX * _um_per_px(record),
        record.configured,
        record.bench,
        record.simulated,
        dark.late_hot,
    )


def _um_per_px(record: StageRecord) -> float:
    """Return how far a source goes sideways while its pattern moves by a pixel."""
    pitch_um, d_mm = known(
        record.geometry, "pixel_pitch_um", "diffuser_distance_mm", what="How far the source moved follows"
    )
    return float(pitch_um * record.z_um / (1e3 * d_mm))


def _axis(name: str, visits: Mapping[str, list[Float]], record: StageRecord) -> AxisPlay:
    reference = visits["up"][0]
    um = {what: np.array([_moved_um(i, reference, name, record) for i in v]) for what, v in visits.items()}
    if not all(np.isfinite(values).all() for values in um.values()):
        raise CalibrationError(
            f"The pattern was not found again while {name[0]} moved: choose a smaller --reach-um, or a place "
            "where the whole pattern falls onto the sensor (--z)."
        )
    up, above, down, below = (um[what] for what in _TURN)
    play = down - up
    if np.abs(np.median(play)) > _PLAY_PART * record.reach_um:
        raise CalibrationError(
            f"{name[0]} stays {abs(np.median(play)):.4g} um behind, nearly all of its reach of "
            f"{record.reach_um:g} um: choose a larger --reach-um."
        )
    scale = np.median([*(above - up), *(down - below)]) / record.reach_um - 1
    # From one turn to the next, in the median: steps lost once do not make a stage imprecise.
    repeatability = float(1.4826 * np.median(np.abs(np.diff([*up, *um["last"]]))) / np.sqrt(2))
    return AxisPlay(
        name,
        float(np.median(play)),
        float(np.std(play, ddof=1) / np.sqrt(len(play))),
        repeatability,
        float(scale),
        float(um["last"][-1] - up[0]),
    )


def _moved_um(image: Float, reference: Float, name: str, record: StageRecord) -> float:
    """Return how far the source went along an axis from where it was in the reference, by the pattern."""
    change = compare(image, reference)
    if name != "z_um":
        return -(change.columns if name == "x_um" else change.rows) * _um_per_px(record)
    (d_mm,) = known(record.geometry, "diffuser_distance_mm", what="How far the source moved follows")
    d_um, z_um = 1e3 * d_mm, record.z_um
    if not np.isfinite(change.shift_px):
        return float("nan")
    factor, larger = reduction(reference), 0.0
    seen, other = block_mean(image, factor), block_mean(reference, factor)
    back = moved(seen, -change.rows / factor, -change.columns / factor)
    for _ in range(3):  # by Newton: the size is linear only while it changes little
        larger = (1 + larger) * (1 + growth(_resized(back, 1 / (1 + larger)), other)) - 1
    return float(-larger * z_um * (z_um + d_um) / d_um / (1 + larger * (z_um + d_um) / d_um))


def _resized(image: Float, factor: float) -> Float:
    """Return an image made larger by a factor about its centre."""
    middle = (np.array(image.shape) - 1) / 2
    resized = ndimage.affine_transform(image, [1 / factor] * 2, middle * (1 - 1 / factor), order=3)
    return np.asarray(resized, np.float32)


def stage_lines(found: StagePlay) -> list[str]:
    """Return what was found of a stage, in lines; the last one is for bench.toml."""
    lines = [f"Quality: {words}" for words in found.findings]
    for axis in found.axes:
        lines.append(
            f"{axis.name[0]}: play {axis.play_um:.3g} +- {axis.play_error_um:.2g} um, comes back within "
            f"{axis.repeatability_um:.2g} um, scale {axis.scale_error:+.2%} of d/z, last return "
            f"{axis.slip_um:+.2g} um"
        )
    lines += late_hot_lines(found.late_hot, "check")
    listed = ", ".join(f"{name} = {play:g}" for name, play in found.play.items())
    lines.append(f"For [stage] of bench.toml: play = {{ {listed} }}" if listed else "No axis has play.")
    return lines


# Procedure -------------------------------------------------------------------------------------------
_COMPUTES = {"moving to and fro": (4.4, 2.2), "analysing": (33.7, 0.9)}
"""Transforms for each megapixel of a frame, compared and all (docs/benchmarks/time-told.md)."""


@dataclass(frozen=True, slots=True)
class StageProcedure(Procedure):
    """Measure play, repeatability, scale and lost steps of the stage's axes."""

    asked: StageCheck

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Hold every place against the stage's limits."""
        folder = folder or bench.config.data_folder
        record = planned(bench, self.asked)
        plan = stage_plan(record, self.asked, bench.camera.exposure_ms)
        check(plan, replace(abilities_of(bench, folder), stage_homed=True))
        names = ", ".join(name[0] for name in record.axes)
        words = (
            f"{names} each go {record.reach_um:g} um to both sides of z = {record.z_um / 1e3:.4g} mm, "
            f"{self.asked.turns} times"
        )
        return outlook_of(bench, plan, folder, [words], computes=_COMPUTES)

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Home, move to and fro, and save what was found in the run's folder."""
        record = planned(bench, self.asked)
        home_if_needed(bench, listener)
        listener.step("finding the source's exposure")
        assert bench.stage is not None
        bench.stage.move_to(record.place)
        exposure_ms = expose_source(bench, target=0.6).exposure_ms
        bench.source_off()
        control.check()
        listener.step("moving to and fro")
        plan = stage_plan(record, self.asked, exposure_ms)
        runner = STAGE.prepare(bench, plan, folder, record, control, listener)
        return _finish(completed(runner.execute()), bench, control, listener)


ROUTINES = (
    Routine(
        name="stage",
        title="Stage",
        help="Move each axis of the stage to and fro and measure its play, repeatability, scale and lost "
        "steps by the PSF.",
        details="Ends with the line for [stage] of bench.toml; with it sweeps come to every place from one "
        "side.",
        options=StageCheck,
        procedure=StageProcedure,
        needs=("stage",),
        purpose=STAGE,
        finish=_finish,
        restore=_come_again,
        examples=("diffuserbench calibrate stage --dry-run", "diffuserbench calibrate stage --reach-um 500"),
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
