"""A stored volume's photograph and PSFs, read and brought together again as they were for it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from instrument.files.errors import FileError
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.request import READ_WITH, volume_job
from instrument.reconstruction.stored_result import StoredResult
from recon.base.noise import NoiseModel
from recon.reconstruction.measurement import Measurement
from recon.types import Calibration

_PATHS = ("dark", "erasures")
_WORDS = ("auto", "none", "saturated")


def made_of(result: StoredResult) -> tuple[Measurement, Calibration]:
    """Return the photograph and the PSFs that a volume was made of.

    Raises FileError where its record does not tell them, they are not there any more, or the photograph is
    another one by now; BenchError and InputError as :func:`~instrument.reconstruction.request.volume_job`.
    """
    told = result.record.get("inputs")
    told = told if isinstance(told, Mapping) else {}
    image, psfs, options = told.get("image"), told.get("calibration"), told.get(READ_WITH)
    if not (isinstance(image, Mapping) and isinstance(psfs, str) and isinstance(options, Mapping)):
        raise FileError(
            result.path,
            "does not tell of which photograph and PSFs it was made, and how these were read.",
            "Give the volume as reconstruct wrote it, its .json beside it; one of a version before 2026-12 "
            "is to be reconstructed again.",
        )
    inputs = _inputs_of(result.path, options)
    job = volume_job(Path(psfs), Path(str(image.get("path"))), inputs)
    if job.provenance["image"]["pixels_sha256"] != image.get("pixels_sha256"):
        raise FileError(
            Path(str(image["path"])),
            f"is not the photograph any more that {result.path} was made of: its pixels differ.",
            "Put the photograph back, or reconstruct this one.",
        )
    return job.as_measurement(inputs.noise), job.calibration


def _inputs_of(path: Path, told: Mapping[str, Any]) -> InputOptions:
    """Return options as :func:`recon.base.declare.record` told them."""
    values = dict(told)
    try:
        if isinstance(crop := values.get("crop"), Mapping):
            values["crop"] = Crop(**crop)
        if isinstance(noise := values.get("noise"), Mapping):
            values["noise"] = NoiseModel(**noise)
        for name in _PATHS:
            if isinstance(value := values.get(name), str) and value not in _WORDS:
                values[name] = Path(value)
        return InputOptions(**values)
    except TypeError as error:
        raise FileError(path, f"has a record of other options than this version knows: {error}.") from error
