"""What TIFFs say of images beside their pixels: OME's fields and the rest by name, and ImageJ's.

Facts for which OME has no field stand in a map annotation of the namespace ``diffuserbench``, each as JSON.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from instrument.files import reading
from recon.arrays import Array, Float64Array

if TYPE_CHECKING:
    import tifffile

SUFFIXES = (".ome.tif", ".ome.tiff")
"""Names that ask for OME-TIFF."""
NAMESPACE = "diffuserbench"
MOST_PLANES = 100_000
"""A damaged file may say any number."""
MICROMETRES = {
    "": 1.0, "nm": 1e-3, "um": 1.0, "µm": 1.0, "μm": 1.0, "\\u00B5m": 1.0, "mm": 1e3, "cm": 1e4, "m": 1e6,
    "micron": 1.0, "microns": 1.0, "micrometer": 1.0, "nanometer": 1e-3, "millimeter": 1e3,
    "centimeter": 1e4, "meter": 1e6,
}  # fmt: skip
"""Units of length; none is a micrometre, which is what OME takes then."""
SECONDS = {
    "": 1.0, "s": 1.0, "sec": 1.0, "second": 1.0, "seconds": 1.0,
    "ms": 1e-3, "msec": 1e-3, "millisecond": 1e-3,
    "us": 1e-6, "µs": 1e-6, "μs": 1e-6, "microsecond": 1e-6, "ns": 1e-9,
    "min": 60.0, "minute": 60.0, "minutes": 60.0,
    "h": 3600.0, "hour": 3600.0, "hours": 3600.0,
}  # fmt: skip
"""Units of time; none is a second, which is what OME and ImageJ take then."""


def imagej_time_unit(tiff: tifffile.TiffFile) -> str:
    """Return what ImageJ's times are counted in, as :data:`SECONDS` has it; empty where it is not said."""
    return str((tiff.imagej_metadata or {}).get("tunit", "")).strip().casefold()


def is_ome_name(path: Path) -> bool:
    """Whether a name asks for OME-TIFF."""
    return path.name.lower().endswith(SUFFIXES)


def annotation(facts: Mapping[str, Any]) -> dict[str, str]:
    """Return facts as tifffile writes them into a map annotation; :func:`facts_of` brings them back."""
    return {"Namespace": NAMESPACE, **{name: _text(value) for name, value in facts.items()}}


def _text(value: Any) -> str:
    if isinstance(value, str) and _value(value) == value:
        return value
    return json.dumps(value, default=str, ensure_ascii=False)


def _value(text: str) -> Any:
    try:
        return reading.parse_json(text)
    except ValueError:
        return text


def facts_of(description: str) -> dict[str, Any]:
    """Return the facts that :func:`annotation` told, of an OME-TIFF's description; empty where it tells none.

    Raises ValueError when it is no XML.
    """
    for told in _parts(description, "MapAnnotation"):
        if told.get("Namespace") == NAMESPACE:
            return {str(one.get("K")): _value(one.text or "") for one in _parts(told, "M")}
    return {}


def tiff_facts(tiff: tifffile.TiffFile) -> dict[str, Any]:
    """Return what this program annotated in an OME-TIFF; empty where it did not."""
    try:
        return {} if tiff.ome_metadata is None else facts_of(tiff.ome_metadata)
    except ValueError:
        return {}


def photograph_fields(facts: Mapping[str, Any], planes: int = 1) -> dict[str, Any]:
    """Return OME's fields of one photograph of so many planes, as tifffile takes them, and all its facts.

    ``facts`` are those of :func:`instrument.bench.photograph_file.snapshot_facts`, as far as they are there.
    """
    fields: dict[str, Any] = {"MapAnnotation": annotation(facts)}
    plane: dict[str, float | str] = {}
    if (exposure_ms := _number(facts.get("exposure_ms"))) is not None:
        plane |= {"ExposureTime": exposure_ms / 1e3, "ExposureTimeUnit": "s"}
    place = facts.get("stage_position")
    for axis in "xyz":
        if isinstance(place, Mapping) and (at := _number(place.get(f"{axis}_um"))) is not None:
            plane |= {f"Position{axis.upper()}": at, f"Position{axis.upper()}Unit": "µm"}
    if plane:
        fields["Plane"] = {name: [value] * planes for name, value in plane.items()}
    if isinstance(utc := facts.get("utc"), str):
        fields["AcquisitionDate"] = utc[:19]
    if isinstance(bits := facts.get("significant_bits"), int):
        fields["SignificantBits"] = bits
    if (pitch_um := _number(facts.get("pixel_pitch_um"))) is not None:
        for side in "XY":
            fields |= {f"PhysicalSize{side}": pitch_um, f"PhysicalSize{side}Unit": "µm"}
    return fields


def ome_tiff_channels() -> dict[str, list[Any]]:
    """Return names and colours of the three channels of a picture in colour, as tifffile takes them.

    OME writes a colour as the signed number of its four bytes: red, green, blue, opacity.
    """
    colours = {"red": 0xFF0000FF, "green": 0x00FF00FF, "blue": 0x0000FFFF}
    signed = [value - (value >> 31 << 32) for value in colours.values()]
    return {"Name": list(colours), "Color": signed}


def resolution(pitch_um: float | None) -> dict[str, Any]:
    """Return the TIFF's own words for pixels of this size, for programs that know no OME."""
    if pitch_um is None or not (np.isfinite(pitch_um) and pitch_um > 0):
        return {}
    return {"resolution": (1e4 / pitch_um, 1e4 / pitch_um), "resolutionunit": "CENTIMETER"}


def write_ome_tiff(path: Path, image: Array, facts: Mapping[str, Any]) -> None:
    """Write an OME-TIFF of an image or stack; floats in colour channel by channel: few know RGB of them."""
    import tifffile

    colour = image.ndim == 3 and image.shape[-1] == 3
    if split := colour and image.dtype.kind == "f":
        image = np.moveaxis(image, -1, 0)
    fields: dict[str, Any] = {"axes": "CYX" if split else "YXS" if colour else "ZYX"[3 - image.ndim :]}
    fields |= photograph_fields(facts, 3 if split else 1 if image.ndim == 2 or colour else len(image))
    if split:
        fields["Channel"] = ome_tiff_channels()
    tifffile.imwrite(
        path,
        np.ascontiguousarray(image),
        ome=True,
        photometric="rgb" if colour and not split else "minisblack",
        metadata=fields,
        **resolution(facts.get("pixel_pitch_um")),
    )


def depths_um(description: str) -> list[float]:
    """Return where an OME-TIFF says its planes are along z, in their order; empty where it does not.

    By the planes' own places, else by their step, counted from the first. Raises ValueError when it is no
    XML.
    """
    pixels = next(iter(_parts(description, "Pixels")), None)
    n_z = 0 if pixels is None else int(pixels.get("SizeZ", "1"))
    if pixels is None or not 1 < n_z <= MOST_PLANES:
        return []
    places: dict[int, float] = {}
    for plane in _parts(pixels, "Plane"):
        unit = MICROMETRES.get(plane.get("PositionZUnit", ""))
        if unit is not None and "PositionZ" in plane.attrib:
            places.setdefault(int(plane.get("TheZ", "0")), unit * float(plane.attrib["PositionZ"]))
    if sorted(places) == list(range(n_z)):
        return [places[z] for z in range(n_z)]
    unit, step = MICROMETRES.get(pixels.get("PhysicalSizeZUnit", "")), pixels.get("PhysicalSizeZ")
    return [] if unit is None or step is None else [unit * float(step) * z for z in range(n_z)]


def tiff_depths(tiff: tifffile.TiffFile) -> dict[str, Any]:
    """Return where the planes of a stack lie, as OME or ImageJ tell it; micrometres.

    Raises ValueError when its description is no XML.
    """
    if tiff.ome_metadata is not None:
        told = depths_um(tiff.ome_metadata)
    else:
        stack = tiff.imagej_metadata or {}
        unit, step = MICROMETRES.get(str(stack.get("unit", "?"))), stack.get("spacing")
        count = min(int(stack.get("slices", 0)), MOST_PLANES)
        told = [unit * float(step) * z for z in range(count)] if unit and step else []
    return {"depths_um": told} if told else {}


def tiff_times(tiff: tifffile.TiffFile) -> dict[str, float]:
    """Return the time from frame to frame of ImageJ's stacks."""
    stack = tiff.imagej_metadata or {}
    unit = SECONDS.get(imagej_time_unit(tiff), 0.0)
    period_s, fps = unit * float(stack.get("finterval", 0)), float(stack.get("fps", 0))
    period_s = period_s or (1 / fps if fps > 0 else 0.0)
    return {"frame_period_s": period_s} if stack.get("frames", 0) > 1 and period_s > 0 else {}


def film_facts(description: str) -> dict[str, float]:
    """Return what an OME-TIFF says of its frames, by the names of a photograph's facts.

    ``frame_period_s`` from one to the next, ``pixel_pitch_um`` along x, ``exposure_ms`` of the first. Raises
    ValueError when it is no XML.
    """
    pixels = next(iter(_parts(description, "Pixels")), None)
    if pixels is None:
        return {}
    plane = next(iter(_parts(pixels, "Plane")), None)
    fields = (
        ("frame_period_s", pixels, "TimeIncrement", SECONDS, 1.0),
        ("pixel_pitch_um", pixels, "PhysicalSizeX", MICROMETRES, 1.0),
        ("exposure_ms", plane, "ExposureTime", SECONDS, 1e3),
    )
    found = {}
    for name, where, field, units, scale in fields:
        text = None if where is None else where.get(field)
        unit = None if where is None else units.get(where.get(f"{field}Unit", ""))
        if text is not None and unit is not None:
            found[name] = scale * unit * float(text)
    return found


def depths_in_words(depths: Sequence[float] | Float64Array) -> str:
    """Say at which depths a file's planes are; micrometres."""
    steps = np.diff(depths)
    if not len(steps) or not np.isfinite(steps).all():
        return ""
    if np.ptp(steps) <= 1e-3 * abs(steps[0]):
        every = f"planes every {abs(steps[0]):g} um as it says"
        return every if depths[0] == 0 else f"{every}, {depths[0] / 1e3:g} to {depths[-1] / 1e3:g} mm"
    near, far = (f"{depth / 1e3:g}" for depth in (min(depths), max(depths)))
    turns = steps.min() < 0 < steps.max()
    order = "not in the order of depths" if turns else "not evenly spaced"
    return f"planes at {near} to {far} mm as it says, {order}"


def _parts(where: str | ElementTree.Element, name: str) -> list[ElementTree.Element]:
    try:
        root = ElementTree.fromstring(where) if isinstance(where, str) else where
    except ElementTree.ParseError as error:
        raise ValueError(f"no XML: {error}") from None
    return [part for part in root.iter() if part.tag.rpartition("}")[2] == name]


def _number(value: Any) -> float | None:
    known = isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value)
    return float(value) if known else None
