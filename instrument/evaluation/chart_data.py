"""What a chart holds: as JSON, as a table, in words; and read again."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from instrument.files.errors import FileError
from recon.evaluation.scored import (
    KINDS,
    SETTLED_ITERATIONS,
    Kind,
    KindName,
    Point,
    even_with_best,
    fronts,
    is_known,
)

COLOURS = ("#00798c", "#d1495b", "#d98e04", "#4f8a5b", "#5b6ee1", "#b04fc4", "#7a5c3e", "#e0559a")
"""Told apart on white and on black."""


def colours_of(data: ChartData) -> dict[str, str]:
    """Give every family of settings a colour."""
    names = sorted({p.family for p in data.points})
    return {name: COLOURS[i % len(COLOURS)] for i, name in enumerate(names)}


def in_words(point: Point) -> str:
    """Return a setting, and how often it was iterated where that was counted."""
    return f"{point.setting}, {point.iterations} it." if point.iterations else point.setting


def title_of(data: ChartData) -> str:
    """Return what was charted, of what."""
    what = {
        "reconstruction": "Reconstructions, speed against accuracy",
        "hologram": "Holograms, time against quality",
        "calibration": "Calibrations, photographs against the error of what is reconstructed",
    }[data.kind_name]
    pixels = " x ".join(str(n) for n in data.about.get("pixels", ()))
    return f"{what}: {subject_of(data.kind_name, data.about)}, {pixels} pixels"


def subject_of(kind: str, about: Mapping[str, Any]) -> str:
    """Return the scene, picture, photograph or bench that was charted."""
    if kind == "hologram":
        return ", ".join(Path(str(p)).name for p in about.get("pictures", ())) + " on the SLM"
    inputs = about.get("inputs") or {}
    if kind == "calibration" and not inputs:
        return "the simulated microscope"
    return Path(str(about.get("scene") or (inputs.get("image") or {}).get("path", "photograph"))).name


_MAKE = "Make it with diffuserbench chart."


def read_chart(path: Path) -> dict[str, Any]:
    """Read what ``diffuserbench chart`` wrote.

    Returns
    -------
    dict
        ``kind`` (of :data:`recon.evaluation.scored.KINDS`), ``about`` (what was charted), ``points`` (the
        fields of :class:`recon.evaluation.scored.Point`; None where one is not known), ``failed`` (settings
        and why), ``missing`` (settings without time).

    Raises
    ------
    FileError
        When it is no such file, or of another version.
    """
    try:
        record = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read as JSON: {error}.", _MAKE) from error
    if not is_chart(record):
        raise FileError(path, "holds no chart.", _MAKE)
    if record["schema"] != SCHEMA:
        raise FileError(
            path, f"has version {record['schema']}; this program reads {SCHEMA}.", "Make it again."
        )
    if record.get("kind") not in KINDS:
        raise FileError(path, f"charts {record.get('kind')!r}; known are {', '.join(KINDS)}.", _MAKE)
    found: dict[str, Any] = record
    return found


def is_chart(record: Any) -> bool:
    """Whether a JSON object is a chart of any version."""
    if not isinstance(record, dict) or not {"schema", "about", "points"} <= record.keys():
        return False
    points = record["points"]
    return isinstance(points, list) and all(
        isinstance(p, dict) and {"setting", "iterations", "seconds"} <= p.keys() for p in points
    )


SCHEMA = 2


@dataclass(frozen=True)
class ChartData:
    """What a chart holds.

    Attributes
    ----------
    kind_name : str
        Of :data:`recon.evaluation.scored.KINDS`.
    about : mapping
        What was charted, JSON-compatible.
    points : tuple of Point
    failed : mapping of str to str
        Settings that could not be run, and why.
    missing : tuple of str
        Settings for which there was no time, or not enough: their points, if any, end before the last count.
    """

    kind_name: KindName
    about: Mapping[str, Any]
    points: tuple[Point, ...]
    failed: Mapping[str, str]
    missing: tuple[str, ...]

    @property
    def kind(self) -> Kind:
        """What costs and scores there are."""
        return KINDS[self.kind_name]

    def fronts(self) -> dict[str, list[Point]]:
        """Return each group's points that no other of the group is both cheaper and better than."""
        return fronts(self.points, self.kind)

    def front(self) -> list[Point]:
        """Return the points of all fronts."""
        return [p for front in self.fronts().values() for p in front]

    def even(self) -> dict[str, tuple[Point, ...]]:
        """Return each group's best by held-out pixels and what is even with it; with a truth none."""
        if self.kind.score_of(self.points).key != "held_out":
            return {}
        # Calibrations are scored at the end of a run, reconstructions on the way.
        least = SETTLED_ITERATIONS if self.kind_name == "reconstruction" else 0
        groups = dict.fromkeys(p.group for p in self.points)
        found = {g: even_with_best((p for p in self.points if p.group == g), least) for g in groups}
        return {g: even for g, even in found.items() if even}

    def to_json(self) -> dict[str, Any]:
        """Return all of it."""
        return {
            "schema": SCHEMA,
            "kind": self.kind_name,
            "about": dict(self.about),
            "points": [p.to_json() for p in self.points],
            "pareto": [
                {"group": g, "setting": p.setting, "iterations": p.iterations}
                for g, front in self.fronts().items()
                for p in front
            ],
            "even_with_best": [
                {"group": g, "setting": p.setting, "iterations": p.iterations}
                for g, even in self.even().items()
                for p in even
            ],
            "failed": dict(self.failed),
            "missing": list(self.missing),
        }

    def to_csv(self) -> str:
        """Return a table of the points, the front marked; columns of which nothing is known are left out."""
        names = [
            f.name
            for f in fields(Point)
            if f.name != "held_out_parts"
            and any(is_known(p, f.name) and getattr(p, f.name) != "" for p in self.points)
        ]
        front = {(p.group, p.setting, p.iterations) for p in self.front()}
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*names, "pareto"])
        for p in self.points:
            values = [getattr(p, n) for n in names]
            shown = ["" if v != v else f"{v:.6g}" if isinstance(v, float) else v for v in values]
            writer.writerow([*shown, int((p.group, p.setting, p.iterations) in front)])
        return text.getvalue()
