"""Time against accuracy of the defaults on every measured set, beside other ways: for ``measured.py``."""

from __future__ import annotations

import cProfile
import pstats
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.measured_blind import WEIGHTS
from benchmarks.measured_scenes import Scene, hand, pairs, usaf
from recon import Calibration, reconstruct
from recon.errors import InputError

OURS: Mapping[str, Mapping[str, Any]] = {
    "defaults": {},
    "`judged=False`": {"judged": False},
    "`--model convolution`": {"model": "convolution"},
    "`--model convolution --no-background -n 20`, unjudged": {
        "model": "convolution",
        "estimate_background": False,
        "judged": False,
        "iterations": 20,
    },
    "`--prior l1`": {"prior": "l1"},
    "`--solver admm -n 20`, unjudged": {"solver": "admm", "iterations": 20, "judged": False},
    "`--solver fista`, unjudged": {"solver": "fista", "judged": False},
    "`--solver wiener`, unjudged": {"solver": "wiener", "judged": False},
}
"""By what is asked for. ``--model`` is not asked of several depths: it is what is chosen there."""
PAIRS = ("394", "643")
"""Of seven, each of which takes the calibration by the other six."""
PLAIN = (20, 100)
"""Iterations of the plain ADMM."""
STEPS: Mapping[str, tuple[str, ...]] = {
    "choosing": ("selection.py", "choose"),
    "solving": ("solve.py", "solve"),
    "calibration's decoys": ("decoys.py", "check_calibration"),
    "pixels held out": ("reconstruct.py", "held_out_error"),
    "evidence": ("reconstruct.py", "_verdict"),
}
"""By what is done: the file and the function that it takes the time of."""
AGAIN_BELOW_S = 3.0
"""What takes less is run twice, and the quicker counts: the first run compiles and fills caches."""


class Found(NamedTuple):
    """What a way came to on a scene."""

    way: str
    cpu_s: float
    quality: float


def own_ways(scene: Scene) -> list[Found]:
    """Return what the program's own ways come to."""
    several = isinstance(scene.calibration, Calibration) and len(scene.calibration.psfs) > 1
    rows = []
    reconstruct(scene.photograph, scene.calibration)  # compiles what this kind of set needs
    for way, asked in OURS.items():
        if several and "model" in asked:
            continue
        try:
            seconds, result = _timed(scene, asked)
            if seconds < AGAIN_BELOW_S:
                seconds = min(seconds, _timed(scene, asked)[0])
        except InputError as error:
            print(scene.name, way, error, flush=True)
            continue
        picture = result.volume if several else result.image
        rows.append(Found(way, seconds, scene.quality(picture)))
        print(scene.name, rows[-1], flush=True)
    return rows


def _timed(scene: Scene, asked: Mapping[str, Any]) -> tuple[float, Any]:
    began = time.process_time()
    result = reconstruct(scene.photograph, scene.calibration, **asked)
    return time.process_time() - began, result


def plain_ways(scene: Scene) -> list[Found]:
    """Return what a plain ADMM comes to, with the weight that serves best."""
    rows: list[Found] = []
    if scene.plain is None:
        return rows
    for iterations in PLAIN:
        tried = []
        for weight in WEIGHTS:
            began = time.process_time()
            picture = scene.plain(iterations, weight)
            tried.append((scene.quality(picture), time.process_time() - began))
        rows.append(Found(f"plain ADMM, {iterations}", min(t[1] for t in tried), max(t[0] for t in tried)))
        print(scene.name, rows[-1], flush=True)
    return rows


def where_time_goes(scene: Scene) -> dict[str, float]:
    """Return the processor seconds of the defaults, all and by steps."""
    profile = cProfile.Profile(time.process_time)
    began = time.process_time()
    profile.runcall(reconstruct, scene.photograph, scene.calibration)
    spent = {"all": time.process_time() - began, **dict.fromkeys(STEPS, 0.0)}
    for (file, _, function), (_, _, _, cumulative, _) in pstats.Stats(profile).stats.items():  # type: ignore[attr-defined]
        for step, (of, name) in STEPS.items():
            if function == name and Path(file).name == of:
                spent[step] += cumulative
    return spent


def mean_of(found: Sequence[Sequence[Found]]) -> list[Found]:
    """Return means over scenes that were all asked the same."""
    return [
        Found(rows[0].way, float(np.mean([r.cpu_s for r in rows])), float(np.mean([r.quality for r in rows])))
        for rows in zip(*found, strict=True)
    ]


def speed(folder: Path) -> list[str]:
    """Show time against accuracy on every measured set, and what the defaults spend it on."""
    found: dict[str, list[Found]] = {}
    spent: dict[str, dict[str, float]] = {}
    groups: Mapping[str, Callable[[], Sequence[Scene]]] = {
        "hand, bin 16": lambda: [hand(16)],
        "hand, bin 8": lambda: [hand(8)],
        "hand, bin 4": lambda: [hand(4)],
        f"pairs {', '.join(PAIRS)}, bin 4": lambda: pairs(4, PAIRS),
        "USAF, bin 4": lambda: [usaf(4)],
    }
    for name, load_scenes in groups.items():
        scenes = load_scenes()
        found[name] = mean_of([[*own_ways(scene), *plain_ways(scene)] for scene in scenes])
        parts = [where_time_goes(scene) for scene in scenes]
        spent[name] = {step: float(np.mean([part[step] for part in parts])) for step in parts[0]}
        print(name, spent[name], flush=True)
    draw(found, folder / "measured_speed.png")
    ways = list(dict.fromkeys(row.way for rows in found.values() for row in rows))
    lines = [
        "CPU s and, of the hand, dB to its converged picture (400 iterations of the default problem, which "
        "favours its weight) after the best shift and gain; of pairs mean dB to what was shown; of the USAF "
        "target how linearly depth goes with x. The plain ADMM of `measured_blind.py` knows the best "
        f"of {len(WEIGHTS)} weights and judges nothing.",
        "",
        f"| way | {' | '.join(found)} |",
        "|---" * (1 + len(found)) + "|",
    ]
    for way in ways:
        cells = []
        for rows in found.values():
            row = next((r for r in rows if r.way == way), None)
            cells.append("" if row is None else f"{row.cpu_s:.2f} s, {row.quality:.3g}")
        lines.append(f"| {way} | {' | '.join(cells)} |")
    steps = list(next(iter(spent.values())))
    lines += ["", "What the defaults spend, CPU s under a profiler:", ""]
    lines += [f"| set | {' | '.join(steps)} |", "|---" * (1 + len(steps)) + "|"]
    lines += [f"| {name} | {' | '.join(f'{s:.2f}' for s in row.values())} |" for name, row in spent.items()]
    return [*lines, "", "![Time against accuracy, a panel a set](measured_speed.png)"]


def draw(found: Mapping[str, Sequence[Found]], path: Path) -> None:
    """Draw accuracy over time, a panel a set, a colour a way."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

    ways = list(dict.fromkeys(row.way for rows in found.values() for row in rows))
    figure, axes = plt.subplots(2, -(-len(found) // 2), figsize=(15, 8), squeeze=False)
    for axis, (name, rows) in zip(axes.flat, found.items(), strict=False):
        for row in rows:
            index = ways.index(row.way)
            label = row.way.replace("`", "")
            marker = "*" if not index else "s" if row.way.startswith("plain") else "o"
            size = 220 if not index else 60
            axis.scatter(row.cpu_s, row.quality, s=size, marker=marker, color=f"C{index}", label=label)
        quality = "depth over x" if name.startswith("USAF") else "dB"
        axis.set(title=name, xlabel="CPU s", ylabel=quality, xscale="log")
        axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(NullFormatter())
        axis.grid(alpha=0.3)
    for axis in axes.flat[len(found) :]:
        axis.axis("off")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncol=4)
    figure.tight_layout(rect=(0, 0.09, 1, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=60)
