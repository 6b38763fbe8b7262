"""Files of SLM patterns: the phase as 8-bit levels of an ideal SLM, 256 levels a turn.

Level ``n`` means a phase of ``2 pi n / 256`` whatever SLM will show it: look-up table and flatness are
applied when the pattern is shown, and only then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from instrument.files.images import read_image, side_car, write_image
from instrument.files.record import RecordFormat

SLM_PHASE = RecordFormat("diffuserbench SLM phase", "description of an SLM pattern")
LEVELS = 256


def phase_levels(phase_rad: npt.NDArray[Any], binning: int = 1) -> npt.NDArray[np.uint8]:
    """Return phases as ideal levels, uint8, each pixel repeated ``binning`` times along both axes."""
    levels = np.mod(np.rint(np.asarray(phase_rad) * (LEVELS / (2 * np.pi))), LEVELS).astype(np.uint8)
    return np.repeat(np.repeat(levels, binning, axis=-2), binning, axis=-1)


def levels_phase(levels: npt.NDArray[np.uint8], binning: int = 1) -> npt.NDArray[np.float64]:
    """Return the phase of ideal levels, float64, one value for each ``binning`` x ``binning`` pixels."""
    phase: npt.NDArray[np.float64] = levels[..., ::binning, ::binning].astype(np.float64)
    return phase * (2 * np.pi / LEVELS)


def write_slm_image(path: Path, levels: npt.NDArray[np.uint8], facts: Mapping[str, Any]) -> None:
    """Write a pattern as PNG, and beside it a JSON file that says how it was made; as ``write_image``."""
    write_image(path, levels, SLM_PHASE.stamped({"levels_per_turn": LEVELS, **facts}))


def read_slm_levels(path: Path | str) -> npt.NDArray[np.uint8]:
    """Return the grey levels of an SLM image, ``(height, width)`` uint8, whatever stands beside it.

    Raises
    ------
    FileError
        When it is missing, no image, or not 8-bit grey.
    """
    pixels = read_image(path).pixels
    if pixels.ndim != 2 or pixels.dtype != np.uint8:
        raise FileError(
            path, f"is {pixels.dtype} {pixels.shape}; an SLM image is 8-bit grey (256 levels a turn)."
        )
    return pixels.astype(np.uint8, copy=False)


def read_slm_image(path: Path | str) -> tuple[npt.NDArray[np.uint8], dict[str, Any]]:
    """Read a pattern and the facts beside it (empty where there is no JSON file: any 8-bit grey image goes).

    Raises
    ------
    FileError
        As :func:`read_slm_levels`; or when the JSON file is no description of a pattern.
    """
    levels, beside = read_slm_levels(path), side_car(path)
    return levels, SLM_PHASE.read(beside) if beside.exists() else {}
