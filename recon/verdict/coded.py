"""Whether a photograph, or it and its PSF, are coded for the eye (sRGB, gamma): not in proportion to light.

A convolution explains light, not its power: what was coded is explained far better once it is straightened.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array

Left = Callable[[Float32Array, Float32Array], float]

GAMMA = 2.2
"""Of files for the eye; sRGB's own curve is as close to this power as its quantisation."""
STRAIGHTER = 0.9
"""What is unexplained falls to at most, relatively, once a photograph is straightened: of the measured hand
to 0.39 (both coded: 0.72), of a measured pair to 0.59, of bars by propagation to 0.80. Of those in proportion
to the light, the hand and seven pairs in three colours, as they are, with too much off, under even light,
vignetted, mirrored, turned, clipped, 1.4 times as much and more."""
SPEAKS = 0.05
"""Share of a photograph's contrast that is unexplained, from which it is asked at all: measured ones in
proportion to the light leave 0.015 to 0.048 where nothing is missing, coded ones 0.07 to 0.12."""


@dataclass(frozen=True, slots=True)
class Coded:
    """What is coded: a photograph, and perhaps its PSF.

    A PSF alone is not asked about: a power takes from it what light of the room it lies on, too.
    """

    psf: bool

    @property
    def words(self) -> str:
        """``the photograph is``, ``both are``."""
        return "both are" if self.psf else "the photograph is"

    @property
    def option(self) -> str:
        """Value of ``--srgb``."""
        return "both" if self.psf else "photograph"

    def straightened(self, photograph: Float32Array, psfs: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Return both in proportion to the light."""
        return straight(photograph), straight(psfs) if self.psf else psfs


CODED = (Coded(False), Coded(True))


def coded(photograph: Float32Array, psfs: Float32Array, left: Left, *, asked: bool = False) -> Coded | None:
    """Return what is coded, None where nothing is or the photograph does not tell.

    Parameters
    ----------
    photograph, psfs : ndarray
    left : callable
        ``left(photograph, psfs)``: the share of the photograph's contrast that they leave unexplained.
    asked : bool
        Whether something is known to be wrong, however little is unexplained.
    """
    given = left(photograph, psfs)
    if given < SPEAKS and not asked:
        return None
    least = {how: left(*how.straightened(photograph, psfs)) / given for how in CODED}
    best = min(least, key=lambda how: least[how])
    return best if least[best] < STRAIGHTER else None


def straight(image: npt.ArrayLike) -> Float32Array:
    """Return what was gamma-coded in proportion to the light."""
    values = np.maximum(np.asarray(image, np.float32), 0)
    top = max(float(values.max()), 1e-30)
    return np.asarray((values / top) ** GAMMA * top, np.float32)
