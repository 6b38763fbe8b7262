"""The scenes that ``bench.toml`` can ask for by name."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib import cbook

from drivers.simulated.options import WorldOptions
from drivers.simulated.presets import Preset
from recon.optics.scene import Scene
from recon.optics.scenes import bar_target, bead_volume, picture, tilted_target

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
    z_um = 1e3 * (options.scene_distance_mm or preset.source_distance_mm)
    sensor_um = preset.sensor.shape[0] * preset.sensor.pitch_um
    height_um = FIELD_SHARE * sensor_um * z_um / distance_um
    if options.scene_height_mm is not None:
        height_um = 1e3 * options.scene_height_mm
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
    z_um = 1e3 * (options.scene_distance_mm or preset.source_distance_mm)
    sensor_um = preset.sensor.shape[0] * preset.sensor.pitch_um
    height_um = FIELD_SHARE * sensor_um * z_um / distance_um
    if options.scene_height_mm is not None:
        height_um = 1e3 * options.scene_height_mm
    return bead_volume(
        options.beads,
        (height_um, height_um),
        (z_um, z_um),
        diameter_um=options.bead_diameter_um,
        seed=options.seed + 1000 * (number + 1),
    )


def sample_picture() -> npt.NDArray[np.float32]:
    """Load the photograph that ships with matplotlib, ``(600, 512, 3)`` float32 linear brightness, 0 to 1."""
    path = cbook.get_sample_data("grace_hopper.jpg", asfileobj=False)
    bgr = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if bgr is None:
        raise ValueError(f"matplotlib's sample picture {path} cannot be read")
    srgb = bgr[:, :, ::-1].astype(np.float32) / 255
    low = srgb <= 0.04045
    return np.where(low, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4).astype(np.float32)
