"""The option ``--noise``: what is known of a camera's noise."""

from __future__ import annotations

import math

from instrument.errors import BenchError
from recon.noise import NoiseModel


def parse_noise(text: str | None) -> NoiseModel | float | None:
    """Read ``COUNTS`` or ``READ,GAIN``: one deviation, or read noise in counts and counts per electron.

    Raises
    ------
    BenchError
    """
    if text is None:
        return None
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) not in (1, 2) or not all(math.isfinite(v) and v >= 0 for v in values):
        raise BenchError(
            f"--noise {text!r} is not understood; write a standard deviation in counts (3.5), or read noise "
            "in counts and counts per electron (2.1,0.13)."
        )
    return values[0] if len(values) == 1 else NoiseModel(*values)
