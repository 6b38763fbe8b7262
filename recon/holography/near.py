"""Light to planes so near that a mask pixel does not reach the whole picture: angular spectrum.

The field behind the mask has its spectrum on a period wide enough for what light spreads. Repeated over the
pixels' first orders, weighed with their shape and with what each direction gains on its way (band-limited
where it would leave the period, Matsushima and Shimobaba, Opt. Express 17, 19662, 2009), it takes the place
that the field behind the mask has elsewhere: one more transform gives the picture, and all else is the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.threads import get_threads, in_blocks
from recon.holography.display import Display


class NearField:
    """Takes fields behind a mask to spectra that are ready for their last transform, and back.

    Parameters
    ----------
    display : Display
        One that is near.
    depths_mm : sequence of float
        Of the planes, counted from the display's distance.
    band : int
        Samples of the spectrum along each axis.
    dtype : complex64 or complex128
    """

    def __init__(self, display: Display, depths_mm: Sequence[float], band: int, dtype: np.dtype[Any]) -> None:
        from recon.holography import _kernels  # late: numba takes half a second to import

        self._kernels, self.band = _kernels, band
        period = display.period
        self.canvas = np.zeros((period, period), dtype)
        """The field behind the mask, in its first rows and columns."""
        f = np.arange(band) - band // 2
        shape = np.sinc(display.mask_fill * f / period)
        sides = [np.exp(-1j * np.pi * f * (n - 1) / period) for n in display.mask.shape]
        self._wy, self._wx = ((side * shape / np.sqrt((shape**2).sum())).astype(dtype) for side in sides)
        clear = display.mask_fill or 1.0
        self.passed = float(clear * (shape**2).sum() / period) ** 2
        """Part of the light that is within the spectrum, for an SLM of random phases."""
        self._ways = [_way(display, z_mm, band).astype(dtype) for z_mm in depths_mm]

    @property
    def nbytes(self) -> int:
        """Bytes in its arrays."""
        return sum(a.nbytes for a in (self.canvas, *self._ways))

    def forward(self, field: Array, plane: int) -> None:
        """Fill the first rows and columns of ``field`` from the canvas; the rows below them become 0."""
        self._transform(forward=False)
        field[self.band :, : self.band] = 0

        def rows(start: int, stop: int) -> None:
            self._kernels.spread(self.canvas, field, self._ways[plane], self._wy, self._wx, start, stop)

        in_blocks(rows, self.band, grain=64)

    def back(self, field: Array, plane: int) -> None:
        """Fill the canvas with the adjoint of :meth:`forward`."""

        def rows(start: int, stop: int) -> None:
            self._kernels.collect(self.canvas, field, self._ways[plane], self._wy, self._wx, start, stop)

        in_blocks(rows, len(self.canvas), grain=64)
        self._transform(forward=True)

    def _transform(self, *, forward: bool) -> None:
        self._kernels.columns(self.canvas, forward, get_threads())
        self._kernels.columns(self.canvas.T, forward, get_threads())


def _way(display: Display, z_mm: float, band: int) -> npt.NDArray[np.complex128]:
    """Return what a quadrant of directions gains on its way to a plane, 0 where light leaves the period."""
    assert display.distance_mm is not None
    display.require_plane(z_mm)
    away_mm = display.distance_mm + z_mm
    pitch_mm, wavelength_mm = display.mask_pitch_um * 1e-3, display.wavelength_nm * 1e-6
    sine = np.arange(band // 2 + 1) * (wavelength_mm / (display.period * pitch_mm))
    along = 1 - sine[:, None] ** 2 - sine**2
    seen = along > 0
    for axis, side in enumerate(display.mask.shape):
        # Beyond its own mask light reaches the picture from nowhere; half a period is what can be sampled.
        reach_mm = min(display.period - side, display.period / 2) * pitch_mm
        inside = sine <= reach_mm / np.hypot(reach_mm, away_mm)
        seen &= inside[:, None] if axis == 0 else inside
    phase = 2 * np.pi * away_mm / wavelength_mm * (np.sqrt(np.maximum(along, 0)) - 1)
    return np.where(seen, np.exp(1j * phase), 0)
