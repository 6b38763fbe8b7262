"""What OME-Zarr 0.5 says of an image: its axes, their steps and units, and smaller levels to browse."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

_KINDS = {"t": ("time", "second"), "c": ("channel", ""), "z": ("space", "micrometer")}
_KINDS |= dict.fromkeys("yx", _KINDS["z"])


def ome_attributes(
    name: str,
    axes: Sequence[str],
    steps: Mapping[str, float | None],
    *,
    levels: Sequence[int] = (1,),
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
    more : mapping, optional
        Further keys of the multiscale.
    """
    datasets = []
    for level, binning in enumerate(levels):
        scale = [(steps.get(a) or 1.0) * (binning if a in "yx" else 1) for a in axes]
        transformations: list[dict[str, Any]] = [{"type": "scale", "scale": scale}]
        if binning > 1:
            # The centre of a larger pixel lies half of the difference away from that of the first small one.
            shift = [(steps.get(a) or 1.0) * (binning - 1) / 2 if a in "yx" else 0.0 for a in axes]
            transformations.append({"type": "translation", "translation": shift})
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
