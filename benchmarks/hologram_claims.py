"""What a DC term costs, what a complex SLM, further frames, a warm start gain, what mirrors reach.

PSNR by the plain judge (double precision, twice the aperture, no aliasing), means over pictures::

    python benchmarks/hologram_claims.py --slm 135x240 --iterations 100 --out hologram-claims.csv
"""

from __future__ import annotations

import argparse
import csv
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import cv2
import numpy as np

from instrument.display.hologram import field_picture
from instrument.files.images import read_image
from instrument.files.sample_images import load_sample
from recon.base.threads import set_threads
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    Target,
    compute_hologram,
    judge,
    random_mask,
)
from recon.holography.display import no_mask
from recon.holography.target import FIRST_ORDER

PICTURES = ("portrait", "relief", "leaves")
DC = DcTerm(0.1, 0.6)
LIGHTS = (0.7, 0.4, 0.2, 0.1, 0.03, 0.01)
FRAMES = {1: (1, 8, 24), 4: (1, 8), 16: (1,)}
"""Of mirrors, by expansion."""
MOVES = 6
"""Frames of the moving image; the first is computed cold."""


def display_of(slm: tuple[int, int], q: int) -> Display:
    """Return a display with a random mask, or with none where it expands nothing."""
    k = round(q**0.5)
    mask = no_mask(slm) if q == 1 else random_mask((slm[0] * k, slm[1] * k), seed=q)
    return Display(slm, mask)


def solve(
    display: Display, target: Target, iterations: int, *, frames: int = 1, start: np.ndarray | None = None
) -> np.ndarray:
    """Compute SLM frames."""
    model = HologramModel(display, [target], frames=frames)
    return compute_hologram(model, initial=start, iterations=iterations, tolerance=0).slm


def psnr(slm: np.ndarray, display: Display, target: Target) -> float:
    """Judge SLM frames."""
    return judge(slm, display, target).psnr_db


def dc_term(slm: tuple[int, int], iterations: int, expansions: list[int]) -> list[tuple[str, float]]:
    """No DC term; one that is modelled; one that is ignored."""
    lines = []
    for q in expansions:
        plain = display_of(slm, q)
        with_dc = replace(plain, dc=DC)
        sums = np.zeros(3)
        for name in PICTURES:
            target = Target(load_sample(name, plain.mask.shape), white=1.0)
            unaware = solve(plain, target, iterations)
            aware = solve(with_dc, target, iterations)
            sums += [
                psnr(unaware, plain, target),
                psnr(aware, with_dc, target),
                psnr(unaware, with_dc, target),
            ]
        words = ("none", "10 %, modelled", "10 %, ignored")
        lines += [(f"{q}x, DC term {w}", v) for w, v in zip(words, sums / len(PICTURES), strict=True)]
    return lines


def complex_slm(slm: tuple[int, int], iterations: int) -> list[tuple[str, float]]:
    """Compare a phase SLM and a complex one that sends less and less of the light, beside a DC term."""
    lines = []
    for q in (4, 16):
        display = replace(display_of(slm, q), dc=DC)
        ways: list[dict[str, Any]] = [{}, *({"complex_slm": True, "light": light} for light in LIGHTS)]
        for way in ways:
            found = []
            for name in PICTURES:
                target = Target(load_sample(name, display.mask.shape), white=1.0)
                model = HologramModel(display, [target], **way)
                slm_field = compute_hologram(model, iterations=iterations, tolerance=0).slm
                found.append((psnr(slm_field, display, target), model.efficiency(slm_field)))
            db, light = np.mean(found, axis=0)
            least = min(db for db, _ in found)
            kind = "complex SLM" if way else "phase SLM"
            lines.append(
                (f"{q}x, {kind}, {light:.3f} of the light (worst picture {least:.2f} dB)", float(db))
            )
    return lines


def frames(slm: tuple[int, int], iterations: int, picture: Path | None) -> Iterator[tuple[str, float]]:
    """One, two, four and eight frames that are optimised together; of a picture file, or the samples."""
    for q in (4, 16):
        display = display_of(slm, q)
        shape = display.mask.shape
        if picture is None:
            images = [load_sample(name, shape) for name in PICTURES]
        else:
            own = field_picture(read_image(picture).pixels)
            images = [cv2.resize(own, shape[::-1], interpolation=cv2.INTER_AREA).clip(0, 1)]
        for count in (1, 2, 4, 8):
            found = []
            for image in images:
                target = Target(image, white=1.0)
                found.append(psnr(solve(display, target, iterations, frames=count), display, target))
            yield f"{q}x, {count} frame(s)", float(np.mean(found))


def windowed(name: str, shape: tuple[int, int]) -> Target:
    """Return a picture where mirrors show it."""
    part = FIRST_ORDER.part(shape)
    image = np.zeros(shape)
    image[part] = load_sample(name, image[part].shape)
    return Target(image, white=1.0, window=FIRST_ORDER)


def mirrors(slm: tuple[int, int], iterations: int) -> Iterator[tuple[str, float]]:
    """Patterns of mirrors beside a phase SLM's, 8 and 24 frames too: quality, and light in the picture."""
    for q in (1, 4, 16):
        display = display_of(slm, q)
        ways: list[dict[str, Any]] = [{"mirrors": "optimised", "frames": n} for n in FRAMES[q]]
        ways.insert(0, {})
        if q == 1:
            ways[1:1] = [{"window": True}]
            ways += [{"mirrors": kind, "frames": n} for kind in ("lee", "off-axis") for n in FRAMES[q]]
        for way in ways:
            options = {name: value for name, value in way.items() if name != "window"}
            found = []
            for name in PICTURES:
                shape = display.mask.shape
                target = windowed(name, shape) if way else Target(load_sample(name, shape), white=1.0)
                model = HologramModel(display, [target], **options)
                field = compute_hologram(model, iterations=iterations, tolerance=0).slm
                light = model.efficiency(field)
                if target.window is not None:
                    whole = model.intensity(field)
                    light *= float(whole[target.window.part(whole.shape)].sum() / whole.sum())
                found.append((psnr(field, display, target), light))
            db, light = np.mean(found, axis=0)
            kind = f"mirrors, {way['mirrors']}, {way['frames']} frame(s)" if options else "phase SLM"
            kind += ", whole field" if not way else ", in the window" if not options else ""
            least = min(db for db, _ in found)
            yield f"{q}x, {kind}, {light:.3f} of the light (worst {least:.2f} dB)", float(db)


def moved(name: str, shape: tuple[int, int], quarters: int) -> Target:
    """Return a picture that has moved by quarters of a mask-grid pixel."""
    height, width = shape
    fine = load_sample(name, (height, 4 * (width + MOVES)))[:, quarters : quarters + 4 * width]
    return Target(fine.reshape(height, width, 4).mean(axis=2), white=1.0)


def warm_start(slm: tuple[int, int]) -> list[tuple[str, float]]:
    """Ten iterations warm, thirty cold and ten cold of a moving picture."""
    display = display_of(slm, 4)
    shape = display.mask.shape
    lines = []
    for quarters in (2, 4):
        warm, cold, few = [], [], []
        for name in PICTURES:
            last = None
            for number in range(MOVES):
                target = moved(name, shape, quarters * number)
                last = solve(display, target, 10 if number else 30, start=last)
                if number:
                    warm.append(psnr(last, display, target))
                    cold.append(psnr(solve(display, target, 30), display, target))
                    few.append(psnr(solve(display, target, 10), display, target))
        speed = f"{quarters / 4 / shape[1]:.4f} of its width a frame"
        for words, values in (("10 warm", warm), ("30 cold", cold), ("10 cold", few)):
            lines.append((f"4x, moving by {speed}, {words} iterations", float(np.mean(values))))
    return lines


def main() -> None:
    """Run all and write the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--slm", default="135x240")
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--only", choices=["dc", "complex", "frames", "warm", "mirrors"], help="one")
    parser.add_argument("--expansions", type=int, nargs="+", default=[1, 4, 16], help="for --only dc")
    parser.add_argument("--picture", type=Path, help="a file for --only frames, instead of the samples")
    parser.add_argument("--out", type=Path, default=Path("hologram-claims.csv"))
    options = parser.parse_args()
    rows, columns = (int(n) for n in options.slm.split("x"))
    set_threads(1)
    with options.out.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["case", "psnr_db"])
        parts = {
            "dc": lambda: dc_term((rows, columns), options.iterations, options.expansions),
            "complex": lambda: complex_slm((rows, columns), options.iterations),
            "frames": lambda: frames((rows, columns), options.iterations, options.picture),
            "warm": lambda: warm_start((rows, columns)),
            "mirrors": lambda: mirrors((rows, columns), options.iterations),
        }
        for name, part in parts.items():
            if options.only not in (None, name):
                continue
            for case, value in part():
                print(f"{case}: {value:.2f} dB", flush=True)
                writer.writerow([case, f"{value:.3f}"])


if __name__ == "__main__":
    main()
