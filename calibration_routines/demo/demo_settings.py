"""What the demo does: which simulated bench, which sweep, which scene, which reconstruction."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from calibration_routines.psf.axial_plan import AxialSweep
from recon.optics.scene import Scene
from recon.optics.scenes import picture

PICTURE = Path(__file__).with_name("demo_picture.jpg")
"""A cup of coffee; photograph by Rachel Michetti, CC0 (docs/reference/demo-picture.md)."""


@dataclass(frozen=True, slots=True)
class DemoSettings:
    """The demo's settings; everything that could flatter the result is here, in the open.

    Attributes
    ----------
    preset : str
        The simulated optics: ``"pco"`` is the dissertation's prototype (Kuo 2020, Sec. 4.3).
    camera_binning, binning : int
        In the camera (2 as in Sec. 4.3) and of PSFs and photograph in software: to the optical resolution.
    z_mm : (float, float)
        Nearest and farthest plane of the sweep.
    planes : int
    scene_plane : int
        The plane, counted from the nearest, in which the scene stands.
    half_field_deg : float
        Half the angle under which the picture's width is seen.
    average : int
        Frames averaged, for PSFs and for the photograph.
    reconstruction_s : float
        Time budget of the reconstruction.
    time_scale : float
        Real seconds per simulated second of motion and exposure.
    seed : int
        Of the diffuser, the sensor and all noise.
    """

    preset: str = "pco"
    camera_binning: int = 2
    binning: int = 2
    z_mm: tuple[float, float] = (100.0, 500.0)
    planes: int = 7
    scene_plane: int = 5
    half_field_deg: float = 18.0
    average: int = 4
    reconstruction_s: float = 12.0
    time_scale: float = 1.0
    seed: int = 0

    @property
    def sweep(self) -> AxialSweep:
        """The axial sweep."""
        return AxialSweep(
            z_min_um=1e3 * self.z_mm[0],
            z_max_um=1e3 * self.z_mm[1],
            planes=self.planes,
            average=self.average,
            binning=self.binning,
        )

    @property
    def scene_z_um(self) -> float:
        """Depth of the scene."""
        return self.sweep.z_um[self.scene_plane]

    @property
    def scene_size_um(self) -> tuple[float, float]:
        """Height and width of the picture on the screen."""
        width = 2 * self.scene_z_um * float(np.tan(np.radians(self.half_field_deg)))
        rows, columns = read_picture().shape
        return width * rows / columns, width

    def scene(self) -> Scene:
        """Return the scene: the picture on a screen that glows in the colour of the point source."""
        radiance = np.zeros((*read_picture().shape, 3), np.float32)
        radiance[..., 1] = read_picture()
        return picture(radiance, self.scene_z_um, self.scene_size_um[1], name="a cup of coffee on a screen")

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


def read_picture() -> npt.NDArray[np.float32]:
    """Return the demo's picture as light from a screen: linear, 0 to 1, grey, (height, width) float32."""
    levels = cv2.imread(str(PICTURE), cv2.IMREAD_GRAYSCALE)
    if levels is None:
        raise FileNotFoundError(f"The demo's picture {PICTURE} is missing: install diffuserbench again.")
    return (np.asarray(levels, np.float32) / 255.0) ** np.float32(2.2)
