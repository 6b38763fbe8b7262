"""What the camera's demo is asked for, and the picture that it shows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from calibration_routines.demos.volume import Lights
from calibration_routines.psf.sweep_options import AxialSweep
from recon.arrays import Float32Array
from recon.base.declare import option
from recon.optics.scene import Scene, picture

GREEN = 1
"""Of red, green and blue: the light of PSFs, of the second scene and of the chart."""
PICTURE = Path(__file__).with_name("picture.jpg")
"""A cup of coffee; photograph by Rachel Michetti, CC0 (docs/reference/demo.md)."""
SCREEN_PIXELS = (420, 280)
"""Width and height of the picture on the screen: no finer than the camera's binned pixels see it."""
_HIDDEN: dict[str, Any] = {"flags": ("",)}  # not offered: the demo is the same for everybody


@dataclass(frozen=True)
class DemoSettings:
    """The demo's settings; everything that could flatter the result is here, in the open."""

    preset: str = option(
        "pco",
        help="The simulated optics; pco: the dissertation's prototype (Kuo 2020, Sec. 4.3).",
        **_HIDDEN,
    )
    camera_binning: int = option(2, least=1, help="In the camera, 2 as in Kuo 2020, Sec. 4.3.", **_HIDDEN)
    binning: int = option(
        2, least=1, help="Of PSFs and photographs in software: to the optical resolution.", **_HIDDEN
    )
    z_mm: tuple[float, float] = option(
        (100.0, 500.0), unit="mm", help="Nearest and farthest plane of the sweep.", **_HIDDEN
    )
    planes: int = option(7, least=1, help="Planes of the sweep.", **_HIDDEN)
    scene_plane: int = option(
        5, least=0, help="The plane, counted from the nearest, in which the scene stands.", **_HIDDEN
    )
    half_field_deg: float = option(
        18.0, unit="deg", help="Half the angle under which the picture's width is seen.", **_HIDDEN
    )
    lights: int = option(32, least=2, help="Green lights that wind away from the camera.", **_HIDDEN)
    average: int = option(2, least=1, help="Frames averaged for PSFs.", **_HIDDEN)
    photograph_average: int = option(8, least=1, help="The same of photographs.", **_HIDDEN)
    reconstruction_s: float = option(
        60.0,
        unit="s",
        least=0.1,
        flags=("--reconstruction-s",),
        metavar="S",
        help="Time for the picture, at most; half as much for the volume.",
    )
    chart_s: float = option(
        12.0, unit="s", least=0.1, help="Time for the chart of methods, at most.", **_HIDDEN
    )
    time_scale: float = option(
        0.02, least=0, help="Real seconds per simulated second of motion and exposure.", **_HIDDEN
    )
    seed: int = option(0, least=0, help="Of the simulated diffuser, sensor and noise.")

    @property
    def sweep(self) -> AxialSweep:
        """The axial sweep."""
        return AxialSweep(
            z_min_um=1e3 * self.z_mm[0],
            z_max_um=1e3 * self.z_mm[1],
            planes=self.planes,
            average=self.average,
            binning=self.binning,
            dark_frames=2 * self.average,
        )

    @property
    def scene_z_um(self) -> float:
        """Depth of the scene."""
        return self.sweep.z_um[self.scene_plane]

    @property
    def scene_size_um(self) -> tuple[float, float]:
        """Height and width of the picture on the screen."""
        width = 2 * self.scene_z_um * float(np.tan(np.radians(self.half_field_deg)))
        rows, columns = read_picture().shape[:2]
        return width * rows / columns, width

    def scene(self, shown: Sequence[bool] = (True, True, True)) -> Scene:
        """Return the scene: the picture on a screen, or what it shows in some of red, green and blue."""
        radiance = read_picture() * np.asarray(shown, np.float32)
        return picture(radiance, self.scene_z_um, self.scene_size_um[1], name="a cup of coffee on a screen")

    @property
    def volume(self) -> Lights:
        """The second scene: lights in a spiral from the nearest plane to the farthest."""
        half = float(np.tan(np.radians(self.half_field_deg)))
        return Lights(self.lights, self.sweep.z_um, (0.62 * half, half))

    def bench_toml(self) -> str:
        """Return the configuration of the demo's bench."""
        return f"""\
# The bench of diffuserbench demo: SIMULATED.
[bench]
name = "demo bench"
data_folder = "."

[camera]
driver = "simulated"
binning = {self.camera_binning}

[stage]
driver = "simulated"

[led_array]
driver = "simulated"

[source]
rgb = [0, 255, 0]

[scene]
control = "simulated"

[simulated]
preset = "{self.preset}"
seed = {self.seed}
time_scale = {self.time_scale:g}
"""


def read_picture() -> Float32Array:
    """Return the demo's picture as light from a screen: linear, 0 to 1, (280, 420, 3) float32."""
    levels = cv2.imread(str(PICTURE), cv2.IMREAD_COLOR)
    if levels is None:
        raise FileNotFoundError(f"The demo's picture {PICTURE} is missing: install diffuserbench again.")
    light = (np.asarray(levels[..., ::-1], np.float32) / 255.0) ** np.float32(2.2)
    return np.asarray(cv2.resize(light, SCREEN_PIXELS, interpolation=cv2.INTER_AREA), np.float32)
