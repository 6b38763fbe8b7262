"""The GenICam camera, through the Aravis library: its settings, and its frames from Aravis' stream."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from pydantic import Field

from drivers.aravis.features import (
    AravisFeatures,
    Underruns,
    find_camera,
    found_cameras,
    identity_of,
    library_error,
    load,
    stream_statistics,
)
from drivers.common.buffered_camera import RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.device import DriverOptions, FoundDevice, Setting, SharedPart
from drivers.errors import DeviceError, DeviceLostError
from drivers.genicam.camera import GIGE_BLOCK_IDS, GenicamCamera, GenicamOptions
from drivers.registry.claim import DeviceBusyError

_SLICE_S = 0.05
"""A wait in the library cannot be ended from outside: it is cut into pieces of this length."""


class AravisOptions(GenicamOptions):
    """Options of a GenICam camera in ``bench.toml``."""

    device_id: str | None = Field(
        None,
        min_length=1,
        description=(
            'Which camera: its id as "diffuserbench devices" lists it, or its network address; left out: the '
            'only one there is. "Fake_1": one that Aravis makes up.'
        ),
    )
    packet_size: int | None = Field(
        None,
        ge=220,
        le=16384,
        description="GigE Vision: bytes a packet; left out: the largest that gets through.",
    )
    packet_delay_ns: int | None = Field(
        None, ge=0, description="GigE Vision: pause between packets, nanoseconds, for busy networks."
    )
    packet_resend: bool = Field(True, description="GigE Vision: ask for lost packets again.")


class AravisCamera(GenicamCamera):
    """Any GenICam camera that Aravis finds: GigE Vision, USB3 Vision, and the one that Aravis makes up."""

    Options = AravisOptions
    options: AravisOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = AravisOptions.of(options)
        self._aravis: Any = None
        self._camera: Any = None
        self._handler = 0
        self._stream: Any = None
        self._woken = threading.Event()
        self._statistics: dict[str, int] = {}

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its configured id."""
        return (f"GenICam camera {AravisOptions.of(options).device_id or '(the only one)'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the GenICam cameras on the network and on USB."""
        return found_cameras()

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (aravis {self.options.device_id or 'any'})"

    # Opening ---------------------------------------------------------------------------------------
    @property
    def _connected(self) -> bool:
        return self._camera is not None

    def _connect(self) -> None:
        self._aravis = load(self.name)
        self._camera = find_camera(self._aravis, self.name, self.options.device_id)
        try:
            device = self._camera.get_device()
            if self._camera.is_gv_device() and not device.is_controller():
                raise DeviceBusyError(self.name, "is controlled by another program.", "Close that one.")
            self._features = AravisFeatures(self._aravis, device, self.name, self._note_lost)
            self._handler = device.connect("control-lost", self._on_control_lost)
            self._identity = identity_of(self._camera, self._features)
            self._prepare()
            if self._camera.is_gv_device():
                self._prepare_network()
        except BaseException:
            self._disconnect()
            raise

    def _prepare_network(self) -> None:
        camera, options = self._camera, self.options
        with self._features.words("agree on a packet size"):
            if options.packet_size is None:
                camera.gv_auto_packet_size()
            else:
                camera.gv_set_packet_size(options.packet_size)
            if options.packet_delay_ns is not None:
                camera.gv_set_packet_delay(options.packet_delay_ns)

    def _disconnect(self) -> None:
        camera, self._camera = self._camera, None
        if camera is not None and self._handler:
            camera.get_device().disconnect(self._handler)
        self._handler = 0
        # The last reference gives the camera's control back.
        self._features = self._images = None  # type: ignore[assignment]

    def _on_control_lost(self, _device: Any) -> None:
        self._note_lost(
            DeviceLostError(
                self.name,
                "is not controlled by this program any more: unplugged, switched off, or taken over.",
                "Check cable and power, then open it again.",
            )
        )

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings from the camera."""
        made = dict(super().settings())
        if self._camera.is_gv_device():
            with self._features.words("say its packet size"):
                made["packet_size_bytes"] = self._camera.gv_get_packet_size()
                made["packet_delay_ns"] = self._camera.gv_get_packet_delay()
        return made

    @property
    def stream_statistics(self) -> Mapping[str, int]:
        """Aravis' counts of the running or last sequence: ``n_missing_packets``, ``n_resent_packets`` ..."""
        stream = self._stream
        return dict(self._statistics) if stream is None else stream_statistics(stream)

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
            return FrameNumberCounter(GIGE_BLOCK_IDS, 1)
        return FrameNumberCounter() if camera.is_uv_device() else Underruns(self._stream, GIGE_BLOCK_IDS)

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
            self._note_padding(buffer.get_image_padding()[0])
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
        self._statistics = stream_statistics(stream)
