"""From a reconstruction in the making to its evidence."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.checks import as_channels, saturated_share
from recon.solvers.base import IterationRecord, StoppingRules, StopReason
from recon.verdict.evidence import Evidence, Observation, averaged, measure

Array = npt.NDArray[Any]

DIVERGED = 1e3
"""``unsettled`` of a run whose iterates were no longer finite; it is never more."""
LIMITS = (StopReason.ITERATIONS, StopReason.TIME, StopReason.CANCELLED)


def observations(
    measurement: npt.ArrayLike, data: Array, valid: npt.NDArray[np.bool_], noise: Array
) -> list[Observation]:
    """Return what the camera saw, a channel each.

    Parameters
    ----------
    measurement : array
        As it came: (height, width[, n_channels]).
    data : ndarray, (n_channels, height, width)
        Background subtracted, in units of the noise.
    valid : ndarray of bool, shape of ``data``
    noise : ndarray, (n_channels,)
        Deviations, counts.
    """
    counts = as_channels(measurement, "measurement")
    return [
        Observation(d, v, float(n), saturated_share(c[v]))
        for d, v, n, c in zip(data, valid, noise, counts, strict=False)
    ]


def evidence_of(
    seen: Sequence[Observation],
    volume: Array,
    psfs: Array,
    residuals: Sequence[float],
    unsettled: float,
    *,
    points: bool = False,
) -> Evidence:
    """Measure all channels of a reconstruction.

    Parameters
    ----------
    seen : sequence of Observation
        One a channel.
    volume : ndarray, (n_z, rows, columns[, n_channels])
        The result in measurement units.
    psfs : ndarray, (n_z, 1 or n_channels, height, width)
        As calibrated.
    residuals : sequence of float
        Residual norms in units of the noise: one a channel, or one of all together.
    unsettled : float
    points : bool
        Whether to look for the result's bright points as well: of volumes.
    """
    n = len(seen)
    channels = [
        measure(
            one,
            volume if volume.ndim == 3 else volume[..., c],
            psfs[:, min(c, psfs.shape[1] - 1)],
            residuals[c] if len(residuals) == n else residuals[0] / n**0.5,
            unsettled=unsettled,
            points=points,
        )
        for c, one in enumerate(seen)
    ]
    return averaged(channels)


def not_judged(error: Exception) -> str:
    """Say that there is no verdict, and why: a result is never lost for want of one."""
    why = f"{type(error).__name__}: {error}"
    return f"No verdict: judging the result failed ({why}). The result itself is whole."


def unsettled_by(
    history: tuple[IterationRecord, ...], reason: StopReason | None, tolerance: float, *, started: bool
) -> float:
    """Return the last change over ten times the tolerance, where a limit ended the run; else 0.

    A run that was ended before it could be seen to settle (:class:`~recon.solvers.base.StoppingRules`
    ask for several calm iterations in a row) counts as if everything had changed: many solvers do not move
    at all in their first iteration. One that was ``started`` from a result had not to begin anew: there the
    residuals count as they do for those rules, as the change alone would call any start settled. Where they
    are nil as well, the start was empty, and nothing is known.
    """
    if reason is StopReason.NOT_FINITE:
        return DIVERGED
    if not history or tolerance <= 0 or reason not in LIMITS:
        return 0.0
    change = history[-1].change
    if len(history) < StoppingRules().patience:
        unrest = history[-1].unrest
        change = unrest if started and unrest > 0 else max(change, 1.0)
    return min(float(change / (10 * tolerance)), DIVERGED) if np.isfinite(change) else DIVERGED
