"""What can go wrong in a calibration."""

from __future__ import annotations

from instrument.errors import BenchError


class CalibrationError(BenchError):
    """A calibration that cannot be taken, or was ended before its last frame."""

    exit_code = 1


class TooDarkError(CalibrationError):
    """Hardly any light reaches the camera, even at its longest exposure."""
