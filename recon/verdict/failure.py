"""What "failed" means, in one place: each criterion gives a severity, and from 1 on it is a failure.

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
               (:mod:`recon.evaluation.stability_spots`)
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
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import metrics
from recon.solvers.base import IterationRecord, StopReason

Image = npt.NDArray[Any]

WORST = 99.0
"""Severities are cut here: an infinite one is no number for a file."""
RING_CORRELATION = 0.5
RING_WIDTH = 0.2
"""Half width of the ring, relative to its frequency."""
DIP = 0.2
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


def trivial_error(back_projection: Image, truth: Image) -> float:
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


def relative_error(found: Image, truth: Image) -> float:
    """Return the NRMSE after the best scale, for any number of dimensions."""
    a, b = (np.asarray(v, np.float64).reshape(len(v), -1) for v in (found, truth))
    return metrics.nrmse(a, b, fit_scale=True)


def ring_correlation(found: Image, truth: Image, period_px: float) -> float:
    """Return the correlation of two images (height, width) on a ring of spatial frequencies."""
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in truth.shape))
    a, b = (np.fft.rfft2(window * (v - v.mean())) for v in (found, truth))
    y, x = np.fft.fftfreq(truth.shape[0])[:, None], np.fft.rfftfreq(truth.shape[1])
    ring = np.abs(np.hypot(y, x) * period_px - 1) <= RING_WIDTH
    norm = float(np.sqrt(np.sum(np.abs(a[ring]) ** 2) * np.sum(np.abs(b[ring]) ** 2)))
    return float(np.sum(a[ring] * b[ring].conj()).real) / norm if norm > 0 else 0.0


def resolution_severity(found: Image, truth: Image, resolved_px: float) -> float:
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
