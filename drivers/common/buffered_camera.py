"""What cameras that fill a queue of buffers have in common: snaps, sequences, the count of lost frames."""

from __future__ import annotations

import logging
import threading
import time
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from typing import Any, ClassVar

import numpy as np

from drivers.camera import Roi, TriggerMode
from drivers.common.camera_settings import KeptSettings
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels
from drivers.errors import (
    DeviceError,
    DeviceLostError,
    DeviceNotOpenError,
    DeviceTimeoutError,
    LimitError,
    StoppedError,
)
from drivers.frame import Frame, FrameMetadata

_log = logging.getLogger(__name__)
_START_S = 3.0
"""What a camera may take from a start to its first exposure: USB cameras power their sensor up."""
_SNAP_BUFFERS = 4
_MISNUMBERED = 3
"""Frames in a row whose numbers do not rise: then the device does not number its frames."""


@dataclass(frozen=True, slots=True)
class RawFrame:
    """A buffer that the device has filled.

    Attributes
    ----------
    data : ndarray
        (n,) uint8, valid until the buffer is given back.
    number : int
        The device's number of the frame.
    device_time_ns : int or None
        By the device's clock.
    complete : bool
        Whether all of it arrived.
    buffer : object
        What the driver needs to give it back.
    facts : mapping
        Further fields of :class:`~drivers.frame.FrameMetadata`, by name, that the device sent with the frame.
    """

    data: Bytes
    number: int
    device_time_ns: int | None
    complete: bool
    buffer: object
    facts: Mapping[str, Any] = field(default_factory=dict)


@dataclass(slots=True)
class _Run:
    """A running sequence, or a snap, and what its frames are."""

    snapping: bool
    counter: FrameNumberCounter | None
    shape: tuple[int, ...]
    dtype: np.dtype[np.uint8] | np.dtype[np.uint16]
    pixel_format: str
    significant_bits: int
    black_level: float
    roi: tuple[int, int, int, int]
    binning: int
    stopping: bool = False
    begun: bool = False
    """Whether the counter has seen a number."""
    lost_first: int = 0
    """Frames that are known to be lost before the first whole one."""
    incomplete: int = 0
    misnumbered: int = 0


class BufferedCamera(KeptSettings):
    """A camera whose driver waits for full buffers and gives them back.

    The frames wait in the device's own queue: when nobody fetches them, those in the queue stay and those
    after them are lost, and counted by the device's frame numbers. Frames that arrived incomplete are not
    handed out; they count as lost.

    Subclasses give the settings and the ``_...`` methods below.
    """

    drops_counted_by = "device frame numbers"
    kind: ClassVar[str] = "camera"

    def __init__(self) -> None:
        super().__init__()
        self._fetching = threading.RLock()
        self._run: _Run | None = None
        self._next_id = 0
        self._lost: DeviceLostError | None = None
        self._incomplete = 0

    # What a driver gives --------------------------------------------------------------------------
    @abstractmethod
    def _connect(self) -> None:
        """Find the device, bring it to a safe state."""

    @abstractmethod
    def _disconnect(self) -> None:
        """Let go of the device, whatever state it is in; must not raise because it is gone."""

    @property
    @abstractmethod
    def _connected(self) -> bool: ...

    @abstractmethod
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        """Queue buffers, start; returns what counts lost frames, None when each is asked for."""

    @abstractmethod
    def _take(self, timeout_s: float) -> RawFrame | None:
        """Wait for a full buffer; None when ``timeout_s`` is over or after ``_wake``."""

    @abstractmethod
    def _give_back(self, raw: RawFrame) -> None:
        """Queue the buffer again."""

    @abstractmethod
    def _wake(self) -> None:
        """End a wait in ``_take`` soon, from another thread."""

    @abstractmethod
    def _end(self) -> None:
        """Stop and free the buffers; must not raise because the device is gone."""

    @abstractmethod
    def _decode(self, data: Bytes, out: Pixels) -> bool:
        """Write a buffer's pixels into an image; False when the bytes are damaged."""

    @abstractmethod
    def _fire(self) -> None:
        """Send one software trigger."""

    @property
    @abstractmethod
    def _period_s(self) -> float:
        """Time from frame to frame as the device is set, seconds."""

    def _asked_for(self, raw: RawFrame) -> bool:
        """Whether a frame is one that a trigger asked for."""
        return True

    frames_to_skip = 0
    """Frames at the start of a snap that may still show older settings."""

    # Opening and closing --------------------------------------------------------------------------
    @property
    def is_open(self) -> bool:
        """Whether the device is connected and has not been lost."""
        return self._connected and self._lost is None

    def open(self) -> None:
        """Connect, bring the camera to its safe state, and bring back what was set before.

        Raises DeviceError when it is missing or busy, or does not take back its settings.
        """
        if self.is_open:
            return
        self.close()
        self._lost = None
        self._connect()
        try:
            self._bring_back()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End any sequence and disconnect."""
        self.stop_sequence()
        with self._fetching:
            if self._connected:
                self._disconnect()
            self._lost = None

    def _require(self) -> None:
        if self._lost is not None:
            raise self._lost_again()
        if not self._connected:
            raise DeviceNotOpenError(self.name)

    def _require_idle(self, what: str) -> None:
        self._require()
        if self._run is not None:
            raise DeviceError(self.name, f"streams: no new {what} now.", "Stop the sequence first.")

    def _note_lost(self, error: DeviceLostError) -> None:
        """Take note that the device is gone: all but ``open`` and ``close`` raise ``error`` from now on."""
        self._lost = error
        # Without its traceback, which would hold on to the mapped buffer that was being looked at.
        self._lost = self._lost_again()

    def _lost_again(self) -> DeviceLostError:
        assert self._lost is not None
        return DeviceLostError(self._lost.device, self._lost.problem, self._lost.remedy)

    # Taking images --------------------------------------------------------------------------------
    @property
    def is_streaming(self) -> bool:
        """Whether a sequence runs."""
        run = self._run
        return run is not None and not run.snapping

    @property
    def incomplete_frames(self) -> int:
        """Frames since the last opening that arrived damaged or in part; they count as lost, too."""
        return self._incomplete

    @property
    def longest_wait_s(self) -> float:
        """What powering up and frames that are skipped may take, at the rate and exposure that are set."""
        frames = 3 + self.frames_to_skip
        frame_s = max(self._period_s, self.exposure_ms / 1e3)
        return max(_START_S, self.longest_silence_s) + frames * frame_s

    def snap(self) -> Frame:
        """Take one frame whose exposure begins after this call, and wait for it."""
        self._require_idle("frame")
        skip = self.frames_to_skip if self.trigger_mode == "free_run" else 0
        run = self._start(_SNAP_BUFFERS, snapping=True)
        try:
            deadline_s = time.monotonic() + self.longest_wait_s
            if self.trigger_mode == "software":
                self._fire()
            image = np.empty(run.shape, run.dtype)
            first_id = self._next_id
            for _ in range(skip + 1):
                metadata = self._next_into(run, image, deadline_s - time.monotonic())
            # Frames let go, or lost before the one that was asked for, were not asked for: they do not count.
            self._next_id = first_id + 1
            return Frame(image, replace(metadata, frame_id=first_id, dropped_before=0))
        finally:
            self._stop(run)

    def start_sequence(self, n_buffers: int = 8) -> None:
        """Start continuous acquisition into ``n_buffers`` buffers."""
        self._require_idle("second sequence")
        if n_buffers < 1:
            raise LimitError(self.name, f"cannot stream into {n_buffers} buffers.", "Ask for one or more.")
        self._start(n_buffers, snapping=False)

    def next_frame(self, timeout_s: float) -> Frame:
        """Return the oldest frame of the running sequence not yet fetched."""
        run = self._running()
        image = np.empty(run.shape, run.dtype)
        return Frame(image, self._next_into(run, image, timeout_s))

    def next_frame_into(self, buffer: Pixels, timeout_s: float) -> FrameMetadata:
        """Unpack the oldest frame not yet fetched into a buffer that fits it."""
        run = self._running()
        if run.shape != buffer.shape or run.dtype != buffer.dtype:
            raise DeviceError(
                self.name,
                f"sends frames {run.dtype} {run.shape}; {buffer.dtype} {buffer.shape} was expected.",
            )
        return self._next_into(run, buffer, timeout_s)

    def trigger(self) -> None:
        """Send one software trigger."""
        self._require()
        if not self.is_streaming or self.trigger_mode != "software":
            raise DeviceError(
                self.name,
                "takes no software trigger now.",
                "Set trigger mode 'software' and start a sequence.",
            )
        self._fire()

    def stop_sequence(self) -> None:
        """End the running sequence or a pending snap at once."""
        run = self._run
        if run is not None:
            self._stop(run)

    # Inside ----------------------------------------------------------------------------------------
    def _running(self) -> _Run:
        self._require()
        run = self._run
        if run is None:
            raise StoppedError(self.name, "no sequence runs.", "Start one first.")
        return run

    def _start(self, n_buffers: int, *, snapping: bool) -> _Run:
        roi: Roi = self.roi
        with self._fetching:
            run = _Run(
                snapping=snapping,
                counter=None,
                shape=self.frame_shape,
                dtype=self.frame_dtype,
                pixel_format=self.pixel_format,
                significant_bits=self.significant_bits,
                black_level=self.black_level,
                roi=roi.as_tuple(),
                binning=self.binning,
            )
            try:
                run.counter = self._begin(n_buffers)
            except BaseException:
                self._end()
                raise
            self._run = run
        return run

    def _stop(self, run: _Run) -> None:
        run.stopping = True
        self._wake()
        with self._fetching:
            if self._run is run:
                self._run = None
                self._end()

    def _next_into(self, run: _Run, image: Pixels, timeout_s: float) -> FrameMetadata:
        deadline_s = time.monotonic() + timeout_s
        with self._fetching:
            while self._run is run and not run.stopping:
                try:
                    raw = self._take(max(0.0, deadline_s - time.monotonic()))
                    metadata = None if raw is None else self._accept(raw, run, image)
                except DeviceError as error:
                    if isinstance(error, DeviceLostError):
                        self._note_lost(error)
                    self._run = None
                    self._end()
                    raise
                if metadata is not None:
                    return metadata
                if time.monotonic() >= deadline_s and not run.stopping:
                    raise self._timeout(run, timeout_s)
        self._require()
        raise StoppedError(self.name, "the sequence was stopped.")

    def _accept(self, raw: RawFrame, run: _Run, image: Pixels) -> FrameMetadata | None:
        """Turn a buffer into a frame; None when it is none that was asked for, or a damaged one."""
        host_time_ns, utc = time.monotonic_ns(), datetime.now(UTC)
        try:
            if not self._asked_for(raw):
                return None
            if not (raw.complete and self._decode(raw.data, image)):
                run.incomplete += 1
                self._incomplete += 1
                self._count_from(raw.number, run)
                return None
        finally:
            self._give_back(raw)
        lost = self._count_lost(raw.number, run)
        frame_id = self._next_id + lost
        self._next_id = frame_id + 1
        full_scale = (1 << run.significant_bits) - 1
        metadata = FrameMetadata(
            frame_id=frame_id,
            device_time_ns=raw.device_time_ns,
            host_time_ns=host_time_ns,
            utc=utc,
            exposure_ms=self.exposure_ms,
            gain=self.gain,
            pixel_format=run.pixel_format,
            significant_bits=run.significant_bits,
            black_level=run.black_level,
            roi=run.roi,
            binning=run.binning,
            dropped_before=lost,
            saturated_fraction=float(np.count_nonzero(image >= full_scale) / image.size),
        )
        return replace(metadata, **raw.facts)

    def _count_from(self, number: int, run: _Run) -> None:
        """Count from an incomplete frame on, which the first whole one comes after."""
        if run.counter is not None and not run.begun:
            run.begun = True
            run.counter.lost(number)
            run.lost_first = 1

    def _count_lost(self, number: int, run: _Run) -> int:
        if run.counter is None or run.snapping:
            return 0
        try:
            lost = run.counter.lost(number)
        except ValueError as error:
            run.misnumbered += 1
            if run.misnumbered == _MISNUMBERED:
                raise DeviceError(
                    self.name,
                    f"does not number its frames: {error}.",
                    "Lost frames could not be counted; another firmware or kernel may help.",
                ) from error
            _log.warning("%s: %s: frames lost here are not counted", self.name, error)
            return 0
        run.misnumbered, run.begun = 0, True
        lost, run.lost_first = lost + run.lost_first, 0
        return lost

    def _timeout(self, run: _Run, timeout_s: float) -> DeviceTimeoutError:
        mode: TriggerMode = self.trigger_mode
        remedy = f"Exposure is {self.exposure_ms:g} ms, trigger mode {mode}."
        if mode == "hardware":
            remedy += " Do trigger pulses come, on the line that is configured?"
        if run.incomplete:
            remedy += f" {run.incomplete} frames came damaged or in part: check the cable and the bandwidth."
        return DeviceTimeoutError(self.name, f"no frame within {timeout_s:.3g} s.", remedy)
