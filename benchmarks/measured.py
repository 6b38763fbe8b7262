"""What defaults make of measured photographs: the page ``docs/benchmarks/measured-data.md``.

Each section is a function of :data:`SECTIONS` that returns its lines of Markdown and draws its picture into
the page's folder; a section that is run again takes its own place in the page. The data are not part of the
repository (``DIFFUSERBENCH_DATA``, or ``../shared/data``).

    python benchmarks/measured.py [--only hand usaf ...] [--out docs/benchmarks]
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import re
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.measured_blind import blind
from benchmarks.measured_labs import cut, cut_drawn, labs
from benchmarks.measured_scenes import load, ramp
from benchmarks.measured_speed import speed
from benchmarks.measured_variants import coarse_pairs, dark_levels, variants
from benchmarks.uncertainty import measured_pairs_held
from recon import Calibration, Reconstruction, reconstruct
from recon.arrays import Array
from recon.base.threads import get_threads, set_threads

PRIORS = ("tv", "l1", "nonnegative")
LAST = 8
"""Of the USAF target's 44 planes, those in which light gathers that fits nowhere."""


def solved(image: Array, calibration: Calibration, **options: Any) -> tuple[Reconstruction, float]:
    """Return the result of the defaults, and the processor time of all of it, choosing included."""
    began = time.process_time()
    result = reconstruct(image, calibration, **options)
    return result, time.process_time() - began


def residuals(result: Reconstruction) -> str:
    """Return the least and the last residual, in units of the noise."""
    norms = [record.data_residual / result.noise_norm for record in result.history]
    return f"{min(norms):.1f}, {norms[-1]:.1f}"


def background(result: Reconstruction, image: Array) -> str:
    """Return the mean of the background relative to that of the data."""
    return "none" if result.background is None else f"{result.background.mean() / image.mean():+.2f}"


def verdict(result: Reconstruction) -> str:
    """Return the verdict in a few words."""
    return "not judged" if result.verdict is None else result.verdict.sentences[0].split(":")[0].rstrip(".")


def said(results: Mapping[str, Reconstruction]) -> list[str]:
    """Return what was said of residuals, by the rows' names."""
    return [
        f"* {name}: {w}" for name, r in results.items() for w in r.warnings if w.startswith("What is left")
    ]


def psnr(image: Array, reference: Array) -> float:
    """Return the peak signal-to-noise ratio for the reference's peak, decibels."""
    return float(20 * np.log10(reference.max() / np.sqrt(np.mean((image - reference) ** 2))))


def hand(folder: Path, binnings: tuple[int, ...]) -> list[str]:
    """Show the hand by every prior at some binnings, and the first of them as a copy in colour."""
    lines = [
        "| bin | prior | PSNR to the converged picture, dB | least and last residual, noise | background | "
        "CPU s | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    results: dict[str, Reconstruction] = {}
    pictures = []
    for binning in binnings:
        calibration, image = load("hand", binning)
        reference = reconstruct(
            image,
            calibration.psfs[0, 0],
            solver="admm-sensor",
            iterations=400,
            tolerance=1e-5,
            judged=False,
        ).image
        for prior in PRIORS:
            result, seconds = solved(image, calibration, prior=prior)
            results[f"bin {binning}, {prior}"] = result
            lines.append(
                f"| {binning} | {prior} | {psnr(result.image, reference):.1f} | {residuals(result)} | "
                f"{background(result, image)} | {seconds:.1f} | {verdict(result)} |"
            )
            if binning == binnings[-1]:
                pictures.append((prior, result.image))
    calibration, image = load("hand", binnings[0])
    colour = np.stack([image * gain for gain in (1.0, 0.7, 0.5)], axis=-1)
    result, seconds = solved(colour, calibration)
    tints = result.image.reshape(-1, 3).sum(axis=0)
    lines += [
        "",
        f"A copy in colour, gains 1, 0.7, 0.5: found {tints / tints[0]}, {seconds:.1f} CPU s.",
    ]
    pictures.append(("colour", result.image))
    picture = f"measured_hand_{binnings[-1]}.jpg"
    draw_row(pictures, folder / picture)
    return [*lines, "", *said(results), "", f"![The hand by every prior, and in colour]({picture})"]


def stray(_: Path) -> list[str]:
    """Show the hand under stray light of several shapes, by default and without a background."""
    calibration, image = load("hand", 8)
    psf = calibration.psfs[0, 0]
    reference = reconstruct(
        image, psf, solver="admm-sensor", iterations=400, tolerance=1e-5, judged=False
    ).image
    y, x = (np.linspace(-1, 1, n) for n in image.shape)
    off_axis2 = y[:, None] ** 2 + x**2
    shapes = {"even": np.ones(image.shape), "bowl": 0.2 + off_axis2, "hill": np.exp(-off_axis2)}
    lines = [
        "Binned by 8, with smooth light added to the photograph: dB to the converged picture of the hand "
        "without it.",
        "",
        "| prior | shape | of its light | `--no-background`, dB | by default, dB | background | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for prior in ("tv", "l1"):
        for name, light in shapes.items():
            for share in (0.0, 0.5, 1.0):
                if share == 0 and name != "even":
                    continue
                lit = (image + share * image.mean() * light / light.mean()).astype(np.float32)
                asked = {"prior": prior, "judged": False}
                none, _ = solved(lit, calibration, estimate_background=False, **asked)
                result, seconds = solved(lit, calibration, **asked)
                lines.append(
                    f"| {prior} | {name} | {share:g} | {psnr(none.image, reference):.1f} | "
                    f"{psnr(result.image, reference):.1f} | {background(result, lit)} | {seconds:.1f} |"
                )
    return lines


def usaf(folder: Path, binning: int) -> list[str]:
    """Show the tilted target by every prior, and by total variation without a background."""
    lines = [
        f"| prior | light in the last {LAST} of 44 planes | depth over x | least and last residual, noise | "
        "background | choosing, all: s | CPU s | verdict |",
        "|---|---|---|---|---|---|---|---|",
    ]
    results: dict[str, Reconstruction] = {}
    calibration, image = load("usaf", binning)
    ways: dict[str, dict[str, Any]] = {prior: {"prior": prior} for prior in PRIORS}
    ways["tv, `--no-background`"] = {"estimate_background": False}
    for name, options in ways.items():
        result, seconds = solved(image, calibration, **options)
        assert result.choice is not None
        results[name] = result
        light = result.volume.sum(axis=(1, 2))
        lines.append(
            f"| {name} | {light[-LAST:].sum() / light.sum():.2f} | {ramp(result.volume):+.2f} | "
            f"{residuals(result)} | {background(result, image)} | {result.choice.seconds:.1f}, "
            f"{result.choice.seconds + result.seconds:.1f} | {seconds:.1f} | {verdict(result)} |"
        )
        print(lines[-1], flush=True)
    picture = f"measured_usaf_{binning}.jpg"
    draw_volumes(results, folder / picture)
    return [*lines, "", *said(results), "", f"![The target: every bar in its own depth]({picture})"]


def draw_row(pictures: list[tuple[str, Array]], path: Path) -> None:
    """Draw pictures side by side, square roots of their light."""
    plt = pyplot()
    figure, axes = plt.subplots(1, len(pictures), figsize=(4 * len(pictures), 3.2))
    for axis, (name, picture) in zip(axes, pictures, strict=True):
        shown = np.sqrt(np.clip(picture / np.percentile(picture, 99.9), 0, 1))
        axis.imshow(shown, cmap="gray")
        axis.set_title(name)
        axis.axis("off")
    figure.tight_layout()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=70)


def draw_volumes(results: Mapping[str, Reconstruction], path: Path) -> None:
    """Draw each volume's brightest over depth and over y, with colour for depth."""
    plt = pyplot()
    figure, axes = plt.subplots(len(results), 3, figsize=(15, 3.2 * len(results)))
    for row, (name, result) in zip(axes, results.items(), strict=True):
        height, width = result.volume.shape[1:]
        volume = result.volume[
            :, int(0.28 * height) : int(0.72 * height), int(0.35 * width) : int(0.7 * width)
        ]
        volume = volume - np.percentile(volume, 20)
        # The first and last planes take what lies outside the calibrated range.
        front, side = volume[1:-1].max(axis=0), volume.max(axis=1)
        level = np.percentile(front, 99.7)
        row[0].imshow(front, cmap="gray", vmin=0, vmax=level)
        row[0].set_title(f"{name}: brightest over depth")
        row[1].imshow(side, aspect="auto", cmap="magma", vmin=0, vmax=np.percentile(side, 99.7))
        row[1].set(title="brightest over y", ylabel="depth plane", xlabel="x")
        hue = plt.get_cmap("turbo")((1 + volume[1:-1].argmax(axis=0)) / len(volume))[..., :3]
        row[2].imshow(np.clip(hue * (front / level)[..., None], 0, 1))
        row[2].set_title("colour: depth")
        row[0].axis("off")
        row[2].axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=50)


def intervals(_: Path) -> list[str]:
    """Return what 95 % intervals of the pairs' pictures hold of their truths."""
    return [
        "What 95 % intervals hold of the pairs' truths (binned 4 x 4), each through the PSF that the other "
        "six give: columns in [uncertainty.md](uncertainty.md).",
        "",
        *measured_pairs_held(4),
    ]


def pairs(_: Path) -> list[str]:
    """Point to where the pairs are reconstructed and judged."""
    return [
        "Seven colour photographs of a screen with their truths and no PSF: each through the PSF that the "
        "other six give, figures and pictures in [calibrate-screen.md](calibrate-screen.md) "
        "(`python benchmarks/calibrate_screen.py`)."
    ]


def pyplot() -> Any:
    """Return matplotlib's pyplot, which draws into files only."""
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    return plt


SECTIONS: Mapping[str, tuple[str, Callable[[Path], list[str]]]] = {
    "hand": ("The hand, bins 8 and 4", lambda folder: hand(folder, (8, 4))),
    "hand-fine": ("The hand, bin 2", lambda folder: hand(folder, (2,))),
    "stray": ("The hand under stray light", stray),
    "usaf": ("The tilted USAF target, half size", lambda folder: usaf(folder, 2)),
    "usaf-full": ("The tilted USAF target, full size", lambda folder: usaf(folder, 1)),
    "pairs": ("The pairs", pairs),
    "variants": ("The hand as other files are", variants),
    "blind": ("The hand as a stranger gives it", blind),
    "labs": ("The hand by other laboratories' habits", labs),
    "cut": ("What tells that the hand's PSF was cut", cut),
    "cut-drawn": ("Drawn pictures through PSFs that were cut", cut_drawn),
    "coarse": ("Pairs in coarse pixels", coarse_pairs),
    "dark": ("Pairs whose dark level is wrong", dark_levels),
    "speed": ("Time against accuracy", speed),
    "intervals": ("How far the pairs' pictures may be off", intervals),
}
"""By name: a title, and what makes the section."""
HEAD = """# Measured photographs

Defaults throughout: no option beyond the files and what a row names. The data are the Waller Lab's
DiffuserCam sets; they stay outside the repository. `python benchmarks/measured.py` makes this page; date and
machine stand under each title.
"""


def main() -> None:
    """Run the sections that are asked for, and put them into the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=list(SECTIONS))
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--threads", type=int, default=get_threads())
    asked = parser.parse_args()
    set_threads(asked.threads)
    asked.out.mkdir(parents=True, exist_ok=True)
    page = asked.out / "measured-data.md"
    text = page.read_text() if page.exists() else HEAD
    for name in asked.only:
        title, section = SECTIONS[name]
        when = (
            f"{datetime.datetime.now(datetime.UTC):%d %B %Y}, {os.cpu_count()} CPUs, load "
            f"{os.getloadavg()[0]:.0f}, threads: {asked.threads}, Python {platform.python_version()}."
        )
        own = "\n".join([f"## {title}", when, "", *section(asked.out), "", ""])
        place = re.compile(rf"^## {re.escape(title)}\n.*?(?=^## |\Z)", re.MULTILINE | re.DOTALL)
        text = place.sub(lambda _, own=own: own, text) if place.search(text) else f"{text.rstrip()}\n\n{own}"
        page.write_text(f"{text.rstrip()}\n")
        print(own, flush=True)


if __name__ == "__main__":
    main()
