"""The GenICam camera: its frames, through Aravis' stream."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers.aravis.features import library_error, load
from drivers.aravis.image_settings import AravisImageSettings
from drivers.common.buffered_camera import RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.common.pixels import Bytes, Pixels, unpack
from drivers.device import DriverOptions, FoundDevice, SharedPart
from drivers.errors import DeviceError

_SLICE_S = 0.05
"""A wait in the library cannot be ended from outside: it is cut into pieces of this length."""
_BLOCK_IDS = 1 << 16
"""Frame ids of GigE Vision 1 start again after this many, at 1."""


class AravisCamera(AravisImageSettings):
    """Any GenICam camera that Aravis finds: GigE Vision, USB3 Vision, and the one that Aravis makes up."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._stream: Any = None
        self._woken = threading.Event()
        self._statistics: dict[str, int] = {}
        self._line_bytes: int | None = None
        """Bytes from line to line where the camera pads lines."""

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the GenICam cameras on the network and on USB."""
        aravis = load("GenICam")
        aravis.update_device_list()
        found = []
        for i in range(aravis.get_n_devices()):
            vendor, model = aravis.get_device_vendor(i) or "", aravis.get_device_model(i) or ""
            found.append(
                FoundDevice(
                    bus="GenICam",
                    address=aravis.get_device_address(i) or aravis.get_device_id(i),
                    description=f"{vendor} {model} ({aravis.get_device_protocol(i)})",
                    vendor=vendor,
                    product=model,
                    serial_number=aravis.get_device_serial_nbr(i) or "",
                    driver="aravis",
                    kind="camera",
                    options={"device_id": aravis.get_device_id(i)},
                    note="pixel_pitch_um = (micrometres, if the camera does not say it: its data sheet does)",
                )
            )
        return tuple(found)

    @property
    def stream_statistics(self) -> Mapping[str, int]:
        """Aravis' counts of the running or last sequence: ``n_missing_packets``, ``n_resent_packets`` ..."""
        stream = self._stream
        return dict(self._statistics) if stream is None else _statistics(stream)

    # Streaming -------------------------------------------------------------------------------------
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        features, aravis, camera = self._features, self._aravis, self._camera
        self._woken.clear()
        self._apply_rate()
        with features.words("start streaming"):
            self._stream = camera.create_stream(None, None)
            if self._stream is None:
                raise DeviceError(
                    self.name, "did not open a stream.", "Is another program streaming from it?"
                )
            if camera.is_gv_device() and not self.options.packet_resend:
                self._stream.set_property("packet-resend", aravis.GvStreamPacketResend.NEVER)
            payload = camera.get_payload()
            for _ in range(n_buffers):
                self._stream.push_buffer(aravis.Buffer.new_allocate(payload))
            camera.start_acquisition()
        if camera.is_gv_device():
            return FrameNumberCounter(_BLOCK_IDS, 1)
        return FrameNumberCounter() if camera.is_uv_device() else _Underruns(self._stream)

    def _take(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._require()  # the control may have been lost meanwhile
            left_s = deadline_s - time.monotonic()
            buffer = self._stream.timeout_pop_buffer(round(max(0.0, min(left_s, _SLICE_S)) * 1e6))
            if buffer is not None:
                return self._raw(buffer)
            if left_s <= 0 or self._woken.is_set():
                return None

    def _raw(self, buffer: Any) -> RawFrame:
        complete = buffer.get_status() == self._aravis.BufferStatus.SUCCESS
        if complete:
            width, height = buffer.get_image_width(), buffer.get_image_height()
            padding, _ = buffer.get_image_padding()
            pixels = self._formats[self._format_name]
            self._line_bytes = pixels.line_bytes(width) + padding if padding else None
            complete = (height, width) == self.image_shape
        data = np.frombuffer(buffer.get_data() if complete else b"", np.uint8)
        return RawFrame(
            data=data,
            number=buffer.get_frame_id(),
            device_time_ns=buffer.get_timestamp() or None,
            complete=complete,
            buffer=buffer,
        )

    def _give_back(self, raw: RawFrame) -> None:
        self._stream.push_buffer(raw.buffer)

    def _wake(self) -> None:
        self._woken.set()

    def _end(self) -> None:
        stream, self._stream = self._stream, None
        if stream is None:
            return
        with contextlib.suppress(library_error()):  # of a camera that is gone
            self._camera.stop_acquisition()
        self._statistics = _statistics(stream)

    def _decode(self, data: Bytes, out: Pixels) -> bool:
        return unpack(data, self._formats[self._format_name].packing, out, self._line_bytes)

    def _fire(self) -> None:
        self._features.execute("TriggerSoftware")


class _Underruns(FrameNumberCounter):
    """Counts for Aravis' camera in process, which does not number the frames that found no free buffer."""

    def __init__(self, stream: Any) -> None:
        super().__init__(_BLOCK_IDS, 1)
        self._stream = stream
        self._counted: int | None = None

    def lost(self, number: int) -> int:
        underruns = int(self._stream.get_info_uint64_by_name("n_underruns"))
        before, self._counted = self._counted, underruns
        return super().lost(number) + (0 if before is None else underruns - before)


def _statistics(stream: Any) -> dict[str, int]:
    names = (stream.get_info_name(i) for i in range(stream.get_n_infos()))
    return {
        name: stream.get_info_uint64_by_name(name)
        for name in names
        if name.startswith("n_") and "ratio" not in name
    }
