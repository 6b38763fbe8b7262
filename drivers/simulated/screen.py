"""The simulated screen: a monitor before the camera, rendered by wave optics like every other scene."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from pydantic import Field

from drivers.device import DriverOptions, SharedPart
from drivers.simulated.scenes import SHEET_SHARE
from drivers.simulated.slm import PanelOptions, SimulatedPanel
from drivers.simulated.world import SimulatedWorld
from recon.arrays import Float32Array, Float64Array
from recon.optics.scene import Layer, Scene, picture

_FINER = 2  # cells of the rendered picture along a pixel: a turned pixel keeps its place within a tenth


class ScreenOptions(PanelOptions):
    """Options of the simulated screen in ``bench.toml``; no program looks at where it stands."""

    pixel_pitch_um: float = Field(270.0, gt=0, description="Pixel pitch.")
    settle_ms: float = Field(20.0, ge=0, description="From a picture sent to the picture seen.")
    distance_mm: float | None = Field(
        None, gt=0, description="From the diffuser to its middle; left out: where the stage homes."
    )
    center_mm: tuple[float, float] = Field((9.0, -6.0), description="x, y of its middle from the axis.")
    roll_deg: float = Field(1.5, ge=-180, le=180, description="Turned about the optical axis.")
    yaw_deg: float = Field(4.0, ge=-60, le=60, description="Turned about the vertical axis.")
    pitch_deg: float = Field(-2.0, ge=-60, le=60, description="Turned about the horizontal axis.")
    gamma: float = Field(2.2, ge=0.2, le=5, description="Radiance follows (level / 255)^gamma.")
    white: float = Field(1.0, gt=0, description="Radiance at level 255, relative to a white picture's.")
    black: float = Field(0.001, ge=0, lt=1, description="Radiance at level 0, relative to white.")
    room: float = Field(
        0.005, ge=0, description="Radiance of what the room's light shows in and around it, likewise."
    )


class SimulatedScreen(SimulatedPanel):
    """A monitor that stands a little askew before the camera.

    Each of its pixels glows alike in all directions. The light of a turned screen is followed back along the
    rays through the middle of the aperture to the plane of its own middle, which keeps the radiance along
    each ray and the perspective; only that its sides are nearer or farther, which scales their PSF by parts
    in a thousand, is left out.
    """

    model = "screen"
    is_screen = True
    Options = ScreenOptions
    options: ScreenOptions
    world: SimulatedWorld

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.z_um = 1e3 * (self.options.distance_mm or self.world.preset.source_distance_mm)

    def open(self) -> None:
        """Connect; the screen shows black, which glows a little."""
        super().open()
        self._black = self._glow()
        self.world.light_screen(*self._black)

    def close(self) -> None:
        """Show black, and switch off."""
        super().close()
        self.world.light_screen()

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels and wait until they are seen."""
        super().display(levels)
        options = self.options
        glow = np.power(levels.astype(np.float32) / 255, np.float32(options.gamma))
        shown = self._layers(glow * np.float32(options.white * (1 - options.black)))
        self.world.light_screen(*self._black, *shown)

    def place_um(self, rows: Float64Array, columns: Float64Array) -> Float64Array:
        """Return where pixels appear in the plane of the middle, (..., 2) as ``x, y``; pixels in numbers."""
        height, width = self.shape
        u = (columns - (width - 1) / 2) * self.pixel_pitch_um
        v = (rows - (height - 1) / 2) * self.pixel_pitch_um
        roll, yaw, pitch = np.deg2rad((self.options.roll_deg, self.options.yaw_deg, self.options.pitch_deg))
        # About x, then y, then z.
        y, z = v * np.cos(pitch), v * np.sin(pitch)
        x, z = u * np.cos(yaw) + z * np.sin(yaw), -u * np.sin(yaw) + z * np.cos(yaw)
        x, y = x * np.cos(roll) - y * np.sin(roll), x * np.sin(roll) + y * np.cos(roll)
        center_x, center_y = (1e3 * side for side in self.options.center_mm)
        nearer = self.z_um / (self.z_um + z)
        return np.stack(((x + center_x) * nearer, (y + center_y) * nearer), axis=-1)

    def _glow(self) -> tuple[Scene, ...]:
        """Return what glows whatever is shown: the screen's black, and the room around it."""
        options, world = self.options, self.world
        layers = self._layers(np.float32(options.white * options.black) * np.ones(self.shape, np.float32))
        if options.room > 0:
            side_um = SHEET_SHARE * max(world.sensor.shape) * world.sensor.pitch_um
            wall = np.full((8, 8), options.room * options.white)
            layers += (picture(wall, self.z_um, side_um * self.z_um / world.distance_um, name="room"),)
        return layers

    def _layers(self, radiance: Float32Array) -> tuple[Scene, ...]:
        """Return the screen's pixels as a picture parallel to the sensor; empty where none of them glows.

        As far as its light gets to the sensor. It has one size whatever glows, so that all pictures are
        rendered from the same point spread functions, which are kept.
        """
        if not radiance.any():
            return ()
        height, width = radiance.shape
        corners = np.array([(0, 0), (0, width), (height, width), (height, 0)], float) - 0.5
        seen = self.place_um(corners[:, 0], corners[:, 1])
        world = self.world
        bent_y, bent_x = world.propagator.half_extent_um(self.z_um)
        side_y, side_x = (n * world.sensor.pitch_um / 2 for n in world.sensor.shape)
        reach = np.array([side_x + bent_x, side_y + bent_y]) * self.z_um / world.distance_um
        low, high = np.clip(seen.min(axis=0), -reach, reach), np.clip(seen.max(axis=0), -reach, reach)
        if not (high > low).all():
            return ()
        pitch = self.pixel_pitch_um / _FINER
        shape = [max(1, int(n)) for n in np.ceil((high - low) / pitch)]
        on_layer = (seen - (low + high) / 2) / pitch + (np.array(shape) - 1) / 2
        warp = cv2.getPerspectiveTransform(corners[:, ::-1].astype(np.float32), on_layer.astype(np.float32))
        flat = np.asarray(cv2.warpPerspective(radiance, warp, shape), np.float32)
        x, y = (low + high) / 2
        size_um = (shape[1] * pitch, shape[0] * pitch)
        grey = np.broadcast_to(flat[:, :, None], (*flat.shape, 3))
        return (Scene("screen", (Layer(grey, self.z_um, size_um, (float(x), float(y))),)),)
