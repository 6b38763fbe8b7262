"""The pictures of a video as OME-Zarr 0.5: one a chunk, float32, written by whoever computed them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.files.volumes import ome_attributes

if TYPE_CHECKING:
    import zarr

Floats = npt.NDArray[np.float32]


def create_output(
    path: Path,
    n_frames: int,
    picture_shape: tuple[int, ...],
    *,
    period_s: float | None,
    pitch_um: float | None,
    attributes: dict[str, Any],
) -> None:
    """Make the folder of a video whose pictures are still to come; they read as NaN until then.

    Parameters
    ----------
    picture_shape : tuple of int
        ``(height, width)`` or ``(height, width, 3)``; stored as ``t, y, x`` or ``t, c, y, x``.
    period_s : float, optional
        From frame to frame.
    pitch_um : float, optional
        Of the picture's pixels in the object.
    attributes : dict
        JSON-compatible, for the attribute ``diffuserbench``.
    """
    import zarr

    colour = len(picture_shape) == 3
    shape = (picture_shape[2], *picture_shape[:2]) if colour else picture_shape
    names = ["t", "c", "y", "x"] if colour else ["t", "y", "x"]
    group = zarr.open_group(path, mode="w", zarr_format=3)
    group.create_array(
        "0",
        shape=(n_frames, *shape),
        chunks=(1, *shape),
        dtype="float32",
        fill_value=np.nan,
        dimension_names=names,
    )
    group.attrs["ome"] = ome_attributes(path.name, names, {"t": period_s, "y": pitch_um, "x": pitch_um})
    group.attrs["diffuserbench"] = attributes


class VideoPictures:
    """The pictures of a video, to be read and written one by one.

    Parameters
    ----------
    path : Path
        The OME-Zarr folder.
    write : bool
    """

    def __init__(self, path: Path, *, write: bool = False) -> None:
        import zarr

        self.path = path
        self.array: zarr.Array[Any] = zarr.open_array(path / "0", mode="r+" if write else "r", zarr_format=3)
        self.attributes: dict[str, Any] = dict(zarr.open_group(path, mode="r").attrs)

    @property
    def period_s(self) -> float | None:
        """Time from picture to picture, where it is known."""
        multiscale = self.attributes["ome"]["multiscales"][0]
        if "unit" not in multiscale["axes"][0]:
            return None
        return float(multiscale["datasets"][0]["coordinateTransformations"][0]["scale"][0])

    def __len__(self) -> int:
        return int(self.array.shape[0])

    def read(self, index: int) -> Floats:
        """Return one picture, (height, width[, 3]); NaN where there is none."""
        picture = np.asarray(self.array[index], np.float32)
        return picture if picture.ndim == 2 else np.ascontiguousarray(np.moveaxis(picture, 0, 2))

    def is_written(self, index: int) -> bool:
        """Whether a picture is on the disk."""
        return self._file(index).exists()

    def write(self, index: int, picture: Floats) -> None:
        """Put a picture on the disk, whole or not at all."""
        self.array[index] = picture if picture.ndim == 2 else np.moveaxis(picture, 2, 0)
        with self._file(index).open("rb") as written:
            os.fsync(written.fileno())

    def _file(self, index: int) -> Path:
        return self.path / "0" / "c" / "/".join(map(str, (index, *(0,) * (self.array.ndim - 1))))
