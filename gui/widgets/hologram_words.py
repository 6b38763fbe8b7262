"""What is written in the fields of a hologram, understood; BenchError with the reason where it is not."""

from __future__ import annotations

from pathlib import Path

from gui.widgets.entry import existing_path, number
from instrument.bench.display_setup import expansion_side
from instrument.files.errors import BenchError


def further_planes(text: str) -> tuple[tuple[Path, float], ...]:
    """Return the pictures of other planes and their depths in mm, from ``FILE @ DEPTH mm; ...``."""
    planes = []
    for part in filter(None, (part.strip() for part in text.split(";"))):
        name, at, depth = part.rpartition("@")
        if not at or not depth.strip():
            raise BenchError(f"{part!r}: write FILE @ DEPTH mm, e.g. far.png @ 40 mm.")
        planes.append((existing_path(name.strip()), depth_mm(depth.strip())))
    return tuple(planes)


def depth_mm(text: str) -> float:
    """Return a depth behind the focal plane; an empty text is 0."""
    bare = text.removesuffix("mm").strip()
    if not bare:
        return 0.0
    try:
        value = float(bare.replace(",", "."))
    except ValueError:
        raise BenchError(f"The depth {text!r} is no number of mm.") from None
    if not abs(value) < float("inf"):
        raise BenchError(f"The depth must be a finite number of mm, not {text}.")
    return value


def expansion(text: str) -> int | None:
    """Return an étendue expansion, a square; None for an empty text: that of the bench."""
    value: int | None = number("The expansion", "", above_zero=True, whole=True)(text)
    if value is not None:
        expansion_side(value)
    return value


def share(text: str) -> float:
    """Return a weight in 0 to 1."""
    value = number("The weight", "")(text)
    if value is None or value > 1:
        raise BenchError(f"The weight elsewhere lies in 0 to 1, not {text!r}.")
    return float(value)


def brush_radius(text: str) -> float:
    """Return a brush's radius, a fraction of the field."""
    value = number("The brush's radius", "", above_zero=True)(text)
    if value is None or value > 1:
        raise BenchError(
            f"The brush's radius is a fraction of the field, above 0 and at most 1, not {text!r}."
        )
    return float(value)


def maybe_path(text: str) -> Path | None:
    """Return the path of a file that must be there; None for an empty text."""
    return existing_path(text) if text else None


def pattern_png(text: str) -> Path:
    """Return the name of a pattern."""
    path = Path(text).expanduser()
    if path.suffix.lower() != ".png":
        raise BenchError("The pattern needs a name that ends in .png.")
    return path
