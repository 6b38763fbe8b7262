"""What can go wrong in a calibration."""

from __future__ import annotations

from instrument.files.errors import BenchError
from instrument.runs.run import Run, RunCondition


class CalibrationError(BenchError):
    """A calibration that cannot be taken, or was ended before its last frame."""

    exit_code = 1


class TooDarkError(CalibrationError):
    """Hardly any light reaches the camera, even at its longest exposure."""


class RunEndedError(CalibrationError):
    """The run behind a calibration was ended before its last frame; its frames are kept.

    Parameters
    ----------
    what : str
        Begins the sentence: ``"The sweep"``.
    run : Run
    remedy : str
        What to do about it.
    """

    def __init__(self, what: str, run: Run, remedy: str = "") -> None:
        self.run = run
        self.words = f"{what} ended early ({run.condition}); what was taken is in {run.path}."
        """Without the remedy, which is not the same on the command line and in a window."""
        super().__init__(self.words + (f" {remedy}" if remedy else ""))


def completed(run: Run, what: str = "The run", remedy: str = "") -> Run:
    """Return a run that has all its frames.

    Raises
    ------
    RunEndedError
        When it was ended before its last one.
    """
    if run.condition is not RunCondition.COMPLETED:
        raise RunEndedError(what, run, remedy)
    return run
