"""What goes over the network: which calls a kind of device has, and their values as JSON; frames as bytes.

Both ends read the calls off the interfaces (:mod:`drivers.camera` and its neighbours), so what an interface
declares is served and called without being declared again. A call is one HTTP request:

===========================================  ====================================================
``GET /api/devices/KIND/NAME``               a property, or what only looks
``POST /api/devices/KIND/NAME``              a command; its arguments by name, a JSON object
``PUT /api/devices/KIND/NAME``               what overtakes: ``stop``, ``off``, ``stop_sequence``
``POST /api/devices/KIND/upload/WORD``       a piece of an array (a file of NumPy's of ``size`` bytes) from
                                             ``place`` on; a command takes it whole as ``{"upload": WORD}``
``GET /api/devices/KIND/hold`` (WebSocket)   opens the device and keeps it for one operator, until it ends
``GET /api/devices/camera/frames``           (WebSocket) a running sequence
===========================================  ====================================================

A reply is a JSON object with ``value`` or ``error``, or the bytes of one frame (:func:`pack_frame`).
"""

from __future__ import annotations

import base64
import functools
import inspect
import io
import json
import math
import struct
import time
import tokenize
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from types import FunctionType
from typing import Any, ClassVar, Literal, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import TypeAdapter

from drivers import errors
from drivers.camera import Camera
from drivers.device import Device
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import LedArray
from drivers.registry.claim import DeviceBusyError
from drivers.slm import Slm
from drivers.stage import Stage

Kind = Literal["camera", "stage", "led_array", "slm"]
INTERFACES: Mapping[Kind, Any] = {
    "camera": Camera,
    "stage": Stage,
    "led_array": LedArray,
    "slm": Slm,
}
PORT = 8470
OPERATOR_HEADER = "Diffuserbench-Operator"
"""Whose call it is: a word that its program drew when it began."""
NUMBER_HEADER = "Diffuserbench-Number"
"""Calls of one opening are numbered: one that a later stop has overtaken on its way is not carried out."""
PROTOCOL = "diffuserbench"
"""WebSocket subprotocol; a browser, which can send no header, gives the token as a second one."""

LONGEST_ARRAYS, LONGEST_REQUEST, PIECE_BYTES = 1 << 30, 16 << 20, 1 << 19
"""Bytes of all arrays that a server keeps for a call, of the longest request, of an array's piece."""

_AT_HOME = {"open", "close", "is_open", "name", "stream", "start_sequence", "next_frame", "next_frame_into"}
_AT_HOME |= {"is_streaming", "frame_dtype", "single"}
"""What the computer that asks answers itself."""
_HEADER_BYTES = 1 << 17
_OVERTAKING = frozenset(("stop", "off", "stop_sequence"))


class Values:
    """A type's values as JSON has them, arrays and frames included."""

    def __init__(self, hint: Any) -> None:
        self._is_list = get_origin(hint) is Sequence  # of arrays, all of one shape
        self.is_array = get_origin(hint) is np.ndarray or any(
            get_origin(part) is np.ndarray for part in get_args(hint)
        )
        self.is_frame = hint is Frame
        self._adapter: TypeAdapter[Any] = TypeAdapter(Any if self.is_array or self.is_frame else hint)

    def dump(self, value: Any) -> Any:
        """Return a value as ``json.dumps`` takes it, with :func:`plain`."""
        if self.is_array:
            return base64.b64encode(self.file(value)).decode()
        return self._adapter.dump_python(value, mode="json", warnings=False)

    @staticmethod
    def file(value: Any) -> memoryview:
        """Return an array, or a list of such of one shape, as a file of NumPy's."""
        file = io.BytesIO()
        np.save(file, np.ascontiguousarray(value), allow_pickle=False)
        return file.getbuffer()

    def load(self, value: Any) -> Any:
        """Return a value from what ``json.loads`` gave, an array also from its file's bytes.

        Raises ValueError when it is none of this type.
        """
        if not self.is_array:
            return self._adapter.validate_python(value)
        is_file = isinstance(value, memoryview)
        array = _array(value if is_file else memoryview(base64.b64decode(value, validate=True)))
        array.flags.writeable = False
        return list(array) if self._is_list else array


def _array(data: memoryview) -> Any:
    """Return an array over a file of NumPy's; ValueError where it is none, or of another size."""
    file = io.BytesIO(data[:_HEADER_BYTES])
    read = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    version = np.lib.format.read_magic(file)
    if version not in read:
        raise ValueError(f"an array's file has version {version}")
    try:  # NumPy reads it as Python
        shape, by_columns, dtype = read[version](file)
    except (tokenize.TokenError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise ValueError(f"an array's file does not begin as one: {error}") from error
    said, there = math.prod(shape) * dtype.itemsize, len(data) - file.tell()
    if said != there:
        raise ValueError(f"an array of {shape} {dtype} has {said} bytes, and {there} came")
    return np.frombuffer(data, dtype, offset=file.tell()).reshape(shape, order="F" if by_columns else "C")


def plain(value: Any) -> Any:
    """Return what JSON has for a value that it does not know: numbers of NumPy's."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be sent.")


@dataclass(frozen=True)
class Call:
    """One call that a kind of device takes.

    Attributes
    ----------
    verb : str
        ``"GET"``, ``"POST"`` or ``"PUT"``, as this module's beginning has it.
    signature : inspect.Signature or None
        Of the method; None of a property.
    takes : mapping
        Its arguments' types.
    gives : Values
        Its result's type.
    function : function
        The interface's own.
    """

    name: str
    verb: Literal["GET", "POST", "PUT"]
    signature: inspect.Signature | None
    takes: Mapping[str, Values]
    gives: Values
    function: FunctionType

    def named(self, device: Device, args: tuple[Any, ...], named: Mapping[str, Any]) -> dict[str, Any]:
        """Return arguments by name, as JSON has them; arrays, which are sent ahead, as their files' bytes."""
        if self.signature is None:
            return {}
        bound = self.signature.bind(device, *args, **named).arguments
        return {
            name: values.file(bound[name]) if values.is_array else values.dump(bound[name])
            for name, values in self.takes.items()
            if name in bound
        }

    def make(self, device: Device, arguments: Mapping[str, Any]) -> Any:
        """Call a device, with arguments from JSON.

        Raises ValueError when they do not fit the call; what the device raises.
        """
        if self.signature is None:
            return getattr(device, self.name)
        unknown = [name for name in arguments if name not in self.takes]
        if unknown:
            raise ValueError(f"{self.name} takes no {', '.join(unknown)}")
        given = {name: self.takes[name].load(value) for name, value in arguments.items()}
        try:
            self.signature.bind(device, **given)
        except TypeError as error:
            raise ValueError(f"{self.name}: {error}") from None
        return getattr(device, self.name)(**given)


def _hints(function: FunctionType, interface: type) -> dict[str, Any]:
    """Return a function's types, with what an interface means by the type variables of its bases."""
    meant: dict[Any, Any] = {}
    for base in getattr(interface, "__orig_bases__", ()):
        meant |= zip(getattr(get_origin(base), "__parameters__", ()), get_args(base), strict=False)
    return {
        name: hint[tuple(meant[variable] for variable in variables)]
        if (variables := getattr(hint, "__parameters__", ()))
        else hint
        for name, hint in get_type_hints(function).items()
    }


@functools.cache
def calls(kind: Kind) -> Mapping[str, Call]:
    """Return what a kind of device is asked for from afar, by name."""
    found: dict[str, Call] = {}
    for name in dir(INTERFACES[kind]):
        member = inspect.getattr_static(INTERFACES[kind], name)
        function = member.fget if isinstance(member, property) else member
        if name.startswith("_") or name in _AT_HOME or not isinstance(function, FunctionType):
            continue
        hints = _hints(function, INTERFACES[kind])
        gives = Values(hints.pop("return"))
        is_read = isinstance(member, property)
        verb: Literal["GET", "POST", "PUT"] = "GET" if is_read else "POST"
        found[name] = Call(
            name,
            "PUT" if name in _OVERTAKING else verb,
            None if is_read else inspect.signature(function),
            {name: Values(hint) for name, hint in hints.items()},
            gives,
            function,
        )
    return found


@functools.cache
def facts(kind: Kind) -> Mapping[str, Values]:
    """Return what a kind of device declares of itself beside calls: a camera's trigger modes, its silence."""
    hints = get_type_hints(INTERFACES[kind])
    return {
        name: Values(get_args(hint)[0] if get_origin(hint) is ClassVar else hint)
        for name, hint in hints.items()
        if name not in ("Options", "Shared") and not name.startswith("_")
    }


# Errors ---
_ERRORS: Mapping[str, type[errors.DeviceError]] = {
    kind.__name__: kind
    for kind in (
        errors.DeviceError,
        errors.DeviceNotOpenError,
        errors.DeviceLostError,
        errors.DeviceTimeoutError,
        errors.LimitError,
        errors.StoppedError,
        DeviceBusyError,
    )
}


def dump_error(error: errors.DeviceError) -> dict[str, str]:
    """Return an error as JSON has it."""
    return {"type": type(error).__name__, "problem": error.problem, "remedy": error.remedy}


def load_error(device: str, said: Mapping[str, str]) -> errors.DeviceError:
    """Return the error that the other end had, under this end's name of the device."""
    kind = _ERRORS.get(said["type"], errors.DeviceError)
    made = errors.DeviceError(device, said["problem"], said["remedy"])
    if kind is not errors.DeviceNotOpenError:
        made = kind(device, said["problem"], said["remedy"])
    return made


# Frames ---
_LENGTH = struct.Struct("<I")
_ALIGNED = 8
_PIECE = struct.Struct("<IQQ")
_PIECE_BYTES = 1 << 20


@functools.cache
def _metadata() -> TypeAdapter[FrameMetadata]:
    return TypeAdapter(FrameMetadata)


def pack_frame(frame: Frame) -> bytes:
    """Return a frame as bytes: the length of a JSON object, the object, the pixels."""
    said = json.dumps(
        {
            "shape": frame.image.shape,
            "bits": 8 * frame.image.dtype.itemsize,
            "metadata": _metadata().dump_python(frame.metadata, mode="json", warnings=False),
        },
        default=plain,
    ).encode()
    said += b" " * (-(len(said) + _LENGTH.size) % _ALIGNED)
    pixels = np.ascontiguousarray(frame.image, dtype=frame.image.dtype.newbyteorder("<"))
    return b"".join([_LENGTH.pack(len(said)), said, pixels.data.cast("B")])


def pieces(frame: Frame, number: int) -> list[bytes]:
    """Return a sequence's frame in messages of at most a megabyte.

    Each says the frame's number, from 0, the frame's size and its own place in it: a message that is whole
    keeps a connection, and its thread, busy for long.
    """
    whole = pack_frame(frame)
    return [
        _PIECE.pack(number, len(whole), place) + whole[place : place + _PIECE_BYTES]
        for place in range(0, len(whole), _PIECE_BYTES)
    ]


class Assembly:
    """Puts frames together from their pieces, in whatever order these come, and gives them in theirs."""

    def __init__(self) -> None:
        self._parts: dict[int, tuple[memoryview, list[int]]] = {}
        self._expected = 0

    def add(self, piece: bytes) -> Iterator[Frame]:
        """Take a piece; yields the frames that are whole by it, the oldest first.

        Raises ValueError when it is none.
        """
        try:
            number, size, place = _PIECE.unpack_from(piece)
        except struct.error as error:
            raise ValueError(f"no piece of a frame: {error}") from None
        whole, left = self._parts.get(number) or (np.empty(size, np.uint8).data, [size])
        self._parts[number] = whole, left
        whole[place : place + len(piece) - _PIECE.size] = memoryview(piece)[_PIECE.size :]
        left[0] -= len(piece) - _PIECE.size
        while (first := self._parts.get(self._expected)) is not None and first[1] == [0]:
            del self._parts[self._expected]
            self._expected += 1
            yield unpack_frame(first[0])


def unpack_frame(message: bytes | memoryview) -> Frame:
    """Return a frame, whose image looks at the message; it reached this computer now.

    Raises ValueError when the message is no frame.
    """
    try:
        (length,) = _LENGTH.unpack_from(message)
        begin = _LENGTH.size + length
        said = json.loads(bytes(message[_LENGTH.size : begin]))
        metadata = _metadata().validate_python(said["metadata"])
        pixels = np.frombuffer(message, "<u1" if said["bits"] == 8 else "<u2", offset=begin)
        image = pixels.reshape(said["shape"])
    except (struct.error, KeyError, TypeError) as error:
        raise ValueError(f"no frame: {error!r}") from None
    return Frame(image, replace(metadata, host_time_ns=time.monotonic_ns(), utc=datetime.now(UTC)))
