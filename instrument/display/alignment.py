"""Where a display's mask was found and what was learned of it, and the file that this is kept in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.errors import BenchError, FileError
from instrument.files.record import RecordFormat, plain, value_of
from recon.arrays import Float64Array
from recon.holography import Display
from recon.holography.learned import Learned
from recon.holography.pose import NODES, Pose

ALIGNMENT = RecordFormat(
    "diffuserbench mask alignment", "mask alignment", make="Make one: diffuserbench align mask"
)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the mask was found."""

    pose: Pose
    """Left over with the stage at ``stage_position``."""
    error: Mapping[str, float]
    """Standard uncertainties, by the name of the pose's parameter."""
    rest: Float64Array
    """(rows, columns, 2): smooth displacement beyond the pose's, on the nodes of ``Pose.displacement``, mask
    pixels."""
    efficiency: float
    """Spot brightness over the model's ideal."""
    stage_position: Mapping[str, float]
    """Where the stage was, by the names of its axes."""
    mask_shape: tuple[int, int]
    """Of the mask that it holds for, in pixels."""
    simulated: bool
    learned: Learned | None = None
    """What photographs taught of the display."""
    corrected: bool | None = None
    """Whether they were taken with an SLM calibration, which holds from then on."""
    psnr_lost_db: float | None = None
    """What a hologram loses to what is not known of the mask's place."""

    def of(self, display: Display) -> Display:
        """Return the display with this mask's displacement.

        Raises FileError when the alignment is another mask's, or was learned with the lens of a display that
        has none.
        """
        if display.mask.shape != self.mask_shape:
            raise FileError(
                "alignment",
                f"holds for a mask of {self.mask_shape} pixels; this display's has {display.mask.shape}.",
            )
        displacement = self.pose.displacement(self.mask_shape) + self.rest
        display = replace(display, lost_db=self.psnr_lost_db)
        if self.learned is None:
            return replace(display, displacement=displacement)
        if display.distance_mm is not None:
            raise FileError(
                "alignment",
                "holds what was learned behind the display's Fourier lens, and the picture is shown without "
                "one: give the alignment from align mask, without what was learned.",
            )
        turns = display.mask.design_wavelength_nm / display.wavelength_nm
        return replace(display, displacement=displacement).taught(self.learned.at(turns))

    def require_correction(self, given: bool) -> None:
        """Refuse to show a pattern otherwise than what was learned of the display.

        Raises BenchError where it was learned with an SLM calibration and none is given, or the other way.
        """
        if self.learned is not None and self.corrected is not None and self.corrected != given:
            raise BenchError(
                "This display was learned "
                + (
                    "with an SLM calibration: give the same --slm-calibration."
                    if self.corrected
                    else "without an SLM calibration: leave --slm-calibration out, or learn it again."
                )
            )


def save_alignment(path: Path, alignment: Alignment, facts: Mapping[str, Any]) -> None:
    """Write an alignment with further facts; errors as ``write_text``."""
    ALIGNMENT.write(path, {**plain(alignment), "rest": alignment.rest.round(4), **facts})


def load_alignment(path: Path) -> Alignment:
    """Read an alignment.

    Raises FileError when it is missing, no alignment, or damaged.
    """
    record = ALIGNMENT.read(path)
    with ALIGNMENT.damaged(path):
        alignment = value_of(Alignment, record)  # what is not the alignment's own are facts about it
        if not np.isfinite(alignment.pose.vector()).all():
            raise ValueError("the pose is not finite")
        if alignment.rest.shape != (*NODES, 2) or not np.isfinite(alignment.rest).all():
            raise ValueError(f"'rest' should be {(*NODES, 2)} numbers, not {alignment.rest.shape}")
        return alignment
