"""ADMM with total variation against lensless 1.0.8 (PyPI, AGPL), on the measured hand: speed and objective.

    python benchmarks/against_lensless.py [--sizes 900x1200 270x480] [--channels 1 3] [--seconds 60]
    [--rounds 7] [--tau 1] [--threads N] [--workers 1] [--environment FOLDER] [--out FILE.csv]

lensless is never imported here. It runs in a virtual environment of its own, made on first use in the
user's cache folder (or the one named), behind ``lensless_worker.py``; pictures pass as .npy files.

Both minimise ``1/2 ||A x - b||^2 + tau TV(x)``, ``x >= 0``, in float32: ``b`` over its noise, PSFs of unit
energy, ``A`` the cropped linear convolution, TV the sum of absolute differences of wrapped neighbours on the
FFT grid. lensless takes the data with maximum 1, as it loads it, so its ``tau`` is divided by that scale; its
``mu`` are relative to the data term and have none. It is run twice: with its own default ``mu``, and with the
penalties at which our ``Admm`` settled. Its object is centred on pixel ``grid // 2`` and is rolled to ours.

Iterations: all take turns, three each; medians. Objective: turns by time spent, every solver ``--seconds`` of
its own, set-up included, compilation and the judging of iterates not. The objective is judged by one function
for all; of lensless the better of its clipped object and its non-negative split variable counts. The defaults
take about 25 minutes on two cores. More in docs/benchmarks/against-lensless.md.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import io
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
import venv
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import numpy as np
from admm_hand import DATA, inputs, processor

from recon.base.threads import get_threads, set_threads
from recon.camera.convolution import Convolution
from recon.priors import NonNegativity, TotalVariation
from recon.reconstruction.problem import Problem as Scaled
from recon.solvers import Admm, SensorAdmm, Solver

REQUIREMENT = "lensless==1.0.8"
BLOCK = 3
"""Iterations of one turn when an iteration is timed."""

CPU_TARGET, OBJECTIVE_TARGET = 3.0, 5.0
"""Aims: CPU per RGB iteration, and time to the same objective, better by these factors."""

DEFAULT_MU = (1e-6, 1e-5, 4e-5)
"""lensless' own ``mu1, mu2, mu3``, for a PSF whose energy over all channels together is 1."""

SETTLED_AFTER = 33
"""Iterations after which the penalties of ``Admm`` stay."""

Rows = list[dict[str, Any]]


class Problem:
    """The hand at one size, scaled alike for both sides."""

    def __init__(self, height: int, width: int, channels: int, tau: float) -> None:
        psf, raw = (resized(image, height, width) for image in inputs(1))
        if channels > 1:
            # Colours: the same hand dimmer and a little aside; the PSF is the same but nobody is told so.
            copies = ((1.0, 0, 0), (0.8, 5, -7), (0.6, -9, 4))
            raw = np.stack([share * np.roll(raw, shift, (0, 1)) for share, *shift in copies], axis=2)
            psf = np.repeat(psf[..., None], 3, axis=2)
        psfs = np.atleast_3d(psf)
        self.psfs = np.moveaxis(psfs / np.linalg.norm(psfs, axis=(0, 1)), 2, 0).astype(np.float32)
        self.data = Scaled.of(raw, psf).data
        self.prior = TotalVariation(tau) + NonNegativity()
        self.scale = float(self.data.max())
        self.tau = tau
        # Our own grid may be a little smaller; on the same one both have the same object, pixel for pixel.
        self.judge = self.camera()

    def camera(self) -> Convolution:
        """Return our operator on the grid of lensless."""
        height, width = self.data.shape[1:]
        return Convolution(self.psfs, (height, width), grid_shape=fast_grid(height, width))

    def objective(self, x: np.ndarray) -> float:
        """Return the objective of an object on our grid."""
        misfit = self.judge.forward(x) - self.data
        return 0.5 * float(np.sum(misfit**2, dtype=np.float64)) + self.prior.value(x)

    def from_theirs(self, image: np.ndarray) -> np.ndarray:
        """Put an object of lensless, (height, width, channels), on our grid in our units."""
        # Object pixel i casts PSF pixel m on sensor pixel j where i = j - m + n - 1 here, + grid // 2 there.
        grid, sensor = self.judge.grid_shape, self.judge.sensor_shape
        shift = [n - 1 - g // 2 for n, g in zip(sensor, grid, strict=True)]
        rolled = np.roll(np.moveaxis(image, 2, 0), shift, (1, 2))
        return np.ascontiguousarray(rolled) * np.float32(self.scale)


class Contender(ABC):
    """A solver that is run in turns and judged between them."""

    def __init__(self, name: str, problem: Problem) -> None:
        self.name, self.problem = name, problem
        self.iteration = 0
        self.spent = 0.0
        self.curve: list[tuple[int, float, float]] = []

    @abstractmethod
    def run(self, iterations: int) -> tuple[float, float]:
        """Go on for some iterations; return their wall and CPU seconds."""

    @abstractmethod
    def value(self) -> float:
        """Return the objective now."""

    def start(self) -> None:
        """Start over; set-up counts as time spent."""
        self.iteration, self.curve = 0, []
        self.spent = self.set_up()

    @abstractmethod
    def set_up(self) -> float:
        """Make a solver at iteration 0; return the seconds that took."""

    @abstractmethod
    def close(self) -> None:
        """Free the solver."""

    def advance(self) -> None:
        """Run to the next iterate worth judging, and judge it."""
        step = 1 if self.iteration < 20 else 5 if self.iteration < 100 else 25
        self.spent += self.run(step)[0]
        self.iteration += step
        self.curve.append((self.iteration, self.spent, self.value()))


class Ours(Contender):
    """One of this project's solvers, in this process."""

    def __init__(self, problem: Problem, solver: type[Solver]) -> None:
        super().__init__(f"ours, {solver.__name__}", problem)
        self._type: Any = solver
        self._solver: Any = None

    def set_up(self) -> float:
        """Make the operator and the solver."""
        if self._solver is None:
            self._make().compile()
        began = time.perf_counter()
        self._solver = self._make()
        return time.perf_counter() - began

    def run(self, iterations: int) -> tuple[float, float]:
        """Step."""
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(iterations):
            self._solver.step()
            self._solver.iteration += 1
        return time.perf_counter() - wall, time.process_time() - cpu

    def value(self) -> float:
        """Judge the split variable that obeys the constraint."""
        return self.problem.objective(self._solver.solution)

    def close(self) -> None:
        """Drop the solver."""
        self._solver = None

    def _make(self) -> Solver:
        p = self.problem
        made: Solver = self._type(p.camera(), p.data, p.prior)
        return made


class Worker:
    """The process that has lensless."""

    def __init__(self, environment: Path, folder: Path, workers: int) -> None:
        self.folder, self.workers = folder, workers
        script = Path(__file__).with_name("lensless_worker.py")
        self._process = subprocess.Popen(
            [interpreter(environment), str(script)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=surroundings(),
        )  # fmt: skip
        self.versions = self._answer()
        if f"lensless=={self.versions['lensless']}" != REQUIREMENT:
            raise SystemExit(f"{environment} has lensless {self.versions['lensless']}, not {REQUIREMENT}.")

    def ask(self, do: str, name: str, **parameters: object) -> dict[str, Any]:
        """Send a request and wait for its answer."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"do": do, "name": name, **parameters}) + "\n")
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait()

    def _answer(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit(f"The process that runs lensless ended with status {self._process.wait()}.")
        answer: dict[str, Any] = json.loads(line)
        return answer


class Theirs(Contender):
    """The ADMM of lensless with some penalties."""

    def __init__(self, problem: Problem, worker: Worker, label: str, mu: tuple[float, ...]) -> None:
        super().__init__(f"lensless, {label}", problem)
        self._worker, self._mu = worker, mu

    def set_up(self) -> float:
        """Hand PSF and data over; only lensless' own part is timed."""
        p, folder = self.problem, self._worker.folder
        np.save(folder / "psf.npy", np.ascontiguousarray(np.moveaxis(p.psfs, 0, 2)[None]))
        np.save(folder / "data.npy", np.ascontiguousarray(np.moveaxis(p.data, 0, 2) / np.float32(p.scale)))
        named = dict(zip(("mu1", "mu2", "mu3"), self._mu, strict=True))
        answer = self._worker.ask(
            "make", self.name, folder=str(folder), tau=p.tau / p.scale, workers=self._worker.workers, **named
        )
        return float(answer["seconds"])

    def run(self, iterations: int) -> tuple[float, float]:
        """Have it iterate."""
        answer = self._worker.ask("run", self.name, iterations=iterations)
        return answer["wall"], answer["cpu"]

    def value(self) -> float:
        """Judge the better of its two candidates."""
        file = self._worker.folder / "object.npy"
        self._worker.ask("save", self.name, file=str(file))
        candidates = (self.problem.from_theirs(image) for image in np.load(file))
        return min(self.problem.objective(np.maximum(x, 0)) for x in candidates)

    def check(self) -> None:
        """Make sure that its object casts the same light by our operator as by its own."""
        p, file = self.problem, self._worker.folder / "light.npy"
        self._worker.ask("save", self.name, file=str(self._worker.folder / "object.npy"))
        self._worker.ask("light", self.name, file=str(file))
        here = p.judge.forward(p.from_theirs(np.load(self._worker.folder / "object.npy")[0]))
        there = np.moveaxis(np.load(file), 2, 0) * p.scale
        error = float(np.linalg.norm(here - there) / np.linalg.norm(there))
        if not error < 1e-3:
            raise SystemExit(f"Our operator and that of lensless differ by {error:.1e} on the same object.")

    def close(self) -> None:
        """Free its memory."""
        self._worker.ask("forget", self.name)


def resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Crop to the aspect ratio about the centre, then average over areas."""
    import cv2

    rows, columns = image.shape
    scale = min(rows / height, columns / width)
    kept = round(scale * height), round(scale * width)
    top, left = (rows - kept[0]) // 2, (columns - kept[1]) // 2
    part = np.ascontiguousarray(image[top : top + kept[0], left : left + kept[1]], np.float32)
    return np.asarray(cv2.resize(part, (width, height), interpolation=cv2.INTER_AREA))


def fast_grid(height: int, width: int) -> tuple[int, int]:
    """Return the grid that lensless pads a sensor to."""
    from scipy.fftpack import next_fast_len

    return int(next_fast_len(2 * height - 1)), int(next_fast_len(2 * width - 1))


def interpreter(environment: Path) -> str:
    """Path of an environment's Python."""
    return str(environment / ("Scripts/python.exe" if os.name == "nt" else "bin/python"))


def surroundings() -> dict[str, str]:
    """Return the variables without ours of Python: a PYTHONPATH would bring our libraries along."""
    return {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}


def ready(environment: Path | None) -> Path:
    """Return an environment with lensless: the one named, or our own, made when it is missing."""
    if environment is not None:
        return environment
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    environment = cache / "diffuserbench" / REQUIREMENT.replace("==", "-")
    complete = environment / "complete"
    if not complete.exists():
        print(f"Installing {REQUIREMENT} in {environment} ...", flush=True)
        venv.create(environment, with_pip=True, clear=True)
        pip = [interpreter(environment), "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
        subprocess.run([*pip, REQUIREMENT], check=True, env=surroundings())
        complete.touch()
    return environment


def settled_penalties(problem: Problem) -> tuple[float, ...]:
    """Return our ``Admm``'s penalties once settled, mean over channels, as ``mu1, mu2, mu3``."""
    solver = Admm(problem.camera(), problem.data, problem.prior)
    for _ in range(SETTLED_AFTER):
        solver.step()
        solver.iteration += 1
    return tuple(float(mu) for mu in solver.penalties.mean(axis=1))


def pace(contenders: list[Contender], rounds: int) -> np.ndarray:
    """Return median wall and CPU milliseconds of an iteration, a row a contender."""
    for contender in contenders:
        contender.start()
        contender.run(1)
    times = [[contender.run(BLOCK) for contender in contenders] for _ in range(rounds)]
    return np.asarray(np.median(times, axis=0)) * 1e3 / BLOCK


def race(contenders: list[Contender], seconds: float) -> None:
    """Give every contender its seconds, in turns: who has spent least goes on."""
    for contender in contenders:
        contender.start()
        contender.advance()
    while (last := min(contenders, key=lambda c: c.spent)).spent < seconds:
        last.advance()


def reached(contender: Contender, level: float) -> float:
    """Seconds to the first iterate judged at or below a level (one may stop there); infinity without any."""
    return min((spent for _, spent, value in contender.curve if value <= level), default=np.inf)


def compare(problem: Problem, worker: Worker, options: argparse.Namespace) -> tuple[Rows, Rows]:
    """Time iterations, race to the objective, print; return a row a contender and one an iterate judged."""
    n = len(problem.data)
    # Unit energy a channel in place of all channels together: the object's penalties grow with their number.
    own = (DEFAULT_MU[0], n * DEFAULT_MU[1], n * DEFAULT_MU[2])
    mu = settled_penalties(problem)
    ours = [Ours(problem, solver) for solver in (Admm, SensorAdmm)]
    theirs = [Theirs(problem, worker, "its mu", own), Theirs(problem, worker, "our mu", mu)]
    contenders = [*ours, *theirs]
    times = pace(contenders, options.rounds)
    race(contenders, options.seconds)
    for their in theirs:
        their.check()
    for contender in contenders:
        contender.close()

    least = {c.name: min(value for _, _, value in c.curve) for c in contenders}
    best, theirs_best = min(least.values()), min(least[c.name] for c in theirs)
    height, width = problem.judge.sensor_shape
    case = {"height": height, "width": width, "channels": n}
    rows: Rows = [
        {
            **case,
            "solver": c.name,
            "wall_ms": wall,
            "cpu_ms": cpu,
            "iterations": c.iteration,
            "least_objective": least[c.name],
            "seconds_to_best": reached(c, 1.01 * best),
            "seconds_to_best_of_lensless": reached(c, 1.01 * theirs_best),
        }
        for c, (wall, cpu) in zip(contenders, times, strict=True)
    ]
    print(
        f"\n{height} x {width}, {'RGB' if n == 3 else 'grey'}, grid "
        f"{problem.judge.grid_shape[0]} x {problem.judge.grid_shape[1]}, tau {problem.tau:g} of the noise "
        f"({problem.tau / problem.scale:.1e} in lensless), our mu {mu[0]:.2g}, {mu[1]:.2g}, {mu[2]:.2g}"
    )
    print(
        "  solver               ms wall    ms CPU  iterations  least objective   s to 1 %  s to lensless' 1 %"
    )
    for row in rows:
        print(
            f"  {row['solver']:18} {row['wall_ms']:9.1f} {row['cpu_ms']:9.1f} {row['iterations']:11} "
            f"{row['least_objective']:16.6g} {row['seconds_to_best']:10.1f} "
            f"{row['seconds_to_best_of_lensless']:19.1f}"
        )
    print_ratios(rows[: len(ours)], rows[len(ours) :], n, options.seconds)
    names = ("iteration", "seconds", "objective")
    curves = [
        {**case, "solver": c.name, **dict(zip(names, point, strict=True))}
        for c in contenders
        for point in c.curve
    ]
    return rows, curves


def print_ratios(ours: Rows, theirs: Rows, n: int, budget: float) -> None:
    """Print lensless over ours, the better of its two runs counting, with the targets."""
    cpu, wall = (min(row[key] for row in theirs) for key in ("cpu_ms", "wall_ms"))
    aim = f" (target {CPU_TARGET:g})" if n == 3 else ""
    for row in ours:
        print(
            f"  lensless / {row['solver'].removeprefix('ours, ')}: CPU per iteration "
            f"{cpu / row['cpu_ms']:.1f}{aim}, wall {wall / row['wall_ms']:.1f}"
        )
    for key, level in (("seconds_to_best", "anyone's"), ("seconds_to_best_of_lensless", "lensless'")):
        a, b = (min(row[key] for row in rows) for rows in (ours, theirs))
        if np.isinf(a):
            ratio = "not reached by ours"
        else:
            ratio = f"{b / a:.1f}" if np.isfinite(b) else f"more than {budget / a:.1f}"
        print(f"  time to within 1 % of {level} least, best of lensless / best of ours: {ratio}", end=" ")
        print(f"(target {OBJECTIVE_TARGET:g})")


def size(text: str) -> tuple[int, int]:
    """Parse ``900x1200``."""
    height, width = (int(n) for n in text.split("x"))
    return height, width


def main() -> None:
    """Run the comparison, print tables, write them as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", type=size, nargs="+", default=[(900, 1200), (270, 480)])
    parser.add_argument("--channels", type=int, nargs="+", choices=(1, 3), default=[1, 3])
    parser.add_argument("--seconds", type=float, default=60, help="of each solver in the race")
    parser.add_argument("--rounds", type=int, default=7, help="of three iterations each, for their pace")
    parser.add_argument("--tau", type=float, default=1.0, help="weight of TV over the noise")
    parser.add_argument("--threads", type=int, default=get_threads(), help="ours")
    parser.add_argument(
        "--workers", type=int, default=1, help="threads of scipy.fft in lensless; 1 as shipped"
    )
    parser.add_argument("--environment", type=Path, help=f"virtual environment that has {REQUIREMENT}")
    parser.add_argument("--out", type=Path, help="CSV of the tables; the curves go beside it")
    options = parser.parse_args()
    set_threads(options.threads)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(line_buffering=True)  # a table may be minutes away

    rows: Rows = []
    curves: Rows = []
    with tempfile.TemporaryDirectory() as folder:
        worker = Worker(ready(options.environment), Path(folder), options.workers)
        print(
            f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}, {processor()}, {os.cpu_count()} CPUs,", end=" "
        )
        print(
            f"load {os.getloadavg()[0]:.1f}, Python {platform.python_version()}, numpy {np.__version__};",
            end=" ",
        )
        print(f"{REQUIREMENT} with numpy {worker.versions['numpy']}")
        print(f"{options.threads} threads against {options.workers} of scipy.fft; {options.seconds:g} s each")
        if not DATA.is_dir():
            print(f"The measured hand is not at {DATA}: a synthetic stand-in is used.")
        for height, width in options.sizes:
            for channels in options.channels:
                found, race_curves = compare(Problem(height, width, channels, options.tau), worker, options)
                rows += found
                curves += race_curves
                if options.out:
                    write(options.out, rows)
                    write(options.out.with_stem(options.out.stem + "-curves"), curves)
        worker.close()


def write(file: Path, rows: Rows) -> None:
    """Write rows as CSV."""
    with file.open("w", newline="") as stream:
        table = csv.DictWriter(stream, list(rows[0]))
        table.writeheader()
        table.writerows(rows)


if __name__ == "__main__":
    main()
