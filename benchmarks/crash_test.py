"""Kill a running acquisition with ``kill -9`` again and again, resume it, and look for what was lost.

    python benchmarks/crash_test.py --kills 200

Each trial runs a plan on the simulated bench in a process of its own, kills it at a random moment (while the
run's folder is made, while frames are taken and written, while the run is finished), maybe kills the resumed
one too, and resumes it to the end. What the killed process had been promised to be on the disk (it reports
every frame whose ``write`` has returned) must be there; no frame may be taken twice once its line is in the
log; every run must open and verify. Exit status 1 when any of it fails.

``kill -9`` ends the process, not the kernel: that everything is also synced in the right order, so that a
power cut costs no more, is held by tests/instrument/runs/test_store_order.py.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.plan import Part, Plan
from instrument.runs.acquire import prepare, prepare_resume
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


@dataclass
class Tally:
    """What all trials together came to."""

    kills: int = 0
    trials: int = 0
    stored_at_kill: list[int] = field(default_factory=list)
    moments: Counter[str] = field(default_factory=Counter)
    lost: int = 0
    repeated: int = 0
    unreadable: int = 0
    torn: int = 0
    unlogged: int = 0
    problems: list[str] = field(default_factory=list)


def acquire(bench: Bench, folder: Path, promises: int) -> None:
    """Run the plan in ``folder``, or go on with the run that is there, reporting what was promised."""
    write = RunWriter.write

    def reporting(self: RunWriter, frames: Sequence[FrameToStore]) -> None:
        write(self, frames)
        os.write(promises, bytes(frame.index for frame in frames))

    RunWriter.write = reporting  # type: ignore[method-assign]
    runs = runs_in(folder)
    if runs:
        prepare_resume(bench, runs[0]).execute()
    else:
        prepare(bench, PLAN, folder).execute()


def runs_in(folder: Path) -> list[Path]:
    """Return the run folders in a folder: the one, or none yet."""
    return sorted(path for path in folder.iterdir() if not path.name.startswith("."))


def attempt(bench: Bench, folder: Path, delay_s: float | None) -> tuple[set[int], bool, float]:
    """Let a process acquire and kill it after ``delay_s`` (None: let it finish).

    The process is a fork with the bench ready to use: its start is not what is to be killed.

    Returns the frames it was promised, whether it was killed, and how long it lived.
    """
    reading, writing = os.pipe()
    began_s = time.monotonic()
    process = os.fork()
    if process == 0:
        status = 1
        try:
            os.close(reading)
            acquire(bench, folder, writing)
            status = 0
        except BaseException:  # noqa: BLE001 - shown, and the process ends here whatever it was
            traceback.print_exc()
        finally:
            os._exit(status)
    os.close(writing)
    if delay_s is not None:
        time.sleep(delay_s)
        os.kill(process, signal.SIGKILL)
    with os.fdopen(reading, "rb") as pipe:
        promised = set(pipe.read())
    _, status = os.waitpid(process, 0)
    killed = os.WIFSIGNALED(status)
    if not killed and os.WEXITSTATUS(status) != 0:
        raise SystemExit("The acquisition itself failed; see above.")
    return promised, killed, time.monotonic() - began_s


def trial(bench: Bench, folder: Path, choose_delay: Callable[[], float | None], tally: Tally) -> None:
    """Kill and resume one run until it is complete, and judge it."""
    tally.trials += 1
    promised: set[int] = set()
    kept: dict[int, bytes] = {}
    delay_s = choose_delay()
    while True:
        reported, killed, _ = attempt(bench, folder, delay_s)
        promised |= reported
        runs = runs_in(folder)
        if killed:
            tally.kills += 1
            look(runs, promised, kept, tally)
        elif delay_s is None or (runs and Run.open(runs[0]).condition is RunCondition.COMPLETED):
            break
        # A run that was killed once is let finish, or killed again with half the probability.
        delay_s = choose_delay() if random.random() < 0.5 else None
    judge(runs_in(folder), kept, tally)


def look(runs: list[Path], promised: set[int], kept: dict[int, bytes], tally: Tally) -> None:
    """After a kill: what was promised must be there, and what is there must stay."""
    if not runs:
        tally.moments["before the folder had its name"] += 1
        if promised:
            tally.lost += len(promised)
        return
    try:
        run = Run.open(runs[0])
    except Exception as error:  # noqa: BLE001 - whatever it is, the run cannot be read
        tally.unreadable += 1
        tally.problems.append(f"{runs[0]}: {error!r}")
        return
    tally.moments[str(run.condition)] += 1
    tally.torn += any(bad.is_torn for bad in run.bad_lines)
    tally.stored_at_kill.append(len(run.records))
    lost = promised - set(run.records)
    damaged = [index for index in run.records if run.verify(index) is not None]
    if lost or damaged:
        tally.lost += len(lost) + len(damaged)
        tally.problems.append(f"{run.path}: promised {sorted(lost)} not there, damaged {damaged}")
    for index in run.records:
        data = run.array.chunk_path(index).read_bytes()
        if kept.setdefault(index, data) != data:
            tally.repeated += 1
            tally.problems.append(f"{run.path}: frame {index} was taken again")


def judge(runs: list[Path], kept: dict[int, bytes], tally: Tally) -> None:
    """At the end: complete, sound, every frame logged once, and the early ones as they were."""
    if len(runs) != 1:
        tally.unreadable += 1
        tally.problems.append(f"{len(runs)} runs where one should be: {runs}")
        return
    run = Run.open(runs[0])
    found = verify(run)
    if run.condition is not RunCondition.COMPLETED or run.missing() or not found.is_sound:
        tally.lost += max(1, len(run.missing()))
        tally.problems.append(f"{run!r} {found}")
    lines, _ = read_lines(run.path / "log.jsonl")
    logged = Counter(line["index"] for line in lines if line["kind"] == "frame")
    twice = [index for index, times in logged.items() if times > 1]
    changed = [i for i, data in kept.items() if run.array.chunk_path(i).read_bytes() != data]
    tally.repeated += len(twice) + len(changed)
    if twice or changed:
        tally.problems.append(f"{run.path}: logged twice {twice}, changed {changed}")
    text = next((str(e["text"]) for e in run.events if e["kind"] == "found" and "without" in e["text"]), "")
    tally.unlogged += bool(text)


def main() -> int:
    """Run the crash test as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--kills", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--keep", action="store_true", help="keep the runs (their folder is printed)")
    options = parser.parse_args()
    random.seed(options.seed)
    parent = Path(tempfile.mkdtemp(prefix="crash-test-"))
    tally = Tally()
    began_s = time.monotonic()
    with open_bench(parse_config(BENCH, None)) as bench:
        for name in ("warm", "whole"):
            (parent / name).mkdir()
        acquire(bench, parent / "warm", os.open(os.devnull, os.O_WRONLY))
        _, _, whole_s = attempt(bench, parent / "whole", None)
        print(f"{len(PLAN)} frames take {whole_s:.2f} s unharmed; runs in {parent}")

        def choose_delay() -> float | None:
            if tally.kills >= options.kills:
                return None
            return random.uniform(0.0, 1.05 * whole_s)

        while tally.kills < options.kills:
            folder = parent / f"{tally.trials:04d}"
            folder.mkdir()
            trial(bench, folder, choose_delay, tally)
            if not options.keep:
                shutil.rmtree(folder)
            print(f"\r{tally.kills} kills", end="", flush=True)
    print(f"\r{tally.kills} kills in {tally.trials} runs, {time.monotonic() - began_s:.0f} s")
    stored = sorted(tally.stored_at_kill)
    print(f"found after a kill: {dict(tally.moments)}")
    if stored:
        print(f"frames stored at the kill: {stored[0]} to {stored[-1]}, median {stored[len(stored) // 2]}")
    print(f"half lines in the log: {tally.torn}; runs with images without a line: {tally.unlogged}")
    print(f"frames lost {tally.lost}, repeated {tally.repeated}, unreadable runs {tally.unreadable}")
    for problem in tally.problems:
        print(problem)
    if not options.keep:
        shutil.rmtree(parent)
    return 1 if tally.lost or tally.repeated or tally.unreadable else 0


if __name__ == "__main__":
    sys.exit(main())
