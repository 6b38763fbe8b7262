"""How good a PSF from photographs of known pictures is: how those fare that it was not made from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from recon.arrays import Array, Float32Array
from recon.base.blocks import block_mean
from recon.blind.known_pictures import PictureSettings, psf_from_pictures
from recon.reconstruction.reconstruct import reconstruct

Progress = Callable[[str, float], object]

POOR_DB = 3.0
"""Better than an even picture: with less a PSF explains nothing."""
_SHIFT_PX = 4  # that a reconstruction may be off the picture by
_SOLVING = 0.8  # of the work on a photograph; the rest is its reconstruction


@dataclass(frozen=True, slots=True)
class LeftOut:
    """A photograph reconstructed with the PSF from the others.

    Attributes
    ----------
    name : str
        Of the photograph.
    psnr_db : float
        As :func:`fare` gives it.
    flat_db : float
        What an even picture would have.
    image : ndarray, float32, (height, width, n_channels)
        The reconstruction, in the light that the picture shows.
    """

    name: str
    psnr_db: float
    flat_db: float
    image: Float32Array

    def to_json(self) -> dict[str, Any]:
        """Return what is kept of it with a calibration."""
        return {"name": self.name, "psnr_db": self.psnr_db, "even_db": self.flat_db}


def fare(image: Array, picture: Array) -> tuple[float, Float32Array]:
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
    best: tuple[float, Float32Array] = (-np.inf, np.empty(0, np.float32))
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


def judged_by(
    psf: Float32Array, photograph: Array, light: Array, name: str = "", binning: int = 1
) -> LeftOut:
    """Reconstruct a photograph by default options with a PSF that was not made from it.

    Parameters
    ----------
    psf, photograph : ndarray, (n_channels, height, width)
    light : ndarray, the same shape
        That it should show, linear.
    name : str, optional
        Of the photograph.
    binning : int
        Of all beforehand: the score hardly changes, the time with its square.

    Errors as ``reconstruct``.
    """
    data, known, truth = (
        np.ascontiguousarray(np.moveaxis(block_mean(images, binning, about_axis=True), 0, -1))
        for images in (photograph, psf, light)
    )
    result = reconstruct(data, known, judged=False)
    psnr_db, image = fare(result.image.reshape(truth.shape), truth)
    return LeftOut(name, psnr_db, fare(np.zeros_like(truth), truth)[0], image)


def leave_out(
    photographs: Array,
    pictures: Array,
    names: Sequence[str],
    settings: PictureSettings | None = None,
    *,
    only: Sequence[str] | None = None,
    binning: int = 1,
    on_progress: Progress | None = None,
) -> list[LeftOut]:
    """Reconstruct photographs, by default options, with the PSF that the others give.

    Parameters
    ----------
    photographs, pictures : ndarray, (n, n_channels, height, width)
        As :func:`~recon.blind.known_pictures.psf_from_pictures` takes them; judged for a peak of 1.
    names : sequence of str
        Of the photographs.
    settings : PictureSettings, optional
    only : sequence of str, optional
        Which are left out, one after the other; default all.
    binning : int
        Of both beforehand.
    on_progress : callable, optional
        Called with what is being done and the share done.

    Errors as ``psf_from_pictures`` and ``reconstruct``.
    """
    report = on_progress or (lambda _what, _share: None)
    data, known = (block_mean(images, binning, about_axis=True) for images in (photographs, pictures))
    known = known / known.max()
    found: list[LeftOut] = []
    left_out = names if only is None else only
    for name in left_out:
        words = f"photograph {name} left out"

        def solving(_what: str, share: float, words: str = words) -> None:
            report(words, (len(found) + _SOLVING * share) / len(left_out))

        number = list(names).index(name)
        others = np.arange(len(data)) != number
        solved = psf_from_pictures(data[others], known[others], settings, on_progress=solving)
        solving("", 1.0)
        found.append(judged_by(solved.psf, data[number], known[number] ** solved.gamma, name))
    return found
