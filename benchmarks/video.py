"""What warm starts gain in a video, and what a Dask worker costs.

    python benchmarks/video.py [--height 270] [--width 480] [--frames 32] [--planes 8] [--out FILE.json]

Scenes are made on a grid three times finer than the sensor's (see dense_2d.py): one larger than the field
that pans by 0, 1/6, 1/2 or 2 sensor pixels a frame, with photon noise of 1 %. Independent frames are solved
from zero by the same solver. For each number of warm iterations: PSNR against the truth (mean over frames,
brightness fitted), processor seconds a frame with the block's cold start included, and how many times as
long independent frames take to the same PSNR. Processor seconds of one thread: they do not depend on what
else the machine does.

The overhead of a Dask worker: the same recording in this process with one thread, and with one worker of a
local cluster once that stands, alternating; wall seconds, least of three.

What ``auto`` costs (``--only choice``): nine PSFs, beside films of several lengths; processor seconds of one
thread.

Offline rates (``--only offline``): the same on all cores, two blocks, at three sizes; wall seconds of the
second of two runs, with reading and writing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import threading
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from dense_2d import FINE, binned, caustic, dense_scene
from live import FULL, near
from scipy import fft
from scipy.ndimage import gaussian_filter

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.video import VideoRequest, prepare_video
from instrument.reconstruction.video_work import cluster, in_process, on_cluster
from recon.base.metrics import psnr
from recon.base.threads import set_threads
from recon.camera.field_registration import forget
from recon.camera.registration import rescaled
from recon.streams.video import COLD_ITERATIONS, VideoSolver, stream_problem
from recon.types import Calibration, Geometry
from tests.mocks.recordings import write_recording

PHOTONS = 1e4
SIZES = ((270, 480), (512, 640), (1024, 1280))
PANS = {"still": 0.0, "1/6 px": 0.5, "1/2 px": 1.5, "2 px": 6.0}
WARM = (1, 2, 3, 4, 6, 8, 12)
COLD = (2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 32, 40, 60)


def scenes(height: int, width: int):
    """Return the light on a fine grid, the fine scene and the PSF."""
    fine = (2 * FINE * height, 2 * FINE * width)
    scene = dense_scene(*fine, seed=0)
    psf = caustic(FINE * height, FINE * width, seed=1)
    psf /= psf.sum(dtype=np.float64)
    return cast(scene, psf), scene[None], binned(psf).astype(np.float32)


def cast(scene, psf):
    """Return the light of a scene through a PSF of half its sides."""
    padded = np.zeros(scene.shape, np.float32)
    padded[: psf.shape[0], : psf.shape[1]] = psf
    padded = np.roll(padded, [-(n // 2) for n in psf.shape], (0, 1))
    return fft.irfft2(fft.rfft2(padded) * fft.rfft2(scene), s=scene.shape)


def volume_scenes(height: int, width: int, planes: int):
    """Return the same of beads in several depths, whose patterns shrink by a third; a calibration."""
    fine, rng = (2 * FINE * height, 2 * FINE * width), np.random.default_rng(3)
    psf = caustic(FINE * height, FINE * width, seed=1)
    light, scene, psfs, depths_um = np.zeros(fine), [], [], 1e4 * np.linspace(1, 1.5, planes)
    for depth_um in depths_um:
        beads = np.zeros(fine, np.float32)
        places = tuple(rng.integers(0, n, beads.size // (4000 * planes)) for n in fine)
        beads[places] = rng.uniform(0.5, 1.5, len(places[0]))
        scene.append(gaussian_filter(beads, FINE))
        own = rescaled(psf, depth_um / depths_um[0])
        light += cast(scene[-1], own / own.sum(dtype=np.float64))
        psfs.append(binned(own / own.sum(dtype=np.float64)))
    points = np.column_stack([np.zeros((planes, 2)), depths_um])
    calibration = Calibration(
        np.stack(psfs)[:, None].astype(np.float32), points, geometry=Geometry(10.0, 1.0)
    )
    return light, np.stack(scene), calibration


def panned(light, scene, height: int, width: int, pan: float, count: int):
    """Return noisy frames and their truths."""
    rng = np.random.default_rng(2)
    frames, truths = [], []
    for number in range(count):
        column, row = FINE * (width // 2) + round(pan * number), FINE * (height // 2)
        window = np.s_[row : row + FINE * height, column : column + FINE * width]
        clean = binned(light[window])
        counts = rng.poisson(clean * PHOTONS / clean.mean()) / PHOTONS * clean.mean()
        frames.append(counts.astype(np.float32))
        truths.append(np.stack([binned(plane[window]) for plane in scene]).squeeze())
    return frames, truths


def quality(picture, truth) -> float:
    """PSNR with the brightness fitted."""
    gain = float(np.vdot(picture, truth) / np.vdot(picture, picture))
    return float(psnr(gain * picture, truth))


def independent(camera, frames, truths):
    """Return (iterations, mean PSNR, processor seconds a frame) for solves from zero."""
    solver = VideoSolver(camera)
    solver.next(frames[0])  # compiles
    found = {count: [0.0, 0.0] for count in COLD}
    for frame, truth in zip(frames, truths, strict=True):
        began_s = time.process_time()
        solver.begin()
        solver.take(frame)
        seconds = time.process_time() - began_s
        for count in range(1, COLD[-1] + 1):
            began_s = time.process_time()
            solver.advance(0.0)
            seconds += time.process_time() - began_s
            if count in found:
                found[count][0] += quality(solver.picture(), truth) / len(frames)
                found[count][1] += seconds / len(frames)
    return [(count, *values) for count, values in found.items()]


def warm(camera, frames, truths, iterations: int) -> tuple[float, float]:
    """Return mean PSNR and processor seconds a frame of a block."""
    solver = VideoSolver(camera, warm_iterations=iterations)
    total, seconds = 0.0, 0.0
    for frame, truth in zip(frames, truths, strict=True):
        began_s = time.process_time()
        picture = solver.next(frame)
        seconds += time.process_time() - began_s
        total += quality(picture, truth)
    return total / len(frames), seconds / len(frames)


def seconds_to(curve, wanted: float) -> float:
    """Return the processor seconds at which independent frames reach a PSNR; infinite if they do not."""
    best, before = -np.inf, None
    for _, reached, seconds in curve:
        if reached >= wanted:
            if before is None:
                return seconds
            share = (wanted - before[0]) / (reached - before[0])
            return before[1] + share * (seconds - before[1])
        if reached > best:
            best, before = reached, (reached, seconds)
    return np.inf


def overhead(psf, frames) -> dict[str, float]:
    """Return seconds in this process and with one worker."""
    seconds: dict[str, list[float]] = {"process": [], "worker": []}
    with tempfile.TemporaryDirectory() as name, cluster(workers=1) as client:
        folder = Path(name)
        np.save(folder / "psf.npy", psf)
        top = max(float(f.max()) for f in frames)
        run = write_recording(folder, {i: np.round(4000 * f / top) for i, f in enumerate(frames)})
        for turn in range(4):
            for kind, times in seconds.items():
                out = folder / f"{kind}{turn}.ome.zarr"
                request = VideoRequest(
                    run=run,
                    out=out,
                    psf=folder / "psf.npy",
                    inputs=InputOptions(dark=0.0, binning=1),
                    video=VideoOptions(block=8),
                )
                job = prepare_video(request).job
                blocks = list(range(len(job.blocks)))
                began_s = time.perf_counter()
                if kind == "process":
                    in_process(job.folder, out, blocks, lambda _: None, threading.Event())
                else:
                    on_cluster(client, job.folder, out, blocks, lambda _: None, threading.Event())
                if turn:  # the first compiles
                    times.append(time.perf_counter() - began_s)
    least = {kind: min(times) for kind, times in seconds.items()}
    return {**least, "overhead": least["worker"] / least["process"] - 1}


def offline(psf, frames) -> float:
    """Return frames a second on all cores, a block for each."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        np.save(folder / "psf.npy", psf)
        top = max(float(f.max()) for f in frames)
        run = write_recording(folder, {i: np.round(4000 * f / top) for i, f in enumerate(frames)})
        for turn in range(2):
            out = folder / f"{turn}.ome.zarr"
            request = VideoRequest(
                run=run,
                out=out,
                psf=folder / "psf.npy",
                inputs=InputOptions(dark=0.0, binning=1),
                video=VideoOptions(block=len(frames) // 2),
            )
            job = prepare_video(request).job
            began_s = time.perf_counter()
            in_process(job.folder, out, list(range(len(job.blocks))), lambda _: None, threading.Event())
    return len(frames) / (time.perf_counter() - began_s)


def choice(height: int, width: int) -> None:
    """Print what ``auto`` costs beside a film, through nine PSFs: of one frame, a block and longer films."""
    for kind in ("local", "background"):
        seen, calibration = near(height, width, kind)
        frames = [frame.astype(np.float32) for frame in seen[:5]]
        known = {"noise": float(np.sqrt(np.mean(frames[0]) * 0.2 * FULL / PHOTONS)), "prior": "tv"}
        for _ in range(2):  # the first compiles
            forget()
            began_s = time.process_time()
            problem = stream_problem(frames[0], calibration, others=frames[1:], **known)
            took = time.process_time() - began_s
        settled = {"model": problem.model, "estimate_background": problem.options.estimate_background}
        forget()  # solving needs the PSFs registered, too
        began_s = time.process_time()
        stream_problem(frames[0], calibration, **settled, **known)
        choosing = took - (time.process_time() - began_s)
        solver, times = VideoSolver(problem), []
        for number in range(9):
            began_s = time.process_time()
            solver.next(frames[number % len(frames)])
            times.append(time.process_time() - began_s)
        cold, warm_s = times[0], float(np.median(times[1:]))
        print(f"{width} x {height}, {kind}: {problem.reason}")
        print(
            f"  choosing {choosing:.1f} CPU s, cold {cold:.2f}, warm {warm_s:.3f} s a frame; of a film of",
            end="",
        )
        for count in (16, 32, 64, 100, 200, 500):
            film = count * warm_s + -(-count // 32) * (cold - warm_s)
            print(f" {count}: {choosing / (film + took):.1%}", end="")
        print(flush=True)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--height", type=int, default=270)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--frames", type=int, default=32)
    parser.add_argument("--planes", type=int, default=1, help="beads in so many depths instead of a picture")
    parser.add_argument("--prior", default="tv")
    parser.add_argument("--pans", nargs="+", choices=list(PANS), default=list(PANS))
    parser.add_argument("--only", choices=("warm", "overhead", "offline", "choice"))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    if options.only != "offline":
        set_threads(1)
    when, load = datetime.now(UTC), os.getloadavg()[0]
    print(f"{when:%Y-%m-%d %H:%M} UTC, {os.cpu_count()} cores, {platform.machine()}, load {load:.1f}")
    if options.only == "offline":
        for height, width in SIZES:
            light, scene, psf = scenes(height, width)
            frames, _ = panned(light, scene, height, width, 0.5, options.frames)
            print(f"{width} x {height}: {offline(psf, frames):.1f} frames/s", flush=True)
        return
    height, width = options.height, options.width
    if options.only == "choice":
        choice(height, width)
        return
    known = {"prior": options.prior, "estimate_background": False, "model": "convolution"}
    several = options.planes > 1
    light, scene, psf = volume_scenes(height, width, options.planes) if several else scenes(height, width)
    result: dict[str, object] = {}
    if options.only != "overhead":
        for name, pan in [(name, PANS[name]) for name in options.pans]:
            frames, truths = panned(light, scene, height, width, pan, options.frames)
            camera = stream_problem(frames[0], psf, **known)
            curve = independent(camera, frames, truths)
            print(f"{name}: independent", [(n, round(db, 2), round(1e3 * s)) for n, db, s in curve])
            rows = []
            for iterations in WARM:
                reached, seconds = warm(camera, frames, truths, iterations)
                alone = seconds_to(curve, reached)
                rows.append((iterations, reached, seconds, alone / seconds))
                print(
                    f"  {iterations:2} warm ({COLD_ITERATIONS} cold): {reached:.2f} dB, {1e3 * seconds:.0f} "
                    f"ms a frame; independent {1e3 * alone:.0f} ms: {alone / seconds:.1f} times",
                    flush=True,
                )
            result[name] = {"independent": curve, "warm": rows}
    if options.only != "warm":
        frames, _ = panned(light, scene, height, width, 0.5, options.frames)
        result["overhead"] = overhead(psf, frames)
        print(result["overhead"])
    if options.out:
        options.out.write_text(json.dumps(result, indent=1))


if __name__ == "__main__":
    main()
