"""The measured tilted USAF target in three dimensions: picture, time and memory.

    python benchmarks/usaf3d.py [--bin 1] [--prior l1 tv] [--iterations 100] [--picture usaf3d.png]

Needs the measured data: ``DIFFUSERBENCH_DATA``, else ``../shared/data``. The target is tilted about the
vertical axis, so its bars lie each in their own depth and the x-z view shows a ramp.
"""

from __future__ import annotations

import argparse
import os
import resource
import sys
from pathlib import Path

import numpy as np
import tifffile

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from recon import Calibration, Reconstruction, reconstruct
from recon.base.threads import set_threads

ROOT = Path(os.environ.get("DIFFUSERBENCH_DATA", Path(__file__).parents[1] / "../shared/data"))


def load(binning: int) -> tuple[Calibration, np.ndarray]:
    """Read PSFs and raw frame, subtract the frame's offset of 100, bin."""
    folder = ROOT / "diffusercam_usaf3d"
    psfs = np.stack([tifffile.imread(f) for f in sorted(folder.glob("psf*.tiff"))])[:, None]
    image = tifffile.imread(folder / "image.tiff").astype(np.float32) - 100
    height, width = (n // binning for n in image.shape)

    def binned(a: np.ndarray) -> np.ndarray:
        cut = a[..., : height * binning, : width * binning]
        return cut.reshape(*a.shape[:-2], height, binning, width, binning).mean((-1, -3))

    psfs = np.ascontiguousarray(binned(psfs), np.float32)
    return Calibration(psfs, np.full((len(psfs), 3), np.nan)), binned(image)


def main() -> None:
    """Reconstruct with each prior, report, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--bin", type=int, default=1)
    parser.add_argument("--prior", nargs="+", default=["l1", "tv"])
    parser.add_argument("--iterations", type=int, default=100)
    parser.add_argument("--tau", type=float, default=None)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--picture", type=Path, default=Path("usaf3d.png"))
    a = parser.parse_args()
    set_threads(a.threads)
    calibration, image = load(a.bin)
    results = {}
    for prior in a.prior:
        r = reconstruct(
            image, calibration, prior=prior, iterations=a.iterations, tau=a.tau, tolerance=1e-3,
            estimate_background=True,
        )  # fmt: skip
        last = r.histories[0][-1]
        print(
            f"{prior}: {r.volume.shape}, {len(r.histories[0])} iterations in {r.seconds:.1f} s "
            f"({r.seconds / len(r.histories[0]):.2f} s each), tau {r.tau:.2g}, "
            f"residual {last.data_residual:.4g} (noise {r.noise_norm:.4g}), {r.stop_reasons[0]}, "
            f"peak {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20:.2f} GiB",
            flush=True,
        )
        results[prior] = r
    _draw(results, a.picture)


def _draw(results: dict[str, Reconstruction], path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(len(results), 4, figsize=(19, 5 * len(results)), squeeze=False)
    for row, (prior, r) in zip(axes, results.items(), strict=True):
        height, width = r.volume.shape[1:]
        cut = np.s_[:, int(0.28 * height) : int(0.72 * height), int(0.35 * width) : int(0.7 * width)]
        volume = r.volume[cut]
        # The first and last planes take what lies outside the calibrated range.
        front, side = volume[1:-1].max(axis=0), volume.max(axis=1)
        level = np.percentile(front, 99.7)
        row[0].imshow(front, cmap="gray", vmax=level)
        row[0].set_title(f"{prior}: brightest over depth")
        row[1].imshow(side, aspect="auto", cmap="magma", vmax=np.percentile(side, 99.7))
        row[1].set(title="brightest over y", ylabel="depth plane", xlabel="x")
        depth = 1 + volume[1:-1].argmax(axis=0)
        hue = plt.get_cmap("turbo")(depth / len(volume))[..., :3]
        row[2].imshow(np.clip(hue * (front / level)[..., None], 0, 1))
        row[2].set_title("colour: depth")
        three = [len(volume) * k // 8 for k in (2, 4, 6)]
        row[3].imshow(np.concatenate([volume[z] for z in three], axis=1), cmap="gray", vmax=level)
        row[3].set_title("planes " + ", ".join(map(str, three)))
    for axis in axes[:, [0, 2, 3]].ravel():
        axis.axis("off")
    figure.tight_layout()
    figure.savefig(path, dpi=60)


if __name__ == "__main__":
    main()
