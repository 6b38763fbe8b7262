"""The table ``[simulated]`` of ``bench.toml``: how the simulated bench is built, and its presets."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from drivers.simulated.surroundings import CommonOptions
from recon.optics.sensor import SensorSpec

DiffuserKind = Literal["smooth", "random_microlens", "regular_microlens"]


@dataclass(frozen=True, slots=True)
class Preset:
    """One camera behind a diffuser, with the stage travel and brightness that suit it."""

    sensor: SensorSpec
    diffuser_distance_mm: float
    aperture_mm: tuple[float, float]
    """``(height, width)``."""
    diffuser: DiffuserKind
    height_map_pitch_um: float
    fall_off_sigma_deg: tuple[float, float] | None
    """Gaussian response along y and along x."""
    source_diameter_um: float
    source_distance_mm: float
    """Where the stage carries the point source after homing."""
    travel_mm: tuple[float, float, float]
    """Half the travel in x and in y, and the farthest z."""
    nearest_z_mm: float
    scene_photons_per_s_mm2_sr: float
    """Sent along the axis by a square millimetre of white picture, in each band."""
    bead_photons_per_s_sr: float
    source_photons_per_s_sr: float
    """Sent along the axis by the point source, in each band, with the LED behind it at its brightest."""
    fluorescent: bool = False
    """Whether source and scene glow green whatever light excites them, the filters keeping the rest out."""
    focal_length_um: float = 1500.0
    lenslet_um: float = 250.0


PCO_EDGE = SensorSpec(
    name="PCO.edge 5.5",
    shape=(2160, 2560),
    pitch_um=6.5,
    quantum_efficiency=(0.55, 0.6, 0.5),
    full_well_e=30_000,
    read_noise_e=1.5,
    dark_current_e_per_s=0.8,
    prnu=0.005,
    dsnu_e=0.6,
    bits=16,
    frames_per_s=50.0,
)
IMX036 = SensorSpec(
    name="Flea3 (IMX036)",
    shape=(1552, 2080),
    pitch_um=2.5,
    quantum_efficiency=(0.45, 0.55, 0.5),
    full_well_e=8_000,
    read_noise_e=6.0,
    dark_current_e_per_s=8.0,
    prnu=0.01,
    dsnu_e=2.0,
    bits=12,
    black_level=0.008,
    frames_per_s=15.0,
)
IMX290 = SensorSpec(
    name="UI-3862LE (IMX290)",
    shape=(1096, 1936),
    pitch_um=2.9,
    quantum_efficiency=(0.65, 0.8, 0.7),
    full_well_e=15_000,
    read_noise_e=3.3,
    dark_current_e_per_s=3.0,
    prnu=0.007,
    dsnu_e=1.0,
    bits=12,
    black_level=0.008,
    frames_per_s=60.0,
)
TINY = SensorSpec(
    name="Tiny 320 x 240",
    shape=(240, 320),
    pitch_um=13.0,
    quantum_efficiency=(0.55, 0.6, 0.5),
    full_well_e=30_000,
    read_noise_e=3.0,
    dark_current_e_per_s=2.0,
    prnu=0.005,
    dsnu_e=1.0,
    bits=12,
    black_level=0.008,
    frames_per_s=200.0,
)

PRESETS: dict[str, Preset] = {
    "pco": Preset(
        sensor=PCO_EDGE,
        diffuser_distance_mm=8.9,
        aperture_mm=(5.5, 7.5),
        diffuser="smooth",
        height_map_pitch_um=5.0,
        fall_off_sigma_deg=(16.7, 23.1),  # 20 % at 30 and 41.5 degrees (Kuo 2020, 4.4)
        source_diameter_um=30.0,
        source_distance_mm=300.0,
        travel_mm=(150.0, 150.0, 500.0),
        nearest_z_mm=7.3,
        scene_photons_per_s_mm2_sr=2e10,
        bead_photons_per_s_sr=2e12,
        source_photons_per_s_sr=1e13,
    ),
    "pointgrey": Preset(
        sensor=IMX036,
        diffuser_distance_mm=6.4,
        aperture_mm=(1.8, 2.4),
        diffuser="smooth",
        height_map_pitch_um=2.5,
        fall_off_sigma_deg=None,
        source_diameter_um=30.0,
        source_distance_mm=200.0,
        travel_mm=(100.0, 100.0, 500.0),
        nearest_z_mm=7.0,
        scene_photons_per_s_mm2_sr=2e11,
        bead_photons_per_s_sr=1e13,
        source_photons_per_s_sr=3e13,
    ),
    "microscope": Preset(
        sensor=IMX290,
        diffuser_distance_mm=3.8,
        aperture_mm=(1.0, 1.0),
        diffuser="random_microlens",
        height_map_pitch_um=1.25,
        fluorescent=True,
        fall_off_sigma_deg=(13.0, 13.0),
        source_diameter_um=15.0,
        source_distance_mm=2.5,
        travel_mm=(2.0, 2.0, 10.0),
        nearest_z_mm=1.5,
        scene_photons_per_s_mm2_sr=2e10,
        bead_photons_per_s_sr=2e10,
        source_photons_per_s_sr=2e10,
    ),
    "tiny": Preset(
        sensor=TINY,
        diffuser_distance_mm=8.9,
        aperture_mm=(1.5, 2.0),
        diffuser="smooth",
        height_map_pitch_um=5.0,
        fall_off_sigma_deg=None,
        source_diameter_um=30.0,
        source_distance_mm=100.0,
        travel_mm=(60.0, 60.0, 300.0),
        nearest_z_mm=8.0,
        scene_photons_per_s_mm2_sr=2e10,
        bead_photons_per_s_sr=2e12,
        source_photons_per_s_sr=1e13,
    ),
}


MOST_SAMPLES = 32e6

Positive = Annotated[float, Field(gt=0)]
NotNegative = Annotated[float, Field(ge=0)]


class WorldOptions(CommonOptions):
    """Options of the simulated world; what is left out comes from the preset."""

    preset: Literal["pco", "pointgrey", "microscope", "tiny"] = Field(
        "pco", description="Optics and sensor; 'tiny' is for tests and trials."
    )

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

    scene: Literal["none", "picture", "color_picture", "bars", "tilted_bars", "beads", "sheet", "animal"] = (
        Field(
            "picture",
            description="What stands in front of the camera; a sheet is plain, evenly white; an animal "
            "moves and flashes (preset 'microscope', camera binned 4 x).",
        )
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
