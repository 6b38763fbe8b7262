"""Keys pressed while a command runs, on a real (pseudo-)terminal."""

from __future__ import annotations

import io
import os
import sys
import termios
import threading
from collections.abc import Iterator

import pytest

from instrument.cli.progress import keys


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    master, slave = os.openpty()
    stdin = os.fdopen(slave, "r", closefd=False)
    monkeypatch.setattr(sys, "stdin", stdin)
    yield master, slave
    stdin.close()
    os.close(master)
    os.close(slave)


def test_each_key_does_its_own_and_others_nothing(terminal: tuple[int, int]) -> None:
    master, slave = terminal
    before = termios.tcgetattr(slave)
    pressed: list[str] = []
    done = threading.Event()
    actions = {"p": lambda: pressed.append("p"), "q": lambda: (pressed.append("q"), done.set())}
    with keys(actions):  # type: ignore[arg-type]
        os.write(master, b"pxPq")
        assert done.wait(10)
    assert pressed == ["p", "p", "q"]
    assert termios.tcgetattr(slave) == before


def test_the_terminal_is_as_before_after_an_error(terminal: tuple[int, int]) -> None:
    _, slave = terminal
    before = termios.tcgetattr(slave)

    def interrupted() -> None:
        assert termios.tcgetattr(slave) != before
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), keys({}):
        interrupted()
    assert termios.tcgetattr(slave) == before


def test_without_a_terminal_it_does_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO("q"))
    with keys({"q": lambda: pytest.fail("no terminal, no keys")}):
        pass
