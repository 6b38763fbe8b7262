"""What a mask that was designed for pictures lifts at 16x, over a random one: simulated.

    python benchmarks/mask_design.py --slm 28x40 --steps 150 --leaves 12 --out mask-design.csv

The phases of all mask pixels are free (up to a wavelength of height, as Kuo 2020, Sec. 7.3 asks of a thin
mask) and are found together with the SLM patterns of pictures of dead leaves, by Adam, so that what an eye
resolves of these is best. Then the mask is kept, in 256 heights, and judged beside random ones, of two
heights and of as many, by pictures that it never saw: one frame, and what no number of frames exceeds.
"""

from __future__ import annotations

import argparse
import csv
import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft

from instrument.files.sample_images import SAMPLES, dead_leaves, load_sample
from recon.base.threads import set_threads
from recon.holography import (
    Display,
    HologramModel,
    HologramOptions,
    Target,
    compute_hologram,
    hologram_limit,
    random_mask,
)
from recon.holography.display import ScatteringMask
from recon.holography.target import ORDER, cutoff_radius

Array = npt.NDArray[np.generic]
HEIGHTS = 256
SIDE = 4
"""Mask pixels in an SLM pixel, along each axis: 16x."""


class Adam:
    """Kingma and Ba 2015, with their constants."""

    def __init__(self, rate: float) -> None:
        self.rate, self.count = rate, 0
        self.mean: Array | float = 0.0
        self.square: Array | float = 0.0

    def step(self, gradient: Array) -> Array:
        """Return what is to be taken off."""
        self.count += 1
        self.mean = 0.9 * self.mean + 0.1 * gradient
        self.square = 0.999 * self.square + 0.001 * gradient**2
        mean, square = self.mean / (1 - 0.9**self.count), self.square / (1 - 0.999**self.count)
        return self.rate * mean / (np.sqrt(square) + 1e-12)


def designed(shape: tuple[int, int], steps: int, pictures: int, seed: int) -> Array:
    """Return the phases of a mask's pixels that show ``pictures`` pictures of leaves best."""
    rng = np.random.default_rng(seed)
    high, wide = shape[0] * SIDE, shape[1] * SIDE
    grid = (2 * high, 2 * wide)  # without aliasing
    y, x = (np.fft.fftfreq(n) * n for n in grid)
    passes = 1 / (1 + ((y[:, None] ** 2 + x**2) / cutoff_radius(shape) ** 2) ** ORDER)
    passes[0, 0] = 0  # brightness
    targets = []
    for number in range(pictures):
        drawn = dead_leaves(1000 + number, 1.0) ** (1, 3, 6)[number % 3]  # the darker, the harder
        image = np.fft.ifftshift(cv2.resize(drawn, grid[::-1], interpolation=cv2.INTER_AREA))
        targets.append((image / image.mean(), (image.max() / image.mean()) ** 2))
    mask = rng.uniform(0, 2 * np.pi, (high, wide))
    slms = rng.uniform(0, 2 * np.pi, (pictures, *shape))
    of_mask, of_slms = Adam(0.03), Adam(0.1)
    for step in range(steps):
        by_mask, by_slms, losses = np.zeros_like(mask), np.zeros_like(slms), []
        for (target, peak), slm, by_slm in zip(targets, slms, by_slms, strict=True):
            light = np.exp(1j * (mask + np.kron(slm, np.ones((SIDE, SIDE))))).astype(np.complex64)
            field = fft.fft2(light, grid, norm="ortho") * np.float32(np.sqrt(4))
            wrong = fft.ifft2(fft.fft2(np.abs(field) ** 2 - target) * passes).real
            losses.append(np.mean(wrong**2) / peak)
            slope = fft.ifft2(fft.fft2(wrong) * passes).real / peak
            back = fft.ifft2(slope * field, norm="ortho")[:high, :wide]
            turned = (back * np.conj(light)).imag
            by_mask += turned
            by_slm += turned.reshape(shape[0], SIDE, shape[1], SIDE).sum((1, 3))
        mask -= of_mask.step(by_mask)
        slms -= of_slms.step(by_slms)
        if step % 50 == 0 or step == steps - 1:
            print(f"step {step}: {-10 * np.log10(np.mean(losses)):.2f} dB of its own pictures", flush=True)
    return mask


def many_heights(phases: Array) -> ScatteringMask:
    """Return a mask of :data:`HEIGHTS` heights."""
    levels = np.rint(np.mod(phases, 2 * np.pi) / (2 * np.pi) * HEIGHTS).astype(int) % HEIGHTS
    return ScatteringMask(levels.astype(np.uint8), np.arange(HEIGHTS) * 2 * np.pi / HEIGHTS)


def main() -> None:
    """Design a mask, judge it and write the results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--slm", default="24x32")
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--leaves", type=int, default=16, help="pictures that it is designed for")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("mask-design.csv"))
    options = parser.parse_args()
    set_threads(1)
    rows, columns = (int(n) for n in options.slm.split("x"))
    whole = (rows * SIDE, columns * SIDE)
    rng = np.random.default_rng(options.seed + 1)
    masks = {
        "random, two heights": random_mask(whole, seed=options.seed),
        "random, 256 heights": many_heights(rng.uniform(0, 2 * np.pi, whole)),
        "designed": many_heights(designed((rows, columns), options.steps, options.leaves, options.seed)),
    }
    with options.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["picture", "mask", "one_frame_db", "relaxation_db", "bound_db"])
        for name in SAMPLES:
            for words, mask in masks.items():
                display = Display((rows, columns), mask)
                target = Target(load_sample(name, whole), white=1.0)
                found = compute_hologram(HologramModel(display, [target]), iterations=100, tolerance=0)
                limit = hologram_limit(display, target, HologramOptions(iterations=100))
                line = (found.history[-1].psnr_db, limit.reached_db, limit.bound_db)
                said = f"one frame {line[0]:.2f}, relaxation {line[1]:.2f}, bound {line[2]:.2f} dB"
                print(f"{name}, {words}: {said}", flush=True)
                writer.writerow([name, words, *(f"{db:.2f}" for db in line)])


if __name__ == "__main__":
    main()
