"""Kill the program with ``kill -9`` at random moments of its work, go on, and look for what was lost.

    python benchmarks/crash_test.py                          50 kills of every kind of work
    python benchmarks/crash_test.py run resume --kills 200   of some, more of each
    TMPDIR=/dev/shm python benchmarks/crash_test.py          on a tmpfs; else on the disk of TMPDIR
    python benchmarks/crash_test.py record --signal term     another signal, which it answers itself
    python benchmarks/crash_test.py run record --clock       and the clock jumps by hours all the while

Each trial carries out one command of the terminal on the simulated bench in a process of its own and kills
it: runs, sweeps, recordings and the window once the run's folder is there (at any time, or just after one
of the frames), finishing once the run's end is being written, files (reconstruct, video, hologram, points)
at any time. It is gone on with as a user would, killed again with half the probability, until it ends.
Every frame is unlike every other, and is told with its checksum when ``write`` has returned: it must be
there, the same, in its own place, at every later look. No frame may be taken twice once its line is in the
log; every run must open and verify; files must be those of an unharmed process; nothing else may lie about
in the end. Exit status 1 when any of it fails.

``kill -9`` ends the process, not the kernel: that everything is also synced in the right order, so that a
power cut costs no more, is held by tests/instrument/runs/test_store_order.py, tests/kernel_vm/power_cut.py.
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
import sys
import tempfile
import time
import zlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.crash_work import BENCH, FINISHING, KINDS, PLAN, PROMISE, Kind, in_folder, runs_in, tree, work
from instrument.files.images import read_image, write_image
from instrument.runs.inspection import verify
from instrument.runs.log import read_lines
from instrument.runs.run import Run, RunCondition

IMPATIENT_S = 600.0
FAMILIES = ("instrument.cli", "instrument.tasks", "instrument.reconstruction", "calibration_routines")
"""Imported before anything is forked, so that no process is killed while it imports them."""


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
    sent: bool
    """Whether it got its signal."""
    killed: bool
    code: int
    said: str
    lived_s: float
    """From when on it was to be killed."""


class Work:
    """One kind of work in a folder, with what it is given."""

    def __init__(self, kind: Kind, parent: Path, number: int, *, clock_jumps: bool) -> None:
        self.kind, self._parent, self._number = kind, parent, number
        self._clock_jumps = clock_jumps
        self.lives_s = 0.0
        """How long a process lives that nobody kills; the first one reads what is cached since."""
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
            self.whole(self.given, in_folder(command, self.given))
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
            work(folder, command, writing, clock_jumps=self._clock_jumps)
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
        return Attempt(promised, sent, killed, code, said, lived_s)

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
        attempts = 0
        while True:
            done = self.attempt(folder, in_folder(command, folder), when, self._number)
            attempts += 1
            promised |= done.promised
            if done.sent and self._number == signal.SIGSTOP:
                tally.kills += 1  # it goes on by itself
            if done.killed:
                tally.kills += 1
                if self.kind.makes_run:
                    look(runs_in(folder / "runs"), promised, kept, tally)
            elif done.code and done.code not in (-signal.SIGKILL,):
                tally.found("failed", 1, f"{command}: exit {done.code}: {done.said[-6000:]}")
                break
            else:
                if attempts == 1:
                    self.lives_s = max(done.lived_s, 0.7 * self.lives_s)
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
        """Compare pixels and places with the unharmed process's."""
        places = Path("points.csv")
        if (self._parent / "whole" / places).is_file():
            one, other = ((at / places).read_bytes() for at in (folder, self._parent / "whole"))
            tally.found("different", int(one != other), folder / places)
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


def kill(name: str, kills: int, number: int, seconds: float, *, clock_jumps: bool) -> Tally:
    """Kill one kind of work so often, or for so long, and return what it came to."""
    tally = Tally()
    with tempfile.TemporaryDirectory(prefix="crash-test-") as folder:
        parent = Path(folder)
        kind = KINDS[name]
        job = Work(kind, parent, number, clock_jumps=clock_jumps)
        whole = parent / "whole"
        shutil.copytree(job.given, whole)
        command = in_folder(kind.first if kind.cut_after is None else kind.again, whole)
        done = job.whole(whole, command)
        job.lives_s = done.lived_s
        sums = list(done.promised.values())
        if len(sums) != len(set(sums)):
            raise SystemExit(f"{name}: frames are alike; a swap would not be seen.")
        unharmed = tree(whole)

        def choose() -> tuple[int, float] | None:
            if tally.kills >= kills:
                return None
            if kind.begins == "finishing":  # most of what is left after it is the program's own end
                return 0, random.uniform(0.0, 0.4 * job.lives_s)
            if kind.begins == "start" or random.random() < 0.3:
                return 0, random.uniform(0.0, 1.05 * job.lives_s)
            return random.randint(1, len(sums)), random.uniform(0.0, 0.03)

        fruitless, ends_s = 0, time.monotonic() + seconds
        while tally.kills < kills and fruitless < 50 and time.monotonic() < ends_s:
            before = tally.kills
            job.trial(tally, unharmed, choose)
            fruitless = 0 if tally.kills > before else fruitless + 1
    return tally


def command_line() -> int:
    """Run the crash test as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("kind", nargs="*", choices=[*KINDS, []], help="kinds of work [default: all]")
    parser.add_argument("--kills", type=int, default=50, help="of each kind")
    parser.add_argument("--seconds", type=float, default=float("inf"), help="of each kind, at most")
    parser.add_argument("--seed", type=int, default=1)
    signals = {"kill": signal.SIGKILL, "term": signal.SIGTERM, "hup": signal.SIGHUP}
    signals |= {"int": signal.SIGINT, "stop": signal.SIGSTOP}
    parser.add_argument("--signal", choices=signals, default="kill", help="int: twice; stop: and go on")
    parser.add_argument("--clock", action="store_true", help="the clock jumps by up to a day, at every look")
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
        tally = kill(name, options.kills, signals[options.signal], options.seconds, clock_jumps=options.clock)
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
