"""Stability maps: two stresses, methods, what each trial gave, and from where on that counts as a failure.

Each criterion gives a severity, and from 1 on it is a failure:

=============  ==========================================================================================
criterion      severity
=============  ==========================================================================================
trivial        error over that of the trivial reconstruction: the measurement's back-projection ``A^H b``
               with the best scale and offset that the truth itself would choose
resolution     0.5 over the correlation with the truth on the ring of frequencies whose period is twice the
               resolved distance (the resolution has fallen below half of nominal); that distance is the
               shift at which the PSF's autocorrelation is 0.7, and at least two pixels
spots          share of true points (away from others) without a peak within 1.5 pixels, and of peaks without
               a point, over 10 %; where points are crowded, less what chance finds
               (:mod:`recon.evaluation.scene_trial`)
dip            0.2 over the least dip between neighbouring points (two-point resolution)
convergence    change of the last iteration over ten times the tolerance, where a limit ended the run
picture        ``10^((20 - PSNR) / 20)``: a hologram's error over a tenth of its picture's white
precision      difference of float32 from float64 over 1 % of the solution
alone          error over that of the same frames reconstructed one by one: the prior over time does harm
=============  ==========================================================================================

Severities are continuous, so that a boundary can be drawn between the cells of a coarse map.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Literal

import numpy as np

from recon.arrays import Array, BoolArray, Float64Array
from recon.base import metrics
from recon.solvers.base import IterationRecord, StopReason

Size = Literal["quick", "full"]

WORST = 99.0
"""Severities are cut here: an infinite one is no number for a file."""
RING_CORRELATION = 0.5
RING_WIDTH = 0.2
"""Half width of the ring, relative to its frequency."""
PSNR_DB = 20.0
PRECISION = 0.01


class Failure(enum.StrEnum):
    """In which way a reconstruction failed."""

    TRIVIAL = "no better than the trivial reconstruction"
    RESOLUTION = "resolution below half of nominal"
    SPOTS = "points lost or made up"
    DIP = "neighbouring points not told apart"
    CONVERGENCE = "not converged"
    PICTURE = "picture below 20 dB"
    PRECISION = "float32 differs from float64"
    ALONE = "worse than each frame on its own"


Severities = Mapping[Failure, float]


def worst(severities: Severities) -> tuple[float, Failure | None]:
    """Return the largest severity, and its criterion where it is a failure (1 or more)."""
    if not severities:
        raise ValueError("A cell needs at least one criterion.")
    kind = max(severities, key=lambda k: severities[k])
    value = bounded(severities[kind])
    return value, kind if value >= 1 else None


def bounded(severity: float) -> float:
    """Return the severity within 0 and :data:`WORST`; NaN is the worst."""
    return WORST if not severity <= WORST else max(float(severity), 0.0)


def trivial_error(back_projection: Array, truth: Array) -> float:
    """Return the NRMSE of the trivial reconstruction: ``a A^H b + c`` with the best ``a`` and ``c``.

    Parameters
    ----------
    back_projection, truth : ndarray
        Of one shape, any number of dimensions.
    """
    seen, wanted = (np.asarray(v, np.float64).ravel() for v in (back_projection, truth))
    columns = np.stack([seen, np.ones_like(seen)], axis=1)
    fitted = columns @ np.linalg.lstsq(columns, wanted, rcond=None)[0]
    return float(np.linalg.norm(fitted - wanted) / np.linalg.norm(wanted))


def relative_error(found: Array, truth: Array) -> float:
    """Return the NRMSE after the best scale, for any number of dimensions."""
    a, b = (np.asarray(v, np.float64).reshape(len(v), -1) for v in (found, truth))
    return metrics.nrmse(a, b, fit_scale=True)


def ring_correlation(found: Array, truth: Array, period_px: float) -> float:
    """Return the correlation of two images (height, width) on a ring of spatial frequencies."""
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in truth.shape))
    a, b = (np.fft.rfft2(window * (v - v.mean())) for v in (found, truth))
    y, x = np.fft.fftfreq(truth.shape[0])[:, None], np.fft.rfftfreq(truth.shape[1])
    ring = np.abs(np.hypot(y, x) * period_px - 1) <= RING_WIDTH
    norm = float(np.sqrt(np.sum(np.abs(a[ring]) ** 2) * np.sum(np.abs(b[ring]) ** 2)))
    return float(np.sum(a[ring] * b[ring].conj()).real) / norm if norm > 0 else 0.0


def resolution_severity(found: Array, truth: Array, resolved_px: float) -> float:
    """Severity of lost resolution; ``resolved_px`` is the distance that the optics resolve."""
    return bounded(RING_CORRELATION / max(ring_correlation(found, truth, 2 * resolved_px), 1e-3))


def convergence_severity(
    history: tuple[IterationRecord, ...], reason: StopReason | None, tolerance: float
) -> float:
    """Severity of a run that was ended by a limit; 0 for one that settled or took one step."""
    if reason is StopReason.NOT_FINITE:
        return WORST
    if not history or reason is not StopReason.ITERATIONS or tolerance <= 0:
        return 0.0
    return bounded(history[-1].change / (10 * tolerance))


# Maps -----------------------------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Stress:
    """A stress."""

    key: str
    label: str
    unit: str
    values: tuple[float, ...]
    """For the full size, rising."""
    quick: tuple[float, ...]
    """For the quick size."""
    logarithmic: bool = False
    named: Callable[[float, Size], str] | None = None
    """``named(value, size)`` says what a value is in other units: the name of its tick."""

    def at(self, size: Size) -> tuple[float, ...]:
        """Return the values of a size."""
        return self.values if size == "full" else self.quick


@dataclass(frozen=True, slots=True)
class Trial:
    """One reconstruction under stress."""

    error: float
    """What the map's ``error`` says: NRMSE after the best scale, or decibels."""
    severities: Severities
    """By criterion, see :mod:`recon.verdict.map`."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What the data alone tell (see :mod:`recon.verdict.evidence`); empty where nothing was reconstructed."""


TrialFunction = Callable[[str, float, float, int, Size], Trial]
"""``trial(method, x, y, seed, size)``."""


@dataclass(frozen=True, slots=True)
class StressMap:
    """A map to be made."""

    name: str
    title: str
    question: str
    """What it answers, in plain words."""
    x: Stress
    y: Stress
    methods: tuple[str, ...]
    trial: TrialFunction
    error: str = "NRMSE"
    """What the errors are."""
    base: str = ""
    """What the trials start from, in words that change when it does; empty where that is not known."""


@dataclass(frozen=True, slots=True)
class Cell:
    """What a method gave at one place of a map."""

    method: str
    ix: int
    iy: int
    error: float
    severity: float
    failure: Failure | None
    evidence: tuple[Mapping[str, float], ...]
    """Of each scene drawn, with its own ``severity``."""
    seconds: float

    def as_json(self) -> dict[str, Any]:
        """Return the cell for a file."""
        failure = None if self.failure is None else self.failure.name.lower()
        return {**asdict(self), "failure": failure, "evidence": [dict(e) for e in self.evidence]}

    @staticmethod
    def from_json(entry: Mapping[str, Any]) -> Cell:
        """Return the cell of a file's entry."""
        failure = None if entry["failure"] is None else Failure[entry["failure"].upper()]
        known = {field.name: entry[field.name] for field in fields(Cell)}
        return Cell(**known | {"failure": failure, "evidence": tuple(entry["evidence"])})


def cell_of(method: str, ix: int, iy: int, trial: Trial, seconds: float) -> Cell:
    """Return the cell that a trial makes."""
    severity, failure = worst(trial.severities)
    evidence = ({**trial.evidence, "severity": severity},) if trial.evidence else ()
    return Cell(method, ix, iy, float(trial.error), severity, failure, evidence, seconds)


def boundary(
    x: tuple[float, ...], y: tuple[float, ...], severity: Float64Array, *, logarithmic: bool
) -> list[tuple[float, float]]:
    """Return where each row crosses from working to failing, ``(x, y)``; other rows have no point.

    ``severity`` is (n_y, n_x), NaN where it is not known.

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


def _misplaced(fails: BoolArray, k: int) -> int:
    """Cells that would be on the wrong side of a border after cell ``k``."""
    return int(np.count_nonzero(fails[: k + 1] != fails[k])) + int(
        np.count_nonzero(fails[k + 1 :] != fails[k + 1])
    )
