"""Single keys pressed while a long command runs."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios
import threading
import tty
from collections.abc import Callable, Iterator, Mapping


@contextlib.contextmanager
def keys(actions: Mapping[str, Callable[[], None]]) -> Iterator[None]:
    """Call an action when its key is pressed; does nothing where stdin is no terminal.

    The actions are called in a thread of their own. Ctrl-C keeps its meaning.
    """
    if not sys.stdin.isatty():
        yield
        return
    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    done = threading.Event()

    def watch() -> None:
        while not done.is_set():
            ready, _, _ = select.select([handle], [], [], 0.1)
            if not ready:
                continue
            # Past Python's buffer, in which further keys would wait unseen by select.
            pressed = os.read(handle, 1).decode("latin-1").lower()
            if not pressed:  # the terminal is gone
                return
            if pressed in actions:
                actions[pressed]()

    thread = threading.Thread(target=watch, name="keys", daemon=True)
    try:
        tty.setcbreak(handle)
        thread.start()
        yield
    finally:
        done.set()
        thread.join()
        termios.tcsetattr(handle, termios.TCSADRAIN, before)
