"""A camera on another computer: its frames come as fast as they are taken, no further ahead than a window."""

from __future__ import annotations

import asyncio
import contextlib
import json
import threading
import time
from collections import deque
from typing import TYPE_CHECKING, Any

from drivers.camera import Camera
from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.frame import Frame
from drivers.remote.device import RemoteDevice, filled_in
from drivers.remote.wire import Assembly, load_error

if TYPE_CHECKING:
    import aiohttp

_WINDOW = 4
"""Frames under way at most, of those that a sequence buffers: the others wait on the server, and are lost and
counted there when nobody fetches them."""


@filled_in
class RemoteCamera(RemoteDevice, Camera):
    """A camera that another computer serves."""

    kind = "camera"

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._arrived = threading.Condition()
        self._ring: deque[Frame] = deque()
        self._stream: aiohttp.ClientWebSocketResponse | None = None
        self._ended: DeviceError | None = None
        self._link.on_failure = self._notice

    def _notice(self) -> None:
        with self._arrived:
            self._stream = None
            self._arrived.notify_all()

    def close(self) -> None:
        """End any sequence, and have the server close the camera."""
        self._leave()
        super().close()

    # Sequences -----------------------------------------------------------------------------------
    def start_sequence(self, n_buffers: int = 8) -> None:
        """Start continuous acquisition into ``n_buffers`` frames, most of them on the server."""
        self._link.require()
        if self._stream is not None:
            raise DeviceError(self.name, "streams: no second sequence now.", "Stop the sequence first.")
        if n_buffers < 1:
            raise LimitError(self.name, f"cannot stream into {n_buffers} buffers.", "Ask for one or more.")
        window = min(_WINDOW, max(1, n_buffers // 2))
        stream = self._link.run(self._link.frames(max(1, n_buffers - window), window))
        with self._arrived:
            self._ring.clear()
            self._ended = None
            self._stream = stream
        self._link.begin(self._receive(stream))

    async def _receive(self, stream: aiohttp.ClientWebSocketResponse) -> None:
        """Put frames into the ring in their order, whatever the order in which they come."""
        import aiohttp

        assembly = Assembly()
        ended: DeviceError | None = None
        async for message in stream:
            if message.type is aiohttp.WSMsgType.BINARY:
                try:
                    for frame in assembly.add(message.data):
                        self._put(stream, frame)
                except ValueError as error:
                    await _left(stream)
                    ended = await self._link.broke("a sequence", str(error))
                    break
            elif message.type is aiohttp.WSMsgType.TEXT and "error" in (said := json.loads(message.data)):
                ended = load_error(self.name, said["error"])
        if ended is None and self._stream is stream:
            ended = await self._link.broke("a sequence", "its frames' connection ended")
        with self._arrived:
            if self._stream is stream:
                self._stream, self._ended = None, ended
            self._arrived.notify_all()

    def _put(self, stream: aiohttp.ClientWebSocketResponse, frame: Frame) -> None:
        with self._arrived:
            if self._stream is stream:
                self._ring.append(frame)
                self._arrived.notify_all()

    def next_frame(self, timeout_s: float) -> Frame:
        """Return the oldest frame of the running sequence not yet fetched."""
        deadline_s = time.monotonic() + timeout_s
        with self._arrived:
            while not self._ring:
                self._link.require()
                if self._stream is None:
                    raise self._ended or StoppedError(self.name, "no sequence runs.", "Start one first.")
                left_s = deadline_s - time.monotonic()
                if left_s <= 0:
                    raise DeviceTimeoutError(
                        self.name, f"no frame within {timeout_s:g} s.", "Does it wait for a trigger?"
                    )
                self._arrived.wait(left_s)
            frame, stream = self._ring.popleft(), self._stream
        if stream is not None:
            self._link.begin(_grant(stream))
        return frame

    def stop_sequence(self) -> None:
        """End the running sequence or a pending snap at once."""
        self._leave()
        if self._link.is_held:
            self._ask("stop_sequence")

    def _leave(self) -> None:
        with self._arrived:
            stream, self._stream = self._stream, None
            self._ring.clear()
            self._ended = None
            self._arrived.notify_all()
        if stream is not None:
            self._link.begin(_left(stream))

    @property
    def is_streaming(self) -> bool:
        """Whether a sequence runs."""
        return self._stream is not None


async def _grant(stream: aiohttp.ClientWebSocketResponse) -> None:
    """Let the server send one frame more."""
    with contextlib.suppress(ConnectionError):
        await stream.send_str("1")


async def _left(stream: aiohttp.ClientWebSocketResponse) -> Any:
    """End a sequence's connection; the server may be gone."""
    with contextlib.suppress(ConnectionError, asyncio.TimeoutError):
        await stream.close()
