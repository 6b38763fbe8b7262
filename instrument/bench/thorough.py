"""What only hardware can tell, measured on an open bench, one finding a line: a report to send.

Light is switched on and off and pictures are shown; axes move only where that is allowed, by little and back.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from drivers.errors import DeviceError
from drivers.led_array import OFF
from instrument.bench.bench import Bench
from instrument.bench.sequence import Wire, take_sequence
from instrument.files.errors import BenchError

_SNAPS = 10
_STREAM_S = 2.0
_PATTERNS = 12
_BRIGHTER = 5.0
"""Standard errors of the mean by which light must be more than dark."""
_SHARE, _STEPS = 0.01, 200
"""Of its range, and in steps, that an axis is moved by at most."""


@dataclass(frozen=True, slots=True)
class Finding:
    """What one test found; ``failed`` where a device did not do what it says."""

    device: str
    test: str
    words: str
    failed: bool = False

    def __str__(self) -> str:
        return f"{'FAILED' if self.failed else 'ok':<7}{self.device}: {self.test}: {self.words}"


Test = Callable[[Bench], str]


def thorough(bench: Bench, *, moves: bool = False) -> Iterator[Finding]:
    """Yield what each test finds, of every device that the bench has; the light is off afterwards.

    ``moves`` allows axes of a homed stage to move by a hundredth of their range, and back. Errors of devices
    are findings.
    """
    tests: list[tuple[str, str, Test]] = [
        ("camera", f"{_SNAPS} photographs", _snaps),
        ("camera", f"stream for {_STREAM_S:g} s", _stream),
        ("camera", "exposures", _exposures),
    ]
    if bench.led_array is not None:
        tests.append(("led_array", "light of [source]", _light))
    if bench.slm is not None:
        tests.append(("slm", "black and white", _slm))
    if bench.stage is not None:
        tests.append(("stage", "small moves", _moves if moves else _no_moves))
    if bench.trigger_source is not None:
        tests.append(("trigger", f"sequence of {_PATTERNS}", _sequence))
    for kind, name, test in tests:
        try:
            yield Finding(kind, name, test(bench))
        except (DeviceError, BenchError) as error:
            yield Finding(kind, name, str(error), failed=True)
        finally:
            if bench.led_array is not None and bench.led_array.is_open:
                bench.led_array.off()


def _timed(call: Callable[[], object], count: int) -> str:
    """Return how long calls take, in words."""
    taken_ms = []
    for _ in range(count):
        began_s = time.perf_counter()
        call()
        taken_ms.append(1e3 * (time.perf_counter() - began_s))
    return f"median {np.median(taken_ms):.3g} ms, longest {max(taken_ms):.3g} ms"


def _snaps(bench: Bench) -> str:
    camera = bench.camera
    return f"{_timed(camera.snap, _SNAPS)}, at an exposure of {camera.exposure_ms:g} ms"


def _stream(bench: Bench) -> str:
    camera, n, lost = bench.camera, 0, 0
    device_ns: list[int] = []
    with camera.stream() as stream:
        reader = stream.reader()
        until_s = time.monotonic() + _STREAM_S
        while (left_s := until_s - time.monotonic()) > 0:
            frame = reader.next_frame(left_s)
            if frame is None:
                break
            n, lost = n + 1, lost + frame.metadata.dropped_before
            if frame.metadata.device_time_ns is not None:
                device_ns.append(frame.metadata.device_time_ns)
    if n == 0:
        raise DeviceError(
            camera.name, f"sent no frame in {_STREAM_S:g} s.", "See its cable and its trigger mode."
        )
    words = f"{n / _STREAM_S:.3g} frames a second, {lost} lost (by {camera.drops_counted_by})"
    if len(device_ns) > 2:
        gaps_ms = np.diff(device_ns) / 1e6
        words += (
            f"; by its clock {np.median(gaps_ms):.4g} ms apart, {gaps_ms.min():.4g} to {gaps_ms.max():.4g}"
        )
    else:
        words += "; it has no clock of its own"
    return words


def _exposures(bench: Bench) -> str:
    """Say what becomes of exposures asked for, and of the counts; the exposure is put back."""
    camera, before = bench.camera, bench.camera.exposure_ms
    if bench.led_array is not None:
        bench.led_array.set_pattern(bench.source_pattern)
    low, high = camera.exposure_limits_ms
    found = []
    try:
        for factor in (0.5, 1.0, 2.0):
            asked = min(max(factor * before, low), high)
            made = camera.set_exposure_ms(asked)
            found.append(f"{asked:.4g} ms became {made:.4g} ms, mean {camera.snap().image.mean():.5g} counts")
    finally:
        camera.set_exposure_ms(before)
    return "; ".join(found)


def _light(bench: Bench) -> str:
    leds = bench.led_array
    assert leds is not None
    leds.off()
    before = bench.camera.snap().image.astype(np.float32)
    leds.set_pattern(bench.source_pattern)
    change = bench.camera.snap().image - before
    dark, lit = float(before.mean()), float((before + change).mean())
    if not lit - dark > _BRIGHTER * float(change.std()) / change.size**0.5:
        raise DeviceError(
            leds.name,
            f"gives no more light: mean {dark:.5g} counts dark, {lit:.5g} lit.",
            "See that it lights and reaches the camera, and [source] of bench.toml.",
        )
    return (
        f"more light: mean {dark:.5g} counts dark, {lit:.5g} lit; "
        f"switching takes {_timed(lambda: leds.set_pattern(bench.source_pattern), 5)}, "
        f"off {_timed(leds.off, 5)}"
    )


def _slm(bench: Bench) -> str:
    slm = bench.slm
    assert slm is not None
    means = []
    try:
        for level in (0, 255):
            slm.display(np.full(slm.shape, level, np.uint8))
            means.append(float(bench.camera.snap().image.mean()))
    finally:
        took = _timed(slm.blank, 3)
    return f"mean {means[0]:.5g} counts at level 0, {means[1]:.5g} at 255; a blank image takes {took}"


def _no_moves(_bench: Bench) -> str:
    return "not done: nothing moves without --move"


def _moves(bench: Bench) -> str:
    stage = bench.stage
    assert stage is not None
    if not stage.is_homed:
        return "not done: the stage is not homed, and this does not home it"
    found = []
    for axis in stage.axes:
        here = stage.position()[axis.name]
        by = min(_SHARE * (axis.upper_limit - axis.lower_limit), _STEPS * axis.resolution)
        there = here + by if here + by <= axis.upper_limit else here - by
        began_s = time.perf_counter()
        off = stage.move_to({axis.name: there})[axis.name] - there
        took_s = time.perf_counter() - began_s
        back = stage.move_to({axis.name: here})[axis.name] - here
        found.append(f"{axis.name} by {by:.4g} in {took_s:.3g} s, off by {off:.3g}, and by {back:.3g} back")
    return "; ".join(found)


def _sequence(bench: Bench) -> str:
    """Play the point source's light, or black and white, over the trigger wire."""
    wire = Wire(bench)
    if wire.leads:
        shown = [OFF if n % 3 == 2 else bench.source_pattern for n in range(_PATTERNS)]
        taken = take_sequence(wire, shown)
    else:
        assert bench.slm is not None
        taken = take_sequence(
            wire, [np.full(bench.slm.shape, 255 * (n % 2), np.uint8) for n in range(_PATTERNS)]
        )
    again = f"; taken again: {'; '.join(taken.troubles)}" if taken.troubles else ""
    return f"one frame for each pattern, {taken.period_ms:.4g} ms apart{again}"
