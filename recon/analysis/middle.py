"""The middle of a large sensor, on which tests by reconstruction stand for the whole.

Finest structure decides what is told apart, and every part of a pattern has it, so the tests need not see all
pixels. What a part lacks is light, and less noise makes up for that; and extent: while depth enlarges a
pattern, the edges of its middle move less. Depths are therefore spread, by how much farther apart in 1/z two
must lie to change the middle as much as they change the whole (:attr:`Middle.spread`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from recon.analysis.point_noise import Noise
from recon.analysis.resolution import axial_resolution
from recon.arrays import Array
from recon.camera.depth_mixture import central_psfs
from recon.camera.refocus import psf_at
from recon.types import Calibration

LARGEST_PX = 80_000
"""Of larger sensors the middle is taken."""
DIMMEST = 0.25
"""Light of the middle, an area's squares, relative to the whole's: of a darker one more pixels are taken."""
RIM_PX = 24
"""Kept dark around patterns, for shifts."""


@dataclass(frozen=True)
class Middle:
    """The middle of a calibration's sensor; all of a small one.

    Attributes
    ----------
    calibration : Calibration
        Colours averaged; of a part the PSFs on the axis alone.
    part : float
        Part of the sensor's pixels.
    spread : float
        Differences in 1/z that change the middle as much as those of 1 change the whole.
    """

    calibration: Calibration
    part: float
    spread: float
    _focused: Calibration
    _brighter: float
    _noisier: float

    @classmethod
    def of(
        cls,
        calibration: Calibration,
        z_um: float,
        step_per_um: float,
        *,
        reach: float = 0.0,
        dark_rim: bool = False,
    ) -> Middle:
        """Return the middle for tests about a depth.

        Parameters
        ----------
        calibration : Calibration
        z_um : float
        step_per_um : float
            Difference in 1/z that changes the whole (inner product 0.8).
        reach : float
            Difference in 1/z, on the whole, up to which farther depths are to be tested: as many more pixels
            are taken as keep them nearer than infinity.
        dark_rim : bool
            Whether :meth:`psf_at` is dark for :data:`RIM_PX` where the middle was cut out of light, for tests
            that take the sensor for large enough.
        """
        pixels = LARGEST_PX
        while True:
            middle = cls._within(calibration, z_um, step_per_um, pixels, dark_rim)
            if middle is not None and (middle.part == 1 or middle.spread * reach < 1 / z_um):
                return middle
            pixels *= 2

    @classmethod
    def _within(
        cls, calibration: Calibration, z_um: float, step_per_um: float, pixels: int, dark_rim: bool
    ) -> Middle | None:
        """Return a middle of so many pixels; None where too little light falls on them."""
        whole = calibration.psfs.shape[-2:]
        shape = _largest(whole, pixels)
        if shape == whole:
            averaged = calibration.psfs.mean(axis=1, keepdims=True)
            all_of_it = replace(calibration, psfs=averaged, background=None)
            return cls(all_of_it, 1.0, 1.0, all_of_it, 1.0, 1.0)
        depths, psfs = central_psfs(calibration)
        nearest = psfs[int(np.argmin(np.abs(1 / depths - 1 / z_um)))].mean(axis=0)
        cut = replace(
            calibration,
            psfs=_middle(psfs, shape).mean(axis=1, keepdims=True),
            source_positions_um=np.array([(0.0, 0.0, z) for z in depths]),
            background=None,
            quality={},
        )
        rims = [RIM_PX if dark_rim and m < n else 0 for n, m in zip(whole, shape, strict=True)]
        lit = tuple(m - 2 * rim for m, rim in zip(shape, rims, strict=True))
        part = _middle(nearest, lit)
        light, held = (float(np.square(image, dtype=np.float64).sum()) for image in (nearest, part))
        if held <= DIMMEST * light * part.size / nearest.size:
            return None
        lost = light / held
        psf = np.pad(_middle(psf_at(cut, z_um), lit), [(rim, rim) for rim in rims])
        distance_um = 1e3 * (calibration.geometry.diffuser_distance_mm or 0.0)
        step = axial_resolution(psf, z_um, distance_um).step_per_um
        return cls(
            cut,
            float(np.prod(shape) / np.prod(whole)),
            max(step / step_per_um, 1.0),
            # Of one PSF: at other depths it is enlarged, as Eq. 4.7 has it, which the spread is true of.
            replace(cut, psfs=psf[None, None], source_positions_um=np.array([(0.0, 0.0, z_um)])),
            lost * float(part.max() / nearest.max()),
            float(np.sqrt(lost)),
        )

    def noise(self, noise: Noise) -> Noise:
        """Return the noise with which the middle tells as much as the whole does with ``noise``."""
        return Noise(noise.electrons * self._brighter, noise.read_e * self._noisier)

    def psf_at(self, z_um: float) -> Array:
        """Return the PSF (height, width) at a depth."""
        return psf_at(self._focused, z_um)


def _largest(shape: tuple[int, ...], pixels: int) -> tuple[int, ...]:
    """Return a shape of the same middle of at most so many pixels, as square as can be."""
    height, width = shape
    while height * width > pixels:
        height, width = (height - 2, width) if height >= width else (height, width - 2)
    return height, width


def _middle(images: Array, shape: tuple[int, ...]) -> Array:
    """Cut images (..., height, width) to a shape about their middle."""
    down, right = (slice((n - m) // 2, (n + m) // 2) for n, m in zip(images.shape[-2:], shape, strict=True))
    return images[..., down, right]
