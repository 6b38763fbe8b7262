"""What files that know one step for all planes cannot say of a volume's depths."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

EVEN = 0.01
"""Steps that differ by less than this part of the smallest are taken for even."""


def middle_step_um(z_um: npt.NDArray[np.float64]) -> float:
    """Return the step beside the middle plane, positive: what OME files get; NaN where it is not known."""
    if len(z_um) < 2:
        return float("nan")
    middle = min(len(z_um) // 2, len(z_um) - 2)
    return abs(float(z_um[middle + 1] - z_um[middle]))


def uneven_steps(z_um: npt.NDArray[np.float64]) -> str:
    """Say that planes are not evenly spaced, and which step an OME file has; empty where they are.

    Parameters
    ----------
    z_um : ndarray, float64, (n_z,)
        Depths of the planes, ascending or descending; not finite where they are not known.
    """
    steps = np.abs(np.diff(z_um))
    if len(steps) < 2 or not np.isfinite(steps).all() or np.ptp(steps) <= EVEN * steps.min():
        return ""
    return (
        f"steps of {steps.min():.4g} to {steps.max():.4g} µm. OME files know one step for all: "
        f"{middle_step_um(z_um):.4g} µm, that of the middle, is written. Other programs stretch the others."
    )
