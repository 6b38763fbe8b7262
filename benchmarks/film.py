"""An animal filmed on the simulated microscope bench: how well films tell what was there, and in how long.

    python benchmarks/film.py [--seeds 0 1] [--bin 1 2] [--frames 200] [--out FOLDER]

``diffuserbench demo film`` for each seed (another animal, other optics, other noise) and binning; the figures
of its ``demo.json``, a line each: share of the clear cells that flash whose dF/F follows the truth, regions
at cells that flash and elsewhere, the blood's speed, seconds of each stage (wall time).
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from datetime import UTC, datetime
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from calibration_routines.demos.film import FilmSettings, run_film


def main() -> None:
    """Film, and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--bin", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--out", type=Path, default=Path("film-benchmark"))
    asked = parser.parse_args()
    when, load = datetime.now(UTC), os.getloadavg()[0]
    print(f"{when:%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}, load {load:.1f}")
    for seed in asked.seeds:
        for binning in asked.bin:
            result = run_film(
                asked.out, settings=FilmSettings(frames=asked.frames, binning=binning, seed=seed)
            )
            model = result.model.split(":")[0]
            print(
                f"seed {seed}, bin {binning}, {model}: {result.judged.figures()} {result.seconds}", flush=True
            )


if __name__ == "__main__":
    main()
