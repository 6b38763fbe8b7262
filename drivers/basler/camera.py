"""The Basler camera: its frames from pylon's stream."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Any

import numpy as np
from pydantic import Field

from drivers.basler.features import (
    GIGE,
    PylonFeatures,
    find_camera,
    found_cameras,
    identity_of,
    load,
)
from drivers.common.buffered_camera import RawFrame
from drivers.common.drops import FrameNumberCounter
from drivers.device import DriverOptions, FoundDevice, SharedPart
from drivers.genicam.camera import GIGE_BLOCK_IDS, GenicamCamera, GenicamOptions

_SLICE_MS = 50
"""A wait in the library cannot be ended from outside: it is cut into pieces of this length."""
_NS_PER_S = 1_000_000_000
_TICKS = "GevTimestampTickFrequency"
"""Ticks a second of a GigE camera's clock: 125 MHz of many, 1 GHz under PTP. USB cameras count ns."""


class BaslerOptions(GenicamOptions):
    """Options of a Basler camera in ``bench.toml``."""

    serial_number: str | None = Field(
        None, min_length=1, description="Which camera; left out: the only one there is."
    )


class BaslerCamera(GenicamCamera):
    """A Basler camera through pylon: GigE, USB3, and those that pylon emulates (``PYLON_CAMEMU``)."""

    Options = BaslerOptions
    options: BaslerOptions
    _features: PylonFeatures

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = BaslerOptions.of(options)
        self._pylon: Any = None
        self._camera: Any = None
        self._woken = threading.Event()
        self._ticks_per_s = _NS_PER_S

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the camera by its serial number."""
        return (f"Basler camera {BaslerOptions.of(options).serial_number or '(the only one)'}",)

    @classmethod
    def discover(cls) -> tuple[FoundDevice, ...]:
        """Return the Basler cameras on the network and on USB."""
        return found_cameras()

    @property
    def name(self) -> str:
        """The camera as error messages name it."""
        return f"camera (basler {self.options.serial_number or 'any'})"

    @property
    def _connected(self) -> bool:
        return self._camera is not None

    def _connect(self) -> None:
        self._pylon = load(self.name)
        self._camera = find_camera(self._pylon, self.name, self.options.serial_number)
        try:
            self._features = PylonFeatures(self._camera, self.name, self._note_lost)
            self._identity = identity_of(self._camera, self._features)
            self._prepare()
        except BaseException:
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        camera, self._camera = self._camera, None
        self._features = self._images = None  # type: ignore[assignment]
        if camera is not None:
            with contextlib.suppress(Exception):  # of a camera that is gone
                camera.Close()
            camera.DestroyDevice()

    # Streaming -------------------------------------------------------------------------------------
    def _begin(self, n_buffers: int) -> FrameNumberCounter | None:
        camera = self._camera
        self._woken.clear()
        self._apply_rate()
        ticks = self._features.find(_TICKS)
        self._ticks_per_s = int(self._features.number(ticks)) if ticks else _NS_PER_S
        with self._features.words("start streaming"):
            camera.MaxNumBuffer.SetValue(max(2, n_buffers))
            camera.StartGrabbing(self._pylon.GrabStrategy_OneByOne)
        if camera.GetDeviceInfo().GetDeviceClass() == GIGE:
            return FrameNumberCounter(GIGE_BLOCK_IDS, 1)
        return FrameNumberCounter()

    def _take(self, timeout_s: float) -> RawFrame | None:
        deadline_s = time.monotonic() + timeout_s
        while True:
            self._features.raise_if_removed()
            left_ms = max(0.0, deadline_s - time.monotonic()) * 1e3
            with self._features.words("hand out a frame"):
                result = self._camera.RetrieveResult(
                    round(min(left_ms, _SLICE_MS)), self._pylon.TimeoutHandling_Return
                )
                if result.IsValid():
                    return self._raw(result)
            if left_ms <= 0 or self._woken.is_set():
                return None

    def _raw(self, result: Any) -> RawFrame:
        complete = result.GrabSucceeded() and (result.Height, result.Width) == self.image_shape
        if complete:
            self._note_padding(int(result.PaddingX))
        data = np.frombuffer(result.GetBuffer() if complete else b"", np.uint8)
        time_ns = int(result.TimeStamp) * _NS_PER_S // self._ticks_per_s
        return RawFrame(data, int(result.BlockID), time_ns or None, bool(complete), result)

    def _give_back(self, raw: RawFrame) -> None:
        raw.buffer.Release()  # type: ignore[attr-defined]

    def _wake(self) -> None:
        self._woken.set()

    def _end(self) -> None:
        if self._camera is not None:
            with contextlib.suppress(Exception):  # of a camera that is gone
                self._camera.StopGrabbing()
