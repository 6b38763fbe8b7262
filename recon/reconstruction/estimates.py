"""What an error of the model, or light left out, costs in decibels: round figures of the scenes tuned on."""

from __future__ import annotations

import numpy as np

ERROR_SCALE = 0.5
"""Relative PSF error that costs 3 dB."""
LEFT_OUT_SCALE = 0.1
"""Share of the light left out that costs 3 dB."""


def loss_db(error: float) -> float:
    """Return what a relative error of the PSFs costs, 0 or below."""
    return -10 * float(np.log10(1 + (error / ERROR_SCALE) ** 2))


def left_out_db(share: float) -> float:
    """Return what leaving out a share of the light costs, 0 or below."""
    return -10 * float(np.log10(1 + share / LEFT_OUT_SCALE)) if share > 0 else 0.0
