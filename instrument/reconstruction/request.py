"""What a reconstruction is asked for, as data: the command line, the window and scripts fill in the same."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.calibration_file import is_calibration
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile, read_image, read_stack
from instrument.reconstruction.defects import mended_stack
from instrument.reconstruction.forecast import Forecast, forecast
from instrument.reconstruction.job import (
    OF_A_FILM,
    Job,
    job_from_calibration,
    job_from_files,
    job_with,
    mended_note,
    prepared_record,
)
from instrument.reconstruction.mosaic import pattern_of
from instrument.reconstruction.options import InputOptions, SourceOptions
from instrument.reconstruction.preparation import darkest_block
from instrument.reconstruction.straightened import straightened
from instrument.runs.run_files import STATE
from instrument.volumes.grid_facts import numbers
from recon.arrays import Float32Array, Float64Array
from recon.base.checks import require_noise, select_psf
from recon.base.declare import record
from recon.camera.camera_model import ModelName, members_of_depths
from recon.camera.grid import depth_in_words
from recon.camera.refocus_field import at_depth
from recon.reconstruction.choice import Choice
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.psf_refinement import refined
from recon.reconstruction.reconstruct import reconstruct, require_two_images
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection import choose
from recon.reconstruction.solvers import SOLVERS, volume_priors
from recon.solvers.base import IterationRecord, Keeper
from recon.types import Calibration, Geometry

READ_WITH, PREPARED, PSF_STACK = "options", "prepared", "psf_stack"
"""What of a volume's recorded inputs tells how they were read, what came of them, and of PSFs from files."""
Watch = Callable[[IterationRecord, Callable[[], Float32Array]], object]
"""Called after each iteration with its record and what makes the present picture or volume."""


def _require_choice(asked: str, model: ModelName) -> None:
    """Refuse to explain or overrule what is not chosen; BenchError says which option prevents it."""
    if model != "auto":
        raise BenchError(
            f"{asked} is about everything that --model auto chooses, which it does not with --model {model}. "
            "Leave one of the two out."
        )


@dataclass(frozen=True, kw_only=True)
class _Request:
    """What pictures and volumes have in common."""

    image: Path | ImageFile
    """The photograph."""
    inputs: InputOptions = field(default_factory=InputOptions)
    """How it becomes a measurement, and what it is explained with a camera."""
    options: ReconstructionOptions = field(default_factory=ReconstructionOptions)

    @property
    def file(self) -> Path:
        """Where the photograph lies; of one that is no file what it is called."""
        return self.image.path if isinstance(self.image, ImageFile) else self.image

    def solve(
        self,
        job: Job,
        *,
        watch: Watch | None = None,
        cancel: threading.Event | None = None,
        keeper: Keeper | None = None,
        on_stage: Stage | None = None,
    ) -> Reconstruction:
        """Reconstruct what ``prepare`` returned.

        Raises InputError when the input does not allow it.
        """
        measurement = self._measurement(job)
        return reconstruct(
            measurement,
            job.calibration,
            self.options,
            on_progress=watch,
            cancel=cancel,
            keeper=keeper,
            on_stage=on_stage,
        )

    def explain(self, job: Job) -> Choice:
        """Say what the model ``"auto"`` would choose, and why; errors as :meth:`solve`.

        Raises BenchError where it would not be asked for all of it.
        """
        _require_choice("--explain", self.options.model)
        problem = Problem.of(self._measurement(job), job.calibration, self.options)
        require_two_images(problem)
        choice = choose(refined(problem)[0] if self.options.refine_psf else problem).choice
        assert choice is not None  # of the model "auto"
        return choice

    def forecast(self, job: Job, on_stage: Stage | None = None) -> Forecast:
        """Say what time and memory it will take, by its first iterations; errors as :meth:`solve`."""
        return forecast(self._measurement(job), job.calibration, self.options, on_stage)

    def _measurement(self, job: Job) -> Measurement:
        """Return a job's photograph with what is known of it."""
        return job.as_measurement(self.inputs.noise)


@dataclass(frozen=True, kw_only=True)
class PictureRequest(_Request):
    """A picture of one depth, from a photograph and either a PSF file or a calibration."""

    psf: Path | None = None
    calibration: Path | None = None
    """One of the two."""

    def prepare(self) -> Job:
        """Read the files and bring them together; the options are checked first.

        Raises InputError when an option cannot be; FileError or BenchError when a file cannot be used, or the
        files do not belong together.
        """
        options, inputs = self.options, self.inputs
        _require_known(inputs, options)
        rules = (options.iterations, options.time_s, options.tolerance, options.stop_at_noise or None)
        one_step = options.solver != "auto" and SOLVERS.named(options.solver).one_step
        if one_step and rules != (None, None, None, None):
            raise BenchError(
                f"{options.solver} is one shot: --iterations, --time, --tolerance and --stop-at-noise do not "
                "apply to it."
            )
        if self.calibration is not None and self.psf is None:
            job = job_from_calibration(self.calibration, self.image, inputs)
        elif self.psf is not None and self.calibration is None:
            job = job_from_files(self.psf, self.image, inputs)
        else:
            raise BenchError("Give either --psf FILE or --calibration FOLDER (one of them).")
        return job if options.z_um is None else refocused(job, options.z_um, beside=options.refine_psf)

    def _measurement(self, job: Job) -> Measurement:
        """Return the photograph; refused for a calibration of several depths without one of them."""
        positions, z_um = job.calibration.source_positions_um, self.options.z_um
        if z_um is None and len(members_of_depths(positions)) > 1:
            select_psf(job.calibration, z_um)  # which says what there is
        return super()._measurement(job)


@dataclass(frozen=True, kw_only=True)
class VolumeRequest(_Request):
    """A volume, from a photograph and PSFs at several depths."""

    psfs: Path
    """As :func:`volume_job`."""

    def prepare(self) -> Job:
        """Read the files and bring them together; errors as :meth:`PictureRequest.prepare`."""
        _require_known(self.inputs, self.options)
        prior, known = self.options.prior or "tv", volume_priors()
        if isinstance(prior, str) and prior not in known:
            raise BenchError(f"--prior {prior} is not for volumes; choose one of {', '.join(known)}.")
        job = volume_job(self.psfs, self.image, self.inputs)
        read_with = record(
            replace(
                self.inputs, dark=_whole_name(self.inputs.dark), erasures=_whole_name(self.inputs.erasures)
            )
        )
        made = {READ_WITH: read_with, PREPARED: prepared_record(job)}
        return replace(job, provenance={**job.provenance, **made})


def _whole_name(choice: Any) -> Any:
    """Return a file's whole name, which tells it in any folder; any other choice as it is."""
    if isinstance(choice, ImageFile):
        choice = Path(f"{choice.path}::{choice.array}") if choice.array else choice.path
    return choice.resolve() if isinstance(choice, Path) else choice


def request_of(
    source: SourceOptions, inputs: InputOptions, options: ReconstructionOptions
) -> PictureRequest | VolumeRequest:
    """Return what a photograph is to be made into: a volume where PSFs of several depths are given.

    Raises BenchError when there is no photograph.
    """
    if source.image is None:
        raise BenchError("Give a photograph with --image FILE, or a recording: RUN --video.")
    if source.volume is not None:
        return VolumeRequest(image=source.image, psfs=source.volume, inputs=inputs, options=options)
    return PictureRequest(
        image=source.image,
        psf=source.psf,
        calibration=source.calibration,
        inputs=inputs,
        options=options,
    )


def _require_known(inputs: InputOptions, options: ReconstructionOptions) -> None:
    """Check what can be checked before any file is read; InputError or BenchError says what is wrong."""
    require_noise(None if isinstance(inputs.noise, str) else inputs.noise)
    if options.positive_background and options.estimate_background is False:
        raise BenchError("--positive-background and --no-background exclude each other.")
    if options.choose is not None:
        _require_choice("--choose", options.model)


def volume_job(psfs: Path | ImageFile, image: Path | ImageFile, inputs: InputOptions) -> Job:
    """Prepare a photograph and PSFs at several depths.

    ``psfs``: a calibration folder or the run it lies in, or a stack as
    :func:`~instrument.files.images.read_stack` takes it (the photograph may lie there too), whose order the
    job's notes and record tell. Its depths, where all are above zero, are taken for distances from the
    diffuser. Integer PSFs lose their darkest level; float ones are taken to be free of any offset. ``image``
    and ``inputs``: as :func:`~instrument.reconstruction.job.job_from_calibration`.

    Raises FileError or BenchError.
    """
    if not isinstance(psfs, ImageFile):
        if psfs.is_dir() and (is_calibration(psfs) or (psfs / STATE).is_file()):  # or the run it was made in
            if (inputs.pixel_um, inputs.distance_mm) != (None, None):
                raise BenchError(
                    f"--pixel-um and --distance-mm are for PSFs that are files: the calibration {psfs} says "
                    "its own. Leave them out."
                )
            return job_from_calibration(psfs, image, inputs)
        own = image.path if isinstance(image, ImageFile) else image
        psfs = read_stack(psfs, leave_out=own)
    if coded := inputs.srgb in ("psf", "both"):
        psfs = straightened(psfs)
    image = read_image(image, holes=True, several=OF_A_FILM)
    mends = pattern_of(inputs.mosaic, image) is None and inputs.erasures != "none"
    stack, n_mended = mended_stack(psfs.pixels) if mends else (psfs.pixels, 0)
    pixels = stack.astype(np.float32)
    if stack.dtype.kind == "u":
        pixels = np.maximum(pixels - min(darkest_block(p) for p in pixels), 0)
    channels = pixels[:, None] if pixels.ndim == 3 else np.moveaxis(pixels, -1, 1)
    places_um, said = _places_um(psfs)
    pitch_um = inputs.pixel_um
    if (
        pitch_um is None
        and (told := numbers(psfs.metadata.get("pixel_pitch_um"), ())) is not None
        and told > 0
    ):
        pitch_um = float(told)
        said = "; ".join(filter(None, (said, f"pixels of {pitch_um:g} um as it says")))
    calibration = Calibration(
        np.ascontiguousarray(channels),
        places_um,
        geometry=Geometry(pitch_um, inputs.distance_mm),
        provenance={"psfs": str(psfs.path), "simulated": psfs.is_simulated},
    )
    job = job_with(calibration, psfs.path, image, inputs, straight=coded)
    words = "; ".join(filter(None, (*psfs.notes, said, *mended_note(n_mended))))
    return replace(
        job,
        notes={**job.notes, **({"PSFs": words} if words else {})},
        provenance={
            **job.provenance,
            PSF_STACK: {**psfs.metadata, **({"array": psfs.array} if psfs.array else {})},
        },
    )


def _places_um(psfs: ImageFile) -> tuple[Float64Array, str]:
    """Return where the sources of a stack's PSFs were, (n, 3), NaN for what is not known; and what to say."""
    places_um = np.full((len(psfs.pixels), 3), np.nan)
    if not psfs.metadata.get("depths_um"):
        return places_um, ""
    depths_um = numbers(psfs.metadata["depths_um"], (len(places_um),))
    if depths_um is None or depths_um.min() <= 0:
        return places_um, "not all above 0: taken for no distances from the diffuser"
    if len(np.unique(depths_um)) < len(depths_um):
        return places_um, "two are the same: taken for no distances from the diffuser"
    places_um[:, 2] = depths_um
    return places_um, "taken for distances from the diffuser"


def refocused(job: Job, z_um: float, *, beside: bool = False) -> Job:
    """Return the job with a PSF for a depth that its calibration does not contain, and a note that says so.

    With ``beside`` the calibrated depths stay beside it, for a fit of the depth. What could not be brought
    there stays as it is, and a note says so.

    Raises InputError as :func:`recon.camera.refocus_field.at_depth`.
    """
    calibration, made = at_depth(job.calibration, z_um)
    if made is None:
        said = [job.notes.get("PSF"), calibration.provenance.get("not_refocused")]
        return replace(job, notes={**job.notes, "PSF": ", ".join(filter(None, said))}) if said[1] else job
    if beside and len(members_of_depths(job.calibration.source_positions_um)) > 1:
        own = (job.calibration, calibration)
        calibration = replace(
            calibration,
            psfs=np.concatenate([c.psfs for c in own]),
            source_positions_um=np.concatenate([c.source_positions_um for c in own]),
        )
    return replace(
        job,
        calibration=calibration,
        notes={**job.notes, "PSF": f"refocused to {depth_in_words(z_um)}: {made}"},
        provenance={**job.provenance, "refocused": made.to_json()},
    )
