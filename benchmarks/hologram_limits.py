"""What any number of frames could reach, beside six frames, and what lifting the picture's black is worth.

Run it as::

    python benchmarks/hologram_limits.py --slm 68x120 --iterations 100 --out hologram-limits.csv
    python benchmarks/hologram_limits.py --only lifts --pictures portrait relief

What an eye sees is also told by NVIDIA's FLIP where its library is installed (``pip install
flip-evaluator``), at 30 pixels a degree: 0 is the picture itself, 1 black for white.
"""

from __future__ import annotations

import argparse
import csv
import os
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from instrument.files.sample_images import load_sample
from recon.arrays import Array
from recon.base.metrics import ssim
from recon.base.threads import set_threads
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    HologramOptions,
    Target,
    compute_hologram,
    hologram_limit,
    random_mask,
)
from recon.holography.scores import low_pass, seen_image

PICTURES = ("portrait", "relief", "leaves", "head")
LIFTS = (0.0, 0.1, 0.2, 0.3, 0.5)
PIXELS_PER_DEGREE = 30.0


def limits(display: Display, name: str, iterations: int) -> list[tuple[str, float]]:
    """Bound, what the relaxation reaches, and six frames, in dB."""
    target = Target(load_sample(name, display.mask.shape), white=1.0)
    limit = hologram_limit(display, target, HologramOptions(iterations=iterations, tolerance=0))
    frames = compute_hologram(HologramModel(display, [target], frames=6), iterations=iterations, tolerance=0)
    return [
        ("bound", limit.bound_db),
        ("relaxation", limit.reached_db),
        ("six frames", frames.history[-1].psnr_db),
    ]


def flip(shown: Array, wanted: Array) -> float:
    """Mean FLIP error (Andersson et al. 2020) of intensities on an sRGB screen; nan without its library."""
    try:
        from flip_evaluator import evaluate
    except ImportError:
        return float("nan")

    def coded(image: Array) -> Array:
        image = image.clip(0, 1)
        grey = np.where(image <= 0.0031308, 12.92 * image, 1.055 * image ** (1 / 2.4) - 0.055)
        return np.repeat(grey.astype(np.float32)[..., None], 3, axis=2)

    return float(
        evaluate(coded(wanted), coded(shown), "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})[
            1
        ]
    )


def lifted(display: Display, name: str, iterations: int) -> list[tuple[str, float]]:
    """SSIM and FLIP to the original picture, of equal mean and fitted by gain and offset."""
    image = load_sample(name, display.mask.shape)
    wanted = np.fft.fftshift(low_pass(np.fft.ifftshift(image), display.slm_shape))
    lines = []
    for lift in LIFTS:
        model = HologramModel(display, [Target(lift + (1 - lift) * image, white=1.0)])
        seen = seen_image(compute_hologram(model, iterations=iterations, tolerance=0).slm, display)
        gain, offset = np.polyfit(seen.ravel(), wanted.ravel(), 1)
        for words, shown in (
            ("equal mean", seen * wanted.mean() / seen.mean()),
            ("fitted", gain * seen + offset),
        ):
            lines.append((f"black at {lift}, SSIM, {words}", ssim(shown, wanted, data_range=1.0)))
            lines.append((f"black at {lift}, FLIP, {words}", flip(shown, wanted)))
    return lines


def main() -> None:
    """Run all and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slm", default="68x120")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--only", choices=("limits", "lifts"))
    parser.add_argument("--pictures", nargs="+", choices=PICTURES, default=PICTURES)
    parser.add_argument("--out", type=Path, default=Path("hologram-limits.csv"))
    options = parser.parse_args()
    rows, columns = (int(n) for n in options.slm.split("x"))
    set_threads(1)
    with options.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["expansion", "picture", "case", "value"])
        for q in (4, 16):
            k = round(q**0.5)
            mask = random_mask((rows * k, columns * k))
            dirty = Display((rows, columns), mask, dc=DcTerm(0.1, 0.6))
            for name in options.pictures:
                found = []
                if options.only != "lifts":
                    found += limits(Display((rows, columns), mask), name, options.iterations)
                if options.only != "limits" and q == 16:
                    found += lifted(dirty, name, options.iterations)
                for case, value in found:
                    print(f"{q}x {name}: {case}: {value:.3f}", flush=True)
                    writer.writerow([q, name, case, f"{value:.3f}"])


if __name__ == "__main__":
    main()
