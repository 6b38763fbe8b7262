"""SLM patterns as files, and what one SLM must be told: levels of an ideal SLM, 256 a turn.

Level ``n`` means a phase of ``2 pi n / 256`` whatever SLM will show it: look-up table and flatness are
applied when the pattern is shown, and only then.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.slm import Slm
from instrument.files.errors import FileError
from instrument.files.images import read_image, side_car, write_image
from instrument.files.record import RecordFormat
from recon.arrays import Array, Float64Array

SLM_CALIBRATION = RecordFormat(
    "diffuserbench SLM calibration", "SLM calibration", make="Make one: diffuserbench calibrate slm"
)


@dataclass(frozen=True, slots=True)
class SlmCorrection:
    """How one SLM answers."""

    phase_of_level_rad: Float64Array
    """(256,): phase that each level really gives, relative to level 0."""
    flatness_rad: Float64Array | None = None
    """(height, width): phase error over the SLM at any sampling, to be taken off."""

    @classmethod
    def ideal(cls) -> SlmCorrection:
        """Return the correction of an SLM that needs none: 256 levels a turn."""
        return cls(np.arange(256, dtype=np.float64) * (2 * np.pi / 256))

    def __post_init__(self) -> None:
        if self.phase_of_level_rad.shape != (256,) or not np.isfinite(self.phase_of_level_rad).all():
            raise ValueError("phase_of_level_rad must be 256 finite numbers.")

    def at(self, turns: float) -> SlmCorrection:
        """Return the correction at another wavelength, where every phase is ``turns`` times as large.

        The same optical path at every wavelength: a liquid crystal's dispersion is left out, and measured by
        ``calibrate slm`` at that wavelength.
        """
        flat = None if self.flatness_rad is None else self.flatness_rad * turns
        return SlmCorrection(self.phase_of_level_rad * turns, flat)

    def apply(self, levels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        """Return the levels that show ideal ``levels`` ((height, width), 256 a turn) best on this SLM."""
        table = self._nearest()
        if self.flatness_rad is None:
            return np.asarray(np.take(table, levels), np.uint8)
        from scipy.ndimage import map_coordinates

        height, width = self.flatness_rad.shape
        y, x = (
            (np.arange(n) + 0.5) / n * m - 0.5 for n, m in zip(levels.shape, (height, width), strict=True)
        )
        error = map_coordinates(self.flatness_rad, np.meshgrid(y, x, indexing="ij"), order=1, mode="nearest")
        wanted = levels - error * (256 / (2 * np.pi))
        whole = np.mod(np.rint(wanted), 256).astype(np.uint8)
        return np.asarray(np.take(table, whole), np.uint8)

    def _nearest(self) -> npt.NDArray[np.uint8]:
        """Return for each ideal level the level whose real phase is nearest, modulo a turn."""
        ideal = np.arange(256) * (2 * np.pi / 256)
        distance = np.angle(np.exp(1j * (self.phase_of_level_rad[None, :] - ideal[:, None])))
        return np.asarray(np.abs(distance).argmin(axis=1), np.uint8)

    def save(self, path: Path, facts: dict[str, Any]) -> None:
        """Write as JSON; errors as ``write_text``."""
        flat = None if self.flatness_rad is None else np.round(self.flatness_rad, 5)
        record = {
            "phase_of_level_rad": np.round(self.phase_of_level_rad, 6),
            "flatness_rad": flat,
            **facts,
        }
        SLM_CALIBRATION.write(path, record, indent=None)


def show_levels(slm: Slm, levels: npt.NDArray[np.uint8], correction: SlmCorrection | None = None) -> None:
    """Show ideal levels (256 a turn) on an SLM, through its calibration where there is one.

    Raises LimitError when the levels are not of the SLM's shape.
    """
    fits = levels.shape == slm.shape
    slm.display(correction.apply(levels) if correction is not None and fits else levels)


def load_slm_correction(path: Path) -> SlmCorrection:
    """Read what :meth:`SlmCorrection.save` wrote.

    Raises FileError when it is missing, no SLM calibration, or damaged.
    """
    record = SLM_CALIBRATION.read(path)
    with SLM_CALIBRATION.damaged(path):
        flat = record["flatness_rad"]
        return SlmCorrection(
            np.array(record["phase_of_level_rad"], float), None if flat is None else np.array(flat, float)
        )


SLM_PHASE = RecordFormat("diffuserbench SLM phase", "description of an SLM pattern")
MIRRORS = RecordFormat("diffuserbench mirror pattern", "description of a pattern of mirrors")
LEVELS = 256


def field_levels(field: Array, binning: int = 1, *, mirrors: bool = False) -> npt.NDArray[np.uint8]:
    """Return the ideal levels of an SLM field, complex (height, width): its phase, or what mirrors send.

    A field that mirrors cannot send, not real or negative, is their first order: they show fringes.
    """
    if not mirrors:
        return phase_levels(np.angle(field), binning)
    if np.any(np.imag(field)) or np.min(np.real(field)) < 0:
        from recon.holography.variables import coded  # late: plans are made where nothing is shown

        field = coded(field)
    sent = np.rint(255 * np.clip(np.real(field), 0, 1)).astype(np.uint8)
    return np.repeat(np.repeat(sent, binning, axis=-2), binning, axis=-1)


def levels_field(levels: npt.NDArray[np.uint8], binning: int, *, mirrors: bool) -> Array:
    """Return the field that a pattern's levels stand for, complex (height, width)."""
    if mirrors:
        return np.asarray(levels[::binning, ::binning] / 255, np.complex64)
    return np.asarray(np.exp(1j * levels_phase(levels, binning)))


def mismatch(slm: Slm, *, mirrors: bool, spots: bool = False) -> str:
    """Say why an SLM cannot show a pattern of mirrors, or of phases (of spots); empty where it can."""
    if slm.mirrors and not mirrors:
        if spots:
            return (
                f"{slm.name} has mirrors that send light or not, and spots are made by phases: give a "
                "picture of them instead, with --mirrors optimised."
            )
        return (
            f"{slm.name} has mirrors that send light or not, and this pattern is of phases: compute it with "
            "--mirrors optimised (without a mask also lee or off-axis)."
        )
    if mirrors and not slm.mirrors:
        return f"{slm.name} sets phases, and this pattern is of mirrors: compute it without --mirrors."
    return ""


def is_of_mirrors(facts: Mapping[str, Any]) -> bool:
    """Return whether a pattern is of mirrors, by the facts beside it."""
    return facts.get("options", {}).get("mirrors") is not None


def phase_levels(phase_rad: Array, binning: int = 1) -> npt.NDArray[np.uint8]:
    """Return phases as ideal levels, uint8, each pixel repeated ``binning`` times along both axes."""
    levels = np.mod(np.rint(np.asarray(phase_rad) * (LEVELS / (2 * np.pi))), LEVELS).astype(np.uint8)
    return np.repeat(np.repeat(levels, binning, axis=-2), binning, axis=-1)


def levels_phase(levels: npt.NDArray[np.uint8], binning: int = 1) -> Float64Array:
    """Return the phase of ideal levels, float64, one value for each ``binning`` x ``binning`` pixels."""
    phase: Float64Array = levels[..., ::binning, ::binning].astype(np.float64)
    return phase * (2 * np.pi / LEVELS)


def write_slm_image(path: Path, levels: npt.NDArray[np.uint8], facts: Mapping[str, Any]) -> None:
    """Write a pattern as PNG, and beside it a JSON file that says how it was made; as ``write_image``."""
    if is_of_mirrors(facts):
        write_image(path, levels, MIRRORS.stamped(facts))
    else:
        write_image(path, levels, SLM_PHASE.stamped({"levels_per_turn": LEVELS, **facts}))


def read_slm_levels(path: Path | str) -> npt.NDArray[np.uint8]:
    """Return the grey levels of an SLM image, ``(height, width)`` uint8, whatever stands beside it.

    Raises FileError when it is missing, no image, or not 8-bit grey.
    """
    pixels = read_image(path).pixels
    if pixels.ndim != 2 or pixels.dtype != np.uint8:
        raise FileError(
            path, f"is {pixels.dtype} {pixels.shape}; an SLM image is 8-bit grey (256 levels a turn)."
        )
    return pixels.astype(np.uint8, copy=False)


def read_slm_image(path: Path | str) -> tuple[npt.NDArray[np.uint8], dict[str, Any]]:
    """Read a pattern and the facts beside it (empty where there is no JSON file: any 8-bit grey image goes).

    Raises FileError as :func:`read_slm_levels`; or when the JSON file is no description of a pattern.
    """
    levels, beside = read_slm_levels(path), side_car(path)
    if not beside.exists():
        return levels, {}
    return levels, (MIRRORS if MIRRORS.is_of(beside) else SLM_PHASE).read(beside)
