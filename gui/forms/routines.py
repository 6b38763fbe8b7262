"""The forms of calibration routines and plans."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from calibration_routines.display.display_procedures import SlmProcedure
from calibration_routines.optics.beads import BeadSlides
from calibration_routines.optics.dpc import BANDS, DpcSetup
from calibration_routines.optics.optics_procedures import (
    AngularProcedure,
    BeadProcedure,
    DpcProcedure,
    PhotographProcedure,
)
from calibration_routines.plan_procedures import PlanProcedure
from calibration_routines.psf.sweep_procedure import SweepProcedure
from calibration_routines.psf.sweep_request import (
    AxialRequest,
    LateralRequest,
    VolumeRequest,
    reachable_depths_um,
)
from gui.forms.field import MM, Form, field_of, setting
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import Plan
from recon.base.declare import Option
from recon.blind import BlindSettings


def _taking(settings: type) -> tuple[Option, ...]:
    return (
        field_of(settings, "average", "Frames a PSF", "All are stored; their mean is the PSF", "whole"),
        field_of(
            settings,
            "dark_frames",
            "Dark frames",
            "At the shortest and at the longest exposure each",
            "whole",
            advanced=True,
        ),
        field_of(
            settings,
            "target",
            "Exposure target",
            "Level of each PSF's 99.9th percentile, as a fraction of full scale: 0.05 to 0.9",
            advanced=True,
        ),
        field_of(
            settings,
            "dct_order",
            "Remove DCT",
            "The N x N lowest DCT coefficients are removed (stray light); 0: none",
            "whole",
            advanced=True,
        ),
        field_of(
            settings,
            "binning",
            "Binning",
            "In software, on top of the camera's; 0: as far as the PSF's finest structure allows",
            "whole",
            unit="px",
            advanced=True,
        ),
        field_of(
            settings,
            "reference_every",
            "Reference every",
            "PSFs between two visits to a reference point, which tell whether the source drifts; 0: none",
            "whole",
            unit="PSFs",
            advanced=True,
        ),
    )


def _centre(settings: type, what: str) -> tuple[Option, ...]:
    return tuple(
        field_of(settings, f"{axis}_um", f"{what} {axis}", f"From the diffuser's centre, along {axis}",
                 unit="mm", scale=MM, advanced=True)
        for axis in "xy"
    )  # fmt: skip


def _planes(settings: type) -> tuple[Option, ...]:
    return (
        field_of(
            settings,
            "planes",
            "Planes",
            "Evenly spaced in 1/z",
            "whole",
            optional="as many as the optics need",
        ),
        field_of(
            settings,
            "lenslet_um",
            "Lenslet",
            "Diameter of a microlens diffuser's lenslets, for the number of planes (Kuo 2020, Eq. 5.10)",
            unit="µm",
            optional="no lenslets",
            advanced=True,
        ),
        field_of(
            settings,
            "wavelength_nm",
            "Wavelength",
            "For the lenslets' depth of field",
            unit="nm",
            optional="the bench's",
            advanced=True,
        ),
    )


def _grid(settings: type) -> tuple[Option, ...]:
    return (
        *(
            field_of(
                settings,
                f"half_field_{axis}_um",
                f"Half field {axis}",
                f"Half the grid's extent along {axis}; both or none",
                unit="mm",
                scale=MM,
                optional="what a reconstruction shows",
            )
            for axis in "xy"
        ),
        field_of(
            settings,
            "spacing_um",
            "Spacing",
            "Of the grid's points",
            unit="mm",
            scale=MM,
            optional="by the fall-off's Nyquist rate",
        ),
        field_of(
            settings,
            "response",
            "Angular response",
            "File of the angular routine: angular_response.json",
            "file",
            optional="none",
        ),
        field_of(
            settings,
            "fall_off_deg",
            "or Gaussian fall-off",
            "Standard deviation of the sensor's angular response",
            unit="deg",
            optional="none",
        ),
    )


def _near_and_far(bench: Bench) -> Mapping[str, Any]:
    near_um, far_um = reachable_depths_um(bench)
    return {"z_min_um": near_um, "z_max_um": far_um, "z_um": far_um}


AXIAL = Form(
    "axial",
    "Axial sweep",
    "PSFs along the axis: for volumes, and with one plane for photographs",
    (
        field_of(
            AxialRequest, "z_min_um", "Nearest plane", "Distance from the diffuser", unit="mm", scale=MM
        ),
        field_of(
            AxialRequest,
            "z_max_um",
            "Farthest plane",
            "Distance from the diffuser",
            unit="mm",
            scale=MM,
            optional="one PSF",
        ),
        *_planes(AxialRequest),
        field_of(
            AxialRequest,
            "by_hand",
            "Placed by hand",
            "The source was placed by hand at the nearest plane; nothing moves",
            "switch",
            advanced=True,
        ),
        *_centre(AxialRequest, "Source"),
        *_taking(AxialRequest),
    ),
    lambda values: SweepProcedure(AxialRequest(**values)),
    start=_near_and_far,
)
LATERAL = Form(
    "lateral",
    "Lateral sweep",
    "PSFs on a grid at one depth: for a camera whose PSF changes over the field",
    (
        field_of(LateralRequest, "z_um", "Depth", "Distance from the diffuser", unit="mm", scale=MM),
        *_grid(LateralRequest),
        *_centre(LateralRequest, "Centre"),
        *_taking(LateralRequest),
    ),
    lambda values: SweepProcedure(LateralRequest(**values)),
    ("stage",),
    _near_and_far,
)
VOLUME = Form(
    "volume",
    "Volume sweep",
    "PSFs on a grid at several depths",
    (
        field_of(
            VolumeRequest, "z_min_um", "Nearest plane", "Distance from the diffuser", unit="mm", scale=MM
        ),
        field_of(
            VolumeRequest, "z_max_um", "Farthest plane", "Distance from the diffuser", unit="mm", scale=MM
        ),
        *_planes(VolumeRequest),
        *_grid(VolumeRequest),
        *_centre(VolumeRequest, "Centre"),
        *_taking(VolumeRequest),
    ),
    lambda values: SweepProcedure(VolumeRequest(**values)),
    ("stage",),
    _near_and_far,
)
ANGULAR = Form(
    "angular",
    "Angular response",
    "The sensor's response to light from the side, for the spacing of lateral sweeps",
    (
        field_of(
            AngularProcedure,
            "z_um",
            "Distance",
            "Of the source's plane from the diffuser",
            unit="mm",
            scale=MM,
            optional="the farthest that spans the angles",
        ),
        field_of(AngularProcedure, "largest_deg", "Largest angle", "To both sides along x and y", unit="deg"),
        field_of(AngularProcedure, "step_deg", "Step", "Between angles", unit="deg"),
        field_of(
            AngularProcedure,
            "emission",
            "Source",
            "A flat pinhole that faces the sensor, or a fluorescent bead",
            "choice",
            choices=("pinhole", "bead"),
        ),
        field_of(AngularProcedure, "average", "Frames a place", "Averaged", "whole"),
        field_of(
            AngularProcedure,
            "dark_frames",
            "Dark frames",
            "At two exposures each",
            "whole",
            advanced=True,
        ),
    ),
    lambda values: AngularProcedure(**values),
    ("stage",),
)
DPC = Form(
    "dpc",
    "Diffuser surface (DPC)",
    "The diffuser's height by differential phase contrast, in an LED array microscope",
    (
        field_of(DpcSetup, "objective_na", "Objective's NA", "Numerical aperture, 0 to 0.95", default=0.1),
        field_of(DpcSetup, "magnification", "Magnification", "From sample to camera", default=4.0, unit="x"),
        field_of(DpcSetup, "index", "Refractive index", "Of the diffuser; polycarbonate: 1.58"),
        field_of(DpcSetup, "band", "LEDs", "Which colour is lit", "choice", choices=BANDS),
        field_of(DpcSetup, "average", "Frames a half", "Averaged", "whole"),
        field_of(DpcSetup, "dark_frames", "Dark frames", "Averaged", "whole", advanced=True),
    ),
    lambda values: DpcProcedure(DpcSetup(**values)),
    ("led_array",),
)


def _beads(values: Mapping[str, Any]) -> BeadProcedure:
    problems = [
        (name, f"at least {least} is needed, not {values[name]:g}")
        for name, least in (("rows", 1), ("columns", 1), ("rank", 1), ("iterations", 1), ("binning", 1))
        if values[name] < least
    ]
    if problems:
        raise SettingsError(problems)
    solver = BlindSettings(
        grid=(values["rows"], values["columns"]),
        ranks=tuple(range(1, values["rank"] + 1)),
        iterations=values["iterations"],
        tau=values["tau"],
        reach=values["reach"],
    )
    slides = BeadSlides(
        values["z_um"],
        images=values["images"],
        average=values["average"],
        binning=values["binning"],
        solver=solver,
    )
    return BeadProcedure(slides=slides)


_SOLVER = BlindSettings()
BEADS = Form(
    "beads",
    "Bead slides",
    "PSFs over the field from a few photographs of beads at unknown places: no stage is needed",
    (
        field_of(
            BeadSlides, "z_um", "Depth", "Of the slide, from the diffuser", default=2.5e3, unit="mm", scale=MM
        ),
        field_of(BeadSlides, "images", "Photographs", "The slide is moved in between", "whole"),
        field_of(BeadSlides, "average", "Frames a photograph", "Averaged", "whole"),
        field_of(
            BeadSlides, "binning", "Binning", "In software, on top of the camera's", "whole", unit="px"
        ),
        setting("rows", "Rows of PSFs", "Over the field", "whole", _SOLVER.grid[0]),
        setting("columns", "Columns of PSFs", "Over the field", "whole", _SOLVER.grid[1]),
        setting("rank", "Highest rank", "Raised step by step up to this", "whole", len(_SOLVER.ranks)),
        field_of(
            BlindSettings, "iterations", "Iterations", "Of each half-step", "whole", advanced=True
        ),
        field_of(BlindSettings, "tau", "Sparsity", "Of the beads, relative", advanced=True),
        field_of(BlindSettings, "reach", "Reach", "Part of the field that the PSFs span", advanced=True),
    ),
    _beads,
)  # fmt: skip
SLM = Form(
    "slm",
    "SLM look-up table",
    "The SLM's phase against its grey levels and, with an alignment, its flatness",
    (
        field_of(SlmProcedure, "levels", "Grey levels", "To measure, 8 to 256", "whole"),
        field_of(
            SlmProcedure, "alignment", "Alignment", "Of the mask: for flatness, too", "file", optional="none"
        ),
        field_of(SlmProcedure, "out", "File", "Where the calibration goes (.json)", "file",
                 optional="dated, beside the runs", advanced=True),
    ),
    lambda values: SlmProcedure(**values),
    ("slm",),
)  # fmt: skip


PHOTOGRAPH = Form(
    "photograph",
    "Photograph of the scene",
    "The lit scene, well exposed, dark frames taken off, as a reconstruction wants it",
    (
        field_of(
            PhotographProcedure,
            "exposure_ms",
            "Exposure",
            "Of each frame",
            unit="ms",
            optional="found, nothing saturates",
        ),
        field_of(PhotographProcedure, "average", "Frames", "All are stored; their mean is taken", "whole"),
        field_of(PhotographProcedure, "dark_frames", "Dark frames", "Without light", "whole"),
        field_of(
            PhotographProcedure,
            "binning",
            "Binning",
            "In software, on top of the camera's; the same as the calibration's",
            "whole",
            unit="px",
            advanced=True,
        ),
    ),
    lambda values: PhotographProcedure(**values),
)


def _plan(values: Mapping[str, Any]) -> PlanProcedure:
    try:
        data = tomllib.loads(values["text"])
    except tomllib.TOMLDecodeError as error:
        raise SettingsError([("text", str(error))]) from None
    base = Path(values["file"]).parent if values["file"] else Path()
    return PlanProcedure(Plan.checked(data, "plan").with_slm_images(lambda image: base / image))


PLAN = Form(
    "plan",
    "Plan",
    "Any acquisition, as a plan in TOML: positions, light, SLM images, exposures",
    (
        setting("file", "File", "A plan to read (.toml); relative paths are seen from its folder", "file",
              optional="none: what stands below"),
        setting("text", "Plan", "TOML; diffuserbench plan new writes the same example", "text",
              (files("instrument.plan") / "example.toml").read_text()),
    ),
    _plan,
)  # fmt: skip

ROUTINES: tuple[Form, ...] = (
    AXIAL,
    LATERAL,
    VOLUME,
    PHOTOGRAPH,
    ANGULAR,
    DPC,
    BEADS,
    SLM,
    PLAN,
)
