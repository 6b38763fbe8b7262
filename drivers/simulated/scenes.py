"""What stands before the simulated camera: the scenes that ``bench.toml`` names."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np

from drivers.simulated.options import Preset, WorldOptions
from recon.arrays import Float32Array
from recon.optics.scene import Scene, bar_target, bead_volume, picture, tilted_target

FIELD_SHARE = 0.5
SHEET_SHARE = 2.0
"""Of what the sensor sees: a sheet reaches beyond it on all sides."""

SHEET_PIXELS = 128
"""A side: fine enough for the light of single LEDs."""

LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)


def make_scene(options: WorldOptions, preset: Preset, distance_um: float) -> Scene | None:
    """Build the scene that the options name; sizes left out follow from what the sensor sees."""
    if options.scene == "none":
        return None
    z_um, height_um = place_of(options, preset, distance_um)
    if options.scene in ("picture", "color_picture"):
        portrait = sample_picture()
        if options.scene == "picture":
            portrait = portrait @ LUMINANCE
        return picture(portrait, z_um, height_um * portrait.shape[1] / portrait.shape[0])
    if options.scene == "sheet":
        if options.scene_height_mm is None:
            height_um *= SHEET_SHARE / FIELD_SHARE
        return picture(np.ones((SHEET_PIXELS, SHEET_PIXELS)), z_um, height_um, name="sheet")
    if options.scene == "bars":
        return picture(bar_target(), z_um, height_um, name="bar target")
    if options.scene == "tilted_bars":
        return tilted_target(bar_target(), z_um, height_um, options.scene_tilt_deg)
    depth_um = 0.5 * z_um if options.scene_depth_mm is None else 1e3 * options.scene_depth_mm
    near, far = z_um - depth_um / 2, z_um + depth_um / 2
    extent_um = (height_um * near / z_um, height_um * near / z_um)
    return bead_volume(
        options.beads, extent_um, (near, far), diameter_um=options.bead_diameter_um, seed=options.seed
    )


def make_slide(options: WorldOptions, preset: Preset, distance_um: float, number: int) -> Scene:
    """Build a flat slide of beads where the scene is; each ``number`` has its beads at other places."""
    z_um, height_um = place_of(options, preset, distance_um)
    return bead_volume(
        options.beads,
        (height_um, height_um),
        (z_um, z_um),
        diameter_um=options.bead_diameter_um,
        seed=options.seed + 1000 * (number + 1),
    )


def place_of(options: WorldOptions, preset: Preset, distance_um: float) -> tuple[float, float]:
    """Return a scene's distance from the diffuser and its height: half of what the sensor sees there."""
    z_um = 1e3 * (options.scene_distance_mm or preset.source_distance_mm)
    if options.scene_height_mm is not None:
        return z_um, 1e3 * options.scene_height_mm
    return z_um, FIELD_SHARE * preset.sensor.shape[0] * preset.sensor.pitch_um * z_um / distance_um


def sample_picture() -> Float32Array:
    """Load the photograph that ships with matplotlib, ``(600, 512, 3)`` float32 linear brightness, 0 to 1."""
    path = Path(_folder_of("matplotlib"), "mpl-data", "sample_data", "grace_hopper.jpg")
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ValueError(f"matplotlib's sample picture {path} cannot be read")
    srgb = bgr[:, :, ::-1].astype(np.float32) / 255
    low = srgb <= 0.04045
    return np.where(low, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)


def _folder_of(package: str) -> str:
    """Return where a package lies, which is not imported: matplotlib is a third of a second."""
    found = find_spec(package)
    if found is None or not found.submodule_search_locations:
        raise ValueError(f"The scene is {package}'s sample picture, and {package} is not installed.")
    return found.submodule_search_locations[0]
