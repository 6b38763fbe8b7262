"""Cost and accuracy of spatially varying models: 25 PSFs, 1024 x 1024 pixels, PSF supports from 64 to 512.

    python benchmarks/local_convolution.py [--size 1024] [--supports 64 128 256 512] [--picture FILE]

Processor time of a forward and an adjoint relative to one convolution of the same frame
(``Convolution``, PSF as large as the sensor), taken in turns; accuracy is the error of the PSF at
places between the calibration points, with angular fall-off of the two-part model (Kuo 2020, Eq. 5.1) and
the pattern stretched by up to ``--aberration`` pixels. The local model is also compared with the same sum
over whole frames.
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon.base.threads import set_threads
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.camera.varying_psfs import (
    FieldOfPsfs,
    interpolation_weights,
    local_convolution,
    low_rank,
    principal_psfs,
)


@dataclass(frozen=True)
class Diffuser:
    """Spots of a PSF within ``support`` pixels, which shift with the field: aberrations of a diffuser."""

    size: int
    places: np.ndarray
    light: np.ndarray
    aberration_px: float
    fall_off_px: float

    @classmethod
    def random(cls, size: int, support: int, aberration_px: float) -> Diffuser:
        """Spread ``2 * support`` spots evenly at random."""
        rng = np.random.default_rng(0)
        places = rng.uniform(3 - support / 2, support / 2 - 4, (2 * support, 2))
        return cls(size, places, rng.random(len(places)), aberration_px, 1.3 * size)

    def psf(self, row: float, column: float) -> np.ndarray:
        """Return the registered PSF of a source: spots, times the response centred beneath the source.

        Towards the edge of the field the pattern is stretched along the field, at its rim by
        ``aberration_px``.
        """
        reach = max(float(np.abs(self.places).max()), 1.0)
        field = np.array([row, column]) / (self.size / 2)
        y, x = (self.places + self.aberration_px * field * self.places / reach).T
        image = np.zeros((self.size, self.size), np.float32)
        near = np.arange(-3, 4)
        rows, columns = np.round(y).astype(int)[:, None] + near, np.round(x).astype(int)[:, None] + near
        spots = self.light[:, None, None] * np.exp(
            -0.5 * ((rows - y[:, None])[:, :, None] ** 2 + (columns - x[:, None])[:, None, :] ** 2)
        )
        np.add.at(image, (rows[:, :, None] + self.size // 2, columns[:, None, :] + self.size // 2), spots)
        r, c = (np.arange(self.size) - self.size // 2 + 2 * p for p in (row, column))
        return image * np.exp(-(r[:, None] ** 2 + c**2) / (2 * self.fall_off_px**2)).astype(np.float32)


def in_turns(operators: dict[str, LinearOperator], rounds: int) -> dict[str, float]:
    """Least processor seconds of a forward and an adjoint, round by round."""
    best = dict.fromkeys(operators, np.inf)
    inputs = {
        k: (np.ones(o.domain_shape, np.float32), np.ones(o.range_shape, np.float32))
        for k, o in operators.items()
    }
    for _ in range(rounds + 1):  # the first compiles
        for name, operator in operators.items():
            x, y = inputs[name]
            began = time.process_time()
            operator.forward(x)
            operator.adjoint(y)
            best[name] = min(best[name], time.process_time() - began)
    return best


def over_whole_frames(field: FieldOfPsfs, sensor: tuple[int, int], x: np.ndarray) -> np.ndarray:
    """Eq. 5.5 as it stands: every PSF's masked object, convolved on the whole frame."""
    total = np.zeros(sensor)
    weights = None
    for i, psf in enumerate(field.psfs):
        camera = Convolution(psf, sensor)
        height, width = camera.field_shape
        rows, columns = (np.arange(n) - c for n, c in zip((height, width), camera.centre, strict=True))
        if weights is None:
            weights = interpolation_weights(field.points, np.eye(len(field.points)), rows, columns)
        masked = np.zeros(camera.domain_shape, np.float32)
        masked[0, :height, :width] = weights[i] * x
        total += camera.forward(masked)[0]
    return total


def psf_error(field: FieldOfPsfs, diffuser: Diffuser, rank: int | None, extent: float) -> float:
    """Root mean square error of the interpolated PSF at random places, relative."""
    rng = np.random.default_rng(1)
    principal = principal_psfs(field, rank=rank) if rank else None
    values = np.eye(len(field.points)) if principal is None else principal.scores
    psfs = field.psfs if principal is None else principal.components
    missed = total = 0.0
    for row, column in rng.uniform(-extent, extent, (12, 2)):
        truth = diffuser.psf(row, column)
        weights = interpolation_weights(field.points, values, [row], [column])[:, 0, 0]
        guess = diffuser.psf(0, 0) if rank == 0 else np.tensordot(weights, psfs[:, 0], 1)
        missed += float(np.sum((guess - truth) ** 2))
        total += float(np.sum(truth**2))
    return float(np.sqrt(missed / total))


def main() -> None:
    """Measure, tabulate, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--supports", type=int, nargs="+", default=[64, 128, 256, 512])
    parser.add_argument("--aberration", type=float, default=1.5, help="stretch at the field's rim, pixels")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--picture", type=Path, default=Path("local_convolution.png"))
    a = parser.parse_args()
    set_threads(a.threads)
    size, extent = a.size, 0.45 * a.size
    places = [(y, x) for y in np.linspace(-extent, extent, 5) for x in np.linspace(-extent, extent, 5)]
    sensor = (size, size)
    support_mask = np.zeros((1, 2 * size - 1, 2 * size - 1), bool)
    support_mask[0, size // 2 : 3 * size // 2, size // 2 : 3 * size // 2] = True
    table = {}
    for support in a.supports:
        diffuser = Diffuser.random(size, support, a.aberration)
        field = FieldOfPsfs(np.stack([diffuser.psf(y, x)[None] for y, x in places]), places)
        operators: dict[str, LinearOperator] = {
            "one convolution": Convolution(diffuser.psf(0, 0)[None], sensor),
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
            name: (s / one, psf_error(field, diffuser, ranks[name], extent)) for name, s in seconds.items()
        }
        x = np.random.default_rng(2).random(support_mask.shape[1:], np.float32) * support_mask[0]
        whole = over_whole_frames(field, sensor, x)
        off = np.abs(operators["local, 25 PSFs"].forward(x[None, None])[0] - whole).max() / whole.max()
        print(
            f"support {support}: one convolution {1000 * one:.0f} ms; the local model differs from whole "
            f"frames by {off:.0e}",
            flush=True,
        )
    print("\n| PSF support | " + " | ".join(table[a.supports[0]]) + " |\n" + "|---" * 6 + "|")
    for support, row in table.items():
        print(
            f"| {support} | " + " | ".join(f"{cost:.2f} ({error:.3f})" for cost, error in row.values()) + " |"
        )
    print("processor time relative to one convolution (PSF error between calibration points)")
    _draw(table, a.picture)


def _draw(table: dict[int, dict[str, tuple[float, float]]], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(table), figsize=(3.2 * len(table), 3.6), sharey=True)
    for axis, (support, row) in zip(np.atleast_1d(axes), table.items(), strict=True):
        for name, (cost, error) in row.items():
            axis.plot(cost, error, "o", label=name)
        axis.set(
            title=f"PSF support {support}", xlabel="processor time (one convolution = 1)", xlim=(0, None)
        )
        axis.grid(alpha=0.3)
    first = np.atleast_1d(axes)[0]
    first.set(ylabel="PSF error between calibration points", ylim=(0, None))
    first.legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
