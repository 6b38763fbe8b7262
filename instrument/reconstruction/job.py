"""A reconstruction from files, before the work: what goes in, and what was chosen, in words and on record."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.calibration_file import find_calibration, load_calibration
from instrument.files.errors import BenchError, FileError, percent
from instrument.files.images import ImageFile, read_image
from instrument.reconstruction.defects import mended_psf
from instrument.reconstruction.matching import check_pair, matched, matched_calibration, matched_dark
from instrument.reconstruction.mosaic import (
    in_colour,
    matched_mosaic,
    mosaic_psf,
    on_every_pixel,
    pattern_of,
    require_whole_cells,
    suspected_mosaic,
)
from instrument.reconstruction.options import InputOptions, NoiseChoice
from instrument.reconstruction.preparation import (
    AUTO_PIXELS,
    Crop,
    Dark,
    Erased,
    FloatImage,
    auto_binning,
    bin_image,
    both_raw,
    calibrated_dark,
    check_psf,
    erasures_of,
    reduce,
    reduce_valid,
    saturated_pixels,
)
from instrument.reconstruction.straightened import require_no_counts, straightened, straightened_dark
from recon.arrays import Array, BoolArray
from recon.base.marks import Marks, marks_of
from recon.base.noise import NoiseModel, averaged_noise
from recon.camera.factors import Pattern
from recon.reconstruction.measurement import Measurement
from recon.types import Calibration

MEASUREMENT, PSFS = "measurement_marks", "psfs_marks"
"""What a record calls the marks of the prepared photograph, and of its PSFs with their places."""


@dataclass(frozen=True, slots=True)
class Reduction:
    """How a photograph became a measurement, to be done again to others of the same camera."""

    first_binning: int
    """To the calibration's pixels, before everything else."""
    dark: float | FloatImage
    """Subtracted then, counts."""
    crop: Crop | None
    binning: int
    """Last."""
    mosaic: Pattern | None = None
    """Of a raw frame, whose colours come apart."""

    def apply(self, pixels: Array) -> FloatImage:
        """Return a photograph (height, width[, 3]) as a measurement."""
        return self.seen(pixels)[0]

    def seen(self, pixels: Array, valid: BoolArray | None = None) -> tuple[FloatImage, BoolArray | None]:
        """Return the same, and which of its ``valid`` pixels were measured; None where all are."""
        if self.mosaic is None:
            binned = bin_image(pixels, self.first_binning) if self.first_binning > 1 else pixels
            return reduce(binned, self.dark, self.crop, self.binning), valid
        raw = reduce(pixels, on_every_pixel(self.dark, self.first_binning, pixels.shape), None, 1)
        image, known = matched_mosaic(raw, self.mosaic, self.first_binning, self.crop, self.binning)
        return image, known if valid is None else known & valid[..., None]


@dataclass(frozen=True, slots=True)
class Job:
    """What :func:`recon.reconstruct` is called with, and how it came about."""

    measurement: FloatImage
    """float32, (height, width) or (height, width, 3)."""
    calibration: Calibration
    """On the measurement's pixels."""
    notes: Mapping[str, str]
    """What was read and chosen, to be shown: ``"Dark"`` to ``"34.1 counts from both ..."``."""
    valid: BoolArray | None = None
    """bool, shape of the measurement or (height, width), or None: the pixels that take part; None means all
    of them."""
    warnings: tuple[str, ...] = ()
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Files with checksums and every setting, JSON-compatible."""
    simulated: bool = False
    """Whether any of the input is known to come from the simulated bench."""
    reduction: Reduction | None = None
    known_noise: NoiseModel | None = None
    """Of single pixels, where the photograph's metadata tell."""

    def binned_noise(self, noise: NoiseChoice) -> NoiseModel | float | None:
        """Return what is left of a single pixel's noise after the averaging that made the measurement.

        None, for what the photograph's metadata tell, becomes a model where they do; "estimate" None.
        """
        if noise == "estimate":
            return None
        if noise is None:
            noise = self.known_noise
        factor: float = int(self.provenance.get("binning", 1)) * int(self.provenance.get("image_binning", 1))
        if factor > 1 and self.provenance.get("mosaic"):
            factor /= 2  # red and blue have a quarter of the pixels
        return averaged_noise(noise, factor**2)

    def as_measurement(self, noise: NoiseChoice) -> Measurement:
        """Return the photograph with what is known of it."""
        erasures = None if self.valid is None else ~self.valid
        return Measurement(self.measurement, self.binned_noise(noise), erasures=erasures)


def job_from_files(psf_file: Path | ImageFile, image_file: Path | ImageFile, inputs: InputOptions) -> Job:
    """Prepare a PSF and an image from anywhere.

    Where a grey image is the raw frame of a colour mosaic, its PSF, when grey as well, is taken to be one
    too.

    Raises FileError or BenchError when a file cannot be used, the two do not belong together, or the window
    or binning does not fit.
    """
    require_no_counts(inputs.noise, inputs.srgb)
    if isinstance(psf_file, Path) and psf_file.is_dir():
        other = "PSFs of several depths in a folder are given by --volume, a calibration by --calibration."
        raise FileError(psf_file, "is a folder; a file is expected.", other)
    raw_psf = read_image(psf_file, several="PSFs, one a depth, are given together by --volume.")
    image = read_image(image_file, holes=True, several=OF_A_FILM)
    crop, binning = inputs.crop, inputs.binning
    _refuse_constant(image)
    pattern = pattern_of(inputs.mosaic, image)
    mends = pattern is None and inputs.erasures != "none"
    pixels, n_mended = mended_psf(raw_psf.pixels) if mends else (raw_psf.pixels, 0)
    psf = replace(raw_psf, pixels=pixels)
    warnings = check_psf(psf, allow_saturated=inputs.allow_saturated)
    check_pair(psf, image, allow_mixed_depth=inputs.allow_mixed_depth, mosaic=pattern is not None)
    dark, read = straightened_dark(inputs.dark, image, inputs.srgb), image
    psf, image = _in_proportion(psf, image, inputs)
    pair = matched(psf, image, mosaic=pattern is not None)
    level = matched_dark(dark, psf, image, pair, apart=inputs.srgb in ("photograph", "psf"))
    psf, match = pair.psf, pair.image_binning
    window = _window(crop, (psf.pixels.shape[0], psf.pixels.shape[1]))
    factor = auto_binning(window) if binning is None else binning
    if pattern is not None and binning is None and factor > 1:
        factor += factor % 2
    erased = erasures_of(inputs.erasures, image, None if pattern else psf.pixels)
    reduction = Reduction(match, level.image, crop, factor, pattern)
    measurement, valid = reduction.seen(image.pixels, _reduced_valid(_on(erased, match), crop, factor))
    if pattern is None:
        psf_pixels = reduce(psf.pixels, level.psf, crop, factor)
    else:
        psf_pixels = mosaic_psf(reduce(psf.pixels, level.psf, None, 1), pattern, crop, factor)
    psf_pixels = np.maximum(psf_pixels, 0)
    if not psf_pixels.any():
        raise FileError(
            psf.path,
            f"nothing of the PSF is left in the window after subtracting {level.reason}.",
            "See --dark.",
        )
    return Job(
        measurement,
        _calibration_of(psf_pixels, psf),
        {
            "PSF": ", ".join((describe(psf), *mended_note(n_mended))),
            "Image": describe(read),
            "Dark": level.reason,
            "Pixels": describe_window(crop, binning, factor, measurement),
            "Erased": erased.reason,
            **mosaic_note(pattern),
            **srgb_note(inputs),
            **noise_note(noise_of(image)),
        },
        valid,
        (
            *warnings,
            *pair.warnings,
            *(_converted(psf, image) if inputs.dark == "auto" else ()),
            *_saturation(image, erased),
            *_suspicion(inputs, image),
        ),
        {
            "psf": source_record(raw_psf) | ({"mended_pixels": n_mended} if n_mended else {}),
            "image": source_record(read),
            "dark": dark_record(level),
            "crop": None if crop is None else slices_record(crop.slices(psf.pixels.shape[:2])),
            "binning": factor,
            **({"image_binning": match} if match > 1 else {}),
            **({"psf_binning": pair.psf_binning} if pair.psf_binning > 1 else {}),
            "erased": erased.reason,
            "mosaic": pattern,
            "srgb": inputs.srgb,
        },
        psf.is_simulated or image.is_simulated,
        reduction,
        noise_of(image),
    )


def job_from_calibration(folder: Path, image: Path | ImageFile, inputs: InputOptions) -> Job:
    """Prepare an image for a calibration folder, or a run folder with one calibration inside.

    An image with a whole multiple of the calibration's pixels is binned to them first; window and
    binning then act on the pixels of both. Errors as ``job_from_files``.
    """
    folder = find_calibration(folder)
    return job_with(load_calibration(folder), folder, image, inputs)


def job_with(
    calibration: Calibration,
    folder: Path,
    image_file: Path | ImageFile,
    inputs: InputOptions,
    *,
    straight: bool = False,
) -> Job:
    """Prepare an image for a calibration that came from ``folder``; as :func:`job_from_calibration`.

    ``straight``: its PSFs were files, and were straightened where that is asked for.
    """
    image = read_image(image_file, holes=True, several=OF_A_FILM)
    crop = inputs.crop
    _refuse_constant(image)
    if inputs.srgb in ("psf", "both") and not straight:
        raise FileError(folder, "a calibration's PSFs are in proportion to the light.", "--srgb photograph.")
    require_no_counts(inputs.noise, inputs.srgb)
    dark, read = straightened_dark(inputs.dark, image, inputs.srgb), image
    image = straightened(image) if inputs.srgb in ("photograph", "both") else image
    shape = calibration.psfs.shape[-2:]
    match = matching_binning(image, shape, folder)
    pattern = pattern_of(inputs.mosaic, image)
    if pattern is not None:
        require_whole_cells(image, match)
    calibration, grey = matched_calibration(calibration, image, mosaic=pattern is not None)
    level = calibrated_dark(dark, image, calibration, match)
    factor = inputs.binning or 1
    nearest = np.moveaxis(calibration.psfs[calibration.nearest_to_axis()], 0, -1)
    erased = erasures_of(inputs.erasures, image, None if pattern else nearest)
    reduction = Reduction(match, level.image, crop, factor, pattern)
    measurement, valid = reduction.seen(image.pixels, _reduced_valid(_on(erased, match), crop, factor))
    if pattern is not None:
        calibration = in_colour(calibration, pattern, match)
    return Job(
        measurement,
        reduced_calibration(calibration, crop, factor),
        {
            "Calibration": f"{folder}: {len(calibration.psfs)} PSFs of {shape[0]} x {shape[1]}",
            "Image": describe(read) + binned_note(match),
            "Dark": level.reason,
            "Pixels": describe_window(crop, factor, factor, measurement),
            "Erased": erased.reason,
            **mosaic_note(pattern),
            **srgb_note(inputs),
            **noise_note(noise_of(image)),
        },
        valid,
        (*((grey,) if grey else ()), *_saturation(image, erased), *_suspicion(inputs, image)),
        {
            "calibration": str(folder.resolve()),
            "image": source_record(read),
            "dark": dark_record(level),
            "image_binning": match,
            "crop": None if crop is None else slices_record(crop.slices((shape[0], shape[1]))),
            "binning": factor,
            "erased": erased.reason,
            "mosaic": pattern,
            "srgb": inputs.srgb,
        },
        bool(calibration.provenance.get("simulated")) or image.is_simulated,
        reduction,
        noise_of(image),
    )


OF_A_FILM = (
    "Frames of a film become a recording by diffuserbench import FILE, and it a video by diffuserbench "
    "reconstruct RUN --video."
)


def matching_binning(image: ImageFile, shape: tuple[int, ...], folder: Path) -> int:
    """Return how many of an image's pixels, along each side, one of the PSFs of ``shape`` has.

    Raises FileError when it is no whole number.
    """
    height, width = image.pixels.shape[:2]
    factor = height // shape[0]
    if factor < 1 or (height // factor, width // factor) != tuple(shape):
        raise FileError(
            image.path,
            f"is {image.describe()}, but the PSFs of {folder} are {shape[0]} x {shape[1]}: "
            "no whole binning brings one to the other.",
            "Its axes are in another order: images first, then rows, then columns (numpy.moveaxis)."
            if shape[0] == width != height
            else "Photograph with the region of interest and binning of the calibration.",
        )
    return int(factor)


def reduced_calibration(calibration: Calibration, crop: Crop | None, factor: int) -> Calibration:
    """Return a calibration whose PSFs are cut and binned as a photograph is, without a background."""
    if crop is None and factor == 1:
        return calibration
    psfs = np.stack(
        [np.moveaxis(reduce(np.moveaxis(psf, 0, -1), 0.0, crop, factor), -1, 0) for psf in calibration.psfs]
    )
    pitch = calibration.geometry.pixel_pitch_um
    geometry = replace(calibration.geometry, pixel_pitch_um=None if pitch is None else pitch * factor)
    return replace(calibration, psfs=psfs, background=None, geometry=geometry)


def _calibration_of(psf: FloatImage, file: ImageFile) -> Calibration:
    channels = np.moveaxis(psf, -1, 0) if psf.ndim == 3 else psf[None]
    return Calibration(
        np.ascontiguousarray(channels[None]), np.full((1, 3), np.nan), provenance={"psf": str(file.path)}
    )


def _reduced_valid(erased: Erased, crop: Crop | None, factor: int) -> BoolArray | None:
    """Return the mask on the measurement's pixels; refused where it leaves nothing."""
    if erased.valid is None:
        return None
    valid = reduce_valid(erased.valid, crop, factor)
    if not valid.any():
        raise BenchError(
            f"After erasing {erased.reason} and binning {factor} x {factor} no pixel is left: a binned pixel "
            "needs all of its pixels. Erase less or bin less."
        )
    return valid


def _on(erased: Erased, binning: int) -> Erased:
    """Return which binned pixels take part."""
    if erased.valid is None or binning == 1:
        return erased
    return replace(erased, valid=reduce_valid(erased.valid, None, binning))


def _window(crop: Crop | None, shape: tuple[int, int]) -> tuple[int, int]:
    if crop is None:
        return shape
    crop.slices(shape)
    return crop.height, crop.width


def _refuse_constant(image: ImageFile) -> None:
    lowest, highest = float(np.nanmin(image.pixels)), float(np.nanmax(image.pixels))
    if lowest == highest:
        hint = "Was the scene lit?" if highest <= 0 else "Was the scene lit? At full scale, expose shorter."
        raise FileError(image.path, f"the image is constant (every pixel is {highest:g}).", hint)


def _converted(psf: ImageFile, image: ImageFile) -> tuple[str, ...]:
    """Doubt a photograph that was made into fractions while its PSF is raw."""
    kinds = psf.pixels.dtype.kind, image.pixels.dtype.kind
    if kinds != ("u", "f") or both_raw(psf, image):
        return ()
    return (
        f"The photograph is {image.pixels.dtype} and its PSF {psf.pixels.dtype}: it was converted, and its "
        "dark level is estimated by itself. Take the raw file, or give --dark.",
    )


def _in_proportion(psf: ImageFile, image: ImageFile, inputs: InputOptions) -> tuple[ImageFile, ImageFile]:
    """Return a PSF and an image, those that are coded for the eye straightened."""
    which = inputs.srgb
    return (
        straightened(psf) if which in ("psf", "both") else psf,
        straightened(image) if which in ("photograph", "both") else image,
    )


def _saturation(image: ImageFile, erased: Erased) -> tuple[str, ...]:
    count = np.count_nonzero(saturated_pixels(image.pixels))
    if not count or erased.valid is not None:
        return ()
    share = percent(count / image.pixels.size)
    are = "pixel of the image ({}) is" if count == 1 else "pixels of the image ({}) are"
    return (f"{count} {are.format(share)} saturated and used: expect halos there.",)


def _suspicion(inputs: InputOptions, image: ImageFile) -> tuple[str, ...]:
    asked = suspected_mosaic(image) if inputs.mosaic == "auto" else ""
    return (asked,) if asked else ()


# As it is shown, and kept beside the result -------------------------------------------------------------
def noise_of(image: ImageFile) -> NoiseModel | None:
    """Return a pixel's noise as the metadata of a photograph tell it, the mean of its frames regarded."""
    told: Any = image.metadata.get("noise")
    try:
        average = float(image.metadata.get("average", 1))
        model = NoiseModel(
            float(told["read_noise_counts"]) / average**0.5, float(told["counts_per_electron"]) / average
        )
    except (TypeError, KeyError, ValueError, ZeroDivisionError):
        return None  # somebody else's metadata
    known = np.isfinite([model.read_noise, model.counts_per_electron]).all()
    return model if known and min(model.read_noise, model.counts_per_electron) >= 0 else None


def noise_note(noise: NoiseModel | None) -> dict[str, str]:
    """Tell of a known noise."""
    if noise is None:
        return {}
    known = f"read noise {noise.read_noise:.3g} counts, {noise.counts_per_electron:.3g} counts an electron"
    return {"Noise": f"{known}, as the photograph's metadata say, unless --noise is given"}


def srgb_note(inputs: InputOptions) -> dict[str, str]:
    """Tell of files for the eye that were straightened."""
    return {} if inputs.srgb == "none" else {"sRGB": f"{inputs.srgb}: made proportional to the light"}


def mosaic_note(pattern: Pattern | None) -> dict[str, str]:
    """Tell of a raw frame's colour mosaic."""
    if pattern is None:
        return {}
    return {"Mosaic": f"{pattern}: every pixel counts for its own colour, nothing is demosaiced"}


def binned_note(match: int) -> str:
    """Tell of a photograph's, or a film's, pixels that became a calibration's; empty where they are its."""
    return f", binned {match} x {match} to the calibration" if match > 1 else ""


def mended_note(count: int) -> tuple[str, ...]:
    """Tell of a PSF's pixels that were filled; empty where none was."""
    what = "hot or dead pixel" if count == 1 else "hot or dead pixels"
    return (f"{count} {what} filled by their neighbours (--erasures none: as they are)",) if count else ()


def describe(file: ImageFile) -> str:
    """Return an image's name, size and what was noted in reading it."""
    return ", ".join((f"{file.path}: {file.describe()}", *file.notes))


def describe_window(crop: Crop | None, asked: int | None, factor: int, result: FloatImage) -> str:
    """Return what was cut out and how it was binned; ``asked`` is None where that was chosen."""
    window = "whole image" if crop is None else f"window of {crop.height} x {crop.width}"
    is_automatic = asked is None and factor > 1
    binned = f"binned {factor} x {factor}" if factor > 1 else "not binned"
    limit = f"at most {AUTO_PIXELS / 1e6:g} megapixel"
    why = f" (automatic: {limit}; --bin 1 for all)" if is_automatic else ""
    return f"{window}, {binned}{why}: {result.shape[0]} x {result.shape[1]}"


def source_record(file: ImageFile) -> dict[str, Any]:
    """Return what tells an image from others: its pixels, when it was taken and in which light."""
    digest = hashlib.sha256(np.ascontiguousarray(file.pixels).data).hexdigest()
    taken = {name: file.metadata[name] for name in ("utc", "exposure_ms", "light") if name in file.metadata}
    told = {"path": str(file.path.resolve()), "pixels": file.describe(), "pixels_sha256": digest}
    return told | ({"array": file.array} if file.array else {}) | ({"taken": taken} if taken else {})


def prepared_record(job: Job) -> dict[str, list[Marks]]:
    """Return what tells a job's measurement, and its PSFs with their places, from others."""
    calibration, geometry = job.calibration, job.calibration.geometry
    lengths = np.array([geometry.pixel_pitch_um, geometry.diffuser_distance_mm], np.float64)
    measured = (job.measurement, *(() if job.valid is None else (job.valid,)))
    of_psfs = (calibration.psfs, calibration.source_positions_um, lengths)
    return {MEASUREMENT: [marks_of(one) for one in measured], PSFS: [marks_of(one) for one in of_psfs]}


def dark_record(dark: Dark) -> dict[str, Any]:
    """Return a dark level's means, counts, and where it comes from."""
    values = {
        name: float(np.mean(value))
        for name, value in (("image_counts", dark.image), ("psf_counts", dark.psf))
    }
    return {**values, "from": dark.reason}


def slices_record(slices: tuple[slice, slice]) -> dict[str, int]:
    """Return a window of rows and columns, pixels."""
    rows, columns = slices
    return {
        "top": rows.start,
        "left": columns.start,
        "height": rows.stop - rows.start,
        "width": columns.stop - columns.start,
    }
