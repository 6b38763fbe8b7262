"""One channel of a volume: its operator, and the solver that fits model and prior."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.base.namespace import Device, array_namespace
from recon.camera.background import BackgroundRemoval
from recon.camera.base import LinearOperator
from recon.camera.camera_model import LOW_RANK_ERROR, Depths, ModelName
from recon.camera.convolution3d import Convolution3D
from recon.camera.erasures import Erasures
from recon.camera.local_convolution import FieldOfPsfs, field_of, local_convolution
from recon.camera.low_rank import low_rank
from recon.camera.spatially_varying import SpatiallyVarying
from recon.errors import InputError
from recon.priors import L1, NonNegativity, Prior, TotalVariation
from recon.reconstruction.preparation import Precision
from recon.solvers import Solver, memory
from recon.solvers.operator_admm import OperatorAdmm
from recon.solvers.splitting import Room, SensorData, Tuning
from recon.solvers.tv_admm_volume import volume_solver

Array = npt.NDArray[Any]
VolumePrior = Literal["tv", "tv-isotropic", "l1", "nonnegative"]
PRIORS: tuple[VolumePrior, ...] = ("tv", "tv-isotropic", "l1", "nonnegative")

NOISE_WEIGHT = {"tv": 1.0, "l1": 1.5}
"""Default weight in units of the noise that the adjoint of a unit-energy PSF passes on: for TV as large, for
l1 what noise exceeds in few voxels."""
LEAST_TAU = {"tv": 1e-5, "l1": 1e-2}
"""Least default weight relative to ``max |A^H b|``: what errors of the model ask for when noise does not."""
VARYING_WEIGHT = {"tv": 0.5, "l1": 1.0}
VARYING_LEAST_TAU = {"tv": 1e-5, "l1": 4e-3}
"""Both where PSFs vary over the field: near the best from 100 to 20000 photons, in the mean 0.9 dB (pictures
by TV), 0.7 dB (volumes by TV) and 0.6 dB (points by l1) better than those above, at four to twelve times the
distance of diffuser and sensor. Strokes on black as near as that stand more: in the stability map of
calibration points errors are up to 20 % larger than with the weights above. One convolution leaves errors of
the model, which such weights hide as they hide noise; the true model leaves noise alone. With a background
points lose the hold that the total of the light gives them: there l1 keeps its ``LEAST_TAU``."""
BACKGROUND_FREQUENCIES = (5, 5)
"""Lowest DCT frequencies that belong to the background (Kuo 2020, sec. 6.2)."""


@dataclass(frozen=True)
class Scaled:
    """A measurement in units of its noise, and a calibration sorted by depth.

    ``energy`` is the root mean energy of the central PSFs; operators are built with PSFs divided by it.
    """

    data: npt.NDArray[np.float32]
    valid: npt.NDArray[np.bool_]
    noise: npt.NDArray[np.float32]
    energy: float
    depths: Depths
    warnings: tuple[str, ...]
    flat: bool


class ChannelProblem:
    """Operator and solver of one channel.

    Parameters
    ----------
    scaled : Scaled
    channel : int
    model : str
        Any of :data:`recon.camera.camera_model.MODELS` but ``"auto"``.
    smooth : bool
        Estimate a smooth background as well.
    prior : str
    weights : ndarray
        Axis weights of TV.
    drop_empty : bool
        With l1: leave out planes that stay empty.
    memory_gib, scratch, device : optional
        As :func:`recon.reconstruct_volume`.
    acceptance_px : float, optional
        As :class:`recon.camera.camera_model.Extent`.
    precision : "float32" or "float64"
        Of operator and solver.
    """

    def __init__(
        self,
        scaled: Scaled,
        channel: int,
        model: ModelName,
        *,
        smooth: bool,
        prior: VolumePrior,
        weights: Array,
        drop_empty: bool = True,
        memory_gib: float | None = None,
        scratch: Path | str | None = None,
        device: Device = "cpu",
        acceptance_px: float | None = None,
        precision: Precision = "float32",
    ) -> None:
        # Before any work: what is missing for the device is said at once.
        self._namespace = array_namespace(device)
        if device != "cpu" and model != "convolution":
            raise InputError(
                f"The {model} model runs on the cpu only. Choose the model convolution for the {device}."
            )
        self.dtype = np.dtype(precision)
        self.data = self._measured = scaled.data[channel : channel + 1].astype(self.dtype, copy=False)
        self.weight = 0.0
        self._removed: BackgroundRemoval | None = None
        self.valid = scaled.valid[channel]
        self.prior = prior
        self.weights = weights
        self.drop_empty = drop_empty
        self._unit = scaled.energy / float(scaled.noise[channel])
        self._removal = (
            BackgroundRemoval((1, *self.valid.shape), BACKGROUND_FREQUENCIES, self.valid, dtype=self.dtype)
            if smooth
            else None
        )
        self._limit = None if memory_gib is None else int(memory_gib * memory.GIB)
        self._storage = memory.Storage()
        own = slice(channel, channel + 1) if scaled.depths.central.shape[1] > 1 else slice(0, 1)
        scale = np.float32(1 / scaled.energy)
        height, width = self.valid.shape
        if model == "convolution":
            self.camera: Convolution3D | SpatiallyVarying = self._convolution(
                scaled.depths.central[:, own] * scale, scratch
            )
        else:
            fields = [FieldOfPsfs(f.psfs[:, own] * scale, f.points) for f in scaled.depths.fields]
            self.camera = self._varying(fields, model, acceptance_px)
            self._central = Convolution3D(
                scaled.depths.central[:, own] * scale, (height, width), dtype=self.dtype
            )

    def _convolution(self, psfs: Array, scratch: Path | str | None) -> Convolution3D:
        height, width = self.valid.shape
        camera = Convolution3D(
            psfs,
            (height, width),
            dtype=self.dtype,
            allocate=lambda shape, dtype: self._storage.zeros(shape, dtype),
        )
        kind = "tv" if self.prior.startswith("tv") else "l1"
        self.plan = memory.plan(
            kind,
            camera.domain_shape,
            psfs.size,
            len(psfs) * height * width,
            itemsize=self.dtype.itemsize,
            available=self._limit,
        )
        if not self.plan.fits:
            self._storage = memory.Storage(memory.scratch_for(self.plan, scratch), self.plan.room)
        return camera

    def _varying(
        self, fields: list[FieldOfPsfs], model: ModelName, acceptance_px: float | None
    ) -> SpatiallyVarying:
        shape = (self.valid.shape[0], self.valid.shape[1])
        field_shape, (row, column) = field_of(shape, fields[0].psfs.shape[2:])
        support = None
        if acceptance_px is not None:
            off_axis = np.hypot(np.arange(field_shape[0])[:, None] - row, np.arange(field_shape[1]) - column)
            support = np.broadcast_to(off_axis <= acceptance_px, (len(fields), *field_shape))
        grid = fft.fast_length(field_shape[0]), fft.fast_length(field_shape[1])
        camera = (
            local_convolution(fields, shape, support=support, grid_shape=grid, dtype=self.dtype)
            if model == "local"
            else low_rank(
                fields, shape, error=LOW_RANK_ERROR, support=support, grid_shape=grid, dtype=self.dtype
            )
        )
        volumes = 12 if self.prior.startswith("tv") else 6
        size = self.dtype.itemsize * int(np.prod(camera.domain_shape))
        available = memory.available_bytes() if self._limit is None else self._limit
        self.plan = memory.MemoryPlan(0, volumes * size + camera.nbytes, available)
        if not self.plan.fits:
            raise InputError(f"The {model} model needs {self.plan}. Bin the images or take fewer depths.")
        return camera

    def memory_used(self) -> str:
        """Say what was planned, and what had to go to disk."""
        on_disk = min(self._storage.on_disk, self.plan.state)  # turns of a run put theirs there anew
        if not on_disk:
            return str(self.plan)
        share = on_disk / max(self.plan.state, 1)
        return (
            f"{self.plan}; {on_disk / memory.GIB:.2f} GiB of the state in files, of which an iteration reads "
            f"and writes about {share * self.plan.traffic / memory.GIB:.2f} GiB"
        )

    def close(self) -> None:
        """Remove what the solver kept on disk."""
        self._storage.close()

    @property
    def _varies(self) -> bool:
        return isinstance(self.camera, SpatiallyVarying)

    @property
    def operator(self) -> LinearOperator:
        """The camera with everything that happens to its data."""
        operator: LinearOperator = self.camera
        if not self.valid.all():
            operator = Erasures(self.valid, self.data.shape, dtype=self.dtype) @ operator
        return operator if self._removal is None else self._removal @ operator

    def start(self, volume: Array, window: tuple[slice, slice]) -> Array:
        """Place a volume in measurement units on the operator's grid."""
        _, n_z, height, width = self.camera.domain_shape
        grid = np.zeros((1, n_z, height, width), self.dtype)
        if grid[0][:, window[0], window[1]].shape != volume.shape:
            raise InputError(
                f"The volume to start from is {volume.shape}; this measurement needs "
                f"{grid[0][:, window[0], window[1]].shape}."
            )
        grid[0][:, window[0], window[1]] = volume * np.float32(self._unit)
        return grid

    def background(self, solution: Array) -> Array:
        """Return the smooth background that goes with a solution, in units of the noise."""
        if self._removal is None:
            raise ValueError("No background was asked for.")
        rest: Array = self._removal.background(self.data - self.camera.forward(solution))
        return np.asarray(rest[0])

    def residual(self, solution: Array, background: Array | None) -> Array:
        """Return what a solution and its background leave of the data (height, width), in its noise."""
        rest: Array = (self._measured - self.camera.forward(solution))[0]
        return np.where(self.valid, rest if background is None else rest - background, 0)

    def positive_background(self, solution: Array) -> Array:
        """Return the smooth background >= 0 nearest to what a solution leaves of the data."""
        removal = self._removal or self._removed
        if removal is None:
            raise ValueError("No background was asked for.")
        rest: Array = removal.non_negative(self._measured - self.camera.forward(solution))
        return np.asarray(rest[0])

    def with_background(self, background: Array) -> Solver:
        """Take a background for given, and return a solver for what is left, with the same weight."""
        self._removed, self._removal = self._removal or self._removed, None
        self.data = np.where(self.valid, self._measured - background, 0).astype(self.dtype)
        return self._solver(None)

    def solver(self, tau: float | None, start: Array | None) -> tuple[Solver, float]:
        """Return a solver, and the prior's weight relative to ``max |A^H b|``."""
        data = self.data if self._removal is None else self._removal.forward(self.data)
        peak = self._peak(data)
        kind = "tv" if self.prior.startswith("tv") else "l1"
        if tau is None:
            noise = (VARYING_WEIGHT if self._varies else NOISE_WEIGHT)[kind]
            held = self._varies and self._removal is None
            tau = max(noise / peak if peak > 0 else 0.0, (VARYING_LEAST_TAU if held else LEAST_TAU)[kind])
        if not 0 <= tau < np.inf:
            raise InputError(f"tau must be 0 or more, and finite; got {tau}.")
        self.weight = 0.0 if self.prior == "nonnegative" else tau * peak
        return self._solver(start), tau

    def _solver(self, start: Array | None) -> Solver:
        data = SensorData(self.data, self.valid, self._removal)
        if isinstance(self.camera, SpatiallyVarying):
            axes = np.broadcast_to(self.weights, (len(self.weights), 3)).mean(axis=0)
            prior = self._penalty(axes, (False, False, False))
            return OperatorAdmm(self.camera, self._central, data, prior, initial=start)
        return volume_solver(
            self.camera,
            data,
            self._penalty(self.weights, (False, True, True)),
            initial=start,
            tuning=Tuning(drop_empty=self.drop_empty),
            room=Room(self._namespace, self._storage, keep_state=False),
        )

    def _penalty(self, axis_weights: Array, wrap: tuple[bool, ...]) -> Prior:
        """Return the prior by name, with its weight."""
        if not self.prior.startswith("tv"):
            return L1(self.weight) + NonNegativity()
        isotropic = self.prior == "tv-isotropic"
        variation = TotalVariation(self.weight, isotropic=isotropic, axis_weights=axis_weights, wrap=wrap)
        return variation + NonNegativity()

    def _peak(self, data: Array) -> float:
        """``max |A^H b|``, plane by plane: no volume for one number."""
        if isinstance(self.camera, SpatiallyVarying):
            return float(np.abs(self.camera.adjoint(data)).max())
        return max(float(np.abs(plane).max()) for plane in self.camera.adjoint_planes(data))
