"""Ctrl-C is noticed even where its exception is swallowed."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable

import pytest

from instrument.runs.interrupts import ctrl_c_remembered, interrupts_held


def in_context(work: Callable[[Callable[[], None]], None]) -> None:
    with ctrl_c_remembered() as check:
        work(check)


def swallow(_: Callable[[], None]) -> None:
    with contextlib.suppress(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


def test_it_interrupts_at_once_and_puts_the_handler_back() -> None:
    before = signal.getsignal(signal.SIGINT)
    done: list[str] = []

    def work(_: Callable[[], None]) -> None:
        signal.raise_signal(signal.SIGINT)
        done.append("went on")

    with pytest.raises(KeyboardInterrupt):
        in_context(work)
    assert not done
    assert signal.getsignal(signal.SIGINT) is before


def test_a_swallowed_interrupt_is_raised_again_by_the_next_check() -> None:
    done: list[str] = []

    def work(check: Callable[[], None]) -> None:
        swallow(check)
        done.append("went on")
        check()
        done.append("went on after the check")

    with pytest.raises(KeyboardInterrupt):
        in_context(work)
    assert done == ["went on"]


def test_a_swallowed_interrupt_is_raised_at_the_latest_at_the_end() -> None:
    with pytest.raises(KeyboardInterrupt):
        in_context(swallow)


def test_without_ctrl_c_and_in_other_threads_nothing_happens() -> None:
    in_context(lambda check: check())
    before = signal.getsignal(signal.SIGINT)
    during: list[object] = []
    thread = threading.Thread(
        target=in_context, args=(lambda _: during.append(signal.getsignal(signal.SIGINT)),)
    )
    thread.start()
    thread.join()
    assert during == [before]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_held_signals_wait_for_the_end_and_the_third_goes_through(number: int) -> None:
    def end(_number: int, _frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(number, end)
    try:
        with interrupts_held() as held:
            signal.raise_signal(number)
            signal.raise_signal(number)
        assert signal.getsignal(number) is end
        with pytest.raises(KeyboardInterrupt):
            held.answer()
        with interrupts_held():
            signal.raise_signal(number)
            signal.raise_signal(number)
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(number)
        assert signal.getsignal(number) is end
    finally:
        signal.signal(number, before)


def test_nothing_held_is_nothing_to_answer() -> None:
    with interrupts_held() as held:
        pass
    held.answer()
