"""A chart of cost against accuracy: each setting in a process of its own, results kept as they come."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from instrument.evaluation.chart_data import ChartData
from instrument.evaluation.chart_process import in_own_process
from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from recon.evaluation.scored import Named, Point, Problem

Told = Callable[[int, int, Named, float], object]
"""Called before each setting: its number, how many there are, the setting, seconds left of the budget."""


def make_chart(
    problem: Problem, about: Mapping[str, Any], path: Path, *, budget_s: float, told: Told
) -> ChartData:
    """Run every setting that the budget allows; what ``path`` has of this problem already is kept.

    The chart is written after each setting, so that an interrupted one goes on where it was.

    Raises
    ------
    FileError
        When ``path`` is the chart of another problem.
    """
    key = problem.fingerprint()
    points, failed, cut_off = _kept(path, key)
    about = {**about, "fingerprint": key, "pixels": list(problem.pixels)}
    settings = problem.settings()
    begun = {p.setting for p in points}
    waiting = [s for s in settings if s.name not in begun | set(failed)]
    # Those that the last budget cut off come after those that have had nothing yet, each from its start.
    waiting += [s for s in settings if s.name in begun & cut_off]
    began = time.monotonic()
    missing = [s.name for s in waiting]
    data = ChartData(problem.kind, about, tuple(points), failed, tuple(missing))
    for place, setting in enumerate(waiting):
        left = budget_s - (time.monotonic() - began)
        if left <= 0:
            break
        told(place, len(waiting), setting, left)
        found = in_own_process(problem, setting, left)
        if isinstance(found, str):
            failed[setting.name] = found
            missing.remove(setting.name)
        else:
            before = [p for p in points if p.setting == setting.name]
            if found.finished or len(found.points) >= len(before):
                points = [p for p in points if p.setting != setting.name] + list(found.points)
            if found.finished:
                missing.remove(setting.name)
        data = ChartData(problem.kind, about, tuple(points), dict(failed), tuple(missing))
        write_text(path, json.dumps(data.to_json(), indent=1, allow_nan=False) + "\n")
    return data


def _kept(path: Path, key: str) -> tuple[list[Point], dict[str, str], set[str]]:
    """Return points, failures and the settings that are not finished, as a chart has them."""
    if not path.exists():
        return [], {}, set()
    try:
        record = json.loads(path.read_text())
        same = record["about"]["fingerprint"] == key
        points = [_point(p) for p in record["points"]]
        failed = dict(record["failed"])
        cut_off = set(record["missing"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(path, f"is no chart of this program ({error}).", "Name another folder.") from error
    if not same:
        raise FileError(
            path,
            "is a chart of something else: another picture, calibration, noise or version of the program.",
            "Name another folder with --out.",
        )
    return points, failed, cut_off


def _point(record: dict[str, Any]) -> Point:
    values: dict[str, Any] = {k: float("nan") if v is None else v for k, v in record.items()}
    return Point(**{**values, "held_out_parts": tuple(values.get("held_out_parts", ()))})
