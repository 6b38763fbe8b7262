"""A measurement and a calibration brought together: data in units of their noise, a camera, a prior."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.base.checks import as_channels, check_psf
from recon.base.declare import settled
from recon.camera.camera_model import Depths, Extent, ModelName, choose_model, energies, levelled
from recon.camera.grid import Grid
from recon.camera.refocus_field import at_depth, beyond_calibrated
from recon.errors import InputError
from recon.priors import PRIORS, Prior, TotalVariation
from recon.reconstruction.measurement import (
    LINES_FOUND,
    Measurement,
    OfOnePhotograph,
    depths_of,
    require_same_channels,
    require_same_pixels,
)
from recon.reconstruction.options import Precision, ReconstructionOptions
from recon.reconstruction.result import Reconstruction, window_of
from recon.reconstruction.solvers import SOLVERS, OfferedSolver, solver_for
from recon.reconstruction.weights import CameraClass, name_of, require_prior
from recon.types import Calibration

if TYPE_CHECKING:
    from recon.reconstruction.choice import Choice
    from recon.reconstruction.reduction import Reduction

Stage = Callable[[float, str], object]
"""``on_stage(share, what)``: how much is done, 0 to 1, of what comes before or after the iterations."""


@dataclass(frozen=True)
class Problem:
    """``min_x 1/2 ||A x - b||^2 + prior(x)`` for a measurement, a calibration and options; see :meth:`of`.

    A picture is a volume of one plane: the camera's domain is (n_channels, n_z, height, width). Each
    channel's data is divided by its noise' standard deviation, the PSFs by their energy, so that nothing
    depends on exposure.

    Attributes
    ----------
    measurement : Measurement
        As it came.
    calibration : Calibration
        The depths that take part.
    options : ReconstructionOptions
    data : ndarray, float32, (n_channels, height, width)
        In units of the noise, background subtracted; 0 where erased.
    valid : ndarray of bool, (n_channels, height, width)
    noise : ndarray, float32, (n_channels,)
        Standard deviation of the noise, counts.
    depths : Depths
        The calibration sorted by depth, its PSFs registered.
    model : str
        Of the camera; ``"auto"`` until :func:`~recon.reconstruction.selection.choose` has chosen it.
    reason : str
        Why that model.
    smooth : bool
        Whether a smooth background is estimated as well.
    precision : "float32" or "float64"
        Of the arithmetic.
    extent : Extent
        How much of PSFs and field is modelled.
    warnings : tuple of str
    tolerance : float or None
        Change an iteration at which to stop, where it was chosen; else the solver's own.
    choice : Choice or None
        What was chosen and why; ``reduction`` then has the way back.
    stack : Calibration or None
        All that was calibrated, where the PSFs of one depth were asked for.
    """

    measurement: Measurement
    calibration: Calibration
    options: ReconstructionOptions
    data: Float32Array
    valid: BoolArray
    noise: Float32Array
    depths: Depths
    model: ModelName
    reason: str
    smooth: bool
    precision: Precision = "float32"
    extent: Extent = field(default_factory=Extent)
    warnings: tuple[str, ...] = ()
    tolerance: float | None = None
    choice: Choice | None = None
    reduction: Reduction | None = None
    stack: Calibration | None = None

    @classmethod
    def of(
        cls,
        measurement: Measurement | npt.ArrayLike,
        calibration: Calibration | npt.ArrayLike,
        options: ReconstructionOptions | None = None,
        *,
        extent: Extent | None = None,
    ) -> Problem:
        """Check, subtract the background, sort PSFs by depth, scale.

        Parameters
        ----------
        measurement : Measurement or array
        calibration : Calibration or array
            PSFs, or one PSF image (height, width[, n_channels]) without background, which is taken as it is:
            one convolution of everything. One channel serves all.
        options : ReconstructionOptions, optional
            With ``z_um`` the picture of one depth, which PSFs are brought to where the calibration does not
            have it (:func:`recon.camera.refocus_field.at_depth`). Else all depths.
        extent : Extent, optional
            How much of the PSFs and of the field to model; default all.

        Raises InputError when the input is unusable; the text says what was found, what was expected and what
        to do.
        """
        options = options or ReconstructionOptions()
        extent = extent or Extent()
        _require(options)
        measurement = measurement if isinstance(measurement, Measurement) else Measurement(measurement)
        measurement, holes = measurement.with_holes_erased()
        measurement, unseen = measurement.with_unseen_erased()
        counts = measurement.counts()
        if not isinstance(calibration, Calibration):
            if options.model not in ("auto", "convolution"):
                raise InputError(
                    f"The {options.model} model needs a calibration with PSFs from several places of the "
                    "field."
                )
            if options.z_um is not None:
                raise InputError(
                    f"z_um = {options.z_um:g} asks for the picture at a depth; a bare PSF image has none: "
                    "leave z_um out, or give a Calibration with the depths of its PSFs."
                )
            psfs = as_channels(calibration, "PSF")
            calibration = Calibration(psfs[None], np.full((1, 3), np.nan))
            options = settled(options, model="convolution")
        if measurement.patterns is not None and options.model == "auto":
            options = settled(options, model="convolution")
        stack = None if options.z_um is None else calibration
        if options.z_um is not None:
            calibration, _ = at_depth(calibration, options.z_um)
        calibration, depths, doubts = depths_of(calibration, options)
        require_same_channels(calibration.psfs, counts.data[:: measurement.frames])
        require_same_pixels(calibration.psfs[0], counts.data)
        if extent.psf_window is not None:
            depths = depths.within(extent.psf_window)
        one = len(depths.central) == 1
        for z, psf in enumerate(depths.central):
            doubts += [text if one else f"Depth {z}: {text}" for text in check_psf(psf)]
        model, reason = options.model, ""
        if model != "auto":
            model, reason = choose_model(depths, model)
            if measurement.patterns is not None and model == "convolution":
                reason = "patterned light takes one PSF a depth where no other model is asked for"
        asked = True if options.positive_background else options.estimate_background
        unmoved = calibration.provenance.get("not_refocused")
        said = (holes, unseen, unmoved and f"The PSF was {unmoved}.", *beyond_calibrated(calibration))
        deviation = measurement.deviations(counts).astype(np.float32)
        problem = cls(
            measurement,
            calibration,
            options,
            np.where(counts.valid, counts.data / deviation[:, None, None], 0).astype(np.float32),
            counts.valid,
            deviation,
            depths,
            model,
            reason,
            (not one and measurement.background is None) if asked is None else asked,
            "float32" if options.precision == "auto" else options.precision,
            extent,
            tuple(dict.fromkeys((*filter(None, said), *doubts, *depths.warnings, *counts.warnings))),
            stack=stack,
        )
        if options.axis_weights is not None:
            problem._require_axis_weights(options.axis_weights)
        return problem

    def with_data(self, image: npt.ArrayLike) -> Problem:
        """Return the same problem with another photograph of the same camera: noise and scales stay.

        Parameters
        ----------
        image : array, shaped as the measurement's
            Less its background where the measurement was given without one.

        Raises InputError when it is shaped otherwise, or this problem was reduced for its photograph by
        ``choose``.
        """
        if self.reduction is not None:
            raise InputError("This problem was reduced for one photograph: choose anew for another.")
        measurement, told = replace(self.measurement, image=image), self.warnings
        if LINES_FOUND in measurement.found:  # they are noise: of each photograph its own
            found = {name: value for name, value in measurement.found.items() if name != LINES_FOUND}
            measurement = replace(measurement, lines=None, found=found)
            told = tuple(words for words in told if not isinstance(words, OfOnePhotograph))
        counts = measurement.channels()
        if counts.shape != self.data.shape or measurement.flat != self.flat:
            raise InputError(
                f"The frame is {np.shape(image)}, those before {np.shape(self.measurement.image)}."
            )
        data = measurement.light_of(counts) / self.noise[:, None, None]
        if not self.valid.all():
            data = np.where(self.valid, data, 0)
        other = replace(self, measurement=measurement, data=data, warnings=told)
        for name in {"energy", "levelled"} & set(self.__dict__):  # they are the PSFs', which stay
            other.__dict__[name] = self.__dict__[name]
        return other

    # What it is --------------------------------------------------------------------------------------
    @property
    def flat(self) -> bool:
        """Whether the measurement has no axis of channels."""
        return self.measurement.flat

    @property
    def patterned(self) -> bool:
        """Whether the data are frames of one scene under patterns of light."""
        return self.measurement.patterns is not None

    @property
    def n_channels(self) -> int:
        """Colour channels of the object."""
        return len(self.data) // self.measurement.frames

    def rows(self, channels: slice) -> slice:
        """Return where the data of some channels are: under patterns all their frames."""
        frames = self.measurement.frames
        return slice(channels.start * frames, channels.stop * frames)

    def as_measured(self, rows: Array) -> Float32Array:
        """Return rows of data, (n, height, width), in the measurement's shape, or with its channels."""
        frames, *pixels = self.measurement.frames, *rows.shape[1:]
        channels = rows.astype(np.float32).reshape(-1, frames, *pixels) if self.patterned else rows
        found = channels[0] if self.flat else np.moveaxis(channels, 0, -1)
        return np.ascontiguousarray(found, np.float32)

    @property
    def n_planes(self) -> int:
        """Depths that are reconstructed."""
        return len(self.depths.central)

    @property
    def n_depths(self) -> int:
        """Planes that are calibrated depths; the others, at the end, are beyond them."""
        return self.n_planes - self.extent.beyond

    @property
    def sensor_shape(self) -> tuple[int, int]:
        """Height and width of the measurement."""
        return self.data.shape[1], self.data.shape[2]

    @cached_property
    def solver(self) -> OfferedSolver:
        """The solver that was asked for, or the first that is for such problems."""
        return solver_for(self)

    @property
    def prior(self) -> str | Prior:
        """The prior that was asked for, or the solver's own."""
        if self.options.prior is not None:
            return self.options.prior
        if self.options.solver != "auto":
            return SOLVERS.named(self.options.solver).prior
        return "tv-haar" if self.patterned else "tv"  # total variation's own prox is slow

    @property
    def prior_name(self) -> str:
        """How the prior is recorded."""
        return name_of(self.prior)

    @property
    def varies(self) -> bool:
        """Whether the camera model has PSFs that vary over the field."""
        return self.model != "convolution"

    @property
    def is_plain(self) -> bool:
        """Whether it is a picture through one PSF, without a background to be estimated."""
        return self.n_planes == 1 and not self.varies and not self.smooth

    @property
    def together(self) -> bool:
        """Whether all channels are solved together; else one after the other, as memory asks for."""
        return self.is_plain and self.options.device == "cpu"

    @property
    def camera_class(self) -> CameraClass:
        """What default weights go by."""
        if self.varies:
            return "varying, with a background" if self.smooth else "varying"
        return "picture" if self.is_plain else "planes"

    @property
    def stop_tolerance(self) -> float:
        """Change an iteration at which to stop: as asked, as chosen, or the solver's own."""
        if self.options.tolerance is not None:
            return self.options.tolerance
        return self.solver.tolerance_for(self) if self.tolerance is None else self.tolerance

    # Scales ------------------------------------------------------------------------------------------
    @cached_property
    def energy(self) -> Array:
        """What the PSFs are divided by, (n_channels or 1,): each its own where channels have one PSF each.

        Of many PSFs it is their root mean square, which keeps how bright they are beside one another.
        """
        psfs = self.depths.central[: self.n_depths]
        if self.is_plain:
            own = np.sqrt(np.sum(psfs[0].astype(np.float64) ** 2, axis=(1, 2)))
            return np.asarray(own, np.float32)
        return np.asarray([float(np.sqrt(np.mean(energies(psfs))))])

    @property
    def image_scale(self) -> Float32Array:
        """From the scaled problem's object to measurement units, (n_channels, 1, 1, 1)."""
        noise = self.noise[:: self.measurement.frames]
        return np.asarray(noise / self.energy, np.float32)[:, None, None, None]

    @cached_property
    def levelled(self) -> tuple[Depths, Float32Array]:
        """PSFs as the prior counts light, and the gains, on the whole field, that bring a solution back.

        l1 counts light on the sensor: no voxel may be the cheaper explanation.
        """
        if self.prior_name != "l1" or self.is_plain:
            return self.depths, np.ones((1, 1, 1), np.float32)
        return levelled(self.depths, self.sensor_shape, varying=self.varies)

    @property
    def gains(self) -> Float32Array:
        """Gains of the voxels that are returned."""
        gains = self.levelled[1]
        rows, columns = self.window
        return gains if gains.shape[1:] == (1, 1) else gains[:, rows, columns]

    # Where it is -------------------------------------------------------------------------------------
    @property
    def window(self) -> tuple[slice, slice]:
        """Part of the operator's grid that is returned."""
        return self._placed[0]

    @property
    def _placed(self) -> tuple[tuple[slice, slice], tuple[int, int]]:
        height, width = self.depths.central.shape[2:]
        return window_of(self.options.field, self.sensor_shape, (height, width))

    @property
    def grid(self) -> Grid:
        """Where the voxels of the result lie."""
        (rows, columns), centre = self._placed
        z_um = self.depths.z_um
        if self.n_planes == 1 and self.options.z_um is not None:
            z_um = np.array([float(self.options.z_um)])
        geometry = self.calibration.geometry
        pitch, distance = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
        pitches = np.full(len(z_um), np.nan)
        if pitch is not None and distance:
            pitches = pitch * z_um / (1000 * distance)
        shape = (len(z_um), rows.stop - rows.start, columns.stop - columns.start)
        return Grid(shape, centre, z_um, pitches, pitch, self.depths.axis_um)

    @property
    def axis_weights(self) -> Array:
        """Weights of the z, y and x differences of total variation, (3,) or (n_z, 3)."""
        given, own = self.options.axis_weights, self.n_depths
        if own == self.n_planes:
            return self.grid.axis_weights() if given is None else np.asarray(given, float)
        # Depths as they are; planes beyond them are tied neither to these nor to one another.
        grid = self.grid
        shape = (own, *grid.shape[1:])
        depths = replace(grid, shape=shape, z_um=grid.z_um[:own], pitch_um=grid.pitch_um[:own])
        weights = np.ones((self.n_planes, 3))
        weights[:own] = depths.axis_weights() if given is None else np.asarray(given, float)
        weights[own:, 1:] = weights[own - 1, 1:]
        weights[own - 1 :, 0] = 0
        return weights

    def _require_axis_weights(self, given: npt.ArrayLike) -> None:
        """Refuse weights of differences that the prior does not take, or that are none."""
        if isinstance(self.prior, Prior):
            raise InputError(
                "axis_weights are for a prior by name; one given as an object has its own: leave them out."
            )
        if not any(isinstance(term, TotalVariation) for term in PRIORS.named(self.prior)(1.0).terms()):
            raise InputError(
                f"axis_weights weigh the differences of total variation; the prior {self.prior} has "
                "none that can be weighed: leave them out, or take tv or tv-isotropic."
            )
        weights = np.asarray(given)
        shapes = ((3,), (self.n_depths, 3))
        if weights.dtype.kind not in "uif" or weights.shape not in shapes:
            raise InputError(
                f"axis_weights are numbers for the z, y and x differences, (3,) or ({self.n_depths}, 3), a "
                f"row a depth; found {given!r}."
            )
        if not (np.isfinite(weights).all() and (weights >= 0).all()):
            raise InputError(f"axis_weights must be 0 or more, and finite; found {given!r}.")

    def measured(self, solution: Array, channels: slice) -> Float32Array:
        """Return what a solution (some channels, n_z, ...) is in the window, in measurement units.

        (n_z, height, width) of one channel, with the channels last where there are several.
        """
        rows, columns = self.window
        volumes = np.asarray(
            solution[:, :, rows, columns] * (self.image_scale[channels] / self.gains), np.float32
        )
        return np.ascontiguousarray(volumes[0] if len(volumes) == 1 else np.moveaxis(volumes, 0, -1))

    def whole(self, volumes: list[Float32Array]) -> Float32Array:
        """Return what the parts' volumes are together, channels last as the measurement has them."""
        volume = volumes[0] if len(volumes) == 1 else np.stack(volumes, axis=-1)
        if not self.flat and self.n_channels == 1:
            volume = volume[..., None]
        return np.ascontiguousarray(volume)

    def start(self, before: Reconstruction, channels: slice, grid_shape: tuple[int, int]) -> Array:
        """Place a reconstruction's object on the operator's grid of some channels, scaled.

        Raises InputError when it does not fit.
        """
        shape = (self.n_channels, self.n_planes, *grid_shape)
        scale = self.image_scale[channels]
        same_grid = self.levelled[1].shape[1:] in ((1, 1), grid_shape)
        if before.state is not None and before.state.shape == shape and same_grid:
            return np.asarray(before.state[channels] * self.levelled[1] / scale, self.precision)
        rows, columns = self.window
        needed = (self.n_planes, rows.stop - rows.start, columns.stop - columns.start)
        volume = before.volume if before.volume.ndim == 4 else before.volume[..., None]
        if volume.shape != (*needed, self.n_channels):
            raise InputError(
                f"The reconstruction to start from is {before.volume.shape}; this measurement needs {needed}"
                + ("." if self.flat else f" of {self.n_channels} channels.")
            )
        whole = np.zeros(shape, self.precision)[channels]
        whole[:, :, rows, columns] = np.moveaxis(volume, -1, 0)[channels] * self.gains / scale
        return whole

    @property
    def _given(self) -> Measurement:
        """The measurement on the pixels and channels that were given."""
        return self.measurement if self.reduction is None else self.reduction.given.measurement

    @property
    def shade(self) -> Float32Array | None:
        """Relative light on the data's pixels that they were divided by, (n_channels, height, width)."""
        given = self._given
        if given.vignetting is None or self.patterned:
            return None
        shade = given.like(given.vignetting, given.channels(), "vignetting")
        if self.choice is not None and len(shade) > len(self.data):  # merged
            shade = shade.mean(axis=0, keepdims=True)
        factor = 1 if self.choice is None else self.choice.binning
        return shade if factor == 1 else block_mean(shade, factor, about_axis=True)

    def provenance(self) -> Mapping[str, Any]:
        """Return what is known of it, JSON-compatible."""
        from recon.base.declare import record

        z_um = float(self.depths.z_um[0])
        return {
            "noise_deviation": [float(v) for v in self.noise],
            "psf_z_um": z_um if self.n_planes == 1 and np.isfinite(z_um) else None,
            "precision": self.precision,
            "valid_share": float(np.count_nonzero(self.valid) / self.valid.size),
            "model": self.model,
            "model_reason": self.reason,
            **({"patterns": self.measurement.frames} if self.patterned else {}),
            **({"fitted_to_the_photograph": dict(found)} if (found := self._given.found) else {}),
            **({"refocused": made} if (made := self.calibration.provenance.get("refocused")) else {}),
            "options": record(self.options),
        }


def _require(options: ReconstructionOptions) -> None:
    """Check what can be checked before there is a measurement."""
    if options.prior is not None:
        require_prior(options.prior)
    if options.tau is not None and isinstance(options.prior, Prior):
        raise InputError(
            "tau weighs a prior by name; a prior given as an object has its own weight: leave tau out."
        )
    if options.positive_background and options.estimate_background is False:
        raise InputError("A positive background cannot be had without estimating one: leave one of them out.")
