"""What the two fast volume solvers share: one channel, the data term on the sensor, where state lives."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from recon.camera.background import BackgroundRemoval
from recon.camera.base import Array
from recon.camera.convolution3d import Convolution3D
from recon.solvers.base import Solver
from recon.solvers.memory import Storage
from recon.solvers.sensor_system import SensorSystem


class VolumeSplitting(Solver):
    """A splitting method for one channel of a volume whose data term is solved exactly on the sensor.

    Parameters
    ----------
    operator : Convolution3D
        One channel.
    data : ndarray, (1, height, width)
    weight : float
        tau, absolute; 0 leaves non-negativity alone.
    valid : ndarray of bool, (height, width), optional
        Pixels that were measured.
    background : BackgroundRemoval, optional
        A smooth background to be estimated as well, for the same valid pixels.
    relaxation : float
        alpha, between 1 and 2.
    balance : bool
        Adapt the penalty or step while running.
    keep_state : bool
        False gives the state up when :meth:`run` ends: one volume less at the peak, and nothing to go on
        from.
    storage : Storage, optional
        Where the state lives; default memory. (The transfer functions are the operator's.)
    """

    def __init__(
        self,
        operator: Convolution3D,
        data: Array,
        weight: float,
        *,
        valid: npt.NDArray[np.bool_] | None,
        background: BackgroundRemoval | None,
        relaxation: float,
        balance: bool,
        keep_state: bool,
        storage: Storage | None,
    ) -> None:
        super().__init__()
        if operator.domain_shape[0] != 1:
            raise ValueError(f"One channel at a time, not {operator.domain_shape[0]}.")
        self.operator = operator
        self.weight = float(weight)
        self.relaxation = relaxation
        self.balance = balance
        self.keep_state = keep_state
        self.system = SensorSystem(
            operator.grid_shape, operator.sensor_window, valid, background, dtype=operator.dtype
        )
        self.data = self.system.masked(np.array(data, operator.dtype).reshape(operator.sensor_shape))
        self._storage = storage or Storage()

    @property
    def _tolerance(self) -> float:
        """Part of the state: how exactly the sensor's system is solved next."""
        return self.system.tolerance

    @_tolerance.setter
    def _tolerance(self, value: float) -> None:
        self.system.tolerance = value

    def _start(self) -> Array | None:
        return None
