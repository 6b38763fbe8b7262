"""The record of a demo, ``demo.json`` in its folder: always whole, it says how far it came, and how fast."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calibration_routines.procedure import Listener
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.runs.interrupts import ctrl_c_remembered
from instrument.runs.runner import RunStatus
from instrument.runs.writer import free_name

FILE = "demo.json"


def new_folder(parent: Path, kind: str = "demo") -> Path:
    """Make a folder ``KIND-DATE-TIME`` in ``parent``, which is made as well where missing.

    Raises FileError when it cannot be made.
    """
    if parent.exists() and not parent.is_dir():
        raise FileError(parent, "is no folder.", "Name a folder with --out.")
    folder = free_name(parent, f"{kind}-{datetime.now(UTC):%Y-%m-%d-%H%M%S}")
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise FileError(folder, f"cannot be made: {error.strerror or error}.") from error
    return folder


class Journal:
    """The demo's record, ``demo.json`` in its folder; written from the first :meth:`note` on.

    Attributes
    ----------
    seconds : dict
        Name of each stage done to the seconds it took, in order.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self.seconds: dict[str, float] = {}
        self._record: dict[str, Any] = {}

    def note(self, **entries: Any) -> None:
        """Add entries (JSON-compatible) and write the file."""
        self._record |= entries
        write_text(self.path, json.dumps(self._record | {"seconds": self.seconds}, indent=1) + "\n")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; while it runs the file names it."""
        self.note(stage=name)
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - started, 2)


class Stages(Listener):
    """Times a demo's stages, and hands on how each goes; Ctrl-C ends it at any of these moments."""

    def __init__(self, journal: Journal, listener: Listener, check: Callable[[], None]) -> None:
        self.journal, self._listener, self._check = journal, listener, check

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Enter a stage."""
        with self.journal.stage(name):
            self._listener.step(name)
            yield
            self._check()

    def step(self, words: str) -> None:
        """Hand on that a stage's next step begins, unless it is to end."""
        self._check()
        self._listener.step(words)

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Hand on how much is done, unless it is to end."""
        self._check()
        self._listener.share(done, total, at_most=at_most)

    def frame(self, status: RunStatus) -> None:
        """Hand on how much of a run is done."""
        self.share(status.done, status.total)


@contextmanager
def told_in(parent: Path, kind: str, listener: Listener) -> Iterator[tuple[Path, Stages]]:
    """Give a new folder and the stages of what is done in it; its journal says how that ended, whatever."""
    place = new_folder(parent, kind)
    journal = Journal(place)
    try:
        journal.note(state="running")
        with ctrl_c_remembered() as check:
            yield place, Stages(journal, listener, check)
    except BaseException as error:
        aborted = isinstance(error, KeyboardInterrupt | SystemExit)
        journal.note(state="aborted" if aborted else "failed", error=str(error) or type(error).__name__)
        error.add_note(f"The demo {'was stopped' if aborted else 'failed'}; what it made is in {place}")
        raise


@contextmanager
def demo_bench(config_toml: str, place: Path, listener: Listener, stages: Stages) -> Iterator[Bench]:
    """Open a demo's bench, kept as ``bench.toml`` in its folder; however it ends, stopped and said to be."""
    journal, path = stages.journal, place / "bench.toml"
    write_text(path, config_toml)
    with stages.stage("open the bench"):
        bench = open_bench(parse_config(config_toml, path))
    with bench:
        bench.foretell(bench.config.bench.name)
        journal.note(simulated=bool(bench.simulated_kinds), bench=bench.label)
        listener.said(f"Bench: {bench.label}")
        listener.said(f"Everything goes to {place}")
        try:
            yield bench
        finally:
            bench.stop()
            journal.note(left=state_of(bench))


def world_of(bench: Bench) -> SimulatedWorld:
    """Return a demo's simulated world."""
    world = bench.shared[SimulatedWorld.table]
    if not isinstance(world, SimulatedWorld):
        raise TypeError(f"The demo's bench is simulated, not {type(world).__name__}.")
    return world


def state_of(bench: Bench) -> dict[str, Any]:
    """Return what the bench is left as, for the record."""
    return {
        "light": bench.led_array.pattern.description if bench.led_array is not None else "none",
        "stage_moving": bench.stage is not None and bench.stage.is_moving,
        "scene_lit": world_of(bench).scene_lit,
    }
