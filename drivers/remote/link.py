"""One device's connections to the server: the hold that keeps it, its calls, and what ends them all."""

from __future__ import annotations

import asyncio
import contextlib
import functools
import getpass
import itertools
import json
import os
import secrets
import socket
import sys
import threading
from collections.abc import Callable, Coroutine, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from drivers.errors import DeviceError, DeviceLostError, DeviceNotOpenError, StoppedError
from drivers.remote.options import RemoteOptions, token_place
from drivers.remote.wire import (
    NUMBER_HEADER,
    OPERATOR_HEADER,
    PIECE_BYTES,
    PROTOCOL,
    Call,
    Kind,
    load_error,
    unpack_frame,
)

if TYPE_CHECKING:
    import aiohttp

T = TypeVar("T")
_CONNECT_S = 5.0
_OPERATOR = secrets.token_hex(8)
"""This program, to servers: all its devices are one operator's."""


@functools.cache
def _loop() -> asyncio.AbstractEventLoop:
    """Return the event loop of all connections, which runs in a thread of its own until the program ends."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="connections to servers", daemon=True).start()
    return loop


class Link:
    """What keeps a device on a server, and calls it; made for one opening after the other.

    Parameters
    ----------
    options : RemoteOptions
    kind : str
    name : str
        The device as error messages name it.
    """

    def __init__(self, options: RemoteOptions, kind: Kind, name: str) -> None:
        self._options, self._kind, self._name = options, kind, name
        self._session: aiohttp.ClientSession | None = None
        self._hold: aiohttp.ClientWebSocketResponse | None = None
        self._keeping: asyncio.Task[None] | None = None
        self._running: set[asyncio.Task[Any]] = set()
        self._numbers = itertools.count(1)
        self.failure: DeviceError | None = None
        """Why the device is not held any more, though nobody let it go."""
        self.on_failure: Callable[[], None] = lambda: None
        """Called, in the connections' thread, when ``failure`` is there."""

    @property
    def is_held(self) -> bool:
        """Whether the device is open on the server, for this program."""
        return self._hold is not None and self.failure is None

    def require(self) -> None:
        """Raise why the device cannot be used, if so."""
        if self.failure is not None:
            raise self._again(self.failure)
        if self._hold is None:
            raise DeviceNotOpenError(self._name)

    # Opening and closing -------------------------------------------------------------------------
    def open(self) -> Mapping[str, Any]:
        """Have the server open the device and keep it; returns what it says of it (see ``wire.facts``).

        Raises DeviceError when the server is not there, does not take the token, or serves another operator.
        """
        try:
            import aiohttp  # noqa: F401
        except ModuleNotFoundError as error:
            raise DeviceError(
                self._name, "needs aiohttp, which is not installed.", 'pip install "diffuserbench[remote]"'
            ) from error
        self.failure = None
        token = self._token()
        return self._wait(self._take(token))

    def close(self) -> None:
        """Have the server close the device; what is lost is closed already.

        Raises DeviceError when the server could not bring it to its safe state.
        """
        if self._session is not None:
            self._wait(self._let_go())
        self.failure = None

    def _token(self) -> str:
        named = self._options.token_file
        file = token_place() if named is None else Path(named).expanduser()
        try:
            return file.read_text("utf-8").strip()
        except OSError as error:
            raise DeviceError(
                self._name,
                f"its token cannot be read from {file}: {error.strerror}.",
                "Copy it from the computer that serves (it says where it is), and name the file in "
                "token_file.",
            ) from error

    async def _take(self, token: str) -> Mapping[str, Any]:
        import aiohttp

        heartbeat_s = self._options.lost_after_s * 2 / 3  # and half of it until the answer
        headers = {
            "Authorization": f"Bearer {token}",
            OPERATOR_HEADER: f"{_OPERATOR} {_who()}",
        }
        self._session = aiohttp.ClientSession(
            self._options.url,
            headers=headers,
            timeout=aiohttp.ClientTimeout(total=None, sock_connect=_CONNECT_S),
        )
        try:
            # A server that ended may leave a socket that connects and never answers.
            async with asyncio.timeout(_CONNECT_S + self._options.lost_after_s):
                self._hold = await self._session.ws_connect(
                    f"/api/devices/{self._kind}/hold", heartbeat=heartbeat_s, protocols=(PROTOCOL,)
                )
            first = await self._hold.receive()
            if first.type is not aiohttp.WSMsgType.TEXT:
                raise self._unreachable("it ended the connection while the device was opened")
            said = json.loads(first.data)
            if "error" in said:
                raise load_error(self._name, said["error"])
        except aiohttp.WSServerHandshakeError as error:
            await self._forget()
            raise self._refused(error.status, error.message) from error
        except (aiohttp.ClientError, OSError, TimeoutError) as error:
            await self._forget()
            raise self._unreachable(str(error) or "it does not answer in time") from error
        except BaseException:
            await self._forget()
            raise
        self._keeping = asyncio.ensure_future(self._keep(self._hold))
        facts: Mapping[str, Any] = said["facts"]
        return facts

    async def _keep(self, hold: aiohttp.ClientWebSocketResponse) -> None:
        """Wait for what ends the hold from the other side."""
        import aiohttp

        failure: DeviceError = DeviceLostError(
            self._name,
            f"the connection to {self._options.url} is lost.",
            "The server has put its light off and stopped its motion. Check network and server, then open "
            "it again.",
        )
        async for message in hold:
            if message.type is aiohttp.WSMsgType.TEXT and "error" in (said := json.loads(message.data)):
                failure = load_error(self._name, said["error"])
        self._fail(failure)

    def _fail(self, failure: DeviceError) -> None:
        """End all that waits for the server."""
        if self.failure is None:
            self.failure = failure
        for task in self._running:
            if task is not asyncio.current_task():
                task.cancel()
        self.on_failure()

    async def broke(self, during: str, why: str) -> DeviceError:
        """Give the device up, as a connection to it broke; returns the error to raise.

        Nobody knows what was carried out. The server makes itself safe when the hold ends.
        """
        self._fail(
            DeviceLostError(
                self._name,
                f"the connection to {self._options.url} broke during {during}: {why}.",
                "Check network and server, then open it again.",
            )
        )
        if self._hold is not None:
            await self._hold.close(code=1011)
        assert self.failure is not None
        return self._again(self.failure)

    async def _let_go(self) -> None:
        hold, keeping = self._hold, self._keeping
        try:
            if hold is None or self.failure is not None or keeping is None:
                return
            keeping.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await keeping
            with contextlib.suppress(ConnectionError):
                await hold.send_str("close")
                said = await hold.receive()
                if isinstance(said.data, str) and "error" in (answer := json.loads(said.data)):
                    error = load_error(self._name, answer["error"])
                    if not isinstance(error, StoppedError):  # which ended the hold just before
                        raise error
        finally:
            await self._forget()

    async def _forget(self) -> None:
        session, self._session, self._hold, self._keeping = self._session, None, None, None
        if session is not None:
            await session.close()

    # Calls ---------------------------------------------------------------------------------------
    def call(self, call: Call, arguments: Mapping[str, Any]) -> Any:
        """Return what the device gives.

        Raises DeviceError: the device's own; DeviceLostError when the connection broke meanwhile.
        """
        data = self._wait(self._request(call, arguments))
        if call.gives.is_frame:
            return unpack_frame(data)
        return call.gives.load(json.loads(data)["value"])

    async def _request(self, call: Call, arguments: Mapping[str, Any]) -> bytes:
        # Asked here, as what ends the hold later ends this, too.
        if call.verb != "PUT" or self._hold is None:  # a stop is tried whatever became of the hold
            self.require()
        number = next(self._numbers)  # of the whole: a stop during its arrays overtakes it
        said = {
            name: {"upload": await self._upload(value)} if isinstance(value, memoryview) else value
            for name, value in arguments.items()
        }
        return await self._exchange(call.verb, call.name, number, data=json.dumps(said) if said else None)

    async def _upload(self, file: memoryview) -> str:
        """Send an array ahead, a piece after the other, and return the word for it."""
        word = str(next(self._numbers))
        for place in range(0, len(file), PIECE_BYTES):
            query, piece = {"size": len(file), "place": place}, bytes(file[place : place + PIECE_BYTES])
            await self._exchange("POST", f"upload/{word}", int(word), params=query, data=piece)
        return word

    async def _exchange(self, verb: str, name: str, number: int, **named: Any) -> bytes:
        """Return the reply to one request; errors as ``call``."""
        import aiohttp

        if self._session is None:
            raise DeviceNotOpenError(self._name)
        limit_s = None if self.failure is None else self._options.lost_after_s  # no hold says that it is lost
        try:
            async with (
                asyncio.timeout(limit_s),
                self._session.request(
                    verb,
                    f"/api/devices/{self._kind}/{name}",
                    headers={NUMBER_HEADER: str(number)},
                    **named,
                ) as reply,
            ):
                data = await reply.read()
                if reply.status == 200:
                    return data
                if reply.content_type != "application/json":
                    raise self._refused(reply.status, data[:100].decode(errors="replace"))
                raise load_error(self._name, json.loads(data)["error"])
        except (aiohttp.ClientError, OSError) as error:
            during = name.partition("/")[0]
            raise await self.broke(during, str(error) or type(error).__name__) from error

    async def frames(self, n_buffers: int, window: int) -> aiohttp.ClientWebSocketResponse:
        """Start a sequence; returns the connection that its frames come over.

        Raises DeviceError when the camera refuses; DeviceLostError when the connection broke meanwhile.
        """
        import aiohttp

        self.require()
        assert self._session is not None
        try:
            stream = await self._session.ws_connect(
                "/api/devices/camera/frames",
                params={"n_buffers": n_buffers, "window": window},
                protocols=(PROTOCOL,),
                max_msg_size=0,
            )
        except (aiohttp.ClientError, OSError) as error:
            raise await self.broke("the start of a sequence", str(error) or type(error).__name__) from error
        first = await stream.receive()
        if first.type is not aiohttp.WSMsgType.TEXT:
            raise await self.broke("the start of a sequence", "its frames' connection ended")
        if "error" in (said := json.loads(first.data)):
            await stream.close()
            raise load_error(self._name, said["error"])
        return stream

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Wait for work in the connections' thread; the end of the hold ends it."""
        return self._wait(work)

    def begin(self, work: Coroutine[Any, Any, Any]) -> None:
        """Begin work in the connections' thread."""
        asyncio.run_coroutine_threadsafe(work, _loop())

    def _wait(self, work: Coroutine[Any, Any, T]) -> T:
        import concurrent.futures

        async def watched() -> T:
            task = asyncio.current_task()
            assert task is not None
            self._running.add(task)
            try:
                return await work
            except asyncio.CancelledError:
                if self.failure is not None:
                    raise self._again(self.failure) from None
                raise
            finally:
                self._running.discard(task)

        waiting = asyncio.run_coroutine_threadsafe(watched(), _loop())
        try:
            return waiting.result()
        except concurrent.futures.CancelledError:
            raise StoppedError(self._name, "its connection was closed meanwhile.") from None
        except BaseException:
            waiting.cancel()
            raise

    # Words ---------------------------------------------------------------------------------------
    def _again(self, failure: DeviceError) -> DeviceError:
        """Return an error anew, for each thread its own."""
        return type(failure)(failure.device, failure.problem, failure.remedy)

    def _unreachable(self, why: str) -> DeviceError:
        return DeviceError(
            self._name,
            f"no server answers at {self._options.url}: {why}.",
            "Start diffuserbench serve there, and check the url in bench.toml and the network between.",
        )

    def _refused(self, status: int, why: str) -> DeviceError:
        if status == 401:
            file = self._options.token_file or token_place()
            return DeviceError(
                self._name,
                f"the server at {self._options.url} does not take the token in {file}.",
                "Copy it again from the computer that serves: it says where it is when it begins.",
            )
        return DeviceError(
            self._name,
            f"{self._options.url} answers {status} ({why}), not as diffuserbench serve does.",
            "Check the url; both computers should have the same version of the program.",
        )


def _who() -> str:
    """Return who operates, as the server tells others."""
    try:
        user = getpass.getuser()
    except (OSError, KeyError):
        user = "somebody"
    program = Path(sys.argv[0] or "python").name
    said = f"{user}@{socket.gethostname()} ({program}, process {os.getpid()})"
    return said.encode("ascii", "replace").decode()
