"""Which wrong calibrations are named, and which right ones accused: by propagation and on measured data.

    python benchmarks/wrong_calibration.py --measured --keep wrong.jsonl
    python benchmarks/wrong_calibration.py --count 0 --right 0 --keep wrong.jsonl --out docs/benchmarks/wrong-calibration.md

Scenes of five kinds before smooth diffusers of many kinds, rendered by wave optics at 128 x 160 pixels with
shot and read noise, in PSFs too, half of them with stray light; no threshold was set on seeds from 100 on.
Measured: the hand at four binnings, the tilted USAF target at half size as a volume (``DIFFUSERBENCH_DATA``, else
``../shared/data``). Every photograph is checked with its own calibration and with wrong ones.
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections import Counter
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import Calibration, InputError, Problem
from recon.base.blocks import block_mean
from recon.base.checks import require_photograph
from recon.camera.transformed import Transformation, transformed
from recon.evaluation import content
from recon.evaluation.measured_sets import measured_set
from recon.optics.diffuser import smooth_diffuser
from recon.optics.fall_off import gaussian_fall_off
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.render import render
from recon.optics.scene import picture
from recon.optics.wave import WavePropagator
from recon.reconstruction.decoys import check_calibration
from recon.verdict.calibration_check import Fit

SHAPE, PITCH_UM, D_UM = (128, 160), 13.0, 8900.0
GRID = PixelGrid(SHAPE, PITCH_UM)
CONTENTS = (content.text, content.filaments, content.gradient, content.texture, content.sparse_picture)
POSES = {
    "turned by 1 degree": Transformation(rotation_deg=1),
    "turned by -4 degrees": Transformation(rotation_deg=-4),
    "turned by 20 degrees": Transformation(rotation_deg=20),
    "1 % larger": Transformation(scale=1.01),
    "1 % smaller": Transformation(scale=0.99),
    "3 % larger": Transformation(scale=1.03),
    "mirrored": Transformation(mirrored=True),
    "upside down": Transformation(rotation_deg=180, mirrored=True),
    "another binning": Transformation(scale=0.5),
}
RIGHT, SWAPPED, SAME, MOVED = "right", "swapped", "the same image", "moved by 12 and -15 pixels"
REFUSED = "refused"


def optics_of(seed: int, rng: np.random.Generator) -> WavePropagator:
    """Return a camera with a diffuser of some feature size and slope."""
    aperture = (0.7 * SHAPE[0] * PITCH_UM, 0.7 * SHAPE[1] * PITCH_UM)
    features_um, slope = float(rng.uniform(80, 220)), float(rng.uniform(0.5, 1.2))
    diffuser = smooth_diffuser(aperture, 5.0, feature_size_um=features_um, mean_slope_deg=slope, seed=seed)
    return WavePropagator(diffuser, D_UM, workers=1)


def psf_of(optics: WavePropagator, z_um: float, rng: np.random.Generator) -> np.ndarray:
    """Photograph a point source: 20,000 electrons at its brightest."""
    light = optics.psf((0.0, 0.0, z_um), GRID, GREEN.samples(1)).astype(np.float64)
    light *= 20_000 / np.quantile(light, 0.999)
    return np.maximum(rng.poisson(light) + rng.normal(0, 2, SHAPE), 0).astype(np.float32)


def simulated(seed: int) -> tuple[str, np.ndarray, dict[str, np.ndarray]]:
    """Return a photograph, what it shows, and calibrations by what is wrong with them."""
    rng = np.random.default_rng([17, seed])
    optics, z_um = optics_of(seed, rng), float(rng.uniform(60e3, 300e3))
    draw = CONTENTS[seed % len(CONTENTS)]
    width_um = rng.uniform(0.5, 1.2) * SHAPE[0] * PITCH_UM * z_um / D_UM
    scene = picture(draw(rng, 128, 1.0), z_um, width_um)
    light = render(
        scene, (0.0, 1.0, 0.0), GRID, optics, gaussian_fall_off(20.0), layer_photons=1, bead_photons=1
    )
    stray = float(rng.choice([0.0, 0.0, 0.3, 1.0])) * light.mean() * np.linspace(0.7, 1.3, SHAPE[1])
    light = light * (10 ** rng.uniform(3.0, 4.6) / light.max())
    counts = rng.poisson(light + stray) + rng.normal(0, 3, SHAPE)
    psf = psf_of(optics, z_um, rng)
    wrong = {name: transformed(psf, how) for name, how in POSES.items()}
    wrong |= {
        "another diffuser": psf_of(optics_of(seed + 5000, rng), z_um, rng),
        "another depth (20 % nearer)": psf_of(optics, 0.8 * z_um, rng),
        MOVED: transformed(psf, Transformation(12, -15)),
    }
    return f"simulated, {draw.__name__}", counts.astype(np.float32), {RIGHT: psf, **wrong}


def measured() -> Iterator[tuple[str, np.ndarray, dict[str, np.ndarray]]]:
    """Yield measured photographs with calibrations: PSFs (n_z, height, width) or (height, width)."""
    psfs, hand = measured_set("hand")
    for binning in (2, 4, 8, 12):
        psf = block_mean(psfs[0], binning)
        wrong = {name: transformed(psf, how) for name, how in POSES.items()}
        yield f"hand, binned {binning}", block_mean(hand, binning), {RIGHT: psf, **wrong}
    psfs, target = (block_mean(images, 2) for images in measured_set("usaf"))
    turned = {name: transformed(psfs, how) for name, how in POSES.items() if how.scale == 1}
    yield "USAF volume, binned 2", target, {RIGHT: psfs, **turned}


def found(photograph: np.ndarray, psf: np.ndarray) -> tuple[str, str, float]:
    """Return what is said of a calibration, as what it is said to be, and processor seconds."""
    began = time.process_time()
    try:
        middle = psf if psf.ndim == 2 else psf[len(psf) // 2]
        require_photograph(photograph[None], middle[None], np.ones((1, *middle.shape), bool))
    except InputError as error:
        return REFUSED, str(error), time.process_time() - began
    places = np.zeros((len(psf), 3))
    places[:, 2] = 1 + np.arange(len(psf))
    check = check_calibration(
        Problem.of(photograph, psf if psf.ndim == 2 else Calibration(psf[:, None], places))
    )
    return str(check.fit), str(check.better or ""), time.process_time() - began


def run(keep: Path, first: int, count: int, right: int, *, with_measured: bool) -> None:
    """Check photographs and append what was said to a file."""
    scenes = (simulated(seed) for seed in range(first, first + max(count, right)))
    for number, (name, photograph, own) in enumerate(chain(measured() if with_measured else (), scenes)):
        psf = own[RIGHT]
        pairs = {wrong: (photograph, other) for wrong, other in own.items()}
        if psf.ndim == 2:
            pairs |= {SWAPPED: (psf, photograph), SAME: (psf, psf)}
        if name.startswith("simulated") and (count := count - 1) < 0:
            pairs = {RIGHT: pairs[RIGHT]}
        for wrong, pair in pairs.items():
            with keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"scene": name, "wrong": wrong, "said": found(*pair)}) + "\n")
        print(f"\r{number + 1} photographs", end="", file=sys.stderr)
    print(file=sys.stderr)


def table(entries: list[dict]) -> str:
    """Return a table: what was said, by what was wrong."""
    said = {wrong: Counter() for wrong in dict.fromkeys(e["wrong"] for e in entries)}
    for entry in entries:
        said[entry["wrong"]][entry["said"][0]] += 1
    lines = [
        "| calibration | checked | named or refused | cannot be told: never reliable | taken for right |",
        "|---|---|---|---|---|",
    ]
    for wrong, counts in said.items():
        n = counts.total()
        named = sum(counts[k] for k in (REFUSED, Fit.OFF, Fit.FOREIGN))
        lines.append(
            f"| {wrong} | {n} | {named} ({named / n:.0%}) | {counts[Fit.UNTOLD]} | {counts[Fit.FITS]} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Check, and print or write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--count", type=int, default=8, help="simulated scenes with wrong calibrations")
    parser.add_argument("--right", type=int, default=20, help="simulated scenes with their right one")
    parser.add_argument("--measured", action="store_true", help="the measured sets as well")
    parser.add_argument("--keep", type=Path, default=Path("wrong.jsonl"))
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    run(a.keep, a.first, a.count, a.right, with_measured=a.measured)
    entries = [json.loads(line) for line in a.keep.read_text("utf-8").splitlines()]
    groups = {
        "Simulated by propagation": [e for e in entries if e["scene"].startswith("simulated")],
        "Measured sets": [e for e in entries if not e["scene"].startswith("simulated")],
    }
    seconds = np.median([e["said"][2] for e in entries if e["said"][0] != REFUSED])
    text = "\n\n".join(f"## {name}\n{table(group)}" for name, group in groups.items() if group)
    text = (
        "# Wrong calibrations\n\n    python benchmarks/wrong_calibration.py --measured\n\n"
        f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}; a check takes {seconds:.2f} s of processor\n"
        "time (median). What the check of decoys says ([decision 0063](../decisions/0063-decoys.md)).\n"
        "A PSF that is moved moves the picture and fits as well: no photograph tells it. What cannot be\n"
        f"told is doubtful at best.\n\n{text}\n"
    )
    print(text)
    if a.out is not None:
        a.out.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
