"""Are these photographs of moved slides of beads? Judged by what a model of points explains of them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from recon.blind.point_step import Points
from recon.camera.registration import LOCAL_MEAN_PX
from recon.errors import InputError

Floats = npt.NDArray[np.float32]

LEAST_EXPLAINED = 0.75
"""Part of the structure above the noise that the beads have to explain."""
_STRUCTURE = 0.1  # of the fine structure's energy above the noise: with less there is nothing to explain
_SAME_BEAD_PX = 0.5  # a bead moved by less was not moved
_SAME_SLIDE = 0.7  # of the beads at the same places: the slide was not moved


def explained(data: Floats, model: Floats) -> float:
    """Return which part of the images' fine structure above the noise a model explains; 0 with none.

    Without what varies slowly, as any few points through a wide pattern make a haze.

    Parameters
    ----------
    data, model : ndarray, float32, (n_images, height, width)
    """
    from scipy import ndimage

    def fine(images: Floats) -> Floats:
        sigma = (0, LOCAL_MEAN_PX, LOCAL_MEAN_PX)
        return np.asarray(images - ndimage.gaussian_filter(images, sigma, mode="nearest"), np.float32)

    noise = float(np.median([_noise(image) for image in data])) ** 2 * data.size
    there = float(np.sum(fine(data) ** 2, dtype=np.float64))
    left = float(np.sum(fine(data - model) ** 2, dtype=np.float64))
    if there - noise < _STRUCTURE * there:
        return 0.0
    return 1 - max(left - noise, 0.0) / (there - noise)


def refuse_what_is_no_beads(data: Floats, model: Floats, beads: Sequence[Points]) -> None:
    """Raise where the images cannot be of slides of beads, moved in between and seen by one optics.

    Parameters
    ----------
    data, model : ndarray, float32, (n_images, height, width)
    beads : sequence of Points

    Raises
    ------
    InputError
        Saying what was found and what to do.
    """
    part = explained(data, model)
    if part < LEAST_EXPLAINED:
        raise InputError(
            f"The {sum(map(len, beads))} beads found explain {part:.0%} of what stands out of the noise in "
            f"these images ({LEAST_EXPLAINED:.0%} expected): are these photographs of some twenty separate "
            "beads each, taken by one camera in the dark? More light or a larger --window may help, too."
        )
    for first in range(len(beads)):
        for second in range(first + 1, len(beads)):
            one, other = beads[first].places, beads[second].places
            away = np.hypot(*(one[:, None] - other[None]).transpose(2, 0, 1))
            if np.mean(away.min(axis=1) < _SAME_BEAD_PX) > _SAME_SLIDE:
                raise InputError(
                    f"Images {first + 1} and {second + 1} show the same beads at the same places: the slide "
                    "was not moved between them. Move it, by any amount, and photograph it again."
                )


def _noise(image: Floats) -> float:
    """Return the standard deviation of an image's noise, from second differences along the diagonals."""
    second = image[2:, 2:] - 2 * image[1:-1, 1:-1] + image[:-2, :-2]
    return float(1.4826 * np.median(np.abs(second - np.median(second))) / np.sqrt(6))
