"""picamera2's interface over a sensor of 48 x 64 pixels, as on a Raspberry Pi 4 or 5.

Written from picamera2's and libcamera's documentation and behaviour: what the real one refuses is refused;
frames come on the clock, whether or not a buffer is free; what finds none is lost, and its number with it.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np

LINE_US = 9
"""Exposures are whole lines."""
BLACK = 1024
"""On libcamera's scale of 16 bits."""
CONTROLS = {
    "AeEnable": (False, True, None),
    "AwbEnable": (False, True, None),
    "ExposureTime": (63, 900_000, 20_000),
    "AnalogueGain": (1.0, 16.0, 1.0),
    "FrameDurationLimits": (4_000, 1_000_000, 33_333),
    "LensPosition": (0.0, 32.0, 1.0),
    "ColourGains": (0.0, 32.0, None),  # of two numbers, though their limits are one's
    "ExposureTimeMode": (0, 1, 0),
}


def counts(number: int, shape: tuple[int, int], bits: int) -> np.ndarray:
    """Return what the sensor sees in the frame of a number."""
    y, x = np.indices(shape)
    return ((3 * x + 7 * y + number) % (1 << bits)).astype(np.uint16)


def packed(image: np.ndarray, bits: int, stride: int) -> np.ndarray:
    """Lay counts out as CSI-2 does: high bytes of a group, then their low bits; lines padded."""
    n, extra = (4, 2) if bits == 10 else (2, 4)
    groups = image.reshape(image.shape[0], -1, n)
    low = np.zeros(groups.shape[:2], np.uint8)
    for place in range(n):
        low |= ((groups[..., place] & ((1 << extra) - 1)) << (extra * place)).astype(np.uint8)
    rows = np.concatenate([(groups >> extra).astype(np.uint8), low[..., None]], axis=2)
    lines = np.full((image.shape[0], stride), 0xAA, np.uint8)
    lines[:, : rows.shape[1] * rows.shape[2]] = rows.reshape(image.shape[0], -1)
    return lines.ravel()


def words(image: np.ndarray, stride: int) -> np.ndarray:
    lines = np.full((image.shape[0], stride), 0xAA, np.uint8)
    lines[:, : 2 * image.shape[1]] = np.ascontiguousarray(image, "<u2").view(np.uint8)
    return lines.ravel()


class Picamera2:
    model = 4
    order = "RGGB"
    broken_after: int | None = None
    """Frames after which no more come: a cable that was pulled."""
    opened = 0
    post_callback: Callable[[Any], None] | None = None

    @staticmethod
    def global_camera_info() -> list[dict[str, Any]]:
        return [
            {"Model": "imx000", "Location": 2, "Rotation": 180, "Id": "/base/soc/i2c0/imx000@1a", "Num": 0}
        ]

    def __init__(self, camera_num: int = 0) -> None:
        if Picamera2.opened:
            raise RuntimeError("Camera __init__ sequence did not complete.")
        Picamera2.opened += 1
        self.camera_properties = {
            "Model": "imx000",
            "UnitCellSize": (1550, 1550),
            "PixelArraySize": (64, 48),
            "ColorFilterArrangement": 0,
        }
        self.camera_controls = dict(CONTROLS)
        self._configuration: dict[str, Any] | None = None
        self._controls: dict[str, Any] = {}
        self._thread: threading.Thread | None = None
        self._stopping = threading.Event()
        self._free = 0
        self._lock = threading.Lock()
        self.stream_map = {"main": "a main stream", "raw": "a raw stream"}

    @property
    def sensor_modes(self) -> list[dict[str, Any]]:
        assert self._thread is None
        made = []
        for bits in (10, 12):
            for size, crop in (((32, 24), (0, 0, 64, 48)), ((64, 48), (0, 0, 64, 48))):
                made.append(
                    {
                        "format": f"S{self.order}{bits}_CSI2P",
                        "unpacked": f"S{self.order}{bits}",
                        "bit_depth": bits,
                        "size": size,
                        "fps": 250.0,
                        "crop_limits": crop,
                        "exposure_limits": (63, 900_000),
                    }
                )
        return made

    def create_video_configuration(
        self,
        main: Mapping[str, Any] = {},
        raw: Mapping[str, Any] = {},
        buffer_count: int = 6,
        controls: Mapping[str, Any] = {},
        display: str | None = "main",
        encode: str | None = "main",
        queue: bool = True,
    ) -> dict[str, Any]:
        if unknown := set(raw) - {"format", "size", "stride"}:
            raise ValueError(f"Bad key {unknown!r}")
        return {
            "main": {"format": "XBGR8888", "size": (1280, 720)} | dict(main),
            "raw": dict(raw),
            "buffer_count": buffer_count,
            "controls": {"FrameDurationLimits": (33_333, 33_333)} | dict(controls),
            "queue": queue,
        }

    def configure(self, config: dict[str, Any]) -> None:
        if self._thread is not None:
            raise RuntimeError("Camera must be stopped before configuring")
        raw = dict(config["raw"])
        bits = int(raw["format"].removesuffix("_CSI2P")[-2:])
        if self.model == 5:
            is_packed = raw["format"].endswith("_CSI2P")
            raw["format"] = f"{self.order}_PISP_COMP1" if is_packed else f"S{self.order}16"
        n_bytes = raw["size"][0] * 5 // 4 if bits == 10 else raw["size"][0] * 3 // 2
        raw["stride"] = -(-(n_bytes if raw["format"].endswith("P") else 2 * raw["size"][0]) // 32) * 32 + 32
        self._bits = bits
        self._configuration = dict(config, raw=raw)
        self._controls = dict(config["controls"])

    def camera_configuration(self) -> dict[str, Any]:
        assert self._configuration is not None
        return self._configuration

    def set_controls(self, controls: Mapping[str, Any]) -> None:
        for name in controls:
            if name not in CONTROLS:
                raise RuntimeError(f"Control {name} is not advertised by libcamera")
        with self._lock:
            self._controls |= controls

    def start(self) -> None:
        assert self._configuration is not None
        self._stopping.clear()
        self._free = self._configuration["buffer_count"]
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        if self._thread is not None:
            self._stopping.set()
            self._thread.join()
            self._thread = None

    def close(self) -> None:
        self.stop()
        Picamera2.opened = 0

    def _run(self) -> None:
        number = -1
        arriving = [dict(self._controls)] * 3  # settings take two frames from the request to the sensor
        while not self._stopping.is_set():
            with self._lock:
                arriving = [*arriving[1:], dict(self._controls)]
            now = arriving[0]
            exposure_us = now.get("ExposureTime", 20_000) // LINE_US * LINE_US
            self._stopping.wait(max(now["FrameDurationLimits"][0], exposure_us) / 1e6)
            number += 1
            if self.broken_after is not None and number >= self.broken_after:
                continue
            with self._lock:
                if self._free == 0 or self._stopping.is_set():
                    continue
                self._free -= 1
            request = _Request(self, number, exposure_us, now.get("AnalogueGain", 1.0))
            if self.post_callback is not None:
                self.post_callback(request)
            request.release()

    def _freed(self) -> None:
        with self._lock:
            self._free += 1


class _Request:
    def __init__(self, camera: Picamera2, number: int, exposure_us: int, gain: float) -> None:
        self._camera, self._uses = camera, 1
        self._lock = threading.Lock()
        self._said = {
            "SensorTimestamp": time.clock_gettime_ns(time.CLOCK_BOOTTIME),
            "ExposureTime": exposure_us,
            "AnalogueGain": round(gain * 16) / 16,
            "DigitalGain": 1.0,
            "SensorBlackLevels": (BLACK,) * 4,
        }
        buffer = SimpleNamespace(metadata=SimpleNamespace(sequence=number))
        self.request: Any = SimpleNamespace(buffers={camera.stream_map["raw"]: buffer})
        raw = camera.camera_configuration()["raw"]
        image = counts(number, raw["size"][::-1], camera._bits)
        if raw["format"].endswith("_CSI2P"):
            self._bytes = packed(image, camera._bits, raw["stride"])
        else:
            shift = 16 - camera._bits if raw["format"].endswith("16") else 0
            self._bytes = words(image << shift, raw["stride"])

    def acquire(self) -> None:
        with self._lock:
            assert self._uses > 0
            self._uses += 1

    def release(self) -> None:
        with self._lock:
            self._uses -= 1
            assert self._uses >= 0
            done = self._uses == 0
        if done:
            self.request = None
            self._camera._freed()

    def get_metadata(self) -> dict[str, Any]:
        assert self._uses > 0
        return dict(self._said)

    def make_buffer(self, name: str) -> np.ndarray:
        assert self._uses > 0
        assert name == "raw"
        return self._bytes.copy()
