"""Kill the program with ``kill -9`` at random moments of its work, go on, and look for what was lost.

    python benchmarks/crash_test.py                          50 kills of every kind of work
    python benchmarks/crash_test.py run resume --kills 200   of some, more of each
    TMPDIR=/dev/shm python benchmarks/crash_test.py          on a tmpfs; else on the disk of TMPDIR
    python benchmarks/crash_test.py record --signal term     another signal, which it answers itself

Each trial carries out one command of the terminal on the simulated bench in a process of its own and kills
it: runs, sweeps, recordings and the window once the run's folder is there (at any time, or just after one of
the frames), finishing once the run's end is being written, files (reconstruct, video, hologram) at any time.
It is gone on with as a user would, killed again with half the probability, until it ends. Every frame is
unlike every other, and is told with its checksum when ``write`` has returned: it must be there, the same, in
its own place, at every later look. No frame may be taken twice once its line is in the log; every run must
open and verify; files must be those of an unharmed process; nothing else may lie about in the end. Exit
status 1 when any of it fails.

``kill -9`` ends the process, not the kernel: that everything is also synced in the right order, so that a
power cut costs no more, is held by tests/instrument/runs/test_store_order.py.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import io
import json
import os
import random
import select
import shutil
import signal
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from instrument.cli import main
from instrument.files.images import read_image, write_image
from instrument.plan import Part, Plan
from instrument.runs.inspection import verify
from instrument.runs.log import read_lines
from instrument.runs.run import Run, RunCondition
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
IMPATIENT_S = 600.0
FAMILIES = ("instrument.cli", "instrument.tasks", "instrument.reconstruction", "calibration_routines")
"""Imported before anything is forked, so that no process is killed while it imports them."""


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
    "window": Kind(("window",)),
}


@dataclass
class Tally:
    """What all trials of a kind came to."""

    kills: int = 0
    trials: int = 0
    stored_at_kill: list[int] = field(default_factory=list)
    moments: Counter[str] = field(default_factory=Counter)
    wrong: Counter[str] = field(default_factory=Counter)
    problems: list[str] = field(default_factory=list)

    def found(self, what: str, n: int, where: object) -> None:
        """Note something that is wrong."""
        if n:
            self.wrong[what] += n
            self.problems.append(f"{what}: {where}")


@dataclass
class Attempt:
    """What one process did: its promised frames with their checksums, how it ended, how long it lived."""

    promised: dict[int, int]
    killed: bool
    code: int
    said: str
    lived_s: float
    """From when on it was to be killed."""


class Work:
    """One kind of work in a folder, with what it is given."""

    def __init__(self, kind: Kind, parent: Path, number: int) -> None:
        self.kind, self._parent, self._number = kind, parent, number
        self.given = parent / "given"
        self.given.mkdir()
        (self.given / "bench.toml").write_text(BENCH + '[slm]\ndriver = "simulated"\nshape = [96, 128]\n')
        (self.given / "plan.json").write_text(PLAN.to_json())
        rng = np.random.default_rng(1)
        psf, scene = (rng.random((64, 96)) ** 12).astype(np.float32), np.zeros((64, 96), np.float32)
        scene[20:44, 30:66] = rng.random((24, 36))
        seen = np.fft.irfft2(np.fft.rfft2(scene) * np.fft.rfft2(np.fft.ifftshift(psf)), psf.shape)
        for name, image in (("psf", psf), ("scene", seen)):
            write_image(self.given / f"{name}.tif", (5e4 * image / image.max()).astype(np.uint16))
        for command in kind.given:
            self.whole(self.given, command)
        if kind.cut_after is not None:
            self.attempt(self.given, kind.first, (kind.cut_after, 0.0))

    def whole(self, folder: Path, command: Sequence[str]) -> Attempt:
        """Carry a command out, unharmed."""
        done = self.attempt(folder, command, None)
        if done.code:
            raise SystemExit(f"{command} itself failed ({done.code}):\n{done.said}")
        return done

    def attempt(
        self,
        folder: Path,
        command: Sequence[str],
        when: tuple[int, float] | None,
        number: int = signal.SIGKILL,
    ) -> Attempt:
        """Let a process work, and send it a signal so many seconds after so many frames were promised.

        Seconds count from when on it is to be killed, or from the last of those frames.
        """
        reading, writing = os.pipe()
        process = os.fork()
        if process == 0:
            os.close(reading)
            _work(folder, command, writing)
        os.close(writing)
        began_s = time.monotonic()
        promised: dict[int, int] = {}
        data, since_s, sent, counted_s = b"", None, False, began_s
        before = set(runs_in(folder / "runs"))
        while True:
            if select.select([reading], [], [], 0.001)[0]:
                piece = os.read(reading, 1 << 16)
                if not piece:
                    break
                data += piece
                whole = len(data) // PROMISE.size * PROMISE.size
                promised |= dict(PROMISE.iter_unpack(data[:whole]))
                data = data[whole:]
            now_s = time.monotonic()
            if since_s is None and self._begun(folder, promised, before):
                since_s = now_s
            if since_s is None or when is None or sent or len(promised) < when[0]:
                counted_s = now_s
            elif now_s - (counted_s if when[0] else since_s) >= when[1]:
                sent = True
                _send(process, number)
            if now_s - began_s > IMPATIENT_S:
                os.kill(process, signal.SIGKILL)
        os.close(reading)
        _, status = os.waitpid(process, 0)
        promised.pop(FINISHING, None)
        said = (folder / "said").read_text() if (folder / "said").is_file() else ""
        lived_s = time.monotonic() - (since_s or began_s)
        code = os.waitstatus_to_exitcode(status)
        killed = sent and code in (-number, 128 + number)  # any other end is a failure
        return Attempt(promised, killed, code, said, lived_s)

    def _begun(self, folder: Path, promised: dict[int, int], before: set[Path]) -> bool:
        if self.kind.begins == "finishing":
            return FINISHING in promised
        if self.kind.begins == "folder" and self.kind.cut_after is None:
            return bool(set(runs_in(folder / "runs")) - before)
        return True

    def trial(self, tally: Tally, unharmed: set[str], choose: Callable[[], tuple[int, float] | None]) -> None:
        """Kill and go on until the work is done, and judge it."""
        tally.trials += 1
        folder = self._parent / "trial"
        shutil.copytree(self.given, folder)
        command = self.kind.first if self.kind.cut_after is None else self.kind.again
        promised: dict[int, int] = {}
        kept: dict[int, bytes] = {}
        when = choose()
        while True:
            done = self.attempt(folder, in_folder(command, folder), when, self._number)
            promised |= done.promised
            if done.killed:
                tally.kills += 1
                if self.kind.makes_run:
                    look(runs_in(folder / "runs"), promised, kept, tally)
            elif done.code and done.code not in (-signal.SIGKILL,):
                tally.found("failed", 1, f"{command}: exit {done.code}: {done.said[-600:]}")
                break
            else:
                break
            if not self.kind.makes_run or runs_in(folder / "runs"):
                command = self.kind.again
            when = choose() if random.random() < 0.5 else None
        if self.kind.makes_run:
            judge(runs_in(folder / "runs"), promised, kept, tally)
        else:
            self._same(folder, tally)
        litter = {name for name in tree(folder) - unharmed if "/kept/" not in f"{name}/"}
        tally.found("litter", len(litter), sorted(litter)[:5])
        shutil.rmtree(folder)

    def _same(self, folder: Path, tally: Tally) -> None:
        """Compare pixels with the unharmed process's."""
        for name in ("picture.tif", "slm.png"):
            if (self._parent / "whole" / name).is_file():
                one, other = (read_image(at / name).pixels for at in (folder, self._parent / "whole"))
                tally.found("different", int(not np.array_equal(one, other)), folder / name)
        for path in (self._parent / "whole" / "film.ome.zarr").rglob("*"):
            twin = folder / path.relative_to(self._parent / "whole")
            if path.is_file() and "/c/" in str(path):
                tally.found("different", int(twin.read_bytes() != path.read_bytes()), twin)


def _send(process: int, number: int) -> None:
    """Send a signal: SIGINT twice, as the impatient do; SIGSTOP with SIGCONT after it."""
    os.kill(process, number)
    if number in (signal.SIGINT, signal.SIGSTOP):
        time.sleep(0.2)
        with contextlib.suppress(ProcessLookupError):
            os.kill(process, signal.SIGCONT if number == signal.SIGSTOP else number)


def _work(folder: Path, command: Sequence[str], promises: int) -> None:
    """Carry out a command in this process, and end it."""
    code = 70
    try:
        os.chdir(folder)
        for handle, name in ((1, "out"), (2, "said")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), handle)
        (folder / "tmp").mkdir(exist_ok=True)
        tempfile.tempdir = os.environ["TMPDIR"] = str(folder / "tmp")
        promising(promises)
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


def run_in_window() -> int:
    """Open the window on the bench of this folder, and carry the plan out from it."""
    os.environ["QT_QPA_PLATFORM"] = "offscreen"
    from PySide6.QtCore import QSettings
    from PySide6.QtTest import QTest

    from gui.app import application
    from gui.main_window import MainWindow
    from gui.session import BenchSession
    from instrument.bench.config_file import load_config
    from instrument.runs.acquire import prepare

    application()
    session = BenchSession(load_config(Path("bench.toml")))
    window = MainWindow(session, QSettings("window.ini", QSettings.Format.IniFormat))
    window.show()
    opening = session.open()
    while not opening.is_over:
        QTest.qWait(5)
    work = session.exclusive_job("A plan", lambda _: prepare(session.bench, PLAN, Path("runs")).execute())
    while not work.is_over:
        QTest.qWait(5)
    session.close()
    while not session.is_closed:
        QTest.qWait(5)
    return 0


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
    return found - {"out", "said", "tmp", "window.ini"}


def look(runs: list[Path], promised: dict[int, int], kept: dict[int, bytes], tally: Tally) -> None:
    """After a kill: what was promised must be there, and what is there must stay."""
    if not runs:
        tally.moments["before the folder had its name"] += 1
        tally.found("lost", len(promised), "no run")
        return
    try:
        run = Run.open(runs[0])
    except Exception as error:  # noqa: BLE001 - whatever it is, the run cannot be read
        tally.found("unreadable", 1, f"{runs[0]}: {error!r}")
        return
    tally.moments[str(run.condition)] += 1
    tally.moments["with half a line"] += any(bad.is_torn for bad in run.bad_lines)
    tally.stored_at_kill.append(len(run.records))
    check(run, promised, tally)
    for index in run.records:
        data = run.array.chunk_path(index).read_bytes()
        if kept.setdefault(index, data) != data:
            tally.found("repeated", 1, f"{run.path}: frame {index}")


def check(run: Run, promised: dict[int, int], tally: Tally) -> None:
    """Hold a run against what was promised."""
    lost = set(promised) - set(run.records)
    damaged = [index for index in run.records if run.verify(index) is not None]
    tally.found("lost", len(lost) + len(damaged), f"{run.path}: not there {sorted(lost)}, damaged {damaged}")
    for index, crc in promised.items():
        if index not in lost and zlib.crc32(run.array.chunk_path(index).read_bytes()) != crc:
            tally.found("different", 1, f"{run.path}: frame {index}")


def judge(runs: list[Path], promised: dict[int, int], kept: dict[int, bytes], tally: Tally) -> None:
    """At the end: ended, sound, every frame logged once, and the early ones as they were."""
    if len(runs) != 1:
        tally.found("unreadable", 1, f"{len(runs)} runs where one should be: {runs}")
        return
    run = Run.open(runs[0])
    sound = verify(run)
    missing = len(run.missing()) if run.plan is not None else 0
    ended = run.condition is RunCondition.COMPLETED or (
        run.plan is None and run.condition not in (RunCondition.RUNNING, RunCondition.CRASHED)
    )
    tally.found("lost", max(missing, int(not ended or not sound.is_sound)), f"{run!r} {sound}")
    check(run, promised, tally)
    lines, _ = read_lines(run.path / "log.jsonl")
    logged = Counter(line["index"] for line in lines if line["kind"] == "frame")
    twice = [index for index, times in logged.items() if times > 1]
    changed = [i for i, data in kept.items() if run.array.chunk_path(i).read_bytes() != data]
    tally.found("repeated", len(twice) + len(changed), f"{run.path}: twice {twice}, changed {changed}")


def kill(name: str, kills: int, number: int) -> Tally:
    """Kill one kind of work so often, and return what it came to."""
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="crash-test-") as folder:
        parent = Path(folder)
        work = Work(KINDS[name], parent, number)
        whole = parent / "whole"
        shutil.copytree(work.given, whole)
        command = in_folder(work.kind.first if work.kind.cut_after is None else work.kind.again, whole)
        done = work.whole(whole, command)
        sums = list(done.promised.values())
        if len(sums) != len(set(sums)):
            raise SystemExit(f"{name}: frames are alike; a swap would not be seen.")
        unharmed = tree(whole)

        def choose() -> tuple[int, float] | None:
            if tally.kills >= kills:
                return None
            if work.kind.begins == "finishing":  # most of what is left after it is the program's own end
                return 0, random.uniform(0.0, 0.4 * done.lived_s)
            if work.kind.begins == "start" or random.random() < 0.3:
                return 0, random.uniform(0.0, 1.05 * done.lived_s)
            return random.randint(1, len(sums)), random.uniform(0.0, 0.03)

        fruitless = 0
        while tally.kills < kills and fruitless < 50:
            before = tally.kills
            work.trial(tally, unharmed, choose)
            fruitless = 0 if tally.kills > before else fruitless + 1
    return tally


def command_line() -> int:
    """Run the crash test as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kind", nargs="*", choices=[*KINDS, []], help="kinds of work [default: all]")
    parser.add_argument("--kills", type=int, default=50, help="of each kind")
    parser.add_argument("--seed", type=int, default=1)
    signals = {"kill": signal.SIGKILL, "term": signal.SIGTERM, "hup": signal.SIGHUP}
    signals |= {"int": signal.SIGINT, "stop": signal.SIGSTOP}
    parser.add_argument("--signal", choices=signals, default="kill", help="int: twice; stop: and go on")
    options = parser.parse_args()
    random.seed(options.seed)
    for family in FAMILIES:
        package = importlib.import_module(family)
        for module in sorted(Path(package.__path__[0]).rglob("*.py")):
            with contextlib.redirect_stdout(io.StringIO()):
                relative = module.relative_to(Path(package.__path__[0])).with_suffix("").parts
                importlib.import_module(".".join((family, *(p for p in relative if p != "__init__"))))
    wrong = 0
    for name in options.kind or KINDS:
        began_s = time.monotonic()
        tally = kill(name, options.kills, signals[options.signal])
        stored = sorted(tally.stored_at_kill) or [0]
        print(
            f"{name}: {tally.kills} kills in {tally.trials} trials, {time.monotonic() - began_s:.0f} s; "
            f"found {json.dumps(tally.moments)}, {stored[0]} to {stored[-1]} frames stored; "
            f"{', '.join(f'{n} {what}' for what, n in tally.wrong.items()) or 'nothing wrong'}",
            flush=True,
        )
        for problem in tally.problems[:10]:
            print(f"  {problem}")
        wrong += sum(tally.wrong.values())
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(command_line())
