"""Arrays whose axes have names, and those that a file calls by name: OME-Zarr, HDF5 and MATLAB files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files import matlab, reading
from instrument.files.errors import FileError

Read = tuple[npt.NDArray[Any], tuple[str, ...]]
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def ordered(path: Path, array: npt.NDArray[Any], axes: str) -> Read:
    """Bring an array to one stack axis (where there is one), height, width, and colour (where there is one).

    ``axes`` has a letter an axis: Y and X, C or S for channels, others (Z, T, I ...) for images of a stack.
    Channels are colours when there are three of them, else images of a stack.

    Raises FileError when there are several axes besides.
    """
    axes = axes.upper()
    if len(axes) != array.ndim or "Y" not in axes or "X" not in axes:
        return array, ()
    if len(axes) == 3 and axes[0] in "QI" and array.shape[-1] in (1, 2, 3, 4):
        return array, ()  # written by name of nothing: a colour picture as arrays have it
    single = tuple(i for i, axis in enumerate(axes) if array.shape[i] == 1 and axis not in "YX")
    array = array.squeeze(single)
    axes = "".join(axis for i, axis in enumerate(axes) if i not in single)
    others = [axis for axis in axes if axis not in "YX"]
    colour = "S" if "S" in others else "C" if "C" in others and array.shape[axes.index("C")] == 3 else ""
    stack = [axis for axis in others if axis != colour]
    if len(stack) > 1:
        found = " x ".join(f"{array.shape[axes.index(axis)]} ({axis})" for axis in stack)
        raise FileError(
            path, f"holds images in {found}; one stack is expected.", "Save one of them as a file of its own."
        )
    wanted = "".join(stack) + "YX" + colour
    notes = []
    if wanted != axes:
        array = array.transpose([axes.index(axis) for axis in wanted])
        notes.append(f"axes {axes} brought to {wanted}")
    if stack == ["C"]:
        notes.append(f"its {len(array)} channels taken as the images of a stack")
    return array, tuple(notes)


# Files of several arrays ---------------------------------------------------------------------------
def is_hdf5(beginning: bytes) -> bool:
    """Whether a file that begins so is HDF5; MATLAB's, since 7.3, have a header of their own before."""
    return beginning.startswith(_HDF5_MAGIC) or beginning[512:520] == _HDF5_MAGIC


def is_matlab(beginning: bytes) -> bool:
    """Whether a file that begins so is MATLAB's, versions 5 to 7."""
    return beginning.startswith(b"MATLAB 5.0 MAT-file") and beginning[126:128] in (b"IM", b"MI")


def read_hdf5(path: Path, inside: str, *, of_matlab: bool = False) -> Read:
    """Read an array of an HDF5 file: the only one with two axes or more, or the one called ``inside``.

    ``of_matlab``: its axes are in MATLAB's order, the last first.

    Raises FileError when it is damaged, none or several arrays could be meant, its numbers are elsewhere, or
    h5py is not installed.
    """
    try:
        import h5py
    except ImportError:
        raise FileError(
            path, "is an HDF5 file, which h5py reads.", "Install it: pip install 'diffuserbench[hdf5]'."
        ) from None
    found: dict[str, tuple[int, ...]] = {}

    def note(name: str, entry: Any) -> None:  # links are not followed: they may lead out of the file
        if isinstance(entry, h5py.Dataset) and entry.dtype.kind in "biuf" and not name.startswith("#"):
            found[name] = entry.shape

    def read(name: str) -> npt.NDArray[Any]:
        if file[name].external or file[name].is_virtual:
            raise FileError(
                path, f"keeps the numbers of {name} in other files.", "Copy them into one file (h5repack)."
            )
        reading.require_plausible(path, file[name].nbytes, reading.stored_bytes(path))
        return np.asarray(file[name][()])

    try:
        with h5py.File(path, "r") as file:
            file.visititems(note)
            name, array = _chosen(path, found, inside, read)
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged file raises nearly anything
        raise FileError(path, f"is a damaged or unusual HDF5 file: {error!s:.200}.") from None
    return _of_matlab(name, array.T) if of_matlab else (array, (f"the array {name} taken",))


def read_matlab(path: Path, inside: str) -> Read:
    """Read an array of a MATLAB file of version 5 to 7; as :func:`read_hdf5`."""
    try:
        found = matlab.arrays_in(path)
        shapes = {name: array.shape for name, array in found.items()}
        name, array = _chosen(path, shapes, inside, lambda name: matlab.read_array(path, found[name]))
    except FileError:
        raise
    except (OSError, ValueError, EOFError, MemoryError, struct.error, zlib.error) as error:
        raise FileError(path, f"is a damaged or unusual MATLAB file: {error!s:.200}.") from None
    return _of_matlab(name, array)


def _chosen(
    path: Path, found: Mapping[str, tuple[int, ...]], inside: str, read: Callable[[str], npt.NDArray[Any]]
) -> tuple[str, npt.NDArray[Any]]:
    images = [name for name, shape in found.items() if sum(side > 1 for side in shape) >= 2]
    listed = ", ".join(f"{name} {found[name]}" for name in images[:8]) or "none"
    if inside and inside not in found:
        raise FileError(path, f"holds no array called {inside}; images could be: {listed}.")
    if not found:
        raise FileError(
            path,
            "holds no array of numbers by itself.",
            "Structures and cells are not read: save their arrays.",
        )
    if not inside and len(images) != 1:
        raise FileError(
            path, f"holds {len(images)} arrays that could be images: {listed}.", f"Name one: {path}::NAME."
        )
    name = inside or images[0]
    return name, read(name)


def _of_matlab(name: str, array: npt.NDArray[Any]) -> Read:
    """Put MATLAB's last axis, which counts images, first; three planes are a picture in colour."""
    notes = [f"the array {name} taken"]
    if array.ndim == 4 or (array.ndim == 3 and array.shape[-1] not in (1, 3)):
        array = np.moveaxis(array, -1, 0)
        notes.append(f"its last axis ({len(array)}) taken as that of the images")
    return array, tuple(notes)


# OME-Zarr ------------------------------------------------------------------------------------------
def is_zarr(folder: Path) -> bool:
    """Whether a folder is a Zarr group or array, of version 2 or 3."""
    return any((folder / name).is_file() for name in ("zarr.json", ".zgroup", ".zarray"))


def _only_series(folder: Path, group: Any) -> tuple[Any, str]:
    """Return the image of a collection of series that bioformats2raw made, where there is one.

    Raises FileError where there are several, with their paths.
    """
    series = sorted((name for name in group.group_keys() if name.isdecimal()), key=int)
    if len(series) != 1:
        paths = ", ".join(str(folder / name) for name in series[:4])
        raise FileError(folder, f"holds {len(series)} image series.", f"Name one: {paths}." if series else "")
    return group[series[0]], f"its image series {series[0]} taken"


def read_zarr(folder: Path) -> Read:
    """Read an OME-Zarr image (0.4 or 0.5) at its finest level, or a Zarr array.

    Raises FileError when it is none, is damaged, or has several stack axes.
    """
    import zarr

    try:
        group: Any = zarr.open(folder, mode="r")
        axes, notes = "", []
        if not isinstance(group, zarr.Array):
            if group.attrs.get("ome", group.attrs).get("bioformats2raw.layout") is not None:
                group, taken = _only_series(folder, group)
                notes.append(taken)
            facts = group.attrs.get("ome", group.attrs)["multiscales"][0]
            axes = "".join(str(a["name"] if isinstance(a, dict) else a) for a in facts.get("axes", "tczyx"))
            scales = facts["datasets"][0].get("coordinateTransformations", [{}])[0].get("scale", [])
            units = [a.get("unit", "") if isinstance(a, dict) else "" for a in facts.get("axes", ())]
            if "z" in axes and len(scales) == len(units) == len(axes):
                z = axes.index("z")
                notes += [f"planes every {scales[z]:g} {units[z]} as it says"] if units[z] else []
            group = group[facts["datasets"][0]["path"]]
        reading.require_plausible(folder, group.nbytes, reading.folder_bytes(folder, group.nbytes))
        array = np.asarray(group[...])
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - stores and codecs raise errors of many kinds
        raise FileError(folder, f"is no OME-Zarr image, or a damaged one: {error!r:.200}.") from None
    array, said = ordered(folder, array, axes)
    return array, (*notes, *said)
