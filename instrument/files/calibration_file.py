"""Save a calibration to disk and read it back.

A calibration is one folder that other programs can read::

    NAME/
      calibration.json    positions, geometry, quality, provenance, checksums
      psfs.ome.zarr/      OME-Zarr 0.5, float32, axes c, z, y, x: one PSF a source along z
      background.ome.zarr/    the same, axes c, y, x; only when a background was kept

Source positions need not be evenly spaced, which OME-Zarr cannot say: they stand in ``calibration.json``
(micrometres). The folder appears whole or not at all: it is written beside its place and renamed.
"""

from __future__ import annotations

import contextlib
import hashlib
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from instrument.files.atomic import DOUBTFUL, whole_folder
from instrument.files.errors import FileError
from instrument.files.ome_zarr import ome_attributes
from instrument.files.pieces import piece_bytes
from instrument.files.reading import folder_bytes, require_plausible
from instrument.files.record import RecordFormat
from recon.arrays import Array, Float32Array
from recon.base.arguments import require_argument
from recon.base.checks import require_calibration
from recon.types import Calibration, Geometry

if TYPE_CHECKING:
    import zarr

_JSON = "calibration.json"
_PSFS = "psfs.ome.zarr"
_BACKGROUND = "background.ome.zarr"
CALIBRATION_FILES = (_JSON, _PSFS, _BACKGROUND)
IN_SWEEP = "calibration"
"""A sweep's folder for the calibration that it was taken for."""
_RESTORE = "Take the calibration again or restore it from a copy."
_PLAIN_PSFS = (
    "PSF images by themselves tell no places: reconstruct takes one by --psf FILE, one a depth by "
    "--volume FOLDER."
)
_CUT_SWEEP = (
    "It is a run: a sweep makes its calibration in the end. Where it was cut short, go on with it: "
    "diffuserbench resume {}"
)
_FIELDS = ("shape", "source_positions_um", "geometry", "quality", "provenance", "sha256")


class CalibrationFileError(FileError):
    """A calibration cannot be written or read; the text names the file, what is wrong, and what to do."""


CALIBRATION = RecordFormat(
    "diffuserbench calibration",
    "calibration",
    restore=_RESTORE,
    fields=_FIELDS,
    error=CalibrationFileError,
)


def save_calibration(calibration: Calibration, folder: Path | str, *, overwrite: bool = False) -> Path:
    """Write ``calibration`` as a folder, whole or not at all.

    The ``folder``, and its parent where missing, is made by this call. ``overwrite`` replaces a calibration
    already there, never anything else.

    Returns
    -------
    Path
        The folder.

    Raises CalibrationFileError when something is there already, the place cannot be written, or the disk is
    full. What was there before is still there then.
    """
    require_calibration(calibration)
    require_argument("folder", folder, Path)
    target = Path(folder)
    if target.exists() and not overwrite:
        remedy = "Choose another name, or overwrite it: --force, in Python overwrite=True."
        raise CalibrationFileError(target, "exists already.", remedy)
    if target.exists() and not (target / _JSON).is_file():
        raise CalibrationFileError(target, "exists and is no calibration.", "It is not overwritten.")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationFileError(target, f"cannot be written: {error.strerror or error}.") from error
    try:
        with whole_folder(target) as draft:
            _write(calibration, draft)
    except OSError as error:
        raise CalibrationFileError(
            target, f"could not be written: {error.strerror or error}.", "Nothing was left half written."
        ) from error
    return target


def load_calibration(folder: Path | str) -> Calibration:
    """Read a calibration that :func:`save_calibration` wrote, checked against its checksums.

    Raises CalibrationFileError when the folder is missing, is no calibration, comes from a newer version, or
    is damaged.
    """
    path = Path(folder)
    record = _record(path)
    with CALIBRATION.damaged(path / _JSON):
        arrays = {name: _read_array(path / name, known) for name, known in _checksums(record).items()}
        psfs = np.ascontiguousarray(arrays[_PSFS].swapaxes(0, 1))
        return _made(record, path, psfs, arrays.get(_BACKGROUND))


def check_calibration(folder: Path | str, *, read: bool = True) -> None:
    """Raise what :func:`load_calibration` would raise, holding no more than one PSF at a time.

    ``read``: False looks at the record only, and whether its arrays are there.
    """
    path = Path(folder)
    record = _record(path)
    with CALIBRATION.damaged(path / _JSON):
        sources, *of_one = record["shape"]
        shapes = {_PSFS: (sources, *of_one), _BACKGROUND: tuple(of_one)}
        checksums = _checksums(record)
        for name, checksum in checksums.items():
            if not (path / name / "0").is_dir():
                raise CalibrationFileError(path / name, "is missing.", _RESTORE)
            if read:
                shapes[name] = _check_array(path / name, checksum)
        if read:
            channels, sources, *of_one = shapes[_PSFS]
            shapes[_PSFS] = (sources, channels, *of_one)
        blank = {name: np.broadcast_to(np.float32(0), shapes[name]) for name in checksums}
        _made(record, path, blank[_PSFS], blank.get(_BACKGROUND))


def is_calibration(folder: Path | str) -> bool:
    """Whether ``folder`` looks like a calibration (it holds a calibration.json)."""
    return (Path(folder) / _JSON).is_file()


def find_calibration(folder: Path) -> Path:
    """Return the calibration folder that ``folder`` is, or the one that it holds.

    Raises FileError when there is none, or more than one.
    """
    if not folder.is_dir():
        found = "is no folder" if folder.exists() else "does not exist"
        raise FileError(
            folder,
            f"{found}; a calibration or a run folder is expected.",
            "" if folder.is_dir() or not folder.exists() else _PLAIN_PSFS,
        )
    if is_calibration(folder):
        return folder
    # In the folder, in a run in it, or in that run's calibration folder (a demo's).
    patterns = ("*/calibration.json", "*/*/calibration.json")
    inside = sorted(path.parent for pattern in patterns for path in folder.glob(pattern))
    if len(inside) != 1:
        found = (
            f"{len(inside)} calibrations ({', '.join(p.name for p in inside)})"
            if inside
            else "no calibration"
        )
        plain = not inside and any(
            f.suffix.lower() in (".tif", ".tiff", ".png", ".npy") for f in folder.iterdir()
        )
        is_run = not inside and (folder / "state.json").is_file()
        remedy = _CUT_SWEEP.format(folder) if is_run else _PLAIN_PSFS if plain else ""
        raise FileError(folder, f"holds {found}; exactly one is expected.", remedy)
    return inside[0]


def calibration_name(folder: Path) -> str:
    """Return what a calibration is called: as its folder, or as the sweep whose folder that is in."""
    return folder.parent.name if folder.name == IN_SWEEP else folder.name


def calibrated_depths_um(folder: Path | str) -> tuple[float, ...]:
    """Return the depths that a calibration holds PSFs of, nearest first, without reading the PSFs.

    Empty where depths are not known.

    Raises CalibrationFileError.
    """
    path = Path(folder) / _JSON
    record = CALIBRATION.read(path)
    with CALIBRATION.damaged(path):
        depths = {float(place[2]) for place in record["source_positions_um"] if place[2] is not None}
    return tuple(sorted(z for z in depths if math.isfinite(z)))


def newest_calibration(runs: Path) -> Path | None:
    """Return the folder of the calibration that was written last below a folder of runs, no doubtful one."""
    found = [
        file
        for pattern in (f"*/{_JSON}", f"*/*/{_JSON}")
        for file in runs.glob(pattern)
        if not file.parent.name.startswith(DOUBTFUL)
    ]
    return max(found, key=lambda file: file.stat().st_mtime).parent if found else None


def _record(path: Path) -> dict[str, Any]:
    """Return what stands in a calibration's record."""
    if not path.exists():
        raise CalibrationFileError(path, "does not exist.")
    if not (path / _JSON).is_file():
        raise CalibrationFileError(path, f"is no calibration: it holds no {_JSON}.")
    return CALIBRATION.read(path / _JSON)


def _checksums(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the checksums of the arrays that a record is of, by their names: of the PSFs always."""
    known = record["sha256"]
    return {name: known[name] for name in (_PSFS, _BACKGROUND) if name == _PSFS or name in known}


def _made(
    record: Mapping[str, Any],
    path: Path,
    psfs: Float32Array,
    background: Float32Array | None,
) -> Calibration:
    """Return the calibration of a record and its arrays; errors of many kinds where they do not go together.

    The checksums are of values in a row: of how many rows and columns the record alone tells.
    """
    if list(psfs.shape) != record["shape"]:
        raise ValueError(f"its PSFs are {psfs.shape}, recorded is {record['shape']}")
    positions = [[math.nan if v is None else v for v in row] for row in record["source_positions_um"]]
    return Calibration(
        psfs=psfs,
        source_positions_um=np.array(positions, np.float64).reshape(-1, 3),
        background=background,
        geometry=CALIBRATION.value(Geometry, record["geometry"], path / _JSON),
        quality=record["quality"],
        provenance=record["provenance"],
    )


def _write(calibration: Calibration, folder: Path) -> None:
    pitch = calibration.geometry.pixel_pitch_um
    arrays = {_PSFS: np.ascontiguousarray(calibration.psfs.swapaxes(0, 1))}
    if calibration.background is not None:
        arrays[_BACKGROUND] = np.ascontiguousarray(calibration.background, np.float32)
    for name, array in arrays.items():
        _write_ome_zarr(array, folder / name, "czyx" if array.ndim == 4 else "cyx", pitch)
    record = {
        "shape": list(calibration.psfs.shape),
        "source_positions_um": [
            [None if math.isnan(v) else float(v) for v in row] for row in calibration.source_positions_um
        ],
        "geometry": calibration.geometry,
        "quality": calibration.quality,
        "provenance": calibration.provenance,
        "sha256": {name: _sha256(array) for name, array in arrays.items()},
    }
    (folder / _JSON).write_text(CALIBRATION.text(record, indent=2), encoding="utf-8")


def _write_ome_zarr(array: Float32Array, path: Path, axes: str, pitch_um: float | None) -> None:
    import zarr  # costs 0.3 s; only who reads or writes a calibration pays

    group = zarr.open_group(path, mode="w", zarr_format=3)
    chunks = (1,) * (array.ndim - 2) + array.shape[-2:]
    stored = group.create_array(
        "0", shape=array.shape, chunks=chunks, dtype="float32", dimension_names=list(axes)
    )
    stored[...] = array
    group.attrs["ome"] = ome_attributes(path.name, axes, {"y": pitch_um, "x": pitch_um})


def _read_array(path: Path, checksum: str) -> Float32Array:
    with _reading(path):
        array = np.ascontiguousarray(_stored(path)[...])
    _require_checksum(path, _sha256(array), checksum)
    return array.astype(np.float32, copy=False)


def _check_array(path: Path, checksum: str) -> tuple[int, ...]:
    """Return the shape of an array whose values have their checksum."""
    digest = hashlib.sha256()
    with _reading(path):
        stored = _stored(path)
        for place in np.ndindex(stored.shape[:-2]):
            digest.update(np.ascontiguousarray(stored[place]).data)
    _require_checksum(path, digest.hexdigest(), checksum)
    return stored.shape


def _stored(array: Path) -> zarr.Array[Any]:
    """Open an array on the disk; FileError where it says to be far larger than its files can hold."""
    import zarr

    stored = zarr.open_array(array / "0", mode="r")
    held = folder_bytes(array, stored.nbytes, [(array, piece_bytes(stored))])
    require_plausible(array, stored.nbytes, held)
    return stored


@contextlib.contextmanager
def _reading(array: Path) -> Iterator[None]:
    """Say of whatever reading an array raises that it is missing or damaged."""
    try:
        yield
    except FileError:
        raise
    except Exception as error:  # zarr's stores and codecs raise errors of many kinds for damaged files
        words = f"cannot be read ({error}): it is missing or damaged."
        raise CalibrationFileError(array, words, _RESTORE) from error


def _require_checksum(array: Path, found: str, recorded: str) -> None:
    if found != recorded:
        raise CalibrationFileError(
            array,
            f"does not have the checksum recorded in {_JSON}: its data were changed or damaged.",
            _RESTORE,
        )


def _sha256(array: Array) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).data).hexdigest()
