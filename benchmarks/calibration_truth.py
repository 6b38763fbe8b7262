"""Angular response and diffuser surface as measured on the simulated bench, against the truth.

    python benchmarks/calibration_truth.py angular [--step 5]      PCO prototype, up to 45 degrees
    python benchmarks/calibration_truth.py dpc [--seeds 3]         0.5 degree diffuser, NA 0.1, 4x

Everything comes through the drivers with default noise; the truth is asked of the simulated world afterwards.
"""

from __future__ import annotations

import argparse
import tempfile
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from calibration_routines.optics.angular import AngularProcedure, AngularSweep, farthest_um
from calibration_routines.optics.angular_response import AngularResponse
from calibration_routines.optics.dpc import DiffuserSurface, DpcProcedure, DpcSetup
from drivers.simulated.led_microscope import LedMicroscopeWorld
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config, template
from recon.analysis.dpc import level, slopes_deg

PCO = """
[camera]
driver = "simulated"
binning = 4
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "pco"
time_scale = 0
"""


def angular(step_deg: float) -> None:
    """Print the cut-offs and the largest error of the response."""
    with open_bench(parse_config(PCO, None)) as bench, tempfile.TemporaryDirectory() as folder:
        assert bench.stage is not None
        bench.stage.home()
        sweep = AngularSweep(farthest_um(bench, 45.0), 45.0, step_deg, average=2)
        response = AngularProcedure(sweep).carry_out(bench, Path(folder)).result
        assert isinstance(response, AngularResponse)
        world = bench.shared["simulated"]
        assert isinstance(world, SimulatedWorld)
    for name, curve, sigma in (("x", response.along_x, 23.1), ("y", response.along_y, 16.7)):
        tangents = np.tan(np.deg2rad(curve.angles_deg))
        zero = np.zeros_like(tangents)
        truth = world.fall_off(zero, tangents) if name == "x" else world.fall_off(tangents, zero)
        errors = np.abs(np.array(curve.response) - truth)
        print(
            f"along {name}: {len(errors)} angles to {max(curve.angles_deg):.1f} degrees; error of the "
            f"response {np.median(errors):.4f} (median) {errors.max():.4f} (largest); 20 % cut-off "
            f"{curve.cut_off_deg or float('nan'):.2f}, truth {sigma * np.sqrt(2 * np.log(5)):.2f} degrees"
        )


def dpc(seeds: int) -> None:
    """Print the error of height and slope for some diffusers."""
    for seed in range(seeds):
        text = template("led_microscope").replace("seed = 0", f"seed = {seed}")
        with open_bench(parse_config(text, None)) as bench, tempfile.TemporaryDirectory() as folder:
            surface = DpcProcedure(DpcSetup(0.1, 4.0)).carry_out(bench, Path(folder)).result
            assert isinstance(surface, DiffuserSurface)
            world = bench.shared["simulated_led_microscope"]
            assert isinstance(world, LedMicroscopeWorld)
            truth = level(world.true_height_um())
        error = surface.height_um - truth
        slope = slopes_deg(truth.astype(np.float32), surface.pitch_um)
        print(
            f"diffuser {seed}: height {truth.std():.3f} um rms, error {error.std():.3f} um rms "
            f"({error.std() / truth.std():.1%}), {np.quantile(np.abs(error), 0.95):.3f} um at 95 %; mean "
            f"slope {surface.figures['slope_mean_deg']:.3f}, truth {slope.mean():.3f} degrees"
        )


def main() -> None:
    """Run one of the two."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("what", choices=("angular", "dpc"))
    parser.add_argument("--step", type=float, default=5.0)
    parser.add_argument("--seeds", type=int, default=3)
    arguments = parser.parse_args()
    print(f"{datetime.now(UTC):%Y-%m-%d}")
    angular(arguments.step) if arguments.what == "angular" else dpc(arguments.seeds)


if __name__ == "__main__":
    main()
