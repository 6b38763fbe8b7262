"""537 million voxels on a desktop: 2048 x 2048 x 128, l1 and non-negativity, a simulated bead scene.

    python benchmarks/volume_537m.py [--iterations 24] [--threads 2] [--sensor 1024] [--picture FILE]

The dissertation (Ch. 4) needed a 144-core workstation, 8 s per iteration and 85 GB for this size.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from lenslet_scene import Camera, beads, expose

from recon.base.threads import set_threads
from recon.camera.convolution import Convolution
from recon.priors import L1, NonNegativity
from recon.solvers import StoppingRules
from recon.solvers.douglas_rachford import SparseDouglasRachford
from recon.solvers.splitting import Room


def peak_gib() -> float:
    """Largest memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Render, reconstruct, report, draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--iterations", type=int, default=24)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--sensor", type=int, default=1024)
    parser.add_argument("--depths", type=int, default=128)
    parser.add_argument("--beads", type=int, default=300)
    parser.add_argument("--picture", type=Path, default=Path("volume_537m.png"))
    a = parser.parse_args()
    set_threads(a.threads)
    camera = Camera(a.sensor, a.depths)
    points = beads(camera, a.beads)
    operator = Convolution(camera.psfs(), (a.sensor, a.sensor))
    voxels = int(np.prod(operator.domain_shape))
    data = expose(camera.render(points), 2000)[None]
    # The prior's weight: three deviations of what noise alone correlates to with a PSF.
    power = float(operator.power().mean()) / a.depths
    weight = 3 * float(np.sqrt(data.mean() + 4)) * float(np.sqrt(power))
    solver = SparseDouglasRachford(operator, data, L1(weight) + NonNegativity(), room=Room(keep_state=False))
    began = time.perf_counter()

    def tell(_, record):
        print(
            f"{record.iteration:3d}  {record.seconds:7.1f} s  residual {record.data_residual:.4g}  "
            f"gap {record.primal_residual:.3g}  {peak_gib():.2f} GiB",
            flush=True,
        )

    outcome = solver.run(StoppingRules(iterations=a.iterations, tolerance=0), callback=tell)
    steps = np.diff([0, *(r.seconds for r in outcome.history)])[2:]
    volume = outcome.solution[0]
    found = _found(volume, points, camera, operator.centre)
    print(
        f"{voxels / 1e6:.0f} million voxels, {a.threads} threads: median {np.median(steps):.2f} s per "
        f"iteration (best {steps.min():.2f}), {time.perf_counter() - began:.0f} s in all, peak "
        f"{peak_gib():.2f} GiB; {found:.0%} of {a.beads} beads found"
    )
    _draw(volume, points, camera, operator.centre, a.picture)


def _found(volume, points, camera, centre) -> float:
    """Share of beads with a voxel above a tenth of the 99.9th percentile within 2 pixels and 3 planes."""
    level = 0.1 * float(volume.max())
    hits = 0
    for y, x, m, _ in points:
        z = round((1 + camera.span - m) / camera.span * (camera.depths - 1))
        i, j = round(y) + centre[0], round(x) + centre[1]
        hits += float(volume[max(z - 3, 0) : z + 4, i - 2 : i + 3, j - 2 : j + 3].max()) > level
    return hits / len(points)


def _draw(volume, points, camera, centre, path: Path) -> None:
    import matplotlib as mpl

    mpl.use("Agg")
    import matplotlib.pyplot as plt

    half = camera.size // 2
    window = np.s_[centre[0] - half : centre[0] + half, centre[1] - half : centre[1] + half]
    top = np.zeros((2 * half, 2 * half), np.float32)
    for plane in volume:
        np.maximum(top, plane[window], out=top)
    side = np.stack([plane[window].max(axis=0) for plane in volume])
    figure, axes = plt.subplots(1, 2, figsize=(13, 6.5), width_ratios=(1, 1))
    level = max(float(np.percentile(top[top > 0], 99)) if (top > 0).any() else 1.0, 1e-9)
    # A bead is a voxel wide: enlarge it so that it can be seen.
    from scipy.ndimage import maximum_filter

    axes[0].imshow(maximum_filter(top, 5), cmap="inferno", vmax=level, extent=(-half, half, half, -half))
    axes[0].scatter(points[:, 1], points[:, 0], s=50, facecolors="none", edgecolors="c", linewidths=0.4)
    axes[0].set(
        title="brightest over depth (circles: true positions)", xlabel="x (pixels)", ylabel="y (pixels)"
    )
    axes[1].imshow(
        maximum_filter(side, (3, 5)),
        cmap="inferno",
        vmax=level,
        aspect="auto",
        extent=(-half, half, camera.depths, 0),
    )
    depth = (1 + camera.span - points[:, 2]) / camera.span * (camera.depths - 1)
    axes[1].scatter(points[:, 1], depth, s=50, facecolors="none", edgecolors="c", linewidths=0.4)
    axes[1].set(title="brightest over y", xlabel="x (pixels)", ylabel="depth plane")
    figure.tight_layout()
    figure.savefig(path, dpi=80)


if __name__ == "__main__":
    main()
