"""JSON records: written, read, checked and brought up to date in one way.

A record is a JSON object whose ``"format"`` names what it is and whose ``"version"`` counts the format's
changes: a whole number, or ``"2.1"``. The number before the dot changes when readers of before would misread
the file (an entry in ``migrate`` then brings old records up to date); the one behind it when fields were
added, which readers of before leave out with a word. Records without a version are of version 1.

:func:`plain` and :func:`value_of` turn values to and from what JSON can hold, dataclasses by their own
declaration: a field added to one is written and read without a line elsewhere.
"""

from __future__ import annotations

import contextlib
import dataclasses
import enum
import json
import logging
import math
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import datetime
from functools import cache, lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.files.reading import parse_json, read_bytes

_log = logging.getLogger(__name__)
T = TypeVar("T")
Fields = dict[str, Any]
Migration = Callable[[Fields], Fields]
Unknown = dict[str, Any]
"""Fields that a record has and this program does not know, by dotted name."""


@dataclasses.dataclass(frozen=True)
class RecordFormat:
    """One format of JSON records."""

    name: str
    """As ``"format"`` has it."""
    thing: str
    """What such a file holds, for sentences: ``"mask alignment"``."""
    major: int = 1
    minor: int = 0
    """The version that is written."""
    make: str = ""
    restore: str = ""
    """What to do where there is none, and where one is damaged."""
    migrate: Mapping[int, Migration] = dataclasses.field(default_factory=dict)
    """From the major version that a record has to the next: takes its fields and returns them changed."""
    fields: Sequence[str] | None = None
    """Every field that is known at the top; None where a record carries any further facts."""
    error: type[FileError] = FileError
    """Raised for whatever is wrong with a file."""
    numbered_before: bool = False
    unnamed_before: bool = False
    """Whether files of before named no format, and had the version as ``"format"`` or nothing there."""

    # Writing -------------------------------------------------------------------------------------
    def stamped(self, fields: Mapping[str, Any]) -> Fields:
        """Return a record's fields, as JSON can hold them, behind its format and version."""
        version = self.major if self.minor == 0 else f"{self.major}.{self.minor}"
        return {"format": self.name, "version": version, **plain(fields)}

    def text(self, fields: Mapping[str, Any], *, indent: int | None = 1) -> str:
        """Return a record as text; without an indent as short as can be."""
        separators = (",", ":") if indent is None else None
        stamped = self.stamped(fields)
        return json.dumps(stamped, indent=indent, separators=separators, ensure_ascii=False) + "\n"

    def write(self, path: Path, fields: Mapping[str, Any], *, indent: int | None = 1) -> None:
        """Write a record, whole or not at all; errors as ``write_text``."""
        write_text(path, self.text(fields, indent=indent))

    # Reading -------------------------------------------------------------------------------------
    def is_of(self, path: Path) -> bool:
        """Return whether a file is a record that names this format; :meth:`read` says what else is wrong."""
        try:
            found = parse_json(read_bytes(path, error=self.error))
        except ValueError:
            return False
        return isinstance(found, dict) and found.get("format") == self.name

    def read(self, path: Path) -> Fields:
        """Return a record's fields, brought up to date.

        Fields that this program does not know are among them, and told of once.

        Raises FileError when there is no such file, it is something else, damaged, or of a version that is
        not known.
        """
        try:
            found = parse_json(read_bytes(path, error=self.error))
        except FileNotFoundError:
            raise self.error(path, "there is no such file.", self.make) from None
        except ValueError as error:
            raise self.error(
                path, f"is no valid JSON ({error}): it was changed or damaged.", self.restore or self.make
            ) from error
        if not isinstance(found, dict):
            raise self.error(path, f"holds no JSON object: it is no {self.thing}.", self.make)
        return self.checked(found, path)

    def checked(self, record: Fields, path: Path) -> Fields:
        """Return the fields of a record that was read from ``path``; errors as :meth:`read`."""
        fields = dict(record)
        name = fields.pop("format", self.name if self.unnamed_before else None)
        version = fields.pop("version", 1)
        if self.numbered_before and isinstance(name, int):
            name, version = self.name, name
        if name != self.name:
            raise self.error(
                path, f"holds no {self.thing}: 'format' is {name!r}, expected {self.name!r}.", self.make
            )
        major, minor = _numbers(version)
        if major > self.major or any(old not in self.migrate for old in range(major, self.major)):
            known = self.major if not self.migrate else f"{min(self.migrate)} to {self.major}"
            raise self.error(
                path,
                f"version {version!r} is not known to this program, which reads version {known}.",
                "Update diffuserbench." if major > self.major else self.restore or self.make,
            )
        with self.damaged(path):
            for old in range(major, self.major):
                fields = self.migrate[old](fields)
        if self.fields is not None:
            self.warn_unknown(path, [name for name in fields if name not in self.fields])
        elif (major, minor) > (self.major, self.minor):
            _say(path, f"is of version {version}, newer than this program's: what is new in it is left out.")
        return fields

    def value(self, kind: type[T], fields: Any, path: Path) -> T:
        """Return the value of a type that part of a record describes, telling of fields that are not known.

        Raises FileError when it does not describe one.
        """
        unknown: Unknown = {}
        with self.damaged(path):
            value = value_of(kind, fields, unknown)
        self.warn_unknown(path, list(unknown))
        return value

    def warn_unknown(self, path: Path, names: Sequence[str]) -> None:
        """Say once that a file has fields which this program does not know."""
        if names:
            _say(path, f"holds {', '.join(map(repr, names))}, which this program does not know: left out.")

    @contextlib.contextmanager
    def damaged(self, path: Path) -> Iterator[None]:
        """Turn what goes wrong while a record's fields are taken apart into an error that names the file."""
        try:
            yield
        except (LookupError, TypeError, ValueError, AttributeError, OverflowError) as error:
            why = f"lacks {error}" if isinstance(error, KeyError) else str(error)
            raise self.error(path, f"is a damaged {self.thing}: {why}.", self.restore or self.make) from error


def _numbers(version: Any) -> tuple[int, int]:
    """Return a version's two numbers; a version that is none counts as newer than any."""
    try:
        major, _, minor = str(version).partition(".")
        return int(major), int(minor or 0)
    except ValueError:
        return (sys.maxsize, 0)


@lru_cache(maxsize=256)
def _say(path: Path, text: str) -> None:
    """Tell of a file once, however often it is read."""
    _log.warning("%s: %s", path, text)


# Values ------------------------------------------------------------------------------------------
def plain(value: Any) -> Any:
    """Return the value as JSON can hold it: no NumPy types, tuples, dates, paths or dataclasses.

    Numbers that are not finite become None; :func:`value_of` brings them back as NaN where a float belongs.
    """
    if value is None or type(value) in (str, int, bool):
        return value
    if isinstance(value, enum.Enum):
        return plain(value.value)
    if isinstance(value, np.generic | np.ndarray):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    if isinstance(value, datetime):
        return value.isoformat()
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    return value


def value_of(kind: type[T], data: Any, unknown: Unknown | None = None) -> T:
    """Return the value of a type that :func:`plain` turned into ``data``.

    ``kind``: a dataclass, or what its fields may be: numbers, strings, dates, paths, enumerations, tuples,
    lists, mappings, arrays, other dataclasses, and any of these or None. ``unknown``: takes the fields that
    no dataclass here has, by dotted name; without it they are left out silently.

    Raises LookupError, TypeError or ValueError when ``data`` describe no such value.
    """
    value: T = _reader(typing.cast(Any, kind))(data, unknown if unknown is not None else {}, "")
    return value


Reader = Callable[[Any, Unknown, str], Any]


@cache
def _reader(kind: Any) -> Reader:
    """Return what turns JSON's value into one of ``kind``."""
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        others = [one for one in arguments if one is not type(None)]
        read = _reader(others[0]) if len(others) == 1 else _one_of(others)
        return lambda data, unknown, at: None if data is None else read(data, unknown, at)
    if origin is tuple:
        return _tuple_reader(arguments)
    if origin is np.ndarray:
        (dtype,) = typing.get_args(arguments[1])
        return _converter(lambda data: np.array(data, dtype))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        key, entry = _reader(arguments[0]), _reader(arguments[1])
        return lambda data, unknown, at: {
            key(k, unknown, at): entry(v, unknown, f"{at}{k}.") for k, v in data.items()
        }
    if origin in (list, Sequence):
        item = _reader(arguments[0])
        return lambda data, unknown, at: [item(one, unknown, at) for one in data]
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return _dataclass_reader(kind)
    if kind is float:
        return _converter(lambda data: math.nan if data is None else float(data))
    if kind is datetime:
        return _converter(datetime.fromisoformat)
    is_made_of_its_value = isinstance(kind, type) and issubclass(kind, Path | enum.Enum)
    return _converter(kind) if is_made_of_its_value else _as_it_is


def _as_it_is(data: Any, _unknown: Unknown, _at: str) -> Any:
    return data


def _converter(convert: Callable[[Any], Any]) -> Reader:
    """Return the reader of a value that holds no dataclass."""
    return lambda data, _unknown, _at: convert(data)


def _one_of(kinds: Sequence[Any]) -> Reader:
    """Return the reader of a value of several types: tables are their dataclass, words of none are a path."""
    tables = [kind for kind in kinds if isinstance(kind, type) and dataclasses.is_dataclass(kind)]
    words = [
        word for kind in kinds if typing.get_origin(kind) is typing.Literal for word in typing.get_args(kind)
    ]

    def read(data: Any, unknown: Unknown, at: str) -> Any:
        if isinstance(data, Mapping) and len(tables) == 1:
            return _reader(tables[0])(data, unknown, at)
        is_path = isinstance(data, str) and Path in kinds and str not in kinds and data not in words
        return Path(data) if is_path else data

    return read


def _tuple_reader(arguments: tuple[Any, ...]) -> Reader:
    if len(arguments) == 2 and arguments[1] is Ellipsis:
        item = _reader(arguments[0])
        return lambda data, unknown, at: tuple(item(one, unknown, at) for one in data)
    items = [_reader(one) for one in arguments]
    return lambda data, unknown, at: tuple(
        item(one, unknown, at) for item, one in zip(items, data, strict=True)
    )


def _dataclass_reader(kind: type) -> Reader:
    hints = typing.get_type_hints(kind)
    readers = {field.name: _reader(hints[field.name]) for field in dataclasses.fields(kind) if field.init}

    def read(data: Any, unknown: Unknown, at: str) -> Any:
        if not isinstance(data, Mapping):
            raise TypeError(f"{at.rstrip('.') or 'it'} should be a table, not {data!r:.40}")
        values = {}
        for name, value in data.items():
            if (reader := readers.get(name)) is _as_it_is:
                values[name] = value
            elif reader is not None:
                values[name] = reader(value, unknown, f"{at}{name}.")
            else:
                unknown[f"{at}{name}"] = value
        return kind(**values)

    return read


def of_kind(value: Any, kind: Any, name: str = "") -> Any:
    """Return part of a record without what is null of its parts, where it is of the kind that is expected.

    A kind is a type, a tuple of which one is meant, ``[kind]`` for a list of such, or ``{name: kind}`` for an
    object: what is named with a ``!`` has to be there, what is not named may be anything. Raises TypeError,
    which names the part, where it is of another kind.
    """
    if isinstance(kind, tuple):
        for one in kind:
            # What is an object is told by what its own parts lack, all else by the kinds that it may be.
            if isinstance(one, dict) and isinstance(value, Mapping):
                return of_kind(value, one, name)
            with contextlib.suppress(TypeError):
                return of_kind(value, one, name)
        raise TypeError(f"'{name}' is {str(value)[:40]!r}, {' and '.join(map(_no_such, kind))}")
    if isinstance(kind, dict):
        if not isinstance(value, Mapping):
            raise TypeError(f"'{name}' is no object of names and values")
        kinds = {key.rstrip("!"): one for key, one in kind.items()}
        for key in kind:
            if key.endswith("!") and value.get(key[:-1]) is None:
                raise TypeError(f"'{name}' has no '{key[:-1]}'")
        known = {key: part for key, part in value.items() if part is not None or key not in kinds}
        return {
            key: of_kind(part, kinds[key], f"{name}.{key}".strip(".")) if key in kinds else part
            for key, part in known.items()
        }
    if isinstance(kind, list):
        if not isinstance(value, list):
            raise TypeError(f"'{name}' is no list")
        return [of_kind(part, kind[0], name) for part in value]
    is_flag = isinstance(value, bool) and kind is not object
    if is_flag or not isinstance(value, (int, float) if kind is float else kind):
        raise TypeError(f"'{name}' is {str(value)[:40]!r}, {_no_such(kind)}")
    if kind is float and isinstance(value, int) and abs(value) > sys.float_info.max:
        raise TypeError(f"'{name}' is a whole number of more than 300 digits")
    return value


_WORDS = {float: "number", int: "whole number", str: "text"}


def _no_such(kind: Any) -> str:
    """Say that a value is not of a kind of :func:`of_kind`."""
    structure = "no object of names and values" if isinstance(kind, dict) else "no list"
    return f"no {_WORDS[kind]}" if isinstance(kind, type) else structure
