"""The data types that cross from measurement to reconstruction.

Coordinates everywhere in the project: the origin is the centre of the diffuser's aperture, the sensor's
centre lies opposite to it; ``x`` runs along the sensor's columns (to the right in an image), ``y`` along its
rows (downwards in an image), ``z`` from the diffuser towards the scene. A source at ``(x, y, z)`` shifts the
pattern on the sensor by ``-(x, y) d / z`` (Kuo 2020, Eqs. 3.1 and 3.2): a picture on the sensor's grid stands
upside down, and pixel offset ``p`` from the centre looks at ``x = -p pitch z / d``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from numbers import Real
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array, Float64Array
from recon.errors import InputError

_DTYPES: Mapping[str, type[np.floating]] = {
    "psfs": np.float32,
    "source_positions_um": np.float64,
    "background": np.float32,
}


def plain_array(given: npt.ArrayLike) -> Array:
    """Return an array of anything; NaN where NumPy's masks hide a value: they are not seen elsewhere."""
    if isinstance(given, np.ma.MaskedArray) and np.ma.is_masked(given):
        plain = np.array(given.data, np.result_type(given.dtype, np.float32))
        plain[np.ma.getmaskarray(given)] = np.nan
        return plain
    return np.asarray(given)


def numbers_of(dtype: np.dtype[Any]) -> str:
    """Return what makes numbers of an array's values where they may be some; empty where nothing does."""
    return "; array.astype(float) makes numbers of what are" if dtype.kind == "O" else ""


def real_array(given: Any, name: str, dtype: type[np.floating] = np.float32) -> Array:
    """Return an array of real numbers of any kind as one of ``dtype``.

    Raises InputError where it is none, or holds finite numbers that are beyond ``dtype``.
    """
    array = plain_array(given)
    if array.dtype.kind not in "uifb":
        raise InputError(f"{name} must hold real numbers, not {array.dtype}{numbers_of(array.dtype)}.")
    with np.errstate(over="ignore"):
        cast = np.asarray(array, dtype)
    if cast.dtype.itemsize < array.dtype.itemsize:
        beyond = array[np.isinf(cast) & np.isfinite(array)]
        if beyond.size:
            most, precision = float(np.finfo(dtype).max), f"float{8 * cast.dtype.itemsize}"
            raise InputError(
                f"{name} must hold real numbers up to {most:.2g} ({precision}), not {float(beyond[0]):.3g}."
            )
    return cast


def plain_number(given: Any) -> Any:
    """Return the one number of an array, as files of NumPy, MATLAB and HDF5 hold scalars, or of a Decimal.

    Anything else as it is, and what NumPy's masks hide as ``np.ma.masked``, which is no number.
    """
    if isinstance(given, Decimal):
        return float(given)
    shape = getattr(given, "shape", None)
    if not isinstance(shape, tuple) or math.prod(shape) != 1 or not hasattr(given, "item"):
        return given
    return np.ma.masked if np.ma.is_masked(given) else given.item()


@dataclass(frozen=True, slots=True)
class Geometry:
    """The optics that a calibration was taken with.

    ``pixel_pitch_um`` is the pitch of the PSF images' pixels, after all binning. Unknown entries are None
    (a PSF file from elsewhere tells nothing about its optics).
    """

    pixel_pitch_um: float | None = None
    diffuser_distance_mm: float | None = None
    """From the diffuser's textured side to the sensor."""
    aperture_mm: tuple[float, float] | None = None
    """``(height, width)`` of the aperture on the diffuser."""
    wavelength_nm: float | None = None
    """Of the light that the PSFs were taken in."""

    def __post_init__(self) -> None:
        for name in ("pixel_pitch_um", "diffuser_distance_mm", "wavelength_nm"):
            object.__setattr__(self, name, value := plain_number(getattr(self, name)))
            if not isinstance(value, Real | None):
                raise InputError(
                    f"{name} must be a number, or None where unknown, not {type(value).__name__}."
                )
        if self.aperture_mm is not None:
            object.__setattr__(self, "aperture_mm", _two_numbers("aperture_mm", self.aperture_mm))


def _two_numbers(name: str, given: Any) -> tuple[float, float]:
    """Return height and width; raises InputError where it is no two numbers."""
    several = isinstance(given, Sequence | np.ndarray) and not isinstance(given, str | bytes)
    numbers = tuple(map(plain_number, given)) if several and len(given) == 2 else ()
    if not numbers or not all(isinstance(n, Real) for n in numbers):
        shown = repr(given) if isinstance(given, str | Real) else type(given).__name__
        raise InputError(f"{name} must be (height, width), two numbers, or None where unknown, not {shown}.")
    height, width = numbers
    return height, width


@dataclass(frozen=True, slots=True)
class Calibration:
    """Point spread functions with the source positions they belong to.

    Attributes
    ----------
    psfs : ndarray, float32, (n_sources, n_channels, height, width)
        Background removed, non-negative; other real numbers are converted. ``n_channels`` is 1 for a grey
        camera. Not normalised: relative brightness between sources is kept.
    source_positions_um : ndarray, float64, (n_sources, 3)
        ``x, y, z`` of the source for each PSF, micrometres; NaN where unknown.
    background : ndarray, float32, (n_channels, height, width), or None
        What was subtracted (dark frame and stray light), in counts.
    geometry : Geometry
    quality : mapping
        Figures of merit by name, JSON-compatible.
    provenance : mapping
        Where it came from (run, bench, software versions), JSON-compatible.
    """

    psfs: Float32Array
    source_positions_um: Float64Array
    background: Float32Array | None = None
    geometry: Geometry = field(default_factory=Geometry)
    quality: Mapping[str, Any] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.geometry, Geometry):
            raise InputError(
                f"geometry must be a Geometry, not {type(self.geometry).__name__}: "
                "Geometry(pixel_pitch_um=..., diffuser_distance_mm=...)."
            )
        for name in ("quality", "provenance"):
            if not isinstance(getattr(self, name), Mapping):
                given = type(getattr(self, name)).__name__
                raise InputError(f"{name} must be a dict, values by their names, not {given}.")
        for name, dtype in _DTYPES.items():
            given = getattr(self, name)
            if (given is not None or name != "background") and getattr(given, "dtype", None) != dtype:
                object.__setattr__(self, name, real_array(given, name, dtype))
        if self.psfs.ndim != 4:
            hint = {2: ": psf[None, None] of a grey one", 3: ": psfs[:, None] of grey ones"}
            raise InputError(
                "psfs must be (n_sources, n_channels, height, width), not "
                f"{self.psfs.shape}{hint.get(self.psfs.ndim, '')}."
            )
        if self.source_positions_um.shape != (len(self.psfs), 3):
            raise InputError(
                f"source_positions_um must be ({len(self.psfs)}, 3) for {len(self.psfs)} PSFs, "
                f"not {self.source_positions_um.shape}."
            )
        if self.background is not None and self.background.shape != self.psfs.shape[1:]:
            raise InputError(
                f"background must have the shape of one PSF {self.psfs.shape[1:]}, "
                f"not {self.background.shape}."
            )

    def __repr__(self) -> str:
        """Say in a line how many PSFs there are, how large, and how far away."""
        count, channels, height, width = self.psfs.shape
        z_mm = self.source_positions_um[:, 2] / 1e3
        depths = f"{len(np.unique(z_mm))} depths, {z_mm.min():.4g} to {z_mm.max():.4g} mm"
        if np.isnan(z_mm).any():
            depths = "depth not known"
        elif z_mm.min() == z_mm.max():
            depths = f"{z_mm[0]:.4g} mm"
        colour = "grey" if channels == 1 else f"{channels} channels"
        return f"<Calibration: {count} PSF{'s' * (count > 1)} {height} x {width} {colour}, {depths}>"

    def part(self, members: Any) -> Calibration:
        """Return the calibration with some of its PSFs: a slice, a mask, or their numbers."""
        positions_um = self.source_positions_um[members]
        return replace(self, psfs=self.psfs[members], source_positions_um=positions_um)

    def nearest_to_axis(self, members: npt.ArrayLike | None = None) -> int:
        """Return which PSF, of some or all, is nearest to the axis; unknown places count as on it."""
        numbers = np.arange(len(self.psfs)) if members is None else np.asarray(members)
        x, y = self.source_positions_um[numbers, :2].T
        return int(numbers[np.argmin(np.nan_to_num(np.hypot(x, y)))])
