"""Declared options as text: what people type for a value, and how it is shown in help and reference."""

from __future__ import annotations

import dataclasses
import enum
import math
import re
import shlex
import typing
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from recon.base.as_python import expression
from recon.base.declare import Declaration, Option, changed, options_of
from recon.errors import InputError


def read(o: Option, typed: str | Sequence[str]) -> Any:
    """Return the value that people typed; what is repeated or has several words comes as a sequence.

    Limits and choices are not checked here (:meth:`~recon.base.declare.Option.mistake` does).

    Raises InputError with the flag, what was expected and what was found.
    """
    if o.item is not None:
        one = dataclasses.replace(o, type=o.item)
        return tuple(read(one, word) for word in ([typed] if isinstance(typed, str) else typed))
    said = o.declaration
    if said.parse_all is not None:
        try:
            return said.parse_all([typed] if isinstance(typed, str) else typed)
        except ValueError as error:
            raise InputError(f"{o.flag}: {error}") from None
    if isinstance(typed, str) and said.none_word and typed == said.none_word:
        return None
    kinds = next((typing.get_args(kind) for kind in o.kinds if typing.get_origin(kind) is tuple), ())
    if kinds and said.parse is None:
        words = typed.split(",") if isinstance(typed, str) else typed
        if len(words) != len(kinds):
            raise InputError(f"{o.flag} must be {metavar(o)}, {len(kinds)} numbers, not {typed!r}.")
        return tuple(
            read(dataclasses.replace(o, type=kind), word) for kind, word in zip(kinds, words, strict=True)
        )
    assert isinstance(typed, str)
    if said.parse is not None:
        try:
            return said.parse(typed)
        except ValueError as error:
            raise InputError(f"{o.flag} {typed!r}: {error}") from None
    return _of_kind(o, typed)


def _of_kind(o: Option, typed: str) -> Any:
    for kind in o.kinds:
        if isinstance(kind, type) and issubclass(kind, enum.Enum) and typed in [e.value for e in kind]:
            return kind(typed)
    if typed in o.words:
        return typed
    if {int, float} & set(o.kinds) and (number := _number(o, typed)) is not None:
        return number
    if Path in o.kinds:
        return Path(typed)
    if str in o.kinds or (o.words and not {int, float} & set(o.kinds)):
        return typed
    raise InputError(f"{o.flag} must be {o.expected(typed=True)}, not {typed!r}.")


def _number(o: Option, typed: str) -> int | float | None:
    try:
        value = int(typed) if o.is_whole else float(typed)
    except ValueError:
        return None
    if value == math.inf and o.declaration.infinity is not None:
        return o.declaration.infinity
    return value if o.is_whole else value * o.declaration.shown_factor if math.isfinite(value) else None


def size(typed: str) -> tuple[int, int]:
    """Read a size or grid, ``1080x1920``: rows and columns. For declarations (``parse=size``).

    Raises
    ------
    ValueError
    """
    if found := re.fullmatch(r"([1-9]\d*)[xX]([1-9]\d*)", typed):
        return int(found[1]), int(found[2])
    raise ValueError("write rows x columns, two whole numbers above 0, for example 3x5.")


_MOST_DIGITS = 1e12
"""Whole numbers from here on have an exponent."""


def shown(o: Option, value: Any) -> str:
    """Return a value as people type it."""
    if value is None:
        return o.declaration.none_word
    if isinstance(value, enum.Enum):
        return str(value.value)
    if isinstance(value, int | float) and not isinstance(value, bool):
        if value == o.declaration.infinity:
            return "inf"
        number = value / o.declaration.shown_factor
        return f"{number:.0f}" if abs(number) < _MOST_DIGITS and number == round(number) else f"{number:.6g}"
    if isinstance(value, tuple | list):
        return ("," if "," in o.declaration.metavar else " ").join(shown(o, one) for one in value)
    return str(value)


def command_line(name: str, *objects: object) -> str:
    """Return the words that carry out a command in the terminal with these objects' options."""
    first, others = [], []
    for o, value in (pair for one in objects for pair in changed(one)):
        each = [shown(o, one) for one in value] if o.item is not None else [shown(o, value)]
        if o.declaration.positional:
            first += each
        elif isinstance(value, bool):
            others.append(o.flags[0].split("/")[-1] if not value else o.flag)
        else:
            others += [word for one in each for word in (o.flag, one)]
    return shlex.join(["diffuserbench", *name.split(), *first, *others])


def default_shown(o: Option) -> str:
    """Return in words what holds where nothing is given; empty where there is nothing to say."""
    if o.declaration.default_words:
        return o.declaration.default_words
    if o.is_required or o.default is False or (o.default is True and "/" not in "".join(o.flags)):
        return ""
    return o.flag.lstrip("-") if o.default is True else shown(o, o.default)


def metavar(o: Option) -> str:
    """Return what stands for a value: as declared, its words, its unit, or what kind of thing it is."""
    said = o.declaration
    if said.metavar:
        return said.metavar
    kinds = (o.item,) if o.item is not None else o.kinds
    words = [*o.words, *((said.none_word,) if said.none_word else ())]
    if {int, float} & set(kinds):
        words.append(
            (said.shown_unit or said.unit or ("N" if o.is_whole and o.item is None else "X")).upper()
        )
    if Path in kinds:
        words.append("FILE")
    return "|".join(words) or "TEXT"


def help_text(o: Option, *, choices: bool = False) -> str:
    """Return its words with the choices, if wanted, the limits that are not obvious, and the default."""
    obvious = ("0 or more", "1 or more", "above 0")
    notes = [", ".join(o.words)] if choices else []
    if default := default_shown(o):
        notes.append(f"default: {default}")
    notes += [limit for limit in o.limits(typed=True) if limit not in obvious]
    if o.is_required:
        notes.append("required")
    return o.declaration.help + (f"  [{'; '.join(notes)}]" if notes else "")


def table(cls: type) -> str:
    """Return a Markdown table of an options class: for the reference pages."""
    rows = ["| in Python | on the command line | default | what it is |", "| --- | --- | --- | --- |"]
    group = ""
    options = options_of(cls)
    order = list(dict.fromkeys(o.declaration.group for o in options))
    for o in sorted(options, key=lambda o: order.index(o.declaration.group)):
        if o.declaration.group != group:
            group = o.declaration.group
            rows.append(f"| **{group}** | | | |")
        rows.append(_row(o, o.declaration))
    return "\n".join(rows) + "\n"


def _row(o: Option, said: Declaration) -> str:
    switch = bool in o.kinds
    typed = "" if not o.flags else f"`{', '.join(o.flags)}{'' if switch else f' {metavar(o)}'}`"
    if o.declaration.positional and o.words:
        typed = f"`{'|'.join(o.words)}`"
    default = "required" if o.is_required else said.default_words or f"`{expression(o.default)}`"
    limits = f" ({', '.join(o.limits())})" if o.limits() else ""
    applies = f" Of a {', '.join(said.applies)}." if said.applies else ""
    unit = f" In {said.unit}." if said.unit else ""
    cells = (f"`{o.name}`", typed, f"{default}{limits}", f"{said.help}{unit}{applies}")
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
