"""The one way out of every acquisition."""

from __future__ import annotations

from instrument.bench.bench import Bench
from instrument.bench.safety import StepsFailedError, note_failures, try_all
from instrument.runs.interrupts import interrupts_held
from instrument.runs.run import FinishReason, Run
from instrument.runs.run_files import LOG, RunError
from instrument.runs.writer import RunWriter


def end_run(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    """Make the bench safe (light off, motion stopped), then finish the run: both tried whatever happens.

    ``writer``: closed afterwards. ``error``: what ended the acquisition. It gets notes on what failed here
    and on where the run is, and stays the error that matters, also when Ctrl-C is pressed meanwhile.

    Raises StepsFailedError or RunError when something failed here and there is no ``error`` to note it on:
    the bench could not be made safe, or the run's end not be written. Raises KeyboardInterrupt or SystemExit
    when it was asked for meanwhile and there is no ``error``; everything was done before.

    Returns
    -------
    Run
        For reading.
    """
    with interrupts_held() as held:
        run = _end(bench, writer, reason, error)
    if error is None:
        held.answer(_where(writer))
    return run


def _end(bench: Bench, writer: RunWriter, reason: FinishReason, error: BaseException | None) -> Run:
    wordless = error is None or (
        isinstance(error, KeyboardInterrupt) and not str(error)
    )  # the reason says it
    text = "" if wordless else str(error) or type(error).__name__
    ended: list[Run] = []
    try:
        try_all(
            [
                ("bench made safe", bench.stop),
                ("run finished", lambda: ended.append(writer.finish(reason, text))),
            ]
        )
    except StepsFailedError as failure:
        first, *others = (problem for _, problem in failure.failures)
        if error is None:
            for other in others:
                note_failures(first, other)
            first.add_note(_where(writer))
            raise first from None
        for problem in (first, *others):
            note_failures(error, problem)
    if error is not None:
        error.add_note(_where(writer))
    if ended:
        return ended[0]
    try:
        return Run.open(writer.path)
    except RunError:
        if error is None:
            raise
        raise error from None  # nothing hides it


def _where(writer: RunWriter) -> str:
    if not (writer.path / LOG).exists():
        return f"What was acquired was in {writer.path}, which is gone or moved."
    return f"What was acquired is in {writer.path}"
