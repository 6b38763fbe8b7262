"""Processor time of the golden runs and of some benchmarks, here against another checkout, in turns.

``python -m tests.golden.times --against COMMIT_OR_FOLDER``. Each checkout runs its own ``tests/golden`` and
``benchmarks`` in processes of its own; the commit to compare with must have them.
"""

from __future__ import annotations

import argparse
import ast
import csv
import gc
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

HERE = Path(__file__).parents[2]
LIMIT = 1.05
WARM = 2
"""Runs before the first that counts: compilation, and what is remembered."""


def _live_step(_folder: Path, said: str) -> float:
    row = ast.literal_eval(next(line for line in said.splitlines() if line.startswith("{")))
    return float(row["cpu_ms_per_picture"]) / float(row["iterations"]) / 1e3


def _hologram_seconds(folder: Path, _said: str) -> float:
    with (folder / "out.csv").open() as file:
        rows = [row for row in csv.reader(file) if "ours" in row]
    return sum(max(float(row[3]) for row in rows if row[0] == q) for q in {row[0] for row in rows})


VOLUME_METHODS = ("--methods", "lean TV", "l1 (Douglas-Rachford)")
BENCHMARKS: dict[str, tuple[list[str], Callable[[Path, str], float] | None]] = {
    "volume_speed": (
        ["--sensor=128", "--depths=32", "--iterations=30", "--threads=1", "--rounds=1", *VOLUME_METHODS],
        None,
    ),
    "dense_2d": (["--height=384", "--width=480", "--seconds=0.2", "--out={out}"], None),
    "local_convolution": (
        ["--size=512", "--supports=64", "--rounds=10", "--threads=1", "--picture={out}.png"],
        None,
    ),
    "hologram_speed": (["--slm=135x240", "--iterations=25", "--out={out}"], _hologram_seconds),
    "live": (["--sizes=256x320", "--seconds=5", "--threads=1"], _live_step),
}
"""Arguments, and what is compared: None for the processor time of the whole, which ends by counts of
iterations; else a figure that it writes (hologram_speed: of L-BFGS; live, which fills a budget of time: of an
iteration)."""


def main() -> None:
    """Compare, or answer another process that does."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", metavar="COMMIT|FOLDER", help="the checkout to compare with")
    parser.add_argument("--cases", nargs="*", metavar="CASE", help="default: all that both have")
    parser.add_argument("--benchmarks", nargs="*", choices=[*BENCHMARKS, []], help="default: all")
    parser.add_argument("--rounds", type=int, default=7, help="turns of each [7]")
    parser.add_argument("--seconds", type=float, default=0.1, help="least processor time a turn [0.1]")
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.serve:
        serve()
        return
    if not asked.against:
        parser.error("--against is needed: a commit or a folder that has tests/golden")
    slower: list[str] = []
    with other_checkout(asked.against) as other:
        print(f"processor time here, at {asked.against}, ratio; medians of {asked.rounds} turns; * > {LIMIT}")
        if asked.cases is None or asked.cases:
            slower += compare_cases(other, asked.cases, asked.rounds, asked.seconds)
        for name in BENCHMARKS if asked.benchmarks is None else asked.benchmarks:
            turns = [(bench(HERE, name), bench(other, name)) for _ in range(max(asked.rounds // 2, 1) + 1)][
                1:
            ]
            slower += report(name, turns)
    print(f"slower: {', '.join(slower) or 'none'}")


@contextmanager
def other_checkout(named: str) -> Iterator[Path]:
    """Give a folder as it is, or a commit in a worktree that is removed afterwards."""
    if Path(named).is_dir():
        folder = Path(named).resolve()
        _require_golden(folder)
        yield folder
        return
    with TemporaryDirectory() as parent:
        folder = Path(parent) / "checkout"
        git = ["git", "-C", str(HERE), "worktree"]
        subprocess.run([*git, "add", "--detach", str(folder), named], check=True, capture_output=True)
        try:
            _require_golden(folder)
            yield folder
        finally:
            subprocess.run([*git, "remove", "--force", str(folder)], check=True)


def _require_golden(folder: Path) -> None:
    if not (folder / "tests/golden/times.py").is_file():
        sys.exit(f"{folder} has no tests/golden/times.py: name a checkout that has the golden set.")


def compare_cases(other: Path, asked: Sequence[str] | None, rounds: int, seconds: float) -> list[str]:
    """Time golden runs in turns; return those that take longer here."""
    slower = []
    with server(HERE) as here, server(other) as there:
        both = sorted(set(here.names) & set(there.names))
        for name in both if asked is None else asked:
            if name not in both:
                print(f"{name:<32} not in both")
                continue
            once = min(here.seconds(name, WARM), there.seconds(name, WARM), here.seconds(name, 1))
            repeats = max(1, int(seconds / max(once, 1e-4)))
            turns = [(here.seconds(name, repeats), there.seconds(name, repeats)) for _ in range(rounds)]
            slower += report(name, turns)
    return slower


def report(name: str, turns: Sequence[tuple[float, float]]) -> list[str]:
    """Print a line of the table."""
    ratio = median(a / b for a, b in turns)
    here, there = (1e3 * median(column) for column in zip(*turns, strict=True))
    mark = " *" if ratio > LIMIT else ""
    print(f"{name:<32}{here:10.2f} ms {there:10.2f} ms {ratio:8.3f}{mark}", flush=True)
    return [name] if mark else []


class Served:
    """A process that times golden runs of one checkout."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.names: list[str] = self._answer()

    def seconds(self, name: str, repeats: int) -> float:
        """Return processor seconds of one run, the mean of ``repeats``."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps([name, repeats]) + "\n")
        self._process.stdin.flush()
        return float(self._answer())

    def _answer(self) -> object:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            sys.exit("A process that times golden runs has ended; its words are above.")
        return json.loads(line)


@contextmanager
def server(checkout: Path) -> Iterator[Served]:
    """Start a process of a checkout that times golden runs."""
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.golden.times", "--serve"],
        cwd=checkout,
        env=_environment(checkout),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield Served(process)
    finally:
        process.kill()
        process.wait()


def serve() -> None:
    """Answer with the names of the cases, then to each ``[name, repeats]`` with seconds a run."""
    from tests.golden import adapter
    from tests.golden.cases import CASES

    assert adapter.project_file().is_relative_to(HERE), f"{adapter.project_file()} is not of {HERE}"
    answers = os.fdopen(os.dup(1), "w")  # what cases print does not come between
    os.dup2(2, 1)
    answers.write(json.dumps(list(CASES)) + "\n")
    answers.flush()
    with adapter.threads_used(1):
        for line in sys.stdin:
            name, repeats = json.loads(line)
            gc.collect()
            began = time.process_time()
            for _ in range(repeats):
                CASES[name].make()
            answers.write(json.dumps((time.process_time() - began) / repeats) + "\n")
            answers.flush()


def bench(checkout: Path, name: str) -> float:
    """Run a benchmark of a checkout; return what is compared, seconds."""
    arguments, figure = BENCHMARKS[name]
    with TemporaryDirectory() as folder:
        words = [word.format(out=Path(folder) / "out") for word in arguments]
        before = _used_by_children()
        done = subprocess.run(
            [sys.executable, str(checkout / "benchmarks" / f"{name}.py"), *words],
            cwd=folder,
            env=_environment(checkout),
            capture_output=True,
            text=True,
        )
        if done.returncode:
            sys.exit(f"{name} of {checkout} failed:\n{done.stderr}")
        return _used_by_children() - before if figure is None else figure(Path(folder), done.stdout)


def _used_by_children() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _environment(checkout: Path) -> dict[str, str]:
    one = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return os.environ | one | {"PYTHONPATH": str(checkout)}


if __name__ == "__main__":
    main()
