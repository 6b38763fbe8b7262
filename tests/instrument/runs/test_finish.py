"""How a run ends: made safe and finished, both tried; what failed is raised or noted."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import pytest

from drivers.errors import DeviceError
from instrument.runs import finish
from instrument.runs.finish import end_run
from instrument.runs.run import FinishReason
from instrument.runs.run_files import RunError


def fail(error: BaseException) -> Any:
    return Mock(side_effect=error)


def ended(error: BaseException | None = None, stop: Any = None, end: Any = None) -> tuple[Any, Any]:
    """End a run of mocks; returns what came of it, and its writer."""
    writer = Mock(path=Path("runs/one"))
    writer.finish = end or Mock(return_value="the run")
    bench: Any = SimpleNamespace(stop=stop or Mock())
    return end_run(bench, writer, FinishReason.FAILED, error), writer


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (None, ""),
        (ValueError("too dark"), "too dark"),
        (ZeroDivisionError(), "ZeroDivisionError"),
        (KeyboardInterrupt(), ""),
        (KeyboardInterrupt("SIGTERM came"), "SIGTERM came"),
    ],
)
def test_a_run_keeps_the_words_of_what_ended_it(error: BaseException | None, text: str) -> None:
    run, writer = ended(error)
    assert run == "the run"
    writer.finish.assert_called_once_with(FinishReason.FAILED, text)
    notes = getattr(error, "__notes__", [])
    assert notes == ([] if error is None else ["What was acquired was in runs/one, which is gone or moved."])


@pytest.mark.parametrize("error", [None, ValueError("too dark")])
def test_who_asked_for_the_end_meanwhile_is_told_where_the_run_is_where_no_error_tells_it(
    error: BaseException | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = MagicMock()
    monkeypatch.setattr(finish, "interrupts_held", lambda: held)
    ended(error)
    answered = [call.args for call in held.__enter__.return_value.answer.call_args_list]
    assert answered == (
        [("What was acquired was in runs/one, which is gone or moved.",)] if error is None else []
    )


def test_without_an_error_the_first_failure_is_raised_with_the_others_and_the_place() -> None:
    end = fail(RunError(Path("runs/one"), "the disk is full."))
    with pytest.raises(DeviceError, match="did not answer") as caught:
        ended(stop=fail(DeviceError("stage", "did not answer.")), end=end)
    end.assert_called_once()
    assert [("disk is full" in note, "was acquired" in note) for note in caught.value.__notes__] == [
        (True, False),
        (False, True),
    ]


def test_with_an_error_every_failure_is_noted_on_it(monkeypatch: pytest.MonkeyPatch) -> None:
    error, end = ValueError("too dark"), fail(RunError(Path("runs/one"), "the disk is full."))
    monkeypatch.setattr(finish.Run, "open", lambda _: "what there is")
    assert ended(error, fail(DeviceError("stage", "did not answer.")), end)[0] == "what there is"
    assert [any(words in n for n in error.__notes__) for words in ("answer", "full", "acquired")] == [
        True
    ] * 3
    monkeypatch.setattr(finish.Run, "open", fail(RunError(Path("runs/one"), "is gone.")))
    with pytest.raises(ValueError, match="too dark"):
        ended(error, end=end)
