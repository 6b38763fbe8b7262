"""The simulated camera: looks at the simulated world through a sensor with all its noise."""

from __future__ import annotations

import hashlib
import threading
import time
from collections import deque
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from drivers.camera import CameraNoise
from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.frame import Frame, FrameMetadata
from drivers.simulated.camera_settings import SimulatedCameraSettings
from drivers.simulated.faults import disturbed, disturbs
from drivers.simulated.look import Look
from drivers.simulated.wire import Pulse
from drivers.simulated.world import Rgb, SimulatedWorld
from recon.arrays import Float32Array
from recon.optics.sensor import FixedPattern, Readout, expose

Pixels = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class _Received(NamedTuple):
    """A pulse that starts an exposure, and what says that it was exposed."""

    pulse: Pulse
    seen: threading.Event


_LAST_LOOK_S = 5.0
_MOST_LATE_FRAMES = 4
"""So many frames a camera holds back for a host that does not fetch them; what is later than that is lost."""
_UNWANTED_S = 1.0
"""Where nothing is waited for, frames are not computed for a host that has asked for none for this long."""


class SimulatedCamera(SimulatedCameraSettings):
    """A camera whose frames are exposures of what the simulated world throws onto its sensor.

    A frame is exposed wholly after it was asked for: it sees the world as it is half way through its
    exposure. Every frame has its own noise, drawn from the world's seed, the frame's number since the camera
    was opened, the settings and what stands in front of it: the same session gives the same frames, and no
    two different photographs share their noise.
    """

    drops_counted_by = "device frame numbers"
    longest_silence_s = 120.0
    """What it sees of a new light is computed first, on a large sensor for many seconds."""
    coarse_first = False
    """Whether a light that takes seconds is computed coarsely first, for :meth:`coarse`."""
    longest_birth_s = 3600.0
    """An animal's first light takes two minutes of a processor, which others may have."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._arrived = threading.Condition(threading.RLock())
        self._abort = threading.Event()
        self._producer: threading.Thread | None = None
        self._ring: deque[Frame] = deque()
        self._reset()

    def _reset(self) -> None:
        self._reset_settings()
        self._triggers = 0
        self._pulse: _Received | None = None
        self._ready_ns = 0
        self._next_id = 0
        self._lost = 0
        self._failure: DeviceError | None = None
        self._light: tuple[Any, Float32Array] | None = None
        self._looks: list[Look] = []
        self._asked_s = 0.0
        self._coarse: tuple[Pixels, int] | None = None
        self._pattern: tuple[Any, FixedPattern] | None = None
        self._replay: tuple[Float32Array, Any, list[tuple[Pixels, float]]] | None = None

    def open(self) -> None:
        """Connect, with the camera's own default settings."""
        self.world.check_plugged(self.kind, self.name)
        if not self._is_open:
            self._reset()
            self._abort.clear()
            self._is_open = True

    def close(self) -> None:
        """End any sequence and disconnect."""
        if self._is_open:
            self._end()
            for look in self._looks:  # one that takes longer (a large sensor, a busy machine) ends by itself
                look.thread.join(timeout=_LAST_LOOK_S)
            self._is_open = False

    @property
    def longest_wait_s(self) -> float:
        """What the next frame may take: much where an animal is to be seen."""
        alive = isinstance(self.world, SimulatedWorld) and self.world.animal is not None
        return super().longest_wait_s + (self.longest_birth_s if alive else 0.0)

    def computed_s(self) -> float:
        """Return how long the light that is computed now has been computed, seconds of the processor."""
        return sum(look.computed_s() for look in self._looks)

    # Taking images ---
    def snap(self) -> Frame:
        """Take one frame whose exposure begins now, and wait for it."""
        self._require_idle("frame")
        self._abort.clear()
        if self._trigger_mode == "hardware":
            raise DeviceError(
                self.name,
                "takes no single frame in trigger mode 'hardware': nothing sends it a pulse.",
                "Set trigger mode 'free_run', or play a sequence.",
            )
        self.world.clock.wait(1e-3 * self.options.start_ms, self._abort)
        return self._take()

    def start_sequence(self, n_buffers: int = 8) -> None:
        """Start continuous acquisition into a ring of frames."""
        self._require_idle("second sequence")
        if n_buffers < 1:
            raise LimitError(self.name, f"cannot stream into {n_buffers} buffers.", "Ask for one or more.")
        self._abort.clear()
        if not self.world.clock.wait(1e-3 * self.options.start_ms, self._abort):
            raise StoppedError(self.name, "the sequence was stopped before it began.")
        with self._arrived:
            self._ring = deque(maxlen=n_buffers)
            self._asked_s = time.monotonic()
            self._triggers = 0
            self._pulse, self._ready_ns = None, 0
            self._lost = 0
            self._failure = None
            self._abort.clear()
            if self._trigger_mode == "hardware":
                self.world.wires.listen(self._trigger_line, self._trigger_edge, self._receive)
            self._producer = threading.Thread(target=self._produce, name="simulated camera", daemon=True)
            self._producer.start()

    def next_frame(self, timeout_s: float) -> Frame:
        """Return the oldest frame of the running sequence not yet fetched."""
        self._require()
        self._asked_s = time.monotonic()
        deadline = self._asked_s + timeout_s
        with self._arrived:
            while not self._ring:
                if self._failure is not None:
                    raise self._failure
                if self._producer is None:
                    raise StoppedError(self.name, "no sequence runs.", "Start one first.")
                left = deadline - time.monotonic()
                if left <= 0:
                    raise DeviceTimeoutError(
                        self.name,
                        f"no frame within {timeout_s:g} s.",
                        f"Exposure is {self._exposure_ms:g} ms, trigger mode {self._trigger_mode}.",
                    )
                self._arrived.wait(left)
            frame = self._ring.popleft()
            lost, self._lost = self._lost, 0
        return Frame(frame.image, replace(frame.metadata, dropped_before=lost))

    def trigger(self) -> None:
        """Send one software trigger."""
        self._require()
        with self._arrived:
            if self._producer is None or self._trigger_mode != "software":
                raise DeviceError(
                    self.name,
                    "takes no software trigger now.",
                    "Set trigger mode 'software' and start a sequence.",
                )
            self._triggers += 1
            self._arrived.notify_all()

    def stop_sequence(self) -> None:
        """End the running sequence or a pending snap at once."""
        self._end()

    @property
    def is_streaming(self) -> bool:
        """Whether a sequence runs."""
        return self._producer is not None

    def _end(self) -> None:
        self._abort.set()
        for look in self._looks:
            look.give_up()
        self.world.wires.deaf()
        with self._arrived:
            producer, self._producer = self._producer, None
            self._arrived.notify_all()
        if producer is not None and producer is not threading.current_thread():
            producer.join()

    # Producing frames ---
    def _produce(self) -> None:
        due = time.monotonic()
        try:
            while not self._abort.is_set():
                if self._trigger_mode == "software" and not self._await_trigger():
                    return
                received = self._await_pulse() if self._trigger_mode == "hardware" else None
                if self._trigger_mode == "hardware":
                    if received is None:
                        return
                    frame = self._take(received.pulse)
                else:
                    received, frame = None, self._take()
                with self._arrived:
                    if len(self._ring) == self._ring.maxlen:
                        self._ring.popleft()
                        self._lost += 1
                    self._ring.append(frame)
                    self._arrived.notify_all()
                if received is not None:
                    received.seen.set()
                    continue
                rate = self.options.frames_per_s or self._spec.frames_per_s
                period = max(1 / rate, self._exposure_ms * 1e-3) * self.world.clock.time_scale
                self.world.clock.skip(1 / rate - self._exposure_ms * 1e-3)
                # A camera's clock does not wait for a busy host: what was late is made up for, up to a point.
                due = max(due + period, time.monotonic() - _MOST_LATE_FRAMES * period)
                self._abort.wait(due - time.monotonic())
                while self._is_unwanted() and not self._abort.wait(0.1):
                    pass
        except StoppedError:
            return
        except DeviceError as error:
            self._failure = error
        finally:
            with self._arrived:
                if self._producer is threading.current_thread():
                    # Not stopped from outside: whoever waits for a frame must hear that none comes. An end
                    # that was asked for is no failure, also where this thread is quicker than who asked.
                    self._producer = None
                    if not self._abort.is_set():
                        ended = DeviceError(self.name, "its sequence ended by an error.", "See the log.")
                        self._failure = self._failure or ended
                self._arrived.notify_all()

    def _is_unwanted(self) -> bool:
        """Whether the next frame would be computed for nobody: a host that hangs would burn a processor."""
        hurries, is_full = self.world.clock.time_scale == 0, len(self._ring) == self._ring.maxlen
        return hurries and is_full and time.monotonic() - self._asked_s > _UNWANTED_S

    def _await_trigger(self) -> bool:
        with self._arrived:
            while self._triggers == 0:
                if self._abort.is_set():
                    return False
                self._arrived.wait(0.1)
            self._triggers -= 1
        return True

    def _await_pulse(self) -> _Received | None:
        with self._arrived:
            while self._pulse is None:
                if self._abort.is_set():
                    return None
                self._arrived.wait(0.1)
            received, self._pulse = self._pulse, None
            return received

    def _receive(self, pulse: Pulse) -> None:
        """Have a pulse start an exposure, unless one is being exposed or read out; wait until it is."""
        with self._arrived:
            if pulse.time_ns < self._ready_ns or self._producer is None:
                return
            self._ready_ns = pulse.time_ns + round(1e6 * (self._exposure_ms + self.readout_ms))
            received = self._pulse = _Received(pulse, threading.Event())
            self._arrived.notify_all()
        while not received.seen.wait(0.05):
            if self._abort.is_set() or self._producer is None:
                return

    def _light_during(self, pulse: Pulse, exposure_ms: float) -> Float32Array:
        """Return the mean light of an exposure, which what is shown may change during."""
        total = np.zeros(self.image_shape, np.float32)
        for share, show in pulse.during(1e-3 * exposure_ms):
            show()
            total += np.float32(share) * self._electrons_per_s()
        return total

    def _take(self, pulse: Pulse | None = None) -> Frame:
        """Expose, read out, and wrap one frame."""
        with self._arrived:
            exposure_ms, gain = self._exposure_ms, self._gain
            frame_id, self._next_id = self._next_id, self._next_id + 1
        half = exposure_ms * 1e-3 / 2
        if not self.world.clock.wait(half, self._abort):
            raise StoppedError(self.name, "the exposure was stopped.")
        self._require()
        light = self._electrons_per_s() if pulse is None else self._light_during(pulse, exposure_ms)
        faults = self.world.options
        if disturbs(faults):
            light = disturbed(light, faults, (faults.seed, frame_id), self.world.clock.now_s, self._binning)
        if not self.world.clock.wait(half, self._abort):
            raise StoppedError(self.name, "the exposure was stopped.")
        ended_ns = self.world.clock.ticks_ns if pulse is None else pulse.time_ns + round(1e6 * exposure_ms)
        image, saturated_fraction = self._read_out(light, exposure_ms, gain, frame_id)
        return Frame(
            image,
            FrameMetadata(
                frame_id=frame_id,
                device_time_ns=ended_ns,
                host_time_ns=time.monotonic_ns(),
                utc=self.world.clock.utc,
                exposure_ms=exposure_ms,
                gain=gain,
                pixel_format=self._pixel_format,
                significant_bits=self.significant_bits,
                black_level=self.black_level,
                roi=self._roi.as_tuple(),
                binning=self._binning,
                saturated_fraction=saturated_fraction,
            ),
        )

    def _read_out(
        self, light: Float32Array, exposure_ms: float, gain: float, frame_id: int
    ) -> tuple[Pixels, float]:
        """Return the counts of an exposure and the fraction of them at full scale."""
        if self.options.replay_frames == 0:
            return self._render(light, exposure_ms, gain, frame_id)
        key = (exposure_ms, gain, self._pixel_format, self.black_level)
        if self._replay is None or self._replay[0] is not light or self._replay[1] != key:
            rendered = [
                self._render(light, exposure_ms, gain, number) for number in range(self.options.replay_frames)
            ]
            self._replay = (light, key, rendered)
        return self._replay[2][frame_id % self.options.replay_frames]

    def _render(
        self, light: Float32Array, exposure_ms: float, gain: float, frame_id: int
    ) -> tuple[Pixels, float]:
        area = self._binning**2
        readout = Readout(
            electrons_per_count=self._spec.full_well_e / self._full_scale,
            gain=gain,
            black_level=self.black_level,
            full_scale=self._full_scale,
            full_well_e=self._spec.full_well_e * area,
            read_noise_e=self._spec.read_noise_e * self._binning,
            noise_scale=self.world.options.noise,
        )
        settings = (exposure_ms, gain, self._pixel_format, self._roi, self._binning)
        what = repr((self.world.options.seed, frame_id, self.world.light_key(), settings)).encode()
        seed = int.from_bytes(hashlib.blake2b(what, digest_size=8).digest())
        counts = expose(light, self._pixels(), exposure_ms * 1e-3, readout, seed)
        saturated_fraction = float(np.count_nonzero(counts == self._full_scale) / counts.size)
        return counts.astype(np.uint8) if self.significant_bits <= 8 else counts, saturated_fraction

    @property
    def noise(self) -> CameraNoise | None:
        """Read noise and quantisation, and the gain in counts per electron; None on a noise-free bench."""
        scale = float(self.world.options.noise)
        if scale <= 0:
            return None
        counts_per_electron = self._gain * self._full_scale / self._spec.full_well_e
        read = scale * self._spec.read_noise_e * self._binning * counts_per_electron
        return CameraNoise(float(np.hypot(read, 12**-0.5)), scale**2 * counts_per_electron)

    def _region(self) -> tuple[slice, slice]:
        """Return the binned pixels that the region of interest covers."""
        roi, factor = self._roi, self._binning
        top, left = roi.top // factor, roi.left // factor
        height, width = self.image_shape
        return slice(top, top + height), slice(left, left + width)

    def _electrons_per_s(self) -> Float32Array:
        """Photons absorbed a second by each pixel of the region, through the colour filters."""
        key = (self.world.light_key(), self._roi, self._binning)
        if self._light is not None and self._light[0] == key:
            return self._light[1]
        self._looks = [look for look in self._looks if look.thread.is_alive()]
        look = Look(partial(self._look_at, self._region(), self._binning, self._filters()))
        self._looks.append(look)
        total = None if self._abort.is_set() else look.light()
        if total is None:
            raise StoppedError(self.name, "the exposure was stopped.")
        # What changed meanwhile (another thread switched a light) must not be found under the old key later.
        unchanged = self.world.light_key() == key[0]
        self._light = (key, total) if unchanged else None
        return total

    def coarse(self) -> tuple[Pixels, int] | None:
        """Return what the frame being computed will show, coarsely, and how many pixels of it a side are one.

        It is no frame: without noise, of one colour, and not taken. None while no light is computed that
        takes seconds, and where nobody asked for it (``coarse_first``).
        """
        return self._coarse

    def awaits_light(self) -> bool:
        """Whether the next frame's light would have to be computed first: it is neither here nor on disk."""
        filters = self._filters()
        return any(self.world.awaits_light(sensitivity, self._binning) for sensitivity, _ in filters)

    def _coarsely(self, region: tuple[slice, slice], binning: int) -> tuple[Pixels, int] | None:
        efficiency = self._spec.quantum_efficiency
        weights = (0.0, efficiency[1], 0.0) if self.options.color else efficiency
        found = self.world.coarse_photons_per_s(weights, binning)
        if found is None:
            return None
        light, factor = found
        rows, columns = (slice(s.start // factor, -(-s.stop // factor)) for s in region)
        counts_per_electron = self._gain * self._full_scale / self._spec.full_well_e
        counts = light[rows, columns] * np.float32(1e-3 * self._exposure_ms * counts_per_electron / factor**2)
        counts = np.clip(np.rint(counts + self.black_level), 0, self._full_scale)
        return counts.astype(np.uint8 if self.significant_bits <= 8 else np.uint16), factor

    def _look_at(
        self,
        region: tuple[slice, slice],
        binning: int,
        filters: list[tuple[Rgb, Float32Array | None]],
    ) -> Float32Array:
        """Return the light of a region; coarsely first where somebody wants to see that."""
        self._coarse = coarse = self._coarsely(region, binning) if self.coarse_first else None
        try:
            return self._absorbed(region, binning, filters)
        finally:
            if self._coarse is coarse:  # not that of a look that began meanwhile
                self._coarse = None

    def _absorbed(
        self,
        region: tuple[slice, slice],
        binning: int,
        filters: list[tuple[Rgb, Float32Array | None]],
    ) -> Float32Array:
        rows, columns = region
        total = np.zeros((rows.stop - rows.start, columns.stop - columns.start), np.float32)
        for sensitivity, mosaic in filters:
            light = self.world.photons_per_s(sensitivity, binning)
            if light is not None:
                total += light[rows, columns] if mosaic is None else light[rows, columns] * mosaic
        return total

    def _filters(self) -> list[tuple[Rgb, Float32Array | None]]:
        """Sensitivity to the three bands of each kind of pixel, and where those are (None: everywhere)."""
        efficiency = self._spec.quantum_efficiency
        if not self.options.color:
            return [(efficiency, None)]
        filters: list[tuple[Rgb, Float32Array | None]] = []
        height, width = self.image_shape
        for color, places in enumerate((((0, 0),), ((0, 1), (1, 0)), ((1, 1),))):
            red, green, blue = (
                e * (1.0 if band == color else self.options.crosstalk) for band, e in enumerate(efficiency)
            )
            # RGGB; regions begin on an even row and column.
            mosaic = np.zeros((height, width), np.float32)
            for row, column in places:
                mosaic[row::2, column::2] = 1
            filters.append(((red, green, blue), mosaic))
        return filters

    def _pixels(self) -> FixedPattern:
        late = self.world.late_hot
        key = (self._roi, self._binning, late)
        if self._pattern is None or self._pattern[0] != key:
            pattern = self.world.fixed_pattern(late=late).binned(self._binning).cropped(*self._region())
            self._pattern = (key, pattern)
        return self._pattern[1]
