"""The frames of a run as one OME-Zarr 0.5 image: Zarr version 3, one frame a chunk, uncompressed.

The metadata are written here rather than through a Zarr library, because only so can each chunk be synced
to the disk by itself, and because an uncompressed chunk is the frame's own bytes: no second copy at camera
speed. Tests read the result back with zarr-python and hold it against the OME-Zarr model library.
"""

from __future__ import annotations

import errno
import math
import os
import shutil
import zlib
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import make_folder, sync_folder, write_json
from instrument.files.errors import FileError
from instrument.files.ome_zarr import ome_attributes
from instrument.files.reading import parse_json, read_bytes, require_file
from instrument.runs.log import GONE
from recon.arrays import Array

_LEVEL = "0"
DESCRIPTIONS = f"{_LEVEL}/zarr.json", "zarr.json"
"""Files that describe the array and the image."""
_DTYPES = ("uint8", "uint16", "float32")
_FRAME_FILES = ("0/0", "0/0/0")
"""Of grey and of colour frames, below the frame's number."""


@dataclass(frozen=True, slots=True)
class StoredChunk:
    """A frame on the disk: its size and CRC-32."""

    n_bytes: int
    crc32: int


class _Draft(NamedTuple):
    """A chunk that is written, but not yet surely on the disk nor under its name."""

    handle: int
    path: Path
    chunk: StoredChunk


class SyncPool:
    """Puts many files and folders on the disk at the same time.

    Each sync ends with the disk emptying its cache, and the kernel joins such requests that come together:
    here, sixteen frames of 1.3 megapixels took a third of the time that they take one after the other.
    """

    def __init__(self, threads: int = 8) -> None:
        self._pool = ThreadPoolExecutor(threads, thread_name_prefix="sync")

    def files(self, handles: Iterable[int]) -> None:
        """Sync open files; returns, or raises the first error, when all have been tried."""
        self._all([self._pool.submit(_sync_file, handle) for handle in handles])

    def folders(self, paths: Iterable[Path]) -> None:
        """Sync folders; returns, or raises the first error, when all have been tried."""
        self._all([self._pool.submit(sync_folder, path) for path in paths])

    def close(self) -> None:
        """End the threads."""
        self._pool.shutdown()

    def _all(self, tasks: list[Future[None]]) -> None:
        try:
            wait(tasks)
        finally:
            wait(tasks)  # after Ctrl-C too: the caller closes the handles next
        for task in tasks:
            task.result()


def _sync_file(handle: int) -> None:
    os.fsync(handle)


class FrameArray:
    """Frames ``0 ... n_frames - 1`` of equal shape in the folder ``path``.

    On the disk the axes are ``t, y, x`` for grey and ``t, c, y, x`` for colour frames (OME-Zarr's order);
    :meth:`write` takes and :meth:`read` returns ``(height, width)`` or ``(height, width, 3)``.
    """

    def __init__(self, path: Path, description: dict[str, Any] | None = None) -> None:
        """Read the array's own description, unless one is given."""
        self.path = path
        described = description or parse_json(read_bytes(path / DESCRIPTIONS[0]))
        shape = tuple(int(side) for side in described["shape"])
        if len(shape) not in (3, 4) or min(shape[1:]) < 1 or described["data_type"] not in _DTYPES:
            raise ValueError(f"no frames have the shape {shape} and the type {described['data_type']!r:.40}")
        self.n_frames: int = shape[0]
        self.is_colour = len(shape) == 4
        self.frame_shape: tuple[int, ...] = (*shape[2:], shape[1]) if self.is_colour else shape[1:]
        self.dtype = np.dtype(described["data_type"])
        self._described = described

    @property
    def frame_bytes(self) -> int:
        """Size of one frame's file."""
        return int(math.prod(self.frame_shape) * self.dtype.itemsize)

    @staticmethod
    def is_there(path: Path) -> bool:
        """Whether an array was ever made in ``path``."""
        return (path / _LEVEL / "c").is_dir()

    @staticmethod
    def indices(path: Path) -> list[int]:
        """Return the frames of which there is an image, whole or not, in order."""
        folder = path / _LEVEL / "c"
        found = sorted(int(p.name) for p in folder.iterdir() if p.name.isdecimal()) if folder.is_dir() else []
        return [i for i in found if any((folder / str(i) / end).is_file() for end in _FRAME_FILES)]

    @cached_property
    def _sync(self) -> SyncPool:
        return SyncPool()

    def close(self) -> None:
        """End the threads that writing began, if any; reading needs no closing."""
        if "_sync" in self.__dict__:
            self._sync.close()
            del self.__dict__["_sync"]

    @classmethod
    def create(
        cls,
        path: Path,
        *,
        n_frames: int,
        frame_shape: tuple[int, ...],
        dtype: npt.DTypeLike,
        pixel_pitch_um: float,
        name: str,
    ) -> FrameArray:
        """Make an array without frames.

        ``frame_shape`` is ``(height, width)`` or ``(height, width, 3)``, the type uint8, uint16 or float32;
        the pitch that of stored pixels on the sensor, micrometres.
        """
        data_type = np.dtype(dtype).name
        if data_type not in _DTYPES:
            raise TypeError(f"Frames are stored as {', '.join(_DTYPES)}, not {data_type}.")
        array = description_of(n_frames, frame_shape, data_type)
        # Under another name until it is whole, so that a crash here leaves no half array behind.
        draft = cls.remove_draft(path)
        try:
            for folder in (draft, draft / _LEVEL, draft / _LEVEL / "c"):
                make_folder(folder)
            write_json(draft / DESCRIPTIONS[0], array)
            write_json(draft / DESCRIPTIONS[1], group_of(array["dimension_names"], pixel_pitch_um, name))
            draft.rename(path)
        except BaseException:  # a signal too: a recording that ends without a frame makes no other array
            cls.remove_draft(path)
            raise
        sync_folder(path.parent)
        return cls(path)

    @staticmethod
    def remove_draft(path: Path) -> Path:
        """Take away what a crash left of an array that was being made; returns where it would be."""
        draft = path.with_name(f".{path.name}.draft")
        shutil.rmtree(draft, ignore_errors=True)
        return draft

    def write(self, items: Sequence[tuple[int, Array]]) -> list[StoredChunk]:
        """Store frames and return once all of them are on the disk.

        Several at a time cost less than one by one, as folders are synced once for all.

        Raises ValueError when an index or an image does not fit the array; nothing is stored. Raises OSError
        when the disk is full or not writable. Frames that were there before stay as they were.
        """
        for index, image in items:
            if not 0 <= index < self.n_frames:
                raise ValueError(f"Frame {index} is outside the array of {self.n_frames} frames.")
            if image.shape != self.frame_shape or image.dtype != self.dtype:
                raise ValueError(
                    f"Frame {index} is {image.dtype} {image.shape}; "
                    f"the run stores {self.dtype} {self.frame_shape}."
                )
        # All of one kind before any of the next, and those at the same time: the file system commits its
        # journal once for all frames, where frame by frame it would several times for each.
        drafts: list[_Draft] = []
        try:
            for index, image in items:
                drafts.append(self._write_draft(index, image))
            self._sync.files(draft.handle for draft in drafts)
        except BaseException:
            for draft in drafts:
                draft.path.unlink(missing_ok=True)
            raise
        finally:
            for draft in drafts:
                os.close(draft.handle)
        top = self.path / _LEVEL / "c"
        folders: dict[Path, None] = {}
        for (index, _), draft in zip(items, drafts, strict=True):
            target = self.chunk_path(index)
            draft.path.replace(target)
            folders.update(dict.fromkeys(folder for folder in target.parents if folder.is_relative_to(top)))
        self._sync.folders(folders)
        return [draft.chunk for draft in drafts]

    def read(self, index: int) -> tuple[Array, int]:
        """Return one frame as it is on the disk, and the CRC-32 of its file.

        Raises FileNotFoundError when the frame is not there; FileError when its file has the wrong size.
        """
        path = self.chunk_path(index)
        if (there := require_file(path)) != self.frame_bytes:
            raise FileError(
                path,
                f"has {there} bytes; frame {index} takes {self.frame_bytes}: it is damaged.",
                "diffuserbench verify RUN names every damaged frame.",
            )
        flat = np.fromfile(path, dtype=self.dtype.newbyteorder("<"))
        crc32 = zlib.crc32(flat.data)
        flat = flat.astype(self.dtype, copy=False)
        if self.is_colour:
            height, width, channels = self.frame_shape
            return np.moveaxis(flat.reshape(channels, height, width), 0, -1), crc32
        return flat.reshape(self.frame_shape), crc32

    def resize(self, n_frames: int) -> None:
        """Change the number of frames that the array says it has."""
        self._described["shape"][0] = n_frames
        write_json(self.path / DESCRIPTIONS[0], self._described)
        self.n_frames = n_frames

    def describe(self, array: dict[str, Any], group: dict[str, Any]) -> None:
        """Write what the array and the image say of themselves."""
        for name, described in zip(DESCRIPTIONS, (array, group), strict=True):
            write_json(self.path / name, described)
        self._described, self.n_frames = array, int(array["shape"][0])

    def description_sums(self) -> dict[str, int]:
        """Return the CRC-32 of the files that describe the array and the image."""
        return {name: zlib.crc32(read_bytes(self.path / name)) for name in DESCRIPTIONS}

    def checksum(self, index: int) -> StoredChunk | None:
        """Return size and CRC-32 of a frame as it is on the disk, None where it is not."""
        path = self.chunk_path(index)
        if not path.is_file():
            return None
        data = path.read_bytes()
        return StoredChunk(len(data), zlib.crc32(data))

    def n_bytes(self, index: int) -> int | None:
        """Return the size of a frame's file, None where there is none."""
        try:
            return self.chunk_path(index).stat().st_size
        except OSError:
            return None

    def remove_half_written(self) -> None:
        """Take away what a crash left of frames that were being written."""
        for part in (self.path / _LEVEL / "c").glob(f"*/{'/'.join('0' * (len(self.frame_shape) - 1))}/part"):
            part.unlink()

    def chunk_path(self, index: int) -> Path:
        """Return the file that holds a frame."""
        return self.path / _LEVEL / "c" / str(index) / "/".join("0" * len(self.frame_shape))

    def _write_draft(self, index: int, image: Array) -> _Draft:
        """Write a frame's bytes beside the place they belong to; not synced yet."""
        planes = np.moveaxis(image, -1, 0) if self.is_colour else image
        data = np.ascontiguousarray(planes, dtype=self.dtype.newbyteorder("<")).data.cast("B")
        target = self.chunk_path(index)
        try:
            (self.path / _LEVEL / "c" / str(index)).mkdir(exist_ok=True)  # never a run's folder anew
        except FileNotFoundError as error:
            raise FileNotFoundError(errno.ENOENT, GONE, str(self.path)) from error
        target.parent.mkdir(parents=True, exist_ok=True)
        path = target.with_name("part")
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644)
        try:
            written = 0
            while written < len(data):
                written += os.write(handle, data[written:])
        except BaseException:
            os.close(handle)
            path.unlink(missing_ok=True)
            raise
        return _Draft(handle, path, StoredChunk(len(data), zlib.crc32(data)))


def description_of(
    n_frames: int, frame_shape: tuple[int, ...], data_type: str, axis: str = "t"
) -> dict[str, Any]:
    """Return what the array's own ``zarr.json`` holds; parameters as :meth:`FrameArray.create`.

    ``axis`` is that of the frames, t or z.
    """
    colour = len(frame_shape) == 3
    shape = [n_frames, *((frame_shape[2], *frame_shape[:2]) if colour else frame_shape)]
    return {
        "zarr_format": 3,
        "node_type": "array",
        "shape": shape,
        "data_type": data_type,
        "chunk_grid": {"name": "regular", "configuration": {"chunk_shape": [1, *shape[1:]]}},
        "chunk_key_encoding": {"name": "default", "configuration": {"separator": "/"}},
        "fill_value": "NaN" if data_type == "float32" else 0,
        "codecs": [
            {"name": "bytes", **({} if data_type == "uint8" else {"configuration": {"endian": "little"}})}
        ],
        "dimension_names": [axis, "c", "y", "x"] if colour else [axis, "y", "x"],
        "attributes": {},
    }


def group_of(
    axes: Sequence[str],
    pixel_pitch_um: float,
    name: str,
    step: float | None = None,
    first: float | None = None,
    more: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return what the image's ``zarr.json`` holds.

    Parameters
    ----------
    axes : sequence of str
        Of the array, the frames' first.
    pixel_pitch_um : float
    name : str
    step, first : float, optional
        Along the frames' axis, in its unit; None where steps are not even or not known, and where the first
        place is not known or the axis goes against the frames.
    more : mapping, optional
        Further attributes: ``omero`` of OME, ``diffuserbench`` beside it. They are known at a run's end.
    """
    rest = dict(more or {})
    steps = {axes[0]: step, "y": pixel_pitch_um, "x": pixel_pitch_um}
    ome = ome_attributes(name, axes, steps, origin=None if first is None else {axes[0]: first})
    if "omero" in rest:
        ome["omero"] = rest.pop("omero")
    return {"zarr_format": 3, "node_type": "group", "attributes": {"ome": ome, **rest}}
