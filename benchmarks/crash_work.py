"""What is killed: the commands of the terminal and the window, each carried out in a process of its own."""

from __future__ import annotations

import faulthandler
import os
import random
import signal
import struct
import sys
import tempfile
import threading
import time
import traceback
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo
from pathlib import Path
from typing import Any, Self

import numpy as np

from instrument.cli import main
from instrument.plan import Part, Plan
from instrument.runs.writer import FrameToStore, RunWriter

BENCH = """
[bench]
name = "crash test"
[camera]
driver = "simulated"
roi = [0, 0, 64, 96]
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0.05
"""
PLAN = Plan(
    label="crash test",
    parts=(
        Part(label="dark", exposures_ms=(2.0,), repeats=5),
        Part(label="psf", light=("source", "off"), exposures_ms=(1.0, 3.0), repeats=8),
        Part(label="dark again", exposures_ms=(2.0,), average=2, repeats=5),
    ),
)
RUN = "RUN"
"""In a command: the run's folder."""
PROMISE = struct.Struct("<HI")
FINISHING = 0xFFFF
"""In place of a promised frame's number: the run's end is being written."""


@dataclass(frozen=True)
class Kind:
    """A kind of work: its command, the one that goes on with it, and what is there before."""

    first: Sequence[str]
    again: Sequence[str] = ("resume", RUN)
    begins: str = "folder"
    """From when on it is killed: ``start``, ``folder`` (a run's is there) or ``finishing``."""
    given: Sequence[Sequence[str]] = ()
    """Commands carried out once before, whole."""
    cut_after: int | None = None
    """A run of ``first`` is cut after so many frames before; what is killed is going on with it."""

    @property
    def makes_run(self) -> bool:
        """Whether it ends in a run, not in files."""
        return self.begins != "start"


_RUN = ("run", "plan.json", "--out", "runs")
_SOLVED = ("--psf", "psf.tif", "--model", "convolution", "--tau", "1e-3", "--bin", "1", "--solver", "admm")
_PICTURE = ("reconstruct", "--image", "scene.tif", *_SOLVED, "-n", "150", "--checkpoint", "kept")
_VIDEO = ("reconstruct", RUN, "--video", *_SOLVED, "-n", "10", "--out", "film.ome.zarr")
_HOLOGRAM = ("hologram", "scene.tif", "--expansion", "1", "--iterations", "15", "--out", "slm.png")
_RECORD = ("record", "--source", "--frames", "40", "--exposure-ms", "2", "--out", "runs")
_SWEEP = ("calibrate", "axial", "--z-min", "20", "--average", "1", "--dark-frames", "1", "--out", "runs")
_ONE_PSF = ("--model", "convolution", "--bin", "1")
_VOLUME = (
    (*_SWEEP, "--z-max", "30", "--planes", "2"),
    ("snap", "--source", "--exposure-ms", "2", "--out", "photo.tif"),
    (
        "reconstruct",
        "--volume",
        RUN,
        "--image",
        "photo.tif",
        *_ONE_PSF,
        "-n",
        "20",
        "--out",
        "volume.ome.zarr",
    ),
)
_POINTS = ("points", "volume.ome.zarr", "--fit", "--out", "points.csv", "--force")
KINDS = {
    "run": Kind(_RUN),
    "sweep": Kind(_SWEEP),
    "record": Kind(_RECORD),
    "resume": Kind(_RUN, cut_after=12),
    "finishing": Kind(_RUN, begins="finishing"),
    "reconstruct": Kind(
        (*_PICTURE, "--out", "picture.tif"), (*_PICTURE, "--out", "picture.tif", "--force"), "start"
    ),
    "video": Kind(_VIDEO, _VIDEO, "start", given=(_RECORD,)),
    "hologram": Kind(_HOLOGRAM, (*_HOLOGRAM, "--force"), "start"),
    "points": Kind(_POINTS, _POINTS, "start", given=_VOLUME),
    "window": Kind(("window",)),
}


def work(folder: Path, command: Sequence[str], promises: int, *, clock_jumps: bool) -> None:
    """Carry out a command in this process, and end it."""
    code = 70
    try:
        os.chdir(folder)
        for handle, name in ((1, "out"), (2, "said")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), handle)
        faulthandler.enable()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
        (folder / "tmp").mkdir(exist_ok=True)
        tempfile.tempdir = os.environ["TMPDIR"] = str(folder / "tmp")
        promising(promises)
        if clock_jumps:
            jumping_clock()
        code = run_in_window() if command[0] == "window" else main(list(command))
    except KeyboardInterrupt:  # of the window, or of the second one
        code = 128 + signal.SIGINT
    except BaseException:  # noqa: BLE001 - shown, and the process ends here whatever it was
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def promising(promises: int) -> None:
    """Have every stored frame told, and the beginning of a run's end; write checkpoints often."""
    from instrument.reconstruction.checkpointing import CheckpointFolder

    write, finish = RunWriter.write, RunWriter.finish

    def writing(self: RunWriter, frames: Sequence[FrameToStore]) -> None:
        write(self, frames)
        kind = np.float32 if self._float or not frames else frames[0].image.dtype
        sums = ((f.index, zlib.crc32(f.image.astype(kind).tobytes())) for f in frames)
        os.write(promises, b"".join(PROMISE.pack(index, crc) for index, crc in sums))

    def finishing(self: RunWriter, *args: Any, **named: Any) -> Any:
        os.write(promises, PROMISE.pack(FINISHING, 0))
        return finish(self, *args, **named)

    RunWriter.write, RunWriter.finish = writing, finishing  # type: ignore[method-assign]
    CheckpointFolder.__init__.__kwdefaults__["every_s"] = 0.02


def jumping_clock() -> None:
    """Have every look at the clock be wrong by up to a day, each time otherwise."""
    now_s, real = time.time, datetime

    def wrong_s() -> float:
        return now_s() + random.uniform(-86400, 86400)

    class AnyTime(type):
        def __instancecheck__(cls, value: object) -> bool:
            return isinstance(value, real)

    class Jumping(datetime, metaclass=AnyTime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> Self:
            return super().now(tz) + timedelta(seconds=random.uniform(-86400, 86400))

    time.time = wrong_s
    for module in list(sys.modules.values()):
        if getattr(module, "datetime", None) is real:
            module.datetime = Jumping  # type: ignore[attr-defined]


def run_in_window() -> int:
    """Open the program's own window on the bench of this folder, carry the plan out from it, and close it.

    Returns what a command would: 128 and the signal that closed it, where one did; 1 where the plan failed.
    """
    os.environ["QT_QPA_PLATFORM"] = "offscreen"
    from instrument.cli.app import signals_wait

    with signals_wait():  # as the command has it: Qt's bindings abort a program that is interrupted in them
        from PySide6.QtCore import QSettings

        from gui import app
        from gui.jobs import JobContext
        from gui.session import BenchSession
    from instrument.bench.config_file import load_config
    from instrument.runs.acquire import prepare
    from instrument.runs.run_control import RunControl

    ended_by: list[int] = []

    class AtWork(BenchSession):
        """A session that carries the plan out once its bench is open, and closes the window after it."""

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            self.opened.connect(self._carry_out)

        def _carry_out(self) -> None:
            work = self.exclusive_job("A plan", self._plan)
            work.failed.connect(self._failed)
            work.ended.connect(self.close)

        def _failed(self, text: str) -> None:
            ended_by.append(1)
            sys.stderr.write(f"{text}\n")

        def _plan(self, context: JobContext) -> object:
            control = RunControl()
            context.on_cancel(lambda: threading.Thread(target=control.stop, name="STOP").start())
            return prepare(self.bench, PLAN, Path("runs"), control=control).execute()

        def log(self, level: Any, text: str) -> None:
            """Notice which signal closes the window."""
            names = (name for name in ("SIGINT", "SIGTERM", "SIGHUP") if text.startswith(f"Signal {name}"))
            ended_by.extend(128 + signal.Signals[name] for name in names)
            super().log(level, text)

    app.BenchSession = AtWork  # type: ignore[misc]
    for scope in (QSettings.Scope.UserScope, QSettings.Scope.SystemScope):
        QSettings.setPath(QSettings.Format.NativeFormat, scope, "settings")
    status = app.run(load_config(Path("bench.toml")))
    return ended_by[0] if ended_by else status


def in_folder(command: Sequence[str], folder: Path) -> list[str]:
    """Return a command with the run's folder in it."""
    runs = runs_in(folder / "runs")
    return [str(runs[0].relative_to(folder)) if word == RUN else word for word in command]


def runs_in(folder: Path) -> list[Path]:
    """Return the run folders in a folder: the one, or none yet."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def tree(folder: Path) -> set[str]:
    """Return the names of all that is in a folder, the run's date left out."""
    runs = {run.name: "run" for run in runs_in(folder / "runs")}
    found = set()
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        found.add("/".join(runs.get(part, part) for part in parts))
    return found - {"out", "said", "tmp", "settings"}
