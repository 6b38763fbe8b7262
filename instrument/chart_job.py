"""A chart of speed against accuracy: each setting in a process of its own, results kept as they come."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import multiprocessing
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from instrument.atomic import write_text
from instrument.errors import BenchError, FileError
from instrument.reconstruction_job import Job
from recon.chart import ChartProblem, Curve, Measure, Point, Setting, pareto, run_setting, settings_for
from recon.errors import InputError
from recon.noise import NoiseModel
from recon.scenes import make_scene
from recon.scenes.scene import Family
from recon.volume.model import one_depth

SCHEMA = 1
Told = Callable[[int, int, Setting, float], object]
"""Called before each setting: its number, how many there are, the setting, seconds left of the budget."""


@dataclass(frozen=True)
class ChartData:
    """What a chart holds.

    Attributes
    ----------
    about : mapping
        What was reconstructed, JSON-compatible.
    points : tuple of Point
    failed : mapping of str to str
        Settings that could not be run, and why.
    missing : tuple of str
        Settings for which there was no time, or not enough: their points, if any, end before the last count.
    """

    about: Mapping[str, Any]
    points: tuple[Point, ...]
    failed: Mapping[str, str]
    missing: tuple[str, ...]

    @property
    def has_truth(self) -> bool:
        """Whether errors are against a ground truth."""
        return any(p.psnr_db == p.psnr_db for p in self.points)

    def front(self) -> list[Point]:
        """Return the points that no other is both quicker and better than."""
        measure: Measure = "psnr_db" if self.has_truth else "held_out"
        return pareto([p for p in self.points if getattr(p, measure) == getattr(p, measure)], measure)

    def to_json(self) -> dict[str, Any]:
        """Return all of it."""
        return {
            "schema": SCHEMA,
            "about": dict(self.about),
            "points": [p.to_json() for p in self.points],
            "pareto": [{"setting": p.setting, "iterations": p.iterations} for p in self.front()],
            "failed": dict(self.failed),
            "missing": list(self.missing),
        }

    def to_csv(self) -> str:
        """Return a table of the points, the front marked."""
        names = [f.name for f in fields(Point)]
        front = {(p.setting, p.iterations) for p in self.front()}
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow([*names, "pareto"])
        for p in self.points:
            values = [getattr(p, n) for n in names]
            shown = ["" if v != v else f"{v:.6g}" if isinstance(v, float) else v for v in values]
            writer.writerow([*shown, int((p.setting, p.iterations) in front)])
        return text.getvalue()


def problem_of_scene(family: str, size: int, seed: int) -> tuple[ChartProblem, dict[str, Any]]:
    """Return a test scene to chart on, and what to say of it.

    Raises
    ------
    BenchError
        When there is no such scene.
    """
    try:
        scene = make_scene(family, size=size, seed=seed, grid=3)  # type: ignore[arg-type]
    except InputError as error:
        raise BenchError(f"--scene {family}: {error}") from error
    problem = ChartProblem(
        scene.measurement,
        scene.calibration,
        not scene.spec.is_picture,
        scene.erasures,
        scene.noise,
        scene.truth,
    )
    return problem, {"scene": family, "size": size, "seed": seed, "simulated": True}


def problem_of_job(job: Job, z_um: float | None, *, volume: bool) -> tuple[ChartProblem, dict[str, Any]]:
    """Return a photograph to chart on: the mean of its colours."""
    measurement = job.measurement if job.measurement.ndim == 2 else job.measurement.mean(axis=2)
    valid = None if job.valid is None else (job.valid if job.valid.ndim == 2 else job.valid.all(axis=2))
    calibration = job.calibration
    if calibration.psfs.shape[1] > 1:
        calibration = replace(calibration, psfs=calibration.psfs.mean(axis=1, keepdims=True), background=None)
    if not volume:
        calibration = one_depth(calibration, z_um)
    return (
        ChartProblem(
            np.ascontiguousarray(measurement, np.float32),
            calibration,
            volume,
            None if valid is None or valid.all() else np.logical_not(np.asarray(valid, bool)),
            _noise_of_mean(job),
        ),
        {"inputs": dict(job.provenance), "simulated": job.simulated},
    )


def _noise_of_mean(job: Job) -> NoiseModel | float | None:
    """Return what the photograph's metadata say of its noise, of the mean of its colours."""
    noise = job.binned_noise(None)
    if job.measurement.ndim == 2 or not isinstance(noise, NoiseModel):
        return noise
    colours = job.measurement.shape[2]
    return NoiseModel(noise.read_noise / colours**0.5, noise.counts_per_electron / colours)


def make_chart(
    problem: ChartProblem, about: Mapping[str, Any], path: Path, *, budget_s: float, told: Told
) -> ChartData:
    """Run every setting that the budget allows; what ``path`` has of this problem already is kept.

    The chart is written after each setting, so that an interrupted one goes on where it was.

    Raises
    ------
    FileError
        When ``path`` is the chart of another problem.
    """
    key = _fingerprint(problem)
    points, failed, cut_off = _kept(path, key)
    about = {**about, "fingerprint": key, "pixels": list(problem.measurement.shape)}
    settings = settings_for(problem)
    begun = {p.setting for p in points}
    waiting = [s for s in settings if s.name not in begun | set(failed)]
    # Those that the last budget cut off come after those that have had nothing yet, each from its start.
    waiting += [s for s in settings if s.name in begun & cut_off]
    began = time.monotonic()
    missing = [s.name for s in waiting]
    data = ChartData(about, tuple(points), failed, tuple(missing))
    for place, setting in enumerate(waiting):
        left = budget_s - (time.monotonic() - began)
        if left <= 0:
            break
        told(place, len(waiting), setting, left)
        found = _in_own_process(problem, setting, left)
        if isinstance(found, str):
            failed[setting.name] = found
            missing.remove(setting.name)
        else:
            before = [p for p in points if p.setting == setting.name]
            if found.finished or len(found.points) >= len(before):
                points = [p for p in points if p.setting != setting.name] + list(found.points)
            if found.finished:
                missing.remove(setting.name)
        data = ChartData(about, tuple(points), dict(failed), tuple(missing))
        write_text(path, json.dumps(data.to_json(), indent=1, allow_nan=False) + "\n")
    return data


def _fingerprint(problem: ChartProblem) -> str:
    digest = hashlib.sha256()
    for array in (problem.measurement, problem.calibration.psfs, problem.calibration.source_positions_um):
        digest.update(np.ascontiguousarray(array).data)
    for part in (problem.erasures, problem.truth):
        digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
    digest.update(f"{problem.volume} {problem.noise}".encode())
    return digest.hexdigest()[:16]


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
            "is a chart of another photograph or calibration, or of another noise or version of the program.",
            "Name another folder with --out.",
        )
    return points, failed, cut_off


def _point(record: dict[str, Any]) -> Point:
    values: dict[str, Any] = {k: float("nan") if v is None else v for k, v in record.items()}
    return Point(**values)


def _in_own_process(problem: ChartProblem, setting: Setting, limit_s: float) -> Curve | str:
    """Run one setting by itself, so that its memory is its own; the reason where it cannot be run."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, problem, setting, limit_s), daemon=True)
    process.start()
    theirs.close()
    try:
        found: Curve | str = ours.recv()
    except EOFError:
        process.join()
        return f"the process ended with status {process.exitcode} (out of memory?)"
    finally:
        if process.is_alive():
            process.join(5)
        if process.is_alive():
            process.terminate()
        ours.close()
    return found


def _work(pipe: Connection, problem: ChartProblem, setting: Setting, limit_s: float) -> None:
    try:
        # Once without looking at the clock, on few pixels: libraries and compiled kernels are loaded, and no
        # memory is left lying about that the run would take without its showing.
        run_setting(_small(problem), replace(setting, binning=1), counts=(1,))
        before = _reset_peak_mib()
        curve = run_setting(problem, setting, limit_s=limit_s)
        peak = _peak_mib() - before
        pipe.send(replace(curve, points=tuple(replace(p, peak_mib=peak) for p in curve.points)))
    except InputError as error:
        pipe.send(str(error))
    finally:
        pipe.close()


def _small(problem: ChartProblem) -> ChartProblem:
    family: Family = "beads" if problem.volume else "sparse-picture"
    scene = make_scene(family, size=16, grid=3, **({"depths": 2} if problem.volume else {}))
    return ChartProblem(scene.measurement, scene.calibration, problem.volume)


def _reset_peak_mib() -> float:
    """Forget the highest memory so far; return what is taken now, MiB (NaN where the system does not say)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return float("nan")
    return _peak_mib()


def _peak_mib() -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    for line in status.read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) / 1024
    return float("nan")
