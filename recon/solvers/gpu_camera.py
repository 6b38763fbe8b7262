"""The camera of one or many depths on any device (Kuo 2020, Eqs. 3.4 and 4.4)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.namespace import Namespace
from recon.camera.background import BackgroundRemoval

Array = Any
"""An array of the camera's namespace."""


class DepthCamera:
    """``A = P C F^-1 sum_z diag(H_z) F``: convolve each depth, sum, crop, mask, remove a smooth background.

    Parameters
    ----------
    xp : module
        Array namespace: ``numpy`` or ``cupy``.
    spectrum : ndarray, complex, (n_z, grid_height, grid_width // 2 + 1)
        Transfer functions, as of :class:`~recon.camera.convolution3d.Convolution3D` or, with one depth, of
        :class:`~recon.camera.convolution.PadCropConvolution`. Copied to the device.
    grid_shape : (int, int)
    window : (slice, slice)
        Where the sensor lies on the grid.
    valid : ndarray of bool, (height, width), optional
        Pixels that were measured.
    background : BackgroundRemoval, optional
        For the same valid pixels.
    """

    def __init__(
        self,
        xp: Namespace,
        spectrum: npt.NDArray[Any],
        grid_shape: tuple[int, int],
        window: tuple[slice, slice],
        valid: npt.NDArray[np.bool_] | None = None,
        background: BackgroundRemoval | None = None,
    ) -> None:
        self.xp = xp
        self.H = xp.asarray(spectrum)
        self.grid_shape = (int(grid_shape[0]), int(grid_shape[1]))
        self.window = window
        self.dtype = np.dtype(self.H.real.dtype)
        self._mask = None if valid is None or valid.all() else xp.asarray(valid.astype(self.dtype))
        self._basis = None if background is None else [xp.asarray(part) for part in background.basis(0)]

    @property
    def domain_shape(self) -> tuple[int, int, int]:
        """``(n_z, grid_height, grid_width)``."""
        return (int(self.H.shape[0]), *self.grid_shape)

    @property
    def range_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the sensor."""
        rows, columns = self.window
        return (rows.stop - rows.start, columns.stop - columns.start)

    def forward(self, x: Array) -> Array:
        """Return what the sensor sees of a volume."""
        xp = self.xp
        return self.crop((self.H * xp.fft.rfft2(x)).sum(axis=0))

    def adjoint(self, y: Array) -> Array:
        """Correlate sensor data with every depth's PSF."""
        xp = self.xp
        return xp.fft.irfft2(xp.conj(self.H) * self.embed(self.masked(y)), s=self.grid_shape)

    def power(self) -> Array:
        """``sum_z |H_z|^2``."""
        return (self.H.real**2 + self.H.imag**2).sum(axis=0)

    def masked(self, image: Array) -> Array:
        """Take out what says nothing: pixels that are not valid, a smooth background. A new array."""
        if self._mask is not None:
            image = image * self._mask
        if self._basis is None:
            return image
        rows, columns, inverse = self._basis
        coefficients = rows @ image.astype(np.float64) @ columns.T
        best = (inverse @ coefficients.ravel()).reshape(coefficients.shape)
        image = image - (rows.T @ best @ columns).astype(self.dtype)
        return image if self._mask is None else image * self._mask

    def embed(self, y: Array) -> Array:
        """``F C^T y``."""
        plane = self.xp.zeros(self.grid_shape, self.dtype)
        plane[self.window] = y
        return self.xp.fft.rfft2(plane)

    def crop(self, X: Array) -> Array:
        """``P C F^-1 X``."""
        return self.masked(self.xp.fft.irfft2(X, s=self.grid_shape)[self.window])
