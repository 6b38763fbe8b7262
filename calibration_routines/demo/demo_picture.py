"""The demo's picture as it is judged and shown: brightness corrected, cut to the screen, the right way up."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from calibration_routines.demo.demo_settings import DemoSettings
from calibration_routines.optics.comparison import compare, scene_field
from drivers.simulated.world import SimulatedWorld
from recon.solvers.stopping import IterationRecord

if TYPE_CHECKING:
    from calibration_routines.demo.demo import Measured

Float = npt.NDArray[np.float32]
_LOOK_EVERY_S = 0.05


class Viewer:
    """Knows the reconstruction's grid, the truth on it, and the response over the field.

    Attributes
    ----------
    truth : ndarray, float32, (height, width)
        The scene's radiance on the reconstruction's grid, upside down as the reconstruction is.
    field : Field
        The pixels that show the screen.
    object_pitch_um : float
        Pitch of the reconstruction in the scene's plane.
    seconds, psnr_db : list of float
        The reconstruction's way to its result, filled in while it runs.
    """

    def __init__(self, world: SimulatedWorld, settings: DemoSettings, measured: Measured) -> None:
        geometry = measured.calibration.calibration.geometry
        height, width = measured.photo.measurement.shape[:2]
        shape = (height, width)
        pitch, d_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
        if pitch is None or d_mm is None:
            raise ValueError("The demo's bench knows its pixel pitch and the distance d.")
        z_um = settings.scene_z_um
        self.object_pitch_um = pitch * z_um / (1e3 * d_mm)
        self.truth = np.asarray(world.ground_truth(shape, pitch), np.float32)
        self.field = scene_field(
            shape, (shape[0] // 2, shape[1] // 2), settings.scene_size_um, self.object_pitch_um
        )
        self._response = measured.response.on_grid(shape, pitch, 1e3 * d_mm, lambertian=True)
        self.seconds: list[float] = []
        self.psnr_db: list[float] = []

    def picture(self, image: Float) -> Float:
        """Return a reconstruction with the brightness lost off the axis restored."""
        corrected: Float = image / self._response
        return corrected

    def upright(self, image: Float, margin: int = 0) -> Float:
        """Return the field of an image, and ``margin`` pixels around it, the right way up."""
        rows, columns = (
            slice(max(0, part.start - margin), part.stop + margin)
            for part in (self.field.rows, self.field.columns)
        )
        return np.ascontiguousarray(image[rows, columns][::-1, ::-1])

    def watch(
        self, advance: Callable[[float], None]
    ) -> Callable[[IterationRecord, Callable[[], Float]], object]:
        """Return a callback for the reconstruction that records its error over time."""

        def look(record: IterationRecord, image: Callable[[], Float]) -> None:
            if not self.seconds or record.seconds - self.seconds[-1] >= _LOOK_EVERY_S:
                self.seconds.append(record.seconds)
                self.psnr_db.append(compare(self.picture(image()[0]), self.truth, self.field).psnr_db)
                advance(record.seconds)

        return look
