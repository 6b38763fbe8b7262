"""Image files, 8 to 16 bit and float, grey and colour, single and stacked (formats: ``decoding``).

Arrays are ``(height, width)`` or ``(height, width, 3)`` in the order red, green, blue; stacks have one more
axis in front. The dtype is the file's own (uint8, uint16 or float32) and pixel values are never rescaled.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
import tifffile

from instrument.files import reading
from instrument.files.atomic import protect, whole_file, write_text
from instrument.files.decoding import DepthsError, decode, depths_told
from instrument.files.errors import BenchError, FileError
from instrument.files.image_folders import images_in, in_order, order_in_words
from instrument.files.named_arrays import is_zarr, read_zarr, zarr_facts
from instrument.files.ome_tiff import (
    depths_in_words,
    facts_of,
    film_facts,
    is_ome_name,
    resolution,
    tiff_depths,
    tiff_times,
    write_ome_tiff,
)
from instrument.files.pictures import (
    PLANES_AS_COLOURS,
    PLANES_AS_IMAGES,
    READABLE,
    Pixels,
    drop_alpha,
    one_image,
    refuse_non_finite,
    several_images,
    standard_dtype,
)
from instrument.files.seen import as_seen, levels_of, png_bytes
from instrument.files.tiff_pages import open_tiff
from instrument.files.tiffs import files_of
from recon.arrays import Array
from recon.base.arguments import require_argument, require_numbers
from recon.errors import InputError

WRITABLE = (".tif", ".tiff", ".png", ".npy")


@dataclass(frozen=True, slots=True, repr=False, eq=False)
class ImageFile:
    """What was read from an image file: NumPy takes it as an array, a notebook shows it."""

    path: Path
    pixels: Pixels
    """One image, or a stack with the images along the first axis; see the module."""
    notes: tuple[str, ...] = ()
    """What reading left out or converted, in sentences without full stop."""
    metadata: Mapping[str, Any] = field(default_factory=dict)
    """What :func:`write_image` kept with the image; empty for images from elsewhere."""
    array: str = ""
    """Which of a file's arrays, where it was named (``FILE::NAME``)."""

    @property
    def is_simulated(self) -> bool:
        """Whether its metadata say that no hardware took it."""
        return bool(self.metadata.get("simulated"))

    @property
    def is_colour(self) -> bool:
        """Whether a single image has three channels."""
        return self.pixels.ndim == 3

    @property
    def colours_are_guessed(self) -> bool:
        """Whether its three channels may as well be three images: nothing in its file tells."""
        return PLANES_AS_COLOURS in self.notes

    @property
    def is_stack(self) -> bool:
        """Whether it holds several images."""
        return self.pixels.ndim == 4 or (self.pixels.ndim == 3 and self.pixels.shape[-1] != 3)

    def describe(self) -> str:
        """Return size, channels and dtype in words, e.g. ``"1200 x 1600 grey uint16"``."""
        height, width = self.pixels.shape[:2]
        return f"{height} x {width} {'colour' if self.is_colour else 'grey'} {self.pixels.dtype}"

    def __array__(self, dtype: npt.DTypeLike | None = None, copy: bool | None = None) -> Array:
        """Return the pixels."""
        return np.array(self.pixels, dtype, copy=copy)

    if not TYPE_CHECKING:  # for who takes it for an array

        def __getattr__(self, name: str) -> Any:
            hint = f": take .pixels.{name}" if hasattr(np.ndarray, name) and name[:2] != "__" else ""
            raise AttributeError(f"An image of a file has no {name!r}{hint}.", name=name, obj=self)

        def __getitem__(self, _place: Any) -> Any:
            raise TypeError("An image of a file is cut by the option crop; .pixels is its array.")

    def __repr__(self) -> str:
        """Say in a line what it is."""
        if self.is_stack:
            return f"<{self.path}: {len(self.pixels)} images {self.pixels.shape[1:]} {self.pixels.dtype}>"
        return f"<{self.path}: {self.describe()}>"

    def _repr_png_(self) -> bytes | None:
        return None if self.is_stack else png_bytes(as_seen(self.pixels, raw=True))


def read_image(path: Path | str | ImageFile, *, holes: bool = False, several: str = "") -> ImageFile:
    """Read one image; one that was read already is returned. With ``holes`` it may have NaN pixels.

    ``several`` is what else helps who gives a stack.

    A folder with one image in it, as a photograph's run is, stands for that image. Three planes of NumPy's or
    MATLAB's are colours (:attr:`ImageFile.colours_are_guessed`), unless their file tells their depths.

    Raises FileError when the file is missing, another folder, empty, unreadable, no image, several images, or
    holds values that are no finite numbers.
    """
    if isinstance(path, ImageFile):
        if path.is_stack:
            raise several_images(path.path, len(path.pixels), several)
        refuse_non_finite(path.path, path.pixels, holes=holes)
        return path
    one = partial(one_image, several=several)
    _, name = _array_of(Path(path))
    path, array, notes = _decoded(_only_image(Path(path)), one)
    array, more = one(path, array)
    if (
        PLANES_AS_COLOURS in (*notes, *more)
        and depths_told(path, 3, image_metadata(path).get("depths_um"))[0]
    ):
        raise several_images(path, 3, several)
    pixels, converted = standard_dtype(path, array, holes=holes)
    return ImageFile(path, pixels, (*notes, *more, *converted), image_metadata(path), name)


def read_stack(path: Path | str, *, leave_out: Path | None = None) -> ImageFile:
    """Read a stack of images: a TIFF of several pages, an array of one more axis, an OME-Zarr, a folder.

    A folder's images are taken in the order of the depths that their names or Micro-Manager's metadata tell,
    else of their names, numbers by their value; all but the file ``leave_out``. They must agree in shape and
    dtype. The order is in the notes and the metadata (``files``, ``depths_um``). A single image is a stack of
    one. Errors as :func:`read_image`.
    """
    path = Path(path)
    if path.is_dir():
        return _read_folder(path, leave_out)
    return replace(_as_stack(*_decoded(path)), array=_array_of(path)[1])


def read(path: Path | str) -> ImageFile:
    """Read what a file holds, or a folder, ``path``: one image, or a stack. Errors as :func:`read_image`.

    Three planes of NumPy's or MATLAB's are a picture in colour, or a stack where their file tells depths.

    Returns
    -------
    ImageFile
        ``pixels`` uint8, uint16 or float32 in the file's own units, never rescaled: (height, width[, 3]), or
        a stack with one more axis in front; ``metadata`` that were kept with them.
    """
    if not isinstance(path, str | PathLike):
        raise BenchError(
            f"A file or folder is read by its name, not {type(path).__name__}; arrays are taken as they are."
        )
    if Path(path).is_dir() and not is_zarr(Path(path)) and len(images_in(Path(path))) != 1:
        return read_stack(path)
    try:
        image = read_image(path, holes=True)
    except FileError:
        try:
            return read_stack(path)
        except DepthsError:
            raise
        except FileError:
            pass
        raise
    return image


def write_image(path: Path | str, image: Array, metadata: Mapping[str, Any] | None = None) -> None:
    """Write one ``image`` (or, as TIFF or .npy, a stack), whole or not at all.

    The suffix of ``path`` chooses the format: ``.tif`` and ``.npy`` keep any dtype, ``.png`` takes uint8 and
    uint16.
    Colour of float32 is stored channel by channel, as ImageJ has it, with the levels that it is shown with.
    ``.ome.tif`` is an OME-TIFF, where ``metadata`` stand in OME's fields and a map annotation. They go into
    another TIFF's description (ImageJ's info of such colour), otherwise into a JSON file beside the image.

    Raises FileError when the suffix or the dtype does not fit, or the folder cannot be written to; OSError
    when the disk is full.
    """
    require_argument("path", path, Path)
    require_argument("metadata", metadata, Mapping | None)
    path = Path(path)
    expected = "an array (height, width[, channels]) of real numbers, or a stack"
    kinds = "uifbc" if path.suffix.lower() == ".npy" else "uifb"
    image = require_numbers("image", image, expected, kinds=kinds, least_axes=0 if kinds[-1] == "c" else 1)
    if (image.ndim < 2 and kinds[-1] != "c") or not image.size:
        raise InputError(f"image must be (height, width[, channels]), or a stack of such, not {image.shape}.")
    check_suffix(path)
    text = json.dumps(metadata, indent=1, default=str) if metadata is not None else None
    suffix = path.suffix.lower()
    if suffix == ".png" and (image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3)):
        raise FileError(path, f"PNG holds one image of uint8 or uint16, not {image.dtype} {image.shape}.")
    with whole_file(path) as temporary:
        if suffix == ".npy":
            np.save(temporary, image, allow_pickle=False)
        elif suffix == ".png":
            _write_png(temporary, image)
        elif is_ome_name(path) and image.ndim < 4:
            write_ome_tiff(temporary, image, metadata or {})
        else:
            _write_tiff(temporary, image, text, (metadata or {}).get("pixel_pitch_um"))
    if text is not None and suffix in (".png", ".npy"):
        write_text(side_car(path), text + "\n")


def side_car(path: Path | str) -> Path:
    """Return the JSON file that goes with an image file."""
    return Path(path).with_suffix(".json")


def check_suffix(path: Path | str) -> None:
    """Refuse a file name whose suffix is no format that can be written.

    Raises FileError.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in WRITABLE:
        found = f"{suffix!r} is no format to write images in" if suffix else "the name has no suffix"
        raise FileError(path, f"{found}; choose one of {', '.join(WRITABLE)}.")


_CFA_PATTERN, _COLOURS = 33422, "RGB"


def image_metadata(path: Path) -> dict[str, Any]:
    """Return the metadata kept with an image, its pixels unread; of another program's TIFF its colour mosaic.

    Empty where there are none, or the file cannot be read.
    """
    said: dict[str, Any] = zarr_facts(path) if is_zarr(path) else {}
    try:
        if path.suffix.lower() in (".tif", ".tiff"):
            with open_tiff(path) as tiff:
                page: Any = tiff.pages.first
                pattern = bytes(page.tags.valueof(_CFA_PATTERN, b""))
                if len(pattern) == 4 and max(pattern) < 3:
                    said = {"pixel_format": "Bayer" + "".join(_COLOURS[c] for c in pattern[:2])}
                said |= tiff_depths(tiff)
                if tiff.is_ome:
                    return said | film_facts(page.description) | facts_of(page.description)
                said |= tiff_times(tiff)
                text = (tiff.imagej_metadata or {}).get("Info") or page.description
        else:
            protect(side_car(path))
            text = reading.read_bytes(side_car(path)).decode()
        metadata = reading.parse_json(text)
    except (OSError, ValueError, TypeError, FileError, tifffile.TiffFileError):
        return said  # another program's description, or none: the pixels were read all the same
    return {**said, **metadata} if isinstance(metadata, dict) else said


# Folders -----------------------------------------------------------------------------------------
def _read_folder(folder: Path, leave_out: Path | None) -> ImageFile:
    if is_zarr(folder):
        array, notes = read_zarr(folder)
        return _as_stack(folder, array, notes)
    paths = images_in(folder)
    if leave_out is not None:
        paths = [p for p in paths if p.resolve() != leave_out.resolve()]
    if not paths:
        raise FileError(folder, f"holds no images ({READABLE}).", _folders_that_do(folder))
    if len(paths) == 1:  # Micro-Manager's folders may hold one file of all planes
        return read_stack(paths[0])
    if files_of(paths[0]) == {path.name for path in paths}:  # OME-TIFF with a file an image
        return read_stack(paths[0])
    paths, depths = in_order(folder, paths)
    first = read_image(paths[0])
    images = [first.pixels]
    for path in paths[1:]:
        image = read_image(path)
        if image.pixels.shape != first.pixels.shape or image.pixels.dtype != first.pixels.dtype:
            raise FileError(
                path,
                f"is {image.describe()}, but {first.path.name} is {first.describe()}: the images of a folder "
                "that is taken as one stack must be alike.",
                "Give a folder with nothing else in it, or a file by its name.",
            )
        images.append(image.pixels)
    stack: Pixels = np.stack(images)  # type: ignore[assignment]
    metadata = {"files": [path.name for path in paths], "depths_um": list(depths)}
    return ImageFile(folder, stack, (order_in_words(paths, depths), *first.notes), metadata)


def _only_image(path: Path) -> Path:
    if not path.is_dir() or is_zarr(path):
        return path
    inside = images_in(path)
    if len(inside) == 1:
        return inside[0]
    more = ", ..." if len(inside) > 4 else ""
    named = f"Images in it: {', '.join(one.name for one in inside[:4])}{more}."
    what = "is a folder; a file is expected" + ("" if inside else ", and it holds no images")
    raise FileError(path, f"{what}.", named if inside else _folders_that_do(path))


def _folders_that_do(folder: Path) -> str:
    try:
        inside = [path for path in sorted(folder.iterdir()) if path.is_dir() and images_in(path)]
    except OSError:  # of others
        return ""
    return f"Folders in it that do: {', '.join(map(str, inside[:4]))}." if inside else ""


def _as_stack(path: Path, array: Array, notes: tuple[str, ...]) -> ImageFile:
    if array.ndim > 3 and array.shape[-1] == 1:
        array = array[..., 0]
    while array.ndim > 3 and array.shape[0] == 1:
        array = array[0]
    if PLANES_AS_COLOURS in notes:
        array, notes = np.moveaxis(array, -1, 0), tuple(note for note in notes if note != PLANES_AS_COLOURS)
        notes += (PLANES_AS_IMAGES,)
    if array.ndim == 2 or (array.ndim == 3 and array.shape[-1] in (3, 4)):
        array, more = one_image(path, array)
        array = array[None]
    elif array.ndim == 4:
        array, more = drop_alpha(array)
    elif array.ndim == 3:
        more = ()
    else:
        raise FileError(path, f"holds an array of shape {array.shape}; a stack of images is expected.")
    pixels, converted = standard_dtype(path, array)
    told = image_metadata(path) if path.is_file() or is_zarr(path) else {}
    depths, words = depths_told(path, len(pixels), told.pop("depths_um", None))
    if depths:
        told["depths_um"] = depths
        words = (*words, depths_in_words(depths))
    return ImageFile(path, pixels, (*notes, *more, *converted, *words), told)


def _decoded(
    path: Path, expect: Callable[[Path, Array], object] = lambda *_: None
) -> tuple[Path, Array, tuple[str, ...]]:
    """Decode a file, a Zarr folder, or an array of a file (``FILE::NAME``); returns the file with it.

    ``expect`` refuses, before it is read, what is not wanted: it is given the file and zeros of its shape.
    """
    if is_zarr(path):
        return path, *read_zarr(path, expect=partial(expect, path))
    file, inside = _array_of(path)
    return file, *decode(file, inside, partial(expect, file))


def _array_of(path: Path) -> tuple[Path, str]:
    """Return a file and the name of its array, empty where none is named."""
    file, _, inside = str(path).partition("::")
    return (Path(file), inside) if inside and not path.exists() else (path, "")


# Writing ------------------------------------------------------------------------------------------
_BIG_TIFF_BYTES = 3_900_000_000


def _write_tiff(path: Path, image: Array, text: str | None, pitch_um: float | None) -> None:
    """Write a TIFF; ImageJ knows colour of floats only as channels, and no TIFF of over 4 GB."""
    colour = image.ndim >= 3 and image.shape[-1] == 3
    known = image.ndim <= 4 and image.dtype == np.float32 and image.nbytes < _BIG_TIFF_BYTES
    if colour and known and min(image.shape[-3:-1]) > 1:
        levels = levels_of(image.reshape(-1, *image.shape[-2:]))
        metadata: dict[str, Any] = {"axes": "ZCYX"[4 - image.ndim :], "mode": "composite"}
        metadata["Ranges"] = [level for white in levels.white for level in (levels.black, white)]
        if text is not None:
            metadata["Info"] = text
        channels = np.ascontiguousarray(np.moveaxis(image, -1, -3))
        tifffile.imwrite(path, channels, imagej=True, metadata=metadata)
        return
    photometric = "rgb" if colour else "minisblack"
    tifffile.imwrite(
        path,
        np.ascontiguousarray(image),
        photometric=photometric,
        description=text,
        metadata=None,
        **resolution(pitch_um),
    )


def _write_png(path: Path, image: Array) -> None:
    ordered = image[..., ::-1] if image.ndim == 3 else image
    done, data = cv2.imencode(".png", np.ascontiguousarray(ordered))
    if not done:
        raise FileError(path, f"could not be encoded as PNG: {image.dtype} {image.shape}.")
    path.write_bytes(data.tobytes())
