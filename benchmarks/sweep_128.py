"""A sweep of 128 planes (Kuo 2020, Sec. 4.5): time a plane beyond exposure and motion.

    python benchmarks/sweep_128.py [--preset pco] [--average 1]

On the simulated bench without waiting (time_scale = 0): exposure and motion take no time, so what is left is
the program's own, and the simulation's. The simulation's light and sensor are timed apart and taken off; the
disk is a real one, every frame synced as in any run.
"""

from __future__ import annotations

import argparse
import platform
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from calibration_routines import AxialSweep, calibrate_sweep, expose_sweep, sweep_plan
from calibration_routines.procedure import Listener
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.plan import estimate
from instrument.runs.acquire import abilities_of
from instrument.runs.runner import RunStatus

BENCH = """
[camera]
driver = "simulated"
binning = {binning}
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "{preset}"
time_scale = 0
"""


class Stopwatch:
    """Adds up the time that a method takes."""

    def __init__(self, owner: Any, name: str) -> None:
        self.seconds = 0.0
        method = getattr(owner, name)

        def timed(*arguments: Any, **options: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(*arguments, **options)
            finally:
                self.seconds += time.perf_counter() - start

        setattr(owner, name, timed)


def main() -> None:
    """Sweep, and print where the time went."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--preset", choices=("tiny", "pco"), default="pco")
    parser.add_argument("--binning", type=int, default=2)
    parser.add_argument("--planes", type=int, default=128)
    parser.add_argument("--average", type=int, default=1)
    parser.add_argument("--folder", type=Path, help="where the run goes; default: a temporary folder")
    arguments = parser.parse_args()
    near, far = (60e3, 250e3) if arguments.preset == "tiny" else (100e3, 500e3)
    sweep = AxialSweep(
        z_min_um=near, z_max_um=far, planes=arguments.planes, average=arguments.average
    ).points()
    text = BENCH.format(preset=arguments.preset, binning=arguments.binning)
    with (
        open_bench(parse_config(text, None)) as bench,
        tempfile.TemporaryDirectory(dir=arguments.folder) as folder,
    ):
        assert bench.stage is not None
        bench.stage.home()
        world = bench.shared["simulated"]
        assert isinstance(world, SimulatedWorld)
        assert isinstance(bench.camera, SimulatedCamera)
        exposures = expose_sweep(bench, sweep)
        cost = estimate(sweep_plan(sweep, exposures.exposures_ms), abilities_of(bench, Path(folder)))
        light, sensor = Stopwatch(world, "_psf"), Stopwatch(bench.camera, "_render")
        taken = 0.0

        class Watch(Listener):
            def frame(self, status: RunStatus) -> None:
                nonlocal taken
                if status.done == status.total:
                    taken = taken or time.perf_counter()

        start = time.perf_counter()
        done = calibrate_sweep(bench, sweep, folder, exposures=exposures, listener=Watch())
        end = time.perf_counter()
        height, width = bench.camera.frame_shape[:2]
    acquisition, planes = taken - start, arguments.planes
    own = acquisition - light.seconds - sensor.seconds
    analysis = end - taken
    print(f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}, {arguments.preset} {height} x {width} pixels")
    print(
        f"{planes} planes, {cost.frames} frames, {cost.total_bytes / 1e6:.0f} MB; findings: {done.findings}"
    )
    print(f"{cost.seconds:8.1f} s  exposure and motion would take on a real bench")
    print(f"{acquisition:8.1f} s  acquisition, exposure and motion taking no time; of it")
    print(f"{light.seconds:8.1f} s    simulated light")
    print(f"{sensor.seconds:8.1f} s    simulated sensor")
    print(
        f"{own:8.1f} s    the program: {1e3 * own / cost.frames:.1f} ms a frame, "
        f"{1e3 * own / planes:.1f} a plane"
    )
    print(f"{analysis:8.1f} s  analysis and saving: {1e3 * analysis / planes:.1f} ms a plane")


if __name__ == "__main__":
    main()
