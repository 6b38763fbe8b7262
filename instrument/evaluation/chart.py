"""A chart of cost against accuracy: what it holds, read and made, each setting in a process of its own."""

from __future__ import annotations

import csv
import io
import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.files.reading import parse_json, read_bytes
from recon.errors import InputError
from recon.evaluation.scored import (
    KINDS,
    SETTLED_ITERATIONS,
    Curve,
    Kind,
    KindName,
    Point,
    even_with_best,
    fronts,
    is_known,
)
from recon.solvers.memory import MemoryMeter

if TYPE_CHECKING:
    from recon.evaluation.trial import Named, Subject

    Progress = Callable[[int, int, Named, float], object]
    """Called before each setting: its number, how many there are, the setting, seconds left of the budget."""

COLOURS = ("#00798c", "#d1495b", "#d98e04", "#4f8a5b", "#5b6ee1", "#b04fc4", "#7a5c3e", "#e0559a")
"""Told apart on white and on black."""
SCHEMA = 2
_TELL_S = 0.25
"""Between two looks whether a setting that runs is to be ended."""
_PRELOADED = [
    "instrument.evaluation.chart",
    "recon.evaluation.chart_reconstruction",
    "recon.evaluation.chart_hologram",
]
"""Imported once, in the process from which those of the settings are forked: seconds for each of them."""


@dataclass(frozen=True)
class ChartData:
    """What a chart holds."""

    kind_name: KindName
    """Of :data:`recon.evaluation.scored.KINDS`."""
    about: Mapping[str, Any]
    """What was charted, JSON-compatible."""
    points: tuple[Point, ...]
    failed: Mapping[str, str]
    """Settings that could not be run, and why."""
    missing: tuple[str, ...]
    """Settings for which there was no time, or not enough: their points, if any, end before the last
    count."""

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
            "pareto": _listed(self.fronts()),
            "even_with_best": _listed(self.even()),
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


def _listed(groups: Mapping[str, Sequence[Point]]) -> list[dict[str, Any]]:
    return [
        {"group": group, "setting": p.setting, "iterations": p.iterations}
        for group, points in groups.items()
        for p in points
    ]


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


# Reading --------------------------------------------------------------------------------------------
def read_chart(path: Path, remedy: str = "Make it with diffuserbench chart.") -> ChartData:
    """Read what ``diffuserbench chart`` wrote; settings get the names that they have now.

    Raises FileError when it is no such file, or of another version.
    """
    try:
        record = parse_json(read_bytes(path))
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read as JSON: {error}.", remedy) from error
    if not _is_chart(record):
        raise FileError(path, "holds no chart.", remedy)
    if record["schema"] != SCHEMA:
        raise FileError(
            path, f"has version {record['schema']}; this program reads {SCHEMA}.", "Make it again."
        )
    kind = record.get("kind", "reconstruction")
    if kind not in KINDS:
        raise FileError(path, f"charts {kind!r}; known are {', '.join(KINDS)}.", remedy)
    now: Callable[[str], str] = _renamed if kind == "reconstruction" else str
    try:
        points = tuple(_point_of(point, now) for point in record["points"])
    except TypeError as error:
        raise FileError(path, f"is no chart of this program ({error}).", remedy) from error
    failed = {now(name): why for name, why in record.get("failed", {}).items()}
    return ChartData(kind, record["about"], points, failed, tuple(map(now, record.get("missing", ()))))


def _point_of(record: Mapping[str, Any], now: Callable[[str], str]) -> Point:
    """Return a point of a chart's record, whose settings are called ``now(name)``."""
    values: dict[str, Any] = {k: float("nan") if v is None else v for k, v in record.items()}
    values |= {key: now(values[key]) for key in ("setting", "family") if key in values}
    return Point(**{**values, "held_out_parts": tuple(values.get("held_out_parts", ()))})


def _is_chart(record: Any) -> bool:
    """Whether a JSON object is a chart of any version."""
    if not isinstance(record, dict) or not {"schema", "about", "points"} <= record.keys():
        return False
    points = record["points"]
    return isinstance(points, list) and all(
        isinstance(p, dict) and {"setting", "iterations", "seconds"} <= p.keys() for p in points
    )


def _renamed(setting: str) -> str:
    """Return what a setting is called now: volumes and a GPU had methods of their own."""
    method, _, rest = setting.partition(" ")
    if method == "admm-gpu":
        return f"admm {rest} gpu"
    return f"admm {rest}" if method == "volume" else setting


# Making -----------------------------------------------------------------------------------------------
def in_own_process(
    problem: Subject[Any], setting: Named, limit_s: float, tell: Callable[[float], object] = lambda _: None
) -> Curve | str:
    """Run one setting by itself; the reason where it cannot be run.

    The process ends when this one is interrupted or killed, and when ``tell``, called a few times a second
    with the seconds that are left, raises.
    """
    context = _context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, problem, setting, limit_s), daemon=True)
    process.start()
    theirs.close()
    ends_s = time.monotonic() + limit_s
    try:
        while not ours.poll(_TELL_S):
            tell(max(0.0, ends_s - time.monotonic()))
        found: Curve | str = ours.recv()
        process.join(5)
        return found
    except EOFError:
        process.join()
        return f"the process ended with status {process.exitcode} (out of memory?)"
    finally:
        if process.is_alive():
            process.terminate()
            process.join()
        ours.close()


def _context() -> ForkServerContext | SpawnContext:
    if sys.platform == "win32":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    # The server inherits a blocked Ctrl-C: that is for this process, which gets it when it is unblocked.
    resource_tracker.ensure_running()  # the server's start would start it, and unblock too early
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _work(pipe: Connection, problem: Subject[Any], setting: Named, limit_s: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's: it ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        # First in small: libraries and compiled kernels are loaded, and no memory is left lying about that
        # the run would take without its showing.
        problem.warm_up(setting)
        meter = MemoryMeter()
        curve = problem.run(setting, limit_s=limit_s, aside=meter.aside)
        peak = meter.peak_mib()
        pipe.send(replace(curve, points=tuple(replace(p, peak_mib=peak) for p in curve.points)))
    except InputError as error:
        pipe.send(str(error))
    except MemoryError:
        pipe.send("there is not enough memory")
    except Exception as error:  # noqa: BLE001 (whatever it is concerns this setting alone, and is told in its row)
        pipe.send(f"{type(error).__name__}: {error}")
    finally:
        pipe.close()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def make_chart(
    problem: Subject[Any], about: Mapping[str, Any], path: Path, *, budget_s: float, on_progress: Progress
) -> ChartData:
    """Run every setting that the budget allows; what ``path`` has of this problem already is kept.

    The chart is written after each setting, so that an interrupted one goes on where it was.

    Raises FileError when ``path`` is the chart of another problem.
    """
    about = {**about, "fingerprint": problem.fingerprint(), "pixels": list(problem.pixels)}
    kept = ChartData(problem.kind, about, (), {}, ())
    if path.exists():
        kept = read_chart(path, "Name another folder with --out.")
    if kept.about.get("fingerprint") != about["fingerprint"]:
        raise FileError(
            path,
            "is a chart of something else: another picture, calibration, noise or version of the program.",
            "Name another folder with --out.",
        )
    points, failed, cut_off = list(kept.points), dict(kept.failed), set(kept.missing)
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
        on_progress(place, len(waiting), setting, left)
        found = in_own_process(problem, setting, left, partial(on_progress, place, len(waiting), setting))
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
