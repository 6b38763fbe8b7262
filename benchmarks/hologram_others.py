"""Holograms beside other packages' optimisers, on a problem that all of them can state: without a mask.

An SLM of n x n phases, a picture of n x n points over its whole far field, on the grid of a plain FFT.
slmsuite (MIT) and odak (MPL 2.0) run in a virtual environment of their own, behind
``hologram_others_worker.py``; odak's padding is taken out, so that its far field has the same grid. Every
result is judged by the same code: on that grid, as the problem is put, and as an eye sees it, between the
grid's points too. Processor seconds of one thread, without what is prepared or compiled once::

    python -m venv others && others/bin/pip install slmsuite==0.5.0 odak==0.2.7 torch
    python benchmarks/hologram_others.py --python others/bin/python --size 256 --out hologram-others
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import subprocess
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from instrument.files.sample_images import load_sample
from recon.base.metrics import psnr
from recon.base.threads import set_threads
from recon.holography import Display, HologramModel, Target, compute_hologram
from recon.holography.display import no_mask
from recon.holography.scores import judge

COUNTS = (10, 30, 100, 300)
Row = dict[str, object]


class Problem:
    """A picture over the whole far field of an SLM without a mask."""

    def __init__(self, name: str, size: int) -> None:
        image = load_sample(name, (size, size))
        self.display = Display((size, size), no_mask((size, size)))
        self.target = Target(image, white=1.0)
        self.wanted = image / image.mean()
        self.peak = 1.0 / image.mean()

    def judged(self, phases: np.ndarray) -> tuple[float, float]:
        """Return the PSNR on the FFT's grid, and as an eye sees it, dB."""
        slm = np.exp(1j * phases.astype(np.float64))
        far = np.fft.fftshift(np.abs(np.fft.fft2(slm)) ** 2) / slm.size
        on_grid = psnr(far * (self.wanted.mean() / far.mean()), self.wanted, data_range=self.peak)
        return on_grid, judge(slm[None], self.display, self.target).psnr_db

    def ours(self, loss: str, grid: str) -> list[Row]:
        """Run this project's search; ``none`` on the dissertation's grid is the others' problem."""
        model = HologramModel(self.display, [self.target], loss=loss, grid=grid)
        compute_hologram(model, iterations=2)  # compiles
        rows = []
        for count in COUNTS:
            began = time.process_time()
            found = compute_hologram(model, iterations=count, tolerance=0, seed=1)
            cpu_s = time.process_time() - began
            rows.append(self.row(f"this, loss {loss}, {grid}", count, cpu_s, found.phase_rad[0]))
        return rows

    def row(self, name: str, count: int, cpu_s: float, phases: np.ndarray) -> Row:
        """Return one line of the table."""
        on_grid, seen = self.judged(phases)
        return {
            "method": name,
            "iterations": count,
            "cpu_s": round(cpu_s, 3),
            "grid_db": round(on_grid, 2),
            "seen_db": round(seen, 2),
        }

    def theirs(self, python: str) -> list[Row]:
        """Run the other packages."""
        rows = []
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            np.save(folder / "wanted.npy", self.wanted)
            worker = Path(__file__).resolve().with_name("hologram_others_worker.py")
            quiet = os.environ | {"TQDM_DISABLE": "1"}
            command = [str(Path(python).absolute()), str(worker), name, *map(str, COUNTS)]
            # There, for odak writes a log where it runs.
            subprocess.run(command, check=True, env=quiet, stdout=subprocess.DEVNULL, cwd=name)
            times = json.loads((folder / "times.json").read_text())
            print(times.pop("versions"))
            for label, cpu_s in times.items():
                method, count = label.rsplit("-", 1)
                rows.append(self.row(method, int(count), cpu_s, np.load(folder / f"{label}.npy")))
        return rows


def main() -> None:
    """Run all and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--python", required=True, help="interpreter that has slmsuite and odak")
    parser.add_argument("--size", type=int, default=256)
    parser.add_argument("--picture", default="portrait")
    parser.add_argument("--out", type=Path, default=Path("hologram-others"))
    options = parser.parse_args()
    set_threads(1)
    problem = Problem(options.picture, options.size)
    rows = problem.theirs(options.python)
    rows += problem.ours("none", "dissertation") + problem.ours("frequency", "alias-free")
    print(f"| {' | '.join(rows[0])} |\n|{'---|' * len(rows[0])}")
    for row in rows:
        print(f"| {' | '.join(map(str, row.values()))} |")
    with options.out.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
