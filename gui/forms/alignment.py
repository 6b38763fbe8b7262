"""The form of the mask's alignment."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from calibration_routines.display.alignment_session import AlignmentSettings
from calibration_routines.display.display_procedures import AlignmentProcedure
from gui.forms.field import Form, field_of, setting
from instrument.files.errors import SettingsError

_SECTIONS = AlignmentSettings().division


def _make(values: Mapping[str, Any]) -> AlignmentProcedure:
    settings = dict(values)
    slm_calibration, out = settings.pop("slm_calibration"), settings.pop("out")
    for name in ("rows", "columns"):
        if settings[name] < 1:
            raise SettingsError([(name, f"at least one is needed, not {settings[name]}")])
    settings["division"] = (settings.pop("rows"), settings.pop("columns"))
    return AlignmentProcedure(
        settings=AlignmentSettings(**settings), slm_calibration=slm_calibration, out=out
    )


ALIGNMENT = Form(
    "alignment",
    "Mask alignment",
    "Finds the scattering mask by spots on the camera, moves its stage, and keeps what is left",
    (
        field_of(AlignmentSettings, "reach", "Reach", "Largest shift to look for", unit="mask px"),
        field_of(AlignmentSettings, "depth_um", "Depth", "Largest distance to look for", unit="µm"),
        field_of(AlignmentSettings, "moves", "Stage moves", "At most; 0: nothing moves", "whole"),
        field_of(AlignmentSettings, "max_frames", "Frames", "Give up rather than take more", "whole"),
        setting("rows", "Section rows", "Of the SLM, measured one by one", "whole", _SECTIONS[0]),
        setting("columns", "Section columns", "Of the SLM, measured one by one", "whole", _SECTIONS[1]),
        field_of(
            AlignmentSettings, "roll_mrad", "Rotation", "Largest to look for", unit="mrad", advanced=True
        ),
        field_of(AlignmentSettings, "scale", "Scale error", "Largest to look for", advanced=True),
        field_of(AlignmentSettings, "spots", "Spots", "In a search picture", "whole", advanced=True),
        field_of(
            AlignmentSettings,
            "section_pictures",
            "Section pictures",
            "In the last measurement of the sections",
            "whole",
            advanced=True,
        ),
        field_of(
            AlignmentSettings,
            "refinements",
            "Refinements",
            "Pictures of the last measurement of depth, tilts and brightness",
            "whole",
            advanced=True,
        ),
        field_of(
            AlignmentProcedure,
            "slm_calibration",
            "SLM calibration",
            "Look-up table and flatness, from the SLM routine",
            "file",
            optional="none: an ideal SLM",
        ),
        field_of(
            AlignmentProcedure,
            "out",
            "File",
            "Where the alignment goes (.json); a picture goes beside it",
            "file",
            optional="dated, beside the runs",
            advanced=True,
        ),
    ),
    _make,
    ("slm",),
)
