"""Which wrong calibrations are named, and which right ones accused: by propagation, in scenes, on measured data.

    python benchmarks/wrong_calibration.py --measured --keep wrong.jsonl
    python benchmarks/wrong_calibration.py --count 0 --right 0 --scenes 0 --scenes-right 0 --keep wrong.jsonl --out docs/benchmarks/wrong-calibration.md

By propagation: scenes of five kinds before smooth diffusers of many kinds, rendered by wave optics at 128 x 160 pixels
with shot and read noise, in PSFs too, half of them with stray light; no threshold was set on seeds from 100 on.
Scenes: pictures and volumes of all families through lenslets, smooth diffusers and the PSFs of the measured sets, with what
fails there: up to four times as much stray light as light, erased and saturated pixels, aberration, fall-off, colour, little
light; numbers from 1000 on are unseen. Measured: the hand at four binnings, the tilted USAF target at full and half size as a
volume (``DIFFUSERBENCH_DATA``, else ``../shared/data``). Every photograph is checked with its own calibration and with
wrong ones.
"""  # noqa: E501

from __future__ import annotations

import argparse
import json
import platform
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import Calibration, InputError, Problem
from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.camera.transformed import Transformation, transformed
from recon.evaluation import content
from recon.evaluation.measured_sets import MEASURED, measured_set
from recon.evaluation.scene import FAMILIES, make_scene, spec_of
from recon.optics.diffuser import smooth_diffuser
from recon.optics.fall_off import gaussian_fall_off
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.render import render
from recon.optics.scene import picture
from recon.optics.wave import WavePropagator
from recon.reconstruction.decoys import check_calibration
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.reconstruct import require_two_images
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
Photograph = Float32Array | Measurement
Psfs = Float32Array | Calibration
Known = tuple[str, Photograph, dict[str, Psfs]]
"""What a photograph shows, itself, and calibrations by what is wrong with them."""
RIGHT, SWAPPED, SAME, MOVED = "right", "swapped", "the same image", "moved by 12 and -15 pixels"
REFUSED = "refused"


def optics_of(seed: int, rng: np.random.Generator) -> WavePropagator:
    """Return a camera with a diffuser of some feature size and slope."""
    aperture = (0.7 * SHAPE[0] * PITCH_UM, 0.7 * SHAPE[1] * PITCH_UM)
    features_um, slope = float(rng.uniform(80, 220)), float(rng.uniform(0.5, 1.2))
    diffuser = smooth_diffuser(aperture, 5.0, feature_size_um=features_um, mean_slope_deg=slope, seed=seed)
    return WavePropagator(diffuser, D_UM)


def psf_of(optics: WavePropagator, z_um: float, rng: np.random.Generator) -> np.ndarray:
    """Photograph a point source: 20,000 electrons at its brightest."""
    light = optics.psf((0.0, 0.0, z_um), GRID, GREEN.samples(1)).astype(np.float64)
    light *= 20_000 / np.quantile(light, 0.999)
    return np.maximum(rng.poisson(light) + rng.normal(0, 2, SHAPE), 0).astype(np.float32)


def simulated(seed: int) -> Known:
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


def seen(seed: int) -> Known:
    """Return a photograph through lenslets or measured PSFs under stresses, and its calibrations."""
    rng = np.random.default_rng([19, seed])
    family = FAMILIES[seed % len(FAMILIES)]
    picture, colour = family in content.PICTURES, rng.random() < 0.2
    kinds = (
        ("hand", "usaf", "random", "usaf", "hand", "random")
        if picture
        else ("usaf", "smooth", "usaf", "random")
    )
    optics = kinds[seed // len(FAMILIES) % len(kinds)]
    height, width = ((90, 120), (112, 150))[seed % 2] if optics == "hand" else ((90, 106), (67, 80))[seed % 2]
    stresses = {
        "background": 10 ** rng.uniform(-1, 0.6),
        "erased": rng.uniform(0.05, 0.8),
        "saturation": rng.uniform(0.4, 0.95),
        "aberration": 10 ** rng.uniform(-2, -1),
        "fall_off_deg": rng.uniform(8, 20),
    }
    spec = spec_of(
        family,
        size=(height, width),
        optics=optics,
        seed=90_000 + seed,
        field=0.65 if optics in MEASURED else 0.9,
        photons=float(10 ** rng.uniform(2, 5)),
        read_noise_e=float(10 ** rng.uniform(0, 1.3)),
        density=float(10 ** rng.uniform(-0.5, 0.5)),
        calibration_photons=float(10 ** rng.uniform(3, 4.5)),
        depths=1 if picture else int(rng.choice([4, 12, 30])),
        grid=int(rng.choice([1, 3])) if family == "microscope" else 1,
        channels=3 if colour and picture else 1,
        colourful=colour,
        **{name: float(value) for name, value in stresses.items() if rng.random() < 0.25},
    )
    scene = make_scene(spec)
    own = scene.calibration
    poses = {k: POSES[k] for k in ("turned by 1 degree", "turned by -4 degrees", "mirrored", "upside down")}
    if picture:
        poses |= {k: POSES[k] for k in ("1 % larger", "3 % larger")}
    wrong = {name: replace(own, psfs=transformed(own.psfs, how)) for name, how in poses.items()}
    other = {"hand": "usaf", "usaf": "hand" if picture else "smooth"}.get(optics, optics)
    plain = {"family": "beads" if not picture else "sparse-picture", "density": 0.1, "background": 0.0}
    foreign = make_scene(replace(spec, optics=other, seed=spec.seed + 5000, **plain))
    wrong["another diffuser"] = foreign.calibration
    return (
        f"seen, {family}, {optics}",
        Measurement(scene.measurement, erasures=scene.erasures),
        {RIGHT: own, **wrong},
    )


def measured() -> Iterator[Known]:
    """Yield measured photographs with calibrations."""
    psfs, hand = measured_set("hand")
    for binning in (2, 4, 8, 12):
        psf = block_mean(psfs[0], binning)
        wrong = {name: transformed(psf, how) for name, how in POSES.items()}
        yield f"hand, binned {binning}", block_mean(hand, binning), {RIGHT: psf, **wrong}
    for binning in (1, 2):
        psfs, target = (block_mean(images, binning) for images in measured_set("usaf"))
        places = np.column_stack([np.zeros((len(psfs), 2)), 1.0 + np.arange(len(psfs))])
        turned = {name: transformed(psfs, how) for name, how in POSES.items() if how.scale == 1}
        own = {
            name: Calibration(images[:, None], places) for name, images in ({RIGHT: psfs} | turned).items()
        }
        yield f"USAF volume, binned {binning}", target, own


def found(photograph: Photograph, psfs: Psfs) -> tuple[str, str, float]:
    """Return what is said of a calibration, as what it is said to be, and processor seconds."""
    began = time.process_time()
    try:
        problem = Problem.of(photograph, psfs)
        require_two_images(problem)
    except InputError as error:
        return REFUSED, str(error), time.process_time() - began
    check = check_calibration(problem)
    seconds = time.process_time() - began
    return ("none", "", seconds) if check is None else (str(check.fit), str(check.better or ""), seconds)


def run(keep: Path, photographs: Iterable[Known], with_wrong: int) -> None:
    """Check photographs, and so many of them with wrong calibrations too; append what was said to a file."""
    for number, (name, photograph, own) in enumerate(photographs):
        psfs = own[RIGHT]
        pairs = {
            wrong: (photograph, other)
            for wrong, other in own.items()
            if number < with_wrong or wrong == RIGHT
        }
        if number < with_wrong and not isinstance(psfs, Calibration):
            pairs |= {SWAPPED: (psfs, photograph), SAME: (psfs, psfs)}
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
    parser.add_argument("--count", type=int, default=8, help="scenes by propagation with wrong calibrations")
    parser.add_argument("--right", type=int, default=20, help="scenes by propagation")
    parser.add_argument("--first-scene", type=int, default=1000)
    parser.add_argument("--scenes", type=int, default=40, help="other scenes with wrong calibrations")
    parser.add_argument("--scenes-right", type=int, default=150, help="other scenes")
    parser.add_argument("--measured", action="store_true", help="the measured sets as well")
    parser.add_argument("--keep", type=Path, default=Path("wrong.jsonl"))
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    if a.measured:
        run(a.keep, measured(), 100)
    run(a.keep, map(simulated, range(a.first, a.first + a.right)), a.count)
    run(a.keep, map(seen, range(a.first_scene, a.first_scene + a.scenes_right)), a.scenes)
    entries = [json.loads(line) for line in a.keep.read_text("utf-8").splitlines()]
    of = {
        "Simulated by propagation": lambda words: words[0] == "simulated",
        "Pictures under stresses, lenslets": lambda words: (
            words[0] == "seen" and words[1] in content.PICTURES and words[2] not in MEASURED
        ),
        "Pictures under stresses, measured PSFs": lambda words: (
            words[0] == "seen" and words[1] in content.PICTURES and words[2] in MEASURED
        ),
        "Volumes under stresses": lambda words: words[0] == "seen" and words[1] not in content.PICTURES,
        "Measured sets": lambda words: words[0] not in ("simulated", "seen"),
    }
    groups = {name: [e for e in entries if within(e["scene"].split(", "))] for name, within in of.items()}
    groups["All together"] = entries
    seconds = np.median([e["said"][2] for e in entries if e["said"][0] != REFUSED])
    text = "\n\n".join(f"## {name}\n{table(group)}" for name, group in groups.items() if group)
    text = (
        "# Wrong calibrations\n\n    python benchmarks/wrong_calibration.py --measured\n\n"
        f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}; a check takes {seconds:.2f} s of processor\n"
        "time (median), others at work beside it. What the check of decoys says (decisions\n"
        "[0063](../decisions/0063-decoys.md), [0072](../decisions/0072-tiles-vote-on-a-calibration.md)).\n"
        "A PSF that is moved moves the picture and fits as well: no photograph tells it. What cannot be\n"
        f"told is doubtful at best.\n\n{text}\n"
    )
    print(text)
    if a.out is not None:
        a.out.write_text(text, "utf-8")


if __name__ == "__main__":
    main()
