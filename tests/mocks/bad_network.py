"""A network between two programs of this computer that is slow, holds back, goes silent or is cut."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any, Self


class BadNetwork:
    """Forwards connections to a port, in a thread of its own; ``port`` is where to connect instead.

    Attributes
    ----------
    bytes_per_s : float
        What each connection carries from the server at most.
    delay_s : float
        What everything takes each way.
    silent : bool
        Whether everything is swallowed while connections stay open, as with a cable that is pulled.
    held : bytes
        What a request contains that is held back, with what follows on its connection, until ``let_pass``.
    """

    def __init__(self, to_port: int) -> None:
        self.bytes_per_s = float("inf")
        self.delay_s = 0.0
        self.silent = False
        self.held = b""
        self.is_holding = threading.Event()
        self._to_port = to_port
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        self._server = self._run(asyncio.start_server(self._accept, "127.0.0.1", 0))
        self.port = self._server.sockets[0].getsockname()[1]
        self._passing = asyncio.Event()
        return self

    def __exit__(self, *_: object) -> None:
        self._run(self._end())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    def cut(self) -> None:
        """Break every connection there is; new ones are taken."""
        self._run(self._cut())

    def let_pass(self) -> None:
        """Send what is held back."""
        self._loop.call_soon_threadsafe(self._passing.set)

    async def _cut(self) -> None:
        for writer in self._writers:
            writer.transport.abort()

    async def _end(self) -> None:
        self._server.close()
        await self._cut()
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._to_port)
        self._writers |= {writer, back}
        for source, sink, to_server in ((reader, back, True), (there, writer, False)):
            on_its_way: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(256)
            for work in (
                self._depart(source, on_its_way),
                self._arrive(on_its_way, sink, to_server=to_server),
            ):
                task = asyncio.create_task(work)
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _depart(
        self, source: asyncio.StreamReader, on_its_way: asyncio.Queue[tuple[float, bytes]]
    ) -> None:
        data = b"-"
        while data:
            try:
                data = await source.read(1 << 14)
            except ConnectionError:
                data = b""
            await on_its_way.put((self._loop.time() + self.delay_s, data))

    async def _arrive(
        self, on_its_way: asyncio.Queue[tuple[float, bytes]], sink: asyncio.StreamWriter, *, to_server: bool
    ) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                due_s, data = await on_its_way.get()
                await asyncio.sleep(due_s - self._loop.time())
                if not data:
                    break
                if to_server and self.held and self.held in data:
                    self.is_holding.set()
                    await self._passing.wait()
                if not to_server:
                    await asyncio.sleep(len(data) / self.bytes_per_s)
                if not self.silent:
                    sink.write(data)
                    await sink.drain()
        if not self.silent:
            sink.close()

    def _run(self, work: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()
