"""What a reconstruction was made from, as it is shown and as it is kept beside the result."""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np

from instrument.files.images import ImageFile
from instrument.reconstruction.preparation import AUTO_PIXELS, Crop, Dark, FloatImage
from recon.base.noise import NoiseModel
from recon.camera.factors import Pattern


def noise_of(image: ImageFile) -> NoiseModel | None:
    """Return a pixel's noise as the metadata of a photograph tell it, the mean of its frames regarded."""
    told: Any = image.metadata.get("noise")
    try:
        average = float(image.metadata.get("average", 1))
        model = NoiseModel(
            float(told["read_noise_counts"]) / average**0.5, float(told["counts_per_electron"]) / average
        )
    except (TypeError, KeyError, ValueError, ZeroDivisionError):
        return None  # somebody else's metadata
    known = np.isfinite([model.read_noise, model.counts_per_electron]).all()
    return model if known and min(model.read_noise, model.counts_per_electron) >= 0 else None


def noise_note(noise: NoiseModel | None) -> dict[str, str]:
    """Tell of a known noise."""
    if noise is None:
        return {}
    known = f"read noise {noise.read_noise:.3g} counts, {noise.counts_per_electron:.3g} counts an electron"
    return {"Noise": f"{known}, as the photograph's metadata say, unless --noise is given"}


def mosaic_note(pattern: Pattern | None) -> dict[str, str]:
    """Tell of a raw frame's colour mosaic."""
    if pattern is None:
        return {}
    return {"Mosaic": f"{pattern}: every pixel counts for its own colour, nothing is demosaiced"}


def describe(file: ImageFile) -> str:
    """Return an image's name, size and what was noted in reading it."""
    return ", ".join((f"{file.path}: {file.describe()}", *file.notes))


def describe_window(crop: Crop | None, asked: int | None, factor: int, result: FloatImage) -> str:
    """Return what was cut out and how it was binned; ``asked`` is None where that was chosen."""
    window = "whole image" if crop is None else f"window of {crop.height} x {crop.width}"
    is_automatic = asked is None and factor > 1
    binned = f"binned {factor} x {factor}" if factor > 1 else "not binned"
    limit = f"at most {AUTO_PIXELS / 1e6:g} megapixel"
    why = f" (automatic: {limit}; --bin 1 for all)" if is_automatic else ""
    return f"{window}, {binned}{why}: {result.shape[0]} x {result.shape[1]}"


def source_record(file: ImageFile) -> dict[str, Any]:
    """Return what tells an image from others."""
    digest = hashlib.sha256(np.ascontiguousarray(file.pixels).data).hexdigest()
    return {"path": str(file.path.resolve()), "pixels": file.describe(), "pixels_sha256": digest}


def dark_record(dark: Dark) -> dict[str, Any]:
    """Return a dark level's means, counts, and where it comes from."""
    values = {
        name: float(np.mean(value))
        for name, value in (("image_counts", dark.image), ("psf_counts", dark.psf))
    }
    return {**values, "from": dark.reason}


def crop_record(crop: Crop | None, image: ImageFile) -> dict[str, int] | None:
    """Return the window that was cut out of an image, pixels."""
    if crop is None:
        return None
    height, width = image.pixels.shape[:2]
    return slices_record(crop.slices((height, width)))


def slices_record(slices: tuple[slice, slice]) -> dict[str, int]:
    """Return a window of rows and columns, pixels."""
    rows, columns = slices
    return {
        "top": rows.start,
        "left": columns.start,
        "height": rows.stop - rows.start,
        "width": columns.stop - columns.start,
    }
