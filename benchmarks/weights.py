"""Default weights of total variation and l1 against a search, and the two ADMMs, on unseen scenes.

    python benchmarks/weights.py [--tuning] [--first SEED] [--turns 1] [--pairs BINNING] [--out FILE]

Text, filaments, slopes, textures, small beads, leaves and strokes, through random lenslets, a smooth diffuser
and the measured PSFs of the hand and of the USAF set, with photons, noise of the PSF, drift and PSFs that
change over the field drawn by the seed. The search takes the default weight times powers of two from 1/16 to
16. What `recon/reconstruction/first_look.py` was fitted on are seeds from 201000 on (``--tuning --turns 3``);
those that judge begin at 600000. ``--pairs``: the measured pairs, each with the PSF from the other six.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from recon import Reconstruction, reconstruct
from recon.base.blocks import block_mean
from recon.base.threads import set_threads
from recon.blind.known_pictures import psf_from_pictures
from recon.blind.left_out import fare
from recon.evaluation.chart_judge import score
from recon.evaluation.measured_sets import MEASURED, measured_pairs
from recon.evaluation.scene import Family, SceneSpec, make_scene, spec_of

FAMILIES: tuple[Family, ...] = (
    "text",
    "filaments",
    "gradient",
    "texture",
    "lights",
    "dense-picture",
    "sparse-picture",
)
SIZES = {"random": 56, "smooth": 56, "hand": (60, 80), "usaf": (54, 64)}
TUNING, JUDGING = 201_000, 600_000
TIMES = 2.0 ** np.arange(-4, 5)
WITHIN_DB = 0.5


def specs(first: int, turns: int) -> Iterator[SceneSpec]:
    """Yield scenes: every family through every camera, as often as asked for."""
    for turn in range(turns):
        for i, family in enumerate(FAMILIES):
            for j, (optics, size) in enumerate(SIZES.items()):
                seed = first + 1000 * turn + 10 * i + j
                rng = np.random.default_rng(seed)
                numbers: dict[str, Any] = {
                    "photons": float(10 ** rng.uniform(2.3, 4.5)),
                    "calibration_photons": float(10 ** rng.uniform(3.3, 5.3)),
                    "density": float(10 ** rng.uniform(-0.3, 0.3)),
                }
                if rng.random() < 0.35:
                    numbers["drift_scale"] = float(10 ** rng.uniform(-3, -2))
                if optics in MEASURED and rng.random() < 0.35:
                    numbers["aberration"] = float(rng.uniform(0.02, 0.15))
                if optics == "random" and rng.random() < 0.3:
                    numbers["aberration"] = float(rng.uniform(0.1, 1))
                yield spec_of(family, size=size, optics=optics, seed=seed, field=0.65, **numbers)


Solve = Callable[..., Reconstruction]
Judge = Callable[[Reconstruction], float]


def judge(name: str, optics: str, prior: str, solve: Solve, psnr: Judge) -> dict[str, Any]:
    """Search the weight of one prior on one photograph; print and return what the default misses."""
    default = solve(prior=prior)
    assert default.tau is not None
    by = [psnr(default if t == 1 else solve(prior=prior, tau=default.tau * t)) for t in TIMES]
    best = int(np.argmax(by))
    own = by[list(TIMES).index(1.0)]
    row = {"optics": optics, "prior": prior, "missing": by[best] - own}
    weight = str(default.provenance.get("weight", "")).partition(" times")[0]
    print(
        f"| {name} | {optics} | {prior} | {weight} | {own:.2f} | "
        f"{by[best]:.2f} at {TIMES[best]:g} | {own - by[best]:+.2f} |",
        flush=True,
    )
    return row


def compare(solve: Solve, psnr: Judge) -> tuple[float, float]:
    """Solve by both ADMMs by default; return how much longer admm took, and what admm-sensor gains, dB."""
    seconds, quality = [], []
    for solver in ("admm", "admm-sensor"):
        began = time.process_time()
        quality.append(psnr(solve(prior="tv", solver=solver)))
        seconds.append(time.process_time() - began)
    return seconds[0] / seconds[1], quality[1] - quality[0]


def said(rows: list[dict[str, Any]]) -> list[str]:
    """Return a table of how often the default is within the bar."""
    lines = [
        "| prior | PSFs | photographs | within 0.5 dB | mean loss | worst |",
        "|---|---|---|---|---|---|",
    ]
    for prior in ("tv", "l1"):
        for kind in ("simulated", "measured", "pairs", "all"):
            missing = [
                r["missing"]
                for r in rows
                if r["prior"] == prior and kind in ("all", kind_of(str(r["optics"])))
            ]
            if missing:
                near = sum(m <= WITHIN_DB for m in missing)
                lines.append(
                    f"| {prior} | {kind} | {len(missing)} | {near} ({near / len(missing):.0%}) | "
                    f"{np.mean(missing):.2f} dB | {max(missing):.2f} dB |"
                )
    return lines


def kind_of(optics: str) -> str:
    """Return where PSFs come from."""
    return "measured" if optics in MEASURED else "pairs" if optics == "pairs" else "simulated"


def pairs(binning: int) -> Iterator[tuple[str, Solve, Judge]]:
    """Yield the measured pairs: how to solve each with the PSF from the other six, and how to judge it."""
    names, photographs, pictures = measured_pairs()
    data, known = (block_mean(images, binning, about_axis=True) for images in (photographs, pictures))
    for k, name in enumerate(names):
        others = np.arange(len(names)) != k
        psf = np.moveaxis(psf_from_pictures(data[others], known[others]).psf, 0, -1)
        photograph, picture = (
            np.ascontiguousarray(np.moveaxis(images[k], 0, -1)) for images in (data, known)
        )

        def solve(photograph: Any = photograph, psf: Any = psf, **options: Any) -> Reconstruction:
            return reconstruct(photograph, psf, judged=False, **options)

        yield name, solve, lambda result, picture=picture: fare(result.image, picture)[0]


def main() -> None:
    """Run it."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tuning", action="store_true", help="the scenes that the weights were fitted on")
    parser.add_argument("--first", type=int, help="seed of the first scene instead")
    parser.add_argument("--turns", type=int, default=1, help="28 scenes each; 0: none")
    parser.add_argument("--pairs", type=int, metavar="BINNING", help="the measured pairs as well")
    parser.add_argument("--out", type=Path, help="write the summary")
    a = parser.parse_args()
    set_threads(1)
    tiny = make_scene("text", size=32)
    for solver in ("admm", "admm-sensor"):  # compiles
        reconstruct(tiny.measurement, tiny.calibration, model="convolution", solver=solver, iterations=2)
    print("| scene | PSFs | prior | weight, noise | default, dB | best, dB | missing |")
    print("|---|---|---|---|---|---|---|")
    rows, solvers = [], []
    for spec in specs(a.first or (TUNING if a.tuning else JUDGING), a.turns):
        scene = make_scene(spec)

        def solve(scene: Any = scene, **options: Any) -> Reconstruction:
            return reconstruct(
                scene.measurement, scene.calibration, model="convolution", judged=False,
                **{"solver": "admm-sensor", **options},
            )  # fmt: skip

        def psnr(result: Reconstruction, scene: Any = scene) -> float:
            return score(result.image, scene.truth, volume=False).psnr_db

        name = f"{spec.family}, {spec.photons:.0f} e-"
        rows += [judge(name, spec.optics, prior, solve, psnr) for prior in ("tv", "l1")]
        solvers.append(compare(solve, psnr))
    for name, solve_pair, psnr_pair in pairs(a.pairs) if a.pairs else ():
        rows.append(judge(f"pair {name}", "pairs", "tv", solve_pair, psnr_pair))
        solvers.append(compare(solve_pair, psnr_pair))
    times, gains = np.array(solvers).T
    report = [
        *said(rows),
        "",
        "admm-sensor against admm, total variation, default weights: "
        f"{np.median(times):.2f} times as fast in the median ({times.min():.2f} to {times.max():.2f}), "
        f"{np.mean(gains):+.2f} dB in the mean ({gains.min():+.2f} to {gains.max():+.2f}).",
    ]
    print("\n".join(report))
    if a.out is not None:
        a.out.write_text("\n".join(report) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
