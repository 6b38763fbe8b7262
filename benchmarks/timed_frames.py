"""Frames a second timed by hardware and step by step, on the simulated bench; what becomes of faulty pulses.

    python benchmarks/timed_frames.py

Rates are of whole runs on the disk (simulated time runs as real time does), the light of each pattern
computed beforehand. The simulated devices obey at once; with ``start_ms`` (camera) and ``command_ms`` (LED
array) they take what real ones take. Every frame's pattern is told by its brightness, so that a frame in
another's place is seen. Faults: each sequence is played once, and the pulses that truly were sent say whether
there was a cause to give it up.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

from drivers.errors import DeviceError
from drivers.led_array import LedPattern
from drivers.simulated.wire import Wires
from instrument.bench import sequence
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config
from instrument.bench.sequence import Wire, take_sequence
from instrument.plan import Light, Part, Plan
from instrument.runs.acquire import acquire

LEVELS = (30, 60, 90, 120, 150, 180, 210, 240)


def bench_of(devices: str, wire: str, world: str) -> Bench:
    """Open a simulated bench."""
    return Bench(
        parse_config(f'[scene]\ncontrol = "simulated"\n{devices}\n[trigger]\n{wire}\n{world}', None)
    ).open()


def led_bench(
    exposure_ms: float,
    *,
    wired: bool,
    latency: str = "0 0",
    simulated: str = "time_scale = 1.0",
    pixels: int = 192,
) -> Bench:
    """Open a simulated microscope with an LED array, with what starting the camera and a command take."""
    start_ms, command_ms = latency.split()
    return bench_of(
        f"""
        [camera]
        driver = "simulated_led_microscope"
        exposure_ms = {exposure_ms}
        frames_per_s = 200.0
        start_ms = {float(start_ms)}
        [led_array]
        driver = "simulated_led_microscope"
        command_ms = {float(command_ms)}
        """,
        'sent_by = "led_array"' if wired else "",
        f"[simulated_led_microscope]\npixels = {pixels}\nlight = 4e5\n{simulated}",
    )


def lights(count: int) -> tuple[Light, ...]:
    """Return lights of different brightness, in turn."""
    return tuple(Light(kind="pattern", description=f"level {n}", leds=((0, n, n, n),)) for n in LEVELS) * (
        count // len(LEVELS)
    )


def frames_a_second(bench: Bench, plan: Plan, folder: Path) -> tuple[float, Any]:
    """Return the rate of a whole run, and the run."""
    acquire(bench, plan, folder)  # the light of each pattern is computed now
    began_s = time.perf_counter()
    run = acquire(bench, plan, folder)
    return len(plan) / (time.perf_counter() - began_s), run


def strange(light: Any) -> int:
    """Return how many frames have not the brightness of their pattern."""
    wanted = np.resize(LEVELS, len(light)).astype(float)
    light = (light - light.min()) / (light.max() - light.min())
    wanted = (wanted - wanted.min()) / (wanted.max() - wanted.min())
    return int(np.count_nonzero(abs(light - wanted) > 0.07))


def rates(folder: Path, count: int) -> None:
    """Print rates stepped and timed."""
    print(f"{f'{count} frames: exposure, delays':<46}{'stepped':>10}{'timed':>10}{'ratio':>8}   wrong places")
    for latency in ("0 0", "30 5", "100 5"):
        for exposure_ms in (2.0, 20.0):
            found = []
            for wired in (False, True):
                with led_bench(exposure_ms, wired=wired, latency=latency) as bench:
                    plan = Plan(label="led", parts=(Part(label="lit", light=lights(count)),))
                    found.append(frames_a_second(bench, plan, folder))
            _line(f"LED array, {exposure_ms:g} ms, start {' and command '.join(latency.split())} ms", found)


def _line(name: str, found: list[tuple[float, Any]]) -> None:
    (stepped, _), (timed, run) = found
    wrong = strange(run.images("lit").mean(axis=(1, 2), dtype=float))
    print(f"{name:<46}{stepped:>10.1f}{timed:>10.1f}{timed / stepped:>8.1f}   {wrong}", flush=True)


def faults(plays: int) -> None:
    """Play sequences over faulty wires, and look at every frame that is kept."""
    print(
        f"\n{'fault':<28}{'played':>8}{'pulses wrong':>14}{'given up':>10}{'without cause':>15}"
        f"{'in a wrong place':>18}"
    )
    patterns = [LedPattern(f"{n}", ((0, (n, n, n)),)) for n in LEVELS * 4]
    for name, simulated in (
        ("none", ""),
        ("jitter 50 us", "pulse_jitter_us = 50.0"),
        ("jitter 1 ms", "pulse_jitter_us = 1000.0"),
        ("1 % of pulses missed", "missed_pulses = 0.01"),
        ("1 % extra pulses", "extra_pulses = 0.01"),
        ("2 % missed and 2 % extra", "missed_pulses = 0.02\nextra_pulses = 0.02"),
    ):
        wrong, given_up, accused, misplaced = 0, 0, 0, 0
        world = f"time_scale = 0.0\n{simulated}"
        with led_bench(2.0, wired=True, simulated=world, pixels=64) as bench, watched() as came:
            wire = Wire(bench)
            for _ in range(plays):
                try:
                    frames = take_sequence(wire, patterns).frames
                except DeviceError:
                    frames = []
                at_s, period_s = came
                grid_s = np.arange(len(patterns) + wire.leads) * period_s
                faulty = len(at_s) != len(grid_s) or bool((abs(at_s - grid_s) > 0.25 * period_s).any())
                wrong += faulty
                given_up += not frames
                accused += not frames and not faulty
                if frames:
                    misplaced += strange(np.array([frame.image.mean() for frame in frames]))
        print(f"{name:<28}{plays:>8}{wrong:>14}{given_up:>10}{accused:>15}{misplaced:>18}", flush=True)


@contextmanager
def watched() -> Iterator[list[Any]]:
    """Give the pulses of the newest sequence and its period, seconds; each sequence is played once."""
    came: list[Any] = []
    sent = Wires._pulses

    def pulses(self: Wires, count: int, period_s: float, settle_s: float) -> Any:
        came[:] = [sent(self, count, period_s, settle_s), period_s]
        return came[0]

    with patch.object(Wires, "_pulses", pulses), patch.object(sequence, "ATTEMPTS", 1):
        yield came


def main() -> None:
    """Run both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=160)
    parser.add_argument("--plays", type=int, default=100)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        rates(Path(folder), asked.frames)
    faults(asked.plays)


if __name__ == "__main__":
    main()
