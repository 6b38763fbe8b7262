"""The same reconstructions on CPU and GPU: seconds an iteration, memory, agreement, what size it takes.

    python benchmarks/gpu.py --out docs/benchmarks/gpu.md       with a CUDA GPU and the extra [gpu]
    python benchmarks/gpu.py --numpy --sizes 32 --depths 1 4    a trial: NumPy plays the GPU's library

Pictures (``--depths 1``) and volumes by total variation and by l1 through one PSF a depth; by total variation
through nine PSFs a depth too, by the local and the low-rank model; a video's frames, each from where the one
before ended; live pictures of one frame; holograms at 4 x 4 mask pixels a pixel of the SLM. Default solvers,
a fixed number of iterations, nothing chosen and nothing judged; each case runs once before it is timed. Kinds
beside one PSF are measured up to ``--most-depths``. ``--sizes 1024 --depths 128 --only tv l1`` is a grid of
2048 x 2048 x 128. Of pictures each goes its own way to one end: they are near each other only after many
iterations (``--iterations 300``: 0.5 % at 24 x 24).
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib.util
import platform
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.volume_speed import lenslet_psfs
from recon import Calibration, Geometry, reconstruct
from recon.base.threads import get_threads
from recon.holography import Display, HologramModel, Target, compute_hologram, random_mask
from recon.reconstruction.options import ReconstructionOptions
from recon.streams.live import LiveReconstructor
from recon.streams.video import VideoSolver, stream_problem

GIB = 2**30
FRAMES = 4
"""Of a video, the first of which begins cold and is not timed."""


@dataclass(frozen=True)
class Case:
    """A size, and what is seen there."""

    size: int
    depths: int
    iterations: int

    def calibration(self, psfs: int = 1) -> Calibration:
        """Return lenslets' PSFs; of several a depth each as bright as its place in the field is."""
        own = lenslet_psfs(self.size, self.depths)
        z_um = 2e4 / np.linspace(1.0, 0.6, self.depths)
        places = [(x, y) for y in range(psfs) for x in range(psfs)]
        offsets = (np.array(places, np.float64) - (psfs - 1) / 2) * 1e3
        every = [(p, z, xy) for p, z in zip(own, z_um, strict=True) for xy in offsets]
        y, x = np.mgrid[: self.size, : self.size] / self.size - 0.5
        stack = [p * np.exp(1e-3 * (xy[0] * x + xy[1] * y)).astype(np.float32) for p, _, xy in every]
        return Calibration(
            np.stack(stack),
            np.array([(*xy, z) for _, z, xy in every]),
            geometry=Geometry(10.0, 5.0, None),
        )

    @property
    def image(self) -> np.ndarray:
        """A photograph of thirty points."""
        psfs, rng = lenslet_psfs(self.size, self.depths), np.random.default_rng(1)
        shifts = rng.integers(-self.size // 5, self.size // 5 + 1, (30, 2))
        light = sum(np.roll(psfs[k % self.depths, 0], tuple(way), (0, 1)) for k, way in enumerate(shifts))
        return rng.poisson(100 * light).astype(np.float32)


Solved = tuple[np.ndarray, float, str]
"""What came out, seconds an iteration, and the solver."""


def still(case: Case, device: str, prior: str, model: str) -> Solved:
    """Reconstruct a photograph."""
    asked: dict[str, Any] = {"prior": prior, "model": model, "noise": 1.0, "tolerance": 0.0, "device": device}
    asked |= {"estimate_background": False, "drop_empty": False, "judged": False}
    calibration = case.calibration(1 if model == "convolution" else 3)
    for count in (1, case.iterations):  # the first compiles, and plans transforms
        found = reconstruct(case.image, calibration, iterations=count, **asked)
    return found.volume, found.seconds / case.iterations, found.solver


def film(case: Case, device: str) -> Solved:
    """Solve frames of a scene that stands."""
    options = ReconstructionOptions(model="convolution", drop_empty=False, device=device)
    frame = case.image
    problem = stream_problem(frame, case.calibration(), options, choosing=False, noise=1.0)
    with VideoSolver(problem, cold_iterations=case.iterations, warm_iterations=case.iterations) as solver:
        solver.next(frame)
        began = time.perf_counter()
        for _ in range(FRAMES):
            found = solver.next(frame)
        each = (time.perf_counter() - began) / FRAMES / case.iterations
        return np.asarray(found), each, problem.solver.name


def live(case: Case, device: str) -> Solved:
    """Make live pictures of one frame, as many as have so many iterations; a tenth of a second for each."""
    maker = LiveReconstructor(case.calibration(), device=device, budget_ms=100.0, noise=1.0)
    frame = case.image
    maker.feed(frame)
    while (found := maker.refine()) is None or not found.total_iterations:
        found = maker.feed(frame)
    before, began = found.total_iterations, time.perf_counter()
    while (done := found.total_iterations - before) < case.iterations:
        newer = maker.refine()
        if newer is None:  # nothing more to gain
            break
        found = newer
    return found.image, (time.perf_counter() - began) / max(done, 1), f"binned {found.binning}"


def hologram(case: Case, device: str) -> Solved:
    """Compute a hologram through a mask of four pixels along each side of the SLM's; its iterations."""
    slm = case.size, case.size
    display = Display(slm, random_mask((4 * case.size, 4 * case.size), seed=1))
    model = HologramModel(display, [Target(case.image)], device=device)
    for count in (1, case.iterations):
        found = compute_hologram(model, iterations=count, tolerance=0.0)
    return model.seen(found.slm), found.seconds / case.iterations, "lbfgs"


KINDS: dict[str, Callable[[Case, str], Solved]] = {
    "tv": lambda case, device: still(case, device, "tv", "convolution"),
    "l1": lambda case, device: still(case, device, "l1", "convolution"),
    "local": lambda case, device: still(case, device, "tv", "local"),
    "lowrank": lambda case, device: still(case, device, "tv", "lowrank"),
    "video": film,
    "live": live,
    "hologram": hologram,
}


def row(kind: str, case: Case, *, played: bool) -> tuple[str, float]:
    """Return a line of the table, and how many times faster the GPU is."""
    with contextlib.ExitStack() as stack:
        cpu = KINDS[kind](case, "cpu")
        if played:
            from tests.device import played as played_device

            stack.enter_context(played_device())
        gpu = KINDS[kind](case, "gpu")
    same = gpu[0].shape == cpu[0].shape  # live pictures may have other pixels
    apart = float(np.linalg.norm(gpu[0] - cpu[0]) / max(np.linalg.norm(cpu[0]), 1e-30)) if same else np.nan
    memory = "" if played else f"{_pool_bytes() / GIB:.2f}"
    times = cpu[1] / max(gpu[1], 1e-9)
    size = f"{case.size} x {case.size} x {case.depths}"
    solvers = ", ".join(dict.fromkeys((cpu[2], gpu[2])))
    words = f"| {kind}, {solvers} | {size} | {cpu[1]:.4f} | {gpu[1]:.4f} | {times:.1f} "
    return words + f"| {apart:.0e} | {memory} |", times


def _pool_bytes() -> int:
    import cupy

    pool = cupy.get_default_memory_pool()
    held = int(pool.total_bytes())
    pool.free_all_blocks()
    return held


def _device(*, played: bool) -> str:
    if played:
        return "NumPy in place of a GPU: times are not a GPU's"
    import cupy

    return str(cupy.cuda.runtime.getDeviceProperties(0)["name"].decode())


def page(a: argparse.Namespace) -> str:
    """Return the page."""
    asked = f"--sizes {' '.join(map(str, a.sizes))} --depths {' '.join(map(str, a.depths))}"
    lines = [
        "# CPU and GPU",
        "",
        f"{datetime.date.today()}, {platform.machine()}, {get_threads()} threads; {_device(played=a.numpy)}. "
        f"`python benchmarks/gpu.py {asked}`",
        "",
        "| what, solvers | sensor x depths | CPU, s an iteration | GPU | times | apart | memory, GiB |",
        "|---|---|---|---|---|---|---|",
    ]
    faster: dict[tuple[str, int], list[int]] = {}
    for kind in a.only or KINDS:
        most = {"tv": max(a.depths), "l1": max(a.depths), "hologram": 1}.get(kind, a.most_depths)
        for n in sorted({min(n, most) for n in a.depths}):
            for size in a.sizes:
                line, times = row(kind, Case(size, n, a.iterations), played=a.numpy)
                print(line, flush=True)
                lines.append(line)
                faster.setdefault((kind, n), []).extend([size] if times > 1 else [])
    lines.append("")
    for (kind, n), won in faster.items():
        said = f"from {min(won)} x {min(won)} on" if won else "at none of these sizes"
        lines.append(f"* {kind}, {n} depth{'s' * (n > 1)}: the GPU is faster {said}.")
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, and write the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--sizes", type=int, nargs="+", default=[64, 128, 256, 512], help="of the sensor, pixels"
    )
    parser.add_argument("--depths", type=int, nargs="+", default=[1, 32, 128])
    parser.add_argument("--most-depths", type=int, default=32, help="of other kinds than tv and l1")
    parser.add_argument("--only", nargs="+", choices=KINDS, help="these kinds")
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--numpy", action="store_true", help="NumPy plays the GPU's library")
    parser.add_argument("--out", type=Path, help="the page")
    a = parser.parse_args(arguments)
    if not a.numpy and importlib.util.find_spec("cupy") is None:
        parser.error(
            "cupy is not installed: pip install 'diffuserbench[gpu]', or --numpy to try the command."
        )
    written = page(a)
    if a.out is None:
        print(written)
    else:
        a.out.write_text(written)


if __name__ == "__main__":
    main()
