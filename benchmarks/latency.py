"""How soon a frame can be seen after its exposure, and how soon STOP comes through, on the simulated bench.

    python benchmarks/latency.py

Frames: from the end of the exposure (the simulated camera's own clock, which is the host's) to the moment at
which a live view that waits for the newest frame has it. STOP: from the call of ``Runner.stop`` to its
return, when the light is off and nothing moves, during moves of minutes and exposures of seconds.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import threading
import time

import numpy as np

from drivers.frame import Frame
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.plan import Part, Plan, StagePoints
from instrument.runs.acquire import prepare
from instrument.runs.runner import RunStatus

BENCH = """
[bench]
name = "latency benchmark"
[camera]
driver = "simulated"
roi = [0, 0, 1024, 1280]
exposure_ms = 0.5
replay_frames = 8
frames_per_s = 60
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "pco"
"""


def frame_latencies_ms(bench: Bench, seconds: float) -> np.ndarray:
    """Return, for each frame that a waiting live view saw, the time since its exposure's end."""
    latencies: list[float] = []
    with bench.camera.stream() as stream:
        seen: Frame | None = None
        until_s = time.monotonic() + seconds
        while time.monotonic() < until_s:
            newest = stream.wait_newer(seen, 1.0)
            now_ns = time.monotonic_ns()
            if newest is not None and newest.metadata.device_time_ns is not None:
                latencies.append((now_ns - newest.metadata.device_time_ns) / 1e6)
                seen = newest
    return np.array(latencies[10:])


def stop_ms(bench: Bench, plan: Plan, folder: str, after_s: float) -> float:
    """Return how long STOP took, ``after_s`` into a step that would last much longer."""
    begun = threading.Event()

    def report(status: RunStatus) -> None:
        if status.step is not None:
            begun.set()

    runner = prepare(bench, plan, folder, on_progress=report)
    thread = threading.Thread(target=runner.execute)
    thread.start()
    begun.wait(60)
    time.sleep(after_s)
    began_s = time.perf_counter()
    runner.stop()
    took_ms = 1e3 * (time.perf_counter() - began_s)
    thread.join()
    assert bench.led_array is not None
    assert bench.stage is not None
    assert bench.led_array.pattern.is_dark
    assert not bench.stage.is_moving
    return took_ms


def _said(values: np.ndarray) -> str:
    return (
        f"median {np.median(values):.2f} ms, 99th percentile {np.percentile(values, 99):.2f} ms, "
        f"largest {values.max():.2f} ms of {len(values)}"
    )


def main() -> None:
    """Run the benchmark as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="of the stream")
    parser.add_argument("--stops", type=int, default=20, help="of each kind")
    options = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with open_bench(parse_config(BENCH, None)) as bench, tempfile.TemporaryDirectory() as folder:
        bench.camera.snap()
        print(f"frame to live view: {_said(frame_latencies_ms(bench, options.seconds))}")
        assert bench.stage is not None
        bench.stage.home()
        low, high = bench.stage.limits["x_um"]
        far = StagePoints(points=({"x_um": low}, {"x_um": high}) * 50)
        move = Plan(label="move", parts=(Part(label="a", light=("source",), positions=far),))
        expose = Plan(label="expose", parts=(Part(label="a", light=("source",), exposures_ms=(5000,)),))
        for name, plan in (("a move", move), ("an exposure", expose)):
            rng = np.random.default_rng(0)
            took = [stop_ms(bench, plan, folder, rng.uniform(0.05, 0.4)) for _ in range(options.stops)]
            print(f"STOP during {name}: {_said(np.array(took))}")


if __name__ == "__main__":
    main()
