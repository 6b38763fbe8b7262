"""Volumes brought to voxels of one size, to be browsed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from instrument.volumes.source import VolumeSource, metric_source, volume_in_memory
from recon.camera.grid import Grid, metric_grid

MOST_BYTES = 1 << 30
"""Larger volumes are brought there only when asked, and plane by plane as they are looked at."""


def bytes_in_proportion(source: VolumeSource, grid: Grid) -> int | None:
    """Return how much a volume takes on voxels of one size; None where it has them or cannot have them.

    ``grid`` is that of ``source``, its depths and pitches known.
    """
    if grid.is_metric or not len(np.unique(grid.z_um)) == len(grid.z_um) > 1:
        return None
    return 4 * int(np.prod(metric_grid(grid).shape)) * source.n_channels


def in_proportion(
    source: VolumeSource, grid: Grid, advance: Callable[[int], object]
) -> tuple[VolumeSource, Grid]:
    """Return a volume on voxels of one size and their grid; in memory up to ``MOST_BYTES``.

    ``advance(planes made)``, called after each, may raise to end the work.

    Raises FileError when the volume cannot be read.
    """
    made, metric = metric_source(source, grid), metric_grid(grid)
    if made.n_bytes > MOST_BYTES:
        return made, metric
    first = made.plane(0)
    voxels = np.empty((metric.shape[0], *first.shape), np.float32)
    for z in range(len(voxels)):
        voxels[z] = made.plane(z)
        advance(z + 1)
    return volume_in_memory(voxels, source.path), metric
