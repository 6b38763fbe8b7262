"""Resolution by reconstructions: two points across, two along, 16 in a square (Kuo 2020, Fig. 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import count

import numpy as np

from recon.analysis.gram import WindowProblem
from recon.analysis.point_images import HALF_WINDOW, PointImage, ShiftedPoints, planes_about
from recon.analysis.point_noise import Noise
from recon.analysis.points import PointGrid, PointTrial, try_points
from recon.analysis.stated_distance import DRAWS, ROUNDS, smallest_told
from recon.arrays import Array


@dataclass(frozen=True)
class PointTests:
    """What was resolved."""

    lateral_px: float | None
    """Two points across: smallest resolved separation on the sensor; None where none tried was resolved."""
    axial_per_um: float | None
    """Two points along the axis: difference in 1/z."""
    sixteen_factor: float | None
    """By how much both separations had to grow for 4 x 4 points in x and z: the dissertation's 1.7."""
    lateral: tuple[PointTrial, ...]
    axial: tuple[PointTrial, ...]
    sixteen: tuple[PointTrial, ...]
    """``lateral``, ``axial`` and ``sixteen``: every trial made."""
    notes: tuple[str, ...]


def point_tests(
    psf_at: Callable[[float], Array],
    z_um: float,
    *,
    lateral_px: float,
    step_per_um: float,
    noise: Noise | None = None,
    image: Callable[[float, float], Array] | None = None,
    on_progress: Callable[[float], object] | None = None,
) -> PointTests:
    """Run the point tests about a depth.

    Parameters
    ----------
    psf_at : callable
        ``psf_at(z_um)``: the PSF (height, width) of a point on the axis.
    z_um : float
        Depth of the middle of the tests.
    lateral_px, step_per_um : float
        Predicted resolution (inner product 0.8): where the search starts, and the planes' spacing.
    noise : Noise, optional
    image : callable, optional
        ``image(columns, z_um)``: one point's image (height, width), ``columns`` pixels off the axis on the
        sensor, measured or from other optics. Default: ``psf_at``, shifted between pixels.
    on_progress : callable, optional
        Called with the share done.
    """
    noise = noise or Noise()
    on_progress = on_progress or (lambda _share: None)
    inverse = planes_about(z_um, step_per_um)
    notes: list[str] = []
    with_depth = bool(np.isfinite(step_per_um) and inverse[-1] > 0)
    if not with_depth:
        inverse = np.array([1 / z_um])
        notes.append(
            f"At {z_um / 1e3:.3g} mm the axial window would reach beyond infinity: points were tested across "
            "the axis only. Choose a nearer depth for tests along it."
        )
    planes = np.stack([psf_at(float(1 / v)) for v in inverse])
    middle = len(planes) // 2
    points: list[PointImage] = []
    for of in (inverse, inverse[middle : middle + 1]):
        shifted = ShiftedPoints(psf_at, of, planes.shape[1:])
        points.append(shifted if image is None else shifted.seen_by(image))
    point, in_plane = points
    on_progress(0.1)
    across = WindowProblem(planes[middle][None], HALF_WINDOW)
    lateral, px = smallest_told(
        lambda apart, seed: try_points(
            across, in_plane, PointGrid(2, separation_px=apart), noise, seed=seed, trials=1
        ),
        max(0.7 * lateral_px, 1.2),
    )
    if px is None:
        notes.append("No two points across the axis were resolved at any separation tried.")
    on_progress(0.3)
    if not with_depth:
        return PointTests(px, None, None, tuple(lateral), (), (), tuple(notes))
    along = WindowProblem(planes, (4, 4))
    axial, apart_planes = smallest_told(
        lambda apart, seed: try_points(
            along, point, PointGrid(1, 2, separation_planes=apart), noise, seed=seed, trials=1
        ),
        1.2,
    )
    if apart_planes is None:
        notes.append("No two points along the axis were resolved at any separation tried.")
    on_progress(0.5)
    sixteen: list[PointTrial] = []
    factor = None
    if px is not None and apart_planes is not None:
        square, draw = WindowProblem(planes, HALF_WINDOW), count(1)

        def sixteen_points(by: float, seed: int) -> PointTrial:
            on_progress(0.5 + 0.5 * next(draw) / (ROUNDS * DRAWS + 1))
            grid = PointGrid(4, 4, by * px, by * apart_planes)
            return try_points(square, point, grid, noise, seed=seed, trials=1)

        room = min((square.n_z - 2) / (3 * apart_planes), (2 * square.half[1] - 3) / (3 * px))
        if room > 1:
            sixteen, factor = smallest_told(sixteen_points, 1.0, room)
        if factor is None:
            notes.append(
                "16 points were not resolved at nine in ten places at any separation that fits the window."
            )
    return PointTests(
        px,
        None if apart_planes is None else apart_planes * step_per_um / 2,
        factor,
        tuple(lateral),
        tuple(axial),
        tuple(sixteen),
        tuple(notes),
    )
