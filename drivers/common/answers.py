"""Waiting for a device's driver no longer than a stated time: a call that hangs is given up, and named."""

from __future__ import annotations

import atexit
import logging
import threading
import time
import weakref
from collections.abc import Callable
from typing import TypeVar

from drivers.errors import DeviceTimeoutError

_log = logging.getLogger(__name__)
T = TypeVar("T")

STOP_ANSWER_S = 10.0
"""For switching off, stopping, ending an exposure: what a sound driver does in a second or two."""

CALL_MARGIN_S = 20.0
"""Beyond what an exposure needs: connecting anew, a slow bus, a busy computer."""


_LOOK_S = 1.0
"""After which it is looked whether what is waited for goes on."""

EXIT_WAIT_S = 3.0
"""For calls that were given up, when the program ends."""

_given_up: weakref.WeakSet[threading.Thread] = weakref.WeakSet()
_here = threading.local()


def is_bounded() -> bool:
    """Return whether somebody waits for what this thread does no longer than a stated time."""
    return getattr(_here, "bounded", False)


class Computed:
    """Whether a device's driver went on computing what it simulates: then it is slow, and does not hang.

    Parameters
    ----------
    computed_s : callable
        How long it has computed; what never grows (real devices: 0) is waited for as if nothing were told.
    """

    def __init__(self, computed_s: Callable[[], float]) -> None:
        self._computed_s, self._seen_s = computed_s, computed_s()

    def went_on(self) -> bool:
        """Return whether it has computed since this was asked last."""
        seen_s, self._seen_s = self._seen_s, self._computed_s()
        return self._seen_s > seen_s


def _wait(over: threading.Event, seconds: float, computed: Computed) -> None:
    """Wait for an event, or until nothing was computed for so long; standing still is no time."""
    left_s = seconds
    while left_s > 0:
        look_s, began_s = min(left_s, _LOOK_S), time.monotonic()
        if over.wait(look_s):
            return
        left_s -= min(time.monotonic() - began_s, 2 * look_s)
        if computed.went_on():
            left_s = seconds


def within(
    seconds: float,
    device: str,
    what: str,
    call: Callable[[], T],
    *,
    undo: Callable[[], object] | None = None,
    left: list[threading.Thread] | None = None,
    computed_s: Callable[[], float] = float,
) -> T:
    """Return what ``call`` returns, or raise what it raises, unless it takes longer than ``seconds``.

    The call is made in a thread of its own, which is left to itself where it hangs: nothing can end it. When
    it ends after all, or was interrupted by Ctrl-C, nobody wants what it did: ``undo`` is called after it.
    Such a thread is put into ``left``. One that had not begun by then does not begin. While ``computed_s``
    grows (of a simulated camera: see :meth:`drivers.camera.Camera.computed_s`) the time begins anew.

    Raises DeviceTimeoutError, naming the device and what it was to do.
    """
    answer: list[T] = []
    errors: list[BaseException] = []
    deciding, over = threading.Lock(), threading.Event()
    begun = given_up = False
    kept = [] if left is None else left

    def begins() -> bool:
        """Return whether the call was not given up before it could begin."""
        nonlocal begun
        with deciding:
            begun = not given_up
        return begun

    def run() -> None:
        if not begins():
            return
        _here.bounded = True
        try:
            answer.append(call())
        except BaseException as error:  # noqa: BLE001 - raised in the caller's thread
            errors.append(error)
        with deciding:
            over.set()
        if given_up:
            undone()

    def undone() -> None:
        try:
            if undo is not None:
                undo()
        except Exception as error:  # noqa: BLE001 - whoever gave the call up has said so
            _log.error("%s: after %s, which was given up: %s", device, what, error)

    def give_up() -> bool:
        """Return whether the call has not ended."""
        nonlocal given_up
        with deciding:
            given_up = not over.is_set()
            if begun and given_up:
                _given_up.add(thread)
                kept.append(thread)
        return given_up

    thread = threading.Thread(target=run, name=f"{device}: {what}", daemon=True)
    try:
        thread.start()
        _wait(over, seconds, Computed(computed_s))
    except BaseException:  # Ctrl-C
        if not give_up():
            undone()
        raise
    if give_up():
        raise DeviceTimeoutError(
            device,
            f"hangs: {what} has not ended for {seconds:.4g} s.",
            "Unplug it or switch it off and on, then start the program again.",
        )
    if errors:
        try:
            raise errors[0]
        finally:
            errors.clear()  # an error that its own traceback holds is never let go of
    return answer[0]


@atexit.register
def _wait_for_given_up() -> None:
    """Wait a little: foreign code that comes back while Python ends has the process end by an abort."""
    until_s = time.monotonic() + EXIT_WAIT_S
    for thread in list(_given_up):
        if thread.is_alive():
            thread.join(max(0.0, until_s - time.monotonic()))
