"""SLM tables under flicker: how many are written, by how many series, and how far the worst level is off.

    python benchmarks/slm_tables.py
    python benchmarks/slm_tables.py --draws 200 --flicker 0.02

A bent table of 33 levels by interference of two speckle fields of 24 x 24 pixels, each picture as bright as
the lamp just is; the analysis is the program's (``steady_phases``). Beside it what one series gives at the
limit of 0.004 rad that was kept before.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable

import numpy as np

from calibration_routines.display import slm_phases
from calibration_routines.display.slm_phases import MAX_PHASE_ERROR_RAD, steady_phases
from calibration_routines.purpose import CalibrationError
from recon.arrays import Float32Array, Float64Array
from recon.errors import InputError

BEFORE = np.array([-0.5, 7.5, 15.5, 23.5, 31.5, 32.5])
TRUTH = 7.2 * np.linspace(0, 1, 33) ** 1.4
ONE_SERIES_RAD = 0.004
WANTED_RAD = 0.02


def flickering(flicker: float, seed: int) -> Callable[[], tuple[Float64Array, Float32Array]]:
    """Return what takes one series after the other: pictures of the levels, and of level 0 in between."""
    rng = np.random.default_rng(seed)
    one, other = (rng.normal(size=(24, 24)) + 1j * rng.normal(size=(24, 24)) for _ in range(2))
    pictures = np.abs(one + other * np.exp(1j * TRUTH)[:, None, None]) ** 2

    def take() -> tuple[Float64Array, Float32Array]:
        shown, again = (1 + flicker * rng.standard_normal((n, 1, 1)) for n in (len(TRUTH), len(BEFORE)))
        return shown * pictures, (again * pictures[0]).astype(np.float32)

    return take


def off_rad(flicker: float, seed: int, limit_rad: float, most: int) -> tuple[float | None, int]:
    """Return how far the worst level of a table is off, None of none, and the series that were taken."""
    slm_phases.MAX_PHASE_ERROR_RAD, slm_phases.MOST_SERIES = limit_rad, most
    try:
        phases, error, scatter = steady_phases(flickering(flicker, seed), BEFORE)
    except (InputError, CalibrationError):
        return None, 1
    return (float(np.abs(phases - TRUTH).max()) if error <= limit_rad else None), scatter.frames


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--draws", type=int, default=40)
    parser.add_argument("--flicker", nargs="+", type=float, default=[0.005, 0.01, 0.015, 0.02, 0.03, 0.2])
    asked = parser.parse_args()
    ways = {"one series, 0.004 rad": (ONE_SERIES_RAD, 1)}
    ways["the program"] = (MAX_PHASE_ERROR_RAD, slm_phases.MOST_SERIES)
    print(
        "| flicker | by | written | worst level off, rad | beyond 0.02 | series: tables |\n"
        + "|---" * 6
        + "|"
    )
    for flicker in asked.flicker:
        for name, (limit_rad, most) in ways.items():
            tried = [off_rad(flicker, seed, limit_rad, most) for seed in range(asked.draws)]
            written = [off for off, _ in tried if off is not None]
            worst = f"{max(written):.4f}" if written else "-"
            series = Counter(many for off, many in tried if off is not None)
            print(
                f"| {flicker:.1%} | {name} | {len(written)} of {len(tried)} | {worst} | "
                f"{sum(off > WANTED_RAD for off in written)} | "
                f"{', '.join(f'{many}: {tables}' for many, tables in sorted(series.items()))} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
