"""A first PSF from images of many beads: align by cross-correlation, rank one (Kuo 2020, sec. 5.4).

Every image is the PSF at some twenty places. Shifted so that one of its beads lies on one of the reference's,
all images share that bead's PSF, while the other beads fall here and there; the first singular vector of the
aligned stack keeps what is shared. Aligning again to what was found pulls in images that had locked onto a
weak pair of beads.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.registration import displacement, shifted

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

ROUNDS = 4
"""Times the images are aligned: first to one of them, then to what was found."""


def first_psf(images: Array, psf_shape: tuple[int, int]) -> Floats:
    """Return a noisy PSF from images (n, height, width) with light, cut to ``psf_shape``; sum 1."""
    # The image with the highest peak over its energy has the fewest overlaps: the best to align to.
    reference = images[int(np.argmax(images.max(axis=(1, 2)) / np.linalg.norm(images, axis=(1, 2))))]
    found = reference
    for _ in range(ROUNDS):
        aligned = np.stack([_onto(image, found) for image in images])
        found = _shared(aligned)
        window = _brightest_window(found, psf_shape)
        kept = np.zeros_like(found)
        kept[window] = found[window]
        found = kept
    psf = centred(np.ascontiguousarray(found[window], np.float32))
    return np.asarray(psf / psf.sum(), np.float32)


def centred(psf: Array) -> Array:
    """Shift PSFs (..., height, width) by whole pixels so that the centre of light is the centre pixel."""
    rows, columns = offset_of(psf)
    return shifted(psf, -rows, -columns)


def offset_of(psf: Array) -> tuple[int, int]:
    """Return by how many pixels the centre of light of (..., height, width) lies off the centre pixel.

    The part above a tenth of the peak counts, so that a faint background does not pull it to the middle.
    """
    light = psf.reshape(-1, *psf.shape[-2:]).mean(axis=0, dtype=np.float64)
    light = np.where(light > 0.1 * light.max(), light, 0)
    total = light.sum()
    offsets = []
    for axis, n in enumerate(light.shape):
        mean = float(light.sum(axis=1 - axis) @ np.arange(n)) / total
        offsets.append(round(mean - n // 2))
    return offsets[0], offsets[1]


def _onto(image: Array, reference: Array) -> Array:
    rows, columns = displacement(image, reference)
    return shifted(image, -rows, -columns)


def _shared(aligned: Array) -> Array:
    """Rank-one approximation of a stack (n, height, width): its right singular vector, not negative.

    Before it, each pixel is limited to the stack's median and a little: a bead that one image alone has at a
    place would otherwise leave a ghost of its PSF there.
    """
    median = np.median(aligned, axis=0)
    limited = np.minimum(aligned, 1.5 * median)
    rows = limited.reshape(len(aligned), -1).astype(np.float64)
    _, vectors = np.linalg.eigh(rows @ rows.T)
    shared = (vectors[:, -1] @ rows).reshape(aligned.shape[1:])
    return np.asarray(np.maximum(shared * np.sign(shared.sum()), 0))


def _brightest_window(image: Array, shape: tuple[int, int]) -> tuple[slice, slice]:
    """Where a window of ``shape`` holds the most energy."""
    energy = np.pad(image.astype(np.float64) ** 2, ((1, 0), (1, 0))).cumsum(axis=0).cumsum(axis=1)
    h, w = (min(n, m) for n, m in zip(shape, image.shape, strict=True))
    inside = energy[h:, w:] - energy[:-h, w:] - energy[h:, :-w] + energy[:-h, :-w]
    row, column = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return slice(int(row), int(row) + h), slice(int(column), int(column) + w)
