"""The measured sets: photographs and PSFs of real diffuser cameras, which tests and benchmarks look for.

They lie in the folder named by the environment variable ``DIFFUSERBENCH_DATA``, or in ``../shared/data``
beside the repository, and come from the Waller Lab (DiffuserCam, DiffuserCam-Tutorial, LenslessLearning).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from recon.arrays import Float32Array
from recon.errors import InputError

MeasuredSet = Literal["hand", "usaf"]
MEASURED: tuple[MeasuredSet, ...] = get_args(MeasuredSet)
HAND_DARK = np.s_[5:15, 5:15]
"""Pixels that no light reached: both files' black level is their mean."""
USAF_BLACK = 100


def data_folder() -> Path:
    """Return the folder of the measured sets; it need not exist."""
    beside = Path(__file__).resolve().parents[2] / "../shared/data"
    return Path(os.environ.get("DIFFUSERBENCH_DATA", beside))


@lru_cache(maxsize=2)
def measured_set(name: MeasuredSet) -> tuple[Float32Array, Float32Array]:
    """Return a set's PSFs and its photograph, black level subtracted; not to be written to.

    Raises InputError when the set is not there.

    Returns
    -------
    psfs : ndarray, (n_z, height, width)
        The nearest depth first. Of the hand one.
    photograph : ndarray, (height, width)
    """
    psfs, photograph = _READERS[name](data_folder())
    for array in (psfs, photograph):
        array.flags.writeable = False
    return psfs, photograph


@lru_cache(maxsize=1)
def measured_pairs() -> tuple[tuple[str, ...], Float32Array, Float32Array]:
    """Return names, photographs through the diffuser and the pictures they show; not to be written to.

    Raises InputError when the set is not there.

    Returns
    -------
    names : tuple of str
        In the order of the files.
    photographs, pictures : ndarray, (n, 3, height, width)
        Red, green, blue, black level subtracted; neither flipped, both centred.
    """
    folder = data_folder() / "diffusercam_pairs"
    names = tuple(file.stem.removeprefix("raw_") for file in _found(folder, "raw_*.npy"))
    photographs, pictures = (
        np.stack([np.moveaxis(np.load(folder / f"{kind}_{name}.npy"), -1, 0) for name in names])
        for kind in ("raw", "truth")
    )
    for array in (photographs, pictures):
        array.flags.writeable = False
    return names, photographs, pictures


def _found(folder: Path, pattern: str) -> list[Path]:
    if not (files := sorted(folder.glob(pattern))):
        raise InputError(
            f"The measured set {folder.name} is not there: no {pattern} in {folder.resolve()}. Name the "
            "folder that holds it in the environment variable DIFFUSERBENCH_DATA."
        )
    return files


def _files(folder: Path, pattern: str) -> list[Float32Array]:
    import cv2

    found = _found(folder, pattern)
    return [np.asarray(cv2.imread(str(file), cv2.IMREAD_UNCHANGED), np.float32) for file in found]


def _hand(root: Path) -> tuple[Float32Array, Float32Array]:
    folder = root / "diffusercam_hand"
    psf, photograph = (
        image - image[HAND_DARK].mean()
        for name in ("psf_sample.tif", "rawdata_hand_sample.tif")
        for image in _files(folder, name)
    )
    return np.maximum(psf, 0)[None], photograph


def _usaf(root: Path) -> tuple[Float32Array, Float32Array]:
    folder = root / "diffusercam_usaf3d"
    return np.stack(_files(folder, "psf*.tiff")), _files(folder, "image.tiff")[0] - USAF_BLACK


_READERS: Mapping[MeasuredSet, Callable[[Path], tuple[Float32Array, Float32Array]]] = {
    "hand": _hand,
    "usaf": _usaf,
}
