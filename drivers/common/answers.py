"""Waiting for a device's driver no longer than a stated time: a call that hangs is given up, and named."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import DeviceTimeoutError

T = TypeVar("T")

STOP_ANSWER_S = 10.0
"""For switching off, stopping, ending an exposure: what a sound driver does in a second or two."""

CALL_MARGIN_S = 20.0
"""Beyond what an exposure needs: connecting anew, a slow bus, a busy computer."""


def within(seconds: float, device: str, what: str, call: Callable[[], T]) -> T:
    """Return what ``call`` returns, or raise what it raises, unless it takes longer than ``seconds``.

    The call is made in a thread of its own, which is left to itself where it hangs: nothing can end it.

    Raises DeviceTimeoutError, naming the device and what it was to do.
    """
    answer: list[T] = []
    errors: list[BaseException] = []

    def run() -> None:
        try:
            answer.append(call())
        except BaseException as error:  # noqa: BLE001 - raised in the caller's thread
            errors.append(error)

    thread = threading.Thread(target=run, name=f"{device}: {what}", daemon=True)
    thread.start()
    thread.join(seconds)
    if thread.is_alive():
        raise DeviceTimeoutError(
            device,
            f"hangs: {what} has not ended for {seconds:g} s.",
            "Unplug it or switch it off and on, then start the program again.",
        )
    if errors:
        try:
            raise errors[0]
        finally:
            errors.clear()  # an error that its own traceback holds is never let go of
    return answer[0]
