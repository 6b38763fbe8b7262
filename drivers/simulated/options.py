"""The table ``[simulated]`` of ``bench.toml``: how the simulated bench is built."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.device import DriverOptions
from drivers.simulated.presets import PRESETS, DiffuserKind

MOST_SAMPLES = 32e6

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class WorldOptions(DriverOptions):
    """Options of the simulated world; what is left out comes from the preset."""

    preset: Literal["pco", "pointgrey", "microscope", "tiny"] = Field(
        "pco", description="Optics and sensor; 'tiny' is for tests and trials."
    )
    seed: int = Field(0, ge=0, description="The same seed gives the same diffuser, sensor and noise.")
    time_scale: float = Field(
        1.0,
        ge=0,
        description="Real seconds per simulated second of motion, exposure, settling; 0: no waiting.",
    )
    noise: float = Field(1.0, ge=0, description="Scale of all temporal noise: 1 is physical, 0 is none.")
    fixed_pattern: bool = Field(True, description="Whether pixels differ (response, offset, hot, dead).")

    diffuser: DiffuserKind | None = Field(None, description="Kind of diffuser; left out: the preset's.")
    diffuser_seed: int | None = Field(
        None, ge=0, description="Another diffuser with the same sensor; left out: seed."
    )
    feature_size_um: Positive = Field(140.0, description="Feature size of the smooth diffuser.")
    mean_slope_deg: float = Field(0.7, gt=0, lt=20, description="Mean slope of the smooth diffuser.")
    lenslet_um: Positive | None = Field(
        None, description="Spacing of the microlens diffusers; left out: the preset's."
    )
    focal_length_um: Positive | None = Field(
        None, description="Focal length of the microlenses; left out: the preset's."
    )
    diffuser_distance_mm: Positive | None = Field(
        None, description="From the diffuser's textured side to the sensor; left out: the preset's."
    )
    aperture_mm: tuple[Positive, Positive] | None = Field(
        None, description="[height, width] of the aperture on the diffuser; left out: the preset's."
    )

    fall_off: Literal["preset", "none", "gaussian", "table"] = Field(
        "preset", description="The sensor's angular response."
    )
    fall_off_sigma_deg: Positive = Field(13.0, description='Width of fall_off = "gaussian".')
    fall_off_table: tuple[tuple[float, float], ...] = Field(
        (), description='For fall_off = "table": pairs of angle in degrees, ascending from 0, and response.'
    )

    scene: Literal["none", "picture", "color_picture", "bars", "tilted_bars", "beads", "sheet"] = Field(
        "picture", description="What stands in front of the camera; a sheet is plain, evenly white."
    )
    scene_distance_mm: Positive | None = Field(
        None, description="From the diffuser to it, or to its middle; left out: where the stage homes."
    )
    scene_height_mm: Positive | None = Field(
        None, description="Its height; left out: half of what the sensor sees from there; of a sheet: twice."
    )
    scene_rgb: tuple[NotNegative, NotNegative, NotNegative] = Field(
        (1.0, 1.0, 1.0), description="Brightness of the scene's light in red, green, blue."
    )
    scene_tilt_deg: float = Field(45.0, ge=-80, le=80, description="Tilt of the tilted bars.")
    scene_depth_mm: Positive | None = Field(
        None, description="Depth of the beads' volume; left out: half its distance."
    )
    beads: int = Field(40, ge=1, le=10_000, description="Number of beads.")
    bead_diameter_um: NotNegative = Field(15.0, description="Their diameter.")

    led_light: Literal["source", "scene"] = Field(
        "source",
        description="What the LED array lights: the point source, or the scene, each LED the part behind it.",
    )
    source_diameter_um: NotNegative | None = Field(
        None, description="Diameter of the point source; left out: the preset's."
    )
    source_brightness: Positive = Field(
        1.0, description="Brightness of the point source relative to the preset's."
    )
    spectral_samples: int = Field(1, ge=1, le=9, description="Wavelengths averaged in each colour band.")

    @model_validator(mode="after")
    def _diffuser_can_be_made(self) -> Self:
        preset = PRESETS[self.preset]
        pitch_um = preset.height_map_pitch_um
        height_mm, width_mm = self.aperture_mm or preset.aperture_mm
        samples = height_mm * width_mm * 1e6 / pitch_um**2
        if samples > MOST_SAMPLES:
            side_mm = MOST_SAMPLES**0.5 * pitch_um * 1e-3
            raise ValueError(
                f"aperture_mm = [{height_mm:g}, {width_mm:g}] is too large to simulate with preset "
                f"{self.preset!r}: at most {side_mm:.0f} mm square"
            )
        if (self.diffuser or preset.diffuser) == "smooth":
            if self.feature_size_um < 4 * pitch_um:
                raise ValueError(
                    f"feature_size_um = {self.feature_size_um:g} is finer than preset {self.preset!r} "
                    f"samples its diffuser: at least {4 * pitch_um:g}"
                )
        else:
            lenslet_um = self.lenslet_um or preset.lenslet_um
            shortest_um = 1.7 * lenslet_um
            if (self.focal_length_um or preset.focal_length_um) < shortest_um:
                raise ValueError(
                    f"lenslets of {lenslet_um:g} um in air cannot focus so close: focal_length_um is at "
                    f"least {shortest_um:g}"
                )
        return self

    @model_validator(mode="after")
    def _beads_lie_in_front(self) -> Self:
        distance_mm = self.scene_distance_mm or PRESETS[self.preset].source_distance_mm
        if self.scene == "beads" and (self.scene_depth_mm or 0.0) >= 2 * distance_mm:
            raise ValueError(
                f"scene_depth_mm = {self.scene_depth_mm:g} about a middle at {distance_mm:g} mm reaches "
                f"behind the diffuser: less than {2 * distance_mm:g}"
            )
        return self

    @model_validator(mode="after")
    def _table_fits(self) -> Self:
        if self.fall_off == "table":
            angles = [angle for angle, _ in self.fall_off_table]
            if len(angles) < 2 or angles[0] != 0 or sorted(set(angles)) != angles:
                raise ValueError("fall_off_table needs two or more pairs whose angles ascend from 0 degrees")
            if any(response < 0 for _, response in self.fall_off_table):
                raise ValueError("fall_off_table holds a negative response")
        elif self.fall_off_table:
            raise ValueError('fall_off_table is used with fall_off = "table" only')
        return self
