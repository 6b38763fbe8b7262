"""Mask alignments on disk: one JSON file that holograms are computed with."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from instrument.files.record import RecordFormat, plain, value_of
from recon.holography import Display
from recon.holography.pose import NODES, Pose

ALIGNMENT = RecordFormat(
    "diffuserbench mask alignment", "mask alignment", make="Make one: diffuserbench align mask"
)


@dataclass(frozen=True, slots=True)
class Alignment:
    """Where the mask was found.

    Attributes
    ----------
    pose : Pose
        Left over with the stage at ``stage_position``.
    error : mapping of parameter name to float
        Standard uncertainties.
    rest : ndarray, float64, (rows, columns, 2)
        Smooth displacement beyond the pose's, on the nodes of ``Pose.displacement``, mask pixels.
    efficiency : float
        Spot brightness over the model's ideal.
    stage_position : mapping of axis name to float
        Where the stage was.
    mask_shape : (int, int)
        Of the mask that it holds for, in pixels.
    simulated : bool
    """

    pose: Pose
    error: Mapping[str, float]
    rest: npt.NDArray[np.float64]
    efficiency: float
    stage_position: Mapping[str, float]
    mask_shape: tuple[int, int]
    simulated: bool

    def of(self, display: Display) -> Display:
        """Return the display with this mask's displacement.

        Raises
        ------
        FileError
            When the alignment is another mask's.
        """
        if display.mask.shape != self.mask_shape:
            raise FileError(
                "alignment",
                f"holds for a mask of {self.mask_shape} pixels; this display's has {display.mask.shape}.",
            )
        return replace(display, displacement=self.pose.displacement(self.mask_shape) + self.rest)


def save_alignment(path: Path, alignment: Alignment, facts: Mapping[str, Any]) -> None:
    """Write an alignment with further facts; errors as ``write_text``."""
    ALIGNMENT.write(path, {**plain(alignment), "rest": alignment.rest.round(4), **facts})


def load_alignment(path: Path) -> Alignment:
    """Read an alignment.

    Raises
    ------
    FileError
        When it is missing, no alignment, or damaged.
    """
    record = ALIGNMENT.read(path)
    with ALIGNMENT.damaged(path):
        alignment = value_of(Alignment, record)  # what is not the alignment's own are facts about it
        if not np.isfinite(alignment.pose.vector()).all():
            raise ValueError("the pose is not finite")
        if alignment.rest.shape != (*NODES, 2) or not np.isfinite(alignment.rest).all():
            raise ValueError(f"'rest' should be {(*NODES, 2)} numbers, not {alignment.rest.shape}")
        return alignment
