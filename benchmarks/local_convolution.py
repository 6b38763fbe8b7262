"""Cost and accuracy of spatially varying models: 25 PSFs, 1024 x 1024 pixels, PSF supports from 64 to 512.

    python benchmarks/local_convolution.py [--size 1024] [--supports 64 128 256 512] [--picture FILE]

Time of a forward and an adjoint relative to one convolution of the same frame (``PadCropConvolution``, PSF as
large as the sensor), taken in turns; accuracy is the error of the PSF at places between the calibration
points, with angular fall-off of the two-part model (Kuo 2020, Eq. 5.1).
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon.operators import FieldOfPsfs, LinearOperator, PadCropConvolution, local_convolution, low_rank
from recon.operators.interpolation import interpolation_weights
from recon.operators.low_rank import principal_psfs
from recon.threads import set_threads


def psf_at(row: float, column: float, base: np.ndarray, sigma_px: float) -> np.ndarray:
    """Return the registered PSF of a source: the pattern, times the response centred beneath the source."""
    y, x = (np.arange(n) - n // 2 for n in base.shape)
    response = np.exp(-((y[:, None] + 2 * row) ** 2 + (x + 2 * column) ** 2) / (2 * sigma_px**2))
    return (base * response).astype(np.float32)


def pattern(size: int, support: int, seed: int = 0) -> np.ndarray:
    """Random bright spots within ``support`` in a frame of ``size``."""
    rng = np.random.default_rng(seed)
    base = np.zeros((size, size))
    rows, columns = rng.integers(size // 2 - support // 2, size // 2 + support // 2, (2, 2 * support))
    base[rows, columns] = rng.random(rows.size)
    return base


def in_turns(operators: dict[str, LinearOperator], rounds: int) -> dict[str, float]:
    """Best seconds of a forward and an adjoint, round by round."""
    best = dict.fromkeys(operators, np.inf)
    inputs = {
        k: (np.ones(o.domain_shape, np.float32), np.ones(o.range_shape, np.float32))
        for k, o in operators.items()
    }
    for _ in range(rounds + 1):
        for name, operator in operators.items():
            x, y = inputs[name]
            began = time.perf_counter()
            operator.forward(x)
            operator.adjoint(y)
            best[name] = min(best[name], time.perf_counter() - began)
    return best


def psf_error(
    field: FieldOfPsfs, base: np.ndarray, sigma_px: float, rank: int | None, extent: float
) -> float:
    """Root mean square error of the interpolated PSF at random places, relative."""
    rng = np.random.default_rng(1)
    principal = principal_psfs(field, rank=rank) if rank else None
    values = np.eye(len(field.points)) if principal is None else principal.scores
    psfs = field.psfs if principal is None else principal.components
    missed = total = 0.0
    for row, column in rng.uniform(-extent, extent, (12, 2)):
        truth = psf_at(row, column, base, sigma_px)
        weights = interpolation_weights(field.points, values, [row], [column])[:, 0, 0]
        guess = psf_at(0, 0, base, sigma_px) if rank == 0 else np.tensordot(weights, psfs[:, 0], 1)
        missed += float(np.sum((guess - truth) ** 2))
        total += float(np.sum(truth**2))
    return float(np.sqrt(missed / total))


def main() -> None:
    """Measure, tabulate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--supports", type=int, nargs="+", default=[64, 128, 256, 512])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--picture", type=Path, default=Path("local_convolution.png"))
    a = parser.parse_args()
    set_threads(a.threads)
    size, extent, sigma = a.size, 0.45 * a.size, 1.3 * a.size
    places = [(y, x) for y in np.linspace(-extent, extent, 5) for x in np.linspace(-extent, extent, 5)]
    sensor = (size, size)
    support_mask = np.zeros((1, 2 * size - 1, 2 * size - 1), bool)
    support_mask[0, size // 2 : 3 * size // 2, size // 2 : 3 * size // 2] = True
    table = {}
    for support in a.supports:
        base = pattern(size, support)
        field = FieldOfPsfs(np.stack([psf_at(y, x, base, sigma)[None] for y, x in places]), places)
        operators: dict[str, LinearOperator] = {
            "one convolution": PadCropConvolution(base[None].astype(np.float32), sensor),
            "local, 25 PSFs": local_convolution([field], sensor, support=support_mask),
        }
        for rank in (3, 5, 8):
            operators[f"low rank {rank}"] = low_rank([field], sensor, rank=rank, support=support_mask)
        seconds = in_turns(operators, a.rounds)
        one = seconds["one convolution"]
        ranks = {
            "one convolution": 0,
            "local, 25 PSFs": None,
            "low rank 3": 3,
            "low rank 5": 5,
            "low rank 8": 8,
        }
        table[support] = {
            name: (s / one, psf_error(field, base, sigma, ranks[name], extent)) for name, s in seconds.items()
        }
        print(f"support {support}: one convolution {1000 * one:.0f} ms", flush=True)
    print("\n| PSF support | " + " | ".join(table[a.supports[0]]) + " |\n" + "|---" * 6 + "|")
    for support, row in table.items():
        print(
            f"| {support} | " + " | ".join(f"{cost:.2f} ({error:.3f})" for cost, error in row.values()) + " |"
        )
    print("time relative to one convolution (PSF error between calibration points)")
    _draw(table, a.picture)


def _draw(table: dict[int, dict[str, tuple[float, float]]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axis = plt.subplots(figsize=(7, 5))
    for name in next(iter(table.values())):
        cost, error = zip(*(row[name] for row in table.values()), strict=True)
        axis.plot(cost, error, "o-", label=name)
        for support, x, y in zip(table, cost, error, strict=True):
            axis.annotate(str(support), (x, y), fontsize=7, xytext=(3, 3), textcoords="offset points")
    axis.set(xlabel="time of forward and adjoint (one convolution = 1)", ylabel="PSF error", yscale="log")
    axis.set_title("25 PSFs; numbers: PSF support in pixels")
    axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
