"""Registration of PSFs against the truth: error from 0 to 30 degrees on the simulated bench.

    python benchmarks/registration.py [--out docs/images/registration.png]

The PCO prototype (Kuo 2020, Ch. 4) with 2 x 2 binning on the camera and 2 x 2 on the computer, its default
noise, exposures found automatically, four frames a PSF. The point source is carried to random places at 300
mm; the truth is where it really was (the simulated stage misses its target a little), not what the stage
said. Frames come through the drivers; light by wave optics.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibration_routines import PointSweep, expose_sweep
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from recon.base.blocks import block_mean
from recon.camera.registration import expected_shift, register

BENCH = """
[camera]
driver = "simulated"
binning = 2
[stage]
driver = "simulated"
axes = {{ x_um = {{ lower_limit = -{reach}, upper_limit = {reach} }}, y_um = {{ lower_limit = -{reach}, upper_limit = {reach} }} }}
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "pco"
time_scale = 0
seed = {seed}
"""  # noqa: E501 - one line is what TOML's inline tables allow
Z_UM = 300e3
BINS_DEG = ((0, 5), (5, 10), (10, 15), (15, 20), (20, 25), (25, 30))


def measure(places_a_bin: int, seed: int) -> list[tuple[float, float, float, float]]:
    """Return ``(degrees, error against truth, error against the stage, similarity)`` of random places."""
    rng = np.random.default_rng(seed)
    reach = round(1.1 * Z_UM * np.tan(np.deg2rad(30)))
    rows = []
    with open_bench(parse_config(BENCH.format(reach=reach, seed=seed), None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        world = bench.shared["simulated"]
        assert isinstance(world, SimulatedWorld)
        exposures = expose_sweep(bench, PointSweep(points_um=((0.0, 0.0, Z_UM),)))
        bench.camera.set_exposure_ms(exposures.exposures_ms[0])
        pitch_um = 2 * bench.camera.pixel_pitch_um * bench.camera.binning
        bench.source_off()
        dark = bench.snap(8).image
        bench.source_on()

        def psf_at(x_um: float, y_um: float) -> tuple[np.ndarray, tuple[float, float, float]]:
            bench.place_source(x_um, y_um, Z_UM)
            true = world.source_position_um
            return block_mean(bench.snap(4).image.astype(np.float32) - dark, 2), true

        reference, origin = psf_at(0.0, 0.0)
        for low, high in BINS_DEG:
            for _ in range(places_a_bin):
                angle, azimuth = rng.uniform(low, high), rng.uniform(0, 2 * np.pi)
                radius = Z_UM * np.tan(np.deg2rad(angle))
                said = (radius * np.cos(azimuth), radius * np.sin(azimuth), Z_UM)
                image, true = psf_at(said[0], said[1])
                found = register(image, reference)
                errors = []
                for here, there in ((true, origin), (said, (0.0, 0.0, Z_UM))):
                    shifts = [np.array(expected_shift(p, world.distance_um, pitch_um)) for p in (here, there)]
                    error = np.array([found.rows, found.columns]) - (shifts[0] - shifts[1])
                    errors.append(float(np.hypot(*error)))
                rows.append((float(angle), errors[0], errors[1], found.similarity))
    return rows


def main() -> None:
    """Measure, print the table, draw the picture."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--places", type=int, default=10, help="a bin of 5 degrees")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(tempfile.gettempdir()) / "registration.png")
    arguments = parser.parse_args()
    start = time.perf_counter()
    rows = np.array(measure(arguments.places, arguments.seed))
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {time.perf_counter() - start:.0f} s")
    print("degrees   against truth: median  95 %   against the stage: median  95 %   similarity")
    for low, high in (*BINS_DEG, (0, 15), (15, 30)):
        here = rows[(rows[:, 0] >= low) & (rows[:, 0] < high)]
        truth, stage = (np.quantile(here[:, k], [0.5, 0.95]) for k in (1, 2))
        print(
            f"{low:3d}-{high:<3d}   {truth[0]:21.3f} {truth[1]:5.3f}   {stage[0]:25.3f} {stage[1]:5.3f}"
            f"   {np.median(here[:, 3]):10.2f}"
        )
    _draw(rows, arguments.out)


def _draw(rows: np.ndarray, out: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(rows[:, 0], rows[:, 1], ".", color="#00798c", label="error against the truth")
    axes.axhline(0.1, color="#d1495b", lw=1, label="0.1 pixel")
    axes.set(xlabel="angle of the source, degrees", ylabel="pixels", ylim=(0, None))
    twin = axes.twinx()
    twin.plot(rows[:, 0], rows[:, 3], "x", ms=4, color="#8496a5", label="similarity (right)")
    twin.set(ylabel="inner product with the central PSF", ylim=(0, 1.02))
    handles = axes.get_lines() + twin.get_lines()
    axes.legend(handles, [str(h.get_label()) for h in handles], frameon=False, loc="center left")
    axes.set_title("Registration of PSFs, PCO prototype, default noise (SIMULATED)", fontsize=10)
    figure.savefig(out, dpi=110)
    print(f"Wrote {out}")


if __name__ == "__main__":
    main()
