"""Registration of PSFs to one another by cross-correlation (Kuo 2020, sec. 5.2)."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon import fft

Array = npt.NDArray[Any]


def displacement(psf: Array, reference: Array) -> tuple[int, int]:
    """Return by how many (rows, columns) the pattern of ``psf`` lies off that of ``reference``.

    The peak of their cross-correlation, padded so that nothing wraps around. Means are taken off first: what
    all pixels share would pull the peak to the middle.

    Parameters
    ----------
    psf, reference : ndarray, (height, width)
    """
    shape = fft.fast_shape([2 * n for n in psf.shape])
    spectra = []
    for image in (psf, reference):
        padded = np.zeros(shape, np.float32)
        padded[: image.shape[0], : image.shape[1]] = image - image.mean()
        spectra.append(fft.rfft(padded))
    correlation = fft.irfft(spectra[0] * np.conj(spectra[1]), shape[1])
    peak = np.unravel_index(int(np.argmax(correlation)), shape)
    row, column = (int(p) - n if p > n // 2 else int(p) for p, n in zip(peak, shape, strict=True))
    return row, column


def shifted(image: Array, rows: int, columns: int) -> Array:
    """Return ``image`` (..., height, width) moved by whole pixels; zeros move in."""
    result = np.zeros_like(image)
    height, width = image.shape[-2:]
    source, target = [], []
    for n, by in ((height, rows), (width, columns)):
        source.append(slice(max(-by, 0), max(min(n - by, n), 0)))
        target.append(slice(max(by, 0), max(min(n + by, n), 0)))
    result[..., target[0], target[1]] = image[..., source[0], source[1]]
    return result
