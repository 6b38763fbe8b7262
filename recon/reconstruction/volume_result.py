"""What the reconstruction of a volume returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recon.solvers.empty_planes import EmptyPlanes
from recon.solvers.stopping import IterationRecord, StopReason
from recon.verdict.verdict import Verdict

if TYPE_CHECKING:
    from recon.reconstruction.choice import Choice


@dataclass(frozen=True, slots=True)
class VolumeGrid:
    """Where the voxels of a volume lie: every depth has its own lateral pitch (Kuo 2020, sec. 4.4).

    Attributes
    ----------
    shape : (int, int, int)
        ``(n_z, height, width)``.
    centre : (int, int)
        ``(row, column)`` of the pixel on the axis.
    z_um : ndarray, (n_z,)
        Depth of each plane in front of the diffuser; NaN where not known.
    pitch_um : ndarray, (n_z,)
        Lateral pitch of each plane, ``sensor pitch * z / d``; NaN where not known.
    """

    shape: tuple[int, int, int]
    centre: tuple[int, int]
    z_um: npt.NDArray[np.float64]
    pitch_um: npt.NDArray[np.float64]

    @property
    def spacing_um(self) -> npt.NDArray[np.float64]:
        """Distance from each plane to the next, positive; the last one's is that of the plane before it."""
        if len(self.z_um) < 2:
            return np.full(len(self.z_um), np.nan)
        steps = np.abs(np.diff(self.z_um))
        return np.append(steps, steps[-1])

    def axis_weights(self) -> npt.NDArray[np.float64]:
        """Weights (n_z, 3) of the z, y and x differences for total variation in space instead of in voxels.

        A step between neighbours counts by the area of the face between their voxels; the x face of a plane
        is ``pitch * spacing``, the z face ``pitch^2``, so relative to x a z difference weighs ``pitch /
        spacing``. One throughout where the geometry is not known.
        """
        weights = np.ones((len(self.z_um), 3))
        ratio = self.pitch_um / self.spacing_um
        if np.isfinite(ratio).all():
            weights[:, 0] = ratio
        return weights


@dataclass(frozen=True, slots=True)
class VolumeReconstruction:
    """A reconstructed volume with all that is needed to judge it.

    Attributes
    ----------
    volume : ndarray, float32, (n_z, height, width) or (n_z, height, width, n_channels)
        In the units in which ``measurement = sum_z PSF_z * volume_z`` holds with the PSFs as calibrated.
    grid : VolumeGrid
    model : str
        ``"convolution"``, ``"local"`` or ``"lowrank"``, and in ``reason`` why.
    prior : str
    tau : float
        Regularisation used, relative to ``max |A^H b|``.
    background : ndarray or None
        The smooth background that was estimated along with the volume, measurement units; shaped as the
        measurement.
    noise_norm : float
        Expected norm of the noise, in the units of the history's residuals.
    histories : tuple of tuple of IterationRecord
        One history a channel.
    stop_reasons : tuple of StopReason
        One a channel.
    seconds : float
        Wall time of the solvers.
    empty_planes : tuple of EmptyPlanes
        One a channel: depth planes that were left out because they stayed empty, and whether the optimality
        condition certifies it.
    verdict : Verdict or None
        Whether to trust it, from the data alone; None where nobody asked for one.
    """

    volume: npt.NDArray[np.float32]
    grid: VolumeGrid
    model: str
    reason: str
    prior: str
    tau: float
    background: npt.NDArray[np.float32] | None
    noise_norm: float
    histories: tuple[tuple[IterationRecord, ...], ...]
    stop_reasons: tuple[StopReason, ...]
    seconds: float
    empty_planes: tuple[EmptyPlanes, ...] = ()
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    verdict: Verdict | None = None
    choice: Choice | None = None
    """What was chosen and why, where the program chose (``model="auto"``)."""
