"""What is being compiled now, for those who wait: it happens once on a machine, and is not far from done."""

from __future__ import annotations

import sys
from typing import Any

_compiled: list[str] = []
_heard: list[Any] = []


def being_compiled() -> str | None:
    """Return the name of what numba compiles now, in any thread; None where it compiles nothing.

    Asked often, it hears of numba when that is there: nothing is imported for it.
    """
    _listen()
    now = _compiled[-1:]  # another thread ends it
    return now[0] if now else None


def _listen() -> None:
    """Hear of what numba compiles, from when it is imported on."""
    if _heard or "numba.core.event" not in sys.modules:
        return
    from numba.core import event

    class Compilations(event.Listener):
        def on_start(self, event: Any) -> None:
            _compiled.append(event.data["dispatcher"].py_func.__name__.strip("_"))

        def on_end(self, event: Any) -> None:
            del _compiled[-1:]

    _heard.append(Compilations())
    event.register("numba:compile", _heard[0])  # type: ignore[no-untyped-call]
