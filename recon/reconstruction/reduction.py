"""The smaller problem that a choice asks for, and the way back to the pixels and depths of the given one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Array, Float32Array
from recon.base.blocks import block_mean, enlarged
from recon.base.declare import record
from recon.base.noise import averaged_noise
from recon.camera.camera_model import Extent, members_of_depths
from recon.camera.field_registration import NOT_ON_AXIS
from recon.errors import InputError
from recon.reconstruction.choice import Choice
from recon.reconstruction.colours import Colours, colours, merged
from recon.reconstruction.measurement import Measurement, Noise, central
from recon.reconstruction.planes import BEYOND, put_back, with_planes_between, with_planes_beyond
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.types import Calibration

MORE_ROUNDS = 2
"""Rounds with planes put back, at most: the last of them has all."""


@dataclass(frozen=True)
class Reduction:
    """How the smaller problem came of the given one, and the way back.

    Attributes
    ----------
    given : Problem
    choice : Choice
    tint : Colours or None
        How channels are proportional that were merged.
    """

    given: Problem
    choice: Choice
    tint: Colours | None

    def picture(self, image: Array) -> Float32Array:
        """Bring a plane (height, width[, n_channels]) back."""
        image = self._larger(image)
        return np.ascontiguousarray(image if self.tint is None else self.tint.spread(image))

    def _larger(self, image: Array) -> Array:
        """Return a plane (height, width[, n_channels]) on the given pixels."""
        factor, shape = self.choice.binning, self.given.sensor_shape
        return image if factor == 1 else _channels_first(image, 2, lambda c: enlarged(c, factor, shape))

    def volume(self, planes: Array) -> Float32Array:
        """Bring a volume (n_z, height, width[, n_channels]) back; depths that were left out are empty.

        Planes beyond the farthest depth, which are the last, are not part of it.
        """
        if self.choice.n_planes == 1:
            return self.picture(planes[0])[None]
        whole = np.zeros((self.choice.n_planes, *self.picture(planes[0]).shape), np.float32)
        places = places_of(self.choice)
        for at, plane in zip(places, planes[: len(places)], strict=True):
            picture, below = self.picture(plane), int(at)
            if at == below:
                whole[below] += picture
            else:  # an object half way between two depths belongs to both
                whole[below : below + 2] += picture / 2
        return whole

    def background(self, image: Array) -> Float32Array:
        """Bring a background (height, width[, n_channels]) back: counts a pixel, not light to be shared."""
        larger: Float32Array = self._larger(image) * self.choice.binning**2
        return larger if self.tint is None else larger[..., None] * self.tint.scene.astype(np.float32)

    def with_planes(self, result: Reconstruction, rounds: int) -> Problem | None:
        """Return the problem with planes that what a result leaves of the data shows light in; else None."""
        overrides = self.given.options.choose
        if rounds >= MORE_ROUNDS or (overrides is not None and overrides.planes is not None):
            return None
        signs = result.provenance.get("light_in_planes_left_out", [])
        more = put_back(self.choice, signs, everything=rounds == MORE_ROUNDS - 1)
        return None if more is None else reduced(more, self.given)

    def back(self, small: Reconstruction, problem: Problem) -> Reconstruction:
        """Return the smaller problem's result as one of the given pixels and depths."""
        choice, places, background = self.choice, places_of(self.choice), small.background
        return replace(
            small,
            volume=self.volume(small.volume),
            grid=self.given.grid,
            background=None if background is None else self.background(background),
            residual=None if small.residual is None else self._larger(small.residual),
            choice=choice,
            empty_planes=tuple(
                replace(e, planes=_empty(choice, [places[z] for z in e.planes if z < len(places)]))
                for e in small.empty_planes
            ),
            # Only a state on the measurement's own pixels and channels can start another run.
            state=small.state if self.on_own_pixels else None,
            provenance={**small.provenance, "auto": choice.to_json(), "options": record(self.given.options)},
            basis=(problem, small),
        )

    @property
    def on_own_pixels(self) -> bool:
        """Whether pixels and channels are the measurement's own."""
        return self.choice.binning == 1 and not self.choice.merged

    def start(self, before: Reconstruction) -> Reconstruction:
        """Return a reconstruction to start from on the smaller problem's pixels, depths and channels."""
        choice, given, volume = self.choice, self.given, before.volume
        expected = (*given.grid.shape, *(() if given.flat else (given.n_channels,)))
        if volume.shape != expected:
            raise InputError(
                f"The volume to start from is {volume.shape}; this measurement needs {expected}."
            )
        if self.tint is not None:
            tints = self.tint.spread(np.ones(()))
            volume = (volume @ tints) / float(tints @ tints)
        if (factor := choice.binning) > 1:
            volume = _channels_first(volume, 3, lambda v: block_mean(v, factor, about_axis=True) * factor**2)
        # Light of planes between is on the calibrated ones: there it begins.
        planes = [volume[int(at)] if at == int(at) else np.zeros_like(volume[0]) for at in places_of(choice)]
        planes += [np.zeros_like(volume[0])] * (len(BEYOND) if choice.beyond else 0)
        state = before.state if self.on_own_pixels else None
        return replace(before, volume=np.stack(planes).astype(np.float32), state=state)


def _channels_first(image: Array, axes: int, change: Callable[[Array], Array]) -> Array:
    """Change an image of so many axes; where it has channels after them, with these first."""
    return change(image) if image.ndim == axes else np.moveaxis(change(np.moveaxis(image, -1, 0)), 0, -1)


def reduced(choice: Choice, problem: Problem) -> Problem:
    """Return the smaller problem that a choice asks for."""
    measurement, calibration = problem.measurement, problem.calibration
    flat, noise = measurement.flat, measurement.noise
    counts = measurement.counts()
    data, valid = counts.data, counts.valid
    tint = None
    if choice.merged:
        deviation = measurement.deviations(counts)
        # Noise of the sum of channels: their weights, and each its own.
        tint = colours(data, deviation, valid, calibration.psfs)
        assert tint is not None
        data, valid, calibration = merged(data, valid, calibration, tint)
        noise = None if noise is None else float(np.sqrt(np.sum((tint.weights * deviation) ** 2)))
        flat = True
    if choice.between:
        calibration = with_planes_between(calibration, problem.depths.z_um, choice.between)
    factor = choice.binning
    every = sorted([*range(choice.n_planes), *(k + 0.5 for k in choice.between)])
    places = places_of(choice)
    planes = None if len(places) == len(every) else tuple(every.index(at) for at in places)
    rest = tuple(z for z, at in enumerate(every) if at not in places)
    left_out = reduced_calibration(calibration, factor, rest) if rest else None
    every_depth = calibration
    calibration = reduced_calibration(calibration, factor, planes)
    if choice.beyond:
        calibration = with_planes_beyond(calibration, reduced_calibration(every_depth, factor, None))
    window = tuple(max(n // factor, 1) for n in choice.psf_window)
    small = tuple(min(w, n) for w, n in zip(window, calibration.psfs.shape[2:], strict=True))
    warnings = problem.warnings
    single = choice.n_planes == 1 and choice.model == "convolution"
    if single:
        calibration = central(calibration)
        # That some PSFs were hard to register is of no concern to one.
        idle = {w for w in problem.depths.warnings if w != NOT_ON_AXIS}
        warnings = tuple(w for w in warnings if w not in idle)
    made = Problem.of(
        on_blocks(data, valid, noise, factor, flat=flat),
        calibration,
        replace(
            problem.options,
            model=choice.model,
            estimate_background=choice.background,
            precision=choice.precision,
            tolerance=None,
            choose=None,
        ),
        extent=None
        if single and not choice.background
        else Extent(
            (small[0], small[1]),
            None if choice.acceptance_px is None else choice.acceptance_px / factor,
            choice.margin,
            left_out,
            len(BEYOND) if choice.beyond else 0,
        ),
    )
    return replace(
        made,
        reason=next(d.why for d in choice.decisions if d.name == "model"),
        tolerance=choice.tolerance,
        # PSFs and photograph are those that were looked at, on fewer pixels.
        warnings=tuple(dict.fromkeys((*warnings, *made.depths.warnings))),
        choice=choice,
        reduction=Reduction(problem, choice, tint),
    )


def on_blocks(data: Float32Array, valid: Array, noise: Noise, factor: int, *, flat: bool) -> Measurement:
    """Return a measurement on blocks of pixels: erased where one of a block's pixels is.

    Parameters
    ----------
    data, valid : ndarray, (n_channels, height, width)
        Counts less the background, and which pixels count.
    noise : NoiseModel or float, optional
        Of one pixel, counts.
    flat : bool
        Whether it has no axis of channels.
    """
    erased = None
    if not valid.all():
        erased = block_mean(valid.astype(np.float32), factor, about_axis=True) < 1 - 1e-6
        data = np.where(valid, data, 0)
    kept = block_mean(data, factor, about_axis=True)
    return Measurement(
        kept[0] if flat else np.moveaxis(kept, 0, -1),
        averaged_noise(noise, factor**2),
        erasures=None if erased is None else (erased[0] if flat else np.moveaxis(erased, 0, -1)),
    )


def reduced_calibration(calibration: Calibration, factor: int, planes: tuple[int, ...] | None) -> Calibration:
    """Return a calibration of some of the depths, on binned pixels."""
    psfs, positions = calibration.psfs, calibration.source_positions_um
    if planes is not None:
        groups = members_of_depths(positions)
        kept = np.sort(np.concatenate([groups[z] for z in planes]))
        psfs, positions = psfs[kept], positions[kept]
    geometry = calibration.geometry
    if factor > 1:
        psfs = block_mean(psfs, factor, about_axis=True)
        pitch = geometry.pixel_pitch_um
        geometry = replace(geometry, pixel_pitch_um=None if pitch is None else pitch * factor)
    return replace(calibration, psfs=psfs, source_positions_um=positions, background=None, geometry=geometry)


def places_of(choice: Choice) -> list[float]:
    """Return the planes that are reconstructed, in the calibration's order: ``k + 0.5`` after depth ``k``."""
    return sorted([*choice.planes, *(k + 0.5 for k in choice.between)])


def _empty(choice: Choice, places: list[float]) -> tuple[int, ...]:
    """Return the depths that are empty where these places are: none that got light of a plane between."""
    given = {k + by for k in choice.between if k + 0.5 not in places for by in (0, 1)}
    return tuple(int(at) for at in places if at == int(at) and at not in given)
