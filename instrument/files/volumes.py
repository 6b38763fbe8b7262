"""Volumes on disk: written as OME-Zarr 0.5, and opened to be looked at plane by plane.

What OME-Zarr says of an image (axes, steps, units, smaller levels to browse) is made here for frames and
calibrations too. Of an opened volume nothing is read that is not looked at.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import whole_file, whole_folder
from instrument.files.errors import FileError
from instrument.files.ome_tiff import annotation, facts_of, resolution
from instrument.files.pieces import piece_bytes
from instrument.files.reading import folder_bytes, require_file, require_plausible, stored_bytes
from instrument.files.tiff_pages import open_tiff

if TYPE_CHECKING:
    import tifffile

    from recon.camera.grid import Grid

EVEN = 0.01
"""Steps that differ by less than this part of the smallest are taken for even."""


def middle_step_um(z_um: npt.NDArray[np.float64]) -> float:
    """Return the step beside the middle plane, positive: what OME files get; NaN where it is not known."""
    if len(z_um) < 2:
        return float("nan")
    middle = min(len(z_um) // 2, len(z_um) - 2)
    return abs(float(z_um[middle + 1] - z_um[middle]))


def uneven_steps(z_um: npt.NDArray[np.float64]) -> str:
    """Say that planes are not evenly spaced, and which step an OME file has; empty where they are.

    ``z_um``, (n_z,), are the planes' depths, ascending or descending; not finite where they are not known.
    """
    steps = np.abs(np.diff(z_um))
    if len(steps) < 2 or not np.isfinite(steps).all() or np.ptp(steps) <= EVEN * steps.min():
        return ""
    return (
        f"steps of {steps.min():.4g} to {steps.max():.4g} µm. OME files know one step for all: "
        f"{middle_step_um(z_um):.4g} µm, that of the middle, is written. Other programs stretch the others."
    )


SUFFIXES = (".ome.zarr", ".zarr")
"""Names that ask for OME-Zarr."""
_BIG_TIFF_BYTES = 4_000_000_000
_SMALLEST_LEVEL = 128
"""Levels are halved laterally until the longer side is at most this many pixels."""


def is_zarr_name(path: Path) -> bool:
    """Whether a name asks for OME-Zarr."""
    return path.name.lower().endswith(SUFFIXES)


def stem_of(path: Path) -> str:
    """Return a name without its suffix, of which ``.ome.zarr`` is one."""
    suffix = next((s for s in SUFFIXES if path.name.lower().endswith(s)), path.suffix)
    return path.name[: len(path.name) - len(suffix)]


def write_volume_zarr(
    path: Path,
    planes: Iterable[npt.NDArray[np.float32]],
    shape: tuple[int, ...],
    grid: Grid,
    attributes: dict[str, Any],
) -> None:
    """Write a volume as OME-Zarr 0.5, whole or not at all, with one plane in memory.

    A folder of that name is replaced.

    Raises OSError when the disk is full or not writable; what was there before stays as it was.

    Parameters
    ----------
    path : Path
        The folder to be.
    planes : iterable of ndarray, float32
        (height, width) or (height, width, n_channels).
    shape : tuple of int
        That of all, with n_z in front. Stored as ``z, y, x`` or, in OME-Zarr's order, ``c, z, y, x``.
    grid : Grid
        OME-Zarr knows one voxel size for all planes: that of the middle one is written where it is known, and
        what :func:`grid_facts` says beside it in the group's attribute ``diffuserbench``.
    attributes : dict
        JSON-compatible; what else shall stand in the attribute ``diffuserbench``.
    """
    import zarr

    colour = len(shape) == 4
    channels = shape[3:]
    with whole_folder(path) as draft:
        group = zarr.open_group(draft, mode="w", zarr_format=3)
        names = ["c", "z", "y", "x"] if colour else ["z", "y", "x"]
        levels = [1]
        arrays: list[Any] = []
        height, width = shape[1:3]
        while True:
            array = group.create_array(
                str(len(arrays)),
                shape=(*channels, shape[0], height, width),
                dtype=np.float32,
                chunks=(1,) * (1 + len(channels)) + (height, width),
                dimension_names=names,
            )
            arrays.append(array)
            if max(height, width) <= _SMALLEST_LEVEL or min(height, width) < 2:
                break
            height, width = height // 2, width // 2
            levels.append(2 * levels[-1])
        white = 0.0
        for z, plane in enumerate(planes):
            pixels = np.moveaxis(plane, -1, 0) if colour else plane
            white = max(white, float(np.nanmax(plane, initial=0.0)))
            for array in arrays:
                array[..., z, :, :] = pixels
                pixels = _halved(pixels)
        told = ome_attributes(
            path.name,
            names,
            voxel_um(grid),
            levels=levels,
            origin=_origin_um(grid),
            more={"type": "local mean"},
        )
        if channels == (3,):
            told["omero"] = ome_channels(white or 1.0, colour=True)
        group.attrs["ome"] = told
        group.attrs["diffuserbench"] = attributes | {"words": _of_voxels(grid)} | grid_facts(grid)


def _halved(pixels: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Return the mean of 2 x 2 pixels."""
    height, width = (n // 2 for n in pixels.shape[-2:])
    blocks = pixels[..., : 2 * height, : 2 * width].reshape(*pixels.shape[:-2], height, 2, width, 2)
    means: npt.NDArray[np.float32] = blocks.mean(axis=(-3, -1), dtype=np.float32)
    return means


def write_volume_tiff(
    path: Path, planes: Iterable[npt.NDArray[np.float32]], shape: tuple[int, ...], grid: Grid
) -> None:
    """Write a volume as OME-TIFF, ``ZYX`` or ``ZCYX``, whole or not at all, with one plane in memory.

    ``planes`` are (height, width) or (height, width, n_channels), ``shape`` is that of all with n_z in front.
    The voxel size is that of the middle plane, where it is known; what :func:`grid_facts` says is annotated.

    Raises FileError or OSError when it cannot be written.
    """
    import tifffile

    colour = len(shape) == 4
    pages = (page for plane in planes for page in (np.moveaxis(plane, -1, 0) if colour else plane[None]))
    sizes = {f"PhysicalSize{axis.upper()}": size for axis, size in voxel_um(grid).items()}
    metadata: dict[str, Any] = {"axes": "ZCYX" if colour else "ZYX", **sizes}
    metadata |= {f"{name}Unit": "µm" for name in sizes}
    n_pages = shape[0] * (shape[3] if colour else 1)
    if origin := _origin_um(grid):
        places = {
            axis.upper(): np.repeat(grid.z_um, n_pages // shape[0])
            if axis == "z"
            else np.full(n_pages, place)
            for axis, place in origin.items()
        }
        metadata["Plane"] = {f"Position{axis}": list(map(float, where)) for axis, where in places.items()}
        metadata["Plane"] |= {f"Position{axis}Unit": ["µm"] * n_pages for axis in places}
    metadata["MapAnnotation"] = annotation({"words": _of_voxels(grid), **grid_facts(grid)})
    stored = (shape[0], shape[3], *shape[1:3]) if colour else shape
    big = 4 * int(np.prod(shape)) > _BIG_TIFF_BYTES
    with whole_file(path) as temporary, tifffile.TiffWriter(temporary, ome=True, bigtiff=big) as tiff:
        size = resolution(sizes.get("PhysicalSizeX"))
        tiff.write(pages, shape=stored, dtype=np.float32, photometric="minisblack", metadata=metadata, **size)


def voxel_um(grid: Grid) -> dict[str, float]:
    """Return the middle plane's voxel size; nothing where it is not known."""
    if not (np.isfinite(grid.pitch_um).all() and np.isfinite(grid.spacing_um).all()):
        return {}
    pitch = float(grid.pitch_um[len(grid.z_um) // 2])
    return {"z": middle_step_um(grid.z_um), "y": pitch, "x": pitch}


def _origin_um(grid: Grid) -> dict[str, float]:
    """Return where the first voxel's centre is: its depth, and from the axis; nothing where not known.

    Along rows and columns as they are stored: of a grid that is not upright these go against y and x.
    """
    voxel = voxel_um(grid)
    if not voxel or (np.diff(grid.z_um) < 0).any():  # told by a step and a place, planes go away from it
        return {}
    row, column = grid.centre
    return {"z": float(grid.z_um[0]), "y": -row * voxel["y"], "x": -column * voxel["x"]}


def grid_facts(grid: Grid) -> dict[str, Any]:
    """Return where a volume's voxels lie, JSON-compatible: None for what is not known."""
    return {
        "shape": list(grid.shape),
        "centre": list(grid.centre),
        "z_um": known(grid.z_um),
        "pitch_um": known(grid.pitch_um),
        "axis_um": None if grid.axis_um is None else grid.axis_um.tolist(),
        "upright": grid.upright,
    }


def _of_voxels(grid: Grid) -> str:
    """Say what the one voxel size of an OME file stands for."""
    if grid.is_metric:
        return "All voxels have one size; rows and columns go with y and x; values are light a voxel."
    if not voxel_um(grid):
        return "The size of the voxels is not known."
    return (
        "Perspective grid: voxels of plane z are pitch_um[z] wide, and the scale is the middle plane's. The "
        "planes stand upside down: rows and columns go against the scene's y and x. diffuserbench export "
        "--metric makes voxels of one size of it."
    )


def grid_of(facts: Mapping[str, Any], shape: tuple[int, int, int]) -> Grid:
    """Return the grid that :func:`grid_facts` told of, NaN for what it did not; of a volume of this shape."""
    from recon.camera.grid import Grid

    n_z, *size = shape
    z_um, pitch_um = (numbers(facts.get(name), (n_z,)) for name in ("z_um", "pitch_um"))
    if z_um is None or pitch_um is None:
        z_um = pitch_um = np.full(n_z, np.nan)
    centre = numbers(facts.get("centre"), (2,))
    row, column = (n // 2 for n in size) if centre is None else centre.astype(int).tolist()
    axis_um = numbers(facts.get("axis_um"), (n_z, 2))
    return Grid(shape, (row, column), z_um, pitch_um, None, axis_um, facts.get("upright") is True)


def numbers(value: Any, shape: tuple[int, ...]) -> npt.NDArray[np.float64] | None:
    """Return finite numbers of a shape, () for one; None where a record has something else."""
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError):
        return None
    return numbers if numbers.shape == shape and np.isfinite(numbers).all() else None


def metric_source(source: VolumeSource, grid: Grid, voxel_um: float | None = None) -> VolumeSource:
    """Return a volume on voxels of equal size; its planes are made when they are looked at.

    ``grid`` is that of ``source``, ``voxel_um`` the edge of a cube (default: see
    :func:`recon.camera.grid.metric_grid`). Closing the one closes the other.

    Raises InputError where the grid is not known or has one plane.
    """
    from recon.camera.grid import metric_grid, metric_planes

    metric = metric_grid(grid, voxel_um)
    made = metric_planes(source.plane, grid, metric)

    def read(z: Any, y: Any, x: Any) -> npt.NDArray[Any]:
        if isinstance(z, int):
            plane: npt.NDArray[Any] = made(z)
            return plane[y, x] if plane.ndim == 3 else plane[y, x, None]
        return np.stack([read(k, y, x) for k in range(*z.indices(metric.shape[0]))])

    facts = grid_facts(metric)
    return VolumeSource(source.path, [read], [metric.shape], source.n_channels, source.close, facts)


def known(values: npt.NDArray[np.float64]) -> list[float] | None:
    """Return numbers as JSON can hold them; None where one of them is not known."""
    return [float(v) for v in values] if np.isfinite(values).all() else None


_KINDS = {"t": ("time", "second"), "c": ("channel", ""), "z": ("space", "micrometer")}
_KINDS |= dict.fromkeys("yx", _KINDS["z"])


_COLOURS = {"red": "FF0000", "green": "00FF00", "blue": "0000FF"}


def ome_channels(white: float, *, colour: bool) -> dict[str, Any]:
    """Return OME's ``omero``: in which colours channels are shown, black at zero and white at ``white``."""
    window = {"min": 0, "max": white, "start": 0, "end": white}
    seen = _COLOURS if colour else {"grey": "FFFFFF"}
    return {"channels": [{"window": window, "color": c, "active": True, "label": n} for n, c in seen.items()]}


def ome_attributes(
    name: str,
    axes: Sequence[str],
    steps: Mapping[str, float | None],
    *,
    levels: Sequence[int] = (1,),
    origin: Mapping[str, float] | None = None,
    more: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the attribute ``ome`` of an image's group.

    Parameters
    ----------
    name : str
        Of the folder; its suffix is left off.
    axes : sequence of str
        Of ``t``, ``c``, ``z``, ``y``, ``x``, in the array's order.
    steps : mapping of axis to float or None
        From one to the next: seconds, micrometres. An axis that is not known, or not there, has no unit and
        the step 1.
    levels : sequence of int
        Lateral binning of each level, the first 1; the levels are called ``0``, ``1`` ...
    origin : mapping of axis to float, optional
        Where the first pixel lies, in the axis' unit.
    more : mapping, optional
        Further keys of the multiscale.
    """
    datasets = []
    for level, binning in enumerate(levels):
        scale = [(steps.get(a) or 1.0) * (binning if a in "yx" else 1) for a in axes]
        transformations: list[dict[str, Any]] = [{"type": "scale", "scale": scale}]
        # The centre of a larger pixel lies half of the difference away from that of the first small one.
        shift = {a: (steps.get(a) or 1.0) * (binning - 1) / 2 for a in axes if a in "yx"}
        place = [(origin or {}).get(a, 0.0) + shift.get(a, 0.0) for a in axes]
        if any(place):
            transformations.append({"type": "translation", "translation": place})
        datasets.append({"path": str(level), "coordinateTransformations": transformations})
    multiscale = {
        "name": name.removesuffix(".zarr").removesuffix(".ome"),
        "axes": [ome_axis(axis, known=bool(steps.get(axis))) for axis in axes],
        "datasets": datasets,
        **(more or {}),
    }
    return {"version": "0.5", "multiscales": [multiscale]}


def ome_axis(axis: str, *, known: bool) -> dict[str, str]:
    """Return an axis as OME-Zarr describes it; with its unit where its step is known."""
    kind, unit = _KINDS[axis]
    return {"name": axis, "type": kind, **({"unit": unit} if known and unit else {})}


Plane = npt.NDArray[np.float32]
_SIDE_PIXELS = 1 << 20
"""Slices along depth are read from the finest level whose planes are no larger: each touches every plane."""


class VolumeSource:
    """Voxels that are read when they are asked for; may be asked from any thread.

    Parameters
    ----------
    path : Path
        Where it lies, for messages.
    levels : sequence of callable
        ``read(z, y, x)`` takes slices or numbers and returns (..., n_channels); the finest level first.
    shapes : sequence of (int, int, int)
        ``(n_z, height, width)`` of each level.
    n_channels : int
    close : callable, optional
        Closes the files.
    facts : mapping
        What its file tells of its grid, as :func:`grid_facts` has it.
    """

    def __init__(
        self,
        path: Path,
        levels: list[Callable[[Any, Any, Any], npt.NDArray[Any]]],
        shapes: list[tuple[int, int, int]],
        n_channels: int,
        close: Callable[[], object] | None = None,
        facts: Mapping[str, Any] | None = None,
    ) -> None:
        self.path = path
        self.facts = facts or {}
        self.shape = shapes[0]
        self.n_channels = n_channels
        self._levels = levels
        self._shapes = shapes
        self._close = close
        self._lock = threading.Lock()  # readers of files are not made for several threads

    @property
    def n_bytes(self) -> int:
        """Bytes of all voxels, were they in memory."""
        return 4 * int(np.prod(self.shape)) * self.n_channels

    def plane(self, z: int) -> Plane:
        """Return a plane, float32 (height, width) or (height, width, n_channels)."""
        return self._read(self._levels[0], z, slice(None), slice(None))

    def across_y(self, y: int) -> Plane:
        """Return the slice at row ``y``, float32 (n_z, width[, n_channels]); coarser for large planes."""
        level = self._side_level()
        rows = self._shapes[level][1]
        row = min(y * rows // self.shape[1], rows - 1)
        return self._read(self._levels[level], slice(None), row, slice(None))

    def across_x(self, x: int) -> Plane:
        """Return the slice at column ``x``, float32 (n_z, height[, n_channels]); coarser as above."""
        level = self._side_level()
        columns = self._shapes[level][2]
        column = min(x * columns // self.shape[2], columns - 1)
        return self._read(self._levels[level], slice(None), slice(None), column)

    def close(self) -> None:
        """Close the files; nothing can be read afterwards."""
        if self._close is not None:
            with self._lock:
                self._close()

    def _side_level(self) -> int:
        for level, (_, height, width) in enumerate(self._shapes):
            if height * width <= _SIDE_PIXELS:
                return level
        return len(self._shapes) - 1

    def _read(self, read: Callable[[Any, Any, Any], npt.NDArray[Any]], z: Any, y: Any, x: Any) -> Plane:
        try:
            with self._lock:
                voxels = np.asarray(read(z, y, x), np.float32)
        except Exception as error:
            raise FileError(self.path, f"cannot be read at plane {z}: {error!s:.200}.") from error
        # A damaged voxel must not make the whole view blank.
        voxels = np.nan_to_num(voxels, nan=0.0, posinf=0.0, neginf=0.0)
        return voxels[..., 0] if self.n_channels == 1 else voxels


def open_volume(path: Path | str) -> VolumeSource:
    """Open a volume: OME-Zarr (``z, y, x`` or ``c, z, y, x``), TIFF (``ZYX``, ``ZCYX``, or pages), .npy.

    Raises FileError when it is no volume, or the file is damaged; it names the shape that was found.
    """
    path = Path(path)
    if not path.exists():
        raise FileError(path, "there is no such file.")
    if is_zarr_name(path) or (path / "zarr.json").is_file():
        return _open_zarr(path)
    if path.suffix.lower() == ".npy":
        return _open_npy(path)
    if path.suffix.lower() in (".tif", ".tiff"):
        return _open_tiff(path)
    raise FileError(path, "is no volume: an OME-Zarr folder, a TIFF or a .npy file is expected.")


def volume_in_memory(
    voxels: npt.NDArray[Any], path: Path, facts: Mapping[str, Any] | None = None
) -> VolumeSource:
    """Return a source of an array, (n_z, height, width) or (n_z, height, width, n_channels).

    ``path`` is what messages call it, ``facts`` as :class:`VolumeSource`. The array may be a memory map.

    Raises FileError when it has another number of axes, or no voxel.
    """
    if voxels.ndim not in (3, 4) or 0 in voxels.shape or voxels.dtype.kind not in "uif":
        raise FileError(
            path,
            f"holds {voxels.dtype} {voxels.shape}; a volume of real numbers is expected: planes, rows, "
            "columns, and perhaps channels.",
        )
    view = voxels[..., None] if voxels.ndim == 3 else voxels
    shape = (view.shape[0], view.shape[1], view.shape[2])
    return VolumeSource(path, [lambda z, y, x: view[z, y, x]], [shape], view.shape[3], facts=facts)


_SPARSE_BYTES = 1 << 33
"""An OME-Zarr leaves chunks of zeros out and is read plane by plane: a volume by l1 shrinks 500-fold."""


def _open_zarr(path: Path) -> VolumeSource:
    import zarr

    try:
        group: Any = zarr.open_group(path, mode="r")
        multiscale = group.attrs["ome"]["multiscales"][0]
        names = [axis["name"] for axis in multiscale["axes"]]
        facts = group.attrs.get("diffuserbench")
        arrays = [group[dataset["path"]] for dataset in multiscale["datasets"]]
        stored = folder_bytes(path, arrays[0].nbytes, [(path / one.path, piece_bytes(one)) for one in arrays])
        for array in arrays:
            require_plausible(path, array.nbytes, stored, small=_SPARSE_BYTES)
            if len(array.shape) != len(names) or 0 in array.shape:
                raise FileError(path, f"holds an array of shape {array.shape} for {len(names)} axes.")
            require_plausible(path, array.nbytes // array.shape[-3], stored)  # a plane
    except FileError:
        raise
    except Exception as error:
        raise FileError(path, f"is no OME-Zarr 0.5 image: {error!r:.200}.") from error
    if names not in (["z", "y", "x"], ["c", "z", "y", "x"]):
        raise FileError(path, f"has the axes {', '.join(names)}; a volume has z, y, x, or c before them.")

    def reader(array: Any) -> Callable[[Any, Any, Any], npt.NDArray[Any]]:
        if len(names) == 3:
            return lambda z, y, x: np.asarray(array[z, y, x])[..., None]
        return lambda z, y, x: np.moveaxis(np.asarray(array[:, z, y, x]), 0, -1)

    shapes = [(a.shape[-3], a.shape[-2], a.shape[-1]) for a in arrays]
    n_channels = 1 if len(names) == 3 else int(arrays[0].shape[0])
    facts = facts if isinstance(facts, Mapping) else None
    return VolumeSource(path, [reader(a) for a in arrays], shapes, n_channels, facts=facts)


def _open_npy(path: Path) -> VolumeSource:
    from instrument.files.decoding import require_npy

    try:
        require_npy(path)
        return volume_in_memory(np.load(path, mmap_mode="r", allow_pickle=False), path)
    except Exception as error:
        if isinstance(error, FileError):
            raise
        raise FileError(path, f"is no plain .npy array: {error}.") from error


def tiff_facts(tiff: tifffile.TiffFile) -> dict[str, Any]:
    """Return what this program annotated in an OME-TIFF; empty where it did not."""
    try:
        return {} if tiff.ome_metadata is None else facts_of(tiff.ome_metadata)
    except ValueError:
        return {}


def _open_tiff(path: Path) -> VolumeSource:
    """Map the file where it lies in one piece, else read it page by page."""
    import tifffile

    tiff = None
    try:
        require_file(path)
        tiff = open_tiff(path)
        series: Any = tiff.series[0]
        require_plausible(path, series.size * series.dtype.itemsize, stored_bytes(path))
    except FileError:
        if tiff is not None:
            tiff.close()
        raise
    except Exception as error:
        if tiff is not None:
            tiff.close()
        raise FileError(path, f"is no TIFF, or a damaged one: {error!r:.200}.") from error
    facts = tiff_facts(tiff)
    axes = series.axes.replace("S", "C")
    if len(axes) == 3 and axes.endswith("YX"):
        axes = "ZYX"  # a stack of pages from elsewhere: whatever its axis is called, it is the depth
    shape = dict(zip(axes, series.shape, strict=True))
    if axes not in ("ZYX", "ZCYX", "ZYXC"):
        tiff.close()
        raise FileError(
            path, f"holds {series.axes} {series.shape}; a volume (ZYX, with or without C) is expected."
        )
    if series.dataoffset is not None and series.dtype.byteorder in ("=", "|", "<"):
        tiff.close()
        try:
            mapped = tifffile.memmap(path, mode="r")
        except Exception as error:
            raise FileError(path, f"is damaged: {error!r:.200}.") from error
        return volume_in_memory(np.moveaxis(mapped, 1, -1) if axes == "ZCYX" else mapped, path, facts)
    per_plane = shape.get("C", 1) if axes == "ZCYX" else 1

    def read(z: Any, y: Any, x: Any) -> npt.NDArray[Any]:
        numbers = [z] if isinstance(z, int) else list(range(*z.indices(shape["Z"])))
        planes = []
        for number in numbers:
            pages = [series[number * per_plane + c].asarray() for c in range(per_plane)]
            whole = np.stack(pages, axis=-1) if axes != "ZYXC" else pages[0]
            planes.append(whole[y, x])
        return planes[0] if isinstance(z, int) else np.stack(planes)

    size = (shape["Z"], shape["Y"], shape["X"])
    return VolumeSource(path, [read], [size], shape.get("C", 1), tiff.close, facts)
