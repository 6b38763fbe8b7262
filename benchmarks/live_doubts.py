"""What live pictures say of themselves: noise called noise, light called light, wrong calibrations named.

    python benchmarks/live_doubts.py [--bin 8] [--draws 5]

A frame of the measured hand (``DIFFUSERBENCH_DATA``, else ``../shared/data``) is dimmed to few electrons and
given photon noise and 2 electrons of read noise, again and again; each stream is fed eight frames. Of dark
frames and dim scenes: how many pictures are called noise, and how alike the settled picture is to that of
full light. Of the right calibration and wrong ones: what is said after the first check.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import NoiseModel
from recon.base.blocks import block_mean
from recon.base.threads import set_threads
from recon.camera.transformed import Transformation, transformed
from recon.evaluation.measured_sets import measured_set
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import NOISE_ONLY, LivePicture

READ_NOISE = 2.0
FRAMES = 8
ELECTRONS = (0.0, 0.03, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0)
"""In the mean pixel."""
WRONG = {
    "right": Transformation(),
    "turned by 1 degree": Transformation(rotation_deg=1.0),
    "turned by 4 degrees": Transformation(rotation_deg=4.0),
    "1 % larger": Transformation(scale=1.01),
    "2 % smaller": Transformation(scale=0.98),
    "mirrored": Transformation(mirrored=True),
    "upside down": Transformation(rotation_deg=180.0),
    "moved by 5 pixels": Transformation(rows=5.0),
}


def watched(psf: np.ndarray, clean: np.ndarray, electrons: float, seed: int) -> tuple[LivePicture, int]:
    """Feed a stream of frames; return the settled picture, and how many were called noise."""
    rng = np.random.default_rng(seed)
    live = LiveReconstructor(psf, budget_ms=1000.0, coarsest=1, noise=NoiseModel(READ_NOISE, 1.0))
    live._fit._not_before = 0.0
    dark = 0
    for _ in range(FRAMES):
        frame = rng.poisson(clean * electrons) + rng.normal(0, READ_NOISE, clean.shape)
        picture = live.feed(frame.astype(np.float32))
        dark += picture.doubt == NOISE_ONLY
    live._fit.wait()
    while (better := live.refine()) is not None:
        picture = better
    return picture, dark


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--bin", type=int, default=8)
    parser.add_argument("--draws", type=int, default=5)
    options = parser.parse_args()
    set_threads(1)
    print(f"{datetime.now(UTC):%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}")
    psfs, photograph = measured_set("hand")
    psf = block_mean(psfs[0][None] if psfs[0].ndim == 2 else psfs[0], options.bin)
    clean = np.maximum(block_mean(photograph[None] if photograph.ndim == 2 else photograph, options.bin), 0)[
        0
    ]
    clean /= clean.mean()
    best = watched(psf[0], clean, 1e5, 0)[0].image
    print(f"{clean.shape} pixels, {options.draws} draws of {FRAMES} frames\n")
    print(
        "| electrons | pictures called noise | likeness to the picture in full light | settled picture says |"
    )
    print("| --- | --- | --- | --- |")
    for electrons in ELECTRONS:
        seen = [watched(psf[0], clean, electrons, seed) for seed in range(options.draws)]
        alike = np.mean([_alike(picture.image, best) for picture, _ in seen])
        noise = sum(dark for _, dark in seen)
        said = sorted({picture.doubt or "nothing" for picture, _ in seen})
        print(
            f"| {electrons:g} | {noise} of {FRAMES * len(seen)} | {alike:.2f} | {'; '.join(said)} |",
            flush=True,
        )
    print("\n| calibration | electrons | said |\n| --- | --- | --- |")
    for name, how in WRONG.items():
        for electrons in (10.0, 1000.0):
            began = time.process_time()
            changed = transformed(psf, how)[0]
            doubts = [watched(changed, clean, electrons, seed)[0].doubt for seed in range(options.draws)]
            said = {doubt or "nothing": doubts.count(doubt) for doubt in doubts}
            spent = (time.process_time() - began) / options.draws
            words = "; ".join(f"{count} x {what}" for what, count in said.items())
            print(f"| {name} | {electrons:g} | {words} ({spent:.1f} CPU s a stream) |", flush=True)


def _alike(image: np.ndarray, other: np.ndarray) -> float:
    """Return the correlation of two pictures; 0 where one is empty."""
    return float(np.corrcoef(image.ravel(), other.ravel())[0, 1]) if image.std() > 0 else 0.0


if __name__ == "__main__":
    main()
