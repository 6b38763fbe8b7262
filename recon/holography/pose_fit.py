"""From the brightness of spots to the mask's pose: response of a spot, one linear step, its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.holography.pose import NAMES, Pose, natural_steps
from recon.holography.spots import Spot, SpotMaker, depth_um

Array = npt.NDArray[Any]


@dataclass(frozen=True, slots=True)
class PoseStep:
    """What one frame (or several) of probe spots say.

    Attributes
    ----------
    change : ndarray, float64, (8,)
        To add to the pose, in its units.
    error : ndarray, float64, (8,)
        Standard uncertainty of the change.
    """

    change: npt.NDArray[np.float64]
    error: npt.NDArray[np.float64]


class PoseProbe:
    """Pairs of spots on either side of a pose, one pair a parameter, and what their brightness means.

    For parameter ``p`` two spots assume ``pose + step_p`` and ``pose - step_p``. From their amplitudes ``a+``
    and ``a-`` comes ``g_p = (a+ - a-) / (a+ + a-)``, zero at the right pose. How ``g`` depends on a small
    error in every parameter is computed once, from the fields themselves; errors in all parameters then
    follow from one linear system.

    Parameters
    ----------
    maker : SpotMaker
    """

    def __init__(self, maker: SpotMaker) -> None:
        self.maker = maker
        display = maker.display
        self.steps = natural_steps(
            display.mask.shape, display.factor, display.mask_pitch_um, depth_um(display)
        )
        self._jacobian: npt.NDArray[np.float64] | None = None

    def poses(self, pose: Pose) -> list[Pose]:
        """Return the probe poses: plus and minus for each parameter, then the pose itself."""
        found = []
        for p in range(len(NAMES)):
            change = np.zeros(len(NAMES))
            change[p] = self.steps[p]
            found += [pose.plus(change), pose.plus(-change)]
        return [*found, pose]

    def jacobian(self) -> npt.NDArray[np.float64]:
        """Return ``dg_p / d(error_q / step_q)``, (8, 8)."""
        if self._jacobian is None:
            n = len(NAMES)
            at = Pose()
            wanted = [np.exp(1j * np.angle(self._field(pose))) for pose in self.poses(at)[:-1]]
            jacobian = np.zeros((n, n))
            small = 0.2
            for q in range(n):
                error = np.zeros(n)
                error[q] = small * self.steps[q]
                sides = []
                for sign in (1, -1):
                    truth = self._field(at.plus(sign * error))
                    a = np.array([abs(np.vdot(truth, slm)) for slm in wanted])
                    sides.append((a[0::2] - a[1::2]) / (a[0::2] + a[1::2]))
                jacobian[:, q] = (sides[0] - sides[1]) / (2 * small)
            self._jacobian = jacobian
        return self._jacobian

    def step(self, brightness: Array, noise: float, pose: Pose, prior: Array) -> PoseStep:
        """Turn measured brightness into a change of pose.

        Parameters
        ----------
        brightness : ndarray, (n_frames, 17)
            Spot intensities in the order of :meth:`poses`; negative ones count as zero.
        noise : float
            Standard deviation of a spot's amplitude from what surrounds it, in the square root of the
            brightness' units.
        pose : Pose
            The pose probed.
        prior : ndarray, (8,)
            Standard deviation of each parameter before anything was measured, about zero; infinite for none.
        """
        amplitude = np.sqrt(np.maximum(brightness, 0))
        plus, minus = amplitude[:, 0:16:2].mean(axis=0), amplitude[:, 1:16:2].mean(axis=0)
        total = np.maximum(plus + minus, 1e-12)
        g = (plus - minus) / total
        sigma = noise / np.sqrt(len(amplitude)) * np.sqrt(2) / total
        if len(amplitude) > 2:
            # Spots differ by more than the speckle around them where something is not modelled.
            single = amplitude[:, 0:16:2] - amplitude[:, 1:16:2]
            scatter = np.sqrt(single.var(axis=0, ddof=1) / len(amplitude)) / total
            sigma *= max(1.0, float(np.sqrt(np.mean((scatter / sigma) ** 2))))
        weighted = self.jacobian() / sigma[:, None]
        likely = (self.steps / prior) ** 2
        # Without the unit term a picture that tells nothing would throw the pose far away.
        covariance = np.linalg.inv(weighted.T @ weighted + np.diag(likely) + np.eye(len(NAMES)))
        change = covariance @ (weighted.T @ (g / sigma) - likely * pose.vector() / self.steps)
        return PoseStep(np.clip(change, -1.2, 1.2) * self.steps, np.sqrt(np.diag(covariance)) * self.steps)

    def _field(self, pose: Pose) -> Array:
        return self.maker.field(Spot(3, 5, pose))
