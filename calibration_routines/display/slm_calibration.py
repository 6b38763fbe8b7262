"""Measure an SLM on the holographic bench: look-up table by interference, flatness by spots."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display.display_io import DisplayBench, bring_mask, require_slm, writable
from calibration_routines.display.kept_frames import KeptFrames, SeenAgain, kept_words
from calibration_routines.display.spot_camera import SpotCamera
from calibration_routines.procedure import (
    CalibrationError,
    Checked,
    Listener,
    Outcome,
    Outlook,
    Procedure,
    Routine,
)
from calibration_routines.scatter import NO_CHANGE, STEADY, Scatter, compare, pooled, scatter_of
from instrument.bench.bench import Bench
from instrument.display.hologram import bench_display, load_alignment
from instrument.files.atomic import require_new
from instrument.files.errors import BenchError
from instrument.files.record import plain
from instrument.files.slm_image import SlmCorrection
from instrument.runs.run_control import RunControl
from recon.base.declare import option
from recon.errors import InputError
from recon.holography import Display
from recon.holography.pose import Pose
from recon.holography.slm_response import MODES, flatness_jacobian, mode, phases_from_frames

Array = npt.NDArray[Any]
SLM_FILE = "slm-calibration.json"
"""Where the command line writes it."""
MAX_PHASE_ERROR_RAD = 0.0022
"""Standard deviation of a phase beyond which no table is made. What flickers with the phase's own cosine and
sine bends the whole table, unseen: two independent parts of this size, the worst level off by twice their
root sum of squares, beyond 0.02 rad in three tables of 100,000 at the limit (docs/decisions/0234)."""
MOST_SERIES = 7
"""Times that all pictures are taken where their mean over so many is steady enough and one series is not."""
_REFERENCE_EVERY = 8  # levels between two pictures of level 0
_FLATNESS_FRAMES = 22
"""Of a flatness measurement, at most."""


@dataclass(frozen=True, slots=True)
class SlmCalibration:
    """What was measured."""

    correction: SlmCorrection
    levels: npt.NDArray[np.int64]
    """(n,): grey levels measured."""
    phases_rad: npt.NDArray[np.float64]
    """(n,): their phases."""
    flatness_rms_rad: float | None
    """Of the flatness error found; None when it was not measured."""
    frames: int
    phase_error_rad: float = 0.0
    """Standard deviation of a phase of the table, by how far the pictures lie off interference."""
    steadiness: Scatter = STEADY
    """Of the picture of level 0, taken again and again in between."""


def measure_look_up_table(
    io: DisplayBench,
    *,
    n_levels: int = 33,
    seed: int = 0,
    on_more: Callable[[int, float], object] | None = None,
) -> SlmCalibration:
    """Let half of the SLM's pixels interfere with the other half at one level after the other.

    Needs no alignment and no model: see :func:`recon.holography.slm_response.phases_from_frames`. Level 0 is
    shown again after every few levels: a slow change of brightness is taken out where the pictures then lie
    better on one ellipse. Where they flicker too much for a table, and not more than the mean over a few
    series makes up for, more series are taken; ``on_more`` gets how many in all, and the error so far.

    Raises InputError when the pictures do not change as interference does; CalibrationError when they lie so
    far off it that the table would be wrong, with what flickers or shakes.
    """
    levels = np.unique(np.linspace(0, 255, n_levels).round().astype(int))
    height, width = io.slm.shape
    chosen = np.random.default_rng(seed).random((height // io.binning, width // io.binning)) < 0.5
    varied = np.repeat(np.repeat(chosen, io.binning, axis=0), io.binning, axis=1)
    exposure_ms = _exposure_ms(io)
    order: list[int] = []
    reference: list[bool] = []
    before = []
    for number, level in enumerate([*levels, 0]):
        if number % _REFERENCE_EVERY == 0 or number == len(levels):
            order.append(0)
            reference.append(True)
            before.append(number - 0.5)
        if number < len(levels):
            order.append(int(level))
            reference.append(False)
    images = [np.where(varied, level, 0).astype(np.uint8) for level in order]
    phases, error, scatter = steady_phases(
        lambda: _taken(io, images, reference, exposure_ms), np.array(before), on_more
    )
    if error > MAX_PHASE_ERROR_RAD:
        words = scatter.causes() or (
            "light, mask or camera are not steady, or the SLM flickers: look for saturation, loose mounts.",
        )
        raise CalibrationError(
            f"The SLM's table would be wrong by {error:.4f} rad (one standard deviation; at most "
            f"{MAX_PHASE_ERROR_RAD:g} is kept): {' '.join(words)} More grey levels (--levels) lessen it, too."
        )
    from scipy.interpolate import PchipInterpolator

    table = np.asarray(PchipInterpolator(levels, phases)(np.arange(256)), np.float64)
    return SlmCalibration(SlmCorrection(table), levels, phases, None, io.frames, error, scatter)


def _taken(
    io: DisplayBench, images: Sequence[npt.NDArray[np.uint8]], reference: Sequence[bool], exposure_ms: float
) -> tuple[Array, Array]:
    """Take a series; returns the levels' pictures, and those of level 0 in between."""
    pictures, references = [], []
    for picture, again in zip(io.photographs(images, exposure_ms), reference, strict=True):
        if again:  # whole: a picture of every other pixel does not tell how far it moved
            references.append(picture)
        else:  # every fourth pixel has more than enough light
            pictures.append(picture[::2, ::2])
    return np.array(pictures), np.array(references, np.float32)


def steady_phases(
    take: Callable[[], tuple[Array, Array]],
    before: Array,
    on_more: Callable[[int, float], object] | None = None,
) -> tuple[Array, float, Scatter]:
    """Return the levels' phases by as many series as needed, their error, and how light and place scatter.

    Parameters
    ----------
    take : callable
        Takes a series: the levels' pictures, (n_levels, ...), and of level 0, (n_references, height, width).
    before : ndarray, (n_references,)
        After which level each of these comes.
    on_more : callable, optional
        Gets how many series are needed in all, and the error so far, radians.
    """
    series = _Series(before)
    phases, error = series.add(*take())
    while MAX_PHASE_ERROR_RAD < error <= MAX_PHASE_ERROR_RAD * float(np.sqrt(MOST_SERIES / series.count)):
        if on_more is not None:
            on_more(int(np.ceil(series.count * (error / MAX_PHASE_ERROR_RAD) ** 2)), error)
        phases, error = series.add(*take())
    return phases, error, series.scatter


class _Series:
    """Series of the same pictures, averaged; ``before`` tells after which level each reference came."""

    def __init__(self, before: Array) -> None:
        self._before = before
        self._frames: Array = np.zeros(0)
        self._references: Array = np.zeros(0)
        self._scatters: list[Scatter] = []
        self._errors: list[float] = []

    @property
    def count(self) -> int:
        """Series so far."""
        return len(self._scatters)

    @property
    def scatter(self) -> Scatter:
        """Of the pictures of level 0; a level has one picture a series."""
        return replace(pooled(self._scatters), frames=self.count)

    def add(self, frames: Array, references: Array) -> tuple[Array, float]:
        """Average another series, (n_levels, ...) and (n_references, height, width), with those before it.

        Returns the levels' phases and their error, radians: at least what the series' own errors leave of
        themselves in a mean, as the mean's looks small by chance.
        """
        self._scatters.append(scatter_of(references)[0])
        self._errors.append(_phases(frames, references, self._before, self._scatters[-1])[1])
        many = self.count
        self._frames = frames if many == 1 else self._frames + (frames - self._frames) / many
        if many == 1:
            self._references = references
        else:
            self._references = (self._references + (references - self._references) / many).astype(np.float32)
        phases, error = _phases(self._frames, self._references, self._before, self.scatter)
        return phases, max(error, float(np.linalg.norm(self._errors)) / many)


def _phases(frames: Array, references: Array, before: Array, scatter: Scatter) -> tuple[Array, float]:
    """Return the levels' phases and their error.

    The pictures as they are, and divided by the brightness between two of the references: what is known
    better counts. Where references flicker they bend the table by it, as slowly as phases go.
    """
    changes = [NO_CHANGE, *(compare(picture, references[0]) for picture in references[1:])]
    levels = np.array([change.brightness for change in changes])
    tries = [(frames, 0.0)]
    if np.isfinite(levels).all() and (levels > 0).all():
        at = np.interp(np.arange(len(frames)), before, levels)
        tries.append((frames / at[:, None, None], _flicker(levels, before) * float(np.sqrt(2 / len(levels)))))
    found = []
    for pictures, added in tries:
        try:
            phases, error = phases_from_frames(pictures)
            found.append((phases, float(np.hypot(error, added))))
        except InputError:
            if words := scatter.causes():
                raise CalibrationError(f"The SLM's table cannot be measured: {' '.join(words)}") from None
            raise
    return min(found, key=lambda one: one[1])


def _flicker(levels: npt.NDArray[np.float64], at: npt.NDArray[np.float64]) -> float:
    """Return the relative standard deviation of brightness beyond what changes evenly; 0 of two visits."""
    share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
    beside = levels[1:-1] - (1 - share) * levels[:-2] - share * levels[2:]
    if not len(beside):
        return 0.0
    return float(np.sqrt(np.mean(beside**2 / (1 + share**2 + (1 - share) ** 2))) / levels.mean())


def measure_flatness(
    io: DisplayBench,
    display: Display,
    pose: Pose,
    table: SlmCalibration,
    *,
    rest: Array | None = None,
    pictures: int = 10,
) -> SlmCalibration:
    """Find the SLM's smooth phase error by spots that take off more and less of it, a pair a mode.

    Parameters
    ----------
    pose : Pose
        Of the mask, from an alignment; the stage must be where that left it.
    table : SlmCalibration
        With the look-up table, which is used from here on.
    rest : ndarray, (rows, columns, 2), optional
        Smooth displacement beyond the pose's, from the alignment.
    pictures : int
        In the last of four steps.

    Raises BenchError when the spots are too weak: the mask is not aligned.
    """
    io.correction = table.correction
    eye = SpotCamera(io, display)
    eye.maker.rest = rest
    eye.register()
    step = 0.8
    jacobian = flatness_jacobian(step)
    modes = [mode(n, display.slm_shape) for n in range(len(MODES))]
    found = np.zeros(len(MODES))
    for count in (3, 3, 3, pictures):
        total = np.zeros(2 * len(MODES) + 1)
        for _ in range(count):
            trials = [found + s * step * np.eye(len(MODES))[n] for n in range(len(MODES)) for s in (1, -1)]
            phases = [np.tensordot(c, modes, 1) for c in (*trials, found)]
            brightness, _ = eye.measure_with_phases(pose, phases)
            total += np.sqrt(np.maximum(brightness, 0))
        if total[-1] ** 2 / count**2 < 0.03 * eye.ideal(len(total)):
            raise BenchError("Flatness cannot be measured: the spots are too weak. Align the mask first.")
        plus, minus = total[0:-1:2], total[1:-1:2]
        change = np.linalg.solve(jacobian, (plus - minus) / np.maximum(plus + minus, 1e-12))
        found = found + np.clip(change, -1.0, 1.0)
    coarse = (36, 64)
    flatness = np.tensordot(found, [mode(n, coarse) for n in range(len(MODES))], 1)
    correction = SlmCorrection(table.correction.phase_of_level_rad, flatness)
    io.correction = correction
    rms_rad = float(np.sqrt((found**2).sum()))
    return replace(table, correction=correction, flatness_rms_rad=rms_rad, frames=io.frames)


def _exposure_ms(io: DisplayBench) -> float:
    """Return an exposure at which the mean is a twelfth of full scale."""
    camera = io.bench.camera
    io.show_levels(np.zeros(io.slm.shape, np.uint8))
    first = io.photograph(camera.exposure_ms)
    bright = first[first > np.median(first) / 4]
    lit = float(bright.mean()) if bright.size else 0.0
    if lit <= 0:
        raise BenchError(f"{camera.name}: it is dark. Check that the laser shines and the exposure.")
    return io.exposure_ms(lit)


# Procedure -------------------------------------------------------------------------------------------
@dataclass(frozen=True, kw_only=True)
class SlmProcedure(SeenAgain, Checked, Procedure):
    """Measure the SLM's phase against its grey levels and, with an alignment, its flatness."""

    levels: int = option(33, least=8, most=256, label="Grey levels", help="Grey levels to measure.")
    alignment: Path | None = option(
        None,
        metavar="FILE",
        help="Of the mask, from align mask: flatness is measured too.",
        default_words="none",
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FILE",
        label="File",
        help="Where the calibration goes (.json).",
        default_words=f"{SLM_FILE}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Overwrite a file that exists.")

    @property
    def series_frames(self) -> int:
        """Frames of a series of levels."""
        return self.levels + 1 + -(-self.levels // _REFERENCE_EVERY)

    @property
    def frames(self) -> int:
        """Frames it takes at most, of one series."""
        return self.series_frames + 2 + (_FLATNESS_FRAMES if self.alignment is not None else 0)

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without phase SLM, an alignment that cannot be read, a file that exists."""
        require_slm(bench, "they have no phase that their levels could be measured by")
        if self.out is not None:
            require_new(self.out, overwrite=self.overwrite)
        if self.alignment is not None:
            load_alignment(self.alignment)
        most = self.frames + (MOST_SERIES - 1) * self.series_frames
        words = (
            f"{self.levels} grey levels, {self.frames} frames at most; where the light flickers the levels "
            f"are taken up to {MOST_SERIES} times, {most} frames"
        )
        return Outlook((words, kept_words(bench, most, self.again)))

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Measure, and save what ``align mask`` and ``show`` take."""
        slm, out = require_slm(bench), writable(bench, folder, self.out, "slm calibration")
        place = load_alignment(self.alignment) if self.alignment is not None else None
        total = self.frames

        def more(series: int, error_rad: float) -> None:
            nonlocal total
            total = self.frames + (series - 1) * self.series_frames
            listener.said(
                f"The pictures are not steady: a level's phase is known to {error_rad:.4f} rad. All levels "
                f"are taken {series} times in all, for their mean."
            )

        with KeptFrames(bench, folder, "calibrate slm", self) as kept:
            io = DisplayBench(
                bench,
                bench.config.display.slm_binning,
                check=control.check,
                on_frame=lambda frames: listener.share(frames, total),
                kept=kept,
            )
            listener.step("measuring the look-up table")
            found = measure_look_up_table(io, n_levels=self.levels, on_more=more)
            if place is not None:
                listener.step("measuring flatness")
                bring_mask(bench, place.stage_position)
                display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
                found = measure_flatness(io, display, place.pose, found, rest=place.rest)
            bench.stop()
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds), "frames": found.frames}
        facts |= {"phase_error_rad": found.phase_error_rad, "scatter": plain(found.steadiness)}
        found.correction.save(out, facts)
        return Outcome(
            verdict=tuple(slm_lines(found, simulated=bool(bench.simulated_kinds))),
            good=True,
            runs=kept.paths,
            files=(out,),
            result=found,
        )


def slm_lines(found: SlmCalibration, *, simulated: bool) -> list[str]:
    """Return what was found out about an SLM, in lines."""
    ideal = np.arange(256) * (2 * np.pi / 256)
    worst = float(np.abs(found.correction.phase_of_level_rad - ideal).max())
    mark = " (SIMULATED)" if simulated else ""
    lines = [
        f"{found.frames} frames{mark}: {found.phases_rad[-1]:.3f} rad at level {found.levels[-1]},",
        f"  up to {worst:.3f} rad from an ideal SLM's 256 levels a turn; a level is known to "
        f"{found.phase_error_rad:.4f} rad",
    ]
    if (series := found.steadiness.frames) > 1:
        lines.append(f"  as the light flickers: every level was taken {series} times, for its mean")
    if found.flatness_rms_rad is not None:
        lines.append(f"  flatness error {found.flatness_rms_rad:.3f} rad rms")
    return lines


ROUTINES = (
    Routine(
        name="slm",
        title="SLM look-up table",
        help="Measure the SLM's phase against its grey levels, and with an alignment its flatness, by the "
        "camera.",
        details="Half of the pixels interfere with the other half; neither mask nor optics need to be "
        "known for that. Give the file to align mask and show (--slm-calibration).",
        options=SlmProcedure,
        procedure=lambda options: options,
        needs=("slm",),
        tried_on="display",
        examples=(
            "diffuserbench calibrate slm --bench display.toml",
            "diffuserbench calibrate slm --bench display.toml --alignment alignment.json",
        ),
        file=SLM_FILE,
    ),
)
"""Row of :data:`calibration_routines.procedure.routines`."""
