"""How good a PSF from photographs of known pictures is: how those fare that it was not made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.blocks import block_mean
from recon.blind.known_pictures import PictureSettings, psf_from_pictures
from recon.reconstruction.reconstruct import reconstruct

Floats = npt.NDArray[np.float32]
Image = npt.NDArray[Any]
Progress = Callable[[str, float], object]

_SHIFT_PX = 4  # that a reconstruction may be off the picture by
_SOLVING = 0.8  # of the work on a photograph; the rest is its reconstruction


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A photograph reconstructed with the PSF from the others.

    Attributes
    ----------
    number : int
        Of the photograph, from 0.
    psnr_db : float
        As :func:`fare` gives it.
    flat_db : float
        What an even picture would have.
    image : ndarray, float32, (height, width, n_channels)
        The reconstruction, in the picture's brightness.
    """

    number: int
    psnr_db: float
    flat_db: float
    image: Floats


def fare(image: Image, picture: Image) -> tuple[float, Floats]:
    """Judge a reconstruction by the picture that it should show, both (height, width, n_channels).

    What no calibration by pictures can tell is not held against it: a shift by whole pixels, and a gain and
    an offset a channel.

    Returns
    -------
    float
        PSNR in dB over the whole field, for a peak of 1.
    ndarray, float32
        The reconstruction after that shift, gain and offset.
    """
    best: tuple[float, Floats] = (-np.inf, np.empty(0, np.float32))
    truth = np.asarray(picture, np.float64)
    centred = truth - truth.mean(axis=(0, 1))
    for rows in range(-_SHIFT_PX, _SHIFT_PX + 1):
        for columns in range(-_SHIFT_PX, _SHIFT_PX + 1):
            moved = np.roll(np.asarray(image, np.float64), (rows, columns), axis=(0, 1))
            moved -= moved.mean(axis=(0, 1))
            power = np.maximum((moved**2).sum(axis=(0, 1)), 1e-30)
            fitted = moved * ((moved * centred).sum(axis=(0, 1)) / power)
            psnr = float(-10 * np.log10(max(float(np.mean((fitted - centred) ** 2)), 1e-30)))
            if psnr > best[0]:
                best = psnr, np.asarray(fitted + truth.mean(axis=(0, 1)), np.float32)
    return best


def leave_out(
    photographs: Image,
    pictures: Image,
    numbers: Sequence[int],
    settings: PictureSettings | None = None,
    *,
    binning: int = 1,
    on_progress: Progress | None = None,
) -> list[LeftOut]:
    """Reconstruct photographs, by default options, with the PSF that the others give.

    Parameters
    ----------
    photographs, pictures : ndarray, (n, n_channels, height, width)
        As :func:`~recon.blind.known_pictures.psf_from_pictures` takes them.
    numbers : sequence of int
        Which are left out, one after the other.
    settings : PictureSettings, optional
    binning : int
        Of both beforehand: the score hardly changes, the time with its square.
    on_progress : callable, optional
        Called with what is being done and the share done.

    Errors as ``psf_from_pictures`` and ``reconstruct``.
    """
    report = on_progress or (lambda _what, _share: None)
    data, known = (block_mean(images, binning, about_axis=True) for images in (photographs, pictures))
    found = []
    for done, number in enumerate(numbers):
        words = f"photograph {number + 1} left out"

        def solving(_what: str, share: float, done: int = done, words: str = words) -> None:
            report(words, (done + _SOLVING * share) / len(numbers))

        others = np.arange(len(data)) != number
        solved = psf_from_pictures(data[others], known[others], settings, on_progress=solving)
        report(words, (done + _SOLVING) / len(numbers))
        photograph, picture = (np.moveaxis(images[number], 0, -1) for images in (data, known))
        result = reconstruct(np.ascontiguousarray(photograph), np.moveaxis(solved.psf, 0, -1))
        psnr_db, image = fare(result.image.reshape(picture.shape), picture)
        flat_db = fare(np.zeros_like(picture), picture)[0]
        found.append(LeftOut(number, psnr_db, flat_db, image))
    return found
