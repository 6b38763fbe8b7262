"""CPU time of hologram optimisation against the dissertation's algorithm written down literally.

The reference is Kuo 2020, A.4 in float64 with ``numpy.fft``: projected gradient with Nesterov's momentum, the
largest of a few fixed steps that works. Both run on the dissertation's own grid, from the same random phases,
and are judged on it. Writes a CSV and a chart::

    python benchmarks/hologram_speed.py --slm 540x960 --iterations 60 --out hologram-speed
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import time
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np

from instrument.files.sample_images import load_sample
from recon.base.threads import set_threads
from recon.holography import Display, HologramModel, Target, compute_hologram, random_mask

Curve = list[tuple[int, float, float]]


def literal(display: Display, image: np.ndarray, iterations: int, step: float, seed: int) -> Curve:
    """Run the dissertation's algorithm; returns (iteration, CPU seconds, PSNR) of every iterate."""
    k = display.factor
    (height, width), mask = display.slm_shape, display.mask.field().real
    wanted = np.fft.ifftshift(image / image.mean())
    peak = 1.0 / image.mean()
    y, x = (np.fft.fftfreq(n) * n for n in mask.shape)
    cutoff = np.sqrt(height * width / np.pi)
    lowpass = 1 / (1 + ((y[:, None] ** 2 + x**2) / cutoff**2) ** 5)
    rng = np.random.default_rng(seed)
    s = np.exp(1j * rng.uniform(0, 2 * np.pi, (1, height, width)).astype(np.float32))[0].astype(complex)
    previous, ahead, t = s, s, 1.0
    curve, began = [], time.process_time()
    for iteration in range(iterations + 1):
        field = mask * np.repeat(np.repeat(ahead, k, axis=0), k, axis=1)
        far = np.fft.fft2(field) / np.sqrt(field.size)
        g = np.fft.ifft2(lowpass * np.fft.fft2(np.abs(far) ** 2 - wanted)).real
        curve.append((iteration, time.process_time() - began, 10 * np.log10(peak**2 / np.mean(g**2))))
        slope = np.fft.ifft2(lowpass * np.fft.fft2(g)).real
        back = mask * np.fft.ifft2(far * slope) * np.sqrt(field.size)
        gradient = back.reshape(height, k, width, k).sum(axis=(1, 3))
        s = ahead - step * gradient
        s /= np.abs(s)
        t, last = 0.5 * (1 + np.sqrt(1 + 4 * t * t)), t
        ahead = s + (last - 1) / t * (s - previous)
        previous = s
    return curve


def ours(display: Display, image: np.ndarray, iterations: int, seed: int) -> Curve:
    """Run L-BFGS on the same grid from the same start."""
    model = HologramModel(display, [Target(image, white=1.0)], grid="dissertation")
    compute_hologram(model, iterations=1)  # compiles
    curve: Curve = []
    began = time.process_time()
    found = compute_hologram(
        model,
        iterations=iterations,
        tolerance=0,
        seed=seed,
        callback=lambda r, _: curve.append((r.iteration, time.process_time() - began, r.psnr_db)),
    )
    return [(0, 0.0, found.history[0].psnr_db), *curve]


def seconds_to(curve: Curve, psnr_db: float) -> float:
    """CPU seconds until a PSNR is reached; infinite when it is not."""
    return next((seconds for _, seconds, psnr in curve if psnr >= psnr_db), float("inf"))


def main() -> None:
    """Run both and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slm", default="540x960")
    parser.add_argument("--iterations", type=int, default=60)
    parser.add_argument("--picture", default="leaves")
    parser.add_argument("--out", type=Path, default=Path("hologram-speed"))
    options = parser.parse_args()
    shape = tuple(int(n) for n in options.slm.split("x"))
    set_threads(1)
    curves: dict[tuple[int, str], Curve] = {}
    for q in (4, 16):
        k = round(q**0.5)
        display = Display((shape[0], shape[1]), random_mask((shape[0] * k, shape[1] * k), seed=q))
        image = load_sample(options.picture, display.mask.shape)
        small = Display((68, 120), random_mask((68 * k, 120 * k), seed=q))
        trial = load_sample(options.picture, small.mask.shape)
        steps = [c / k**2 for c in (0.4, 0.7, 1.0, 1.4, 2.0, 2.4, 3.2, 4.0)]
        with np.errstate(all="ignore"):
            reached = [np.nan_to_num(literal(small, trial, 40, step, 1)[-1][2], nan=-1) for step in steps]
        step = steps[int(np.argmax(reached))]
        curves[q, "literal"] = literal(display, image, options.iterations, step, 1)
        curves[q, "ours"] = ours(display, image, 2 * options.iterations, 1)
        goal = curves[q, "literal"][-1][2]
        slow, fast = seconds_to(curves[q, "literal"], goal), seconds_to(curves[q, "ours"], goal)
        print(
            f"q = {q}: literal (step {step * k**2:.1f}/k^2) reaches {goal:.2f} dB after {slow:.1f} s CPU "
            f"({slow / options.iterations:.2f} s an iteration), L-BFGS after {fast:.1f} s: "
            f"{slow / fast:.1f} times less"
        )
    write(options.out, curves, f"{options.slm}, {options.picture}, one thread, {platform.machine()}")


def write(out: Path, curves: dict[tuple[int, str], Curve], note: str) -> None:
    """Write CSV and chart."""
    from matplotlib.figure import Figure

    with out.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["expansion", "algorithm", "iteration", "cpu_s", "psnr_db"])
        for (q, name), curve in curves.items():
            writer.writerows([q, name, n, f"{seconds:.3f}", f"{psnr:.3f}"] for n, seconds, psnr in curve)
    figure = Figure(figsize=(12, 4.5), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    for (q, name), curve in curves.items():
        n, seconds, psnr = zip(*curve, strict=True)
        style = {"color": "#00798c" if name == "ours" else "#d1495b", "linestyle": "-" if q == 4 else "--"}
        left.plot(np.maximum(seconds, 0.05), psnr, label=f"{q}x, {name}", **style)
        right.plot(n, psnr, **style)
    left.set_xscale("log")
    left.set_xlabel("CPU seconds")
    right.set_xlabel("iterations")
    left.set_ylabel("PSNR on the dissertation's grid, dB")
    left.legend()
    left.grid(alpha=0.3)
    right.grid(alpha=0.3)
    figure.suptitle(f"Holograms: literal algorithm against ours. {note}", x=0.01, ha="left", fontsize=11)
    figure.savefig(out.with_suffix(".png"), dpi=100)


if __name__ == "__main__":
    main()
