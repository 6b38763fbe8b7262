"""The same reconstructions on CPU and GPU: seconds an iteration, memory, agreement, what size it takes.

    python benchmarks/gpu.py --out docs/benchmarks/gpu.md       with a CUDA GPU and the extra [gpu]
    python benchmarks/gpu.py --numpy --sizes 32 --depths 1 4    a trial: NumPy plays the GPU's library

Pictures (``--depths 1``) and volumes by total variation and by l1 with default solvers, one PSF a depth, a
fixed number of iterations, nothing chosen and nothing judged. Each case runs once before it is timed.
``--sizes 1024 --depths 128`` is a grid of 2048 x 2048 x 128. Of pictures each goes its own way to one end:
they are near each other only after many iterations (``--iterations 300``: 0.5 % at 24 x 24).
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import importlib.util
import platform
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.volume_speed import lenslet_psfs
from recon import Calibration, Reconstruction, reconstruct
from recon.base.threads import get_threads

PRIORS = ("tv", "l1")
GIB = 2**30


def solved(size: int, depths: int, prior: str, device: str, iterations: int) -> Reconstruction:
    """Return the timed run of a case."""
    psfs = lenslet_psfs(size, depths)
    rng = np.random.default_rng(1)
    shifts = rng.integers(-size // 5, size // 5 + 1, (30, 2))
    light = sum(np.roll(psfs[k % depths, 0], tuple(way), (0, 1)) for k, way in enumerate(shifts))
    image = rng.poisson(100 * light).astype(np.float32)
    z_um = 1e4 / np.linspace(1.0, 0.3, depths)
    places = np.column_stack([np.zeros((depths, 2)), z_um])
    asked: dict[str, Any] = {"prior": prior, "model": "convolution", "noise": 1.0, "tolerance": 0.0}
    asked |= {"estimate_background": False, "drop_empty": False, "judged": False, "device": device}
    for count in (1, iterations):  # the first compiles, and plans transforms
        found = reconstruct(image, Calibration(psfs, places), iterations=count, **asked)
    return found


def row(size: int, depths: int, prior: str, iterations: int, *, played: bool) -> tuple[str, float]:
    """Return a line of the table, and how many times faster the GPU is."""
    with contextlib.ExitStack() as stack:
        cpu = solved(size, depths, prior, "cpu", iterations)
        if played:
            from tests.golden.adapter import numpy_as_device

            stack.enter_context(numpy_as_device())
        gpu = solved(size, depths, prior, "gpu", iterations)
    apart = float(np.linalg.norm(gpu.volume - cpu.volume) / max(np.linalg.norm(cpu.volume), 1e-30))
    each = [r.seconds / iterations for r in (cpu, gpu)]
    memory = "" if played else f"{_pool_bytes() / GIB:.2f}"
    solvers = ", ".join(dict.fromkeys((cpu.solver, gpu.solver)))
    words = f"| {prior}, {solvers} | {size} x {size} x {depths} | {each[0]:.4f} | {each[1]:.4f} "
    return words + f"| {each[0] / each[1]:.1f} | {apart:.0e} | {memory} |", each[0] / each[1]


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


def _words(numbers: list[int]) -> str:
    return " ".join(map(str, numbers))


def page(sizes: list[int], depths: list[int], iterations: int, *, played: bool) -> str:
    """Return the page."""
    lines = [
        "# CPU and GPU",
        "",
        f"{datetime.date.today()}, {platform.machine()}, {get_threads()} threads; {_device(played=played)}. "
        f"`python benchmarks/gpu.py --sizes {_words(sizes)} --depths {_words(depths)}`",
        "",
        "| prior, solvers | sensor x depths | CPU, s an iteration | GPU | times | apart | memory, GiB |",
        "|---|---|---|---|---|---|---|",
    ]
    faster: dict[tuple[str, int], list[int]] = {}
    for prior in PRIORS:
        for n in depths:
            for size in sizes:
                line, times = row(size, n, prior, iterations, played=played)
                print(line, flush=True)
                lines.append(line)
                faster.setdefault((prior, n), []).extend([size] if times > 1 else [])
    lines.append("")
    for (prior, n), won in faster.items():
        said = f"from {min(won)} x {min(won)} on" if won else "at none of these sizes"
        lines.append(f"* {prior}, {n} depth{'s' * (n > 1)}: the GPU is faster {said}.")
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
    parser.add_argument("--iterations", type=int, default=10)
    parser.add_argument("--numpy", action="store_true", help="NumPy plays the GPU's library")
    parser.add_argument("--out", type=Path, help="the page")
    a = parser.parse_args(arguments)
    if not a.numpy and importlib.util.find_spec("cupy") is None:
        parser.error(
            "cupy is not installed: pip install 'diffuserbench[gpu]', or --numpy to try the command."
        )
    written = page(a.sizes, a.depths, a.iterations, played=a.numpy)
    if a.out is None:
        print(written)
    else:
        a.out.write_text(written)


if __name__ == "__main__":
    main()
