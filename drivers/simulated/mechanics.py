"""The moving parts of the simulated stage: where it says it is, and where it is.

An axis follows a trapezoidal speed profile. Its carriage trails its screw with play (backlash): approached
upwards it sits where the screw says, approached downwards it is ahead by the play. On top, every move ends
off by a random amount (repeatability). Hard limit switches stop the carriage.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from drivers.simulated.surroundings import Clock
from drivers.stage import trapezoid_duration_s


@dataclass(frozen=True, slots=True)
class AxisSpec:
    """One axis; lengths in the unit that its name ends in, times in seconds."""

    name: str
    lower_limit: float
    upper_limit: float
    home: float
    speed_per_s: float
    acceleration_per_s2: float
    resolution: float
    backlash: float
    repeatability: float
    hard_margin: float
    """How far the limit switches lie beyond the soft limits."""
    scale: float = 1.0
    """True way over the way that the screw reports, about where homing ends."""
    slip: float = 0.0
    slip_at_move: int = 0
    """Steps that are lost when the axis begins so manieth move (from 1; 0: never)."""


@dataclass(slots=True)
class _AxisState:
    start: float
    target: float
    carriage: float
    """Where the carriage was when the move began, without the random error."""
    error_before: float = 0.0
    error_after: float = 0.0
    slip: float = 0.0
    """True screw position minus the one reported (lost steps)."""
    jammed: bool = False
    moves: int = 0


def trapezoid_path(elapsed: float, distance: float, speed: float, acceleration: float) -> float:
    """Return the way covered (signed as ``distance``) after ``elapsed`` seconds of a move."""
    total = trapezoid_duration_s(distance, speed, acceleration)
    if elapsed >= total:
        return distance
    way = abs(distance)
    ramp_time = min(speed / acceleration, total / 2)
    peak = acceleration * ramp_time
    if elapsed < ramp_time:
        covered = acceleration * elapsed**2 / 2
    elif elapsed < total - ramp_time:
        covered = peak * (elapsed - ramp_time / 2)
    else:
        covered = way - acceleration * (total - elapsed) ** 2 / 2
    return math.copysign(covered, distance)


class Carriage:
    """The stage's axes in motion; safe to use from several threads.

    Parameters
    ----------
    axes : tuple of AxisSpec
    clock : Clock
    seed : int
        Draws of the random errors.
    """

    def __init__(self, axes: tuple[AxisSpec, ...], clock: Clock, seed: int) -> None:
        self.axes = {axis.name: axis for axis in axes}
        self._clock = clock
        self._rng = np.random.default_rng(seed)
        self._lock = threading.RLock()
        self._started = time.monotonic()
        self._states = {a.name: _AxisState(a.home, a.home, a.home) for a in axes}

    def start(self, target: Mapping[str, float]) -> float:
        """Begin a move from wherever the axes are; returns its duration in simulated seconds."""
        with self._lock:
            here = self.reported()
            self._settle(here)
            for name, position in target.items():
                axis, state = self.axes[name], self._states[name]
                state.target = round(position / axis.resolution) * axis.resolution
                state.error_after = float(self._rng.normal(0.0, axis.repeatability))
                state.moves += state.target != state.start
                if state.moves == axis.slip_at_move and state.target != state.start:
                    state.slip += axis.slip
            self._started = time.monotonic()
            duration_s = max((self._duration(name) for name in target), default=0.0)
            self._clock.skip(duration_s)
            return duration_s

    def halt(self) -> None:
        """Stop where the axes are now."""
        with self._lock:
            self._settle(self.reported())

    def reported(self) -> dict[str, float]:
        """Where the screws say the axes are."""
        with self._lock:
            elapsed = self._clock.elapsed_since(self._started)
            return {name: self._screw(name, elapsed) for name in self._states}

    def true(self) -> dict[str, float]:
        """Where the carriage is."""
        with self._lock:
            elapsed = self._clock.elapsed_since(self._started)
            return {name: self._true(name, self._screw(name, elapsed)) for name in self._states}

    @property
    def is_moving(self) -> bool:
        """Whether any axis is on its way."""
        with self._lock:
            elapsed = self._clock.elapsed_since(self._started)
            return any(
                (state.jammed and state.target != state.start) or elapsed < self._duration(name)
                for name, state in self._states.items()
            )

    def jammed_axes(self) -> tuple[str, ...]:
        """Axes that are asked to move and cannot."""
        with self._lock:
            return tuple(n for n, s in self._states.items() if s.jammed and s.target != s.start)

    def tripped_switches(self) -> tuple[str, ...]:
        """Axes whose screw stands at a hard limit switch."""
        with self._lock:
            elapsed = self._clock.elapsed_since(self._started)
            tripped = []
            for name, state in self._states.items():
                low, high = self._switches(name)
                if not low < self._screw(name, elapsed) + state.slip < high:
                    tripped.append(name)
            return tuple(tripped)

    def find_reference(self) -> None:
        """Set every axis to its reference position; lost steps are forgotten."""
        with self._lock:
            for name, axis in self.axes.items():
                before = self._states[name]
                self._states[name] = _AxisState(
                    axis.home, axis.home, axis.home, jammed=before.jammed, moves=before.moves
                )

    def set_jammed(self, name: str, jammed: bool) -> None:
        """Make an axis stick, or free it."""
        with self._lock:
            self._settle(self.reported())
            self._states[name].jammed = jammed

    def slip(self, name: str, amount: float) -> None:
        """Lose steps: move the carriage without the screw counter."""
        with self._lock:
            self._settle(self.reported())
            self._states[name].slip += amount

    def _settle(self, here: Mapping[str, float]) -> None:
        """Make the present positions the start of whatever comes next."""
        for name, state in self._states.items():
            fraction = self._fraction(state, here[name])
            state.carriage = self._trailing(name, here[name])
            state.error_before += (state.error_after - state.error_before) * fraction
            state.error_after = state.error_before
            state.start = state.target = here[name]

    def _duration(self, name: str) -> float:
        axis, state = self.axes[name], self._states[name]
        return trapezoid_duration_s(state.target - state.start, axis.speed_per_s, axis.acceleration_per_s2)

    def _screw(self, name: str, elapsed: float) -> float:
        axis, state = self.axes[name], self._states[name]
        if state.jammed:
            return state.start
        way = trapezoid_path(elapsed, state.target - state.start, axis.speed_per_s, axis.acceleration_per_s2)
        low, high = self._switches(name)
        return min(max(state.start + way, low - state.slip), high - state.slip)

    def _switches(self, name: str) -> tuple[float, float]:
        axis = self.axes[name]
        return axis.lower_limit - axis.hard_margin, axis.upper_limit + axis.hard_margin

    def _trailing(self, name: str, screw: float) -> float:
        return min(max(self._states[name].carriage, screw), screw + self.axes[name].backlash)

    def _true(self, name: str, screw: float) -> float:
        state = self._states[name]
        error = state.error_before + (state.error_after - state.error_before) * self._fraction(state, screw)
        axis = self.axes[name]
        return axis.home + axis.scale * (self._trailing(name, screw) - axis.home) + state.slip + error

    @staticmethod
    def _fraction(state: _AxisState, screw: float) -> float:
        return 1.0 if state.target == state.start else (screw - state.start) / (state.target - state.start)
