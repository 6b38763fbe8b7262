"""What a video is read from and written to: a recording, pictures as OME-Zarr, one a chunk, float32."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drivers.frame import FrameMetadata
from instrument.files.atomic import whole_folder
from instrument.files.calibration_file import is_calibration
from instrument.files.errors import FileError
from instrument.files.ome_zarr import ome_attributes, ome_channels
from instrument.files.pieces import piece_bytes, require_pieces
from instrument.files.reading import MOST_TEXT_BYTES, require_file, require_plausible
from instrument.runs.run import Run
from instrument.volumes.grid_facts import grid_facts, grid_of, origin_um, voxel_um
from recon.arrays import Array, Float32Array

STILL = {"um": 0.5, "mrad": 0.02}
"""How far readings of a stage that stands may lie apart, by the unit that an axis' name ends in.

A mask 25 mm wide that turns by 0.02 mrad moves by 0.25 um at its edges: less than any pixel.
"""

_SAME: dict[str, Callable[[FrameMetadata], object]] = {
    "light": lambda m: m.led_pattern,
    "pattern on the SLM": lambda m: m.slm_image_hash,
    "exposure": lambda m: m.exposure_ms,
    "gain": lambda m: m.gain,
}
"""What all frames of a planned run must share to be a video of one scene, besides the stage's position."""


def require_video(run: Run) -> None:
    """Refuse a run that is no video: frames of a plan that moves or lights something, or a calibration.

    A recording is one; so is a plan that takes the same photograph again and again.

    Raises FileError with what differs from frame to frame, and what to do.
    """
    if not run.records:
        raise FileError(run.path, "has no frames to reconstruct.")
    planned = run.plan is not None
    if is_calibration(run.path) or (planned and any(run.path.glob("*/calibration.json"))):
        raise FileError(
            run.path,
            "holds a calibration: it is no video of a scene.",
            "Give the recording as RUN and this as --calibration: were the two swapped?",
        )
    if not planned:
        return
    stands = _stands([record.metadata.stage_position for record in run.records.values()])
    if differing := [*([] if stands else ["stage position"]), *changed_settings(run)]:
        raise FileError(
            run.path,
            f"is the run of a plan, no video: its frames differ in {' and '.join(differing)}.",
            "Record a video with 'diffuserbench record'. Single frames: 'diffuserbench export' writes them, "
            "'reconstruct --image' takes each.",
        )


def changed_settings(run: Run) -> list[str]:
    """Return which settings of light, SLM and camera are not the same for all frames, in words."""
    frames = [record.metadata for record in run.records.values()]
    return [what for what, of in _SAME.items() if len({of(frame) for frame in frames}) > 1]


def _stands(positions: Sequence[Mapping[str, float]]) -> bool:
    """Tell whether all positions have the same axes, each at one place as far as readings tell."""
    axes = set(positions[0])
    if any(set(position) != axes for position in positions):
        return False
    for axis in axes:
        readings = [position[axis] for position in positions]
        # An axis of another unit has no tolerance.
        if not np.ptp(readings) <= STILL.get(axis.rsplit("_", 1)[-1], 0.0):
            return False
    return True


if TYPE_CHECKING:
    import zarr

    from recon.camera.grid import Grid


def create_output(
    path: Path,
    n_frames: int,
    picture_shape: tuple[int, ...],
    *,
    period_s: float | None,
    grid: Grid | None,
    attributes: dict[str, Any],
) -> None:
    """Make the folder of a video whose pictures are still to come; they read as NaN until then.

    Parameters
    ----------
    picture_shape : tuple of int
        ``([n_z,] height, width[, 3])``; stored as ``t, [c,] [z,] y, x``.
    period_s : float, optional
        From frame to frame.
    grid : Grid, optional
        Where the pixels lie in the object. One voxel size holds for all planes: the middle one's, as of a
        volume; what :func:`~instrument.volumes.grid_facts.grid_facts` says stands in
        the attribute ``diffuserbench``.
    attributes : dict
        JSON-compatible, for the attribute ``diffuserbench``.
    """
    import zarr

    deep = grid is not None and grid.shape[0] > 1
    colour = len(picture_shape) == 3 + deep
    shape = (picture_shape[-1], *picture_shape[:-1]) if colour else picture_shape
    names = ["t", *(["c"] if colour else []), *(["z"] if deep else []), "y", "x"]
    steps: dict[str, float | None] = {"t": period_s}
    if grid is not None:
        attributes = attributes | grid_facts(grid)
        steps |= voxel_um(grid)
    with whole_folder(path) as draft:
        group = zarr.open_group(draft, mode="w", zarr_format=3)
        group.create_array(
            "0",
            shape=(n_frames, *shape),
            chunks=(1, *shape),
            dtype="float32",
            fill_value=np.nan,
            dimension_names=names,
        )
        origin = origin_um(grid) if grid is not None and deep else None
        group.attrs["ome"] = ome_attributes(path.name, names, steps, origin=origin)
        group.attrs["diffuserbench"] = attributes


class VideoPictures:
    """The pictures or volumes of a video, to be read and written one by one.

    ``path``: the OME-Zarr folder.
    """

    def __init__(self, path: Path, *, write: bool = False) -> None:
        import zarr

        self.path = path
        self.array: zarr.Array[Any] = zarr.open_array(path / "0", mode="r+" if write else "r", zarr_format=3)
        self.attributes: dict[str, Any] = dict(zarr.open_group(path, mode="r").attrs)

    @property
    def axes(self) -> str:
        """Names of the array's axes, such as ``"tyx"`` or ``"tczyx"``."""
        return "".join(axis["name"] for axis in self.attributes["ome"]["multiscales"][0]["axes"])

    @property
    def period_s(self) -> float | None:
        """Time from picture to picture, where it is known."""
        multiscale = self.attributes["ome"]["multiscales"][0]
        if "unit" not in multiscale["axes"][0]:
            return None
        return float(multiscale["datasets"][0]["coordinateTransformations"][0]["scale"][0])

    @property
    def calibrated_px(self) -> tuple[float, float, float, float] | None:
        """Top, left, bottom and right between the outermost PSFs, where they vary over the field."""
        box = self.attributes.get("diffuserbench", {}).get("calibrated_px")
        return None if box is None else (box[0], box[1], box[2], box[3])

    @property
    def grid(self) -> Grid | None:
        """Where pixels and planes lie in the object; None where the file does not tell."""
        facts = self.attributes.get("diffuserbench", {})
        sizes = dict(zip(self.axes, self.array.shape, strict=True))
        if "pitch_um" not in facts and "z" not in sizes:
            return None
        return grid_of(facts, (sizes.get("z", 1), sizes["y"], sizes["x"]))

    def __len__(self) -> int:
        return int(self.array.shape[0])

    def require_sound(self) -> None:
        """Refuse what is no film: other axes, other chunks than a picture each, figures that are none.

        Raises FileError, or whatever reading such figures raises.
        """
        if self.axes not in ("tyx", "tcyx", "tzyx", "tczyx") or len(self.axes) != self.array.ndim:
            raise FileError(self.path, f"has the axes {self.axes!r:.40} of {self.array.ndim}: no film's.")
        if self.array.chunks != (1, *self.array.shape[1:]):
            raise FileError(self.path, f"has chunks of {self.array.chunks}: a film has one a picture.")
        _ = self.grid, [float(edge) for edge in self.calibrated_px or ()]
        if self.period_s is not None and not 0 < self.period_s < np.inf:
            raise FileError(self.path, f"says {self.period_s:g} s from picture to picture.")

    @property
    def written(self) -> tuple[int, ...]:
        """Which pictures are on the disk."""
        folder = self.path / "0" / "c"
        names = [entry.name for entry in folder.iterdir()] if folder.is_dir() else []
        indices = sorted(int(name) for name in names if name.isascii() and name.isdecimal())
        return tuple(index for index in indices if index < len(self) and self.is_written(index))

    def read(self, index: int) -> Float32Array:
        """Return one picture or volume, ([n_z,] height, width[, 3]); NaN where there is none.

        Raises FileError when it is damaged.
        """
        try:
            self._require_picture(index)
            picture = np.asarray(self.array[index], np.float32)
        except FileError:
            raise
        except Exception as error:
            raise FileError(self.path, f"picture {index} cannot be read: {error!s:.200}.") from error
        return np.ascontiguousarray(np.moveaxis(picture, 0, -1)) if "c" in self.axes else picture

    def flat(self, index: int) -> Float32Array:
        """Return one picture, (height, width[, 3]); of a volume each pixel's light of all depths."""
        picture = self.read(index)
        return picture.sum(axis=0) if "z" in self.axes else picture

    def is_written(self, index: int) -> bool:
        """Whether a picture is on the disk."""
        return self._file(index).exists()

    def write(self, index: int, picture: Float32Array) -> None:
        """Put a picture on the disk, whole or not at all; OSError names the folder."""
        try:
            self.array[index] = np.moveaxis(picture, -1, 0) if "c" in self.axes else picture
        except OSError as error:  # zarr's has no name
            raise OSError(error.errno, error.strerror, str(self.path)) from error
        with self._file(index).open("rb") as written:
            os.fsync(written.fileno())

    def say_white(self, indices: Sequence[int]) -> None:
        """Say in OME's own words how bright the pictures of these indices are, where they are in colour."""
        import zarr

        if "c" in self.axes:
            _, white = levels_of(self.read(index) for index in indices)
            self.attributes["ome"] = {**self.attributes["ome"], "omero": ome_channels(white, colour=True)}
            zarr.open_group(self.path, mode="r+").attrs["ome"] = self.attributes["ome"]

    def remove(self, index: int) -> None:
        """Take a picture away, where there is one."""
        self._file(index).unlink(missing_ok=True)

    def remove_litter(self) -> None:
        """Remove what killed programs had begun to write; nobody may be writing now."""
        for begun in self.path.rglob("*.partial"):  # zarr's own name for it
            begun.unlink(missing_ok=True)

    def _require_picture(self, index: int) -> None:
        """Refuse a picture that is no file, or inflates to more than a picture, before memory is taken."""
        file, holds = self._file(index), piece_bytes(self.array)
        if os.path.lexists(file):
            require_file(file, 2 * holds + MOST_TEXT_BYTES)
            require_plausible(self.path, holds, file.stat().st_size, most=_MOST_EXPANSION)
            require_pieces(self.path, [(file.stat().st_size, lambda: file.open("rb"))], holds)

    def _file(self, index: int) -> Path:
        return self.path / "0" / "c" / "/".join(map(str, (index, *(0,) * (self.array.ndim - 1))))


_MOST_EXPANSION = 50_000
"""Zeros shrink 32,000-fold by zstd, nothing more."""
DEFAULT_FPS = 25.0
SAMPLES = 24
"""Pictures looked at to find black and white of all."""


def samples_of(indices: Sequence[int]) -> list[int]:
    """Return at most :data:`SAMPLES` of a video's pictures, spread over all of it."""
    chosen = np.unique(np.linspace(0, len(indices) - 1, SAMPLES).round().astype(int))
    return [indices[place] for place in chosen]


BLACK_PERCENTILE, WHITE_PERCENTILE = 0.5, 99.8


def levels_of(pictures: Iterable[Array]) -> tuple[float, float]:
    """Return black and white for pictures to be shown alike: percentiles over all of them, NaN left out."""
    values = [picture[np.isfinite(picture)][::7] for picture in pictures]
    together = np.concatenate([v for v in values if v.size] or [np.zeros(1)])
    low, high = np.percentile(together, (BLACK_PERCENTILE, WHITE_PERCENTILE))
    return float(low), float(high) if high > low else float(low) + 1.0
