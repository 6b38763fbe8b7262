"""Optics and sensors that the simulated bench can be built as.

The first three follow the dissertation's prototypes (Kuo 2020, Ch. 3, 4.3, 6.4) and their sensors' published
data sheets, rounded; ``tiny`` is for tests and trials: the smooth diffuser's physics on a sensor small enough
that a frame takes milliseconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

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
