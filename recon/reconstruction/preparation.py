"""From measurement and calibration in counts to a well-scaled problem, and back to a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from recon.base.checks import as_channels, check_psf, saturated_share, select_psf
from recon.base.noise import NoiseModel, estimate_deviation
from recon.base.options import require_options
from recon.camera.base import LinearOperator
from recon.camera.convolution import PadCropConvolution
from recon.camera.erasures import Erasures
from recon.errors import InputError
from recon.reconstruction.result import ImageGrid
from recon.types import Calibration, Geometry

Array = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]
Field = Literal["sensor", "full"]
Precision = Literal["float32", "float64"]
PRECISIONS: tuple[Precision, ...] = ("float32", "float64")
"""Of all arithmetic in the solver."""

LEAST_NOISE = 1e-5
"""Noise assumed at least, relative to the measurement's root mean square: float32 holds no more."""


@dataclass(frozen=True)
class Prepared:
    """A measurement ready to be solved, in units that do not depend on exposure.

    Each channel's data is divided by its noise' standard deviation, each PSF by its Euclidean norm.

    Attributes
    ----------
    operator : LinearOperator
        The camera with unit-energy PSFs; with erasures when some pixels are not valid.
    camera : PadCropConvolution
        The same without erasures.
    data : ndarray, (n_channels, height, width)
        In the precision asked for, like the operators.
    noise : ndarray, float32, (n_channels,)
        Standard deviation of the noise, counts.
    image_scale : ndarray, float32, (n_channels, 1, 1)
        From the scaled problem's object to an image for which ``measurement = PSF * image``.
    noise_norm : float
        Expected norm of the noise in ``data``.
    flat : bool
        Whether the measurement had no channel axis.
    """

    operator: LinearOperator
    camera: PadCropConvolution
    data: Array
    noise: Floats
    image_scale: Floats
    noise_norm: float
    flat: bool
    psf_z_um: float | None
    geometry: Geometry
    warnings: tuple[str, ...]
    psfs: Floats
    """As calibrated, (1 or n_channels, height, width)."""
    valid: npt.NDArray[np.bool_]
    """Of the shape of ``data``."""

    def picture(self, solution: Array, field: Field) -> Floats:
        """Return the object as an image (height, width[, n_channels]) in measurement units."""
        rows, columns, _ = self._window(field)
        image = solution[:, rows, columns] * self.image_scale
        return np.ascontiguousarray(image[0] if self.flat else np.moveaxis(image, 0, 2), np.float32)

    def grid(self, field: Field, z_um: float | None) -> ImageGrid:
        """Return where the picture's pixels lie."""
        rows, columns, centre = self._window(field)
        z_um = self.psf_z_um if z_um is None else z_um
        pitch = self.geometry.pixel_pitch_um
        object_pitch = None
        if pitch is not None and z_um is not None and self.geometry.diffuser_distance_mm:
            object_pitch = pitch * z_um / (1000 * self.geometry.diffuser_distance_mm)
        shape = (rows.stop - rows.start, columns.stop - columns.start)
        return ImageGrid(shape, centre, pitch, object_pitch, z_um)

    def _window(self, field: Field) -> tuple[slice, slice, tuple[int, int]]:
        """Part of the operator's grid that a field takes, and where the axis is in it."""
        (row, column), (height, width) = self.camera.centre, self.camera.sensor_shape
        if field == "sensor":
            top, left = row - height // 2, column - width // 2
            return slice(top, top + height), slice(left, left + width), (height // 2, width // 2)
        if field == "full":
            height, width = self.camera.field_shape
            return slice(0, height), slice(0, width), (row, column)
        raise InputError(f'field must be "sensor" or "full", not {field!r}.')


def prepare(
    measurement: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None = None,
    noise: NoiseModel | float | None = None,
    background: npt.ArrayLike | None = None,
    erasures: npt.ArrayLike | None = None,
    precision: Precision = "float32",
) -> Prepared:
    """Check, subtract the background, scale. Parameters as :func:`recon.reconstruct`."""
    require_precision(precision)
    require_options(z_um=z_um, noise=noise)
    dtype = np.dtype(precision)
    data, valid, saturated = data_of(measurement, background, erasures)
    if isinstance(calibration, Calibration):
        psfs, psf_z_um = select_psf(calibration, z_um)
        geometry = calibration.geometry
    else:
        psfs, psf_z_um, geometry = as_channels(calibration, "PSF"), None, Geometry()
    warnings = list(check_psf(psfs))
    require_same_pixels(psfs, data)
    if len(psfs) not in (1, len(data)):
        raise InputError(
            f"The PSF has {len(psfs)} channels and the measurement {len(data)}: give one PSF for all "
            "channels or one for each."
        )
    warnings += saturated

    deviation = np.array([channel_noise(d, v, noise) for d, v in zip(data, valid, strict=True)], np.float32)
    energy = np.sqrt(np.sum(psfs.astype(np.float64) ** 2, axis=(1, 2))).astype(np.float32)
    shape = (data.shape[1], data.shape[2])
    camera = PadCropConvolution(psfs / energy[:, None, None], shape, n_channels=len(data), dtype=dtype)
    operator: LinearOperator = camera if valid.all() else Erasures(valid, data.shape, dtype=dtype) @ camera
    return Prepared(
        operator=operator,
        camera=camera,
        data=np.where(valid, data / deviation[:, None, None], 0).astype(dtype),
        noise=deviation,
        image_scale=(deviation / energy)[:, None, None],
        noise_norm=float(np.sqrt(np.count_nonzero(valid))),
        flat=np.ndim(measurement) == 2,
        psf_z_um=psf_z_um,
        geometry=geometry,
        warnings=tuple(warnings),
        psfs=psfs,
        valid=valid,
    )


def require_precision(precision: str) -> None:
    """Raise InputError for what is not one of :data:`PRECISIONS`."""
    if precision not in PRECISIONS:
        raise InputError(f"The precision is {' or '.join(PRECISIONS)}, not {precision!r}.")


def data_of(
    measurement: npt.ArrayLike, background: npt.ArrayLike | None, erasures: npt.ArrayLike | None
) -> tuple[Floats, npt.NDArray[np.bool_], list[str]]:
    """Return data (n_channels, height, width) less background, which of it is valid, and warnings."""
    counts = as_channels(measurement, "measurement")
    data = counts if background is None else counts - like_data(background, counts, "background")
    valid = np.ones(data.shape, bool) if erasures is None else ~_mask(erasures, data)
    if not valid.any(axis=(1, 2)).all():
        raise InputError("The erasures leave no pixel (True marks an erased one): is the mask inverted?")
    warnings = []
    # As it came: once a background is off, saturated pixels no longer share a value.
    for channel, (values, kept) in enumerate(zip(counts, valid, strict=True)):
        lowest, highest = float(values[kept].min()), float(values[kept].max())
        if lowest == highest and values[kept].size > 1:
            warnings.append(
                f"The measurement's channel {channel} is constant ({highest:g} everywhere): there is nothing "
                "in it to reconstruct. Was the scene lit, and the exposure long enough?"
            )
        elif share := saturated_share(values[kept]):
            warnings.append(
                f"The measurement's channel {channel} looks saturated: {share:.2%} of its pixels are at "
                f"exactly its maximum {highest:g}. "
                "Leave them out with erasures, or expose shorter."
            )
    return data, valid, warnings


def _mask(erasures: npt.ArrayLike, data: Floats) -> npt.NDArray[np.bool_]:
    """Return erasures as a mask of the data's shape."""
    given = np.asarray(erasures)
    expected = "a mask of the measurement's pixels is expected, True (or 1) where one is erased, else False"
    if given.ndim == 0:
        raise InputError(f"erasures is {erasures!r}: {expected}.")
    mask = like_data(given, data, "erasures")
    if not np.isin(mask, (0, 1)).all():
        raise InputError(f"erasures holds values from {mask.min():g} to {mask.max():g}: {expected}.")
    erased: npt.NDArray[np.bool_] = mask != 0
    return erased


def require_same_pixels(psfs: Array, data: Array) -> None:
    """Raise InputError when PSFs and data (n_channels, height, width) differ in size."""
    if psfs.shape[1:] != data.shape[1:]:
        raise InputError(
            f"The PSF has {_size(psfs)} pixels and the measurement {_size(data)}. Both must come from the "
            "same sensor area at the same binning: crop or bin one to match the other."
        )


def channel_noise(data: Floats, valid: npt.NDArray[np.bool_], noise: NoiseModel | float | None) -> float:
    """Return one channel's noise deviation in counts, at least what float32 can tell."""
    if isinstance(noise, NoiseModel):
        deviation = noise.deviation(data[valid])
    elif noise is not None:
        require_options(noise=noise)
        deviation = float(noise)
    else:
        deviation = estimate_deviation(data, valid)
    size = float(np.sqrt(np.mean(data[valid].astype(np.float64) ** 2)))
    return max(deviation, LEAST_NOISE * size) or 1.0


def like_data(image: npt.ArrayLike, data: Floats, name: str) -> Floats:
    """Broadcast a number or an image to the data, channels first."""
    if np.ndim(image) == 0:
        return np.full_like(data, float(np.asarray(image)))
    channels = as_channels(image, name)
    if channels.shape[1:] != data.shape[1:] or len(channels) not in (1, len(data)):
        raise InputError(
            f"The {name} has {_size(channels)} pixels and {len(channels)} channels; the measurement has "
            f"{_size(data)} and {len(data)}."
        )
    return np.broadcast_to(channels, data.shape)


def _size(channels: Array) -> str:
    return f"{channels.shape[1]} x {channels.shape[2]}"
