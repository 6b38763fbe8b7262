"""What is read as a whole: a plain file of a sensible size, looked at before memory is taken for it."""

from __future__ import annotations

import json
import stat
import tomllib
from pathlib import Path
from typing import Any

from instrument.files.errors import FileError, os_reason, size

MOST_TEXT_BYTES = 1 << 27
"""Records, plans, configurations: a plan of 100,000 named positions has 20 MB."""


_GROWTH_BYTES = 1 << 22
"""A file may grow while it is read, and those of /proc have no size before."""


def read_bytes(path: Path, most: int = MOST_TEXT_BYTES, *, error: type[FileError] = FileError) -> bytes:
    """Return a file's content.

    Raises FileNotFoundError when there is none; ``error`` when it is no plain file (a folder, a pipe, a
    device: reading might never end), has more than ``most`` bytes, or cannot be read.
    """
    said = require_file(path, most, error=error)
    try:
        with path.open("rb") as file:
            data = file.read(said + _GROWTH_BYTES)
    except FileNotFoundError:
        raise
    except OSError as failure:
        raise error(path, f"cannot be read: {os_reason(failure)}") from failure
    if len(data) > most:
        raise error(path, _too_large(len(data), most))
    return data


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


_SMALL_BYTES = 1 << 29
_MOST_EXPANSION = 200
"""No photograph shrinks so much when it is compressed; a bomb or a damaged header does."""


def require_plausible(
    path: Path,
    n_bytes: int,
    stored_bytes: int,
    *,
    small: int = _SMALL_BYTES,
    error: type[FileError] = FileError,
) -> None:
    """Refuse pixels that say they are far more than their file can hold, before memory is taken for them.

    ``small`` bytes are taken whatever the file's size: sparse volumes and even masks shrink without end.
    """
    if n_bytes > small and n_bytes > _MOST_EXPANSION * stored_bytes:
        raise error(
            path,
            f"says that it holds {size(n_bytes)} in {size(stored_bytes)} of file: it is damaged, or made to "
            "fill the memory.",
        )


def folder_bytes(folder: Path) -> int:
    """Return the size of all files in a folder and below."""
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


def parse_toml(text: str) -> dict[str, Any]:
    """Return what TOML says; raises ValueError for all that is none, nested without end too."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def parse_json(text: str | bytes) -> Any:
    """Return what JSON text says; raises ValueError for all that is none, nested without end too."""
    try:
        return json.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
