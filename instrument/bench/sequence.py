"""Frames timed by hardware: a device plays patterns, each sends the camera a pulse, frame k is pattern k's.

A pulse may be lost, one may come that nobody sent, one may come late. The frames' times tell: frames of a
sequence that is not whole are given up, all of them, and it is played again. None is ever taken for the frame
of another pattern.
"""

from __future__ import annotations

import hashlib
import math
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera, TriggerEdge
from drivers.common.answers import STOP_ANSWER_S, Computed, within
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import OFF, LedArray, LedPattern
from drivers.slm import Slm
from instrument.bench.safety import SafeStep, StepsFailedError, note_failures, try_all
from instrument.files.errors import BenchError
from recon.arrays import Float64Array

if TYPE_CHECKING:
    from instrument.bench.bench import Bench

Levels = npt.NDArray[np.uint8]
ATTEMPTS = 3
MOST_BYTES = 256 * 2**20
"""Memory for the frames of one sequence, which are kept until all are known to be right."""
_MARGIN = 1.02
"""Between the shortest period and the one that is played: clocks differ."""
_JITTER_MS = 0.5
"""By which a pulse may be late without the next one finding the camera busy."""
_LATE = 0.25
"""Share of the period by which a frame may be late, where its exposure leaves so much time."""
_CLOCKS = 0.01
"""Share of the period that the clocks themselves are allowed."""
_OTHER_CLOCK = 0.05
"""Share by which a source's period may be another than it said: some count their own work beside it."""
_HEAD, _FOLLOW = 9, 0.1
"""Frames that tell where the grid of times is, and how quickly it follows the frames."""
_NAMED = 5
"""Frames of a kind of fault that are named."""
_QUIET_S = 0.05
"""After a sequence, for a frame too many to come."""
_MISSING_S = 0.5
"""After a sequence, for frames that are still on their way where some have not come."""
_DARKER = 5.0
"""Standard errors by which the dark frame before a lit one must be darker."""
_EARLY = 0.1
"""Share of the first light by which the dark frames before it may differ: the room's flicker."""


@dataclass(frozen=True, slots=True)
class Wire:
    """The wire of ``[trigger]`` with the camera's line and edge as a plan may have them otherwise."""

    bench: Bench
    line: str | None = None
    edge: TriggerEdge | None = None

    @property
    def source(self) -> LedArray | Slm:
        """What plays the sequences."""
        source = self.bench.trigger_source
        if source is None:
            raise BenchError(f"{self.bench.label} has no trigger wire; see [trigger] in bench.toml.")
        return source

    @property
    def leads(self) -> int:
        """Dark patterns that an LED array shows before the first, which tell whether frames are shifted."""
        return 2 if isinstance(self.source, LedArray) else 0

    @property
    def most(self) -> int:
        """Frames that one sequence can have: what the device stores, and what memory holds."""
        limits, camera = self.source.sequence_limits, self.bench.camera
        stored = 0 if limits is None else limits.most - self.leads
        frame_bytes = int(np.prod(camera.frame_shape)) * camera.frame_dtype.itemsize
        return max(0, min(stored, MOST_BYTES // frame_bytes - self.leads))

    @property
    def period_ms(self) -> float:
        """From one pattern to the next at the camera's present exposure, milliseconds."""
        limits, camera = self.source.sequence_limits, self.bench.camera
        assert limits is not None, "opening refuses a source without"
        asked = self.bench.config.trigger.period_ms
        exposure_ms = camera.exposure_ms
        least = max(exposure_ms + max(camera.readout_ms, limits.settle_ms), limits.shortest_ms)
        if asked is not None and asked < least:
            raise BenchError(
                f"[trigger] period_ms = {asked:g}, but an exposure of {exposure_ms:g} ms with read-out and "
                f"settling needs {least:g} ms. Expose shorter, or leave period_ms out."
            )
        return asked if asked is not None else _MARGIN * least + _JITTER_MS


@dataclass(frozen=True, slots=True)
class Sequenced:
    """The frames of a sequence, and what was found wrong before it was whole."""

    frames: list[Frame]
    """One for each pattern, in order; their metadata name the pattern."""
    period_ms: float
    troubles: tuple[str, ...]
    """Of the attempts before, in words."""


def take_sequence(
    wire: Wire,
    patterns: Sequence[LedPattern] | Sequence[Levels],
    *,
    on_frame: Callable[[Frame], object] = lambda _: None,
) -> Sequenced:
    """Have the wire's source play patterns, and return the frame of each.

    Light, motion and exposure are as they are; an LED array is dark afterwards. ``on_frame`` gets each frame
    as it comes, before it is known whether the sequence is whole.

    Raises DeviceError naming the frames that are missing, extra or late when no attempt was whole; LimitError
    when the source cannot play it (nothing was shown); StoppedError when something stopped it.
    """
    source, period_ms = wire.source, wire.period_ms
    shown: Any = [*[OFF] * wire.leads, *patterns]
    period_ms = source.arm(shown, period_ms, wire.bench.config.trigger.output)
    troubles: list[str] = []
    for _ in range(ATTEMPTS):
        with _triggered(wire, len(shown)) as camera:
            frames, early = _played(camera, source, len(shown), period_ms, on_frame)
        wire.bench.require_light()
        found = _faults(frames, len(shown), wire, period_ms)
        if early:
            found.insert(0, f"{early} before the first pattern")
        if not found and wire.leads and not _lit_in_time(frames, shown):
            found = ["the frames do not light up with the first pattern that is lit, as if they were shifted"]
        if not found:
            kept = _named(wire, frames[wire.leads :], patterns)
            return Sequenced(kept, period_ms, tuple(troubles))
        troubles.append("; ".join(found))
    listed = " ".join(f"Attempt {n}: {words}." for n, words in enumerate(troubles, 1))
    if len(set(troubles)) == 1:
        listed = f"In each of {ATTEMPTS} attempts: {troubles[0]}."
    raise DeviceError(
        wire.bench.camera.name,
        f"did not take one frame for each of {len(shown)} pulses, {period_ms:g} ms apart. {listed}",
        "Check the trigger wire, trigger_line and trigger_edge of [camera], or do it step by step: "
        'timing = "stepped".',
    )


@contextmanager
def _triggered(wire: Wire, count: int) -> Iterator[Camera]:
    """Have the camera wait for pulses, and be as before at the end; what fails then hides no error before."""
    camera = wire.bench.camera
    mode, line, edge = camera.trigger_mode, camera.trigger_line, camera.trigger_edge

    def trigger_as_before() -> None:
        camera.set_trigger_mode(mode)

    as_before: list[SafeStep] = [
        ("sequence ended", camera.stop_sequence),
        ("trigger as before", trigger_as_before),
        ("trigger's input as before", partial(_listen, camera, line, edge)),
    ]
    try:
        _listen(camera, wire.line or line, wire.edge or edge)
        camera.set_trigger_mode("hardware")
        camera.start_sequence(count + 8)
        yield camera
    except BaseException as error:
        try:
            try_all(as_before)
        except StepsFailedError as failure:
            _note_each(error, failure.failures)
        raise
    try:
        try_all(as_before)
    except StepsFailedError as failure:
        (_, first), *rest = failure.failures
        _note_each(first, rest)
        raise first from None


def _note_each(error: BaseException, failures: Iterable[tuple[str, BaseException]]) -> None:
    """Note on an error each step that failed beside it; none of them leaves light or motion behind."""
    for _, problem in failures:
        note_failures(error, problem)


def _listen(camera: Camera, line: str, edge: TriggerEdge) -> None:
    """Have the hardware trigger come in on a line, by an edge of its pulses."""
    if line != camera.trigger_line:
        camera.set_trigger_line(line)
    if edge != camera.trigger_edge:
        camera.set_trigger_edge(edge)


def _played(
    camera: Camera,
    source: LedArray | Slm,
    count: int,
    period_ms: float,
    on_frame: Callable[[Frame], object],
) -> tuple[list[Frame], str]:
    """Play what is armed; returns the frames that came, and what came before the beginning, in words."""
    early = len(_waiting(camera))
    failed: list[BaseException] = []

    def play() -> None:
        try:
            source.play()
        except BaseException as error:  # noqa: BLE001 - raised below, in the caller's thread
            failed.append(error)

    player = threading.Thread(target=play, name=f"{source.name}: sequence", daemon=True)
    player.start()
    frames: list[Frame] = []
    quiet_s = max(_QUIET_S, 2e-3 * period_ms)
    silent_since_s, ended_s = time.monotonic(), math.inf
    computed = Computed(camera.computed_s)
    try:
        while True:
            try:
                frame = camera.next_frame(quiet_s)
            except DeviceTimeoutError:
                if not player.is_alive():
                    ended_s = min(ended_s, time.monotonic())
                    if failed or len(frames) >= count or time.monotonic() - ended_s > _MISSING_S:
                        break
                    continue
                if computed.went_on():
                    silent_since_s = time.monotonic()
                if time.monotonic() - silent_since_s > camera.longest_wait_s + 1e-3 * (count * period_ms):
                    raise
                continue
            silent_since_s = time.monotonic()
            on_frame(frame)
            frames.append(frame)
            if len(frames) > 2 * count:
                break
    except StoppedError:
        if not failed:
            raise
    finally:
        try:
            if player.is_alive():
                source.off() if isinstance(source, LedArray) else source.blank()
        finally:
            within(STOP_ANSWER_S, source.name, "ending its sequence", player.join)
    if failed:
        raise failed[0]
    return frames, f"{early} frame{'s' if early > 1 else ''} came" if early else ""


def _waiting(camera: Camera) -> list[Frame]:
    """Return the frames that are there already."""
    frames = []
    while True:
        try:
            frames.append(camera.next_frame(0.0))
        except DeviceTimeoutError:
            return frames


def _faults(frames: Sequence[Frame], count: int, wire: Wire, period_ms: float) -> list[str]:
    """Return in words which frames are missing, extra or late, by their times; empty of a whole sequence."""
    lost = sum(frame.metadata.dropped_before for frame in frames)
    if lost:
        return [f"{lost} of {count} frames were lost between camera and program"]
    if not frames:
        line = wire.line or wire.bench.camera.trigger_line or "the trigger input"
        return [f"no frame came on {line}"]
    times_ms, by_device = _times_ms([frame.metadata for frame in frames])
    limits = wire.source.sequence_limits
    spare_ms = period_ms - wire.bench.camera.exposure_ms - (limits.settle_ms if limits else 0.0)
    slack = min(_LATE, max(_CLOCKS, spare_ms / period_ms)) if by_device else _LATE
    on_time, late_ms, extra = _placed(times_ms, period_ms, slack)
    first = min([*on_time, *late_ms])

    def name(place: int) -> str:
        number = place - first - wire.leads + 1
        return f"pattern {number}" if number > 0 else "a dark pattern before the first"

    places = {*on_time, *late_ms}
    missing = [name(place) for place in range(first, max(places)) if place not in places]
    found = []
    if extra:
        found.append(f"no pattern asked for frames at {_some(f'{at_ms:.4g} ms' for at_ms in extra)}")
    if late_ms:
        found.append(f"late: {_some(f'{name(at)} by {ms:.3g} ms' for at, ms in late_ms.items())}")
    if missing:
        found.append(f"no frame came of {_some(missing)}")
    spanned = max(places) - first + 1
    if spanned < count:
        found.append(f"{count - spanned} of {count} frames are missing at the beginning or the end")
    elif spanned > count:
        found.append(f"{spanned - count} frames too many came at the beginning or the end")
    return found


def _some(words: Iterable[str]) -> str:
    """Return a list of words, cut where it is long."""
    every = list(words)
    more = f" and {len(every) - _NAMED} more" if len(every) > _NAMED else ""
    return ", ".join(every[:_NAMED]) + more


def _placed(
    times_ms: Float64Array, period_ms: float, slack: float
) -> tuple[set[int], dict[int, float], list[float]]:
    """Put frames to places in a grid of one period: on time, late (by ms), and those of no place (at ms).

    The grid is the one that most of the first frames are on; it follows the slow drift of one clock against
    the other.
    """
    measured_ms = float(np.median(np.diff(times_ms))) if len(times_ms) > _HEAD else period_ms
    if abs(measured_ms / period_ms - 1) < _OTHER_CLOCK:
        period_ms = measured_ms
    head = times_ms[:_HEAD]
    off_grid = (head - head[:, None]) / period_ms
    reference_ms = head[np.argmax((abs(off_grid - np.round(off_grid)) <= slack).sum(axis=1))]
    on_time: set[int] = set()
    late_ms: dict[int, float] = {}
    extra: list[float] = []
    between: list[tuple[int, float, float]] = []
    for time_ms in times_ms:
        place = (time_ms - reference_ms) / period_ms
        nearest = round(place)
        if abs(place - nearest) > slack:
            between.append((math.floor(place), (place - math.floor(place)) * period_ms, time_ms))
        elif nearest in on_time:
            extra.append(time_ms - times_ms[0])
        else:
            on_time.add(nearest)
            reference_ms += _FOLLOW * (place - nearest) * period_ms
    for place, ms, time_ms in between:
        if place in on_time or place in late_ms:
            extra.append(time_ms - times_ms[0])
        else:
            late_ms[place] = ms
    return on_time, late_ms, extra


def _times_ms(frames: Sequence[FrameMetadata]) -> tuple[Float64Array, bool]:
    """Return when frames were exposed, and whether by the camera's clock: else when they came."""
    device = [frame.device_time_ns for frame in frames]
    by_device = None not in device
    times_ns = device if by_device else [frame.host_time_ns for frame in frames]
    times_ms = np.asarray(times_ns, np.int64) / 1e6
    return times_ms, by_device


def _lit_in_time(frames: Sequence[Frame], shown: Sequence[LedPattern]) -> bool:
    """Whether the light of the first pattern that is not dark is in its frame, and not in the one before."""
    first = next((n for n, pattern in enumerate(shown) if not pattern.is_dark), None)
    if first is None:
        return True
    dark, before, lit = (frames[n].image.astype(np.float32) for n in (0, first - 1, first))
    change, early = lit - before, float((before - dark).mean())
    own = float(change.mean())
    return own > _DARKER * float(change.std()) / change.size**0.5 and early < _EARLY * own


def _named(
    wire: Wire, frames: Sequence[Frame], patterns: Sequence[LedPattern] | Sequence[Levels]
) -> list[Frame]:
    """Return frames whose metadata say what was shown, and the rest of the bench as it is."""
    around = wire.bench.with_surroundings(frames[0].metadata)
    named = []
    for frame, pattern in zip(frames, patterns, strict=True):
        if isinstance(pattern, LedPattern):
            own = replace(around, led_pattern=pattern.description)
        else:
            own = replace(around, slm_image_hash=hashlib.sha256(np.asarray(pattern).tobytes()).hexdigest())
        named.append(Frame(frame.image, frame.metadata.among(own)))
    return named
