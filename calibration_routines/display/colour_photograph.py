"""Pictures in colour, shown one colour after the other and photographed by a camera that sees no colours.

Each colour has its own light, its own field of view (as wide as its wavelength is long) and its own place on
the camera; the pictures are brought together where they are of one size (:func:`colour_shares`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.hologram_photograph import (
    HologramCamera,
    display_of_pattern,
    target_of_pattern,
)
from instrument.display.alignment import Alignment
from instrument.display.hologram_files import CHANNELS
from instrument.files.errors import BenchError
from instrument.files.images import write_image
from instrument.files.pictures import Pixels
from recon.arrays import Array, Float64Array
from recon.holography import Scores
from recon.holography.scores import compare


@dataclass(frozen=True, slots=True)
class ColourPattern:
    """What is shown in one colour."""

    fields: list[Array]
    """Time-multiplexed SLM fields, complex (height, width)."""
    facts: Mapping[str, Any]
    """Beside the pattern's file."""

    @property
    def wavelength_nm(self) -> float:
        """Of the light that it was computed for."""
        return float(self.facts["wavelength_nm"])

    @property
    def share(self) -> float:
        """Which part of its field the picture fills."""
        return float(self.facts.get("field_share", 1.0))


@dataclass(frozen=True, slots=True)
class ColourCapture:
    """A photographed picture in colour."""

    seen: Float64Array
    """(height, width, colours): as an eye would see it, each colour's white 1, in linear light."""
    wanted: Float64Array
    """The picture through the same low-pass."""
    channels: tuple[Scores, ...]
    wavelengths_nm: tuple[float, ...]
    simulated: bool
    saturated_fraction: float
    """Of the worst colour's photograph."""

    @property
    def psnr_db(self) -> float:
        """Over all colours together, each brought to the brightness wanted of it."""
        errors = [10 ** (-score.psnr_db / 10) for score in self.channels]
        return float(-10 * np.log10(np.mean(errors)))

    @property
    def ssim(self) -> float:
        """Mean of the colours."""
        return float(np.mean([score.ssim for score in self.channels]))


def colour_patterns(
    fields: Sequence[Array], facts: Sequence[Mapping[str, Any]], own_nm: float
) -> list[ColourPattern]:
    """Return patterns sorted by the colour that they were computed for: red, green, blue, any others.

    A pattern without facts is for the bench's own laser, ``own_nm``.
    """
    found: dict[float, ColourPattern] = {}
    for field, about in zip(fields, facts, strict=True):
        nm = float(about.get("wavelength_nm", own_nm))
        found.setdefault(nm, ColourPattern([], {"wavelength_nm": nm, **about})).fields.append(field)
    order = dict(zip(CHANNELS, range(len(CHANNELS)), strict=True))
    return sorted(found.values(), key=lambda p: order.get(p.facts.get("colour", ""), len(order)))


def photograph_colours(
    lights: Sequence[DisplayBench],
    patterns: Sequence[ColourPattern],
    picture: Pixels,
    alignment: Alignment | None = None,
    *,
    average: int = 1,
) -> ColourCapture:
    """Show one colour after the other, photograph each, bring them together and compare with the picture.

    ``lights`` is the bench as each colour's light shows it.

    Raises BenchError where the patterns are not the colours of one picture; InputError when the mask's
    speckle is not recognised; DeviceError when a device fails.
    """
    colours = [pattern.facts.get("colour") for pattern in patterns]
    if sorted(filter(None, colours)) != sorted(CHANNELS) or picture.ndim != 3:
        raise BenchError(
            f"A picture in colour is shown by patterns for {', '.join(CHANNELS)}, from hologram --color; "
            f"these are for {', '.join(f'{pattern.wavelength_nm:g} nm' for pattern in patterns)}."
        )
    seen: list[Array] = []
    wanted: list[Array] = []
    scores, saturated = [], []
    for io, pattern in zip(lights, patterns, strict=True):
        size = io.slm.shape, io.slm.pixel_pitch_um
        display = display_of_pattern(io.bench.config, size, pattern.facts, alignment)
        target = target_of_pattern(picture, display, pattern.facts)
        try:
            capture = HologramCamera.registered(io, display).capture(pattern.fields, target, average=average)
        finally:
            io.light(on=False)
        count = max(capture.seen.shape) if not seen else len(seen[0])
        share = pattern.share if target.window is None else 1.0  # what is seen of a window is all picture
        seen.append(_middle(capture.seen, share, count))
        wanted.append(_middle(capture.wanted, share, count))
        scores.append(compare(seen[-1], wanted[-1], 1.0))
        saturated.append(capture.saturated_fraction)
    return ColourCapture(
        np.stack(seen, axis=-1),
        np.stack(wanted, axis=-1),
        tuple(scores),
        tuple(pattern.wavelength_nm for pattern in patterns),
        bool(lights[0].bench.simulated_kinds),
        max(saturated),
    )


def _middle(image: Array, share: float, count: int) -> Float64Array:
    """Return the middle of a picture over its field, ``share`` of each side, as (count, count)."""
    from scipy.ndimage import map_coordinates

    at = (np.arange(count) - count // 2) / count * share
    y, x = (at * n + n // 2 for n in image.shape)
    return np.asarray(map_coordinates(image, np.meshgrid(y, x, indexing="ij"), order=3, mode="nearest"))


def write_colours(path: Path, found: ColourCapture) -> None:
    """Write what was seen as an 8-bit RGB image, white at 255, linear, and its metrics beside it."""
    pixels = np.clip(np.rint(found.seen * 255), 0, 255).astype(np.uint8)
    facts = {
        "simulated": found.simulated,
        "metrics": {"psnr_db": found.psnr_db, "ssim": found.ssim},
        "psnr_db_of_colours": [score.psnr_db for score in found.channels],
        "wavelengths_nm": list(found.wavelengths_nm),
        "low_passed": True,
        "white": 255,
    }
    write_image(path, pixels, facts)
