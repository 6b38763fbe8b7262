"""What the steps that ``--explain`` names do.

    python benchmarks/explain.py [--seeds 1 2] [--sets simulated hand usaf]

Every step up or down is taken (``choose`` overrules the program): the solve's processor time and residual
relative to those with what was chosen, and, where there is a truth, the change of signal over error.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import Calibration, Measurement, Options, Problem, choose, solve
from recon.base.blocks import block_mean
from recon.evaluation.measured_sets import measured_set
from recon.evaluation.scene import make_scene
from recon.reconstruction.choice import Choice
from recon.reconstruction.options import Overrides
from recon.reconstruction.result import Reconstruction

SCENES = (
    ("dense-picture", {"size": 96, "grid": 3}),
    ("text", {"size": 96, "optics": "smooth", "spot_px": 2.5}),
    ("sparse-picture", {"size": 48, "channels": 3, "grid": 3}),
    ("beads", {"size": 40, "depths": 6, "grid": 3, "layers": (0.5, 0.8)}),
    ("dense-volume", {"size": 40, "depths": 5, "grid": 3, "fall_off_deg": 15.0}),
)
Case = tuple[str, Measurement, Calibration, np.ndarray | None, str]


def cases(sets: list[str], seeds: list[int]) -> Iterator[Case]:
    """Yield a name, the photograph, its calibration, the truth where it is known, and the prior."""
    if "simulated" in sets:
        for family, changes in SCENES:
            for seed in seeds:
                scene = make_scene(family, seed=seed, **changes)  # type: ignore[arg-type]
                photograph = Measurement(scene.measurement, scene.noise)
                prior = "l1" if family == "beads" else "tv"
                yield f"{family}, seed {seed}", photograph, scene.calibration, scene.truth, prior
    for name, binning in (("hand", 4), ("usaf", 2)):
        if name in sets:
            psfs, image = (block_mean(a, binning) for a in measured_set(name))
            places = np.full((len(psfs), 3), np.nan)
            places[:, 2] = 1.0 + np.arange(len(psfs)) if len(psfs) > 1 else np.nan
            yield f"{name}, bin {binning}", Measurement(image), Calibration(psfs[:, None], places), None, "tv"


def steps(choice: Choice) -> Iterator[tuple[str, Overrides]]:
    """Yield a step in words, and what overrules the program so; not every step can be asked for."""
    for decision in choice.decisions:
        for way, value in (("up", decision.up), ("down", decision.down)):
            if value is None:
                continue
            name = decision.name
            changes: dict[str, object] = {name: value}
            if name == "binning":
                changes = {name: int(value)}
            elif name == "background":
                changes = {name: value == "estimated"}
            elif name == "between":
                changes = {name: way == "up"}
            elif name == "iterations":
                changes = {"tolerance": float(value.split()[-1])}
            elif (name in ("planes", "field") and way == "up") or (name == "channels" and way == "up"):
                changes = {name: "all"}
            elif name in ("planes", "field"):
                continue
            yield f"{name} {way} to {value}", Overrides(**changes)  # type: ignore[arg-type]


def run(problem: Problem) -> tuple[Reconstruction, float]:
    """Return a chosen problem's result, and its processor seconds."""
    began = time.process_time()
    return solve(problem), time.process_time() - began


def quality(result: Reconstruction, truth: np.ndarray | None) -> float:
    """Return signal over error, decibels; NaN without a truth."""
    if truth is None:
        return float("nan")
    volume = result.volume.reshape(truth.shape)
    return float(20 * np.log10(np.linalg.norm(truth) / np.linalg.norm(volume - truth)))


def rows(case: Case) -> Iterator[str]:
    """Yield a table's row for each step."""
    name, photograph, calibration, truth, prior = case
    problem = Problem.of(photograph, calibration, Options(prior=prior, judged=False))
    chosen = choose(problem)
    assert chosen.choice is not None
    run(chosen)  # compiles what there is to compile
    result, seconds = run(chosen)
    for words, overrides in steps(chosen.choice):
        step = choose(replace(problem, options=replace(problem.options, choose=overrides)))
        run(step)
        other, other_seconds = run(step)
        gain = quality(other, truth) - quality(result, truth)
        residual = max(other.residuals) / max(result.residuals)
        yield f"| {name} | {words} | {other_seconds / seconds:.2g} | {gain:+.1f} | {residual:.2f} |"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--sets", nargs="+", default=["simulated", "hand", "usaf"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[1])
    asked = parser.parse_args()
    print("| photograph | step | time | dB | residual |\n|---|---|---|---|---|")
    for case in cases(asked.sets, asked.seeds):
        for row in rows(case):
            print(row, flush=True)


if __name__ == "__main__":
    main()
