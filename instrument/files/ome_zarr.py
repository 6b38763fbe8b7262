"""What OME-Zarr 0.5 says of an image: names, axes, steps and units, smaller levels to browse, colours.

Made here for frames, calibrations, volumes and videos alike.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

SUFFIXES = (".ome.zarr", ".zarr")
"""Names that ask for OME-Zarr."""


def is_zarr_name(path: Path) -> bool:
    """Whether a name asks for OME-Zarr."""
    return path.name.lower().endswith(SUFFIXES)


def stem_of(path: Path) -> str:
    """Return a name without its suffix, of which ``.ome.zarr`` is one."""
    suffix = next((s for s in SUFFIXES if path.name.lower().endswith(s)), path.suffix)
    return path.name[: len(path.name) - len(suffix)]


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
