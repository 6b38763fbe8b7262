"""Mistakes in a configuration, with their lines, said so that a person can put them right."""

from __future__ import annotations

import difflib
import re
import types
import typing
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Union

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from instrument.files.errors import ConfigProblem, mistake_in_words

# Suffix to (dimension, factor to its base unit); how units are written in this project's names.
_UNITS: Mapping[str, tuple[str, float]] = {
    "ns": ("time", 1e-9), "us": ("time", 1e-6), "ms": ("time", 1e-3), "s": ("time", 1.0),
    "min": ("time", 60.0),
    "nm": ("length", 1e-9), "um": ("length", 1e-6), "mm": ("length", 1e-3), "cm": ("length", 1e-2),
    "m": ("length", 1.0), "urad": ("angle", 1e-6), "mrad": ("angle", 1e-3), "rad": ("angle", 1.0),
    "deg": ("angle", 0.017453292519943295), "hz": ("rate", 1.0), "khz": ("rate", 1e3),
}  # fmt: skip


class Mistakes:
    """Collects the mistakes of one file, with lines."""

    def __init__(self, lines: Mapping[KeyPath, int]) -> None:
        self._lines = lines
        self.problems: list[ConfigProblem] = []

    def __bool__(self) -> bool:
        return bool(self.problems)

    def add(self, path: KeyPath, where: str, text: str) -> None:
        """Note one mistake at a key; ``where`` is how the text names it."""
        self.problems.append(ConfigProblem(self._lines.get(path), where, text))

    def add_all(
        self,
        error: ValidationError,
        model: type[BaseModel],
        table: tuple[str, ...],
        known: Sequence[str],
        content: Mapping[str, Any],
    ) -> None:
        """Note every mistake that a model found in a table with this content.

        ``known`` are the keys allowed at the table's top level, which may be more than the model's own.
        """
        for detail in error.errors(include_url=False):
            path = self._place(table, detail["loc"])
            name = _spell((*path[1:], *_unplaced(table, detail, path)))
            where = f"[{table[0]}] {name}".rstrip()
            names_in_loc = [i for i, step in enumerate(detail["loc"]) if isinstance(step, str)]
            inner = _models_at(model, detail["loc"][: max(names_in_loc, default=0)], content)
            names = tuple(known) if inner == (model,) else tuple(key for m in inner for key in m.model_fields)
            self.add(path, where, _sentence(detail, names, inner))

    def _place(self, table: tuple[str, ...], loc: Iterable[str | int]) -> KeyPath:
        """Follow ``loc`` as far as the file goes; it also holds names of alternatives that no file has."""
        path: KeyPath = table
        for step in loc:
            if (*path, step) in self._lines:
                path = (*path, step)
        return path


def nearest_name(name: str, names: Iterable[str]) -> str | None:
    """Return the name that was probably meant, or None where none is close."""
    names = list(names)
    if close := difflib.get_close_matches(name.lower(), names, n=1, cutoff=0.6):
        return close[0]
    longer = [known for known in names if len(name) > 2 and known.startswith(name.lower())]
    return longer[0] if len(longer) == 1 else None


def nearest(name: str, names: Iterable[str]) -> str:
    """Return ``" Did you mean 'x'?"``, or nothing where no name is close."""
    close = nearest_name(name, names)
    return f" Did you mean {close!r}?" if close else ""


def _sentence(detail: ErrorDetails, names: Sequence[str], models: Sequence[type[BaseModel]]) -> str:
    kind, key, value = detail["type"], detail["loc"][-1] if detail["loc"] else "", detail["input"]
    if kind == "extra_forbidden":
        hint = _other_unit(str(key), value, names) or nearest(str(key), names)
        return f"there is no such key.{hint}" + (f" Keys here: {', '.join(names)}." if names else "")
    if kind == "missing":
        return f"{mistake_in_words(detail)}.{_about(detail, models)}"
    found = "" if isinstance(value, Mapping) else f", not {value!r}"  # a whole table is in the file to see
    return f"{mistake_in_words(detail)}{found}.{_about(detail, models)}"


def _about(detail: ErrorDetails, models: Sequence[type[BaseModel]]) -> str:
    """Return a space and the description of the key that a mistake is about, or nothing."""
    names = [step for step in detail["loc"] if isinstance(step, str)]
    fields = [model.model_fields[names[-1]] for model in models if names and names[-1] in model.model_fields]
    return f" {fields[0].description}" if fields and fields[0].description else ""


def _other_unit(key: str, value: object, names: Iterable[str]) -> str:
    """Say how ``exposure_s = 0.01`` is written where the key is ``exposure_ms``."""
    stem, _, unit = key.rpartition("_")
    if not stem or unit not in _UNITS:
        return ""
    dimension, factor = _UNITS[unit]
    for name in names:
        other_stem, _, other = name.rpartition("_")
        if other_stem == stem and other in _UNITS and _UNITS[other][0] == dimension:
            hint = f" Did you mean {name!r}?"
            if isinstance(value, int | float) and not isinstance(value, bool):
                hint += f" {key} = {value:g} would be {name} = {value * factor / _UNITS[other][1]:.6g}."
            return hint
    return ""


def _spell(path: Iterable[str | int]) -> str:
    text = ""
    for step in path:
        text += f"[{step}]" if isinstance(step, int) else f".{step}" if text else step
    return text


def _unplaced(table: tuple[str, ...], detail: ErrorDetails, path: KeyPath) -> KeyPath:
    """Return the last step of a mistake's place where the file does not hold it: a missing key."""
    missing = (
        detail["type"] == "missing"
        and detail["loc"]
        and (len(path) == len(table) or path[-1] != detail["loc"][-1])
    )
    return (detail["loc"][-1],) if missing else ()


def _models_at(
    model: type[BaseModel], loc: Iterable[str | int], content: object
) -> tuple[type[BaseModel], ...]:
    """Return the models that the keys at a place inside ``model`` belong to, as far as annotations tell.

    It is one, or two where a model has an ``options_model``: a classmethod that tells from the content of its
    table what checks the keys that it does not know itself.
    """
    current: tuple[Any, ...] = (model,)
    in_table_of_models = False
    for step in loc:
        content = content.get(step) if isinstance(content, Mapping) else None
        if isinstance(step, int):
            continue  # an element of an array belongs to the model that the array holds
        if in_table_of_models:
            in_table_of_models = False
        else:
            field = next((m.model_fields[step] for m in current if step in m.model_fields), None)
            inner = None if field is None else _only_model(field.annotation)
            if field is None or inner is None:
                return ()
            in_table_of_models = typing.get_origin(field.annotation) is dict
            current = (inner,)
            if in_table_of_models:
                continue
        options_model = getattr(current[0], "options_model", None)
        more = options_model(content) if options_model else None
        current = (*current, more) if more else current
    return current


def _only_model(annotation: Any) -> Any:
    """Return the one model in an annotation such as ``Model | None`` or ``tuple[Model, ...]``, else None."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (Union, types.UnionType, tuple, list, dict):
        models = {found for part in typing.get_args(annotation) if (found := _only_model(part))}
        return models.pop() if len(models) == 1 else None
    return None


KeyPath = tuple[str | int, ...]
"""Names of tables and keys from the top; integers count the elements of arrays."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_SCALAR = re.compile(r"[^,\]}#\n]*")
_STRINGS = tuple(
    re.compile(pattern, re.DOTALL)
    for pattern in (
        r'"""(?:\\.|.)*?"""(?:"{0,2})(?!")',
        r"'''.*?'''(?:'{0,2})(?!')",
        r'"(?:\\.|[^"\\\n])*"',
        r"'[^'\n]*'",
    )
)


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every key, table and array element of a TOML text.

    Of a text that ``tomllib`` does not accept, those up to its first flaw. ``("camera", "roi", 0)`` leads to
    the line where that element begins; a table that several headers or dotted keys build up has the line of
    its first mention.
    """
    return _Scanner(text).scan()


class _FlawError(Exception):
    """The text is no TOML here."""


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line = 1
        self._counted_to = 0
        self._lines: dict[KeyPath, int] = {}
        self._tables_in_array: dict[KeyPath, int] = {}

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        try:
            self._skip(_BLANK)
            while self._at < len(self._text):
                if self._peek("["):
                    table = self._header()
                else:
                    self._key_and_value(table)
                self._skip(_BLANK)
        except _FlawError:
            pass  # the caller reports tomllib's own message; lines found so far stay useful
        return self._lines

    # Statements --------------------------------------------------------------------------------
    def _header(self) -> KeyPath:
        line = self._line_here()
        is_array = self._text.startswith("[[", self._at)
        self._at += 2 if is_array else 1
        names = self._dotted_key()
        self._expect("]]" if is_array else "]")
        path: KeyPath = ()
        for depth, name in enumerate(names):
            path = (*path, name)
            if is_array and depth == len(names) - 1:
                self._lines.setdefault(path, line)
                index = self._tables_in_array.get(path, -1) + 1
                self._tables_in_array[path] = index
                path = (*path, index)
            elif path in self._tables_in_array:
                path = (*path, self._tables_in_array[path])
            self._lines.setdefault(path, line)
        return path

    def _key_and_value(self, table: KeyPath) -> None:
        line = self._line_here()
        path = table
        for name in self._dotted_key():
            path = (*path, name)
            self._lines.setdefault(path, line)
        self._expect("=")
        self._skip(_SPACE)
        self._value(path)

    def _dotted_key(self) -> list[str]:
        names = []
        while True:
            self._skip(_SPACE)
            names.append(self._simple_key())
            self._skip(_SPACE)
            if not self._peek("."):
                return names
            self._at += 1

    def _simple_key(self) -> str:
        if self._peek('"') or self._peek("'"):
            quoted = self._take(_STRINGS[2] if self._peek('"') else _STRINGS[3])
            return quoted[1:-1]
        return self._take(_BARE_KEY)

    # Values ------------------------------------------------------------------------------------
    def _value(self, path: KeyPath) -> None:
        if self._peek("["):
            self._array(path)
        elif self._peek("{"):
            self._inline_table(path)
        elif self._peek('"') or self._peek("'"):
            self._string()
        else:
            self._take(_SCALAR)

    def _array(self, path: KeyPath) -> None:
        self._at += 1
        index = 0
        while True:
            self._skip(_BLANK)
            if self._peek("]"):
                self._at += 1
                return
            self._lines.setdefault((*path, index), self._line_here())
            self._value((*path, index))
            index += 1
            self._separator("]")

    def _inline_table(self, path: KeyPath) -> None:
        self._at += 1
        while True:
            self._skip(_BLANK)
            if self._peek("}"):
                self._at += 1
                return
            self._key_and_value(path)
            self._separator("}")

    def _separator(self, closing: str) -> None:
        self._skip(_BLANK)
        if self._peek(","):
            self._at += 1
        elif not self._peek(closing):
            raise _FlawError

    def _string(self) -> None:
        for pattern in _STRINGS:
            match = pattern.match(self._text, self._at)
            if match:
                self._at = match.end()
                return
        raise _FlawError

    # Characters --------------------------------------------------------------------------------
    def _peek(self, character: str) -> bool:
        return self._text.startswith(character, self._at)

    def _skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self._text, self._at)
        if match:
            self._at = match.end()

    def _take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if not match or match.end() == self._at:
            raise _FlawError
        self._at = match.end()
        return match.group()

    def _expect(self, mark: str) -> None:
        self._skip(_SPACE)
        if not self._peek(mark):
            raise _FlawError
        self._at += len(mark)

    def _line_here(self) -> int:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        return self._line
