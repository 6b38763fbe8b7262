"""Arrays whose axes have names, and those that a file calls by name: OME-Zarr, HDF5 and MATLAB files."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files import matlab, reading
from instrument.files.errors import FileError
from instrument.files.ome_tiff import MICROMETRES, MOST_PLANES, SECONDS
from instrument.files.pictures import PLANES_AS_COLOURS
from instrument.files.pieces import (
    MOST_LZF_EXPANSION,
    hdf5_pieces,
    lzf_place,
    piece_bytes,
    require_lzf_pieces,
    require_pieces,
    require_szip_pieces,
)
from recon.arrays import Array, Float64Array

Read = tuple[Array, tuple[str, ...]]
Expect = Callable[[Array], object]
"""Given zeros of the shape that will be read, which take no memory; raises where it is refused."""
_AXES = ("t", "c", "z", "y", "x", "s")
_COLOURS = {"S": (1, 2, 3, 4), "C": (3,)}
"""How many samples a pixel may have, or channels an image, to be colours; one may be alpha."""
_HDF5_MAGIC = b"\x89HDF\r\n\x1a\n"


def ordered(path: Path, array: Array, axes: str) -> Read:
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
    colour = next((a for a in "SC" if a in others and array.shape[axes.index(a)] in _COLOURS[a]), "")
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
    if stack in (["C"], ["S"]):
        notes.append(f"its {len(array)} channels taken as the images of a stack")
    return array, tuple(notes)


def outline(shape: Sequence[int], dtype: npt.DTypeLike) -> Array:
    """Return zeros of a shape, which take no memory."""
    return np.broadcast_to(np.zeros((), dtype), tuple(map(int, shape)))


def _anything(_array: Array) -> None:
    """Expect nothing."""


# Files of several arrays ---------------------------------------------------------------------------
def is_hdf5(beginning: bytes) -> bool:
    """Whether a file that begins so is HDF5; MATLAB's, since 7.3, have a header of their own before."""
    return any(beginning[at : at + 8] == _HDF5_MAGIC for at in (0, 512, 1024, 2048, 4096))


def is_matlab(beginning: bytes) -> bool:
    """Whether a file that begins so is MATLAB's, versions 5 to 7."""
    return beginning.startswith(b"MATLAB 5.0 MAT-file") and beginning[126:128] in (b"IM", b"MI")


def read_hdf5(path: Path, inside: str, *, of_matlab: bool = False, expect: Expect = _anything) -> Read:
    """Read an array of an HDF5 file: the only one with two axes or more, or the one called ``inside``.

    ``of_matlab``: its axes are in MATLAB's order, the last first. ``expect`` is asked before it is read.

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
        is_array = isinstance(entry, h5py.Dataset) and entry.shape is not None
        if is_array and entry.dtype.kind in "biuf" and not name.startswith("#"):
            found[name] = entry.shape

    def brought(name: str, array: Array) -> Read:
        if of_matlab:
            return _of_matlab(name, array.T)
        array, said = ordered(path, array, _letters([str(axis.label) for axis in file[name].dims]))
        return array, (f"the array {name} taken", *said)

    def read(name: str) -> Array:
        if file[name].external or file[name].is_virtual:
            raise FileError(
                path, f"keeps the numbers of {name} in other files.", "Copy them into one file (h5repack)."
            )
        stored = file[name].id
        expect(brought(name, outline(file[name].shape, file[name].dtype))[0])
        most = reading.MOST_EXPANSION if lzf_place(stored) is None else MOST_LZF_EXPANSION
        reading.require_plausible(path, file[name].nbytes, reading.stored_bytes(path), most=most)
        if file[name].chunks is not None and stored.get_create_plist().get_nfilters():
            require_lzf_pieces(path, stored, piece_bytes(file[name]))
            require_szip_pieces(path, stored, piece_bytes(file[name]))
            require_pieces(path, hdf5_pieces(stored), piece_bytes(file[name]))
        return np.asarray(file[name][()])

    try:
        with h5py.File(path, "r") as file:
            file.visititems(note)
            return brought(*_chosen(path, found, inside, read))
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - a damaged file raises nearly anything
        raise FileError(path, f"is a damaged or unusual HDF5 file: {error!s:.200}.") from None


def _letters(names: Sequence[Any]) -> str:
    """Return names of axes as :func:`ordered` takes them; empty where they are not all known."""
    known = all(str(name).lower() in _AXES for name in names)
    return "".join(str(name) for name in names) if known else ""


def read_matlab(path: Path, inside: str, *, expect: Expect = _anything) -> Read:
    """Read an array of a MATLAB file of version 5 to 7; as :func:`read_hdf5`."""

    def read(name: str) -> Array:
        expect(_of_matlab(name, outline(found[name].shape, np.uint8))[0])
        return matlab.read_array(path, found[name])

    try:
        found = matlab.arrays_in(path)
        name, array = _chosen(path, {name: array.shape for name, array in found.items()}, inside, read)
    except FileError:
        raise
    except (OSError, ValueError, EOFError, MemoryError, struct.error, zlib.error) as error:
        raise FileError(path, f"is a damaged or unusual MATLAB file: {error!s:.200}.") from None
    return _of_matlab(name, array)


def _chosen(
    path: Path, found: Mapping[str, tuple[int, ...]], inside: str, read: Callable[[str], Array]
) -> tuple[str, Array]:
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


def _of_matlab(name: str, array: Array) -> Read:
    """Put MATLAB's last axis, which counts images, first; three planes may be colours, which is said."""
    notes = [f"the array {name} taken"]
    if array.ndim == 3 and array.shape[-1] == 3:
        notes.append(PLANES_AS_COLOURS)
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


def read_zarr(folder: Path, *, expect: Expect = _anything) -> Read:
    """Read an OME-Zarr image (0.4 or 0.5) at its finest level, or a Zarr array; as :func:`read_hdf5`.

    Raises FileError when it is none, is damaged, or has several stack axes.
    """
    import zarr

    try:
        group: Any = zarr.open(folder, mode="r")
        axes, notes = "", []
        if isinstance(group, zarr.Array):
            names = getattr(group.metadata, "dimension_names", None) or group.attrs.get("_ARRAY_DIMENSIONS")
            axes = _letters(names if isinstance(names, list | tuple) else ())
        else:
            if _said(group).get("bioformats2raw.layout") is not None:
                group, taken = _only_series(folder, group)
                notes.append(taken)
            image = _image_of(folder, group)
            names = [axis["name"] if isinstance(axis, dict) else axis for axis in image.get("axes", "tczyx")]
            axes = "".join(map(str, names))
            group = group[image["datasets"][0]["path"]]
        expect(ordered(folder, outline(group.shape, group.dtype), axes)[0])
        held = reading.folder_bytes(folder, group.nbytes, [(folder / group.path, piece_bytes(group))])
        reading.require_plausible(folder, group.nbytes, held)
        array = np.asarray(group[...])
    except FileError:
        raise
    except Exception as error:  # noqa: BLE001 - stores and codecs raise errors of many kinds
        raise FileError(folder, f"is no OME-Zarr image, or a damaged one: {error!r:.200}.") from None
    array, said = ordered(folder, array, axes)
    return array, (*notes, *said)


def zarr_facts(folder: Path) -> dict[str, Any]:
    """Return what an OME-Zarr image says of its planes, frames and pixels, by the names of a photograph's.

    ``depths_um``, ``frame_period_s`` and ``pixel_pitch_um``, as far as it tells them with units.
    """
    import zarr

    try:
        group: Any = zarr.open(folder, mode="r")
        if isinstance(group, zarr.Array):
            return {}
        if _said(group).get("bioformats2raw.layout") is not None:
            group, _ = _only_series(folder, group)
        image = _image_of(folder, group)
        places = _places(image, group[image["datasets"][0]["path"]].shape)
    except Exception:  # noqa: BLE001 - what is wrong there is said by who reads its pixels
        return {}
    told: dict[str, Any] = {}
    if "z" in places and len(places["z"]) > 1:
        told["depths_um"] = places["z"].tolist()
    for axis, name in (("t", "frame_period_s"), ("x", "pixel_pitch_um")):
        if axis in places and len(places[axis]) > 1:
            told[name] = float(np.diff(places[axis])[0])
    return told


def _places(image: Mapping[str, Any], shape: Sequence[int]) -> dict[str, Float64Array]:
    """Return where an image's elements lie along each axis whose unit is known: micrometres, seconds."""
    level = image["datasets"][0]
    places = {}
    for number, axis in enumerate(image["axes"]):
        unit = (SECONDS if axis["name"] == "t" else MICROMETRES).get(axis.get("unit", "?"))
        at = np.arange(min(shape[number], MOST_PLANES), dtype=float)
        for transformed in (level, image):  # what is said of all levels follows
            for step in transformed.get("coordinateTransformations", ()):
                if step["type"] == "scale":
                    at = at * step["scale"][number]
                elif step["type"] == "translation":
                    at = at + step["translation"][number]
        if unit is not None:
            places[str(axis["name"])] = unit * at
    return places


def _said(group: Any) -> Any:
    return group.attrs.get("ome", group.attrs)


def _image_of(folder: Path, group: Any) -> Any:
    """Return what OME-Zarr says of a group's image; raises FileError where it says nothing."""
    if "multiscales" not in _said(group):
        inside = sorted([*group.array_keys(), *group.group_keys()])
        paths = ", ".join(str(folder / name) for name in inside[:4])
        raise FileError(
            folder,
            "is a Zarr group, but no OME-Zarr image.",
            f"Name what is meant of it: {paths}." if paths else "There is nothing in it.",
        )
    return _said(group)["multiscales"][0]
