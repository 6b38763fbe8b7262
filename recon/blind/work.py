"""What blind deconvolution of bead images computes, counted step by step before it begins.

In transforms of 1024 x 1024 there and back: half of it is transforms, and what else takes time goes with the
same sizes. By it the share done is told, and the time of all of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Float64Array
from recon.base import fft
from recon.blind.settings import BlindSettings
from recon.camera.convolution import field_of
from recon.camera.spatially_varying import SpatiallyVarying
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution

BEADS = 20
"""Beads an image, before any is found: what a slide should have."""
ROUNDS_A_DEGREE = 3
"""With each degree of the field's variation, at most."""
_MPX = 1024**2
# Measured on images of 60 x 80 to 540 x 640 pixels: what a pixel, or its frequency, takes.
_LOCAL = 0.55  # of those that the local model counts, forward and adjoint
_TRANSFORMED = 0.8  # of one that is transformed there and back
_MIXED = 0.3  # of one product of a PSF's spectrum with an image's, forward and adjoint
_MADE = 1.5  # of one spectrum of beads on the grid
_NORM = 10.0  # of one frequency's matrix and its largest eigenvalue, for each pair of functions
_FIRST = 105.0  # of a first PSF, by registration
_POINT, _POINT_BY_FUNCTION = 130.0, 8.0  # of a point's patch, refined
_MARGIN_PX = 8  # of a patch
_LEFT = 32.0  # of what is left of an image, in which beads are looked for


@dataclass(frozen=True, slots=True)
class BlindWork:
    """Work of the parts, in transforms of 1024 x 1024 there and back."""

    first: float
    """A first PSF."""
    beads: float
    """Beads on the grid, of one rank."""
    psfs: float
    """PSFs on the grid, of one rank."""
    ranks: int
    degrees: tuple[float, ...]
    """PSFs and beads between pixels, by the degree of the field's variation."""
    halves: float
    """PSFs of either half of the images, and of noise."""

    @property
    def total(self) -> float:
        """All of it, where no rank and no round is left out."""
        return self.on_grid(self.ranks) + sum(self.degrees) + self.halves

    def on_grid(self, ranks: float) -> float:
        """Return the work until so many ranks on the grid are done."""
        return self.first + ranks * (self.beads + self.psfs)

    def between_pixels(self, share: float) -> float:
        """Return the work until a share of the degrees is done, each of which counts as much in it."""
        done = np.concatenate([[0.0], np.cumsum(self.degrees)])
        return self.on_grid(self.ranks) + float(np.interp(share, np.linspace(0, 1, len(done)), done))


def blind_work(
    shape: tuple[int, int, int], psf_shape: tuple[int, int], settings: BlindSettings, beads: int = BEADS
) -> BlindWork:
    """Count what images of a shape will take.

    Parameters
    ----------
    shape : (int, int, int)
        Of the images: (n_images, height, width).
    psf_shape : (int, int)
        The window; at most height and width.
    settings : BlindSettings
    beads : int
        In each image.
    """
    n, height, width = shape
    sensor = height, width
    points = grid_points(sensor, settings)
    lit = np.broadcast_to(np.float32(1), (len(points), 1, *psf_shape))
    local = local_convolution([FieldOfPsfs(lit, points)], sensor)
    assert isinstance(local, SpatiallyVarying)
    grid = float(np.prod(fft.fast_shape(field_of(sensor, psf_shape)[0]))) / _MPX
    patch = (psf_shape[0] + _MARGIN_PX) * (psf_shape[1] + _MARGIN_PX) / _MPX

    def fit(images: float, psfs: int) -> float:
        """Return what fitting PSFs takes, so many iterations."""
        return settings.iterations * grid * (_TRANSFORMED * (psfs + images) + _MIXED * psfs * images)

    def degree(functions: int) -> float:
        refined = n * beads * patch * (_POINT + _POINT_BY_FUNCTION * functions)
        norm, left = _NORM * functions**2 * grid, _LEFT * n * height * width / _MPX
        return ROUNDS_A_DEGREE * (2 * fit(n, functions) + norm + refined + left)

    functions = [(d + 1) * (d + 2) // 2 for d in range(settings.degree + 1)]
    return BlindWork(
        first=_FIRST * n * height * width / _MPX,
        beads=n * settings.iterations * _LOCAL * local.fft_pixels / _MPX,
        psfs=fit(n, len(points)) + _MADE * n * len(points) * grid,
        ranks=sum(rank <= len(points) for rank in settings.ranks),
        degrees=tuple(map(degree, functions)),
        halves=2 * (2 * fit(n / 2, functions[-1]) + _NORM * functions[-1] ** 2 * grid),
    )


def grid_points(sensor: tuple[int, int], settings: BlindSettings) -> Float64Array:
    """Return where the PSFs over the field stand: ``(row, column)`` from the axis, (n, 2), object pixels."""
    axes = [
        np.linspace(-0.5, 0.5, k) * settings.reach * n if k > 1 else np.zeros(1)
        for k, n in zip(settings.grid, sensor, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2).round()
