"""Reconstruct with what was chosen, and bring the result back to the given pixels, depths and colours."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.camera.camera_model import Extent
from recon.reconstruction.between import with_planes_between
from recon.reconstruction.channels import merged_input
from recon.reconstruction.choice import Choice
from recon.reconstruction.preparation import channel_noise, data_of
from recon.reconstruction.reduced import Colours, binned, enlarged, reduced_calibration
from recon.reconstruction.volume_result import VolumeGrid, VolumeReconstruction
from recon.types import Calibration

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Reduced:
    """The input of the smaller problem.

    Attributes
    ----------
    measurement : ndarray, float32, (height, width[, n_channels])
        Background subtracted.
    erasures : ndarray of bool, as ``measurement``, or None
    calibration : Calibration
    noise : NoiseModel, float or None
        What is left of a pixel's noise, where it was known.
    extent : Extent
    """

    measurement: Floats
    erasures: npt.NDArray[np.bool_] | None
    calibration: Calibration
    noise: NoiseModel | float | None
    extent: Extent
    choice: Choice
    tint: Colours | None
    shape: tuple[int, int]
    warnings: tuple[str, ...] = ()

    def picture(self, image: Array) -> Floats:
        """Bring a picture (height, width[, n_channels]) back."""
        if self.choice.binning > 1:
            channels_first = image if image.ndim == 2 else np.moveaxis(image, -1, 0)
            larger = enlarged(channels_first, self.choice.binning, self.shape)
            image = larger if image.ndim == 2 else np.moveaxis(larger, 0, -1)
        whole = image if self.tint is None else self.tint.spread(image)
        return np.ascontiguousarray(whole)

    def volume(self, planes: Array) -> Floats:
        """Bring a volume (n_z, height, width[, n_channels]) back; depths that were left out are empty."""
        whole = np.zeros((self.choice.n_planes, *self.picture(planes[0]).shape), np.float32)
        for at, plane in zip(_places(self.choice), planes, strict=True):
            picture, below = self.picture(plane), int(at)
            if at == below:
                whole[below] += picture
            else:  # an object half way between two depths belongs to both
                whole[below : below + 2] += picture / 2
        return whole


def reduce(
    choice: Choice,
    measurement: npt.ArrayLike,
    calibration: Calibration,
    *,
    noise: NoiseModel | float | None,
    background: npt.ArrayLike | None,
    erasures: npt.ArrayLike | None,
) -> Reduced:
    """Make the smaller problem that a choice asks for. Parameters as :func:`recon.reconstruct`."""
    flat = np.ndim(measurement) == 2
    data, valid, warnings = data_of(measurement, background, erasures)
    tint = None
    if choice.merged:
        deviation = np.array([channel_noise(d, v, noise) for d, v in zip(data, valid, strict=True)])
        # Noise of the sum of channels: their weights, and each its own.
        data, valid, calibration, tint = merged_input(data, valid, deviation, calibration)
        noise = None if noise is None else float(np.sqrt(np.sum((tint.weights * deviation) ** 2)))
        flat = True
    if choice.between:
        depths_um = calibration.source_positions_um[:, 2]
        calibration = with_planes_between(calibration, depths_um, choice.between)
    factor = choice.binning
    shape = (data.shape[1], data.shape[2])
    every = sorted([*range(choice.n_planes), *(k + 0.5 for k in choice.between)])
    places = _places(choice)
    planes = None if len(places) == len(every) else tuple(every.index(at) for at in places)
    rest = tuple(z for z, at in enumerate(every) if at not in places)
    left_out = reduced_calibration(calibration, factor, rest) if rest else None
    calibration = reduced_calibration(calibration, factor, planes)
    window = tuple(max(n // factor, 1) for n in choice.psf_window)
    small = tuple(min(w, n) for w, n in zip(window, calibration.psfs.shape[2:], strict=True))
    kept = np.where(valid, data, 0)
    held = None
    if not valid.all():
        held = binned(valid.astype(np.float32), factor) < 1 - 1e-6
    kept = binned(kept, factor)
    return Reduced(
        measurement=kept[0] if flat else np.moveaxis(kept, 0, -1),
        erasures=None if held is None else (held[0] if flat else np.moveaxis(held, 0, -1)),
        calibration=calibration,
        noise=_averaged(noise, factor),
        extent=Extent(
            (small[0], small[1]),
            None if choice.acceptance_px is None else choice.acceptance_px / factor,
            left_out,
        ),
        choice=choice,
        tint=tint,
        shape=shape,
        warnings=tuple(warnings),
    )


def whole_volume(
    small: VolumeReconstruction, reduced: Reduced, calibration_grid: VolumeGrid
) -> VolumeReconstruction:
    """Return a smaller problem's volume as one of the given pixels and depths."""
    choice, places = reduced.choice, _places(reduced.choice)
    background = small.background
    if background is not None:
        # Counts a pixel, not light: no sharing among pixels.
        if choice.binning > 1:
            channels_first = background if background.ndim == 2 else np.moveaxis(background, -1, 0)
            larger = enlarged(channels_first, choice.binning, reduced.shape) * choice.binning**2
            background = larger if background.ndim == 2 else np.moveaxis(larger, 0, -1)
        if reduced.tint is not None:
            background = background[..., None] * reduced.tint.scene.astype(np.float32)
    return replace(
        small,
        volume=reduced.volume(small.volume),
        grid=calibration_grid,
        background=background,
        reason=next(d.why for d in choice.decisions if d.name == "model"),
        choice=choice,
        empty_planes=tuple(
            replace(e, planes=_empty(choice, [places[z] for z in e.planes])) for e in small.empty_planes
        ),
        warnings=_together(reduced.warnings, small.warnings),
        provenance={**small.provenance, "auto": choice.to_json()},
    )


def shown(reduced: Reduced, picture: Callable[[], Array]) -> Callable[[], Floats]:
    """Return what makes the present volume of a smaller problem on the given pixels and depths."""
    return lambda: reduced.volume(picture())


def _places(choice: Choice) -> list[float]:
    """Return the planes that are reconstructed, in the calibration's order: ``k + 0.5`` after depth ``k``."""
    return sorted([*choice.planes, *(k + 0.5 for k in choice.between)])


def _empty(choice: Choice, places: list[float]) -> tuple[int, ...]:
    """Return the depths that are empty where these places are: none that got light of a plane between."""
    given = {k + by for k in choice.between if k + 0.5 not in places for by in (0, 1)}
    return tuple(int(at) for at in places if at == int(at) and at not in given)


def _together(first: tuple[str, ...], second: tuple[str, ...]) -> tuple[str, ...]:
    """Return all warnings, each once."""
    return tuple(dict.fromkeys((*first, *second)))


def _averaged(noise: NoiseModel | float | None, factor: int) -> NoiseModel | float | None:
    if isinstance(noise, NoiseModel):
        return NoiseModel(noise.read_noise / factor, noise.counts_per_electron / factor**2)
    return None if noise is None else noise / factor
