"""A chart of cost against accuracy: each setting in a process of its own, results kept as they come."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path
from typing import Any

from instrument.evaluation.chart_data import ChartData
from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from recon.errors import InputError
from recon.evaluation.scored import Curve, Point
from recon.evaluation.trial import Named, Subject

_PRELOADED = [
    "instrument.evaluation.chart_job",
    "recon.evaluation.chart_reconstruction",
    "recon.evaluation.chart_hologram",
]
"""Imported once, in the process from which those of the settings are forked: seconds for each of them."""


def in_own_process(problem: Subject[Any], setting: Named, limit_s: float) -> Curve | str:
    """Run one setting by itself; the reason where it cannot be run.

    The process ends when this one is interrupted or killed.
    """
    context = _context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, problem, setting, limit_s), daemon=True)
    process.start()
    theirs.close()
    try:
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


class MemoryMeter:
    """Measures the most memory that this process took at a time since the meter was made, in MiB.

    NaN where the system does not say (it is Linux that does).
    """

    def __init__(self) -> None:
        self._before = _reset_peak_mib()
        self._most = 0.0

    def peak_mib(self) -> float:
        """Return the most so far beyond what was taken at the start, without what was taken aside."""
        return max(self._most, _status_mib("VmHWM") - self._before)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Do something whose memory does not count, nor what it leaves behind."""
        self._most = self.peak_mib()
        present = _status_mib("VmRSS")
        try:
            yield
        finally:
            self._before += _reset_peak_mib() - present


def _reset_peak_mib() -> float:
    """Forget the highest memory so far; return what is taken now, MiB (NaN where the system does not say)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return float("nan")
    return _status_mib("VmHWM")


def _status_mib(name: str) -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    for line in status.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    return float("nan")


Told = Callable[[int, int, Named, float], object]
"""Called before each setting: its number, how many there are, the setting, seconds left of the budget."""


def make_chart(
    problem: Subject[Any], about: Mapping[str, Any], path: Path, *, budget_s: float, told: Told
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
        failed, cut_off = dict(record["failed"]), set(record["missing"])
        if record.get("kind", "reconstruction") == "reconstruction":
            points = [replace(p, setting=_renamed(p.setting), family=_renamed(p.family)) for p in points]
            failed = {_renamed(name): why for name, why in failed.items()}
            cut_off = {_renamed(name) for name in cut_off}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise FileError(path, f"is no chart of this program ({error}).", "Name another folder.") from error
    if not same:
        raise FileError(
            path,
            "is a chart of something else: another picture, calibration, noise or version of the program.",
            "Name another folder with --out.",
        )
    return points, failed, cut_off


def _renamed(setting: str) -> str:
    """Return what a setting is called now: volumes and a GPU had methods of their own."""
    method, _, rest = setting.partition(" ")
    if method == "admm-gpu":
        return f"admm {rest} gpu"
    return f"admm {rest}" if method == "volume" else setting


def _point(record: dict[str, Any]) -> Point:
    values: dict[str, Any] = {k: float("nan") if v is None else v for k, v in record.items()}
    return Point(**{**values, "held_out_parts": tuple(values.get("held_out_parts", ()))})
