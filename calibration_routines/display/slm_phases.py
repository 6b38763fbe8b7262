"""Phases of an SLM's levels by pictures of interference: series of them, averaged where they flicker."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from calibration_routines.purpose import CalibrationError
from calibration_routines.scatter import NO_CHANGE, Scatter, compare, pooled, scatter_of
from recon.arrays import Array, Float64Array
from recon.errors import InputError
from recon.holography.slm_response import phases_from_frames

MAX_PHASE_ERROR_RAD = 0.0022
"""Standard deviation of a phase beyond which no table is made. What flickers with the phase's own cosine and
sine bends the whole table, unseen: two independent parts of this size, the worst level off by twice their
root sum of squares, beyond 0.02 rad in three tables of 100,000 at the limit (docs/decisions/0234)."""
MOST_SERIES = 7
"""Times that all pictures are taken where their mean over so many is steady enough and one series is not."""


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


def _flicker(levels: Float64Array, at: Float64Array) -> float:
    """Return the relative standard deviation of brightness beyond what changes evenly; 0 of two visits."""
    share = (at[1:-1] - at[:-2]) / (at[2:] - at[:-2])
    beside = levels[1:-1] - (1 - share) * levels[:-2] - share * levels[2:]
    if not len(beside):
        return 0.0
    return float(np.sqrt(np.mean(beside**2 / (1 + share**2 + (1 - share) ** 2))) / levels.mean())
