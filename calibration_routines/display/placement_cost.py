"""How much PSNR a hologram has where the mask is: what a move would gain, what an uncertainty costs."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from instrument.files.sample_images import load_sample
from recon.holography import Display, Target
from recon.holography.lowpass import make_band
from recon.holography.placement import PlacedHologram
from recon.holography.pose import Pose

ITERATIONS = 15
"""Enough to tell places apart: further ones raise all of them alike."""
DRAWS = 6


class PlacementCost:
    """Computes holograms of a busy sample picture for places of the mask, and looks at them.

    Parameters
    ----------
    display : Display
    """

    def __init__(self, display: Display) -> None:
        self.display = display
        shape = make_band(display.slm_shape, display.factor, "alias_free").seen_shape
        ey, ex = (np.fft.fftshift(e) for e in display.envelope(shape))
        self._target = Target(load_sample("leaves", shape) * ey[:, None] * ex, white=1.0)
        self._in_place: PlacedHologram | None = None

    def psnr_db(self, pose: Pose) -> float:
        """Return the PSNR of a hologram that knows the pose's displacement, but not its depth and tilts."""
        return self._compute(pose).psnr_db(pose)

    def in_place(self, pose: Pose) -> float:
        """Return the PSNR of a hologram for what stays of a pose; computed once, as little changes there."""
        if self._in_place is None:
            self._in_place = self._compute(pose)
        return self._in_place.psnr_db(self._in_place.pose)

    def of_difference_db(self, place: Pose, difference: Pose) -> float:
        """Return what a hologram computed for :meth:`in_place` of a pose loses to a difference from there."""
        psnr_db = self.in_place(place)
        assert self._in_place is not None
        vector = self._in_place.pose.vector() + difference.vector()
        return psnr_db - self._in_place.psnr_db(Pose(*(float(v) for v in vector)))

    def lost_db(
        self,
        pose: Pose,
        deep_error: npt.NDArray[np.float64],
        rest: npt.NDArray[np.float64],
        modes: npt.NDArray[np.float64],
    ) -> float:
        """Return what a hologram computed with a result loses to what remains, on average.

        Depth and tilts are there and not modelled; they and the displacement are off by their uncertainty.

        Parameters
        ----------
        pose : Pose
        deep_error : ndarray, (3,)
            Uncertainty of depth, pitch and yaw.
        rest : ndarray, (rows, columns, 2)
            Displacement beyond the pose's.
        modes : ndarray, (modes, rows, columns, 2)
            Errors of the displacement, one standard deviation each.
        """
        hologram = self._compute(pose, rest)
        flat = pose.with_(z_um=0.0, pitch_mrad=0.0, yaw_mrad=0.0)
        rng = np.random.default_rng(0)
        seen = []
        for _ in range(DRAWS):
            z, pitch, yaw = rng.normal(size=3) * deep_error
            off = pose.with_(
                z_um=pose.z_um + z, pitch_mrad=pose.pitch_mrad + pitch, yaw_mrad=pose.yaw_mrad + yaw
            )
            error: npt.NDArray[np.float64] = np.tensordot(rng.normal(size=len(modes)), modes, 1)
            seen.append(hologram.psnr_db(off, error))
        return hologram.psnr_db(flat) - float(np.mean(seen))

    def _compute(self, pose: Pose, rest: npt.NDArray[np.float64] | None = None) -> PlacedHologram:
        return PlacedHologram(self.display, self._target, pose, rest, iterations=ITERATIONS)
