"""Mask alignments on disk: one JSON file that holograms are computed with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from recon.holography import Display
from recon.holography.pose import NAMES, NODES, Pose

FORMAT = "diffuserbench mask alignment"


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
        from dataclasses import replace

        if display.mask.shape != self.mask_shape:
            raise FileError(
                "alignment",
                f"holds for a mask of {self.mask_shape} pixels; this display's has {display.mask.shape}.",
            )
        return replace(display, displacement=self.pose.displacement(self.mask_shape) + self.rest)


def save_alignment(path: Path, alignment: Alignment, facts: Mapping[str, Any]) -> None:
    """Write an alignment with further facts; errors as ``write_text``."""
    record = {"format": FORMAT, **asdict(alignment), "rest": alignment.rest.round(4).tolist(), **facts}
    write_text(path, json.dumps(record, indent=1) + "\n")


def load_alignment(path: Path) -> Alignment:
    """Read an alignment.

    Raises
    ------
    FileError
        When it is missing, no alignment, or damaged.
    """
    try:
        record = json.loads(path.read_text("utf-8"))
    except FileNotFoundError:
        raise FileError(path, "there is no such file.", "Make one: diffuserbench align mask") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileError(path, f"cannot be read as an alignment: {error}.") from None
    if not isinstance(record, dict) or record.get("format") != FORMAT:
        raise FileError(path, f"is no mask alignment ('format' should be {FORMAT!r}).")
    try:
        pose = Pose(**{name: float(record["pose"][name]) for name in NAMES})
        if not np.isfinite(pose.vector()).all():
            raise ValueError("the pose is not finite")
        rest = np.array(record["rest"], float)
        if rest.shape != (*NODES, 2) or not np.isfinite(rest).all():
            raise ValueError(f"'rest' should be {(*NODES, 2)} numbers, not {rest.shape}")
        height, width = record["mask_shape"]
        return Alignment(
            pose,
            dict(record["error"]),
            rest,
            float(record["efficiency"]),
            dict(record["stage_position"]),
            (int(height), int(width)),
            bool(record["simulated"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise FileError(path, f"is a damaged mask alignment: {error}.") from None
