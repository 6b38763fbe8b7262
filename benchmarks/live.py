"""Live pictures: frames per second, latency and quality, with a camera that is faster than the computer.

    python benchmarks/live.py [--sizes 270x480 512x640 1024x1280] [--seconds 15] [--out live.csv]
    python benchmarks/live.py --cameras local lowrank background planes --sizes 270x480

Frames are cut from light that was computed on a grid three times finer than the sensor's, blurred there and
binned, with photon noise (see dense_2d.py): a picture larger than the field that pans for a third of the
time, by half a pixel a frame, and stands still for the rest. They come at 60 frames/s through the same stream
and thread as a real camera's. Latency is from a frame's arrival to its picture. Quality is against what
200 iterations of the exact-data ADMM make of the same frame at full resolution, in dB, the live picture
enlarged to it.

``--cameras``: other cameras than one PSF, at 200 ms a picture. Points that pan, each through a PSF of its
own place and depth (scaled and sheared, which no model knows); nine PSFs measured, ``local`` and ``lowrank``;
``background``: smooth stray light and the local model; ``planes``: eight depths.
"""

from __future__ import annotations

import argparse
import csv
import os
import platform
import sys
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np
from dense_2d import FINE, binned, caustic, dense_scene
from scipy import fft

from drivers.common.stream import FrameStream
from drivers.errors import DeviceTimeoutError
from drivers.frame import FrameMetadata
from instrument.live.live import LiveView
from recon import reconstruct
from recon.base.blocks import block_mean
from recon.base.metrics import psnr
from recon.base.threads import set_threads
from recon.reconstruction.reduction import reduced_calibration
from recon.streams.live import LiveReconstructor
from recon.streams.video import VideoSolver, stream_problem
from recon.types import Calibration, Geometry

PHOTONS = 1e4
FULL = 3000
BUDGETS_MS = {(270, 480): 33.0, (512, 640): 66.0, (1024, 1280): 125.0}


class Playback:
    """A camera that plays frames at a fixed rate; a frame nobody fetched in time is lost and counted."""

    name = "playback"
    trigger_mode = "free_run"
    exposure_ms = 5.0
    longest_wait_s = 0.1

    def __init__(self, frames: list[np.ndarray], rate: float) -> None:
        self.frames, self.rate = frames, rate
        self.frame_shape, self.frame_dtype = frames[0].shape, frames[0].dtype
        self.shown: list[tuple[int, int]] = []
        self._stopped = threading.Event()

    def computed_s(self) -> float:
        """Return the seconds that it has computed: none, its frames are there."""
        return 0.0

    def stream(self, n_buffers: int) -> FrameStream:
        """Return a stream."""
        return FrameStream(self, n_buffers)

    def start_sequence(self, n_buffers: int) -> None:
        """Begin to count time."""
        self._began_s, self._next = time.monotonic(), 0
        self._stopped.clear()

    def stop_sequence(self) -> None:
        """End."""
        self._stopped.set()

    def next_frame_into(self, buffer: np.ndarray, timeout_s: float) -> FrameMetadata:
        """Wait until the next frame is due."""
        due_s = self._began_s + self._next / self.rate
        if self._stopped.wait(max(0.0, min(timeout_s, due_s - time.monotonic()))):
            raise DeviceTimeoutError(self.name, "stopped.")
        if time.monotonic() < due_s:
            raise DeviceTimeoutError(self.name, "no frame yet.")
        number = max(self._next, int((time.monotonic() - self._began_s) * self.rate))
        buffer[...] = self.frames[number % len(self.frames)]
        dropped, self._next = number - self._next, number + 1
        height, width = self.frame_shape
        return FrameMetadata(
            number, None, time.monotonic_ns(), datetime.now(UTC), 5.0, 1.0, "Mono12", 12, 0.0,
            (0, 0, height, width), 1, dropped_before=dropped,
        )  # fmt: skip


def video(height: int, width: int, count: int):
    """Return frames and PSF: the first third pans, the rest stands still."""
    fine = (2 * FINE * height, 2 * FINE * width)
    scene = dense_scene(*fine, seed=0)
    psf = caustic(FINE * height, FINE * width, seed=1)
    psf /= psf.sum(dtype=np.float64)
    padded = np.zeros(fine, np.float32)
    padded[: FINE * height, : FINE * width] = psf
    padded = np.roll(padded, [-(FINE * (n // 2)) for n in (height, width)], (0, 1))
    light = fft.irfft2(fft.rfft2(padded, workers=2) * fft.rfft2(scene, workers=2), s=fine, workers=2)
    rng = np.random.default_rng(2)
    frames = []
    for number in range(count):
        # Half a sensor pixel a frame is one and a half fine ones.
        column = FINE * (width // 2) + int(1.5 * min(number, count // 3))
        row = FINE * (height // 2)
        clean = binned(light[row : row + FINE * height, column : column + FINE * width])
        counts = rng.poisson(clean * PHOTONS / clean.mean()) / PHOTONS * 0.3 * FULL
        frames.append(np.clip(np.round(counts), 0, 4095).astype(np.uint16))
    return frames, binned(psf).astype(np.float32)


D_UM, PITCH_UM, NEAR_UM, FAR_UM = 1000.0, 10.0, 10_000.0, 14_000.0
CAMERAS = {
    "local": {"model": "local", "estimate_background": False},
    "lowrank": {"model": "lowrank", "estimate_background": False},
    "background": {"model": "local", "estimate_background": True},
    "planes": {"model": "convolution", "estimate_background": False},
    "stack": {"model": "convolution", "estimate_background": False},
}
STACKS = {"planes": (8, FAR_UM), "stack": (32, 10_500.0)}
"""Depths, and the last: well apart, and as a z-stage steps them."""


def near(height: int, width: int, kind: str):
    """Return frames and calibration of points near the camera: the first five pan, the others stand still."""
    psf = binned(caustic(FINE * height, FINE * width, seed=1)).astype(np.float32)
    psf /= psf.sum()
    half = 0.25 * np.array([width, height])

    def cast(x_um: float, y_um: float, z_um: float) -> np.ndarray:
        size, shift = NEAR_UM / z_um, -np.array([x_um, y_um]) * D_UM / z_um / PITCH_UM
        u, v = shift / half
        matrix = np.array([[size + 0.05 * u, 0.05 * v], [0.05 * u, size - 0.05 * v]])
        centre = np.array([width // 2, height // 2])
        moved = np.column_stack([matrix, centre + shift - matrix @ centre])
        return cv2.warpAffine(psf, moved, (width, height), flags=cv2.INTER_LINEAR)

    n_depths, far_um = STACKS.get(kind, (1, NEAR_UM))
    depths = np.linspace(NEAR_UM, far_um, n_depths)
    steps = (0,) if kind in STACKS else (-1, 0, 1)
    reach = half * PITCH_UM * NEAR_UM / D_UM
    places = np.array([(i * reach[0], j * reach[1], z) for z in depths for j in steps for i in steps])
    calibration = Calibration(
        np.stack([cast(*place) for place in places])[:, None], places, geometry=Geometry(PITCH_UM, D_UM / 1e3)
    )
    rng = np.random.default_rng(2)
    points = rng.uniform(-1, 1, (100, 2)) * reach
    z = rng.uniform(NEAR_UM, far_um, 100)
    stray = 1.0 + 0.5 * np.cos(np.linspace(0, np.pi, width)) if kind == "background" else 0.0
    frames = []
    for number in range(8):
        pan_um = 0.5 * min(number, 4) * PITCH_UM * NEAR_UM / D_UM
        clean = sum(cast(x + pan_um, y, depth) for (x, y), depth in zip(points, z, strict=True))
        clean = clean + stray * clean.mean()
        counts = rng.poisson(clean * PHOTONS / clean.mean()) / PHOTONS * 0.2 * FULL
        frames.append(np.clip(np.round(counts), 0, 4095).astype(np.uint16))
    return [*frames[:5], *(frames[5:] * 4)], calibration


def run(
    height: int, width: int, seconds: float, budget_ms: float, kind: str = "one PSF"
) -> dict[str, object]:
    """Watch one size for a time; returns the figures."""
    own = kind == "one PSF"
    frames, psf = video(height, width, 45) if own else near(height, width, kind)
    camera = Playback(frames, 60.0)
    kept = {}
    live = LiveReconstructor(psf, budget_ms=budget_ms, **({} if own else CAMERAS[kind]))
    with LiveView(camera.stream(4), live) as view:
        seen = view.wait_newer(None, 120.0)
        began_s = time.monotonic()
        used = os.times()
        binnings, iterations, planes, late, words = [], [], [], 0, ""
        while time.monotonic() - began_s < seconds:
            seen = view.wait_newer(seen, 1.0) or seen
            if seen.refined:
                continue
            binnings.append(seen.picture.binning)
            iterations.append(seen.picture.iterations)
            planes.append(len(seen.picture.planes))
            late += seen.picture.work_ms > 1.5 * budget_ms
            words = seen.picture.quality
            phase = seen.metadata.frame_id % len(frames)
            for name, wanted in (("moving", 12), ("still", len(frames) - 3)):
                if abs(phase - wanted) <= 2:
                    kept[name] = (phase, seen.picture)
        elapsed_s = time.monotonic() - began_s
        now = os.times()
        status = view.status
    row: dict[str, object] = {
        "camera": kind,
        "size": f"{width} x {height}",
        "budget_ms": budget_ms,
        "pictures_per_s": round(status.pictures_per_s, 1),
        "iterated_share": round(float(np.mean(np.array(iterations) > 0)), 2),
        "latency_median_ms": round(status.latency_median_ms, 1),
        "latency_p99_ms": round(status.latency_p99_ms, 1),
        "late_share": round(late / len(binnings), 3),
        "binning": int(np.median(binnings)),
        "planes": int(np.median(planes)),
        "iterations": float(np.median(iterations)),
        "cores_used": round((now.user + now.system - used.user - used.system) / elapsed_s, 2),
        "cpu_ms_per_picture": round(
            1e3 * (now.user + now.system - used.user - used.system) / max(len(binnings), 1), 1
        ),
        "passed_over": status.passed_over,
        "words": words,
    }
    if not own:
        return row
    for name, (phase, picture) in kept.items():
        converged = reconstruct(
            frames[phase].astype(np.float32), psf, solver="admm-sensor", iterations=200, tolerance=0
        ).image
        shown = cv2.resize(picture.image, (width, height), interpolation=cv2.INTER_CUBIC)
        row[f"{name}_db"] = round(float(psnr(shown, converged)), 1)
        row[f"{name}_quality"] = picture.quality
    return row


def work(height: int, width: int, kind: str) -> None:
    """Print what a picture takes on one thread at each binning, least of five: no load of others tells."""
    frames, calibration = near(height, width, kind)
    for binning in (1, 2, 3, 4):
        reduced = reduced_calibration(calibration, binning, None)
        small = [block_mean(f[None].astype(np.float32), binning, about_axis=True)[0] for f in frames[:6]]
        fixed, step = [], []
        with VideoSolver(stream_problem(small[0], reduced, choosing=False, **CAMERAS[kind])) as solver:
            solver.next(small[0])
            for frame in small[1:]:
                began_s = time.process_time()
                solver.take(frame)
                taken_s = time.process_time()
                solver.advance(0.0)
                done_s = time.process_time()
                solver.volume()
                step.append(1e3 * (done_s - taken_s))
                fixed.append(1e3 * (time.process_time() - done_s + taken_s - began_s))
        least = min(fixed) + 2 * min(step)
        print(
            f"{kind}, binned {binning} x {binning}: an iteration {min(step):.0f} CPU ms, all else "
            f"{min(fixed):.0f}; two iterations: {1e3 / least:.1f} pictures/s on one core",
            flush=True,
        )


def main() -> None:
    """Measure each size and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", nargs="+", default=[f"{h}x{w}" for h, w in BUDGETS_MS])
    parser.add_argument("--cameras", nargs="+", default=["one PSF"], choices=["one PSF", *CAMERAS])
    parser.add_argument("--work", action="store_true", help="of other cameras, what a picture takes")
    parser.add_argument("--seconds", type=float, default=15.0)
    parser.add_argument("--budget-ms", type=float, help="time allowed a picture (by default by size)")
    parser.add_argument("--threads", type=int)
    parser.add_argument("--out", type=Path, help="also as CSV")
    options = parser.parse_args()
    if options.threads:
        set_threads(options.threads)
    when, load = datetime.now(UTC), os.getloadavg()[0]
    print(f"{when:%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}, load {load:.1f}")
    rows = []
    for size in options.sizes:
        height, width = (int(n) for n in size.split("x"))
        for kind in options.cameras:
            if options.work:
                set_threads(1)
                work(height, width, kind)
                continue
            usual_ms = BUDGETS_MS.get((height, width), 100.0) if kind == "one PSF" else 200.0
            budget_ms = options.budget_ms or usual_ms
            rows.append(run(height, width, options.seconds, budget_ms, kind))
            print(rows[-1], flush=True)
    if options.out:
        with options.out.open("w", newline="") as file:
            writer = csv.DictWriter(file, list(dict.fromkeys(k for row in rows for k in row)))
            writer.writeheader()
            writer.writerows(rows)


if __name__ == "__main__":
    sys.exit(main())
