"""What was photographed, what is known of the photograph (background, erased pixels, noise), through what."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array, Float64Array
from recon.base.brief import brief
from recon.base.checks import (
    NEIGHBOURS,
    as_channels,
    require_finite,
    require_noise,
    saturated_share,
    select_psf,
)
from recon.base.noise import NoiseModel, estimate_deviation
from recon.base.unseen import unseen_lines
from recon.camera.camera_model import Depths, members_of_depths, one_depth, sort_by_depth
from recon.camera.field_registration import one_psf
from recon.errors import InputError
from recon.reconstruction.options import ReconstructionOptions
from recon.types import Calibration, plain_array, real_array

Noise = NoiseModel | float | None

LEAST_NOISE = 1e-5
"""Noise assumed at least, relative to the measurement's root mean square: float32 holds no more."""

MOST_LIGHT = 1.5
"""Of relative light: what lies beyond is counts. A mean of 1 instead of a maximum leaves 1.5 seldom."""

LINES_FOUND = "shared_lines_counts"
"""Where lines were looked for in the photograph itself: its name among what was found."""

MARKED = "Put numbers there, and mark them in erasures."
"""What helps where pixels of a measurement that are NaN are not erased by themselves."""


class OfOnePhotograph(str):
    """A warning of one photograph alone: another's data in the same problem leave it behind."""

    __slots__ = ()


@dataclass(frozen=True)
class Measurement:
    """A photograph with the facts about it.

    Attributes
    ----------
    image : array, (height, width) or (height, width, n_channels)
        Any real dtype, any exposure. With ``patterns`` the frames, (n_patterns, height, width[, n_channels]).
    noise : NoiseModel or float, optional
        The camera's noise, or its standard deviation in counts; default: estimated from the image.
    background : array or number, optional
        Subtracted from the image first.
    erasures : array of bool, as ``image`` or (height, width), optional
        True where a pixel tells nothing: dead, saturated, not read (Kuo 2020, Eq. 3.10, has the complement).
    patterns : array, (n_patterns, height, width), optional
        Relative light on the pixels of the picture in each frame, not negative: a reconstruction of a plain
        sheet lit by it (see :mod:`recon.camera.factors`). One pattern of ones is the ordinary photograph.
    vignetting : array, (height, width) or as ``image``, optional
        Relative light on the pixels, about 1 at most, which the PSF does not have: the image less its
        background is divided by it. None: looked for where light is missing
        (:mod:`recon.reconstruction.mending.restored_light`).
    lines : array, (height, width) or as ``image``, optional
        Offsets that whole rows and columns share, counts: subtracted as the background is. None: looked for
        (:mod:`recon.base.shared_lines`).
    found : mapping
        What of this was fitted to the photograph itself, as results record it.
    """

    image: npt.ArrayLike
    noise: Noise = None
    background: npt.ArrayLike | None = None
    erasures: npt.ArrayLike | None = None
    patterns: npt.ArrayLike | None = None
    vignetting: npt.ArrayLike | None = None
    lines: npt.ArrayLike | None = None
    found: Mapping[str, Any] = field(default_factory=dict)

    __repr__ = brief

    def __post_init__(self) -> None:
        """Raise InputError where the image is no array of numbers: a file's name is read by db.read."""
        if self.image is None or isinstance(self.image, str | bytes | Path):
            remedy = "" if self.image is None else " db.read reads a file."
            expected = "The measurement must be an array, (height, width[, n_channels])"
            raise InputError(f"{expected}, not {self.image!r}.{remedy}")

    @property
    def flat(self) -> bool:
        """Whether the image has no axis of channels."""
        return np.ndim(self.image) == (2 if self.patterns is None else 3)

    @property
    def frames(self) -> int:
        """Frames of each channel: one, or one a pattern."""
        return 1 if self.patterns is None else len(np.asarray(self.patterns))

    def with_holes_erased(self) -> tuple[Measurement, str]:
        """Return it with NaN and masked pixels erased, and that in words; itself and no words without any."""
        image = plain_array(self.image)
        if self.patterns is not None or image.dtype.kind != "f" or not (holes := np.isnan(image)).any():
            return self, ""
        erased = np.asarray(self.erasures if self.erasures is not None else False)
        if erased.ndim == 2 and image.ndim == 3:
            erased = erased[..., None]
        if holes.all() or erased.ndim not in (0, image.ndim):
            return self, ""  # which is refused in words of its own
        filled = np.where(holes, np.median(image[~holes]), image)
        masked = " or masked" if np.ma.is_masked(self.image) else ""
        said = f"{np.count_nonzero(holes)} pixels of the measurement are NaN{masked}: they are erased."
        return replace(self, image=filled, erasures=np.maximum(erased, holes)), said

    def with_unseen_erased(self) -> tuple[Measurement, str]:
        """Return it with frames and covered parts erased, and that in words; itself and no words without any.

        Such are outer rows and columns of one value (:mod:`recon.base.unseen`); not under patterns.
        """
        if self.patterns is not None:
            return self, ""
        channels = self.channels()
        erased = np.zeros(channels.shape, bool) if self.erasures is None else self._erased(channels)
        if not (unseen := unseen_lines(channels, ~erased)).any():
            return self, ""
        said = (
            f"{np.mean(unseen):.1%} of the measurement's pixels lie in outer rows and columns of one value "
            "each: a frame, or a part that was covered or not read. They are erased."
        )
        both = erased | unseen
        return replace(self, erasures=both[0] if self.flat else np.moveaxis(both, 0, -1)), said

    def channels(self) -> Float32Array:
        """Return the image as it came, channels first; under patterns each channel's frames in turn."""
        if self.patterns is None:
            return as_channels(self.image, "measurement", MARKED, "Make bad pixels NaN: erased.")
        return _frames(self.image, self.light())

    def light(self) -> Float32Array:
        """Return the patterns, checked.

        Raises InputError when they are no patterns.
        """
        light = real_array(self.patterns, "The patterns")
        if light.ndim != 3 or not np.isfinite(light).all():
            raise InputError(f"Patterns are finite numbers, (n, height, width); got {light.shape}.")
        if light.min() < 0 or not light.any():
            raise InputError("Patterns must not be negative, nor all dark.")
        return light

    def counts(self) -> Counts:
        """Return the image less its background, channels first.

        Raises InputError when the image or what is known of it is unusable.
        """
        require_noise(self.noise)
        counts = self.channels()
        data = self.light_of(counts)
        valid = np.ones(data.shape, bool) if self.erasures is None else ~self._erased(data)
        if not valid.any(axis=(1, 2)).all():
            raise InputError("The erasures leave no pixel (True marks an erased one): is the mask inverted?")
        # As it came: once a background is off, saturated pixels no longer share a value.
        warnings = tuple(
            said
            for channel, (values, kept) in enumerate(zip(counts, valid, strict=True))
            if (said := _doubt(channel, values[kept]))
        )
        return Counts(data, valid, warnings)

    def light_of(self, counts: Float32Array) -> Float32Array:
        """Return channels less their background and what lines share, and divided by the vignetting.

        Raises InputError where either is shaped otherwise, or the vignetting is no relative light.
        """
        if self.background is not None:
            counts = counts - self.like(self.background, counts, "background")
        if self.lines is not None:
            counts = counts - self.like(self.lines, counts, "offset of lines")
        if self.vignetting is not None:
            shade = self.like(self.vignetting, counts, "vignetting")
            if not shade.min() > 0:
                raise InputError(f"The vignetting is relative light, above 0; found {shade.min():g}.")
            if (full := np.percentile(shade, 99)) > MOST_LIGHT:
                raise InputError(
                    f"The vignetting is relative light, about 1 at most; found {full:g}, as of a flat field "
                    "in counts. Take its dark frame off it, and divide it by its brightest part: "
                    "flat / numpy.percentile(flat, 99.9)."
                )
            counts = counts / shade
        return counts

    def like(self, image: npt.ArrayLike, data: Float32Array, name: str) -> Float32Array:
        """Broadcast a number, one image, or one for each channel (under patterns: each frame) to the data.

        Raises InputError when it is shaped otherwise.
        """
        if np.ndim(image) == 0:
            number = real_array(image, f"The {name}")
            if not np.isfinite(number):
                raise InputError(f"The {name} must be finite, not {number:g}.")
            return np.full_like(data, number)
        if self.patterns is not None and np.ndim(image) >= 3:  # shaped as the frames: patterns first
            frames = np.asarray(image)
            if frames.ndim == 3 and not self.flat:  # one for all colours
                frames = np.repeat(frames[..., None], np.shape(self.image)[-1], axis=-1)
            image = np.moveaxis(_by_channel(frames), 0, -1)
        channels = as_channels(image, name, "Put 1 or 0 there." if name == "erasures" else NEIGHBOURS)
        if channels.shape[1:] != data.shape[1:] or len(channels) not in (1, len(data)):
            if self.patterns is not None:
                shape = np.shape(self.image)
                raise InputError(
                    f"The {name} is {np.shape(image)}, and the frames are {shape}: give a number, one image "
                    f"{shape[1:3]} for all frames, or one for each, patterns first."
                )
            raise InputError(
                f"The {name} has {_size(channels)} pixels and {len(channels)} channels; the measurement has "
                f"{_size(data)} and {len(data)}."
            )
        return np.broadcast_to(channels, data.shape)

    def _erased(self, data: Float32Array) -> BoolArray:
        """Return the erasures as a mask of the data's shape."""
        expected = (
            "a mask of the measurement's pixels is expected, True (or 1) where one is erased, else False"
        )
        if self.erasures is None or np.ndim(self.erasures) == 0:
            raise InputError(f"erasures is {self.erasures!r}: {expected}.")
        mask = self.like(self.erasures, data, "erasures")
        if not np.isin(mask, (0, 1)).all():
            raise InputError(f"erasures holds values from {mask.min():g} to {mask.max():g}: {expected}.")
        erased: BoolArray = mask != 0
        return erased

    def deviations(self, counts: Counts) -> Float64Array:
        """Return every channel's noise deviation, counts; under patterns its frames' root mean square."""
        shades: Iterable[Float32Array | None] = [None] * len(counts.data)
        if self.vignetting is not None:
            shades = self.like(self.vignetting, counts.data, "vignetting")
        rows = zip(counts.data, counts.valid, shades, strict=True)
        each = np.array([channel_noise(d, v, self.noise, shade) for d, v, shade in rows])
        of_channels = np.sqrt(np.mean(each.reshape(-1, self.frames) ** 2, axis=1))
        return each if self.patterns is None else np.repeat(of_channels, self.frames)


class Counts(NamedTuple):
    """An image less its background, (rows, height, width), which of its pixels count, and warnings.

    A row is a channel; under patterns a frame of one.
    """

    data: Float32Array
    valid: BoolArray
    warnings: tuple[str, ...]


def channel_noise(
    data: Float32Array, valid: BoolArray, noise: Noise, shade: Float32Array | None = None
) -> float:
    """Return one channel's noise deviation in counts, at least what float32 can tell.

    A ``noise`` that is known is that of the counts before they were divided by ``shade``, relative light.
    """
    if noise is not None and shade is not None:
        model = noise if isinstance(noise, NoiseModel) else NoiseModel(noise, 0.0)
        photons2 = model.counts_per_electron * np.maximum(data[valid], 0) / shade[valid]
        grown2 = (model.read_noise / shade[valid]) ** 2 + photons2
        deviation = float(np.sqrt(np.mean(grown2, dtype=np.float64)))
    elif isinstance(noise, NoiseModel):
        deviation = noise.deviation(data[valid])
    elif noise is not None:
        deviation = float(noise)
    else:
        deviation = estimate_deviation(data, valid & ~_clipped(data, valid))
    size = float(np.sqrt(np.mean(data[valid].astype(np.float64) ** 2)))
    return max(deviation, LEAST_NOISE * size) or 1.0


def _clipped(data: Float32Array, valid: BoolArray) -> BoolArray:
    """Return which pixels are at full scale, as are all around them: such have no noise."""
    from scipy.ndimage import minimum_filter

    if not 0 < saturated_share(data[valid]) < 1:
        return np.zeros(data.shape, bool)
    top = data[valid].max()
    return np.asarray(minimum_filter(np.where(valid, data, top), 3) == top)


def require_same_pixels(psfs: Array, data: Array) -> None:
    """Raise InputError when PSFs and data (n_channels, height, width) differ in size."""
    if psfs.shape[1:] != data.shape[1:]:
        raise InputError(
            f"The PSF has {_size(psfs)} pixels and the measurement {_size(data)}. Both must come from the "
            "same sensor area at the same binning: crop or bin one to match the other."
        )


def require_same_channels(psfs: Array, data: Array) -> None:
    """Raise InputError when PSFs (n, n_channels, height, width) do not serve the data's channels."""
    if psfs.shape[1] not in (1, len(data)):
        has = "PSF has" if len(psfs) == 1 else "PSFs have"
        stack = " PSFs of several depths are a Calibration, or a folder or stack of files."
        raise InputError(
            f"The {has} {psfs.shape[1]} channels and the measurement {len(data)}: give one PSF for all "
            f"channels or one for each.{stack if psfs.shape[1] > 4 else ''}"
        )


def depths_of(
    calibration: Calibration, options: ReconstructionOptions
) -> tuple[Calibration, Depths, list[str]]:
    """Return the depths that take part, sorted and registered, and warnings."""
    if len(calibration.psfs) == 0:
        raise InputError("The calibration holds no PSF: at least one is needed.")
    if options.z_um is None and len(members_of_depths(calibration.source_positions_um)) > 1:
        return calibration, sort_by_depth(calibration), []
    if options.model == "convolution":
        z_um = calibration.source_positions_um[0, 2]  # of PSFs of one depth, theirs
        asked = float(z_um) if options.z_um is None and np.isfinite(z_um) else options.z_um
        psf, _ = select_psf(calibration, asked)
        same = next(k for k, own in enumerate(calibration.psfs) if np.shares_memory(own, psf))
        calibration = calibration.part(slice(same, same + 1))
        return calibration, sort_by_depth(calibration), []
    depth = one_depth(calibration, options.z_um)
    try:
        return depth, sort_by_depth(depth), []
    except InputError as error:
        if options.model != "auto":
            raise
        depth = central(depth)
        return depth, sort_by_depth(depth), [f"One PSF for the whole field: {error}"]


def central(calibration: Calibration) -> Calibration:
    """Return one PSF for the whole field of one depth: the one on the axis."""
    nearest = calibration.part([calibration.nearest_to_axis()])
    return replace(nearest, psfs=one_psf(calibration)[None])


def _frames(frames: npt.ArrayLike, light: Float32Array) -> Float32Array:
    """Return frames that fit their patterns, each channel's in turn."""
    data = real_array(plain_array(frames), "The measurement")
    if data.ndim not in (3, 4) or data.shape[:3] != light.shape:
        raise InputError(
            "One pattern a frame is expected, patterns (n, height, width), frames alike or with channels "
            f"last; got frames {data.shape} and patterns {light.shape}."
        )
    require_finite(data, "measurement", MARKED)
    return _by_channel(data)


def _by_channel(frames: Array) -> Array:
    """Return frames (n, height, width[, n_channels]) as one row of frames, each channel's in turn."""
    return frames if frames.ndim == 3 else np.moveaxis(frames, -1, 0).reshape(-1, *frames.shape[1:3])


def _doubt(channel: int, values: Array) -> str:
    """Say what is doubtful about a channel's pixels."""
    lowest, highest = float(values.min()), float(values.max())
    if lowest == highest and values.size > 1:
        return (
            f"The measurement's channel {channel} is constant ({highest:g} everywhere): there is nothing "
            "in it to reconstruct. Was the scene lit, and the exposure long enough?"
        )
    if share := saturated_share(values):
        return (
            f"The measurement's channel {channel} looks saturated: {share:.2%} of its pixels are at "
            f"exactly its maximum {highest:g}. "
            "Leave them out with erasures, or expose shorter."
        )
    return ""


def _size(channels: Array) -> str:
    return f"{channels.shape[1]} x {channels.shape[2]}"
