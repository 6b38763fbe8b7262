"""Options declared once: fields of a frozen dataclass that carry their own words, unit and limits.

The command line, the window's forms, "Copy as Python", the record beside a result, a checkpoint's identity,
refusals and the reference pages are made from these declarations; nobody repeats a default or a sentence.
"""

from __future__ import annotations

import copy
import dataclasses
import difflib
import enum
import functools
import math
import os
import re
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from pathlib import Path
from typing import Any, TypeVar

from recon.errors import InputError

_KEY = "declared"
RARE = "Rarely needed"
"""The group that help and forms show last."""
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
    infinity : float, optional
        What the word ``inf`` stands for, in ``unit``; None: it is no value.
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
        Whether it belongs to the record beside a result.
    identifies : bool
        Whether work that was kept with another value is other work; False for what only says when to stop.
    parse : callable, optional
        Makes the value of the words that people type, where the type does not tell how; raises InputError or
        ValueError with a sentence. Given once for each word of a repeated option.
    parse_all : callable, optional
        Makes one value of all the words of an option that may be repeated (``NAME=VALUE``, say).
    replaced : callable, optional
        Returns words that it could be once, and what replaces each, as a sentence.
    none_word : str
        What people type for None ("auto", say); empty: None cannot be typed.
    positional : bool
        Whether the command line takes it without a flag, as what the command is about.
    """

    help: str
    unit: str = ""
    shown_unit: str = ""
    shown_factor: float = 1.0
    least: float = -math.inf
    most: float = math.inf
    above: float = -math.inf
    below: float = math.inf
    infinity: float | None = None
    choices: Callable[[], Sequence[str]] | Sequence[str] = ()
    group: str = ""
    flags: tuple[str, ...] = ()
    metavar: str = ""
    label: str = ""
    default_words: str = ""
    applies: tuple[str, ...] = ()
    recorded: bool = True
    identifies: bool = True
    parse: Callable[[str], Any] | None = None
    parse_all: Callable[[Sequence[str]], Any] | None = None
    replaced: Callable[[], Mapping[str, str]] = dict
    none_word: str = ""
    positional: bool = False

    def words(self) -> tuple[str, ...]:
        """Return the words that it is declared to be; empty where it is no choice of words."""
        return tuple(self.choices() if callable(self.choices) else self.choices)


@dataclass(frozen=True)
class Option:
    """A declared field: its name, type, default and declaration."""

    name: str
    type: Any
    default: Any
    declaration: Declaration

    @functools.cached_property
    def kinds(self) -> tuple[Any, ...]:
        """The types that its value may have, without None."""
        inside = typing.get_args(self.type)
        is_union = inside and typing.get_origin(self.type) not in (tuple, list, dict, typing.Literal)
        return tuple(k for k in (inside if is_union else (self.type,)) if k is not type(None))

    @property
    def is_required(self) -> bool:
        """Whether it has no default."""
        return self.default is dataclasses.MISSING

    @property
    def words(self) -> tuple[str, ...]:
        """The words that it can be: as declared, else of its Literal and enumeration types."""
        if said := self.declaration.words():
            return said
        found: list[str] = []
        for kind in self.kinds:
            if typing.get_origin(kind) is typing.Literal:
                found += [word for word in typing.get_args(kind) if isinstance(word, str)]
            elif isinstance(kind, type) and issubclass(kind, enum.Enum):
                found += [str(member.value) for member in kind]
        return tuple(found)

    @property
    def item(self) -> Any:
        """Of a repeated option (``tuple[X, ...]``) the type X of one; else None."""
        for kind in self.kinds:
            if typing.get_origin(kind) is tuple and typing.get_args(kind)[1:] == (...,):
                return typing.get_args(kind)[0]
        return None

    @property
    def flags(self) -> tuple[str, ...]:
        """Its names on the command line, with both of a switch as ``--on/--off``; empty: not offered."""
        if self.declaration.flags or self.declaration.positional:
            return tuple(flag for flag in self.declaration.flags if flag)
        said, name = self.declaration, self.name
        if said.shown_unit and name.endswith(f"_{said.unit}"):
            name = f"{name.removesuffix(f'_{said.unit}')}_{said.shown_unit}"
        name = name.replace("_", "-")
        return (
            (f"--{name}/--no-{name}",) if bool in self.kinds and self.default is not False else (f"--{name}",)
        )

    @property
    def flag(self) -> str:
        """The name that people are told: the first long one, of a switch what turns it on."""
        bare = self.declaration.metavar if self.declaration.positional else self.name
        return next((flag.partition("/")[0] for flag in self.flags if flag.startswith("--")), bare)

    @property
    def label(self) -> str:
        """How a form names it, with the unit that people read."""
        said = self.declaration
        unit = said.shown_unit or said.unit
        name = said.label or self.name.removesuffix(f"_{said.unit}").replace("_", " ").capitalize()
        return f"{name} ({unit})" if unit else name

    def mistake(self, value: object, *, typed: bool = False) -> str | None:
        """Say what is wrong with a value; None where nothing is.

        With ``typed`` in the words of the command line: its flag, and the unit that people type.
        """
        if value is self.default:
            return None
        name = self.flag if typed else self.name
        if value is None:
            may_be = self.default is None or type(None) in typing.get_args(self.type)
            return None if may_be else f"{name} must be given, not None."
        if self.item is not None and isinstance(value, Sequence) and not isinstance(value, str):
            one = dataclasses.replace(self, type=self.item, default=0)
            return next((wrong for v in value if (wrong := one.mistake(v, typed=typed))), None)
        if (words := self.words) and isinstance(value, str) and value not in words:
            if instead := self.declaration.replaced().get(value):
                return f"{name}: {instead}"
            near = difflib.get_close_matches(value.lower(), words, 1)
            meant = f". Did you mean {near[0]!r}?" if near else "."
            return f"{name} must be one of {', '.join(words)}, not {value!r}{meant}"
        if self.kinds == (bool,) and not isinstance(value, bool):
            return f"{name} must be True or False, not {value!r}."
        if any(_fits(kind, value) for kind in self.kinds):
            return None
        if isinstance(value, type) and any(issubclass(value, k) for k in self.kinds if isinstance(k, type)):
            return f"{name} must be an object, not its class: {value.__name__}(...)."
        if not {int, float} & set(self.kinds):
            return f"{name} must be {self.expected(typed=typed)}, not {_shown(value)}."
        said = self.declaration
        kind = Integral if self.is_whole else Real
        is_number = isinstance(value, kind) and not isinstance(value, bool)
        if is_number and said.infinity is not None and value == math.inf:
            return None
        # A NaN fails every comparison.
        if is_number and said.least <= value <= said.most and said.above < value < said.below:  # type: ignore[operator]
            return None
        shown = f"{value / said.shown_factor:g}" if typed and is_number else _shown(value)  # type: ignore[operator]
        expected = self.expected(typed=typed)
        if is_number and said.infinity is None and math.isinf(value):  # type: ignore[arg-type]
            expected = expected.replace("a number", "a finite number", 1)
        return f"{name} must be {expected}, not {shown}."

    @property
    def is_whole(self) -> bool:
        """Whether of the numbers only whole ones will do."""
        return float not in self.kinds

    def limits(self, *, typed: bool = False) -> tuple[str, ...]:
        """Return its limits in words; with ``typed`` in the unit that people type."""
        said = self.declaration
        factor = said.shown_factor if typed else 1.0
        limits = (
            f"{said.least / factor:g} or more" if said.least > -math.inf else "",
            f"above {said.above / factor:g}" if said.above > -math.inf else "",
            f"{said.most / factor:g} or less" if said.most < math.inf else "",
            f"below {said.below / factor:g}" if said.below < math.inf else "",
        )
        return tuple(limit for limit in limits if limit)

    def expected(self, *, typed: bool = False) -> str:
        """Say which values are allowed."""
        said = self.declaration
        words = [*self.words, *((said.none_word,) if said.none_word and typed else ())]
        if not {int, float} & set(self.kinds):
            others = [_in_words(kind) for kind in self.kinds if not (kind is str and words)]
            others = [said for said in others if said]
            return " or ".join(([f"one of {', '.join(words)}"] if words else []) + others) or "given"
        number = ", ".join(["a whole number" if self.is_whole else "a number", *self.limits(typed=typed)])
        unit = (said.shown_unit if typed else "") or said.unit
        number += f" ({unit})" if unit else ""
        number += ", or inf" if said.infinity is not None else ""
        if Path in self.kinds:
            words.append("the name of a file")
        return f"{', '.join(words)} or {number}" if words else number


def _shown(value: object) -> str:
    shape = getattr(value, "shape", ())
    return f"an array of shape {shape}" if shape else repr(value)


def _fits(kind: Any, value: object) -> bool:
    """Whether a value is of a type, as far as that can be told; numbers are judged with their limits."""
    if kind in (int, float):
        return False
    if typing.get_origin(kind) is typing.Literal:
        return isinstance(value, str)  # which words is another question
    if typing.get_origin(kind) is tuple:
        several = (
            hasattr(value, "__len__") and not isinstance(value, str) and getattr(value, "shape", None) != ()
        )
        items = typing.get_args(kind)
        return several and (items[1:] == (...,) or len(value) == len(items))  # type: ignore[arg-type]
    if not isinstance(kind, type):
        return True
    if kind is Path and isinstance(value, os.PathLike):
        return isinstance(os.fspath(value), str)
    also = str if kind is Path else tuple if issubclass(kind, tuple) else ()
    return isinstance(value, (kind, also))


def _in_words(kind: Any) -> str:
    """Say what a value of a type is; empty where its words say it."""
    if kind is Path:
        return "the name of a file"
    if kind is Callable:
        return "a function"
    if inside := typing.get_args(kind):
        many = typing.get_origin(kind) is tuple
        return f"{'several' if inside[1:] == (...,) else len(inside)} values" if many else ""
    if not isinstance(kind, type) or issubclass(kind, enum.Enum):
        return ""
    if kind is str:
        return "a text"
    return f"{'an' if kind.__name__[0] in 'AEIOU' else 'a'} {kind.__name__}"


def option(default: Any = dataclasses.MISSING, **declaration: Any) -> Any:
    """Declare a field of an options class, required without a default; keywords as :class:`Declaration`."""
    return dataclasses.field(default=default, metadata={_KEY: Declaration(**declaration)})


_FLAG = re.compile(r"(?:diffuserbench|dask) [^.,;:()]*|(?<![^\s(\[{\"'`“‘])--[a-z][\w-]*")
"""A command, or a flag; no dashes within a word or a path."""


def in_other_words(
    text: str,
    options: Iterable[Option],
    named: Callable[[Option], str],
    otherwise: Callable[[str], str] = lambda flag: flag,
) -> str:
    """Return a message with what the options are ``named`` elsewhere in place of the terminal's flags.

    A whole command ("diffuserbench snap --dark") stays as it is typed; ``otherwise`` names a flag of none.
    """
    if not _FLAG.search(text):
        return text  # most helps have none, and a form asks for each of its fields
    names: dict[str, str] = {}
    for option in options:
        on_off = [flag.split("/") for flag in option.flags if flag.startswith("--")]
        names |= {off: f"{named(option)} off" for _, *offs in on_off for off in offs}
        names |= {on: named(option) for on, *_ in on_off}
    return _FLAG.sub(
        lambda flag: names.get(flag[0]) or (otherwise(flag[0]) if flag[0][0] == "-" else flag[0]), text
    )


def options_of(declared: type | object) -> tuple[Option, ...]:
    """Return the declared fields of an options class or object, in order."""
    return _options_of(declared if isinstance(declared, type) else type(declared))


@functools.cache
def _options_of(cls: type) -> tuple[Option, ...]:
    hints = typing.get_type_hints(cls)  # takes a millisecond: as long as an iteration of a small picture
    return tuple(
        Option(field.name, hints[field.name], field.default, field.metadata[_KEY])
        for field in dataclasses.fields(cls)
        if _KEY in field.metadata
    )


def mistakes(options: object) -> list[str]:
    """Return everything that is wrong with an options object, one sentence each."""
    values = ((o, getattr(options, o.name)) for o in options_of(options))
    found = (o.mistake(value) for o, value in values if value is not o.default)
    return [mistake for mistake in found if mistake is not None]


def require(options: object) -> None:
    """Raise InputError that names all mistakes of an options object at once."""
    if found := mistakes(options):
        raise InputError(" ".join(found))


def with_overrides(options: _T, overrides: Mapping[str, Any]) -> _T:
    """Return options with some fields replaced.

    Raises InputError for a name that is no option, with the nearest one that is.
    """
    require_known(overrides, type(options))
    return dataclasses.replace(options, **overrides) if overrides else options  # type: ignore[type-var]


OTHER_NAMES = {
    **dict.fromkeys(("weight", "lambda", "lam", "regularization", "regularisation"), "tau"),
    "output": "out",
}
"""What other programs call an option; too far from its name here to be guessed."""


def require_known(names: Iterable[str], *classes: type) -> None:
    """Raise InputError for a name that is no option of these classes, with the one that may be meant."""
    known = [field.name for cls in classes for field in dataclasses.fields(cls)]
    for name in names:
        if name not in known:
            meant = OTHER_NAMES.get(name)
            near = [meant] if meant in known else difflib.get_close_matches(name, known, 1)
            hint = f" Did you mean {near[0]!r}?" if near else f" There are {', '.join(known)}."
            flag = f"--{name.replace('_', '-')}"  # an old name goes on working on the command line
            if new := next((o for cls in classes for o in options_of(cls) if flag in o.flags), None):
                unit = new.declaration.unit
                hint = f" It is called {new.name!r}{f', in {unit}' if unit else ''}."
            raise InputError(f"There is no option {name!r}.{hint}")


def settled(options: _T, **values: Any) -> _T:
    """Return options with some values that the program itself chose: they are not checked again."""
    made = copy.copy(options)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def changed(options: object) -> Iterator[tuple[Option, Any]]:
    """Yield the options that differ from their defaults, with their values."""
    for o in options_of(options):
        value = getattr(options, o.name)
        if value is not o.default and not same(value, o.default):
            yield o, value


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal; arrays of several numbers are not taken for equal."""
    try:
        return bool(one == other)
    except ValueError:  # arrays
        return False


def inapplicable(options: object, subject: str) -> list[Option]:
    """Return the options that differ from their defaults and do not apply to a subject ("video", say)."""
    return [o for o, _ in changed(options) if o.declaration.applies and subject not in o.declaration.applies]


def record(options: object) -> dict[str, Any]:
    """Return what is recorded of options, JSON-compatible: the same for the same work."""
    return {o.name: _plain(getattr(options, o.name)) for o in options_of(options) if o.declaration.recorded}


def identity(options: object) -> dict[str, Any]:
    """Return, JSON-compatible, what must be the same for kept work to be gone on with."""
    kept = (o for o in options_of(options) if o.declaration.recorded and o.declaration.identifies)
    return {o.name: _plain(getattr(options, o.name)) for o in kept}


def _plain(value: Any) -> Any:
    if isinstance(value, enum.Enum):
        return value.value
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, os.PathLike):
        return str(os.fspath(value))
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if hasattr(value, "tolist"):
        return value.tolist()
    if isinstance(value, Sequence):
        return [_plain(v) for v in value]
    return repr(value)
