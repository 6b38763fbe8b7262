"""Files of stability maps: cells as they are made (``cells.jsonl``), and ``stability.json`` with all maps."""

from __future__ import annotations

import json
import platform
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.files.reading import read_bytes
from instrument.files.record import Fields, RecordFormat
from recon.verdict.cases import OF_VOLUMES
from recon.verdict.map import Cell, Size, Stress, StressMap, boundary


def _named(method: str) -> str:
    """Name a method of volumes by its solver, as those of pictures: "volume tv" is "admm tv of volumes"."""
    kind, _, prior = method.partition(" ")
    return f"admm {prior}{OF_VOLUMES}" if kind == "volume" else method


def _of_volumes(fields: Fields) -> Fields:
    maps = {
        name: {**found, "methods": {_named(m): result for m, result in found["methods"].items()}}
        for name, found in fields["maps"].items()
    }
    return {**fields, "maps": maps}


STABILITY = RecordFormat(
    "diffuserbench-stability",
    "stability maps",
    major=2,
    migrate={1: _of_volumes},
    make="Make it with diffuserbench stability.",
    fields=("program", "utc", "machine", "command", "maps"),
)
CELLS = "cells.jsonl"
RESULT = "stability.json"
_KEY = ("map", "size", "axes", "program", "scene")
"""What tells cells apart, as a line has it."""


class CellLog:
    """The cells that were made so far, one JSON line each, so that an interrupted map goes on.

    A line belongs to a map, a size, and the axes, scene and version of the program that it was made with:
    where one of these has changed since, the cells are made again.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / CELLS
        self._cells: dict[tuple[str, ...], dict[tuple[str, int, int], Cell]] = {}
        if self.path.exists():
            self._read()

    def of(self, stress: StressMap, size: Size) -> list[Cell]:
        """Return the cells of a map."""
        return list(self._cells.get(_key(stress, size), {}).values())

    def add(self, stress: StressMap, size: Size, cell: Cell) -> None:
        """Append a cell to the file."""
        key = _key(stress, size)
        entry = {**dict(zip(_KEY, key, strict=True)), **cell.as_json()}
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(entry, allow_nan=False) + "\n")
        self._keep(key, cell)

    def _read(self) -> None:
        lines = read_bytes(self.path).decode().splitlines()
        for number, line in enumerate(lines, 1):
            try:
                entry = json.loads(line)
                # Lines of old have neither program nor scene: they are of another, whatever it was.
                key = (*(str(entry[name]) for name in _KEY[:3]), *(str(entry.get(n)) for n in _KEY[3:]))
                self._keep(key, Cell.from_json({**entry, "method": _named(entry["method"])}))
            except (ValueError, KeyError, TypeError) as error:
                if number == len(lines):  # cut off in mid-line: that cell is made again
                    self._cut_last(lines)
                    return
                raise FileError(
                    self.path, f"line {number} is no cell of a map.", "Remove the file to start again."
                ) from error

    def _cut_last(self, lines: list[str]) -> None:
        write_text(self.path, "".join(f"{line}\n" for line in lines[:-1]))

    def _keep(self, key: tuple[str, ...], cell: Cell) -> None:
        self._cells.setdefault(key, {})[(cell.method, cell.ix, cell.iy)] = cell


def _key(stress: StressMap, size: Size) -> tuple[str, ...]:
    """Return what a map's cells depend on, in the order of ``_KEY``."""
    axes = ";".join(f"{a.key}:{','.join(f'{v:g}' for v in a.at(size))}" for a in (stress.x, stress.y))
    scene = f"1 {stress.base}".strip()  # one scene a cell
    return stress.name, size, axes, version("diffuserbench"), scene


def map_record(stress: StressMap, size: Size, cells: Sequence[Cell]) -> dict[str, Any]:
    """Return a map as ``stability.json`` has it (docs/reference/stability-json.md)."""
    x, y = stress.x.at(size), stress.y.at(size)
    methods: dict[str, Any] = {}
    places = _grid(x, y, lambda k: k)
    for method in stress.methods:
        mine = {(c.iy, c.ix): c for c in cells if c.method == method}
        if not mine:
            continue
        severity = [[mine[k].severity if k in mine else np.nan for k in row] for row in places]
        methods[method] = {
            "error": _grid(x, y, lambda k, mine=mine: _maybe(mine, k, "error")),
            "severity": _grid(x, y, lambda k, mine=mine: _maybe(mine, k, "severity")),
            "failure": _grid(x, y, lambda k, mine=mine: _failure(mine, k)),
            "boundary": boundary(x, y, np.array(severity), logarithmic=stress.x.logarithmic),
            "evidence": [
                {"ix": c.ix, "iy": c.iy, **{k: _short(v) for k, v in e.items()}}
                for c in mine.values()
                for e in c.evidence
            ],
            "seconds": round(sum(c.seconds for c in mine.values()), 2),
        }
    return {
        "title": stress.title,
        "question": stress.question,
        "size": size,
        "error": stress.error,
        "x": _axis(stress.x, size),
        "y": _axis(stress.y, size),
        "methods": methods,
    }


def write_stability(folder: Path, maps: Mapping[str, Any], command: str) -> Path:
    """Write ``stability.json``: the given maps take the place of those of their name, others stay."""
    path = folder / RESULT
    before = read_stability(path) if path.exists() else {"maps": {}}
    record = {
        **before,  # also what a newer version may have added
        "program": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": platform.machine(),
        "command": command,
        "maps": {**before["maps"], **maps},
    }
    STABILITY.write(path, record, indent=None)
    return path


def read_stability(path: Path) -> dict[str, Any]:
    """Read ``stability.json``; errors name the file."""
    record = STABILITY.read(path)
    with STABILITY.damaged(path):
        dict(record["maps"])
    return record


def _axis(axis: Stress, size: Size) -> dict[str, Any]:
    ticks = {} if axis.named is None else {"ticks": [axis.named(v, size) for v in axis.at(size)]}
    return {
        "key": axis.key,
        "label": axis.label,
        "unit": axis.unit,
        "values": list(axis.at(size)),
        "logarithmic": axis.logarithmic,
        **ticks,
    }


def _grid(x: Sequence[float], y: Sequence[float], value: Any) -> list[list[Any]]:
    return [[value((iy, ix)) for ix in range(len(x))] for iy in range(len(y))]


def _maybe(cells: Mapping[tuple[int, int], Cell], key: tuple[int, int], name: str) -> float | None:
    value = getattr(cells[key], name) if key in cells else None
    return None if value is None or not np.isfinite(value) else _short(value)


def _short(value: float) -> float:
    """Five digits: more are noise."""
    return float(f"{value:.5g}")


def _failure(cells: Mapping[tuple[int, int], Cell], key: tuple[int, int]) -> str | None:
    failure = cells[key].failure if key in cells else None
    return None if failure is None else failure.name.lower()
