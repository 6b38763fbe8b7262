"""The one way out of every acquisition."""

from __future__ import annotations

import logging

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError, try_all
from instrument.files.interrupt import interrupts_held
from instrument.runs.layout import FinishReason
from instrument.runs.run import Run
from instrument.runs.writer import RunWriter

_log = logging.getLogger(__name__)


def end_run(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    """Make the bench safe (light off, motion stopped), then finish the run: both tried whatever happens.

    Parameters
    ----------
    bench : Bench
    writer : RunWriter
        Closed afterwards.
    reason : FinishReason
    error : BaseException, optional
        What ended the acquisition. It gets notes on what failed here and on where the run is, and stays the
        error that matters, also when Ctrl-C is pressed meanwhile.

    Returns
    -------
    Run
        For reading.

    Raises
    ------
    StepsFailedError, RunError
        When something failed here and there is no ``error`` to note it on: the bench could not be made safe,
        or the run's end not be written.
    KeyboardInterrupt, SystemExit
        When it was asked for meanwhile and there is no ``error``; everything was done before.
    """
    with interrupts_held() as held:
        run = _end(bench, writer, reason, error)
    if error is None:
        try:
            held.answer()
        except BaseException as interruption:
            interruption.add_note(f"What was acquired is in {writer.path}")
            raise
    return run


def _end(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    text = "" if error is None else str(error) or type(error).__name__
    ended: list[Run] = []
    try:
        try_all(
            [
                ("bench made safe", bench.safe_state),
                ("run finished", lambda: ended.append(writer.finish(reason, text))),
            ]
        )
    except StepsFailedError as failure:
        first, *others = (problem for _, problem in failure.failures)
        if error is None:
            for other in others:
                first.add_note(str(other))
            first.add_note(f"What was acquired is in {writer.path}")
            raise first from None
        for problem in (first, *others):
            _log.error("%s", problem)
            error.add_note(str(problem))
    if error is not None:
        error.add_note(f"What was acquired is in {writer.path}")
    return ended[0] if ended else Run.open(writer.path)
