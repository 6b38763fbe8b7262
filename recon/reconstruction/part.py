"""What one solver takes of a problem: the channels that it solves together, their operator and weight."""

from __future__ import annotations

from functools import cached_property, partial, reduce
from operator import add
from typing import Any

import numpy as np

from recon.arrays import Array, BoolArray
from recon.base import fft
from recon.base.namespace import array_namespace
from recon.camera.base import LinearOperator
from recon.camera.camera_model import CAMERAS, LOW_RANK_ERROR
from recon.camera.convolution import Convolution, field_of
from recon.camera.factors import BackgroundRemoval, Erasures, PatternedCamera
from recon.camera.spatially_varying import SpatiallyVarying
from recon.camera.varying_on_device import VaryingOnDevice
from recon.camera.varying_psfs import FieldOfPsfs, grid_axes, local_convolution, low_rank, spanned
from recon.errors import NoMemoryError
from recon.priors import Prior, TotalVariation
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import window_of
from recon.reconstruction.weights import default_tau, is_weighted, kind_of, penalty_of
from recon.solvers import memory
from recon.solvers.splitting import SensorData

BACKGROUND_FREQUENCIES = (5, 5)
"""Lowest DCT frequencies that belong to the background (Kuo 2020, sec. 6.2)."""


class Reshaped(LinearOperator):
    """An operator whose object has another shape of as many values: a picture as a volume of one plane."""

    def __init__(self, own: LinearOperator, domain_shape: tuple[int, ...]) -> None:
        super().__init__(domain_shape, own.range_shape, own.dtype)
        self.own = own

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return what the sensor sees of ``x``."""
        return self.own.forward(x.reshape(self.own.domain_shape), out)

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Return the adjoint's object."""
        inside = None if out is None else out.reshape(self.own.domain_shape)
        return self.own.adjoint(y, inside).reshape(self.domain_shape)

    @property
    def norm_bound(self) -> float:
        """That of the operator itself."""
        return self.own.norm_bound


def expects_background(problem: Problem) -> bool:
    """Whether a background of this problem has a prior mean: see :meth:`Part.set_data`."""
    return problem.n_planes == 1 and kind_of(problem.prior_name) == "tv"


class Part:
    """Operator, data and prior of the channels that are solved together.

    Parameters
    ----------
    problem : Problem
    channels : slice
        All, or one.

    Attributes
    ----------
    camera : LinearOperator
        Domain (n_channels, n_z, grid height, grid width), range (n_channels, height, width).
    data : ndarray, (n_channels, height, width)
        In units of the noise, and in the precision of the arithmetic; less what a background is expected to
        be, where one is estimated.
    valid : ndarray of bool, as ``data``
    removal : BackgroundRemoval or None
        What takes a smooth background out of the data, where one is estimated.
    tau, weight : float or None
        Of the prior: relative to ``max |A^H b|``, and absolute; set by :meth:`weigh`.
    held : float
        How many times what noise asks for the weight is, where the table's least decided; else 1.
    """

    def __init__(self, problem: Problem, channels: slice) -> None:
        self.problem, self.channels = problem, channels
        # Before any work: what is missing for the device is said at once.
        self.namespace = array_namespace(problem.options.device)
        self.dtype = np.dtype(problem.precision)
        self.valid = problem.valid[self._rows]
        self.storage = memory.Storage()
        self.plan: memory.MemoryPlan | None = None
        self.tau: float | None = None
        self.weight, self.held = 0.0, 1.0
        self._removed: BackgroundRemoval | None = None
        self._support: BoolArray | None = None
        self._usual: Array = np.zeros((1, 1, 1), self.dtype)
        self.removal = (
            BackgroundRemoval(self.valid.shape, BACKGROUND_FREQUENCIES, self.valid, self.dtype)
            if problem.smooth
            else None
        )
        given = problem.options.memory_gib
        self._limit = None if given is None else int(given * memory.GIB)
        self.set_data(problem)
        self.camera = self._make_camera()
        if problem.patterned:
            shape, psf = problem.sensor_shape, problem.depths.central.shape
            window, _ = window_of("sensor", shape, (psf[2], psf[3]))
            self.camera = PatternedCamera(self.camera, problem.measurement.light(), window)

    def set_data(self, problem: Problem) -> None:
        """Take another photograph's data.

        A background's prior deviation is their root mean square: object and background do not trade places
        beyond that. Its prior mean is half of theirs in pictures by priors that do not mind an even object
        and would keep its even part: none of the light may be stray or all. It is 0 with l1, which minds
        light, and in volumes, where it stands for what PSFs do not tell as well and may be negative.
        """
        self.problem = problem
        self.data = self._measured = problem.data[self._rows].astype(self.dtype, copy=False)
        if self.removal is not None:
            power = float(np.sum(self.data.astype(np.float64) ** 2))
            pixels = int(np.count_nonzero(self.valid))
            self.removal.restrain(pixels / max(power, pixels))
            if expects_background(problem):
                means = [
                    0.5 * d[v].mean(dtype=np.float64) for d, v in zip(self.data, self.valid, strict=True)
                ]
                self._usual = np.asarray(means, self.dtype)[:, None, None]
                self.data = np.where(self.valid, self.data - self._usual, 0)

    @property
    def _rows(self) -> slice:
        """The data of these channels."""
        return self.problem.rows(self.channels)

    def _make_camera(self) -> LinearOperator:
        problem, depths = self.problem, self.problem.levelled[0]
        if problem.together or (problem.smooth and problem.solver.flat):
            plane = Convolution(
                self._own(depths.central)[0] / self._energy[:, None, None],
                problem.sensor_shape,
                n_channels=self.channels.stop - self.channels.start,
                dtype=self.dtype,
            )
            self._require_memory(plane)
            channels, *shape = plane.domain_shape
            return Reshaped(plane, (channels, 1, *shape))
        if problem.model in CAMERAS:
            return CAMERAS[problem.model].make(self.central, problem.depths)
        if not problem.varies:
            return self._convolution(self._scaled(depths.central))
        return self._varying([FieldOfPsfs(self._scaled(f.psfs), f.points) for f in depths.fields])

    def _own(self, psfs: Array) -> Array:
        """Return these channels of PSFs (n, 1 or n_channels, height, width)."""
        return psfs[:, self.channels] if psfs.shape[1] > 1 else psfs

    @property
    def _energy(self) -> Array:
        """What these channels' PSFs are divided by."""
        energy = self.problem.energy
        return energy[self.channels] if len(energy) > 1 else energy

    def _scaled(self, psfs: Array) -> Array:
        return self._own(psfs) * np.float32(1 / float(self._energy[0]))

    def _require_memory(self, plane: Convolution) -> None:
        """Refuse a picture that a given limit has no room for."""
        if self._limit is None:
            return
        self.plan = memory.MemoryPlan(0, picture_bytes(self.problem), self._limit)
        if not self.plan.fits:
            raise NoMemoryError(f"This picture needs {self.plan}. Bin the images, or allow more.")

    def _convolution(self, psfs: Array) -> Convolution:
        self.plan = volume_plan(self.problem)
        if not self.plan.fits:
            scratch = memory.scratch_for(self.plan, self.problem.options.scratch)
            self.storage = memory.Storage(scratch, self.plan.room)
        lasting = partial(
            self.storage.zeros, lasting=True
        )  # not this part's, which would never be free again
        return Convolution(psfs, self.problem.sensor_shape, dtype=self.dtype, allocate=lasting)

    def _varying(self, fields: list[FieldOfPsfs]) -> SpatiallyVarying | VaryingOnDevice:
        problem, shape = self.problem, self.problem.sensor_shape
        field_shape, (row, column) = field_of(shape, fields[0].psfs.shape[2:])
        support = None
        reach, margin = problem.extent.acceptance_px, problem.extent.margin
        if reach is not None or margin is not None:
            y, x = np.arange(field_shape[0])[:, None] - row, np.arange(field_shape[1])[None] - column
            near = np.hypot(y, x) <= (np.inf if reach is None else reach)
            support = self._support = np.stack(
                [near if margin is None else near & spanned(f, y, x, margin) for f in fields]
            )
        grid = fft.fast_length(field_shape[0]), fft.fast_length(field_shape[1])
        made: dict[str, Any] = {"support": support, "grid_shape": grid, "dtype": self.dtype}
        made["xp"] = self.namespace
        camera = (
            local_convolution(fields, shape, **made)
            if problem.model == "local"
            else low_rank(fields, shape, error=LOW_RANK_ERROR, **made)
        )
        plane = self.dtype.itemsize * int(np.prod(camera.domain_shape[2:]))
        available = memory.available_bytes() if self._limit is None else self._limit
        scattered = max((len(f.points) for f in fields if grid_axes(f.points) is None), default=0)
        kind = kind_of(problem.prior_name)
        needed = memory.varying_bytes(kind, len(fields), plane, camera.nbytes, scattered)
        self.plan = memory.MemoryPlan(0, needed, available)  # before its transfer functions are made
        if not self.plan.fits:
            raise NoMemoryError(
                f"The {problem.model} model needs {self.plan}. Bin the images or take fewer depths."
            )
        return camera

    @cached_property
    def central(self) -> Convolution:
        """The camera with each depth's central PSF everywhere: varying ones are preconditioned by it."""
        psfs = self._scaled(self.problem.levelled[0].central)
        return Convolution(psfs, self.problem.sensor_shape, dtype=self.dtype)

    def memory_used(self) -> str | None:
        """Say what was planned, and what had to go to disk; None where nothing was."""
        if self.plan is None:
            return None
        on_disk = min(self.storage.on_disk, self.plan.state)  # turns of a run put theirs there anew
        if not on_disk:
            return str(self.plan)
        share = on_disk / max(self.plan.state, 1)
        return (
            f"{self.plan}; {memory.in_words(on_disk)} of the state in files, of which an iteration reads "
            f"and writes about {memory.in_words(share * self.plan.traffic)}"
        )

    def close(self) -> None:
        """Remove what the solver kept on disk."""
        self.storage.close()

    # For solvers -------------------------------------------------------------------------------------
    @property
    def operator(self) -> LinearOperator:
        """The camera with everything that happens to its data."""
        seen = self._seen(self.camera)
        return seen if self.removal is None else self.removal @ seen

    @property
    def picture_operator(self) -> LinearOperator:
        """The same of one plane for solvers of pictures, whose objects are (n_channels, height, width)."""
        camera = self.picture_camera
        return camera if self.removal is None else self.removal @ camera

    @property
    def picture_camera(self) -> LinearOperator:
        """The same without what takes out a background."""
        camera = self.camera
        if isinstance(camera, Reshaped):
            return self._seen(camera.own)
        channels, _, *shape = camera.domain_shape
        return self._seen(Reshaped(camera, (channels, *shape)))

    def _seen(self, operator: LinearOperator) -> LinearOperator:
        if self.valid.all():
            return operator
        return Erasures(self.valid, self.data.shape, dtype=self.dtype) @ operator

    @property
    def solved_data(self) -> Array:
        """The data that belong to :attr:`operator`."""
        return self.data if self.removal is None else self.removal.forward(self.data)

    @property
    def sensor_data(self) -> SensorData:
        """The same for solvers that take a background out themselves."""
        return SensorData(self.data, self.valid[0], self.removal)

    @property
    def prior(self) -> Prior:
        """The prior with its weight; of y and x differences where it is a named total variation."""
        if self.problem.options.axis_weights is None:
            return penalty_of(self.problem.prior, self.weight)
        return self.prior_on(self.mean_axis_weights[1:])

    @property
    def mean_axis_weights(self) -> Array:
        """Weights of the z, y and x differences, the mean of the planes, (3,)."""
        problem = self.problem
        mean: Array = np.broadcast_to(problem.axis_weights, (problem.n_planes, 3)).mean(axis=0)
        return mean

    def prior_on(self, axis_weights: Array, wrap: tuple[bool, ...] | None = None) -> Prior:
        """Return the prior with a named total variation of these axes.

        Parameters
        ----------
        axis_weights : ndarray, (2,), (3,) or (n_z, 3)
            Weights of the (z,) y and x differences: of an object ([n_z,] height, width).
        wrap : tuple of bool, optional
            Which of the axes wrap around.
        """
        prior = penalty_of(self.problem.prior, self.weight)
        terms = list(prior.terms())
        if not isinstance(self.problem.prior, Prior):
            for i, term in enumerate(terms):
                if isinstance(term, TotalVariation) and term.axis_weights.shape == (2,):
                    isotropic = term.isotropic
                    terms[i] = TotalVariation(
                        term.weight, isotropic=isotropic, axis_weights=axis_weights, wrap=wrap
                    )
        return reduce(add, terms)

    def weigh(self, tau: float | None, times_noise: float | None = None) -> None:
        """Set the prior's weight: relative to ``max |A^H b|``, else to the noise, else by the table."""
        name = self.problem.prior_name
        if isinstance(self.problem.prior, Prior) or not is_weighted(name):
            return
        peak = self.peak()
        if tau is None and times_noise is not None and peak > 0:
            tau = times_noise / peak
        if tau is None:
            tau, of_noise = default_tau(name, self.problem.camera_class, peak)
            self.held = tau / of_noise if of_noise > 0 else 1.0
        self.tau = float(tau)
        self.weight = self.tau * peak

    def peak(self) -> float:
        """``max |A^H b|``; of a convolution plane by plane: no volume for one number."""
        data = self.solved_data
        if isinstance(self.camera, Convolution):
            return max(float(np.abs(plane).max()) for plane in self.camera.adjoint_planes(data))
        return float(np.max(np.abs(self.camera.adjoint(data))))

    # From a solution ---------------------------------------------------------------------------------
    def lifted(self, solution: Array) -> Array:
        """Return a solver's solution on the camera's domain; 0 where no object was modelled.

        There no data hold it, and a prior goes on with what is beside.
        """
        solution = solution.reshape(self.camera.domain_shape)
        if self._support is None:
            return solution
        height, width = self._support.shape[1:]
        solution = solution.copy()
        solution[..., :height, :width] *= self._support
        return solution

    def background(self, solution: Array) -> Array:
        """Return the smooth background that goes with a solution, in units of the noise, as ``data``."""
        if self.removal is None:
            raise ValueError("No background was asked for.")
        return self._usual + self.removal.background(self.data - self.camera.forward(solution))

    def from_beyond(self, solution: Array) -> Array:
        """Return the light from planes beyond the farthest depth on the sensor, as ``data``."""
        own = self.problem.n_depths
        psfs = self._scaled(self.problem.levelled[0].central[own:])
        camera = Convolution(psfs, self.problem.sensor_shape, dtype=self.dtype)
        return camera.forward(np.ascontiguousarray(solution[:, own:]))

    def residual(self, solution: Array, background: Array | None) -> Array:
        """Return what a solution and its background leave of the data, as ``data``; 0 where erased."""
        rest: Array = self._measured - self.camera.forward(solution)
        return np.where(self.valid, rest if background is None else rest - background, 0)

    def positive_background(self, solution: Array) -> Array:
        """Return the smooth background >= 0 nearest to what a solution leaves of the data."""
        removal = self.removal or self._removed
        if removal is None:
            raise ValueError("No background was asked for.")
        return removal.non_negative(self._measured - self.camera.forward(solution))

    def without(self, background: Array) -> None:
        """Take a background for given: what is left of the data is solved for, with the same weight."""
        self._removed, self.removal = self.removal or self._removed, None
        self.data = np.where(self.valid, self._measured - background, 0).astype(self.dtype)

    @property
    def noise_norm(self) -> float:
        """Expected norm of the noise in the data."""
        return float(np.sqrt(np.count_nonzero(self.valid)))


def volume_plan(problem: Problem) -> memory.MemoryPlan:
    """Return the memory that one channel takes through one PSF a depth."""
    n_z, _, *psf = problem.levelled[0].central.shape
    field, _ = field_of(problem.sensor_shape, (psf[0], psf[1]))
    limit = problem.options.memory_gib
    return memory.plan(
        kind_of(problem.prior_name),
        (1, n_z, *fft.fast_shape(field)),
        n_z * psf[0] * psf[1],
        n_z * problem.sensor_shape[0] * problem.sensor_shape[1],
        itemsize=np.dtype(problem.precision).itemsize,
        available=None if limit is None else int(limit * memory.GIB),
    )


def picture_bytes(problem: Problem) -> int:
    """Return the memory that a picture takes through one PSF, all channels together or its only one."""
    itemsize = np.dtype(problem.precision).itemsize
    field, _ = field_of(problem.sensor_shape, problem.depths.central.shape[2:])
    channels = problem.n_channels if problem.together else 1
    grid, sensor = (itemsize * int(np.prod(n)) for n in (fft.fast_shape(field), problem.sensor_shape))
    return memory.picture_bytes(channels, grid, sensor)


def parts_of(problem: Problem) -> list[slice]:
    """Return the channels that are solved together, one slice a run."""
    if problem.together:
        return [slice(0, problem.n_channels)]
    return [slice(c, c + 1) for c in range(problem.n_channels)]
