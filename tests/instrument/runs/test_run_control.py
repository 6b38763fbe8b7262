"""What is asked of a procedure holds for the runner that goes on, for the next one, and between them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from instrument.bench.safety import StepsFailedError
from instrument.runs.run import FinishReason
from instrument.runs.run_control import EndedEarlyError, RunControl


class Listening:
    """A runner, or a bench: notes what it is told."""

    path = Path("runs/one")

    def __init__(self, *, switches: bool = True, fails: bool = False) -> None:
        self.told: list[str] = []
        self.can_switch_source = self.can_switch_scene = switches
        self._fails = fails

    def __getattr__(self, name: str) -> Callable[[], None]:
        def tell() -> None:
            self.told.append(name)
            if name == "stop" and self._fails:
                raise StepsFailedError([("light off", OSError("no answer"))])

        return tell


def made(**kind: Any) -> Any:
    return Listening(**kind)


@pytest.mark.parametrize(
    ("asked", "told", "ending"),
    [
        (["pause"], ["pause"], None),
        (["pause", "resume"], ["pause", "resume"], None),
        (["abort"], ["abort"], FinishReason.ABORTED),
        (["stop"], ["stop"], FinishReason.STOPPED),
        (["stop", "abort"], ["stop", "abort"], FinishReason.STOPPED),
        (["abort", "stop"], ["abort", "stop"], FinishReason.STOPPED),
    ],
)
def test_what_is_asked_reaches_the_runner_and_the_next_one(
    asked: list[str], told: list[str], ending: FinishReason | None
) -> None:
    control, runner, following = RunControl(), made(), made()
    assert control.run is None
    control.follow(runner)
    assert control.run == runner.path
    for name in asked:
        getattr(control, name)()
    assert runner.told == told
    assert control.ending is ending
    assert control.is_pausing == (asked == ["pause"])
    control.follow(following)
    expected = {FinishReason.ABORTED: ["abort"], FinishReason.STOPPED: ["stop"], None: []}[ending]
    assert following.told == (["pause"] if asked == ["pause"] else expected)
    if ending is None and not control.is_pausing:
        control.check()
    elif ending is not None:
        with pytest.raises(EndedEarlyError, match=f"was {ending}") as caught:
            control.check()
        assert caught.value.exit_code == 1


@pytest.mark.parametrize("switches", [True, False])
@pytest.mark.parametrize("ends", ["resume", "abort", "stop"])
def test_between_runs_a_paused_procedure_waits_in_the_dark(*, switches: bool, ends: str) -> None:
    control, bench = RunControl(), made(switches=switches)
    ended: list[BaseException | None] = []

    def work() -> None:
        try:
            with control.procedure(bench):
                begun.set()
                while not ended and not control.is_pausing:
                    time.sleep(0.001)
                control.check()
        except EndedEarlyError as error:
            ended.append(error)
        else:
            ended.append(None)

    begun = threading.Event()
    thread = threading.Thread(target=work)
    thread.start()
    assert begun.wait(10)
    control.pause()
    deadline_s = time.monotonic() + 10
    while switches and bench.told[-1:] != ["scene_off"] and time.monotonic() < deadline_s:
        time.sleep(0.001)
    time.sleep(0.02)
    assert not ended
    assert bench.told == (["source_off", "scene_off"] if switches else [])
    getattr(control, ends)()
    thread.join(10)
    assert (ended[0] is None) == (ends == "resume")
    stops = bench.told[2 if switches else 0 :]
    assert set(stops) == (set() if ends == "resume" else {"stop"})


def test_a_procedure_that_is_to_end_does_not_begin_and_the_bench_is_free_afterwards() -> None:
    control, bench = RunControl(), made()
    control.abort()
    with pytest.raises(EndedEarlyError), control.procedure(bench):
        pytest.fail("it began")
    assert bench.told == ["stop"]
    control.stop()  # of nobody's any more
    assert bench.told == ["stop"]


def test_an_error_stays_the_error_and_says_what_could_not_be_made_safe() -> None:
    control, bench, runner = RunControl(), made(fails=True), made(fails=True)
    with pytest.raises(ZeroDivisionError) as caught, control.procedure(bench):  # noqa: PT012
        control.follow(runner)
        raise ZeroDivisionError
    assert "no answer" in "".join(caught.value.__notes__)
    assert bench.told == ["stop"]
    control.pause()
    assert not runner.told, "it is nobody's any more"
    control.follow(runner)
    with pytest.raises(StepsFailedError):
        control.stop()


def test_stop_between_runs_stops_the_bench_until_the_procedure_has_let_it_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    control, bench, asked = RunControl(), made(), list[tuple[Callable[[], None], threading.Event]]()
    monkeypatch.setattr("instrument.runs.run_control.stop_until", lambda *both: asked.append(both))
    with pytest.raises(EndedEarlyError), control.procedure(bench):  # noqa: PT012
        control.stop()
        ((stop, ended),) = asked
        stop()
        assert bench.told == ["stop"]
        assert not ended.is_set()
        control.check()
    assert ended.is_set()
