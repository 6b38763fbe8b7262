"""What a reconstruction returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recon.solvers.stopping import IterationRecord, StopReason
from recon.verdict.verdict import Verdict

if TYPE_CHECKING:
    from recon.reconstruction.choice import Choice


@dataclass(frozen=True, slots=True)
class ImageGrid:
    """Where the pixels of a reconstructed image lie.

    Attributes
    ----------
    shape : (int, int)
        ``(height, width)`` in pixels.
    centre : (int, int)
        ``(row, column)`` of the pixel on the axis.
    sensor_pitch_um : float or None
        Pixel pitch of the sensor: one image pixel is what shifts the PSF by one sensor pixel.
    object_pitch_um : float or None
        Pitch in the object's plane, ``sensor_pitch_um * z / d`` (Kuo 2020, Eq. 3.1).
    z_um : float or None
        Depth of the object's plane in front of the diffuser.
    """

    shape: tuple[int, int]
    centre: tuple[int, int]
    sensor_pitch_um: float | None = None
    object_pitch_um: float | None = None
    z_um: float | None = None


@dataclass(frozen=True, slots=True)
class Reconstruction:
    """A reconstructed picture with all that is needed to judge it.

    Attributes
    ----------
    image : ndarray, float32, (height, width) or (height, width, n_channels)
        In the units in which ``measurement = PSF * image`` holds with the PSF as calibrated.
    grid : ImageGrid
    method, prior : str
    tau : float or None
        Regularisation used, relative (see :func:`recon.reconstruct`).
    noise_norm : float or None
        Expected norm of the measurement's noise, measurement units.
    history : tuple of IterationRecord
        Empty for one-shot methods.
    stop_reason : StopReason or None
        None for one-shot methods.
    seconds : float
        Wall time of the solver.
    warnings : tuple of str
        What may be wrong with the result, in sentences.
    state : ndarray or None
        The whole object on the operator's grid, (n_channels, ...): pass as ``initial`` for a warm start.
    provenance : mapping
        Software and settings, JSON-compatible.
    verdict : Verdict or None
        Whether to trust it, from the data alone; None where nobody asked for one.
    """

    image: npt.NDArray[np.float32]
    grid: ImageGrid
    method: str
    prior: str
    tau: float | None
    noise_norm: float | None
    history: tuple[IterationRecord, ...]
    stop_reason: StopReason | None
    seconds: float
    warnings: tuple[str, ...] = ()
    state: npt.NDArray[Any] | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict)
    verdict: Verdict | None = None
    choice: Choice | None = None
    """What was chosen and why, where the program chose (``model="auto"``)."""
