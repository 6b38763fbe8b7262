"""A stored volume's photograph and PSFs, read and brought together again as they were for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from instrument.files.atomic import protect
from instrument.files.errors import FileError
from instrument.files.record import value_of
from instrument.reconstruction.job import MEASUREMENT, PSFS, prepared_record
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import PREPARED, PSF_STACK, READ_WITH, volume_job
from instrument.reconstruction.stored_result import StoredResult
from recon.base.declare import require, with_overrides
from recon.base.marks import Likeness, likeness
from recon.base.noise import NoiseModel
from recon.reconstruction.measurement import Measurement
from recon.types import Calibration


class MadeOf(NamedTuple):
    """What a volume was made of, and what is doubtful about that, in a sentence or empty."""

    measurement: Measurement
    calibration: Calibration
    doubt: str


def can_be_fitted(result: StoredResult) -> bool:
    """Whether points of a volume can be fitted, as far as its record tells: of one PSF a depth, and grey."""
    grey = result.volume is not None and (result.volume.n_channels == 1 or _is_merged(result))
    return grey and result.record.get("model") == "convolution" and _tells(result)


def _tells(result: StoredResult) -> bool:
    """Whether a volume's record names the photograph and the PSFs it was made of, and how they were read."""
    told = _inputs_of(result)
    kinds = {"image": Mapping, "calibration": str, READ_WITH: Mapping}
    return all(isinstance(told.get(name), kind) for name, kind in kinds.items())


def _is_merged(result: StoredResult) -> bool:
    """Whether a volume's channels were reconstructed as one."""
    found: Any = result.record
    for name in ("provenance", "auto", "channels_merged"):
        found = found.get(name) if isinstance(found, Mapping) else None
    return found is True


def made_of(result: StoredResult) -> MadeOf:
    """Return the photograph and the PSFs that a volume was made of.

    Files that are not where they were are looked for beside the volume. Raises FileError where its record
    does not tell them, they are not there any more, or are others by now; BenchError and InputError as
    :func:`~instrument.reconstruction.request.volume_job`.
    """
    if not _tells(result):
        raise FileError(
            result.path,
            "does not tell of which photograph and PSFs it was made, and how these were read.",
            "Give the volume as reconstruct wrote it, its .json beside it; one of a version before 2026-12 "
            "is to be reconstructed again.",
        )
    told = _inputs_of(result)
    inputs = _options_of(result.path, told[READ_WITH])
    image = _there(_named(told["image"].get("path"), told["image"]), result.path)
    psfs = _there(_named(told["calibration"], told.get(PSF_STACK)), result.path)
    read = (image, psfs, inputs.dark, inputs.erasures)
    protect(*(file for file in read if isinstance(file, Path)))
    job = volume_job(psfs, image, inputs)
    pixels, then = told["image"].get("pixels_sha256"), told.get(PREPARED)
    then, now = then if isinstance(then, Mapping) else {}, prepared_record(job)
    is_same = pixels == job.provenance["image"]["pixels_sha256"]
    alike = {
        "photograph": (Likeness.SAME if is_same else Likeness.OTHER)
        if isinstance(pixels, str)
        else Likeness.UNKNOWN,
        "PSFs": likeness(then.get(PSFS), now[PSFS]),
        "dark frame, background and mask": likeness(then.get(MEASUREMENT), now[MEASUREMENT]),
    }
    if alike["photograph"] is Likeness.OTHER:
        raise FileError(
            image,
            f"is not the photograph any more that {result.path} was made of: its pixels differ.",
            "Put the photograph back, or reconstruct this one.",
        )
    if alike["PSFs"] is Likeness.OTHER:
        raise FileError(
            psfs,
            f"holds other PSFs than those that {result.path} was made of.",
            "Put those back, or reconstruct the volume again.",
        )
    if alike["dark frame, background and mask"] is Likeness.OTHER:
        cause = "its dark frame, the calibration's background or the mask of --erasures has changed since"
        if alike["photograph"] is Likeness.UNKNOWN:
            cause += ", or it is another photograph"
        raise FileError(
            result.path,
            f"was made of other numbers than what is left of its photograph now: {cause}.",
            "Put back what changed, or reconstruct the volume again.",
        )
    measurement, calibration = job.as_measurement(inputs.noise), job.calibration
    if _is_merged(result):
        measurement, calibration = _in_grey(measurement, calibration)
    return MadeOf(measurement, calibration, _doubt(alike))


def _doubt(alike: Mapping[str, Likeness]) -> str:
    """Say what of a volume's inputs its record does not tell, or not to the last bit; else nothing."""
    of = {kind: ", ".join(what for what, known in alike.items() if known is kind) for kind in Likeness}
    said = []
    if unknown := of[Likeness.UNKNOWN]:
        said.append(
            f"the volume's record does not tell its {unknown} from others, as one of a version before "
            "2026-12: whether they have changed since was not checked."
        )
    if as_near := of[Likeness.ALIKE]:
        said.append(
            f"its record does not tell whether its {as_near} are those of then to the last bit: changes by "
            "less than a hundred-thousandth were not looked for."
        )
    if near := of[Likeness.NEAR]:
        said.append(
            f"its {near} are not to the last bit those of then: rounded otherwise by another processor or "
            "version, or changed by less than a hundred-thousandth, which is not told from that."
        )
    return " ".join(said)


def _in_grey(measurement: Measurement, calibration: Calibration) -> tuple[Measurement, Calibration]:
    """Return a photograph's channels added up, as points' light is told, and PSFs of their mean."""
    image = np.asarray(measurement.image)
    if image.ndim == 2:
        return measurement, calibration
    noise, n = measurement.noise, image.shape[2]
    if isinstance(noise, NoiseModel):
        noise = replace(noise, read_noise=noise.read_noise * n**0.5)
    elif noise is not None:
        noise = noise * n**0.5
    erased = measurement.erasures
    if erased is not None and np.ndim(erased) == 3:
        erased = np.asarray(erased).any(axis=2)
    grey = replace(measurement, image=image.sum(axis=2), noise=noise, erasures=erased)
    return grey, replace(calibration, psfs=calibration.psfs.mean(axis=1, keepdims=True), background=None)


def _inputs_of(result: StoredResult) -> Mapping[str, Any]:
    """Return what a record tells of a volume's inputs; nothing where it is another kind of record."""
    told = result.record.get("inputs")
    return told if isinstance(told, Mapping) else {}


def _options_of(path: Path, told: Mapping[str, Any]) -> InputOptions:
    """Return options as :func:`recon.base.declare.record` told them, their files found again."""
    unknown: dict[str, Any] = {}
    try:
        options = value_of(InputOptions, told, unknown)
        require(options)
        if unknown:
            raise ValueError(f"{', '.join(unknown)} is not known")
    except (LookupError, TypeError, ValueError, AttributeError) as error:  # InputError among them
        raise FileError(
            path,
            f"has a record of options that this version does not know: {str(error).rstrip('.')}.",
            "Reconstruct the volume again.",
        ) from error
    files = {name: getattr(options, name) for name in ("dark", "erasures")}
    found = {name: _there(file, path) for name, file in files.items() if isinstance(file, Path)}
    return with_overrides(options, found)


def _named(file: object, told: object) -> Path:
    """Return a file, with the name of its array (``FILE::NAME``) where that is told."""
    array = told.get("array") if isinstance(told, Mapping) else None
    return Path(f"{file}::{array}" if isinstance(array, str) else str(file))


def _there(recorded: Path, volume: Path) -> Path:
    """Return a file or folder where it was, else of its name beside the volume."""
    if recorded.exists():
        return recorded
    file, sign, array = str(recorded).partition("::")
    own = Path(file)
    found = next((path for path in (own, volume.absolute().with_name(own.name)) if path.exists()), None)
    if found is None:
        raise FileError(
            own,
            f"there is no such file any more, and none of its name beside {volume}, which was made of it.",
            "Put it back, or a copy beside the volume.",
        )
    return Path(f"{found}{sign}{array}")
