"""Devices that are not believed: what one reports is compared with what it was asked for, by any driver.

:func:`checked` makes of a driver a class whose settings, moves, patterns and frames are compared, and whose
failures of any type come as a DeviceError; the bench uses no other. What a difference may be:

====================  ==============================================================================
exposure              10 % or 0.2 ms, whichever is more: cameras count in lines and tenths of milliseconds
gain                  25 % or 0.5, whichever is more: some have steps of 2 dB
binning, format, ...  none; a region lies within the one asked for
place of an axis      what its driver lets it settle within (3 times its resolution by default), read
                       once more after the move; of a homed stage at any time, 100 times its travel
                       beyond its ends
pattern, SLM image    none
====================  ==============================================================================

A value that is no finite number is never a report. A call that sets, moves, opens or asks, or the reading of
a property, that does not come back is given up (``longest_call_s`` of the device), and its device is not used
again before it does.
"""

from __future__ import annotations

import functools
import inspect
import logging
import math
import sys
import threading
import weakref
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar, cast

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera, Roi, TriggerEdge, TriggerMode
from drivers.common.answers import CALL_MARGIN_S, STOP_ANSWER_S, is_bounded, within
from drivers.common.pixels import Pixels
from drivers.device import Device
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import LedArray, LedPattern
from drivers.sequence import PlaysSequences
from drivers.slm import Slm
from drivers.stage import Stage, StageAxis

_log = logging.getLogger(__name__)
_D = TypeVar("_D", bound=type[Device])
_T = TypeVar("_T")
_TRAVELS = 100
_ASKS = {"settings", "own_settings", "position", "commanded_position"}
_SHORT = {*_ASKS, "display", "snap", "trigger", "off", "blank", "unlock"}
"""Calls that are waited for as long as their device says, as are all that set something."""
_MOVES = {"home": 20, "move_to": 20, "move_by": 20, "wait": 20}
_LONG = {"open": 4, "arm": 20, **_MOVES}
"""Calls that have so many times as long; streams, stopping and closing have limits of their own."""
_SAFE = {"off", "blank"}
"""Tried, too, while another call hangs."""
_BEGIN = {"start_sequence", "play"}
"""Bounded by who makes them, and refused, too, while another call hangs: what undoes that would end them."""
_ENDED_BY = {"snap": "stop_sequence", **dict.fromkeys(_MOVES, "stop")}
_UNDONE_BY = {"open": "close", "set_pattern": "off", **_ENDED_BY}
"""What is done after a call that ended when it had been given up: it may have lit or moved something."""
_INTERRUPTED_S = 2.0
_LONGEST_WAIT_S = 7 * 86_400.0
"""No camera takes longer for a frame."""
_AT_ONCE = {"name", "is_open", "pattern", "displayed"}
"""Properties that no driver asks its device for: errors, what makes a bench safe and windows need them."""
_READING = "reading "
_OUTSIDE = {__name__, "drivers.common.stream"}
"""Of the drivers' modules those that use devices as others do. What a driver's own code reads of itself, in
threads of its own too, is not read in another thread, which may need a lock that the first one holds."""
_here = threading.local()
_hanging: weakref.WeakKeyDictionary[Device, list[threading.Thread]] = weakref.WeakKeyDictionary()
"""Not with the device: its attributes are its driver's."""
_REMEDY = "Its readings cannot be trusted: check the device, its firmware and its driver."


@functools.cache
def checked(driver: _D) -> _D:
    """Return a driver's class whose reports are compared, and whose errors are all DeviceErrors."""
    mixin, interface = next(
        (mixin, interface) for mixin, interface in _MIXINS.items() if issubclass(driver, interface)
    )
    plain = type(driver.__name__, (mixin, driver), {})
    itself = {"__eq__": object.__eq__, "__hash__": object.__hash__}  # a @dataclass is no other device either
    facts = {"__module__": driver.__module__, "__doc__": driver.__doc__}
    made = type(driver.__name__, (plain,), itself | facts)
    for name in dir(interface):
        member = inspect.getattr_static(plain, name)
        if name.startswith("_"):
            continue
        if inspect.isfunction(member):
            setattr(made, name, functools.wraps(member)(_guarded_call(made, name)))
        elif isinstance(member, property):
            setattr(made, name, property(_guarded_read(made, name), member.fset, doc=member.__doc__))
    return cast("_D", made)


def _guarded_call(made: type, name: str) -> Callable[..., Any]:
    def call(self: Device, *args: Any, **named: Any) -> Any:
        within_driver, _here.within_driver = _is_within_driver(), True
        try:
            return getattr(super(made, self), name)(*args, **named)
        except DeviceError:
            raise
        except Exception as error:
            raise _driver_failed(self, name, error) from error
        finally:
            _here.within_driver = within_driver

    def begins(self: Device, *args: Any, **named: Any) -> Any:
        require_ended(self)
        return call(self, *args, **named)

    if not is_timed(name):
        return begins if name in _BEGIN else call

    def bounded(self: Device, *args: Any, **named: Any) -> Any:
        if is_bounded() or _is_within_driver():
            return call(self, *args, **named)
        return _in_time(self, name, lambda: call(self, *args, **named))

    return bounded


def is_timed(name: str) -> bool:
    """Whether a call of this name is given up when it hangs; of the others, who makes them sees to it."""
    return name in _SHORT or name in _LONG or name.startswith("set_")


def call_limit_s(device: Device, name: str) -> float:
    """Return after how many seconds a call of a driver's method is given up."""
    if name == "snap":
        return cast(Camera, device).longest_wait_s + CALL_MARGIN_S
    limit_s = device.longest_call_s * _LONG.get(name, 1)
    if isinstance(device, Stage) and name in _MOVES:
        travels_s = ((axis.upper_limit - axis.lower_limit) / axis.speed_per_s for axis in device.axes)
        limit_s = max(limit_s, 3 * max(travels_s, default=0.0))
    return limit_s


def given_up(device: Device) -> list[threading.Thread]:
    """Return a device's calls that were given up; those that hang are alive."""
    return _hanging.setdefault(device, [])


def _in_time(device: Device, name: str, call: Callable[[], _T]) -> _T:
    """Return what a call of a driver returns; one that hangs is given up, and its device not used again."""
    left = given_up(device)
    if name not in _SAFE:
        require_ended(device)
    undo = getattr(device, _UNDONE_BY[name]) if name in _UNDONE_BY else None
    computed_s = device.computed_s if isinstance(device, Camera) else float
    limit_s, what = call_limit_s(device, name), name.replace("_", " ")
    try:
        return within(limit_s, device.name, what, call, undo=undo, left=left, computed_s=computed_s)
    except Exception:
        raise
    except BaseException as interruption:  # Ctrl-C: nothing moves on, or is lit late, that nobody waits for
        try:
            if name in _ENDED_BY:
                within(STOP_ANSWER_S, device.name, "stopping", getattr(device, _ENDED_BY[name]))
        except Exception as error:  # noqa: BLE001 - Ctrl-C is not taken for a failure
            interruption.add_note(str(error))
        for thread in left:
            thread.join(_INTERRUPTED_S)
        raise


def require_ended(device: Device) -> None:
    """Refuse to go on while a call that was given up, or what undoes it, has not ended.

    Raises DeviceTimeoutError, naming the call.
    """
    for thread in tuple(given_up(device)):
        if thread.is_alive():
            problem = f"still hangs: {thread.name.removeprefix(f'{device.name}: ')} has not ended."
            raise DeviceTimeoutError(device.name, problem, "Unplug it or switch it off and on.")


def _guarded_read(made: type, name: str) -> Callable[[Any], Any]:
    own = made.__module__.partition(".")[0]

    def read(self: Device) -> Any:
        within_driver, _here.within_driver = _is_within_driver(), True
        try:
            said = getattr(super(made, self), name)
        except DeviceError:
            raise
        except Exception as error:
            raise _driver_failed(self, name, error) from error
        finally:
            _here.within_driver = within_driver
        if isinstance(said, float) and not math.isfinite(said):
            raise _refuse(self, name, f"{said:g}")
        if name == "longest_wait_s" and not 0 < said <= _LONGEST_WAIT_S:
            raise _refuse(self, "how long a frame may take", f"{said:g} s")
        return said

    if name in _AT_ONCE:
        return read

    def bounded(self: Device) -> Any:
        asker = sys._getframe(1).f_globals.get("__name__", "")
        asks_itself = asker.partition(".")[0] in ("drivers", own) and asker not in _OUTSIDE
        if is_bounded() or asks_itself or _is_within_driver():
            return read(self)
        left = given_up(self)
        if any(f": {_READING}" in thread.name for thread in tuple(left)):
            require_ended(self)
        return within(self.longest_call_s, self.name, _READING + name, lambda: read(self), left=left)

    return bounded


def _is_within_driver() -> bool:
    """Return whether this thread is in a driver's call: it may hold locks that another would wait for."""
    return getattr(_here, "within_driver", False)


def _driver_failed(device: Device, name: str, error: Exception) -> DeviceError:
    """Return a mistake of a driver's as a sentence; its traceback goes to the log."""
    _log.error("%s: its driver failed in %s", device.name, name, exc_info=error)
    problem = f"its driver failed in {name}: {type(error).__name__}: {error}."
    return DeviceError(device.name, problem, "The log has the traceback, for whoever wrote the driver.")


def _refuse(device: Device, asked: str, said: object) -> DeviceError:
    return DeviceError(device.name, f"was asked for {asked} and says {said}.", _REMEDY)


def _near(device: Device, what: str, asked: float, said: float, *, share: float, least: float) -> None:
    """Refuse a number that is none, not above 0, or too far from what was asked for."""
    if not (math.isfinite(said) and said > 0 and abs(said - asked) <= max(share * abs(asked), least)):
        raise _refuse(device, f"{what} of {asked:g}", f"{said:g}")


def _same(device: Device, what: str, asked: _T, said: _T) -> _T:
    """Refuse anything but what was asked for."""
    if said != asked:
        raise _refuse(device, f"{what} of {asked}", said)
    return said


def _sound(camera: Camera, metadata: FrameMetadata, shape: tuple[int, ...]) -> None:
    """Refuse a frame whose figures are none, or that has another shape than its region and binning."""
    for what, value in (("an exposure (ms)", metadata.exposure_ms), ("a gain", metadata.gain)):
        if not (math.isfinite(value) and value > 0):
            raise _refuse(camera, f"a frame with {what}", f"{value:g}")
    _, _, height, width = metadata.roi
    expected = (height // metadata.binning, width // metadata.binning)
    if shape[:2] != expected:
        raise _refuse(camera, f"a frame of {expected} pixels", shape)


def _arrived(stage: Stage, target: Mapping[str, float], said: Mapping[str, float]) -> None:
    """Refuse places away from the target."""
    strays = {
        axis.name: said.get(axis.name, math.nan)
        for axis in stage.axes
        if axis.name in target
        and not abs(said.get(axis.name, math.nan) - target[axis.name]) <= stage.settles_within(axis)
    }
    if strays:
        wanted = ", ".join(f"{name} = {target[name]:g}" for name in strays)
        raise _refuse(stage, wanted, ", ".join(f"{name} = {place:g}" for name, place in strays.items()))


def _is_nowhere(axis: StageAxis, place: float) -> bool:
    """Return whether a place is far beyond an axis' ends, however close a user has set them."""
    far = _TRAVELS * (axis.upper_limit - axis.lower_limit)
    return not axis.lower_limit - far <= place <= axis.upper_limit + far


class _CheckedCamera(Camera):
    def set_exposure_ms(self, exposure_ms: float) -> float:
        said = super().set_exposure_ms(exposure_ms)  # type: ignore[safe-super]
        for value in (said, self.exposure_ms):
            _near(self, "an exposure (ms)", exposure_ms, value, share=0.1, least=0.2)
        return said

    def set_gain(self, gain: float) -> float:
        said = super().set_gain(gain)  # type: ignore[safe-super]
        for value in (said, self.gain):
            _near(self, "a gain", gain, value, share=0.25, least=0.5)
        return said

    def set_binning(self, binning: int) -> int:
        return _same(self, "a binning", binning, super().set_binning(binning))  # type: ignore[safe-super]

    def set_pixel_format(self, pixel_format: str) -> str:
        said = super().set_pixel_format(pixel_format)  # type: ignore[safe-super]
        return _same(self, "a pixel format", pixel_format, said)

    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        return _same(self, "a trigger mode", mode, super().set_trigger_mode(mode))  # type: ignore[safe-super]

    def set_trigger_line(self, line: str) -> str:
        return _same(self, "a trigger line", line, super().set_trigger_line(line))

    def set_trigger_edge(self, edge: TriggerEdge) -> TriggerEdge:
        return _same(self, "a trigger edge", edge, super().set_trigger_edge(edge))

    def set_roi(self, roi: Roi | None) -> Roi:
        said = super().set_roi(roi)  # type: ignore[safe-super]
        if roi is not None and not roi.contains(said):
            raise _refuse(self, f"the region {roi.as_tuple()}", said.as_tuple())
        return said

    def snap(self) -> Frame:
        frame = super().snap()  # type: ignore[safe-super]
        _sound(self, frame.metadata, frame.image.shape)
        return frame

    def next_frame(self, timeout_s: float) -> Frame:
        frame = super().next_frame(timeout_s)  # type: ignore[safe-super]
        _sound(self, frame.metadata, frame.image.shape)
        return frame

    def next_frame_into(self, buffer: Pixels, timeout_s: float) -> FrameMetadata:
        metadata = super().next_frame_into(buffer, timeout_s)
        _sound(self, metadata, buffer.shape)
        return metadata


class _CheckedStage(Stage):
    def home(self) -> None:
        super().home()  # type: ignore[safe-super]
        if not self.is_homed:
            raise _refuse(self, "homing", "that it is not homed")

    def position(self) -> dict[str, float]:
        said = super().position()  # type: ignore[safe-super]
        missing = [axis.name for axis in self.axes if not math.isfinite(said.get(axis.name, math.nan))]
        if missing:
            raise _refuse(self, "its place", f"nothing, or no number, for {', '.join(missing)}: {said}")
        if (far := [axis for axis in self.axes if _is_nowhere(axis, said[axis.name])]) and self.is_homed:
            places = ", ".join(f"{axis.name} = {said[axis.name]:g}" for axis in far)
            ranges = ", ".join(f"{axis.lower_limit:g} to {axis.upper_limit:g}" for axis in far)
            raise _refuse(self, f"its place, which is within {ranges}", places)
        return said

    def move_to(self, target: Mapping[str, float], *, wait: bool = True) -> dict[str, float]:
        said = super().move_to(target, wait=wait)  # type: ignore[safe-super]
        if wait:
            _arrived(self, target, said)
            _arrived(self, target, self.position())
        return said


def _period(device: PlaysSequences[Any], asked_ms: float, said_ms: float) -> float:
    """Refuse a sequence's period that is shorter than asked for, or far longer."""
    if not asked_ms * (1 - 1e-6) <= said_ms <= 1.5 * asked_ms + 2.0:
        raise _refuse(device, f"a sequence with a period of {asked_ms:g} ms", f"{said_ms:g} ms")
    return said_ms


class _CheckedLedArray(LedArray):
    def arm(self, patterns: Sequence[LedPattern], period_ms: float, output: int = 0) -> float:
        return _period(self, period_ms, super().arm(patterns, period_ms, output))

    def play(self) -> None:
        super().play()
        if not self.pattern.is_dark:
            raise _refuse(self, "darkness after a sequence", f"that it shows {self.pattern.description!r}")

    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        said = super().set_pattern(pattern)  # type: ignore[safe-super]
        for shown in (said, self.pattern):
            if shown.levels != pattern.levels:
                raise _refuse(self, f"the pattern {pattern.description!r}", repr(shown.description))
        return said

    def off(self) -> None:
        super().off()  # type: ignore[safe-super]
        if not self.pattern.is_dark:
            raise _refuse(self, "darkness", f"that it shows {self.pattern.description!r}")


class _CheckedSlm(Slm):
    def arm(self, patterns: Sequence[npt.NDArray[np.uint8]], period_ms: float, output: int = 0) -> float:
        return _period(self, period_ms, super().arm(patterns, period_ms, output))

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        super().display(levels)  # type: ignore[safe-super]
        if not np.array_equal(self.displayed, levels):
            raise _refuse(self, "an image", "that it shows another one")


_MIXINS: Mapping[Any, Any] = {
    _CheckedCamera: Camera,
    _CheckedStage: Stage,
    _CheckedLedArray: LedArray,
    _CheckedSlm: Slm,
}
