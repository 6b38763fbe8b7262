"""Draw time and memory of reconstructions against pixels, planes, PSFs, frames and threads, with slopes.

    python benchmarks/growth.py [--most 1.0] [--out growth] [--iterations 30] [--times 1]
    python benchmarks/growth.py --told            # what reconstructions say early, and what they took
    python benchmarks/growth.py --before          # memory that is said before it is taken
    python benchmarks/growth.py --explained       # what --explain says of each kind, and what all of it takes

Cases run in processes of their own on points seen through random lenslets (SIMULATED): first the
forecast that ``--explain`` gives, then the whole of it; frames and workers are those of films; holograms are
those of a picture through a scattering mask. Seconds are of the processor, of several threads by the clock,
and of workers what this program takes and what each of them does: nothing waits for a core. Written are
``growth.png`` and ``growth.csv``: seconds and memory against each size, the exponent by which they grow, what
the forecast missed, and the largest that fits into this machine's memory, straight on from the last two.
Sizes are scaled by ``--most``.
"""

from __future__ import annotations

import argparse
import csv
import ctypes
import gc
import multiprocessing
import os
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from benchmarks.growth_kinds import KINDS, made_of
from instrument.display.hologram import compute_and_judge
from instrument.display.hologram_forecast import forecast_hologram
from instrument.files import kept_times
from instrument.files.figures import ACCENT, INK, SECOND, save_figure, style
from instrument.files.images import write_image
from instrument.files.sample_images import load_sample
from instrument.reconstruction import forecast as module
from instrument.reconstruction import video_forecast, video_work
from instrument.reconstruction.forecast import forecast
from instrument.reconstruction.foretold import Foretold, Like
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.video import VideoRequest, finish_video, prepare_video, solve_video
from instrument.reconstruction.video_forecast import forecast_video, trial_of
from instrument.reconstruction.video_work import BlockReport
from recon import Calibration, Geometry, reconstruct
from recon.base.threads import set_threads
from recon.evaluation.scene import make_scene
from recon.holography import Display, HologramOptions, Target, random_mask
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.solvers.memory import GIB, MemoryMeter, available_bytes
from recon.streams.joint import OverTimeName
from tests.mocks.recordings import write_recording

BY_PROCESSOR = "GROWTH_BY_PROCESSOR"
"""In the environment of workers, which read this file as they begin, and count the processor's seconds."""
if os.environ.get(BY_PROCESSOR):
    video_work.time = SimpleNamespace(perf_counter=time.process_time)


@dataclass(frozen=True)
class Case:
    """A reconstruction: how much of everything."""

    side: int = 192
    planes: int = 1
    psfs: int = 1
    """Along each side of the field."""
    frames: int = 0
    """Of a film; 0: a photograph."""
    threads: int = 1
    workers: int = 0
    """Processes of a cluster; 0: none."""
    over_time: OverTimeName | None = None
    expansion: int = 0
    """Of a hologram, whose SLM has so many pixels along each side; 0: none."""
    again: int = 1
    """Holograms, each from where the one before ended."""


def cases(most: float) -> dict[str, list[tuple[int, Case]]]:
    """Return for each thing that grows its sizes and the cases."""
    sides = [round(n * most**0.5 / 16) * 16 for n in (128, 256, 512, 1024)]
    return {
        "pixels": [(n * n, Case(side=n)) for n in sides],
        "planes": [(n, Case(planes=n)) for n in (4, 8, 16, 32)],
        "PSFs": [(n * n, Case(side=128, psfs=n)) for n in (2, 3, 5)],
        "frames": [(n, Case(side=128, frames=n)) for n in (32, 96, 288)],
        "small films": [(n, Case(side=64, frames=n)) for n in (64, 128)],
        "frames together": [(n, Case(side=64, frames=n, over_time="tv")) for n in (32, 96)],
        "holograms": [(n * n, Case(side=n, expansion=4)) for n in (128, 256, 512)],
        "expansions": [(n, Case(side=128, expansion=n)) for n in (1, 4, 16)],
        "holograms in a row": [(n, Case(side=128, expansion=4, again=n)) for n in (1, 3)],
        "workers": [(n, Case(side=128, frames=96, workers=n)) for n in (1, 2)],
        "threads": [(n, Case(side=384, threads=n)) for n in (1, 2)],
    }


def scene(case: Case) -> tuple[np.ndarray, Calibration]:
    """Return photographs (frames, side, side) and PSFs; the values do not matter, the sizes do."""
    rng = np.random.default_rng(0)
    n, support = case.side, case.side // 3
    y, x = np.mgrid[:n, :n] - n / 2
    places, psfs = [], []
    for plane in range(case.planes):
        z_um = 2e4 / (1 - 0.4 * plane / max(case.planes - 1, 1))
        for row in range(case.psfs):
            for column in range(case.psfs):
                lenslets = np.random.default_rng(1).random((n, n)) ** 400
                inside = np.hypot(y, x) < support * (1 + 0.3 * plane / case.planes) / 2
                psfs.append((lenslets * inside).astype(np.float32)[None])
                offset = (np.array([column, row]) - (case.psfs - 1) / 2) * 1000
                places.append([*offset, z_um])
    calibration = Calibration(
        np.stack(psfs), np.array(places, np.float64), geometry=Geometry(10.0, 5.0, None)
    )
    points = (rng.random((max(case.frames, 1), n, n)) > 0.999).astype(np.float32)
    spectra = np.fft.rfft2(points) * np.fft.rfft2(np.fft.ifftshift(psfs[0][0]))
    light = np.fft.irfft2(spectra, (n, n)).clip(0)
    return rng.poisson(1000 * light / light.max() + 10).astype(np.float32), calibration


def measure(case: Case, iterations: int, foretold: bool, answer: Any) -> None:
    """Forecast a case, or run it; sends seconds (of the processor where there is one thread) and bytes."""
    if case.threads == 1:
        time.perf_counter = time.process_time  # a machine that others use too tells no other time
    set_threads(case.threads)
    photographs, calibration = scene(case)
    options = ReconstructionOptions(
        model="local" if case.psfs > 1 else "convolution",
        prior="tv" if case.planes == 1 else "l1",
        iterations=iterations,
        tolerance=0.0,
        judged=False,
    )
    small = scene(Case(side=48, planes=case.planes, psfs=case.psfs))
    reconstruct(small[0][0], small[1], options, iterations=2)  # kernels are compiled
    if foretold:
        told = forecast(Measurement(photographs[0]), calibration, options)
        answer.send((told.seconds, told.memory_bytes))
        return
    meter, began = MemoryMeter(), time.perf_counter()
    reconstruct(photographs[0], calibration, options)
    answer.send((time.perf_counter() - began, meter.peak_mib() * 2**20))


def processor_of(workers: int) -> Callable[[], float]:
    """Return what tells the processor's seconds of this program and of each of its workers to come."""
    import psutil

    own = psutil.Process()
    os.environ[BY_PROCESSOR] = "1"

    def seconds() -> float:
        used = own.cpu_times()
        theirs = used.children_user + used.children_system
        for child in own.children():
            with suppress(psutil.NoSuchProcess):
                theirs += sum(child.cpu_times()[:2])
        return float(used.user + used.system + theirs / workers)

    return seconds


def film(case: Case, foretold: bool, answer: Any) -> None:
    """Forecast a film, or make it; sends seconds of the processor, and bytes."""
    clock = processor_of(case.workers) if case.workers else time.process_time
    if case.workers:
        video_forecast.time = SimpleNamespace(perf_counter=clock)
    else:
        time.perf_counter = clock
    set_threads(case.threads)
    with TemporaryDirectory() as scratch:
        folder = Path(scratch)
        (folder / "small").mkdir()
        make_film(film_request(Case(side=48, frames=6, over_time=case.over_time), folder / "small"))
        asked = film_request(case, folder)
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)
        if foretold:
            with trial_of(asked) as trial:
                told = forecast_video(trial)
            assert told is not None
            answer.send((told.seconds, told.memory_bytes))
            return
        meter, began = MemoryMeter(), clock()
        reports = make_film(asked)
        took_s = clock() - began
        own = max(report.peak_bytes for report in reports)
        answer.send((took_s, own if case.workers else meter.peak_mib() * 2**20))


def make_film(asked: VideoRequest) -> list[BlockReport]:
    """Make a film, as the terminal does; returns what was told of its blocks."""
    prepared, reports = prepare_video(asked), list[BlockReport]()
    solve_video(prepared, reports.append, threading.Event())
    finish_video(prepared)
    return reports


def film_request(case: Case, folder: Path) -> VideoRequest:
    """Write a recording and its PSF, and return what is asked of them."""
    photographs, calibration = scene(case)
    write_image(folder / "psf.tif", calibration.psfs[0, 0])
    frames = dict(enumerate(photographs))
    return VideoRequest(
        run=write_recording(folder, frames),
        out=folder / "film.ome.zarr",
        psf=folder / "psf.tif",
        inputs=InputOptions(dark=0.0, binning=1),
        video=VideoOptions(workers=case.workers or None, over_time=case.over_time),
    )


def holograms(case: Case, foretold: bool, answer: Any) -> None:
    """Forecast holograms by default options, or compute them; sends seconds of the processor, and bytes."""
    time.perf_counter = time.process_time
    set_threads(1)
    options = HologramOptions()
    factor = round(case.expansion**0.5)
    small = Display((32, 32), random_mask((32 * factor, 32 * factor)))
    compute_and_judge(
        small, [Target(load_sample("leaves", small.mask.shape))], replace(options, iterations=2)
    )  # it is compiled
    display = Display((case.side, case.side), random_mask((case.side * factor, case.side * factor)))
    targets = [Target(load_sample("leaves", display.mask.shape))]
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    if foretold:
        told = forecast_hologram(display, targets, options, frames=case.again)
        answer.send((told.seconds, told.memory_bytes))
        return
    meter, began, slm = MemoryMeter(), time.perf_counter(), None
    for _ in range(case.again):
        slm = compute_and_judge(display, targets, options, initial=slm).hologram.slm
    answer.send((time.perf_counter() - began, meter.peak_mib() * 2**20))


def measured(case: Case, iterations: int) -> tuple[float, float, float, float]:
    """Forecast and run a case, each in a process of its own.

    Returns the seconds and bytes that it took, and those that were told.
    """
    work: Callable[..., None] = film if case.frames else holograms if case.expansion else measure
    further = () if case.frames or case.expansion else (iterations,)
    told = in_process(work, case, *further, True)
    took = in_process(work, case, *further, False)
    return took[0], took[1], told[0], told[1]


def in_process(work: Callable[..., None], *arguments: object) -> tuple[float, ...]:
    """Do what sends numbers in a process of its own."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(*arguments, theirs))
    process.start()
    theirs.close()
    numbers: tuple[float, ...] = ours.recv()
    process.join()
    return numbers


def tell_default(size: int) -> None:
    """Print what reconstructions by default options say they will take, and what they took; each twice.

    The second is told before it begins, by the first.
    """
    kept_times.in_a_window()
    with TemporaryDirectory() as folder:
        os.environ["XDG_CACHE_HOME"] = folder
        for name in ("dense-picture", "sparse-picture", "beads", "dense-volume"):
            made = make_scene(name, size=size)
            reconstruct(made.measurement, made.calibration, iterations=2)  # kernels are compiled
            for _ in range(2):
                foretold = Foretold(lambda _: None, Like(name, size))
                meter, began = MemoryMeter(), time.perf_counter()
                found = reconstruct(
                    made.measurement, made.calibration, on_progress=foretold.watch, on_stage=foretold.stage
                )
                took_s, took_bytes = time.perf_counter() - began, meter.peak_mib() * 2**20
                foretold.ended(found.stop_reasons)
                before_s, before_bytes = foretold.before or (np.nan, np.nan)
                print(
                    f"{name:<16}{len(found.history):4} iterations, {took_s:6.2f} s "
                    f"(before {before_s / took_s - 1:+.0%}, early {foretold.seconds / took_s - 1:+.0%}), "
                    f"{took_bytes / 2**20:6.1f} MiB (before {before_bytes / max(took_bytes, 1) - 1:+.0%}, "
                    f"early {foretold.memory_bytes / max(took_bytes, 1) - 1:+.0%})",
                    flush=True,
                )


def explain_or_take(kind: str, seed: int, foretold: bool, by_course: bool, answer: Any) -> None:
    """Forecast a kind, or run it, judged, by default options; sends processor seconds and bytes.

    ``by_course``: forecast by the course of the first iterations, however soon all are over.
    """
    time.perf_counter = time.process_time  # a machine that others use too tells no other time
    family, sizes, options = KINDS[kind]
    alike = {"hand": "dense-picture", "usaf": "dense-volume"}.get(family)
    small = made_of(alike or family, seed, **({} if alike else sizes) | {"size": 48})
    asked = ReconstructionOptions(**options)
    reconstruct(*small, asked, iterations=3)  # kernels are compiled
    photograph, calibration = made_of(family, seed, **sizes)
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    meter, began = MemoryMeter(), time.process_time()
    if foretold:
        if by_course:
            module.SOLVED_S = 1e-6
        told = forecast(Measurement(photograph), calibration, asked)
        cost_s, settles = time.process_time() - began, told.settles or np.nan
        answer.send((told.seconds, *told.between_s, told.memory_bytes, cost_s, settles))
        return
    found = reconstruct(photograph, calibration, asked)
    longest = max(len(history) for history in found.histories)
    answer.send((time.process_time() - began, meter.peak_mib() * 2**20, 0.0, longest))


def tell_explained(seeds: list[int], kinds: list[str], *, by_course: bool) -> None:
    """Print what is said of each kind before it, what it costs to say so, and what it takes."""
    near = ranges = within = 0
    for kind in kinds:
        for seed in seeds:
            told = in_process(explain_or_take, kind, seed, True, by_course)
            told_s, least_s, most_s, told_bytes, cost_s, settles = told
            took_s, took_bytes, _, longest = in_process(explain_or_take, kind, seed, False, by_course)
            near += abs(told_s / took_s - 1) < 0.25
            ranges += least_s < most_s
            within += least_s < most_s and least_s <= took_s <= most_s
            print(
                f"{kind:<16} {took_s:6.2f} CPU s (told {told_s / took_s - 1:+.0%}, "
                f"{least_s:.2f} to {most_s:.2f}, in {cost_s:.2f}), "
                f"{took_bytes / 2**20:6.1f} MiB (told {told_bytes / took_bytes - 1:+.0%}), "
                f"{longest:.0f} iterations (told {settles:.0f})",
                flush=True,
            )
    count = len(kinds) * len(seeds)
    print(f"within 25 %: {near} of {count}; in the range that was told: {within} of {ranges}")


def take(case: Case, prior: str, answer: Any) -> None:
    """Reconstruct; sends what was said of memory before the first iteration, and the bytes that it took."""
    set_threads(case.threads)
    options = ReconstructionOptions(
        model="local" if case.psfs > 1 else "convolution",
        prior=prior,
        iterations=14,
        tolerance=0.0,
        judged=False,
    )
    small = scene(Case(side=48, planes=case.planes, psfs=case.psfs))
    reconstruct(small[0][0], small[1], options, iterations=2)  # kernels are compiled
    (photograph,), calibration = scene(case)
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)  # what was freed is not there for the taking
    said: list[str] = []
    meter = MemoryMeter()
    reconstruct(photograph, calibration, options, on_stage=lambda _, what: said.append(what))
    number, unit = next(what for what in said if "takes about" in what).split()[-4:-2]
    answer.send((float(number) * (GIB if unit == "GiB" else 2**20), meter.peak_mib() * 2**20))


def tell_before() -> None:
    """Print what is said of memory before the first iteration, and what was taken; a process each."""
    volumes = [
        Case(side=side, planes=planes, threads=threads)
        for planes, side, threads in (
            (4, 192, 1),
            (8, 128, 1),
            (8, 192, 2),
            (16, 192, 1),
            (16, 192, 2),
            (32, 128, 2),
        )
    ]
    pictures = [Case(side=side, threads=2) for side in (192, 384, 640)]
    varying = [Case(side=side, psfs=psfs, threads=2) for side, psfs in ((128, 3), (256, 3), (192, 4))]
    varying.append(Case(side=128, planes=4, psfs=2, threads=2))
    for case in (*pictures, *varying, *volumes):
        for prior in ("tv", "l1"):
            told, took = in_process(take, case, prior)
            print(
                f"{prior:<3}{case.planes:4} planes of {case.side} x {case.side}, {case.psfs**2} PSFs, "
                f"{case.threads} threads: {took / 2**20:6.1f} MiB (told {told / took - 1:+.0%})",
                flush=True,
            )


def slope(sizes: list[int], values: list[float]) -> float:
    """Return the exponent of growth over the two largest sizes."""
    ratio = np.log(sizes[-1] / sizes[-2])
    return float(np.log(max(values[-1], 1e-9) / max(values[-2], 1e-9)) / ratio)


def main() -> None:
    """Measure all cases, print and draw them."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--most", type=float, default=1.0, help="pixels, times those of 1024 x 1024")
    parser.add_argument("--iterations", type=int, default=30)
    parser.add_argument("--times", type=int, default=1, help="how often each; medians are drawn")
    parser.add_argument("--told", action="store_true", help="only: what is told early, by default options")
    parser.add_argument("--before", action="store_true", help="only: memory said before the first iteration")
    parser.add_argument("--explained", action="store_true", help="only: what --explain says, and takes")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1], help="of --explained")
    parser.add_argument("--by-course", action="store_true", help="of --explained: nothing is solved to tell")
    parser.add_argument(
        "--only", nargs="+", help="of pixels, planes, PSFs, frames, workers ...; of --explained: kinds"
    )
    parser.add_argument("--out", type=Path, default=Path("growth"))
    options = parser.parse_args()
    if options.told:
        tell_default(96)
        return
    if options.before:
        tell_before()
        return
    if options.explained:
        kinds = [kind for kind in KINDS if not options.only or kind in options.only]
        tell_explained(options.seeds, kinds, by_course=options.by_course)
        return
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = {k: v for k, v in cases(options.most).items() if not options.only or k in options.only}
    figure = Figure(figsize=(4.2 * len(wanted), 4.4), layout="constrained")
    panels = figure.subplots(1, len(wanted), squeeze=False)[0]
    rows = []
    for axes, (what, grown) in zip(panels, wanted.items(), strict=True):
        sizes = [size for size, _ in grown]
        found = []
        for size, case in grown:
            runs = [measured(case, options.iterations) for _ in range(options.times)]
            found.append(tuple(map(float, np.median(runs, axis=0))))
            for took_s, took_bytes, told_s, told_bytes in runs:
                rows.append([what, size, took_s, told_s, took_bytes / 2**20, told_bytes / 2**20])
                print(
                    f"{what:<8}{size:>9}  {took_s:8.2f} s (forecast {told_s / took_s - 1:+.0%})  "
                    f"{took_bytes / 2**20:8.1f} MiB (forecast {told_bytes / took_bytes - 1:+.0%})",
                    flush=True,
                )
        seconds, memory = [f[0] for f in found], [f[1] for f in found]
        time_slope, memory_slope = slope(sizes, seconds), slope(sizes, memory)
        words = f"time ~ size^{time_slope:.2f}, memory ~ size^{memory_slope:.2f}"
        each = (memory[-1] - memory[-2]) / (sizes[-1] - sizes[-2])
        if memory_slope > 0.1:
            fits = sizes[-1] + (0.9 * available_bytes() - memory[-1]) / each
            words += f"; {fits:.2g} {what} fit into {available_bytes() / GIB:.0f} GiB"
        print(f"{what:<8}{words}")
        axes.loglog(sizes, seconds, "o-", color=SECOND, label="seconds")
        axes.loglog(sizes, [f[2] for f in found], "x", color=SECOND, label="forecast")
        axes.loglog(sizes, [m / 2**20 for m in memory], "s-", color=ACCENT, label="MiB")
        axes.loglog(sizes, [f[3] / 2**20 for f in found], "+", color=ACCENT, label="forecast")
        axes.set_xticks(sizes, [str(size) for size in sizes])
        axes.minorticks_off()
        style(axes, words.replace("; ", "\n").replace(", ", "\n"), what, "", title_size=9)
        axes.legend(fontsize=8, frameon=False, labelcolor=INK)
    with (options.out / "growth.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["what", "size", "seconds", "forecast_s", "mib", "forecast_mib"])
        writer.writerows(rows)
    figure.suptitle(f"{options.iterations} iterations, SIMULATED", fontsize=10, color=INK)
    save_figure(figure, options.out / "growth.png")


if __name__ == "__main__":
    main()
