"""What the image of a run's frames tells other programs: in OME-Zarr's own fields, and beside them."""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite
from typing import Any

import numpy as np

from drivers.frame import FrameMetadata
from instrument.files.ome_zarr import ome_channels
from instrument.runs.frame_array import description_of, group_of
from instrument.runs.run import Run
from instrument.runs.run_files import PROVENANCE, RunError
from instrument.volumes.grid_facts import EVEN
from recon.arrays import Float64Array

TOLD = ("pixel_format", "significant_bits", "black_level", "exposure_ms", "gain", "binning", "roi")
"""Of the camera: as one value where it is that of all frames."""
_COLOURS = {"red": "FF0000", "green": "00FF00", "blue": "0000FF"}
EVERY = ("exposure_ms", "led_pattern", "slm_image_hash")
"""Of every frame of a plan."""


def z_steps_um(noted: Sequence[FrameMetadata]) -> Float64Array:
    """Return the steps of a sweep along z alone, which goes one way; nothing for other frames."""
    places = [one.stage_position for one in noted]
    others = {tuple(v for name, v in place.items() if name != "z_um") for place in places}
    if len(others) > 1 or not all("z_um" in place for place in places):
        return np.empty(0)
    steps = np.diff([place["z_um"] for place in places])
    return steps if bool((steps > 0).all() or (steps < 0).all()) else np.empty(0)


def descriptions(run: Run, n_frames: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return what the ``zarr.json`` of a run's array and of its image hold, by what is known of its frames.

    A plan's sweep along z alone has the axis z, with its step where steps are even, and then the place of
    its first frame; any other run t.
    The bit depth is the window of OME's ``omero``; what OME-Zarr has no field for (exposure, black level,
    stage positions, times, light, colour filter) is in the attribute ``diffuserbench``: of every frame for
    plans, in the array's order and None for frames that are not there; what is common for recordings.
    """
    array = run.array
    noted = [record.metadata for _, record in sorted(run.records.items())]
    steps = np.empty(0) if run.plan is None else z_steps_um(noted)
    axis = "z" if steps.size else "t"
    described = description_of(n_frames, array.frame_shape, array.dtype.name, axis)
    first = noted[0]
    facts: dict[str, Any] = {name: _common([getattr(one, name) for one in noted]) for name in TOLD}
    facts |= {"simulated": run.is_simulated, "began_utc": first.utc.isoformat()}
    if run.plan is not None:
        facts["frames"] = _of_every(run, n_frames)
    more: dict[str, Any] = {"diffuserbench": facts}
    if array.dtype.kind == "u":
        top = (1 << first.significant_bits) - 1
        more["omero"] = ome_channels(top, colour=array.is_colour)
    step, start = run.frame_period_s, None
    if steps.size:
        sizes = np.abs(steps)
        step = float(np.median(sizes)) if np.ptp(sizes) <= EVEN * sizes.min() else None
        if step is not None and steps[0] > 0 and min(run.records) == 0:  # a scale is positive
            start = first.stage_position["z_um"]
    try:
        pitch_um = float(run.provenance["pixel_pitch_um"])
    except (LookupError, TypeError, ValueError):  # no log has a copy of an older run's
        raise RunError(run.path / PROVENANCE, "is damaged: pixel_pitch_um is gone or no number.") from None
    return described, group_of(described["dimension_names"], pitch_um, run.label, step, start, more)


def _common(values: Sequence[Any]) -> Any:
    """Return what all values are; None where they differ."""
    first = values[0]
    return (list(first) if isinstance(first, tuple) else first) if all(v == first for v in values) else None


def _of_every(run: Run, n_frames: int) -> dict[str, list[Any]]:
    """Return what is known of each frame of a plan, a list a name; None for those that are not there."""
    records = [run.records.get(index) for index in range(n_frames)]
    noted = [None if record is None else record.metadata for record in records]
    began_ns = min(one.host_time_ns for one in noted if one is not None)
    axes = sorted({name for one in noted if one is not None for name in one.stage_position})
    every: dict[str, list[Any]] = {
        "time_s": [None if one is None else (one.host_time_ns - began_ns) / 1e9 for one in noted]
    }
    every |= {name: [None if one is None else getattr(one, name) for one in noted] for name in EVERY}
    for name in axes:
        places = [None if one is None else one.stage_position.get(name) for one in noted]
        every[name] = [None if place is None or not isfinite(place) else place for place in places]
    return every
