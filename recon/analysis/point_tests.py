"""The point tests of a calibration: two points across, two along, 16 in a square (Kuo 2020, Fig. 4.4)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.analysis.points import Noise, PointGrid, PointImage, PointTrial, smallest_resolved, try_points
from recon.analysis.window import WindowProblem
from recon.base import fft
from recon.camera.refocus import refocus
from recon.types import Calibration

Array = npt.NDArray[Any]

PLANES = 17
"""Planes of the window in depth, half an axial step (inner product 0.8) apart: the spacing of Sec. 4.4."""
HALF_WINDOW = (4, 24)
"""Rows and columns that the window reaches from the axis, voxels."""
LATERAL_PX = tuple(float(v) for v in np.arange(1.5, 12.1, 0.5))
AXIAL_PLANES = tuple(float(v) for v in np.arange(1.5, 12.1, 0.5))
FACTORS = (1.0, 1.2, 1.4, 1.6, 1.8, 2.0, 2.4, 2.8, 3.4)


@dataclass(frozen=True)
class PointTests:
    """What was resolved.

    Attributes
    ----------
    lateral_px : float or None
        Two points across: smallest resolved separation on the sensor; None where none tried was resolved.
    axial_per_um : float or None
        Two points along the axis: difference in 1/z.
    sixteen_factor : float or None
        By how much both separations had to grow for 4 x 4 points in x and z: the dissertation's 1.7.
    lateral, axial, sixteen : tuple of PointTrial
        Every trial made.
    notes : tuple of str
    """

    lateral_px: float | None
    axial_per_um: float | None
    sixteen_factor: float | None
    lateral: tuple[PointTrial, ...]
    axial: tuple[PointTrial, ...]
    sixteen: tuple[PointTrial, ...]
    notes: tuple[str, ...]


def point_tests(
    calibration: Calibration,
    z_um: float,
    *,
    lateral_px: float,
    step_per_um: float,
    noise: Noise | None = None,
    image: Callable[[float, float], Array] | None = None,
    progress: Callable[[float], object] | None = None,
) -> PointTests:
    """Run the point tests about a depth.

    Parameters
    ----------
    calibration : Calibration
    z_um : float
        Depth of the middle of the tests.
    lateral_px, step_per_um : float
        Predicted resolution (inner product 0.8): where the search starts, and the planes' spacing.
    noise : Noise, optional
    image : callable, optional
        ``image(columns, z_um)``: one point's image (height, width), ``columns`` pixels off the axis on the
        sensor, measured or from other optics than the calibration's. Default: the calibrated PSFs,
        refocused and shifted between pixels.
    progress : callable, optional
        Told the share done.
    """
    noise = noise or Noise()
    tell = progress or (lambda _share: None)
    inverse = 1 / z_um - step_per_um / 2 * (np.arange(PLANES) - PLANES // 2)
    notes: list[str] = []
    with_depth = bool(np.isfinite(step_per_um) and inverse[-1] > 0)
    if not with_depth:
        inverse = np.array([1 / z_um])
        notes.append(
            f"At {z_um / 1e3:.3g} mm the axial window would reach beyond infinity: points were tested across "
            "the axis only. Choose a nearer depth for tests along it."
        )
    planes = np.stack([refocus(calibration, float(1 / v)).psf.mean(axis=0) for v in inverse])
    make = image or _Shifted(calibration)

    def point(columns: float, s: float) -> Array:
        # Places between planes, evenly in 1/z.
        at = float(np.interp(s, np.arange(len(inverse)), inverse)) if len(inverse) > 1 else inverse[0]
        return make(columns, 1 / at)

    tell(0.1)
    across = WindowProblem(planes[len(planes) // 2][None], HALF_WINDOW)
    middle = len(planes) // 2

    def on_axis_plane(columns: float, _s: float) -> Array:
        return point(columns, middle)

    def try_lateral(px: float) -> PointTrial:
        return try_points(across, on_axis_plane, PointGrid(2, separation_px=px), noise)

    lateral, found = smallest_resolved(try_lateral, [v for v in LATERAL_PX if v >= 0.7 * lateral_px])
    if found is None:
        notes.append("No two points across the axis were resolved at any separation tried.")
    tell(0.3)
    resolved_px = None if found is None else found.separation_px
    if not with_depth:
        return PointTests(resolved_px, None, None, tuple(lateral), (), (), tuple(notes))
    along = WindowProblem(planes, (4, 4))
    axial, found_z = smallest_resolved(
        lambda s: try_points(along, point, PointGrid(1, 2, separation_planes=s), noise),
        AXIAL_PLANES,
    )
    if found_z is None:
        notes.append("No two points along the axis were resolved at any separation tried.")
    tell(0.5)
    sixteen: list[PointTrial] = []
    factor = None
    if found is not None and found_z is not None:
        problem = WindowProblem(planes, HALF_WINDOW)
        sixteen, factor = _sixteen(
            problem, point, found.separation_px, found_z.separation_planes, noise, tell
        )
        if factor is None:
            notes.append("16 points were not resolved at any separation that fits the window.")
    return PointTests(
        resolved_px,
        None if found_z is None else found_z.separation_planes * step_per_um / 2,
        factor,
        tuple(lateral),
        tuple(axial),
        tuple(sixteen),
        tuple(notes),
    )


def _sixteen(
    problem: WindowProblem,
    point: PointImage,
    px: float,
    planes: float,
    noise: Noise,
    tell: Callable[[float], object],
) -> tuple[list[PointTrial], float | None]:
    """Grow both separations of a 4 x 4 grid until it is resolved; returns the trials and the factor."""
    room = min((problem.n_z - 2) / (3 * planes), (2 * problem.half[1] - 3) / (3 * px))
    factors = [f for f in FACTORS if f <= room]
    trials: list[PointTrial] = []
    for number, factor in enumerate(factors):
        trials.append(
            try_points(problem, point, PointGrid(4, 4, factor * px, factor * planes), noise, trials=1)
        )
        tell(0.5 + 0.5 * (number + 1) / len(factors))
        if trials[-1].resolved:
            return trials, factor
    return trials, None


class _Shifted:
    """Images of points from calibrated PSFs: refocused, then shifted between pixels by a linear phase."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._spectra: dict[float, Array] = {}
        height, width = calibration.psfs.shape[-2:]
        # Room on both sides for the shift, which otherwise would wrap around.
        self._shape = fft.fast_shape((height, width + 4 * HALF_WINDOW[1]))

    def __call__(self, columns: float, z_um: float) -> Array:
        height, width = self._calibration.psfs.shape[-2:]
        key = round(z_um, 6)
        if key not in self._spectra:
            padded = np.zeros(self._shape)
            padded[:height, :width] = refocus(self._calibration, z_um).psf.mean(axis=0)
            if len(self._spectra) > 2 * PLANES:
                self._spectra.clear()
            self._spectra[key] = fft.rfft(padded)
        frequency = np.fft.rfftfreq(self._shape[1])
        moved = self._spectra[key] * np.exp(-2j * np.pi * frequency * columns)
        shifted: Array = fft.irfft(np.ascontiguousarray(moved), self._shape[1])[:height, :width]
        return shifted
