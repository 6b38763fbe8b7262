"""Making a bench safe: which steps, in which order, each tried; also when the interpreter ends."""

from __future__ import annotations

import atexit
import logging
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterable
from typing import Protocol

from drivers.camera import Camera
from drivers.common.answers import STOP_ANSWER_S, within
from drivers.device import Device
from drivers.errors import DeviceLostError, DeviceNotOpenError
from drivers.led_array import LedArray
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.source_and_scene import SceneSwitch
from instrument.files.errors import BenchError

_log = logging.getLogger(__name__)

EXIT_WAIT_S = 15.0
"""Closing a bench that answers takes a second or two; a move that has to be halted first, a few more."""


class _Closes(Protocol):
    """What is closed."""

    def close(self) -> None:
        """Make safe and close."""


class ClosingAtExit:
    """Closes what is still open at the end of the interpreter, within ``EXIT_WAIT_S`` seconds altogether.

    The closing is done in a thread, so that a driver that hangs does not keep the process from ending. It is
    started with the first bench, because none can be started while the interpreter ends (Python 3.12).
    """

    def __init__(self) -> None:
        self._open: weakref.WeakSet[_Closes] = weakref.WeakSet()
        self._begin, self._done = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._thread: threading.Thread | None = None

    def watch(self, bench: _Closes) -> None:
        """Close a bench at the end, unless it is forgotten before."""
        with self._lock:
            self._open.add(bench)
            if self._thread is None:
                self._thread = threading.Thread(target=self._wait, name="closing at exit", daemon=True)
                self._thread.start()
                atexit.register(self._end)

    def forget(self, bench: _Closes) -> None:
        """Do not close a bench at the end: it was closed."""
        with self._lock:
            self._open.discard(bench)

    def _wait(self) -> None:
        self._begin.wait()
        self._close_all()
        self._done.set()

    def _close_all(self) -> None:
        for bench in list(self._open):
            try:
                bench.close()
            except Exception as failure:  # noqa: BLE001 - the next bench is closed whatever this one raised
                _log.error("%s", failure)

    def _end(self) -> None:
        if not self._open:
            return
        if self._thread is None or not self._thread.is_alive():  # a forked child has no threads of its parent
            self._close_all()
            return
        self._begin.set()
        if not self._done.wait(EXIT_WAIT_S):
            _log.error(
                "A device did not answer within %g s while the program ended; the others may not be closed. "
                "See by eye that light and motion are off.",
                EXIT_WAIT_S,
            )


_STOP_REPEAT_S, _STOP_WAIT_S = 0.005, 2.0

SafeStep = tuple[str, Callable[[], None]]
"""A step in words, e.g. ``"light off, led_array (illuminate)"``, and what does it."""

UNSAFE = "The bench may not be safe"
LIGHT_DOUBT = "The light may be on"
MOTION_DOUBT = "The stage may be moving"
_LOOK = "look, and switch its power off if so."


class StepsFailedError(BenchError):
    """Some steps of making the bench safe failed; all were tried.

    Attributes
    ----------
    failures : tuple of (str, BaseException)
        Each failed step in words, with its error.
    """

    exit_code = 1

    def __init__(self, failures: Iterable[tuple[str, BaseException]]) -> None:
        self.failures = tuple(failures)
        listed = "".join(f"\n{_line(step, error)}" for step, error in self.failures)
        super().__init__(f"{UNSAFE}. Check by eye what could not be done:{listed}")


def note_failures(error: BaseException, failure: BaseException) -> None:
    """Note on an error what failed on its way out, less what it or its notes say already.

    A step that failed with the error's own words is named without them.
    """
    if isinstance(failure, StepsFailedError):
        told = "\n".join([str(error), *getattr(error, "__notes__", ())])
        brief = [(step, _SAME if str(why) == str(error) else why) for step, why in failure.failures]
        new = [(step, why) for step, why in brief if _line(step, why) not in told]
        if new:
            error.add_note(str(StepsFailedError(new)))
    elif str(failure) not in (str(error), *getattr(error, "__notes__", ())):
        error.add_note(str(failure))


_SAME = BenchError("as above.")


def _line(step: str, error: BaseException) -> str:
    """Return a failed step's line in the words of all that failed."""
    return f"  {step}: {_without_its_name(step, error)}"


def _without_its_name(step: str, error: BaseException) -> str:
    """Return what an error says, less the device's name that the step's words end in."""
    name, _, said = str(error).partition(": ")
    return said if said and step.endswith(name) else str(error) or type(error).__name__


def safe_steps(
    led_array: LedArray | None,
    scene: SceneSwitch | None,
    stage: Stage | None,
    camera: Camera,
    slm: Slm | None,
    opened: Collection[Device],
) -> list[SafeStep]:
    """Return the steps that make a bench safe: light off, motion stopped, exposure ended, SLM blank.

    Devices that are closed by then are safe already; ``slm`` is left out where it may keep its image. An LED
    array or a stage among ``opened`` (opened by the bench and not closed by it) that is not open was lost: it
    may shine or move on, and its step fails.
    """
    steps: list[SafeStep] = []
    if led_array is not None:
        steps.append(
            (f"light off, {led_array.name}", _made_sure(led_array, led_array.off, opened, LIGHT_DOUBT))
        )
    if scene is not None:
        steps.append(("scene dark, simulated", lambda: setattr(scene, "scene_lit", False)))
    if stage is not None:
        steps.append((f"motion stopped, {stage.name}", _made_sure(stage, stage.stop, opened, MOTION_DOUBT)))
    steps.append((f"exposure ended, {camera.name}", _when_open(camera, camera.stop_sequence)))
    if slm is not None:
        steps.append((f"blank, {slm.name}", _when_open(slm, slm.blank)))
    return steps


def _when_open(device: Device, step: Callable[[], None]) -> Callable[[], None]:
    def run() -> None:
        if device.is_open:
            within(STOP_ANSWER_S, device.name, "making it safe", step)

    return run


def _made_sure(
    device: Device, step: Callable[[], None], opened: Collection[Device], doubt: str
) -> Callable[[], None]:
    """Return a step whose error says what may be going on; of a lost device it fails whatever happens."""

    def run() -> None:
        lost = not device.is_open
        if lost and device not in opened:
            return
        try:
            within(STOP_ANSWER_S, device.name, "making it safe", step)
        except Exception as error:
            if not (lost and isinstance(error, DeviceNotOpenError)):
                text = str(error) or type(error).__name__
                if doubt in text:
                    raise
                raise BenchError(f"{text} {doubt}: {_LOOK}") from error
        if lost and not device.is_open:
            raise DeviceLostError(device.name, "was lost.", f"{doubt}: {_LOOK}")

    return run


def try_all(steps: Iterable[SafeStep]) -> None:
    """Run every step in order, each even if those before it failed or were interrupted.

    Raises KeyboardInterrupt or SystemExit: the first of them that came during a step, after every step was
    tried; failures are its notes. Raises StepsFailedError when steps failed.
    """
    failures: list[tuple[str, BaseException]] = []
    interruption: BaseException | None = None
    for name, step in steps:
        try:
            step()
        except Exception as error:  # noqa: BLE001 - the next step must be tried whatever this one raised
            failures.append((name, error))
        except BaseException as error:  # noqa: BLE001 - an impatient Ctrl-C must not leave the light on
            failures.append((name, error))
            interruption = interruption or error
    if not failures:
        return
    failed = StepsFailedError(failures)
    if interruption is not None:
        interruption.add_note(str(failed))
        raise interruption
    raise failed


def stop_until(stop: Callable[[], None], ended: threading.Event, *, once: bool = False) -> None:
    """Stop again and again until what runs has ended, or for two seconds.

    Once is not enough: another thread may have been about to start a move, an exposure or a light.

    Raises StepsFailedError: the last, when a device could not be made safe; all were tried.
    """
    failure: StepsFailedError | None = None
    deadline_s = time.monotonic() + _STOP_WAIT_S
    while True:
        try:
            stop()
        except StepsFailedError as error:
            failure = error
        if once or ended.wait(_STOP_REPEAT_S) or time.monotonic() > deadline_s:
            break
    if failure is not None:
        raise failure
