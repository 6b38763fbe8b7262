"""What is asked for in Python: images, arrays or files, brought together as the terminal brings them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from numbers import Real
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from instrument.files.errors import BenchError
from instrument.files.image_folders import images_in
from instrument.files.images import ImageFile, read
from instrument.reconstruction.job import Job, job_from_files, job_with, source_record
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.request import refocused, volume_job
from instrument.runs.run import Run
from instrument.runs.run_files import is_run
from recon.base.checks import as_channels
from recon.base.declare import options_of, require, require_known, with_overrides
from recon.errors import InputError
from recon.reconstruction import reconstruct as one_door
from recon.reconstruction.measurement import MOST_LIGHT, Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.types import Calibration, plain_array

Image = Path | str | ImageFile | Measurement | npt.ArrayLike
Psf = Path | str | ImageFile | Calibration | npt.ArrayLike

_INPUTS = {f.name for f in fields(InputOptions)}
_BRIGHT = 99.9
"""Percentile of a flat field that is taken for full light."""
_FILES_ONLY = _INPUTS - set(one_door.FACTS)
FACTS = tuple(name for name in one_door.FACTS if name not in _INPUTS)
"""What is known of a photograph by arrays, in Python only."""

_OF_FILES = {
    "background": "Of a file the background is taken off by dark=.",
    "patterns": "Patterned light of files is a run's: diffuserbench reconstruct RUN --patterned.",
    "lines": "What rows and columns share in a file is looked for and taken off without it; known offsets "
    "go into a dark frame: dark=.",
}
"""What to do instead where a photograph is a file, by the name of what arrays take."""


@dataclass(frozen=True)
class Asked:
    """A photograph with what is known of it, PSFs, and how to reconstruct."""

    measurement: Measurement
    calibration: Any
    """A Calibration, or an array that the one door takes."""
    options: ReconstructionOptions
    prepared: Job | None
    """Where a file was among them."""

    @classmethod
    def of(cls, image: Any, psf: Any, options: Any, overrides: Mapping[str, Any]) -> Self:
        """Bring them together; errors as :func:`~instrument.notebook.reconstruct.reconstruct`."""
        image, psf = getattr(image, "measurement", image), getattr(psf, "calibration", psf)
        overrides = dict(overrides)
        if (film := recording_of(image)) is not None:
            raise BenchError(
                f"{film.path} is a run of {len(film.records)} frames: diffuserbench reconstruct "
                f"{film.path} --video makes its film (db.forecast tells what that takes); a frame of it is "
                f"db.run({str(film.path)!r}).frame(0)."
            )
        require_known([name for name in overrides if name not in FACTS], ReconstructionOptions, InputOptions)
        if not isinstance(options, ReconstructionOptions | None):
            raise BenchError(
                f"options are db.Options(...), not {type(options).__name__}; single ones are given by name: "
                "prior='l1', warm=result."
            )
        if _is_file(image) or _is_file(psf):
            if about := [name for name in FACTS if name in overrides and name != "vignetting"]:
                of_files = " ".join(_OF_FILES[name] for name in about)
                raise BenchError(
                    f"{' and '.join(about)}: for arrays (db.read(FILE).pixels is one). {of_files}"
                )
            shade = overrides.pop("vignetting", None)
            inputs = inputs_of({name: overrides.pop(name) for name in _INPUTS & set(overrides)})
            options = with_overrides(options or ReconstructionOptions(), overrides)
            job = _job(_opened(image, "photograph"), psf, inputs, options)
            measurement = job.as_measurement(inputs.noise)
            if shade is not None:
                job, measurement = _divided(job, measurement, _opened(shade, "vignetting"), inputs.dark)
            return cls(measurement, job.calibration, options, job)
        if about := sorted(_FILES_ONLY & set(overrides)):
            raise BenchError(
                f"{' and '.join(about)}: for files and images of db.read; arrays are taken as they are. "
                "Leave it out, and do it to the arrays yourself (a dark frame: photograph - dark)."
            )
        _require_one(image, psf)
        for name, given in (("photograph", image), ("PSF", psf)):
            _require_no_alpha(given, name)
        measurement, options = one_door.measured(image, options, overrides)
        return cls(measurement, psf, options, None)

    @property
    def job(self) -> Job:
        """What it is reconstructed from."""
        return self.prepared or _job_of_arrays(self.measurement, self.calibration)


def _divided(job: Job, measurement: Measurement, shade: ImageFile, dark: object) -> tuple[Job, Measurement]:
    """Return a photograph with its relative light, given on the file's pixels, cut and binned as it was.

    What is beyond relative light (:data:`~recon.reconstruction.measurement.MOST_LIGHT`) is a flat field in
    counts, of whatever kind its numbers are: it loses the dark level or frame that was given, and is divided
    by its brightest pixels but for the last thousandth, which hot ones are among.
    """
    assert job.reduction is not None  # of files
    light = replace(job.reduction, dark=0.0).apply(shade.pixels)
    said = ""
    if shade.pixels.dtype.kind == "u" or np.nanpercentile(light, _BRIGHT) > MOST_LIGHT:
        known = dark != "auto"
        light = job.reduction.apply(shade.pixels) if known else light
        full = float(np.nanpercentile(light, _BRIGHT))
        if full <= 0:
            raise BenchError(
                f"The vignetting is a flat field in counts, and at most {100 - _BRIGHT:.1f} % of it lies "
                "above the dark level that was given: expected is a lit, even field."
            )
        light = light / full
        less = "less the dark level given" if known else "its dark level not taken off (dark= gives it)"
        said = f", counts {less} and divided by {full:.4g}"
    if light.shape[:2] != job.measurement.shape[:2]:
        raise BenchError(
            f"The vignetting is {shade.describe()}, and comes to {light.shape[0]} x {light.shape[1]} pixels "
            f"where the photograph comes to {job.measurement.shape[0]} x {job.measurement.shape[1]}: give it "
            "on the photograph's own pixels."
        )
    said = f"divided by the vignetting that was given, {light.min():.3g} to {light.max():.3g}{said}"
    told = {"vignetting": source_record(shade)}
    made = replace(job, notes={**job.notes, "Light": said}, provenance={**job.provenance, **told})
    return made, replace(measurement, vignetting=light)


def recording_of(given: Any) -> Run | None:
    """Return the recording that a run or its folder is; None for a photograph, in a run of its own or not."""
    if isinstance(given, Run):
        return given
    if not isinstance(given, Path | str):
        return None
    folder = Path(given)
    if not is_run(folder) or len(images_in(folder)) == 1:
        return None
    return Run.open(folder)


def _require_one(image: Any, psf: Any) -> None:
    """Raise BenchError where an array has a photograph's size behind an axis that counts photographs."""
    shape, psf_shape = np.shape(image), np.shape(psf)
    if len(shape) == 3 and len(psf_shape) == 2 and shape[:2] != psf_shape == shape[1:]:
        raise BenchError(
            f"The photograph is an array {shape}: {shape[0]} of {shape[1]} x {shape[2]} pixels. Give one of "
            "them: photograph[0]; colours are the last axis: np.moveaxis(photograph, 0, -1)."
        )


def _require_no_alpha(given: Any, name: str) -> None:
    """Raise BenchError where the fourth channel of an array is the same everywhere, as transparency is."""
    if isinstance(given, Measurement | Calibration):
        return
    pixels = plain_array(given)
    if (
        pixels.ndim == 3
        and pixels.shape[-1] == 4
        and pixels.size
        and (fourth := pixels[..., 3]).min() == fourth.max()
    ):
        raise BenchError(
            f"The {name}'s fourth channel is {fourth[0, 0]:g} everywhere: transparency (RGBA), no light. "
            f"Give the colours alone: [..., :3]."
        )


def _is_file(given: object) -> bool:
    return isinstance(given, Path | str | ImageFile)


def _opened(given: Any, name: str) -> ImageFile:
    """Return an image of a file; an array as one, under a name for messages."""
    if isinstance(given, ImageFile):
        return given
    if isinstance(given, Path | str):
        return read(given)
    if isinstance(given, Measurement):
        raise BenchError(
            "A Measurement goes with a Calibration or an array, not with a file: db.read(...).pixels is one."
        )
    pixels = plain_array(given)
    if pixels.dtype.kind not in "uifb" or pixels.ndim < 2:
        raise BenchError(
            f"The {name} is a file, an image of db.read, or an array (height, width) of real numbers, "
            f"not {type(given).__name__}{f' {pixels.dtype} {pixels.shape}' if pixels.ndim else ''}."
        )
    if pixels.dtype not in (np.uint8, np.uint16):
        pixels = pixels.astype(np.float32)
    return ImageFile(Path(f"the {name}, an array"), pixels)


def inputs_of(given: Mapping[str, Any]) -> InputOptions:
    """Return options of files; words are read as the terminal reads them, and numbers in a row as words."""
    declared = {o.name: o.declaration for o in options_of(InputOptions)}
    read: dict[str, Any] = {}
    for name, value in given.items():
        if isinstance(value, str) and value == declared[name].none_word:
            value = None
        if isinstance(value, tuple | list) and all(isinstance(one, Real) for one in value):
            value = ",".join(map(str, value))
        elif name == "dark" and np.ndim(value):
            opened = _opened(value, "dark frame")
            value = opened if value is opened else ImageFile(Path("an array"), opened.pixels)
        parse = declared[name].parse if isinstance(value, str) else None
        try:
            read[name] = value if parse is None else parse(value)
        except InputError as error:
            raise InputError(f"{name}: {error}") from None
    inputs = InputOptions(**read)
    require(inputs)
    return inputs


def _job(image: ImageFile, psf: Any, inputs: InputOptions, options: ReconstructionOptions) -> Job:
    """Bring a photograph and PSFs together."""
    if isinstance(psf, Calibration):
        job = job_with(psf, Path("the calibration"), image, inputs)
    elif isinstance(psf, Path | str) and Path(psf).is_dir():
        job = volume_job(Path(psf), image, inputs)
    else:
        file = _opened(psf, "PSF")
        job = volume_job(file, image, inputs) if file.is_stack else job_from_files(file, image, inputs)
    z_um, beside = options.z_um, options.refine_psf
    return job if z_um is None else refocused(job, z_um, beside=beside)


def _job_of_arrays(image: Any, psf: Any) -> Job:
    """Return what arrays were reconstructed from."""
    pixels = plain_array(image.image if isinstance(image, Measurement) else image).astype(
        np.float32, copy=False
    )
    if not isinstance(psf, Calibration):
        psf = Calibration(as_channels(psf, "PSF")[None], np.full((1, 3), np.nan))
    simulated = bool(psf.provenance.get("simulated"))
    return Job(pixels, psf, {}, provenance={"image": {"path": "an array"}}, simulated=simulated)
