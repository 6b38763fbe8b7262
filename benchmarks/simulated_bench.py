"""The simulated bench: seconds for a PSF and a photograph, PSFs against angle, and a page of pictures.

python benchmarks/simulated_bench.py [--out docs/images/simulated-bench.png]
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array
from recon.optics.grid import PixelGrid, mixed_spectrum
from recon.optics.scene import Scene
from recon.optics.sensor import Readout, expose

GREEN = (0.0, 1.0, 0.0)
WHITE = (1.0, 1.0, 1.0)
ANGLES_DEG = (5, 10, 15, 20, 25, 30)


def world(preset: str) -> SimulatedWorld:
    """Build the simulated world of a preset."""
    return SimulatedWorld(WorldOptions.model_validate({"preset": preset, "time_scale": 0.0}))


def timed(name: str, function: object, *arguments: object) -> Float32Array:
    """Call and print how long it took."""
    wall, cpu = time.perf_counter(), time.process_time()
    result: Float32Array = function(*arguments)  # type: ignore[operator]
    print(f"{name:48} {time.perf_counter() - wall:7.2f} s wall {time.process_time() - cpu:7.2f} s CPU")
    return result


def similarity_with_angle(bench: SimulatedWorld, z_um: float) -> list[float]:
    """Inner product with the on-axis PSF at its best registration (Kuo 2020, Fig. 5.1d)."""
    grid = bench.sensor_grid(2)
    half_y, half_x = bench.propagator.half_extent_um(z_um)
    shape = (2 * int(half_y / grid.pitch_um), 2 * int(half_x / grid.pitch_um))
    spectra = []
    for angle in (0, *ANGLES_DEG):
        x = float(np.tan(np.deg2rad(angle)) * z_um)
        place = PixelGrid(shape, grid.pitch_um, (-x * bench.distance_um / z_um, 0.0))
        psf = bench.propagator.psf(
            (x, 0.0, z_um), place, mixed_spectrum(GREEN, 1), diameter_um=bench.source_diameter_um
        )
        spectra.append(np.fft.rfft2(psf / np.linalg.norm(psf)))
    return [float(np.fft.irfft2(spectrum * spectra[0].conj(), shape).max()) for spectrum in spectra[1:]]


def contrast(image: Float32Array) -> Float32Array:
    """Stretch as in Fig. A.2: from 0 to 30 % of the maximum (99.99th percentile)."""
    return np.clip(image / (0.3 * np.quantile(image, 0.9999)), 0, 1)


def main() -> None:
    """Measure, print, draw."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=None, help="where to put the page of pictures")
    out: Path | None = parser.parse_args().out
    pco = world("pco")
    timed("pco: compile, make the diffuser, first PSF", pco.psf, (0.0, 0.0, 3e5), GREEN, 2)
    far = timed("pco, 2x2 binned: PSF at 300 mm, one colour", pco.psf, (10.0, 0.0, 3e5), GREEN, 2)
    timed("pco, 2x2 binned: PSF at 300 mm, white", pco.psf, (10.0, 0.0, 3e5), WHITE, 2)
    near = timed("pco, 2x2 binned: PSF at 12 mm, one colour", pco.psf, (0.0, 0.0, 12e3), GREEN, 2)
    pco.scene_lit = True
    light = timed("pco, 2x2 binned: photograph of the picture", pco.photons_per_s, WHITE, 2)
    timed("pco, whole sensor: photograph of the picture", pco.photons_per_s, WHITE)
    assert pco.scene is not None
    layer = pco.scene.layers[0]
    pco.set_scene(Scene("negative", (replace(layer, radiance=1 - layer.radiance),)))
    timed("pco, whole sensor: another picture in its place", pco.photons_per_s, WHITE)
    pattern = pco.fixed_pattern().binned(2)
    readout = Readout(0.46, 1.0, 100.0, 65535, 120_000.0, 3.0)
    exposure_s = 20_000 / float(light.max())
    raw = expose(light, pattern, exposure_s, readout, 1)
    frame = timed("pco, 2x2 binned: noise of one frame", expose, light, pattern, exposure_s, readout, 2)
    print("pco: similarity of PSFs with angle (Fig. 5.1d), source at 1 m:")
    for angle, value in zip(ANGLES_DEG, similarity_with_angle(pco, 1e6), strict=True):
        print(f"    {angle:2d} degrees  {value:.3f}")

    microscope = world("microscope")
    timed("microscope: compile, make the diffuser, first PSF", microscope.psf, (0.0, 0.0, 2.5e3), GREEN, 2)
    axis = timed("microscope, 2x2 binned: PSF on axis", microscope.psf, (1.0, 0.0, 2.5e3), GREEN, 2)
    oblique = timed("microscope, 2x2 binned: PSF off axis", microscope.psf, (500.0, 0.0, 2.5e3), GREEN, 2)
    tiny = world("tiny")
    tiny.psf((0.0, 0.0, 1e5), GREEN)
    timed("tiny: PSF, one colour", tiny.psf, (1.0, 0.0, 1e5), GREEN)
    tiny.scene_lit = True
    timed("tiny: photograph of the picture", tiny.photons_per_s, WHITE)

    if out is None:
        return
    panels = [
        ("pco, source at 300 mm", contrast(far)),
        ("pco, source at 12 mm", contrast(near)),
        ("microscope, bead on axis", contrast(axis)),
        ("microscope, bead 0.5 mm off axis", contrast(oblique)),
        ("pco, raw frame of the picture", np.asarray(raw, np.float32) / frame.max()),
        ("its ground truth, on the sensor's grid", pco.ground_truth(raw.shape, 13.0)),
    ]
    figure = Figure(figsize=(9, 10.5), layout="constrained")
    for place, (title, image) in zip(figure.subplots(3, 2).ravel(), panels, strict=True):
        place.imshow(image, cmap="magma" if "source" in title or "bead" in title else "gray")
        place.set_title(f"SIMULATED: {title}", fontsize=9)
        place.set_axis_off()
    figure.savefig(out, dpi=80)
    print(f"pictures in {out}")


if __name__ == "__main__":
    main()
