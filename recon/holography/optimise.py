"""Find the SLM pattern: L-BFGS on the phase, projected gradient, one-step back-propagation.

All start from a seed or a given pattern and give the same result for the same seed, whatever the number of
threads. The amplitude of a complex SLM lies between 0 and 1 all the way.
"""

from __future__ import annotations

import enum
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array
from recon.base.declare import with_overrides
from recon.base.namespace import to_host
from recon.errors import InputError
from recon.holography.model import HologramModel
from recon.holography.options import HologramOptions
from recon.holography.variables import FIRST_ORDER, Bounded, Mirrors, Phase, Point, Variable, coded, decoded

_OF_THE_MODEL = (
    *("loss", "centre", "radius", "periphery", "weights", "grid"),
    *("frames", "complex_slm", "mirrors", "light", "device"),
)


class HologramStop(enum.StrEnum):
    """Why the computation of a hologram ended."""

    QUALITY = "the requested PSNR is reached"
    CONVERGED = "the loss no longer falls"
    TIME = "the time budget is spent"
    ITERATIONS = "the number of iterations is reached"
    CANCELLED = "cancelled"
    ONE_STEP = "one-step method"
    EVEN = "the spots are as bright as asked for"


@dataclass(frozen=True, slots=True)
class HologramRecord:
    """What one iteration reached; iteration 0 is the start."""

    iteration: int
    seconds: float
    """Wall time since the start, without callbacks."""
    loss: float
    psnr_db: float
    """Of the low-passed image over the whole field, as the model sees it."""


@dataclass(frozen=True, slots=True)
class Hologram:
    """SLM patterns and how they were found.

    Attributes
    ----------
    slm : ndarray, complex64, (n_frames, height, width)
        Field at the SLM; of modulus 1 for a phase SLM, at most 1 for a complex one, 0 or 1 of mirrors.
    history : tuple of HologramRecord
    stop_reason : HologramStop
    seconds : float
    """

    slm: npt.NDArray[np.complex64]
    history: tuple[HologramRecord, ...]
    stop_reason: HologramStop
    seconds: float

    @property
    def phase_rad(self) -> Float32Array:
        """Phase in 0 to 2 pi, float32 (n_frames, height, width)."""
        return np.mod(np.angle(self.slm), 2 * np.pi).astype(np.float32)


Callback = Callable[[HologramRecord, Array], object]


def compute_hologram(
    model: HologramModel,
    *,
    initial: Array | None = None,
    callback: Callback | None = None,
    cancel: threading.Event | None = None,
    **overrides: Any,
) -> Hologram:
    """Compute SLM patterns for a model's targets, as its options say.

    Parameters
    ----------
    model : HologramModel
    initial : ndarray, complex, (n_frames, height, width), optional
        Warm start, e.g. the last video frame's ``slm``; by default a random phase.
    callback : callable, optional
        ``callback(record, slm)`` after each iteration; its time is not counted.
    cancel : threading.Event, optional
        Set it from any thread, or from the callback, to end after the iteration in progress.
    **overrides
        Single options of the search.

    Raises InputError for options that contradict each other, and for an override of what made the model.
    """
    if made := [name for name in _OF_THE_MODEL if name in overrides]:
        raise InputError(f"{', '.join(made)}: this is the model's; make another HologramModel.")
    options = with_overrides(model.options, overrides)
    method, complex_slm = options.method, options.complex_slm
    shape = (model.frames, *model.display.slm_shape)
    if initial is not None and initial.shape != shape:
        raise InputError(f"The start must be {shape}, not {initial.shape}.")
    if options.mirrors is not None and method != "lbfgs":
        raise InputError("Mirrors need the method 'lbfgs'.")
    if options.phase_levels is not None and (complex_slm or method != "lbfgs"):
        raise InputError("Phase levels are of a phase SLM and need the method 'lbfgs'.")
    if method == "nesterov" and model.wraps:
        raise InputError("What was learned of the display jumps where phases wrap: use the method 'lbfgs'.")
    if method == "one-step":
        if complex_slm or initial is not None:
            raise InputError("The one-step method takes no start and has no form for a complex SLM.")
        return one_step(model, seed=options.seed)
    watch = _Watch(options, callback, cancel)
    if options.mirrors is not None:
        return _on_mirrors(model, initial, options, watch)
    if options.phase_levels is not None:
        phase = Phase(model)
        start = model.xp.asarray(phase.pack(_start(initial, model, options)))
        return _on_levels(phase, start, options.phase_levels, watch)
    search: _Lbfgs | _Nesterov
    if method == "lbfgs":
        variable = Bounded(model) if complex_slm else Phase(model)
        search = _Lbfgs(variable, model.xp.asarray(variable.pack(_start(initial, model, options))))
    else:
        search = _Nesterov(model, _start(initial, model, options), complex_slm)
    if isinstance(search, _Lbfgs) and isinstance(variable, Phase) and model.wraps:
        return _in_turns(variable, search, watch)
    history, reason = watch.run(search, options.iterations, options.psnr_db)
    return Hologram(search.slm.astype(np.complex64), history, reason, history[-1].seconds)


def _start(initial: Array | None, model: HologramModel, options: HologramOptions) -> Array:
    if initial is not None:
        return _within(initial) if options.complex_slm else _unit(initial)
    shape = (model.frames, *model.display.slm_shape)
    # Near, what is smooth leaves no speckle to take out and sends less into higher orders: 0.7 to 3 dB.
    widest = 0.5 * np.pi if model.display.near else 2 * np.pi
    phases = np.random.default_rng(options.seed).uniform(0, widest, shape).astype(np.float32)
    start: Array = np.exp(1j * phases)
    start *= np.float32(np.sqrt(options.share))
    return start


def one_step(model: HologramModel, *, seed: int = 0) -> Hologram:
    """Back-propagate the target with a random phase and keep the SLM phase (Kuo 2020, Eqs. 7.11 to 7.13)."""
    began = time.perf_counter()
    rng = np.random.default_rng(seed)
    slm = np.zeros((model.frames, *model.display.slm_shape), model.dtype)
    for frame in range(model.frames):
        for plane, target in enumerate(model.targets):
            amplitude = np.sqrt(_sample(target.scaled(model.display)[0], model.band.shape))
            phase = rng.uniform(0, 2 * np.pi, model.band.shape)
            slm[frame] += model.back_propagate((amplitude * np.exp(1j * phase)).astype(model.dtype), plane)
    slm = _unit(slm)
    seconds = time.perf_counter() - began
    found = model.evaluate(slm)
    record = HologramRecord(0, seconds, found.loss, found.seen_psnr_db)
    return Hologram(slm.astype(np.complex64), (record,), HologramStop.ONE_STEP, seconds)


def _unit(slm: Array) -> Array:
    return np.exp(1j * np.angle(slm)).astype(slm.dtype)


def _within(slm: Array) -> Array:
    """Return the nearest field whose amplitude is at most 1."""
    return np.asarray(slm / np.maximum(np.abs(slm), 1), slm.dtype)


def _sample(image: Array, shape: tuple[int, int]) -> Array:
    """Sample an image in FFT order on another grid over the same field, to the nearest pixel."""
    y, x = (np.rint(np.fft.fftfreq(n) * m).astype(int) % m for n, m in zip(shape, image.shape, strict=True))
    sampled: Array = image[np.ix_(y, x)]
    return sampled


# Searches -----------------------------------------------------------------------------------------
# Each moves on by a step, and returns what is there, or None when it is stuck.
class _Lbfgs:
    """L-BFGS with a back-tracking line search (Nocedal and Wright, Alg. 7.4).

    The first step turns the phases by a typical 0.5 rad (a complex SLM's field by as much); from then on the
    step 1 is nearly always taken, so an iteration costs one evaluation. Three pairs: eight gain less than
    0.15 dB after 100 iterations and need 10 more SLM-sized arrays.
    """

    MEMORY = 3

    def __init__(self, variable: Variable, x: Array) -> None:
        self.variable = variable
        self.x = x
        self.point, self.gradient = variable.evaluate(self.x)
        self.pairs: deque[tuple[Array, Array, float]] = deque(maxlen=self.MEMORY)

    @property
    def slm(self) -> Array:
        return to_host(self.variable.field(self.x.copy()))  # steps are taken in place

    def step(self) -> Point | None:
        for _ in range(2):
            moved = self._search(self._direction())
            if moved is not None:
                return moved
            if not self.pairs:
                return None
            self.pairs.clear()
        return None

    def _direction(self) -> Array:
        direction = -self.gradient
        if not self.pairs:
            size = float(np.sqrt(np.mean(self.gradient.astype(np.float64) ** 2)))
            return (
                direction * direction.dtype.type(self.variable.first_step / size) if size > 0 else direction
            )
        weights = []
        for s, y, rho in reversed(self.pairs):
            weight = rho * float(s @ direction)
            direction -= direction.dtype.type(weight) * y
            weights.append(weight)
        s, y, rho = self.pairs[-1]
        direction *= direction.dtype.type(1.0 / (rho * float(y @ y)))
        for (s, y, rho), weight in zip(self.pairs, reversed(weights), strict=True):
            direction += direction.dtype.type(weight - rho * float(y @ direction)) * s
        if len(self.pairs) == self.MEMORY:
            self.pairs.popleft()  # used for the last time: its room is needed while the step is tried
        return direction

    def _search(self, step: Array) -> Point | None:
        """Shorten ``step`` until the loss falls enough, and take it."""
        slope = float(step @ self.gradient)
        if not slope < 0:
            return None
        taken = self.x
        for _ in range(12):
            taken += step
            point, gradient = self.variable.evaluate(taken)
            if point.loss <= self.point.loss + 1e-4 * slope:
                change = np.subtract(gradient, self.gradient, out=self.gradient)
                curvature = float(step @ change)
                if curvature > 1e-10 * float(change @ change):
                    self.pairs.append((step, change, 1.0 / curvature))
                self.point, self.gradient = point, gradient
                return point
            taken -= step
            bend = point.loss - self.point.loss - slope
            shorter = float(np.clip(-slope / (2 * bend), 0.1, 0.5)) if bend > 0 else 0.25
            step *= step.dtype.type(shorter)
            slope *= shorter
        return None


class _Nesterov:
    """Projected gradient with Nesterov acceleration (Kuo 2020, Alg. 1, A.6), finding its own step.

    The step starts large and is halved, and the momentum dropped, whenever the loss rises. The extrapolated
    point is projected too, so that what is evaluated is what the SLM can show.
    """

    def __init__(self, model: HologramModel, start: Array, complex_slm: bool) -> None:
        self.model = model
        self.project: Callable[[Array], Array] = _within if complex_slm else _unit
        self.base = self.ahead = start.astype(model.dtype)
        self.t = 1.0
        found = model.evaluate(self.ahead)
        self.point, self.gradient = Point(found.loss, found.seen_psnr_db), found.gradient
        size = float(np.sqrt(np.mean(np.abs(self.gradient) ** 2)))
        self.size = 2.0 / max(size, 1e-30)

    @property
    def slm(self) -> Array:
        return self.ahead

    def step(self) -> Point | None:
        for _ in range(20):
            base = self.project(self.ahead - self.model.dtype.type(self.size) * self.gradient)
            t = 0.5 * (1 + np.sqrt(1 + 4 * self.t**2))
            ahead = self.project(base + self.model.dtype.type((self.t - 1) / t) * (base - self.base))
            found = self.model.evaluate(ahead)
            if found.loss <= self.point.loss:
                self.base, self.t, self.ahead, self.gradient = base, t, ahead, found.gradient
                self.point = Point(found.loss, found.seen_psnr_db)
                return self.point
            self.size /= 2
            self.t = 1.0
            self.base = self.ahead
        return None


# Phase levels -------------------------------------------------------------------------------------
Stages = tuple[tuple[float, float], ...]
STAGES: Stages = ((0.0, 0.6), (0.5, 0.1), (0.8, 0.1), (0.95, 0.1), (0.99, 0.1))
"""Part of the pixels that are rounded in each stage, closest to a level first, and of the iterations."""
MIRROR_STAGES: Stages = (
    *((0.0, 0.3), (0.25, 0.1), (0.5, 0.1), (0.7, 0.1)),
    *((0.85, 0.1), (0.93, 0.1), (0.97, 0.1), (0.99, 0.1)),
)
"""Of mirrors, which are between their states at first: 0.6 to 2 dB better than by the stages above."""
FINE = 32
"""So many levels or more are rounded to at the end only: stages would cost more than they make up for."""


def _on_levels(variable: Phase, x: Array, levels: int, watch: _Watch, stages: Stages = STAGES) -> Hologram:
    """Find phases on levels; the last record is theirs, all others are of phases that are partly rounded."""
    step = x.dtype.type(2 * np.pi / levels)
    if variable.model.wraps:
        # Stages would search across the jumps, and a phase that is rounded up to a whole turn jumps.
        def nearest(slm: Array) -> Array:
            near = np.rint(np.mod(variable.pack(slm), x.dtype.type(2 * np.pi)) / step)
            rounded: Array = np.minimum(near, levels - 1) * step
            return rounded

        found = _in_turns(
            variable, _Lbfgs(variable, x), watch, lambda slm: variable.evaluate(nearest(slm))[0].psnr_db
        )
        return _rounded(variable, nearest(found.slm), found.history, found.stop_reason)
    history: tuple[HologramRecord, ...] = ()
    reason = HologramStop.ITERATIONS
    done = 0.0
    for held, part in stages if levels < FINE else ((0.0, 1.0),):
        done += part
        if held:
            away = np.abs(x / step - np.rint(x / step))
            if variable.held is not None:
                away[variable.held] = -1
            variable.held = away <= np.quantile(away, held)
            x[variable.held] = np.rint(x[variable.held] / step) * step
        if reason in (HologramStop.CANCELLED, HologramStop.TIME, HologramStop.QUALITY):
            continue
        search = _Lbfgs(variable, x)

        def rounded_db(search: _Lbfgs = search) -> float:
            return variable.evaluate(np.rint(search.x / step) * step)[0].psnr_db

        iterations = round(watch.options.iterations * done)
        history, reason = watch.run(search, iterations, watch.options.psnr_db, history, rounded_db)
        x = search.x
    variable.held = None
    return _rounded(variable, np.rint(x / step) * step, history, reason)


def _rounded(
    variable: Phase, x: Array, history: tuple[HologramRecord, ...], reason: HologramStop
) -> Hologram:
    last = history[-1]
    record = HologramRecord(last.iteration, last.seconds, *variable.evaluate(x)[0])
    slm = to_host(variable.field(x)).astype(np.complex64)
    return Hologram(slm, (*history[:-1], record), reason, last.seconds)


def _on_mirrors(
    model: HologramModel, initial: Array | None, options: HologramOptions, watch: _Watch
) -> Hologram:
    """Find patterns of mirrors that send light or not; the last record is theirs.

    Optimised: as phases on two levels. Else what the first order shall be is found as for a phase or a
    complex SLM, and then coded.
    """
    if options.mirrors == "optimised":
        whole = Mirrors(model)
        start = initial if initial is not None else 0.5 + 0.5 * _start(None, model, options).real
        return _on_levels(whole, whole.pack(start), 2, watch, MIRROR_STAGES)
    if (model.display.mask.levels != model.display.mask.levels.flat[0]).any():
        raise InputError(
            f"A mask scatters what carries the picture and what does not over the whole field alike: "
            f"{options.mirrors!r} is for a display without one (expansion 1). Through a mask: 'optimised'."
        )
    kind = Bounded if options.mirrors == "lee" else Phase
    variable = kind(model, FIRST_ORDER)
    start = _start(None, model, options) if initial is None else decoded(initial)
    search = _Lbfgs(variable, variable.pack(start))

    def coded_db() -> float:
        return model.evaluate(coded(search.slm)).seen_psnr_db

    history, reason = watch.run(search, options.iterations, options.psnr_db, shown_db=coded_db)
    last, shown = history[-1], coded(search.slm)
    found = model.evaluate(shown)
    record = HologramRecord(last.iteration, last.seconds, found.loss, found.seen_psnr_db)
    return Hologram(shown.astype(np.complex64), (*history[:-1], record), reason, last.seconds)


TURNS = ((0.25, False), (0.2, False), (0.15, False), (0.2, True), (0.2, True))
"""Where a display jumps as phases wrap: parts of the iterations in which none does, and whether phases stop
at the ends of their turn then, so that nothing jumps afterwards."""


def _in_turns(
    variable: Phase, search: _Lbfgs, watch: _Watch, shown_db: Callable[[Array], float] | None = None
) -> Hologram:
    """Search with phases that do not wrap, and wrap them in between; the best wrapped ones count.

    ``shown_db`` is the PSNR of what is shown of them, where that is not they themselves.
    """
    model = variable.model
    history: tuple[HologramRecord, ...] = (HologramRecord(0, 0.0, *search.point),)
    best, slm = search.point, search.slm
    reason, done = HologramStop.ITERATIONS, 0.0
    for part, within in TURNS:
        done += part
        model.hold(search.slm, within=within)
        going = _Lbfgs(variable, search.x)
        # What a held display reaches is shown by no SLM: the PSNR asked for is looked for once it is wrapped.
        history, reason = watch.run(going, round(watch.options.iterations * done), None, history)
        now = model.stopped(going.slm)
        model.hold(None)
        search = _Lbfgs(variable, variable.pack(now))
        if search.point.loss < best.loss:
            best, slm = search.point, now
        history = (*history[:-1], replace(history[-1], loss=best.loss, psnr_db=best.psnr_db))
        asked_db = watch.options.psnr_db
        good = asked_db is not None and best.psnr_db >= asked_db
        if good and (shown_db is None or shown_db(slm) >= (asked_db or 0.0)):
            reason = HologramStop.QUALITY
        if reason not in (HologramStop.ITERATIONS, HologramStop.CONVERGED):
            break
    return Hologram(slm.astype(np.complex64), history, reason, history[-1].seconds)


TOLERANCE = 1e-5
"""Where none is asked for."""


@dataclass(frozen=True, slots=True)
class _Watch:
    """Steps a search until what was asked for is reached or spent."""

    options: HologramOptions
    callback: Callback | None
    cancel: threading.Event | None

    def run(
        self,
        search: _Lbfgs | _Nesterov,
        iterations: int,
        psnr_db: float | None,
        before: tuple[HologramRecord, ...] = (),
        shown_db: Callable[[], float] | None = None,
    ) -> tuple[tuple[HologramRecord, ...], HologramStop]:
        """Step on; ``before`` is the history so far, whose iterations count.

        ``shown_db`` is the PSNR of what would be shown, where that is not what the search moves.
        """
        history = [*before] or [HologramRecord(0, 0.0, *search.point)]
        seconds, calm = history[-1].seconds, 0
        tolerance = TOLERANCE if self.options.tolerance is None else self.options.tolerance
        while True:
            last, began = history[-1], time.perf_counter()
            reason = self._ended(last, seconds, iterations, psnr_db)
            if reason is HologramStop.QUALITY and shown_db is not None and shown_db() < (psnr_db or 0.0):
                reason = self._ended(last, seconds, iterations, None)
            if reason is not None:
                return tuple(history), reason
            found = search.step()
            seconds += time.perf_counter() - began
            if found is None:
                return tuple(history), HologramStop.CONVERGED
            calm = calm + 1 if last.loss - found.loss < tolerance * last.loss else 0
            history.append(HologramRecord(last.iteration + 1, seconds, found.loss, found.psnr_db))
            if self.callback is not None:
                self.callback(history[-1], search.slm)
            if calm >= 5:
                return tuple(history), HologramStop.CONVERGED

    def _ended(
        self, last: HologramRecord, seconds: float, iterations: int, psnr_db: float | None
    ) -> HologramStop | None:
        if self.cancel is not None and self.cancel.is_set():
            return HologramStop.CANCELLED
        if psnr_db is not None and last.psnr_db >= psnr_db:
            return HologramStop.QUALITY
        if last.iteration >= iterations:
            return HologramStop.ITERATIONS
        if self.options.time_s is not None and seconds >= self.options.time_s:
            return HologramStop.TIME
        return None
