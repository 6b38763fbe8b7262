"""``model="auto"`` against every fixed model, on 111 scenes that it was not tuned on.

    python benchmarks/auto_model.py [--tuning] [--seed-offset N] [--only NAME] [--keep FILE [--finished]]
                                    [--out FOLDER]

Each scene is rendered lenslet by lenslet (``recon.evaluation.scene``) and reconstructed with the convolution,
low-rank and local models, each without and with a background, all depths, all pixels; and once with ``auto``.
Errors are against the truth (PSNR after the best factor; volumes through a blur of one voxel), times are
processor seconds of one thread, those of choosing included. The largest model is the local one with a
background; it and ``auto`` run twice, in turns, and the shorter time of each counts, since whatever else the
machine does can only add to it. With ``--keep`` every finished run is a line of that file, and is not run
again. ``--out`` writes auto-model.csv, auto-model-table.md and auto-model.png.
"""

from __future__ import annotations

import argparse
import csv
import functools
import json
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from auto_scenes import FAMILY_PRIOR, JUDGED, TUNING

import recon
from recon.base.threads import set_threads
from recon.camera import field_registration as remembered
from recon.evaluation.chart_judge import score
from recon.evaluation.scene import SceneSpec, TestScene, make_scene
from recon.reconstruction.choice import Choice

FIXED = tuple(f"{m}{b}" for m in ("convolution", "lowrank", "local") for b in ("", " + background"))
ITERATIONS = 150
WITHIN_DB = 0.5


def solve(scene: TestScene, model: str, background: bool | None) -> dict[str, Any]:
    """Return PSNR, processor seconds and what was chosen."""
    prior = FAMILY_PRIOR[scene.spec.family]
    settings = {"prior": prior, "erasures": scene.erasures, "iterations": ITERATIONS, "judged": False}
    remembered.forget()  # each pays for registering its PSFs
    began = time.process_time()
    if scene.spec.is_picture and not background:
        result = recon.reconstruct(
            scene.measurement, scene.calibration, z_um=float(scene.z_um[0]), model=model, **settings
        )
        found = result.image
    else:
        result = recon.reconstruct(
            scene.measurement, scene.calibration, model=model, estimate_background=background, **settings
        )
        found = result.volume[0] if scene.spec.is_picture else result.volume
    seconds = time.process_time() - began
    return {"dB": score(found, scene.truth).psnr_db, "s": seconds, "choice": in_short(result.choice)}


def in_short(choice: Choice | None) -> str:
    """Say what was chosen."""
    if choice is None:
        return ""
    smooth = " + background" if choice.background else ""
    merged = ", colours merged" if choice.merged else ""
    planes = f"{len(choice.planes)}/{choice.n_planes} planes"
    return f"{choice.model}{smooth}, {planes}, bin {choice.binning}{merged}"


class Kept:
    """Finished runs in a file, one JSON line each; None: nothing is kept."""

    def __init__(self, path: Path | None) -> None:
        self.path = path
        self.runs: dict[tuple[str, str, int], dict[str, Any]] = {}
        if path is not None and path.exists():
            for line in path.read_text().splitlines():
                run = json.loads(line)
                self.runs[run["scene"], run["model"], run["time"]] = run

    def get(self, scene: str, model: str, turn: int, run: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return a run: the kept one, else a new one."""
        known = self.runs.get((scene, model, turn))
        if known is None:
            known = {"scene": scene, "model": model, "time": turn, **run()}
            self.runs[scene, model, turn] = known
            if self.path is not None:
                with self.path.open("a") as file:
                    file.write(json.dumps(known) + "\n")
        return known

    def finished(self, scene: str, spec: SceneSpec) -> bool:
        """Tell whether all runs of a scene are kept."""
        fixed = fixed_models(spec)
        turns = [(label, 0) for label in (*fixed, "auto")] + [("auto", 1), (fixed[-1], 1)]
        return all((scene, *turn) in self.runs for turn in turns)


def fixed_models(spec: SceneSpec) -> tuple[str, ...]:
    """Return the models that a calibration allows, the largest last: of one PSF a depth convolutions."""
    return FIXED if spec.grid > 1 else tuple(m for m in FIXED if m.startswith("convolution"))


def judge(name: str, spec: SceneSpec, kept: Kept) -> dict[str, object]:
    """Run every model on one scene."""
    scene = functools.cache(lambda: make_scene(spec))

    def run(label: str, turn: int) -> dict[str, Any]:
        model, _, background = label.partition(" + ")
        smooth = None if model == "auto" else bool(background)
        return kept.get(name, label, turn, lambda: solve(scene(), model, smooth))

    fixed = {label: run(label, 0) for label in fixed_models(spec)}
    largest = [*fixed][-1]
    auto = run("auto", 0)
    seconds = min(auto["s"], run("auto", 1)["s"])
    fixed[largest] |= {"s": min(fixed[largest]["s"], run(largest, 1)["s"])}
    best = max(fixed, key=lambda k: fixed[k]["dB"])
    row = {
        "scene": name,
        "best": best,
        "best_db": fixed[best]["dB"],
        "best_s": fixed[best]["s"],
        "largest_db": fixed[largest]["dB"],
        "largest_s": fixed[largest]["s"],
        "auto": auto["choice"],
        "auto_db": auto["dB"],
        "auto_s": seconds,
    }
    for label, found in fixed.items():
        row[f"{label} dB"], row[f"{label} s"] = found["dB"], found["s"]
    print(
        f"{name:24} best {row['best']:24} {row['best_db']:6.2f} dB {row['best_s']:6.2f} s | auto "
        f"{row['auto_db']:6.2f} dB {seconds:6.2f} s of {row['largest_s']:6.2f} s | {row['auto']}",
        flush=True,
    )
    return row


def summary(rows: list[dict]) -> str:
    """Say whether the bars are met."""
    near = sum(r["auto_db"] >= r["best_db"] - WITHIN_DB for r in rows)
    measured = [r for r in rows if r["scene"].removeprefix("t-").startswith(("hand", "usaf"))]
    near_measured = sum(r["auto_db"] >= r["best_db"] - WITHIN_DB for r in measured)
    ratio = float(np.median([r["auto_s"] / r["largest_s"] for r in rows]))
    gap = float(np.median([r["auto_db"] - r["best_db"] for r in rows]))
    return (
        f"auto is within {WITHIN_DB} dB of the best fixed model on {near} of {len(rows)} scenes "
        f"({near / len(rows):.0%}; through measured PSFs {near_measured} of {len(measured)}), at a median of "
        f"{ratio:.2f} times the largest model's time; median "
        f"difference {gap:+.2f} dB."
    )


def write(rows: list[dict], folder: Path) -> None:
    """Write table and picture."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "auto-model.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(
            {k: f"{v:.3f}" if isinstance(v, float) else v for k, v in row.items()} for row in rows
        )
    lines = [
        f"{summary(rows)} {datetime.now(UTC):%Y-%m-%d}, {platform.processor() or platform.machine()}, one "
        "thread, processor seconds.",
        "",
        "| scene | best fixed model | dB | s | auto chose | dB | s | largest: dB | s |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        mark = "" if r["auto_db"] >= r["best_db"] - WITHIN_DB else " **missed**"
        lines.append(
            f"| {r['scene']} | {r['best']} | {r['best_db']:.2f} | {r['best_s']:.2f} | {r['auto']} | "
            f"{r['auto_db']:.2f}{mark} | {r['auto_s']:.2f} | {r['largest_db']:.2f} | {r['largest_s']:.2f} |"
        )
    (folder / "auto-model-table.md").write_text("\n".join(lines) + "\n")
    draw(rows, folder / "auto-model.png")


def draw(rows: list[dict], path: Path) -> None:
    """Draw difference and time of every scene, those of a kind in one line."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    kinds = list(dict.fromkeys(kind_of(r["scene"]) for r in rows))
    y = np.array([kinds.index(kind_of(r["scene"])) for r in rows])
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 0.27 * len(kinds) + 1.4), sharey=True)
    gap = np.array([r["auto_db"] - r["best_db"] for r in rows])
    left.axvspan(-WITHIN_DB, 0, color="0.9", label=f"within {WITHIN_DB} dB")
    left.scatter(gap, y, s=24, c=np.where(gap >= -WITHIN_DB, "tab:blue", "tab:red"))
    left.set_yticks(range(len(kinds)), kinds, fontsize=8)
    left.set_ylim(len(kinds) - 0.4, -0.6)
    left.set_xlabel("auto minus best fixed model (dB)")
    left.legend(fontsize=8, loc="upper left")
    ratio = np.array([r["auto_s"] / r["largest_s"] for r in rows])
    right.scatter(ratio, y, s=24, color="tab:green")
    right.set_xlim(0, None)
    right.axvline(0.5, color="k", lw=0.8)
    right.axvline(float(np.median(ratio)), color="k", lw=0.8, ls=":", label=f"median {np.median(ratio):.2f}")
    right.set_xlabel("time of auto over the largest model's")
    right.legend(fontsize=8, loc="upper right")
    for panel in (left, right):
        panel.grid(axis="y", color="0.92")
        panel.set_axisbelow(True)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def kind_of(name: str) -> str:
    """Return a scene's name without its number."""
    return name.rstrip("0123456789 ")


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--tuning", action="store_true", help="the scenes it was tuned on instead")
    parser.add_argument(
        "--seed-offset", type=int, default=0, help="added to every scene's seed: other scenes"
    )
    parser.add_argument("--only", help="scenes whose name holds this")
    parser.add_argument("--keep", type=Path, help="file of finished runs, to go on from")
    parser.add_argument("--finished", action="store_true", help="only scenes of which --keep has all runs")
    parser.add_argument("--out", type=Path, help="folder for table and picture")
    arguments = parser.parse_args()
    set_threads(1)
    make_scene("beads", size=32)  # compile
    scenes = [
        (name, replace(spec, seed=spec.seed + arguments.seed_offset))
        for name, spec in (TUNING if arguments.tuning else JUDGED)
        if (arguments.only or "") in name
    ]
    kept = Kept(arguments.keep)
    if arguments.finished:
        scenes = [s for s in scenes if kept.finished(*s)]
    rows = [judge(name, spec, kept) for name, spec in scenes]
    print(summary(rows))
    if arguments.out is not None:
        write(rows, arguments.out)


if __name__ == "__main__":
    main()
