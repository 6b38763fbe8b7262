"""A solver's state moved in the plane, where the scene has moved as a whole: whole periods wrap around."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.namespace import namespace_of
from recon.base.threads import over_rows


def move(images: Array, rows: float, columns: float) -> None:
    """Move images (..., height, width) in place, by cubic convolution (Keys 1981, a = -1/2).

    Half a millisecond for 540 x 960: a tenth of Fourier's way, which leaves no more for a solver to mend.
    """
    if not images.size:  # a state that a prior has no use for
        return
    xp = namespace_of(images)
    if xp is not np:
        spectra = fft.rfft(images)
        move_spectra(spectra, rows, columns, images.shape[-1])
        images[...] = fft.irfft(spectra, images.shape[-1])
        return
    from recon.solvers import _picture_kernels

    by, weights = zip(*(_taps(d, images.dtype) for d in (rows, columns)), strict=True)
    result = np.empty(images.shape[-2:], images.dtype)
    for place in np.ndindex(images.shape[:-2]):
        over_rows(_picture_kernels.move_rows, result, np.ascontiguousarray(images[place]), *by, *weights)
        images[place] = result


def move_spectra(spectra: Array, rows: float, columns: float, width: int) -> None:
    """Move images of a width in place, given by their real transforms (..., height, width // 2 + 1)."""
    height, half = spectra.shape[-2:]
    along = np.exp(-2j * np.pi * rows * np.fft.fftfreq(height)).astype(spectra.dtype)
    across = np.exp(-2j * np.pi * columns * np.fft.rfftfreq(width)).astype(spectra.dtype)
    if height % 2 == 0:
        along[height // 2] = along[height // 2].real
    if width % 2 == 0:
        across[half - 1] = across[half - 1].real
    phases = namespace_of(spectra).asarray(along[:, None] * across)
    for place in np.ndindex(spectra.shape[:-2]):
        spectra[place] *= phases


def _taps(by: float, dtype: np.dtype) -> tuple[int, Array]:
    """Return the whole pixels of a displacement, rounded up, and the four weights of what is left."""
    whole = int(np.ceil(by))
    f = whole - by
    weights = (
        -0.5 * f**3 + f**2 - 0.5 * f,
        1.5 * f**3 - 2.5 * f**2 + 1,
        -1.5 * f**3 + 2 * f**2 + 0.5 * f,
        0.5 * f**3 - 0.5 * f**2,
    )
    return whole, np.array(weights, dtype)
