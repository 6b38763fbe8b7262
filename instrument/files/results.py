"""Where results lie: those that are there, and a free name for the next. Only records are read."""

from __future__ import annotations

import itertools
from pathlib import Path

from instrument.files.errors import FileError
from instrument.files.reading import parse_json, read_bytes

_DEEP = 3
"""Folders are searched so many levels down: runs lie in the data folder, calibrations and results in runs."""


def find_results(folder: Path | str) -> list[Path]:
    """Return the pictures and volumes with a record of ours in a folder and below, the newest first.

    Only records are read. A folder that is not there holds none.
    """
    found: list[tuple[float, Path]] = []
    for depth in range(_DEEP):
        for record in Path(folder).glob("*/" * depth + "*.json"):
            if _is_record(record):
                found.append((record.stat().st_mtime, record))
    return [path for _, path in sorted(found, reverse=True)]


def _is_record(path: Path) -> bool:
    """Whether a JSON file is the record of a reconstruction, and the reconstruction is there."""
    try:
        with path.open("rb") as file:
            if b'"diffuserbench ' not in file.read(200):  # the program's name stands first
                return False
        record = parse_json(read_bytes(path))
    except (OSError, ValueError, FileError):
        return False  # another program's file
    if not isinstance(record, dict) or not {"grid", "prior", "inputs"} <= record.keys():
        return False
    stem = path.with_suffix("")
    return any(
        stem.with_name(stem.name + suffix).exists() for suffix in (".tif", ".tiff", ".ome.zarr", ".zarr")
    )


def free_result(folder: Path, stem: str, suffix: str) -> Path:
    """Return a name in a folder under which nothing is written yet: ``stem``, else ``stem-2`` and so on."""
    for number in itertools.count(1):
        name = stem if number == 1 else f"{stem}-{number}"
        if not any((folder / f"{name}{s}").exists() for s in {suffix, ".json", ".png"}):
            return folder / f"{name}{suffix}"
    raise AssertionError
