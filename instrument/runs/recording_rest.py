"""What a recording lacks that was cut (kill, fault, STOP), read from its folder: how long, in what light."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drivers.device import DeviceIdentity
from instrument.bench.bench import Bench
from instrument.bench.camera_settings import camera_settings, restore_camera
from instrument.bench.lit import Lit
from instrument.files.errors import BenchError
from instrument.files.record import value_of
from instrument.runs.inspection import run_paths
from instrument.runs.run import Run, RunCondition
from instrument.runs.run_files import PLAN

_LEAST_S = 0.1
"""Less than that is not worth a film of its own."""
_CUT = (RunCondition.CRASHED, RunCondition.FAILED, RunCondition.STOPPED)
"""Not one that was aborted: Ctrl+C ended it on purpose, or ``resume`` closed it."""


@dataclass(frozen=True, slots=True)
class RecordingRest:
    """The rest of a recording, which goes on as a film of its own."""

    run: Path
    """The recording that was cut."""
    label: str
    stored: int
    """Frames that are kept of it."""
    seconds: float | None
    n_frames: int | None
    """How long the rest is, whichever end comes first; None: no such end was asked for."""
    lit: Lit | None
    """What was lit; None: as it is."""
    taken_with: str
    """Which camera, and whether simulated, as it said of itself."""
    camera: Mapping[str, Any]
    """The camera's settings; empty: as they are."""

    @contextlib.contextmanager
    def set_up(self, bench: Bench) -> Iterator[None]:
        """Bring camera and light to what they were; where that or what follows fails, to what they are now.

        Raises DeviceError or BenchError where they cannot be brought there.
        """
        with contextlib.ExitStack() as back:
            back.callback(Lit.now(bench).put_back, bench)
            back.callback(restore_camera, bench.camera, camera_settings(bench.camera))
            restore_camera(bench.camera, self.camera)
            if self.lit is not None:
                self.lit.put_back(bench)
            yield
            back.pop_all()


def rest_of(path: Path) -> RecordingRest | None:
    """Return what a recording lacks; None of one that came to its end, goes on, or says not how long."""
    try:
        run = Run.open(path)
        if run.plan is not None or run.condition not in _CUT:
            return None
        started = next((event for event in run.events if event.get("kind") == "started"), {})
        seconds, n_frames = started.get("seconds"), started.get("n_frames")
        if seconds is not None:
            seconds = float(seconds) - _lasted_s(run)
        if n_frames is not None:
            n_frames = int(n_frames) - run.n_frames
        ends = [end for end, least in ((seconds, _LEAST_S), (n_frames, 1)) if end is not None and end < least]
        if ends or (seconds is None and n_frames is None):
            return None
        lit = value_of(Lit, started["lit"]) if started.get("lit") else None
        camera: Mapping[str, Any] = {}
        with contextlib.suppress(LookupError):
            camera = dict(run.provenance["camera"])
        taken_with = str(run.provenance["devices"]["camera"])
        return RecordingRest(path, run.label, len(run.records), seconds, n_frames, lit, taken_with, camera)
    except (BenchError, OSError, LookupError, TypeError, ValueError):
        return None


def _lasted_s(run: Run) -> float:
    """Return how long a recording went on, to its last frame."""
    if not run.records:
        return 0.0
    first, last = (run.records[index].metadata.host_time_ns for index in (min(run.records), max(run.records)))
    return max(last - first, 0) / 1e9


def newest_rest(folder: Path, camera: DeviceIdentity) -> RecordingRest | None:
    """Return what the newest recording in a folder lacks; None where it ended, or is of another camera."""
    newest = next((path for path in reversed(run_paths(folder)) if not (path / PLAN).exists()), None)
    rest = None if newest is None else rest_of(newest)
    return rest if rest is not None and rest.taken_with == str(camera) else None
