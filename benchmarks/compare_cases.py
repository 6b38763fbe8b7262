"""What `compare` says of two calibrations between which one thing changed, by light that is propagated.

    python benchmarks/compare_cases.py                      three depths and one, smooth diffuser and lenslets
    python benchmarks/compare_cases.py --only source --words

The bench is `tiny`; PSFs have photon and read noise. ``told``: the sentence names what changed;
``undecided``: it says that it cannot tell which part moved; ``unseen``: it says that it does not see such a
change; ``other``: it names something else; ``nothing``: the old calibration serves, without more. Beside a
change the lamp may be a fifth darker (``dim``), as after some months.
"""

from __future__ import annotations

import argparse
import re
from dataclasses import dataclass, replace

import numpy as np

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.compare import compare
from recon.base.blocks import block_mean
from recon.errors import InputError
from recon.optics.grid import GREEN, PixelGrid
from recon.optics.wave import WavePropagator
from recon.types import Calibration, Geometry

DEPTHS_UM = (60e3, 90e3, 150e3)


@dataclass(frozen=True)
class Case:
    """What changed, and what a right sentence about it holds."""

    words: str
    source_um: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """By which the source stands beside what is recorded."""
    diffuser_um: tuple[float, float] = (0.0, 0.0)
    """By which the diffuser moved across."""
    world: tuple[tuple[str, object], ...] = ()
    lamp: tuple[float, float, float] = (1.0, 1.0, 1.0)
    binning: int = 1
    turned_deg: float = 0.0


SOURCE, DIFFUSER = r"(?i)\bsource (moved|did|stands|stood)", r"(?i)\bdiffuser (moved|is|stands)"
DRIFT = "lamp's drift"
CASES = {
    "nothing": Case("still serves"),
    "another diffuser": Case("different patterns", world=(("diffuser_seed", 9),)),
    "another diffuser (2)": Case("different patterns", world=(("diffuser_seed", 23),)),
    "source 50 um across": Case(SOURCE, source_um=(50, 0, 0)),
    "source 200 um across": Case(SOURCE, source_um=(160, -120, 0)),
    "source 1 mm across": Case(SOURCE, source_um=(0, 1000, 0)),
    "source 3 mm across": Case(SOURCE, source_um=(3000, 0, 0)),
    "source 0.5 mm farther": Case(SOURCE, source_um=(0, 0, 500)),
    "source 2 mm farther": Case(SOURCE, source_um=(0, 0, 2000)),
    "source 4 mm nearer": Case(SOURCE, source_um=(0, 0, -4000)),
    "diffuser 20 um across": Case(DIFFUSER, diffuser_um=(20, 0)),
    "diffuser 100 um across": Case(DIFFUSER, diffuser_um=(60, -80)),
    "diffuser 300 um across": Case(DIFFUSER, diffuser_um=(0, 300)),
    "diffuser 0.05 mm farther": Case(DIFFUSER, world=(("diffuser_distance_mm", 8.95),)),
    "diffuser 0.15 mm farther": Case(DIFFUSER, world=(("diffuser_distance_mm", 9.05),)),
    "diffuser 0.5 mm nearer": Case(DIFFUSER, world=(("diffuser_distance_mm", 8.4),)),
    "camera turned 0.5 degrees": Case("turned by", turned_deg=0.5),
    "lamp at 0.7": Case("light is 0.[57]", lamp=(0.7, 0.7, 0.7)),
    "lamp at 0.9": Case("light is 0.[79]", lamp=(0.9, 0.9, 0.9)),
    "lamp drifts 1, 0.9, 0.8": Case(DRIFT, lamp=(1.0, 0.9, 0.8)),
    "pixels binned 2 x 2": Case("Another binning", binning=2),
}


class Camera:
    """A bench whose PSFs are asked for; light of one diffuser and distance is computed once."""

    def __init__(self, **options: object) -> None:
        self.world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0, **options))  # type: ignore[arg-type]
        self.light = WavePropagator(self.world.diffuser, self.world.distance_um)

    def psf(
        self, source_um: tuple[float, ...], diffuser_um: tuple[float, float], turned_deg: float
    ) -> np.ndarray:
        """Return light on the pixels.

        A diffuser that moves is a sensor and a source that move the other way.
        """
        grid = self.world.sensor_grid(1)
        (x, y, z), (u, v) = source_um, diffuser_um
        angle = np.deg2rad(turned_deg)
        if angle:  # the sensor turns about the axis: by splines, as no other change here is made
            straight = self.light.psf((x, y, z), grid, GREEN.samples(1), emission="lambertian")
            from scipy import ndimage

            return ndimage.rotate(straight, turned_deg, reshape=False, order=3)
        moved = PixelGrid(grid.shape, grid.pitch_um, (grid.center_um[0] - u, grid.center_um[1] - v))
        return self.light.psf((x - u, y - v, z), moved, GREEN.samples(1), emission="lambertian")


def calibration(camera: Camera, case: Case, depths_um: tuple[float, ...], seed: int) -> Calibration:
    """Photograph the source at some depths, as a sweep records them."""
    rng = np.random.default_rng(seed)
    psfs, level = [], 0.0
    for z, lamp in zip(depths_um, case.lamp, strict=False):
        x_off, y_off, z_off = case.source_um
        light = camera.psf((x_off, y_off, z + z_off), case.diffuser_um, case.turned_deg)
        level = level or 4000 / np.quantile(camera.psf((0.0, 0.0, depths_um[0]), (0, 0), 0.0), 0.999)
        light = np.maximum(light, 0) * level * lamp
        psfs.append(
            np.maximum(np.mean([rng.poisson(light) + rng.normal(0, 2, light.shape) for _ in range(4)], 0), 0)
        )
    geometry = Geometry(13.0, 8.9)
    places = np.array([(0.0, 0.0, z) for z in depths_um])
    made = Calibration(
        np.float32(psfs)[:, None], places, geometry=geometry, provenance={"reference_exposure_ms": 1.0}
    )
    if case.binning > 1:
        binned = block_mean(made.psfs, case.binning)
        made = replace(made, psfs=binned, geometry=Geometry(13.0 * case.binning, 8.9))
    return made


def judged(case: Case, name: str, reasons: tuple[str, ...]) -> str:
    """Return what became of a case."""
    found = [words for words in reasons if not words.startswith("This comparison does not see")]
    said = " ".join(found)
    undecided = re.search(r"does not tell|cannot be told|tells neither", said)
    if re.search(case.words, said) or ("across" in name and undecided):
        return "undecided" if undecided and case.words in (SOURCE, DIFFUSER) else "told"
    if case.words == DRIFT and "any drift of the lamp" in reasons[-1]:
        return "unseen"
    return "nothing" if "still serves" in said and len(found) == 1 else "other"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", help="part of a case's name")
    parser.add_argument("--kind", nargs="+", choices=["smooth", "lenslets"], default=["smooth", "lenslets"])
    parser.add_argument("--words", action="store_true", help="print what was said, too")
    arguments = parser.parse_args()
    kinds = {
        "smooth": {},
        "lenslets": {"diffuser": "random_microlens", "lenslet_um": 200.0, "focal_length_um": 8000.0},
    }
    kinds = {kind: options for kind, options in kinds.items() if kind in arguments.kind}
    cases = {name: case for name, case in CASES.items() if arguments.only in name}
    rows: dict[str, list[str]] = {name: [] for name in cases}
    for kind, options in kinds.items():
        cameras = {(): Camera(**options)}
        for depths_um in (DEPTHS_UM, DEPTHS_UM[1:2]):
            before = calibration(cameras[()], CASES["nothing"], depths_um, 1)
            for number, (name, case) in enumerate(cases.items()):
                if case.world not in cameras:
                    cameras[case.world] = Camera(**options, **dict(case.world))
                for lamp in (1.0, 0.8):
                    changed = replace(case, lamp=tuple(lamp * part for part in case.lamp))  # type: ignore[arg-type]
                    after = calibration(cameras[case.world], changed, depths_um, 100 + number)
                    try:
                        reasons = compare(before, after).reasons
                    except InputError as error:
                        reasons = (str(error),)
                    rows[name].append(judged(case, name, reasons))
                    if arguments.words:
                        print(
                            f"{kind}, {len(depths_um)}, {name}, lamp {lamp}: {rows[name][-1]}:",
                            " | ".join(reasons),
                            flush=True,
                        )
    head = [f"{kind}, {n}{lamp}" for kind in kinds for n in ("3 depths", "1 depth") for lamp in ("", ", dim")]
    print("| what changed | " + " | ".join(head) + " |\n|---" + "|---" * len(head) + "|")
    for name, cells in rows.items():
        print(f"| {name} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main()
