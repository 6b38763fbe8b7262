"""The server: calls over HTTP, holds and frames over WebSocket (see :mod:`drivers.remote.wire`)."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import hmac
import json
import logging
import threading
import weakref
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib import resources
from typing import Any, Self, TypeVar, cast

from aiohttp import WSCloseCode, WSMsgType, web

from drivers.camera import Camera
from drivers.device import Device
from drivers.errors import DeviceError, DeviceLostError, DeviceTimeoutError, LimitError
from drivers.frame import Frame
from drivers.remote.device import said_facts
from drivers.remote.wire import (
    INTERFACES,
    LONGEST_REQUEST,
    NUMBER_HEADER,
    OPERATOR_HEADER,
    PORT,
    PROTOCOL,
    Call,
    Kind,
    calls,
    dump_error,
    pack_frame,
    pieces,
    plain,
)
from instrument.bench.config import BenchConfig
from instrument.files.errors import BenchError
from instrument.serve.operation import WATCHER, Operation, Operator
from instrument.serve.uploads import Uploads
from instrument.serve.watching import Watcher, picture

_log = logging.getLogger(__name__)
_T = TypeVar("_T")
_Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]
_FRAME_WAIT_S, _CLOSING_S, _GIVE_WAY_S = 0.2, 1.0, 0.002
_STATE_S, _PICTURE_S = 1.0, 0.1
"""How often a page hears of the state, and sees a picture, at most."""
_SHORT_BYTES = 4096
_PAGE_HEADERS = {
    "Content-Security-Policy": "default-src 'self' 'unsafe-inline'; img-src blob:; frame-ancestors 'none'",
    "Cache-Control": "no-store",
    "Referrer-Policy": "no-referrer",
}
_dumps = functools.partial(json.dumps, default=plain)


def _decoded(data: bytes) -> Any:
    """Return what JSON says; ValueError where it is none, or lists are in lists in lists without end."""
    try:
        return json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deep") from None


@dataclass(frozen=True, kw_only=True)
class Serving:
    """Where a bench is served, and for whom."""

    token: str
    host: str = "127.0.0.1"
    port: int = PORT
    lost_after_s: float = 5.0
    """An operator whose connection is silent for this long is lost, seconds."""


class BenchServer:
    """Serves a bench from threads of its own, until it is closed; a context manager.

    Parameters
    ----------
    config : BenchConfig
    serving : Serving
    say : callable
        Takes a sentence for whoever looks after the server.
    """

    def __init__(self, config: BenchConfig, serving: Serving, say: Callable[[str], None] = _log.info) -> None:
        self.operation = Operation(config, say)
        self._serving = serving
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, name="server", daemon=True)
        self._pool = ThreadPoolExecutor(64, "call")
        self._overtaking = ThreadPoolExecutor(16, "stop")
        self._watcher = Watcher(self.operation)
        self._uploads = Uploads()
        self._runner: web.AppRunner | None = None
        self._links: weakref.WeakSet[web.WebSocketResponse] = weakref.WeakSet()
        self._frames: asyncio.Task[Any] | None = None
        """Sends the frames of the newest sequence."""
        self._filmed: Camera | None = None
        """The camera whose frames these are: one that was lost before must not end them."""
        self._sequences = asyncio.Lock()
        """No sequence is started while the end of one before it is still being carried out."""
        self._overtakers = 0
        """Stops that are being carried out: meanwhile no frame is sent."""

    # Starting and ending -------------------------------------------------------------------------
    def start(self) -> Self:
        """Serve from now on.

        Raises BenchError when the address cannot be listened at.
        """
        self._thread.start()
        try:
            self._run(self._begin())
        except OSError as error:
            self._end_thread()
            raise BenchError(
                f"Nothing can be served at {self._serving.host}, port {self._serving.port}: "
                f"{error.strerror}. Name another port by --port, or an address of this computer by --host."
            ) from error
        return self

    async def _begin(self) -> None:
        app = web.Application(client_max_size=LONGEST_REQUEST, middlewares=[self._guard])
        app.add_routes(
            [
                web.get("/", self._page),
                web.get("/api/state", self._state),
                web.post("/api/stop", self._stop),
                web.get("/api/live", self._live),
                web.get("/api/devices/{kind}/hold", self._hold),
                web.post("/api/devices/{kind}/upload/{word}", self._upload),
                web.get("/api/devices/camera/frames", self._sequence),
                *(
                    web.route(verb, "/api/devices/{kind}/{name}", self._call)
                    for verb in ("GET", "POST", "PUT")
                ),
            ]
        )
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=2.0)
        app.on_shutdown.append(self._part_all)
        await self._runner.setup()
        await web.TCPSite(self._runner, self._serving.host, self._serving.port).start()

    async def _part_all(self, _app: web.Application) -> None:
        for link in set(self._links):
            await link.close(code=WSCloseCode.GOING_AWAY)

    async def _linked(self, request: web.Request, heartbeat_s: float | None = None) -> web.WebSocketResponse:
        """Return a WebSocket that is closed with the server."""
        link = web.WebSocketResponse(heartbeat=heartbeat_s, protocols=(PROTOCOL,), timeout=_CLOSING_S)
        await link.prepare(request)
        self._links.add(link)
        return link

    @property
    def url(self) -> str:
        """Where it is served, with the port that was found free when 0 was asked for."""
        assert self._runner is not None
        host, port = self._runner.addresses[0][:2]
        return f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"

    def close(self) -> None:
        """End serving: light off, motion stopped, devices closed.

        Raises StepsFailedError naming what could not be made safe; all was tried.
        """
        if not self._thread.is_alive():
            return
        try:
            lost = DeviceLostError("bench", "its server was ended.", "Start diffuserbench serve again.")
            self.operation.end(lost)
        finally:
            if self._runner is not None:
                self._run(self._runner.cleanup())
            self._end_thread()

    def _end_thread(self) -> None:
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        for pool in (self._pool, self._overtaking):
            pool.shutdown(wait=False, cancel_futures=True)

    def _run(self, work: Coroutine[Any, Any, _T]) -> _T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    # Who may ask ---------------------------------------------------------------------------------
    @web.middleware
    async def _guard(self, request: web.Request, handler: _Handler) -> web.StreamResponse:
        """Let nobody in without the token; say in JSON what went wrong."""
        if request.path.startswith("/api/") and not self._is_known(request):
            return _error(401, DeviceError("server", "needs its token.", "See where serve has put it."))
        try:
            return await handler(request)
        except web.HTTPRequestEntityTooLarge:
            problem = f"takes requests of at most {LONGEST_REQUEST >> 20} MB over the network."
            return _error(413, LimitError("server", problem, "Send less at a time."))
        except DeviceError as error:
            return _error(409, error)
        except BenchError as error:
            return _error(409, DeviceError("bench", str(error)))
        except (ValueError, KeyError) as error:
            return _error(400, DeviceError("server", f"does not understand this: {error}."))

    def _is_known(self, request: web.Request) -> bool:
        said = request.headers.get("Authorization", "").removeprefix("Bearer ")
        if not said:  # of a browser's WebSocket
            protocols = request.headers.get("Sec-WebSocket-Protocol", "")
            said = protocols.partition(",")[2].strip()
        return hmac.compare_digest(said.encode("utf-8", "surrogateescape"), self._serving.token.encode())

    @staticmethod
    def _operator(request: web.Request) -> Operator:
        key, _, words = request.headers.get(OPERATOR_HEADER, "").partition(" ")
        if not key:
            raise ValueError(f"the header {OPERATOR_HEADER} says who operates, and is missing")
        return Operator(key, words)

    async def _in_thread(self, work: Callable[..., _T], *args: Any) -> _T:
        return await self._loop.run_in_executor(self._pool, work, *args)

    # Calls ---------------------------------------------------------------------------------------
    async def _call(self, request: web.Request) -> web.StreamResponse:
        kind, name = _kind(request), request.match_info["name"]
        call = calls(kind).get(name)
        if call is None or call.verb != request.method:
            problem = f"takes no {request.method} {name}."
            return _error(404, DeviceError(kind, problem, "Both ends need the same version of the program."))
        key = self._operator(request).key
        arguments = await self._arguments(request, call, f"{key} {kind}")
        number = int(request.headers.get(NUMBER_HEADER, "0"))
        pool = self._overtaking if call.verb == "PUT" else self._pool
        self._overtakers += call.verb == "PUT"
        try:
            made = await self._loop.run_in_executor(
                pool, self.operation.make, call, kind, key, number, arguments
            )
        finally:
            self._overtakers -= call.verb == "PUT"
        if isinstance(made, Frame):
            return web.Response(body=await self._in_thread(pack_frame, made))
        said = await self._in_thread(lambda: _dumps({"value": call.gives.dump(made)}))
        return web.json_response(text=said)

    async def _upload(self, request: web.Request) -> web.StreamResponse:
        """Keep a piece of an array for the call that takes it."""
        kind, key, query = _kind(request), self._operator(request).key, request.query
        word, size, place = request.match_info["word"], int(query["size"]), int(query["place"])
        piece = await request.read()
        self.operation.device(kind, key)  # who has left meanwhile leaves nothing here
        self._uploads.add(f"{key} {kind}", word, size, place, piece)
        return web.json_response({"value": None})

    async def _arguments(self, request: web.Request, call: Call, sender: str) -> dict[str, Any]:
        """Return what a request says, decoded in another thread, so that no STOP waits for it."""
        data = await request.read() if request.can_read_body else b"{}"
        # A STOP's few bytes do not wait for the threads that it is to overtake.
        short = len(data) <= _SHORT_BYTES
        arguments = _decoded(data) if short else await self._in_thread(_decoded, data)
        if not isinstance(arguments, dict):
            raise ValueError("arguments come by name, in a JSON object")
        return self._uploads.filled_in(sender, call, arguments)

    async def _stop(self, request: web.Request) -> web.StreamResponse:
        who = f"somebody at {request.remote}"
        await self._loop.run_in_executor(self._overtaking, self.operation.stop, who)
        return web.json_response({"value": None})

    async def _state(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(await self._in_thread(self.state), dumps=_dumps)

    def state(self) -> dict[str, Any]:
        """Return what the bench is and does, as its page shows it."""
        operation = self.operation
        operator = None if operation.operator == WATCHER else operation.operator
        return {
            "bench": operation.config.label,
            "devices": {kind: device.driver_name for kind, device in operation.config.devices.items()},
            "operator": operator and operator.words,
            "since": operator and operator.since.isoformat(timespec="seconds"),
            "readings": operation.readings(),
            "trouble": operation.trouble or self._watcher.trouble,
        }

    # Holds ---------------------------------------------------------------------------------------
    async def _hold(self, request: web.Request) -> web.StreamResponse:
        """Keep a device open for an operator as long as his connection lasts."""
        kind, operator = _kind(request), self._operator(request)
        link = await self._linked(request, self._serving.lost_after_s * 2 / 3)

        def on_end(reason: DeviceError) -> None:
            self._loop.call_soon_threadsafe(lambda: self._loop.create_task(_part(link, reason)))

        try:
            device, facts = await self._in_thread(self._taken, kind, operator, on_end)
        except (DeviceError, BenchError) as error:
            if not isinstance(error, DeviceError):
                error = DeviceError(kind, str(error))
            await _part(link, error)
            return link
        let_go = False
        try:
            await link.send_json({"facts": facts}, dumps=_dumps)
            async for message in link:
                let_go = let_go or (message.type is WSMsgType.TEXT and message.data == "close")
                if let_go:
                    break
        except ConnectionError:
            pass  # lost, as below
        finally:
            if device is self._filmed and self._frames is not None:
                self._frames.cancel()
            await asyncio.shield(self._after(kind, operator, link if let_go else None))
        return link

    def _taken(
        self, kind: Kind, operator: Operator, on_end: Callable[[DeviceError], None]
    ) -> tuple[Device, Mapping[str, Any]]:
        """Open a device, and return it and what it says of itself; one that fails at that is closed again.

        Raises DeviceError or BenchError: what it said, and what could not be made safe.
        """
        device = self.operation.take(kind, operator, on_end)
        try:
            return device, said_facts(device, kind)
        except Exception as error:
            said = error if isinstance(error, DeviceError | BenchError) else f"failed when opened: {error}."
            try:
                self.operation.let_go(kind, operator)
            except (DeviceError, BenchError) as failure:
                raise BenchError(f"{said} {failure}") from error
            if isinstance(said, str):
                raise DeviceError(kind, said) from error
            raise

    async def _after(self, kind: Kind, operator: Operator, link: web.WebSocketResponse | None) -> None:
        """Close a device that was let go; without its ``link`` the operator is lost, and all is made safe."""
        if link is None:
            words = f"The connection of {operator.words} was lost: light off, motion stopped."
            lost = DeviceLostError("bench", words, "Open it again.")
            try:
                await self._loop.run_in_executor(self._overtaking, self.operation.drop, operator, lost)
            except BenchError as error:
                _log.error("%s", error)
            finally:
                self._uploads.forget(f"{operator.key} {kind}")
            return
        answer: dict[str, Any] = {"closed": True}
        try:
            await self._in_thread(self.operation.let_go, kind, operator)
        except (DeviceError, BenchError) as error:
            told = error if isinstance(error, DeviceError) else DeviceError(kind, str(error))
            answer = {"error": dump_error(told)}
        self._uploads.forget(f"{operator.key} {kind}")
        await link.send_json(answer)
        await link.close()

    # Frames --------------------------------------------------------------------------------------
    async def _sequence(self, request: web.Request) -> web.StreamResponse:
        """Start a sequence and send its frames, ``window`` of them ahead of what the operator has fetched."""
        key = self._operator(request).key
        n_buffers, window = int(request.query["n_buffers"]), int(request.query["window"])
        if window < 1:
            raise ValueError(f"a sequence of which {window} frames may be under way never begins")
        link = await self._linked(request)
        try:
            camera = cast(Camera, self.operation.device("camera", key))
            async with self._sequences:
                await self._in_thread(camera.start_sequence, n_buffers)
                credit = asyncio.Semaphore(window)
                sending = self._frames = asyncio.create_task(self._send_frames(link, camera, credit))
                self._filmed = camera
        except DeviceError as error:
            await _part(link, error)
            return link
        try:
            await link.send_json({"started": True})
            async for _ in link:
                credit.release()
        finally:
            sending.cancel()
            await asyncio.shield(self._end_sequence(sending, camera))
        return link

    async def _end_sequence(self, sending: asyncio.Task[Any], camera: Camera) -> None:
        """Stop a camera's sequence, unless its operator has stopped it and begun the next one already."""
        async with self._sequences:
            if self._frames is sending:
                self._frames = None
                await self._loop.run_in_executor(self._overtaking, _stop_sequence, camera)

    async def _send_frames(
        self, link: web.WebSocketResponse, camera: Camera, credit: asyncio.Semaphore
    ) -> None:
        number = 0
        try:
            while True:
                await credit.acquire()
                while (frame := await self._in_thread(_next_frame, camera)) is None:
                    pass
                self.operation.newest_frame = frame
                for piece in await self._in_thread(pieces, frame, number):
                    while self._overtakers:  # pictures can wait
                        await asyncio.sleep(_GIVE_WAY_S)
                    await link.send_bytes(piece)
                number += 1
        except DeviceError as error:
            await _part(link, error)
        except ConnectionError:
            pass  # its other end is gone, which whoever reads from it hears too

    # The page ------------------------------------------------------------------------------------
    async def _page(self, request: web.Request) -> web.StreamResponse:
        text = resources.files("instrument.serve").joinpath("page.html").read_text("utf-8")
        return web.Response(text=text, content_type="text/html", headers=_PAGE_HEADERS)

    async def _live(self, request: web.Request) -> web.StreamResponse:
        """Tell a page what the bench does every second, and show it each new frame that it is ready for."""
        link = await self._linked(request, self._serving.lost_after_s * 2 / 3)
        ready = asyncio.Event()
        telling = asyncio.create_task(self._tell(link))
        showing = asyncio.create_task(self._show(link, ready))
        self._watcher.join()
        try:
            async for _ in link:
                ready.set()
        finally:
            self._watcher.leave()
            telling.cancel()
            showing.cancel()
        return link

    async def _tell(self, link: web.WebSocketResponse) -> None:
        with contextlib.suppress(ConnectionError):
            while True:
                await link.send_json({"state": await self._in_thread(self.state)}, dumps=_dumps)
                await asyncio.sleep(_STATE_S)

    async def _show(self, link: web.WebSocketResponse, ready: asyncio.Event) -> None:
        shown: Frame | None = None
        with contextlib.suppress(ConnectionError):
            while True:
                await ready.wait()
                frame = self.operation.newest_frame
                if frame is not None and frame is not shown:
                    said, pixels = await self._in_thread(picture, frame)
                    ready.clear()
                    await link.send_json({"picture": said})
                    await link.send_bytes(pixels)
                    shown = frame
                await asyncio.sleep(_PICTURE_S)


def _kind(request: web.Request) -> Kind:
    kind = request.match_info["kind"]
    if kind not in INTERFACES:
        raise ValueError(f"{kind!r} is none of {', '.join(INTERFACES)}")
    return cast(Kind, kind)


def _error(status: int, error: DeviceError) -> web.Response:
    return web.json_response({"error": dump_error(error)}, status=status)


async def _part(link: web.WebSocketResponse, reason: DeviceError) -> None:
    """End a connection with its reason; the other end may be gone."""
    try:
        await link.send_json({"error": dump_error(reason)})
        await link.close(code=WSCloseCode.GOING_AWAY)
    except ConnectionError:
        pass


def _next_frame(camera: Camera) -> Frame | None:
    try:
        return camera.next_frame(_FRAME_WAIT_S)
    except DeviceTimeoutError:
        return None  # between frames, or before a trigger: the operator has his own patience


def _stop_sequence(camera: Camera) -> None:
    try:
        camera.stop_sequence()
    except DeviceError as error:
        _log.error("%s", error)
