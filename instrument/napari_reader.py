"""What napari shows of this program's files: a reader of its own, which napari finds by ``napari.yaml``.

Runs, calibrations, volumes and videos are OME-Zarr, of which nothing is read that is not looked at; results
are TIFF with a record beside, exported volumes and photographs TIFF that says it is ours. What is not this
program's is left to other readers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.calibration_file import is_calibration, load_calibration
from instrument.files.errors import FileError
from instrument.files.images import image_metadata
from instrument.files.ome_tiff import tiff_facts
from instrument.files.ome_zarr import is_zarr_name, stem_of
from instrument.files.reading import parse_json, read_bytes
from instrument.files.record import plain
from instrument.files.tiff_pages import open_tiff
from instrument.runs.run_files import FRAMES, is_run
from instrument.volumes.grid_facts import middle_step_um

Layer = tuple[Any, dict[str, Any], str]
"""napari's: what is shown, the arguments of its layer, and the layer's kind."""


def get_reader(path: str | Sequence[str]) -> Callable[[str | Sequence[str]], list[Layer]] | None:
    """Return what reads a folder or file of this program; None for any other, and for several at once."""
    if not isinstance(path, str):
        return None
    return read if _kind(Path(path)) is not None else None


def read(path: str | Sequence[str]) -> list[Layer]:
    """Return the layers of a run, calibration, volume, video or result.

    Raises FileError when it is damaged or has nothing to show, in a sentence.
    """
    found = Path(str(path))
    kind = _kind(found)
    if kind is None:
        raise ValueError(f"{found} is none of diffuserbench's.")
    return kind(found)


def _kind(path: Path) -> Callable[[Path], list[Layer]] | None:
    if is_calibration(path):
        return _calibration
    if path.is_dir() and is_run(path):
        return _run
    if is_zarr_name(path):
        return _array if "diffuserbench" in _attributes(path) else None
    is_tiff = path.suffix.lower() in (".tif", ".tiff")
    return _result if is_tiff and (_record(path) or _annotated(path)) else None


def _attributes(path: Path) -> Mapping[str, Any]:
    """Return a Zarr group's attributes; none where it has none to be read."""
    try:
        found = parse_json(read_bytes(path / "zarr.json"))
    except (OSError, ValueError):
        return {}
    attributes = found.get("attributes") if isinstance(found, dict) else None
    return attributes if isinstance(attributes, dict) else {}


def _record(path: Path) -> Mapping[str, Any]:
    """Return the record beside a result; nothing where there is none of this program's."""
    try:
        found = parse_json(read_bytes(path.with_suffix(".json")))
    except (OSError, ValueError):
        return {}
    ours = isinstance(found, dict) and str(found.get("program", "")).startswith("diffuserbench")
    return found if ours else {}


def _annotated(path: Path) -> Mapping[str, Any]:
    """Return what this program says in a TIFF, a photograph's or a volume's; nothing of any other."""
    try:
        with open_tiff(path) as file:
            if facts := tiff_facts(file):
                return facts
        facts = image_metadata(path)
        return facts if {"bench", "pixel_format", "pixel_pitch_um"} <= facts.keys() else {}
    except Exception:  # noqa: BLE001 - whatever is wrong with it, another reader may say
        return {}


def _run(path: Path) -> list[Layer]:
    """Return a run's frames, and the PSFs that were made of them."""
    frames = path / FRAMES
    layers = _array(frames, name=path.name) if "ome" in _attributes(frames) else []
    for made in sorted(path.glob("[!.]*/calibration.json")):
        layers += _calibration(made.parent)
    if not layers:
        raise FileError(path, "has no frames: the run ended before its first.")
    return layers


def _calibration(path: Path) -> list[Layer]:
    """Return a calibration's PSFs, one a step of the slider; the metadata say where the sources were."""
    calibration = load_calibration(path)
    pitch_um = calibration.geometry.pixel_pitch_um
    facts = {"source_positions_um": calibration.source_positions_um, "quality": calibration.quality}
    psfs, axes = calibration.psfs, ["n", "c", "y", "x"]
    if psfs.shape[1] == 1:
        psfs, axes = psfs[:, 0], ["n", "y", "x"]
    name = f"PSFs of {path.parent.name if path.name == 'calibration' else path.name}"
    return [_image(psfs, axes, {"y": pitch_um, "x": pitch_um}, {}, name, facts)]


def _array(path: Path, name: str = "") -> list[Layer]:
    """Return an OME-Zarr image, all its levels, as its own metadata place it."""
    import zarr

    attributes = _attributes(path)
    image = attributes["ome"]["multiscales"][0]
    axes = [axis["name"] for axis in image["axes"]]
    known = {axis["name"] for axis in image["axes"] if "unit" in axis}
    placed = {change["type"]: change for change in image["datasets"][0]["coordinateTransformations"]}
    scale = dict(zip(axes, placed["scale"]["scale"], strict=True))
    step = {axis: size if axis in known else None for axis, size in scale.items()}
    move = placed.get("translation", {"translation": [0.0] * len(axes)})["translation"]
    origin = dict(zip(axes, move, strict=True))
    levels = [zarr.open_array(path / level["path"], mode="r") for level in image["datasets"]]
    data = levels if len(levels) > 1 else levels[0]
    return [_image(data, axes, step, origin, name or stem_of(path), attributes.get("diffuserbench", {}))]


def _result(path: Path) -> list[Layer]:
    """Return a reconstruction on its grid, or a photograph."""
    facts = _annotated(path)
    record = _record(path) or {**facts, "grid": {"object_pitch_um": facts.get("pixel_pitch_um"), **facts}}
    with open_tiff(path) as file:
        series = file.series[0]
        data, axes = series.asarray(), [{"s": "c"}.get(a, a) for a in series.axes.lower()]
    grid = record.get("grid") or {}
    pitch = grid.get("object_pitch_um")
    if isinstance(widths := grid.get("pitch_um"), list) and widths:  # a volume's: its middle plane's
        pitch = widths[len(widths) // 2]
    depths = grid.get("z_um")
    step, origin = {"y": pitch, "x": pitch}, {}
    if isinstance(depths, list) and len(depths) > 1:
        step["z"] = middle_step_um(np.array(depths))
        centre = grid.get("centre")
        if pitch and centre and depths[0] < depths[-1]:
            origin = {"z": depths[0], "y": -centre[0] * pitch, "x": -centre[1] * pitch}
    return [_image(data, axes, step, origin, path.stem, record)]


def _image(
    data: Any,
    axes: Sequence[str],
    step: Mapping[str, float | None],
    origin: Mapping[str, float],
    name: str,
    facts: Mapping[str, Any],
) -> Layer:
    """Return napari's layer of an image: channels side by side, steps and places in the axes' units."""
    arguments: dict[str, Any] = {"name": name, "metadata": {"diffuserbench": plain(facts)}}
    shown = list(axes)
    if "c" in shown:
        at = shown.index("c")
        shown.remove("c")
        count = (data[0] if isinstance(data, list) else data).shape[at]
        colours = ["red", "green", "blue"] if count == 3 else [str(n) for n in range(count)]
        arguments |= {"channel_axis": at, "name": [f"{name} {colour}" for colour in colours]}
        if count == 3:  # napari's own choice is cyan, magenta, yellow
            arguments["colormap"] = colours
    arguments["scale"] = [step.get(axis) or 1.0 for axis in shown]
    arguments["translate"] = [origin.get(axis, 0.0) for axis in shown]
    arguments["units"] = [("s" if axis == "t" else "um") if step.get(axis) else "pixel" for axis in shown]
    arguments["axis_labels"] = shown
    return data, arguments, "image"
