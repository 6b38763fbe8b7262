"""Which library's arrays: NumPy's in memory, CuPy's on a GPU."""

from __future__ import annotations

import importlib
from typing import Any, Literal

import numpy as np

from recon.arrays import Array
from recon.errors import InputError

Namespace = Any
"""A module with NumPy's functions: ``numpy`` or ``cupy``."""

Device = Literal["cpu", "gpu"]
DEVICES: tuple[Device, ...] = ("cpu", "gpu")


def array_namespace(device: Device) -> Namespace:
    """Return the module whose arrays live on a device.

    Raises InputError when there is no GPU, or no CuPy that fits it; the text says what to install.
    """
    if device == "cpu":
        return np
    if device != "gpu":
        raise InputError(f"The device {device!r} is not known. Choose cpu or gpu.")
    try:
        cupy = importlib.import_module("cupy")
    except ImportError as error:
        raise InputError(
            f"The device gpu needs CuPy, which could not be imported ({error}). Install it with "
            'pip install "diffuserbench[gpu]" (for CUDA 12; for another version install its CuPy).'
        ) from error
    try:
        count = int(cupy.cuda.runtime.getDeviceCount())
    except Exception as error:  # CuPy has an error class for each of CUDA's libraries
        raise InputError(
            f"The device gpu cannot be used: {error}. Check the driver with nvidia-smi."
        ) from error
    if count == 0:
        raise InputError(
            "The device gpu cannot be used: CUDA finds no GPU. Check the driver with nvidia-smi."
        )
    return cupy


def namespace_of(array: Any) -> Namespace:
    """Return the module that an array is of."""
    if isinstance(array, np.ndarray):
        return array.__array_namespace__()  # NumPy's, also of other packages' images that are its arrays
    return importlib.import_module(type(array).__module__.split(".")[0])


def to_host(array: Any) -> Array:
    """Return an array as one of NumPy; its own memory only where it comes from a GPU."""
    return np.asarray(array.get() if hasattr(array, "get") else array)


def require_memory(xp: Namespace, n_bytes: int) -> None:
    """Refuse what does not fit a GPU's free memory.

    Raises
    ------
    InputError
    """
    if xp is np:
        return
    free, _ = xp.cuda.runtime.memGetInfo()
    if n_bytes > free:
        raise InputError(
            f"On the GPU this needs {n_bytes / 2**30:.1f} GiB, and {free / 2**30:.1f} GiB are free. "
            "Bin the images, take fewer depths, or use the cpu, which needs a third of it."
        )
