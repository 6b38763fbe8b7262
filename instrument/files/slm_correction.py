"""From ideal phase levels to what an SLM must be told: its look-up table and flatness, applied once."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.slm import Slm
from instrument.files.record import RecordFormat

SLM_CALIBRATION = RecordFormat(
    "diffuserbench SLM calibration", "SLM calibration", make="Make one: diffuserbench calibrate slm"
)


@dataclass(frozen=True, slots=True)
class SlmCorrection:
    """How one SLM answers.

    Attributes
    ----------
    phase_of_level_rad : ndarray, float64, (256,)
        Phase that each level really gives, relative to level 0.
    flatness_rad : ndarray, float64, (height, width), or None
        Phase error over the SLM at any sampling, to be taken off.
    """

    phase_of_level_rad: npt.NDArray[np.float64]
    flatness_rad: npt.NDArray[np.float64] | None = None

    @classmethod
    def ideal(cls) -> SlmCorrection:
        """Return the correction of an SLM that needs none: 256 levels a turn."""
        return cls(np.arange(256, dtype=np.float64) * (2 * np.pi / 256))

    def __post_init__(self) -> None:
        if self.phase_of_level_rad.shape != (256,) or not np.isfinite(self.phase_of_level_rad).all():
            raise ValueError("phase_of_level_rad must be 256 finite numbers.")

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

    Parameters
    ----------
    slm : Slm
        Open.
    levels : ndarray, uint8, of the SLM's shape
    correction : SlmCorrection, optional

    Raises
    ------
    LimitError
        When the levels are not of the SLM's shape.
    """
    fits = levels.shape == slm.shape
    slm.display(correction.apply(levels) if correction is not None and fits else levels)


def load_slm_correction(path: Path) -> SlmCorrection:
    """Read what :meth:`SlmCorrection.save` wrote.

    Raises
    ------
    FileError
        When it is missing, no SLM calibration, or damaged.
    """
    record = SLM_CALIBRATION.read(path)
    with SLM_CALIBRATION.damaged(path):
        flat = record["flatness_rad"]
        return SlmCorrection(
            np.array(record["phase_of_level_rad"], float), None if flat is None else np.array(flat, float)
        )
