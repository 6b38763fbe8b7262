"""The live picture of the page: the operator's frames, or, while nobody operates, the camera's own."""

from __future__ import annotations

import logging
import threading
import time
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from drivers.camera import Camera
from drivers.errors import DeviceError, DeviceTimeoutError
from drivers.frame import Frame
from instrument.files.errors import BenchError, percent
from instrument.live.frame_view import SATURATED, fill_indices, histogram, index_table, percentiles
from instrument.serve.operation import WATCHER, Operation
from recon.arrays import Array

_log = logging.getLogger(__name__)
_WIDEST = 1024
"""Pixels of the page's picture along its longer side, at most."""
_DARKEST, _BRIGHTEST = 0.5, 99.8
"""Per cent of the pixels below what is shown black and white."""
_DARK = 0.02
"""Of full scale: what differs by less is shown dark, and said to be."""
_RETRY_S = 1.0
_CURRENT_S = 2.0
"""A picture older than this, and three exposures, is not current."""


class Watcher:
    """Has the camera taken while somebody looks at the page and nobody operates; a thread of its own."""

    def __init__(self, operation: Operation) -> None:
        self._operation = operation
        self._lock = threading.Lock()
        self._viewers = 0
        self._thread: threading.Thread | None = None
        self._nobody = threading.Event()
        self.trouble = ""
        """Why there is no picture, in words; empty when there is one."""

    def join(self) -> None:
        """One more looks."""
        with self._lock:
            self._viewers += 1
            if self._viewers == 1:
                self._nobody = threading.Event()
                self._thread = threading.Thread(
                    target=self._watch, args=(self._nobody,), name="watching", daemon=True
                )
                self._thread.start()

    def leave(self) -> None:
        """One looks no longer; after the last one the camera is closed."""
        with self._lock:
            self._viewers -= 1
            if self._viewers == 0:
                self._nobody.set()

    def _watch(self, nobody: threading.Event) -> None:
        logged = ""
        while not nobody.is_set():
            self.trouble = ""
            if not self._is_operated():
                try:
                    self._take_frames(nobody)
                except (DeviceError, BenchError) as error:
                    self.trouble = "" if self._is_operated() else str(error)
                except Exception as error:  # noqa: BLE001 - the page says it, and the next try follows
                    self.trouble = f"The camera could not be watched: {type(error).__name__}: {error}."
                    if self.trouble != logged:  # not at every try
                        _log.exception("the camera could not be watched")
                    logged = self.trouble
            nobody.wait(_RETRY_S)

    def _is_operated(self) -> bool:
        return self._operation.operator not in (None, WATCHER)

    def _take_frames(self, nobody: threading.Event) -> None:
        camera = cast(Camera, self._operation.take("camera", WATCHER, lambda _: None))
        try:
            camera.start_sequence(4)
            while not nobody.is_set():
                try:
                    self._operation.newest_frame = camera.next_frame(0.2)
                except DeviceTimeoutError:
                    continue
                self.trouble = ""
        finally:
            self._operation.let_go("camera", WATCHER)


def picture(frame: Frame) -> tuple[dict[str, Any], bytes]:
    """Return what is to be said of a frame's picture, and the picture: JPEG, saturated pixels red.

    Counts are shown from black to white between the 0.5th and the 99.8th per cent of them; of several pixels
    that are shown as one, a saturated one shows.
    """
    image, metadata = frame.image, frame.metadata
    low, high = percentiles(histogram(image), _DARKEST, _BRIGHTEST)
    is_dark = high - low < _DARK * frame.full_scale
    high = max(high, low + _DARK * frame.full_scale)  # noise is not stretched to a picture
    table = index_table(image.dtype, low, high, frame.full_scale)
    step = -(-max(image.shape[:2]) // _WIDEST)
    channels = [image] if image.ndim == 2 else [image[..., c] for c in (2, 1, 0)]
    shown = np.stack([_indices(channel, table, step) for channel in channels], axis=-1)
    saturated = (shown == SATURATED).any(axis=-1)
    shown = np.repeat(shown, 3, axis=-1) if len(channels) == 1 else shown
    shown[saturated] = (40, 40, 255)
    _, encoded = cv2.imencode(".jpg", shown, [cv2.IMWRITE_JPEG_QUALITY, 85])
    age_s = (time.monotonic_ns() - metadata.host_time_ns) / 1e9
    said = {
        "frame": metadata.frame_id,
        "age_s": age_s,
        "current_s": _CURRENT_S + 3 * metadata.exposure_ms / 1e3,
        "words": f"{image.shape[0]} x {image.shape[1]} {metadata.pixel_format}, "
        f"{metadata.exposure_ms:g} ms, gain {metadata.gain:.3g}; counts {low:g} (black) to {high:g} (white); "
        f"{percent(metadata.saturated_fraction)} saturated"
        f"{'; dark, nothing but noise may be here' if is_dark else ''}",
    }
    return said, encoded.tobytes()


def _indices(channel: Array, table: npt.NDArray[np.uint8], step: int) -> npt.NDArray[np.uint8]:
    out = np.empty((channel.shape[0] // step, channel.shape[1] // step), np.uint8)
    fill_indices(np.ascontiguousarray(channel), table, step, out)
    return out
