"""What a map of a failure boundary is: two stresses, methods, a trial, and what the trials gave."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.verdict.failure import Failure, Severities, worst

Size = Literal["quick", "full"]
SIZES: tuple[Size, ...] = ("quick", "full")


@dataclass(frozen=True, slots=True)
class Axis:
    """A stress.

    Attributes
    ----------
    key, label, unit : str
    values : tuple of float
        For the full size, rising.
    quick : tuple of float
        For the quick size.
    logarithmic : bool
    named : callable, optional
        ``named(value, size)`` says what a value is in other units: the name of its tick.
    """

    key: str
    label: str
    unit: str
    values: tuple[float, ...]
    quick: tuple[float, ...]
    logarithmic: bool = False
    named: Callable[[float, Size], str] | None = None

    def at(self, size: Size) -> tuple[float, ...]:
        """Return the values of a size."""
        return self.values if size == "full" else self.quick


@dataclass(frozen=True, slots=True)
class Trial:
    """One reconstruction under stress.

    Attributes
    ----------
    error : float
        What the map's ``error`` says: NRMSE after the best scale, or decibels.
    severities : mapping
        By criterion, see :mod:`recon.verdict.failure`.
    evidence : mapping
        What the data alone tell (see :mod:`recon.verdict.evidence`); empty where nothing was reconstructed.
    """

    error: float
    severities: Severities
    evidence: Mapping[str, float] = field(default_factory=dict)


TrialFunction = Callable[[str, float, float, int, Size], Trial]
"""``trial(method, x, y, seed, size)``."""


@dataclass(frozen=True, slots=True)
class StressMap:
    """A map to be made.

    Attributes
    ----------
    name, title : str
    question : str
        What it answers, in plain words.
    x, y : Axis
    methods : tuple of str
    trial : callable
    error : str
        What the errors are.
    draws : int
        Scenes a cell in the full size; the median severity counts.
    base : str
        What the trials start from, in words that change when it does; empty where that is not known.
    """

    name: str
    title: str
    question: str
    x: Axis
    y: Axis
    methods: tuple[str, ...]
    trial: TrialFunction
    error: str = "NRMSE"
    draws: int = 1
    base: str = ""


@dataclass(frozen=True, slots=True)
class Cell:
    """What a method gave at one place of a map: the median of the draws."""

    method: str
    ix: int
    iy: int
    error: float
    severity: float
    failure: Failure | None
    evidence: tuple[Mapping[str, float], ...]
    """One mapping a draw, each with its own ``severity``."""
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return the cell for a file."""
        return {
            "method": self.method,
            "ix": self.ix,
            "iy": self.iy,
            "error": self.error,
            "severity": self.severity,
            "failure": None if self.failure is None else self.failure.name.lower(),
            "evidence": [dict(e) for e in self.evidence],
            "seconds": self.seconds,
        }

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Cell:
        """Return the cell of a file's entry."""
        return Cell(
            entry["method"],
            int(entry["ix"]),
            int(entry["iy"]),
            float(entry["error"]),
            float(entry["severity"]),
            None if entry["failure"] is None else Failure[entry["failure"].upper()],
            tuple(entry["evidence"]),
            float(entry["seconds"]),
        )


def cell_of(method: str, ix: int, iy: int, trials: list[Trial], seconds: float) -> Cell:
    """Summarise the draws of a cell."""
    judged = [worst(t.severities) for t in trials]
    order = np.argsort([severity for severity, _ in judged])
    middle = int(order[len(order) // 2])
    return Cell(
        method,
        ix,
        iy,
        float(np.median([t.error for t in trials])),
        judged[middle][0],
        judged[middle][1],
        tuple(
            {**t.evidence, "severity": severity}
            for t, (severity, _) in zip(trials, judged, strict=True)
            if t.evidence
        ),
        seconds,
    )


def severity_grid(cells: list[Cell], method: str, shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Return the severities of a method, (n_y, n_x); NaN where there is no cell yet."""
    grid = np.full(shape, np.nan)
    for cell in cells:
        if cell.method == method:
            grid[cell.iy, cell.ix] = cell.severity
    return grid


def boundary(
    x: tuple[float, ...], y: tuple[float, ...], severity: npt.NDArray[np.float64], *, logarithmic: bool
) -> list[tuple[float, float]]:
    """Return where each row crosses from working to failing, ``(x, y)``; other rows have no point.

    Between two cells the crossing is interpolated on the logarithm of the severity, along ``x`` or its
    logarithm. A row that crosses more than once counts where most of its cells are on the right side.
    """
    points = []
    places = np.log(x) if logarithmic else np.asarray(x, float)
    for value, row in zip(y, severity, strict=True):
        fails = row >= 1
        crossings = np.flatnonzero(fails[1:] != fails[:-1])
        if not len(crossings) or np.isnan(row).any():
            continue
        k = int(min(crossings, key=lambda c: _misplaced(fails, int(c))))
        a, b = np.log(np.maximum(row[[k, k + 1]], 1e-6))
        at = places[k] + (places[k + 1] - places[k]) * (0.0 if a == b else float(-a / (b - a)))
        points.append((float(np.exp(at)) if logarithmic else float(at), float(value)))
    return points


def _misplaced(fails: npt.NDArray[np.bool_], k: int) -> int:
    """Cells that would be on the wrong side of a border after cell ``k``."""
    return int(np.count_nonzero(fails[: k + 1] != fails[k])) + int(
        np.count_nonzero(fails[k + 1 :] != fails[k + 1])
    )
