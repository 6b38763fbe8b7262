"""Options declared once: fields of a frozen dataclass that carry their own words, unit and limits.

The command line, the window's forms, "Copy as Python", the record beside a result, a checkpoint's identity,
refusals and the reference pages are made from these declarations; nobody repeats a default or a sentence.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from recon.errors import InputError

_KEY = "declared"
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, kw_only=True)
class Declaration:
    """What a field says of itself.

    Attributes
    ----------
    help : str
        One or two sentences, without the default, the unit or the choices: those are added.
    unit : str
        Of the value in Python, as in ``_um``; empty for none.
    shown_unit, shown_factor : str, float
        Unit that people type and read, and how much of ``unit`` one of it is (1000 for mm of um).
    least, most, above, below : float
        Limits of a number: ``least <= x <= most`` and ``above < x < below``.
    choices : callable or sequence of str
        Words it can be; a callable is asked each time, so that what is registered later appears.
    group : str
        Heading in help, form and reference.
    flags : tuple of str
        Names on the command line, the first is shown; empty: from the field's name; ``("",)``: not offered.
    metavar, label : str
        How the command line and the window name the value; empty: from type and name.
    default_words : str
        What None or the default means, where the value alone does not tell.
    applies : tuple of str
        What it is about ("picture", "volume", "video", "live", ...); empty: everything.
    recorded : bool
        Whether it belongs to the record beside a result and to a checkpoint's identity.
    """

    help: str
    unit: str = ""
    shown_unit: str = ""
    shown_factor: float = 1.0
    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    choices: Callable[[], Sequence[str]] | Sequence[str] = ()
    group: str = ""
    flags: tuple[str, ...] = ()
    metavar: str = ""
    label: str = ""
    default_words: str = ""
    applies: tuple[str, ...] = ()
    recorded: bool = True

    def words(self) -> tuple[str, ...]:
        """Return the words that it can be; empty where it is no choice of words."""
        return tuple(self.choices() if callable(self.choices) else self.choices)


@dataclass(frozen=True, slots=True)
class Option:
    """A declared field: its name, type, default and declaration."""

    name: str
    type: Any
    default: Any
    declaration: Declaration

    @property
    def kinds(self) -> tuple[Any, ...]:
        """The types that its value may have, without None."""
        inside = typing.get_args(self.type)
        is_union = inside and typing.get_origin(self.type) not in (tuple, list, dict, typing.Literal)
        return tuple(k for k in (inside if is_union else (self.type,)) if k is not type(None))

    @property
    def label(self) -> str:
        """How a form names it, with the unit that people read."""
        said = self.declaration
        unit = said.shown_unit or said.unit
        name = said.label or self.name.removesuffix(f"_{said.unit}").replace("_", " ").capitalize()
        return f"{name} ({unit})" if unit else name

    def mistake(self, value: object) -> str | None:
        """Say what is wrong with a value; None where nothing is."""
        said = self.declaration
        if value is None:
            return None if self.default is None else f"{self.name} must be given, not None."
        if (words := said.words()) and isinstance(value, str) and value not in words:
            near = difflib.get_close_matches(value, words, 1)
            meant = f"; {near[0]!r}?" if near else "."
            return f"{self.name} must be one of {', '.join(words)}, not {value!r}{meant}"
        if not {int, float} & set(self.kinds) or not _is_only_number(self.kinds):
            return None
        whole = float not in self.kinds
        kind = Integral if whole else Real
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        # A NaN fails every comparison.
        if is_number and said.least <= value <= said.most and said.above < value < said.below:  # type: ignore[operator]
            return None
        return f"{self.name} must be {self.expected(whole=whole)}, not {value!r}."

    def expected(self, *, whole: bool | None = None) -> str:
        """Say which values are allowed."""
        said = self.declaration
        whole = float not in self.kinds if whole is None else whole
        limits = [
            f"{said.least:g} or more" if said.least > -math.inf else "",
            f"above {said.above:g}" if said.above > -math.inf else "",
            f"{said.most:g} or less" if said.most < math.inf else "",
            f"below {said.below:g}" if said.below < math.inf else "",
        ]
        parts = ["a whole number" if whole else "a number", *(limit for limit in limits if limit)]
        return f"{', '.join(parts)}{f' ({said.unit})' if said.unit else ''}"


def _is_only_number(kinds: tuple[Any, ...]) -> bool:
    return all(kind in (int, float) for kind in kinds)


def option(default: Any, **declaration: Any) -> Any:
    """Declare a field of an options class; keywords as :class:`Declaration`."""
    return dataclasses.field(default=default, metadata={_KEY: Declaration(**declaration)})


def options_of(declared: type | object) -> tuple[Option, ...]:
    """Return the declared fields of an options class or object, in order."""
    cls = declared if isinstance(declared, type) else type(declared)
    hints = typing.get_type_hints(cls)
    return tuple(
        Option(field.name, hints[field.name], field.default, field.metadata[_KEY])
        for field in dataclasses.fields(cls)
        if _KEY in field.metadata
    )


def mistakes(options: object) -> list[str]:
    """Return everything that is wrong with an options object, one sentence each."""
    found = (o.mistake(getattr(options, o.name)) for o in options_of(options))
    return [mistake for mistake in found if mistake is not None]


def require(options: object) -> None:
    """Raise InputError that names all mistakes of an options object at once."""
    if found := mistakes(options):
        raise InputError(" ".join(found))


def with_overrides(options: _T, overrides: Mapping[str, Any]) -> _T:
    """Return options with some fields replaced.

    Raises
    ------
    InputError
        For a name that is no option, with the nearest one that is.
    """
    known = [field.name for field in dataclasses.fields(options)]  # type: ignore[arg-type]
    for name in overrides:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f" Did you mean {near[0]!r}?" if near else f" There are {', '.join(known)}."
            raise InputError(f"{type(options).__name__} has no option {name!r}.{hint}")
    return dataclasses.replace(options, **overrides) if overrides else options  # type: ignore[type-var]


def changed(options: object) -> Iterator[tuple[Option, Any]]:
    """Yield the options that differ from their defaults, with their values."""
    for o in options_of(options):
        value = getattr(options, o.name)
        if value is not o.default and not _same(value, o.default):
            yield o, value


def _same(one: Any, other: Any) -> bool:
    try:
        return bool(one == other)
    except ValueError:  # arrays
        return False


def record(options: object) -> dict[str, Any]:
    """Return what is recorded of options, JSON-compatible: the same for the same work."""
    return {o.name: _plain(getattr(options, o.name)) for o in options_of(options) if o.declaration.recorded}


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, Path):
        return str(value)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Sequence):
        return [_plain(v) for v in value]
    return repr(value)


def expression(options: object) -> str:
    """Return the Python expression that makes these options, without what is default."""
    given = ", ".join(f"{o.name}={value!r}" for o, value in changed(options))
    return f"{type(options).__name__}({given})"
