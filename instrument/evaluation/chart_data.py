"""What a chart holds, as JSON and as a table."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from recon.evaluation.even import SETTLED_ITERATIONS, even_with_best
from recon.evaluation.scored import KINDS, Kind, KindName, Point, fronts, is_known

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
