"""What can go wrong in a calibration."""

from __future__ import annotations

from instrument.errors import BenchError


class CalibrationError(BenchError):
    """A calibration that cannot be taken, or was ended before its last frame."""

    exit_code = 1
