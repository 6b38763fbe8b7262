"""What is read as a whole: a plain file of a sensible size, looked at before memory is taken for it."""

from __future__ import annotations

import json
import os
import re
import stat
import tomllib
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import IO, Any

from instrument.files.errors import FileError, os_reason, size
from instrument.files.pieces import require_pieces

MOST_TEXT_BYTES = 48 << 20
"""Records, plans, configurations: a plan of 100,000 named positions has 20 MB."""
_MOST_JSON_VALUES = 3_000_000
_MOST_TOML_BYTES = 3 << 19
"""Read at a megabyte a second."""
_MOST_KEY_PARTS = 64

_GROWTH_BYTES = 1 << 22
"""A file may grow while it is read, and those of /proc have no size before."""


def read_bytes(path: Path, most: int = MOST_TEXT_BYTES, *, error: type[FileError] = FileError) -> bytes:
    """Return a file's content.

    Raises FileNotFoundError when there is none; ``error`` when it is no plain file (a folder, a pipe, a
    device: reading might never end), has more than ``most`` bytes, or cannot be read.
    """
    said = require_file(path, most, error=error)
    try:
        with open(path, "rb", opener=_at_once) as file:
            data = file.read(said + _GROWTH_BYTES)
    except FileNotFoundError:
        raise
    except OSError as failure:
        raise error(path, f"cannot be read: {os_reason(failure)}") from failure
    if data is None:  # /proc/kmsg: a plain file by its kind
        raise error(path, "is a device, which might never end; a file is expected.", "Name a file.")
    if len(data) > most:
        raise error(path, _too_large(len(data), most))
    return data


def _at_once(path: str, flags: int) -> int:
    """Open a file so that reading it does not wait for what is not there yet."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0))


def require_file(path: Path, most: int | None = None, *, error: type[FileError] = FileError) -> int:
    """Return a plain file's size in bytes; errors as :func:`read_bytes`."""
    try:
        found = path.stat()
    except FileNotFoundError:
        raise
    except (OSError, ValueError) as failure:  # a name with a zero byte
        words = os_reason(failure) if isinstance(failure, OSError) else f"{failure}."
        raise error(path, f"cannot be read: {words}") from failure
    if stat.S_ISDIR(found.st_mode):
        raise error(path, "is a folder; a file is expected.")
    if not stat.S_ISREG(found.st_mode):
        raise error(path, "is a pipe or device, which might never end; a file is expected.", "Name a file.")
    if most is not None and found.st_size > most:
        raise error(path, _too_large(found.st_size, most))
    return found.st_size


def _too_large(n_bytes: int, most: int) -> str:
    return f"has {size(n_bytes)}; a file of this kind has at most {size(most)}."


_SMALL_BYTES = 1 << 27
MOST_EXPANSION = 200
"""No photograph shrinks so much when it is compressed; a bomb or a damaged header does."""


def require_plausible(
    path: Path,
    n_bytes: int,
    stored_bytes: int,
    *,
    small: int = _SMALL_BYTES,
    most: int = MOST_EXPANSION,
    error: type[FileError] = FileError,
) -> None:
    """Refuse pixels that say they are far more than their file can hold, before memory is taken for them.

    ``small`` bytes are taken whatever the file's size: sparse volumes and even masks shrink without end.
    ``most``: times the file's size, by what its compression can do at all.
    """
    if n_bytes > small and n_bytes > most * stored_bytes:
        raise error(
            path,
            f"says that it holds {size(n_bytes)} in {size(stored_bytes)} of file: it is damaged, or made to "
            "fill the memory.",
        )


def stored_bytes(path: Path) -> int:
    """Return the bytes that a file has on its disk, as far as that tells: a hollow one has few."""
    found = path.stat()
    return min(found.st_size, 512 * (getattr(found, "st_blocks", 0) or found.st_size))


def _opened(path: Path) -> IO[bytes]:
    return path.open("rb")


def folder_bytes(
    folder: Path,
    n_bytes: int | None = None,
    pieces: Sequence[tuple[Path, int]] = (),
    *,
    error: type[FileError] = FileError,
) -> int:
    """Return the stored bytes of all files in a folder and below.

    With ``n_bytes``, those of its array's numbers, a file that is larger than they could be is refused; of
    ``pieces``, folders of arrays that are read and what a file of each holds, one that inflates to more.
    """
    files = [file for file in folder.rglob("*") if file.is_file()]
    for file in files if n_bytes is not None else ():
        if file.stat().st_size > 2 * (n_bytes or 0) + MOST_TEXT_BYTES:
            raise error(
                file, f"has {size(file.stat().st_size)}, for numbers of {size(n_bytes or 0)}: damaged."
            )
    for below, piece_bytes in pieces:
        stored = (
            (file.stat().st_size, partial(_opened, file))
            for file in files
            if file.suffix != ".json" and file.is_relative_to(below)
        )
        require_pieces(folder, stored, piece_bytes, error=error)
    return sum(map(stored_bytes, files))


_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_LONG_KEY = re.compile(rf"(?:\.[ \t]*{_PART}[ \t]*){{{_MOST_KEY_PARTS}}}")


def parse_toml(text: str) -> dict[str, Any]:
    """Return what TOML says; raises ValueError for all that is none, nested without end or huge too."""
    if len(text) > _MOST_TOML_BYTES:
        raise ValueError(
            f"it has {size(len(text))}; TOML has at most {size(_MOST_TOML_BYTES)}, JSON may have more"
        )
    if _LONG_KEY.search(text):  # the time and memory for a key grow with the square of its parts
        raise ValueError(f"it has a key of more than {_MOST_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def _each_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    made = dict(pairs)
    if len(made) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r:.60} stands there twice")
    return made


_DIGITS = r"\d{301}"
"""Of a whole number, or of a text: which of them is asked only where there are so many."""


def _of_few_digits(number: str) -> int:
    if len(number.lstrip("-")) > 300:
        raise ValueError("it has a number of more than 300 digits")
    return int(number)


def parse_json(text: str | bytes, *, by_hand: bool = False) -> Any:
    """Return what JSON text says; raises ValueError for all that is none, nested without end or huge too.

    ``by_hand``: people write it, and a key that stands twice is a mistake of theirs (of two the last counts).
    """
    if len(text) > _MOST_JSON_VALUES:
        marks = text.count if isinstance(text, str) else lambda mark: text.count(mark.encode())
        if sum(map(marks, ",[{")) > _MOST_JSON_VALUES:
            raise ValueError(f"it has more than {_MOST_JSON_VALUES} values")
    long = re.search(_DIGITS, text) if isinstance(text, str) else re.search(_DIGITS.encode(), text)
    try:
        return json.loads(
            text,
            object_pairs_hook=_each_once if by_hand else None,
            parse_int=_of_few_digits if long else None,
        )
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
