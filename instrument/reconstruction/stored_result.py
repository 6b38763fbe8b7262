"""Reconstructions on disk: listed, read back with their story in words, written for other programs."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, fields, replace
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import protect, refuse_input, whole_file
from instrument.files.calibration_file import find_calibration, load_calibration, save_calibration
from instrument.files.decoding import require_npy
from instrument.files.errors import FileError, size
from instrument.files.images import read_image, write_image
from instrument.files.ome_zarr import is_zarr_name, stem_of
from instrument.files.orientation import AS_IT_IS, Orientation
from instrument.files.reading import parse_json, read_bytes, require_file
from instrument.files.record import of_kind
from instrument.files.seen import as_seen
from instrument.files.tiff_pages import open_tiff
from instrument.volumes.grid_facts import grid_of
from instrument.volumes.opening import open_volume
from instrument.volumes.source import VolumeSource, metric_source
from instrument.volumes.writing import write_volume_tiff, write_volume_zarr
from recon.arrays import Float32Array, Float64Array
from recon.camera.grid import Grid
from recon.errors import InputError
from recon.reconstruction.psf_refinement import as_refined
from recon.solvers.base import IterationRecord
from recon.verdict.judge import Region

_HISTORY = [{"iteration!": float, "seconds!": float}]
_TOLD: dict[str, Any] = {
    "inputs": {
        "image": (str, {"path!": str, "taken": {}}),
        "psf": (str, {"path!": str}),
        "calibration": str,
        "dark": {},
    },
    "provenance": {
        "psf_refinement": {},
        "auto": {"decisions": [{"name!": object, "value!": object, "why!": object}]},
    },
    "verdict": {"sentences": [object]},
    "uncertainty": {"sentences": [object]},
    "warnings": [object],
    "history": _HISTORY,
    "histories": [_HISTORY],
    "stop_reasons": [object],
    "noise_norm": float,
    "tau": float,
    "seconds": float,
    "grid": {"shape": [int], "object_pitch_um": float, "pixel_mrad": float},
}
"""What is read of a record: a type, or what an object or a list holds, or one of several; ! is needed."""


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A reconstruction on disk."""

    path: Path
    """The image's or volume's file or folder."""
    image: Float32Array | None
    """float32, (height, width) or (height, width, 3): the picture; None for a volume."""
    volume: VolumeSource | None
    """The volume; None for a picture. Close it in the end."""
    record: Mapping[str, Any]
    """What was written beside it; empty for results from elsewhere."""
    deviation: Float32Array | None = None
    """Standard deviation of a picture's pixels, as it; None where it was not asked for."""
    residual: Float32Array | None = None
    """What is left of the data, in units of their noise; None where a verdict says what it is worth."""

    def __repr__(self) -> str:
        """Say in a line what it is."""
        return f"<{self.path}: {self._size()}{'; ' * bool(self.verdict)}{' '.join(self.verdict[:1])}>"

    @property
    def inputs(self) -> list[Path]:
        """The files that it was made of, as far as they are known, and its own."""
        named = self.record.get("inputs")
        values = named.values() if isinstance(named, Mapping) else ()
        named = [value.get("path") if isinstance(value, Mapping) else value for value in values]
        return [self.path, *(Path(value) for value in named if isinstance(value, str) and value)]

    @property
    def taken(self) -> str:
        """When its photograph was taken, how long it was exposed and what was lit, as far as is known."""
        image = self.record.get("inputs", {}).get("image")
        told = image.get("taken", {}) if isinstance(image, Mapping) else {}
        words = []
        with contextlib.suppress(KeyError, ValueError):
            words.append(f"{datetime.fromisoformat(str(told['utc'])).astimezone():%Y-%m-%d %H:%M:%S}")
        with contextlib.suppress(KeyError, ValueError):  # a photograph's file may say anything
            words.append(f"{float(str(told['exposure_ms'])):.4g} ms")
        return ", ".join([*words, f"light: {told['light']}"] if "light" in told else words)

    @property
    def simulated(self) -> bool:
        """Whether any of its input is known to come from the simulated bench."""
        return bool(self.record.get("simulated"))

    @property
    def warnings(self) -> tuple[str, ...]:
        """What may be wrong with it, in sentences: the verdict first, where it is not favourable."""
        verdict = self.verdict if self._region in (Region.NEAR, Region.OUTSIDE) else ()
        return (*verdict, *(str(text) for text in self.record.get("warnings", ())))

    @property
    def verdict(self) -> tuple[str, ...]:
        """Whether to trust it, in sentences; empty where it was not judged."""
        return tuple(str(text) for text in (self.record.get("verdict") or {}).get("sentences", ()))

    @property
    def _region(self) -> str:
        return str((self.record.get("verdict") or {}).get("region", Region.UNKNOWN))

    @property
    def histories(self) -> tuple[tuple[IterationRecord, ...], ...]:
        """The iterations, one history a channel; empty where there were none, or nothing is known."""
        raw = self.record.get("histories", [self.record.get("history", [])])
        return tuple(tuple(_iteration(entry) for entry in history) for history in raw if history)

    @property
    def noise_norm(self) -> float | None:
        """Expected norm of the noise, in the units of the histories' residuals."""
        value = self.record.get("noise_norm")
        return None if value is None else float(value)

    @property
    def pitch_um(self) -> float | None:
        """Pixel pitch of a picture in the object's plane, micrometres; None where not known."""
        value = self._grid("object_pitch_um") if self.volume is None else None
        return None if value is None else float(value)

    @property
    def planes_um(self) -> tuple[Float64Array, Float64Array] | None:
        """Depth and lateral pitch of each plane of a volume, micrometres; None where not known."""
        grid = self.grid
        known = grid is not None and np.isfinite(grid.z_um).all() and np.isfinite(grid.pitch_um).all()
        return (grid.z_um, grid.pitch_um) if grid is not None and known else None

    @property
    def grid(self) -> Grid | None:
        """Where a volume's voxels lie, NaN for what is not known; None for a picture."""
        if self.volume is None:
            return None
        return grid_of({**self.record.get("grid", {}), **self.volume.facts}, self.volume.shape)

    def metric(self, voxel_um: float | None = None) -> StoredResult:
        """Return the volume on voxels of equal size, upright; made plane by plane as it is looked at.

        ``voxel_um`` is the edge of a cube, by default as wide as the middle plane's pixels and as deep as
        the step beside it.

        Raises FileError where this is a picture, or where its planes lie is not known.
        """
        grid = self.grid
        if self.volume is None or grid is None:
            raise FileError(self.path, "is a picture, whose pixels are of equal size already.")
        try:
            volume = metric_source(self.volume, grid, voxel_um)
        except InputError as error:
            told = np.isfinite(grid.z_um).all() and np.isfinite(grid.pitch_um).all()
            how = "" if told else "Of PSFs from files --pixel-um and --distance-mm of reconstruct say them."
            raise FileError(self.path, str(error), how) from error
        return replace(self, volume=volume)

    def voxels_in_words(self) -> str:
        """Say where a volume's voxels lie that are all of one size, and how much they take."""
        grid = self.grid
        assert grid is not None
        assert grid.is_metric
        n_z, height, width = grid.shape
        (x, y, z), (x_end, y_end, z_end) = grid.place_um(0, 0, 0), grid.place_um(-1, height - 1, width - 1)
        pitch, deep = grid.pitch_um[0], grid.spacing_um[0]
        return (
            f"{n_z} x {height} x {width} of {deep:.4g} x {pitch:.4g} x {pitch:.4g} um (z, y, x); "
            f"z {z / 1e3:.5g} to {z_end / 1e3:.5g}, y {y / 1e3:.4g} to {y_end / 1e3:.4g}, "
            f"x {x / 1e3:.4g} to {x_end / 1e3:.4g} mm; {size(4 * int(np.prod(grid.shape)))}"
        )

    @property
    def fitted_from(self) -> Path | None:
        """The calibration whose PSFs were fitted to the photograph; None where none were."""
        record = self.record
        refinement = (record.get("provenance") or {}).get("psf_refinement") or {}
        calibration = (record.get("inputs") or {}).get("calibration")
        return Path(str(calibration)) if calibration and refinement.get("used") else None

    def keep_fitted(self, runs: Path) -> Path:
        """Save the calibration with its PSFs as they were fitted to the photograph, in a folder of its own.

        Returns the folder of the calibration, below that of the runs.

        Raises FileError when there is none, the calibration is not there any more, or the disk is full.
        """
        if self.fitted_from is None:
            raise FileError(self.path, "was not made with a calibration whose PSFs were fitted to it.")
        calibration = load_calibration(find_calibration(self.fitted_from))
        made = as_refined(calibration, self.record["provenance"]["psf_refinement"])
        folder = runs / f"{time.strftime('%Y-%m-%d_%H-%M-%S')}_fitted-to-{stem_of(self.path)}"
        return save_calibration(made, folder / "calibration")

    def facts(self) -> list[tuple[str, str]]:
        """Return what is known of it as names and values, to be shown; verdict and model first."""
        record = self.record
        origin = record.get("provenance", {})
        facts: list[tuple[str, str]] = []
        if self.verdict:
            facts.append(("Verdict", " ".join(self.verdict)))
        if said := (record.get("uncertainty") or {}).get("sentences"):
            facts += [(name, str(one)) for name, one in zip(("Uncertainty", "Points"), said, strict=False)]
        if refined := (origin.get("psf_refinement") or {}).get("words"):
            facts.append(("Refined PSF", str(refined)))
        chosen = self._chosen()
        facts += chosen
        if record and "Model" not in dict(chosen):
            model = record.get("model") or origin.get("model") or "convolution"
            reason = record.get("model_reason") or origin.get("model_reason") or "one PSF for the whole field"
            facts.append(("Model", f"{model}: {reason}"))
        if record:
            method = record.get("method")
            weight = "" if record.get("tau") is None else f", tau {record['tau']:.3g}"
            name = f"{method}, prior" if method else "prior"
            facts.append(("Method", f"{name} {record.get('prior')}{weight}"))
            facts.append(("Stopped", self._stopped()))
        facts.append(("Size", self._size()))
        inputs = record.get("inputs", {})
        for name, key in (("Photograph", "image"), ("PSF", "psf"), ("Calibration", "calibration")):
            if value := inputs.get(key):
                facts.append((name, str(value["path"]) if isinstance(value, Mapping) else str(value)))
                if key == "image" and self.taken:
                    facts.append(("Taken", self.taken))
        if dark := inputs.get("dark"):
            facts.append(("Dark", str(dark.get("from"))))
        if erased := inputs.get("erased"):
            facts.append(("Erased", str(erased)))
        if "binning" in inputs:
            facts.append(("Averaged", f"{inputs['binning']} x {inputs['binning']} pixels"))
        if memory := origin.get("memory"):
            facts.append(("Memory", str(memory)))
        if record:
            facts.append(("Made", f"{record.get('utc', '')} by {record.get('program', '')}"))
        return facts

    def _chosen(self) -> list[tuple[str, str]]:
        """Return what the program chose and why, one entry a choice."""
        decisions = (self.record.get("provenance", {}).get("auto") or {}).get("decisions", ())
        return [
            (
                str(d["name"]).capitalize(),
                f"{d['value']}: {d['why']}{' (as asked)' if d.get('overruled') else ''}",
            )
            for d in decisions
        ]

    def close(self) -> None:
        """Close a volume's files."""
        if self.volume is not None:
            self.volume.close()

    def _grid(self, key: str) -> Any:
        return self.record.get("grid", {}).get(key)

    def _stopped(self) -> str:
        reasons = self.record.get("stop_reasons") or [self.record.get("stop_reason")]
        count = max((len(history) for history in self.histories), default=0)
        seconds = f"{self.record.get('seconds', 0.0):.1f} s"
        if not count:
            return f"solved in one step, {seconds}"
        return f"after {count} iterations, {seconds}: {reasons[0]}"

    def _size(self) -> str:
        if self.volume is None:
            assert self.image is not None
            text = " x ".join(map(str, self.image.shape)) + " pixels"
            angle = self._grid("pixel_mrad")
            sizes = [] if self.pitch_um is None else [_length(self.pitch_um)]
            sizes += [] if angle is None else [f"{angle:.3g} mrad"]
            return f"{text} of {' or '.join(sizes)}" if sizes else text
        colours = f", {n} channels" if (n := self.volume.n_channels) > 1 else ""
        text = " x ".join(map(str, self.volume.shape)) + f" voxels (planes, rows, columns){colours}"
        if (planes := self.planes_um) is not None:
            z_um = planes[0]
            text += f"; {_length(z_um[0])} to {_length(z_um[-1])} from the diffuser"
        return text


def open_result(path: Path | str) -> StoredResult:
    """Open a picture or volume, by its own file or by the JSON record or preview beside it.

    A volume's voxels are read when they are looked at. An image or volume from elsewhere opens too; nothing
    is known of it then.

    Raises FileError when it is none, or its record is damaged.
    """
    path = _data_file(Path(path))
    protect(path, record_file(path))
    record = _read_record(record_file(path))
    if is_zarr_name(path) or path.is_dir() or _is_volume(path, record):
        return StoredResult(path, None, open_volume(path), record)
    pixels = read_image(path).pixels
    deviation = _beside(path, (record.get("uncertainty") or {}).get("file"))
    residual = _beside(path, record.get("residual"))
    return StoredResult(path, np.asarray(pixels, np.float32), None, record, deviation, residual)


def _beside(path: Path, name: str | None) -> Float32Array | None:
    """Read what was written beside a picture; None where it is no more."""
    beside = path.with_name(Path(str(name)).name)
    if name is None or not beside.is_file():
        return None
    protect(beside)
    return np.asarray(read_image(beside).pixels, np.float32)


def record_file(path: Path) -> Path:
    """Return the JSON file that goes with a picture or volume."""
    return path.with_name(f"{stem_of(path)}.json")


def _data_file(path: Path) -> Path:
    """Return the picture or volume that a record or a preview goes with; any other path as it is."""
    if not path.exists():
        raise FileError(path, "there is no such file.")
    if path.suffix.lower() not in (".json", ".png"):
        return path
    stem = path.with_suffix("")
    beside = [
        stem.with_name(stem.name + suffix) for suffix in (".tif", ".tiff", ".ome.zarr", ".zarr", ".npy")
    ]
    found = next((candidate for candidate in beside if candidate.exists()), None)
    if found is not None:
        return found
    if path.suffix.lower() == ".json":
        raise FileError(path, "no .tif or .ome.zarr of that name lies beside this record.")
    return path


def _read_record(path: Path) -> dict[str, Any]:
    """Return a record as it was written, without what is null of what is read; empty where there is none.

    Raises FileError where it is damaged, with the name of the part that is of another kind.
    """
    if not path.is_file():
        return {}
    try:
        record = parse_json(read_bytes(path))
    except (OSError, ValueError) as error:
        raise FileError(path, f"cannot be read as JSON: {error}.") from error
    # Another program's JSON, or that of another kind of file of ours, is no record of this one.
    if not isinstance(record, dict) or not isinstance(record.get("grid"), dict):
        return {}
    try:
        told: dict[str, Any] = of_kind(record, _TOLD)
    except TypeError as error:
        raise FileError(
            path,
            f"is damaged: {error}.",
            "Reconstruct again, or move it away: the image alone is kept then.",
        ) from None
    return told


def _is_volume(path: Path, record: Mapping[str, Any]) -> bool:
    if record:
        return len(record["grid"].get("shape", ())) == 3
    if path.suffix.lower() in (".tif", ".tiff"):
        try:
            require_file(path)
            with open_tiff(path) as tiff:
                series = tiff.series[0]
                colours = "S" in series.axes or (series.axes, series.shape[0]) == ("CYX", 3)
                return len(series.shape) == 4 or (len(series.shape) == 3 and not colours)
        except Exception:  # noqa: BLE001 - a damaged TIFF raises nearly anything
            return False  # reading it as an image then says what is wrong
    if path.suffix.lower() == ".npy":
        try:
            require_npy(path)
            shape = np.load(path, mmap_mode="r", allow_pickle=False).shape
        except Exception:  # noqa: BLE001 - a damaged header raises nearly anything
            return False
        return len(shape) == 4 or (len(shape) == 3 and shape[-1] not in (1, 3, 4))
    return False


def _iteration(entry: Mapping[str, Any]) -> IterationRecord:
    """Return a written record; what JSON cannot hold (NaN) was written as null."""
    known = {f.name for f in fields(IterationRecord)}
    values: dict[str, Any] = {k: np.nan if v is None else v for k, v in entry.items() if k in known}
    return IterationRecord(**values)


def _length(um: float) -> str:
    return f"{um:.3g} um" if um < 1000 else f"{um / 1000:.4g} mm"


Advance = Callable[[int, int], object]
PICTURE_SUFFIXES = (".tif", ".tiff", ".npy", ".png")
VOLUME_SUFFIXES = (".tif", ".tiff", ".npy", ".ome.zarr", ".zarr")


def export_result(
    result: StoredResult,
    target: Path | str,
    *,
    orientation: Orientation = AS_IT_IS,
    overwrite: bool = False,
    advance: Advance | None = None,
) -> None:
    """Write a picture or volume in the format that the target's name asks for, whole or not at all.

    Raises FileError when the name asks for no format that there is, something is there already, or it cannot
    be written; OSError when the disk is full.

    Parameters
    ----------
    target : Path
        A picture: ``.tif`` and ``.npy`` (float32) or ``.png`` (8 bit, as the preview). A volume: ``.tif``
        (OME-TIFF), ``.npy`` or ``.ome.zarr``, all plane by plane.
    orientation : Orientation
        How a picture is turned and mirrored.
    advance : callable, optional
        ``advance(planes done, planes)``; may raise to end the work.
    """
    target = Path(target)
    refuse_input(target)
    volume = result.volume is not None
    known = VOLUME_SUFFIXES if volume else PICTURE_SUFFIXES
    if not target.name.lower().endswith(known):
        kind = "volume" if volume else "picture"
        raise FileError(target, f"a {kind} is exported as {', '.join(known)}.")
    if target.resolve() == result.path.resolve():
        raise FileError(target, "is the result itself.", "Choose another name.")
    if target.exists() and not overwrite:
        raise FileError(target, "exists already and was left as it is.")
    if result.volume is None:
        assert result.image is not None
        image = np.ascontiguousarray(orientation.apply(result.image))
        write_image(target, as_seen(image) if target.suffix.lower() == ".png" else image)
        return
    source, grid = result.volume, result.grid
    assert grid is not None
    planes, shape = _planes(source, advance), _full_shape(source)
    if target.suffix.lower() == ".npy":
        _write_npy(target, planes, shape)
    elif is_zarr_name(target):
        write_volume_zarr(target, planes, shape, grid, {"simulated": result.simulated})
    else:
        write_volume_tiff(target, planes, shape, grid)


def _planes(source: VolumeSource, advance: Advance | None) -> Iterator[Float32Array]:
    n_z = source.shape[0]
    for z in range(n_z):
        yield source.plane(z)
        if advance is not None:
            advance(z + 1, n_z)


def _full_shape(source: VolumeSource) -> tuple[int, ...]:
    return source.shape if source.n_channels == 1 else (*source.shape, source.n_channels)


def _write_npy(target: Path, planes: Iterator[Float32Array], shape: tuple[int, ...]) -> None:
    with whole_file(target) as temporary:
        voxels = np.lib.format.open_memmap(temporary, mode="w+", dtype=np.dtype(np.float32), shape=shape)
        for z, plane in enumerate(planes):
            voxels[z] = plane
        voxels.flush()
