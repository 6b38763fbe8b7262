"""Find the SLM pattern: L-BFGS on the phase, projected gradient, one-step back-propagation.

All start from a seed or a given pattern and give the same result for the same seed, whatever the number of
threads. A complex SLM (any amplitude) is the same problem without the constraint on the amplitude.
"""

from __future__ import annotations

import enum
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from recon.errors import InputError
from recon.holography.model import HologramModel

Array = npt.NDArray[Any]
Method = Literal["lbfgs", "nesterov", "one_step"]


class HologramStop(enum.StrEnum):
    """Why the computation of a hologram ended."""

    QUALITY = "the requested PSNR is reached"
    CONVERGED = "the loss no longer falls"
    TIME = "the time budget is spent"
    ITERATIONS = "the number of iterations is reached"
    CANCELLED = "cancelled"
    ONE_STEP = "one-step method"


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
class Budget:
    """When to stop; whichever comes first.

    Attributes
    ----------
    iterations : int
    time_s : float or None
    psnr_db : float or None
        Stop when the low-passed image is that good over the whole field.
    tolerance : float
        Stop when the loss fell by less than this fraction in each of five iterations in a row.
    """

    iterations: int = 200
    time_s: float | None = None
    psnr_db: float | None = None
    tolerance: float = 1e-5

    def __post_init__(self) -> None:
        if self.iterations < 0 or (self.time_s is not None and self.time_s <= 0):
            raise InputError(
                f"A budget needs iterations >= 0 and a time above 0, not {self.iterations}, {self.time_s}."
            )


@dataclass(frozen=True, slots=True)
class Hologram:
    """SLM patterns and how they were found.

    Attributes
    ----------
    slm : ndarray, complex64, (n_frames, height, width)
        Field at the SLM; of modulus 1 for a phase SLM, at most 1 for a complex one.
    history : tuple of HologramRecord
    stop_reason : HologramStop
    seconds : float
    """

    slm: npt.NDArray[np.complex64]
    history: tuple[HologramRecord, ...]
    stop_reason: HologramStop
    seconds: float

    @property
    def phase_rad(self) -> npt.NDArray[np.float32]:
        """Phase in 0 to 2 pi, float32 (n_frames, height, width)."""
        return np.mod(np.angle(self.slm), 2 * np.pi).astype(np.float32)


Callback = Callable[[HologramRecord, Array], object]


def compute_hologram(
    model: HologramModel,
    *,
    method: Method = "lbfgs",
    budget: Budget | None = None,
    complex_slm: bool = False,
    phase_levels: int | None = None,
    initial: Array | None = None,
    seed: int = 0,
    callback: Callback | None = None,
    cancel: threading.Event | None = None,
) -> Hologram:
    """Compute SLM patterns for a model's targets.

    Parameters
    ----------
    model : HologramModel
    method : "lbfgs", "nesterov" or "one_step"
    budget : Budget, optional
    complex_slm : bool
        The SLM sets the amplitude too.
    phase_levels : int, optional
        The SLM shows so many equidistant phases only (L-BFGS): the last iterations round more and more
        pixels and let the others make up for it.
    initial : ndarray, complex, (n_frames, height, width), optional
        Warm start, e.g. the last video frame's ``slm``; by default a random phase.
    seed : int
        Of the random phases.
    callback : callable, optional
        ``callback(record, slm)`` after each iteration; its time is not counted.
    cancel : threading.Event, optional
        Set it from any thread, or from the callback, to end after the iteration in progress.
    """
    shape = (model.frames, *model.display.slm_shape)
    if initial is not None and initial.shape != shape:
        raise InputError(f"The start must be {shape}, not {initial.shape}.")
    if phase_levels is not None and (phase_levels < 2 or complex_slm or method != "lbfgs"):
        raise InputError("Phase levels are 2 or more, of a phase SLM, and need the method 'lbfgs'.")
    if method == "one_step":
        if complex_slm or initial is not None:
            raise InputError("The one-step method takes no start and has no form for a complex SLM.")
        return one_step(model, seed=seed)
    search: _Search
    budget = budget or Budget()
    if phase_levels is not None:
        phase = _Phase(model)
        start = phase.pack(_start(initial, shape, seed, complex_slm))
        return _on_levels(phase, start, phase_levels, budget, callback, cancel)
    if method == "lbfgs":
        variable = _Complex(model) if complex_slm else _Phase(model)
        search = _Lbfgs(variable, variable.pack(_start(initial, shape, seed, complex_slm)))
    elif method == "nesterov":
        search = _Nesterov(model, _start(initial, shape, seed, complex_slm), complex_slm)
    else:
        raise InputError(f"The method is 'lbfgs', 'nesterov' or 'one_step', not {method!r}.")
    history, reason = _run(search, budget, callback, cancel)
    slm = search.slm / max(float(np.abs(search.slm).max()), 1.0) if complex_slm else search.slm
    return Hologram(slm.astype(np.complex64), history, reason, history[-1].seconds)


def _start(initial: Array | None, shape: tuple[int, ...], seed: int, complex_slm: bool) -> Array:
    if initial is not None:
        return initial if complex_slm else _unit(initial)
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, shape).astype(np.float32)
    return np.asarray(np.exp(1j * phases))


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


def _sample(image: Array, shape: tuple[int, int]) -> Array:
    """Sample an image in FFT order on another grid over the same field, to the nearest pixel."""
    y, x = (np.rint(np.fft.fftfreq(n) * m).astype(int) % m for n, m in zip(shape, image.shape, strict=True))
    sampled: Array = image[np.ix_(y, x)]
    return sampled


class _Point(NamedTuple):
    """What is kept of an evaluation."""

    loss: float
    psnr_db: float


# Variables: what the quasi-Newton method moves -----------------------------------------------------
class _Phase:
    """The SLM's phases as a flat real vector; where ``held`` is true they stay as they are."""

    held: npt.NDArray[np.bool_] | None = None

    def __init__(self, model: HologramModel) -> None:
        self.model = model

    def pack(self, slm: Array) -> Array:
        phases: Array = np.angle(slm).astype(self.model.dtype.type(0).real.dtype)
        return phases.ravel()

    def field(self, x: Array) -> Array:
        slm = np.empty((self.model.frames, *self.model.display.slm_shape), self.model.dtype)
        phases = x.reshape(slm.shape)
        np.cos(phases, out=slm.real)
        np.sin(phases, out=slm.imag)
        return slm

    def evaluate(self, x: Array) -> tuple[_Point, Array]:
        slm = self.field(x)
        found = self.model.evaluate(slm)
        # dL/dphi = 2 Im(gradient conj(s)); formed in place of the gradient's imaginary part.
        found.gradient.imag *= slm.real
        found.gradient.real *= slm.imag
        found.gradient.imag -= found.gradient.real
        gradient: Array = np.multiply(found.gradient.imag, 2).ravel()
        if self.held is not None:
            gradient[self.held] = 0
        return _Point(found.loss, found.seen_psnr_db), gradient


class _Complex:
    """Real and imaginary parts of the SLM's field as a flat real vector."""

    def __init__(self, model: HologramModel) -> None:
        self.model = model

    def pack(self, slm: Array) -> Array:
        parts: Array = slm.astype(self.model.dtype).view(self.model.dtype.type(0).real.dtype)
        return parts.ravel()

    def field(self, x: Array) -> Array:
        slm: Array = x.view(self.model.dtype).reshape(self.model.frames, *self.model.display.slm_shape)
        return slm

    def evaluate(self, x: Array) -> tuple[_Point, Array]:
        found = self.model.evaluate(self.field(x))
        gradient: Array = 2 * found.gradient.ravel()
        return _Point(found.loss, found.seen_psnr_db), gradient.view(gradient.real.dtype)


# Searches -----------------------------------------------------------------------------------------
class _Search(ABC):
    """A descent method: :meth:`step` moves on and returns what is there, or None when it is stuck."""

    point: _Point

    @abstractmethod
    def step(self) -> _Point | None: ...

    @property
    @abstractmethod
    def slm(self) -> Array: ...


class _Lbfgs(_Search):
    """L-BFGS with a back-tracking line search (Nocedal and Wright, Alg. 7.4).

    The first step turns the phases by a typical 0.5 rad; from then on the step 1 is nearly always taken, so
    an iteration costs one evaluation. Three pairs: eight gain less than 0.15 dB after 100 iterations and need
    10 more SLM-sized arrays.
    """

    MEMORY = 3
    FIRST_STEP_RAD = 0.5

    def __init__(self, variable: _Phase | _Complex, x: Array) -> None:
        self.variable = variable
        self.x = x
        self.point, self.gradient = variable.evaluate(self.x)
        self.pairs: deque[tuple[Array, Array, float]] = deque(maxlen=self.MEMORY)

    @property
    def slm(self) -> Array:
        return self.variable.field(self.x.copy())  # steps are taken in place

    def step(self) -> _Point | None:
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
            return direction * direction.dtype.type(self.FIRST_STEP_RAD / size) if size > 0 else direction
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

    def _search(self, step: Array) -> _Point | None:
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


class _Nesterov(_Search):
    """Projected gradient with Nesterov acceleration (Kuo 2020, Alg. 1, A.6), finding its own step.

    The step starts large and is halved, and the momentum dropped, whenever the loss rises. The extrapolated
    point is projected too, so that what is evaluated is what the SLM can show.
    """

    def __init__(self, model: HologramModel, start: Array, complex_slm: bool) -> None:
        self.model = model
        self.project: Callable[[Array], Array] = (lambda s: s) if complex_slm else _unit
        self.base = self.ahead = start.astype(model.dtype)
        self.t = 1.0
        found = model.evaluate(self.ahead)
        self.point, self.gradient = _Point(found.loss, found.seen_psnr_db), found.gradient
        size = float(np.sqrt(np.mean(np.abs(self.gradient) ** 2)))
        self.size = 2.0 / max(size, 1e-30)

    @property
    def slm(self) -> Array:
        return self.ahead

    def step(self) -> _Point | None:
        for _ in range(20):
            base = self.project(self.ahead - self.model.dtype.type(self.size) * self.gradient)
            t = 0.5 * (1 + np.sqrt(1 + 4 * self.t**2))
            ahead = self.project(base + self.model.dtype.type((self.t - 1) / t) * (base - self.base))
            found = self.model.evaluate(ahead)
            if found.loss <= self.point.loss:
                self.base, self.t, self.ahead, self.gradient = base, t, ahead, found.gradient
                self.point = _Point(found.loss, found.seen_psnr_db)
                return self.point
            self.size /= 2
            self.t = 1.0
            self.base = self.ahead
        return None


# Phase levels -------------------------------------------------------------------------------------
HELD = (0.0, 0.5, 0.8, 0.95, 0.99)
"""Part of the pixels that are rounded in each stage, those closest to a level first."""
STAGES = (0.6, 0.1, 0.1, 0.1, 0.1)
"""Part of the iterations in each stage."""
FINE = 32
"""So many levels or more are rounded to at the end only: stages would cost more than they make up for."""


def _on_levels(
    variable: _Phase,
    x: Array,
    levels: int,
    budget: Budget,
    callback: Callback | None,
    cancel: threading.Event | None,
) -> Hologram:
    """Find phases on levels; the last record is theirs, all others are of phases that are partly rounded."""
    step = x.dtype.type(2 * np.pi / levels)
    history: tuple[HologramRecord, ...] = ()
    reason = HologramStop.ITERATIONS
    stages = zip(HELD, np.cumsum(STAGES), strict=True) if levels < FINE else [(0.0, 1.0)]
    for held, part in stages:
        if held:
            away = np.abs(x / step - np.rint(x / step))
            if variable.held is not None:
                away[variable.held] = -1
            variable.held = away <= np.quantile(away, held)
            x[variable.held] = np.rint(x[variable.held] / step) * step
        if reason is HologramStop.CANCELLED or reason is HologramStop.TIME:
            continue
        search = _Lbfgs(variable, x)
        limit = replace(budget, iterations=round(budget.iterations * float(part)), psnr_db=None)
        history, reason = _run(search, limit, callback, cancel, history)
        x = search.x
    variable.held = None
    point, _ = variable.evaluate(np.rint(x / step) * step)
    last = history[-1]
    rounded = HologramRecord(last.iteration, last.seconds, *point)
    slm = variable.field(np.rint(x / step) * step)
    return Hologram(slm.astype(np.complex64), (*history[:-1], rounded), reason, last.seconds)


def _run(
    search: _Search,
    budget: Budget,
    callback: Callback | None,
    cancel: threading.Event | None,
    before: tuple[HologramRecord, ...] = (),
) -> tuple[tuple[HologramRecord, ...], HologramStop]:
    """Step until the budget is spent; ``before`` is the history so far."""
    history = [*before] or [HologramRecord(0, 0.0, *search.point)]
    seconds, calm = history[-1].seconds, 0
    while True:
        last = history[-1]
        if cancel is not None and cancel.is_set():
            return tuple(history), HologramStop.CANCELLED
        if budget.psnr_db is not None and last.psnr_db >= budget.psnr_db:
            return tuple(history), HologramStop.QUALITY
        if last.iteration >= budget.iterations:
            return tuple(history), HologramStop.ITERATIONS
        if budget.time_s is not None and seconds >= budget.time_s:
            return tuple(history), HologramStop.TIME
        began = time.perf_counter()
        found = search.step()
        seconds += time.perf_counter() - began
        if found is None:
            return tuple(history), HologramStop.CONVERGED
        calm = calm + 1 if last.loss - found.loss < budget.tolerance * last.loss else 0
        history.append(HologramRecord(last.iteration + 1, seconds, found.loss, found.psnr_db))
        if callback is not None:
            callback(history[-1], search.slm)
        if calm >= 5:
            return tuple(history), HologramStop.CONVERGED
