"""What a reconstruction is asked for, as data: the command line, the window and scripts fill in the same."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from instrument.files.errors import BenchError
from instrument.reconstruction.erasures import Choice as ErasuresChoice
from instrument.reconstruction.job import (
    Binning,
    DarkChoice,
    Job,
    NoiseChoice,
    job_from_calibration,
    job_from_files,
    refocused,
    require_distance,
)
from instrument.reconstruction.mosaic import MosaicChoice
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.volume_job import volume_job
from recon.base.checks import select_psf
from recon.base.namespace import DEVICES, Device
from recon.base.options import require_options
from recon.camera.camera_model import MODELS, ModelName, members_of_depths
from recon.reconstruction.choice import Choice
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.overrides import Precision, Wishes
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection import choice_for
from recon.reconstruction.solve import ITERATIONS
from recon.reconstruction.solvers import VOLUME_PRIORS, require_solver
from recon.reconstruction.weights import require_prior
from recon.solvers.base import Keeper
from recon.solvers.stopping import IterationRecord
from recon.types import Calibration

Watch = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]
"""Called after each iteration with its record and what makes the present picture or volume."""


def _require_choice(asked: str, model: ModelName) -> None:
    """Refuse to explain or overrule what is not chosen; BenchError says which option prevents it."""
    if model != "auto":
        raise BenchError(
            f"{asked} is about everything that --model auto chooses, which it does not with --model {model}. "
            "Leave one of the two out."
        )


def known_model(name: str) -> ModelName:
    """Return the camera model of that name; BenchError where there is none."""
    found = next((model for model in MODELS if model == name), None)
    if found is None:
        raise BenchError(f"--model {name!r} is not known; choose one of {', '.join(MODELS)}.")
    return found


def _require_volume_prior(name: str) -> None:
    if name not in VOLUME_PRIORS:
        raise BenchError(f"--prior {name} is not for volumes; choose one of {', '.join(VOLUME_PRIORS)}.")


def known_device(name: str) -> Device:
    """Return where to compute; BenchError where the name is not known."""
    found = next((device for device in DEVICES if device == name), None)
    if found is None:
        raise BenchError(f"--device {name!r} is not known; choose one of {', '.join(DEVICES)}.")
    return found


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """What pictures and volumes are both prepared and solved with.

    Attributes
    ----------
    dark, crop, binning, erasures
        As :func:`instrument.reconstruction.job.job_from_files`.
    model : str
        One of :data:`recon.camera.camera_model.MODELS`.
    prior : str or None
        None: the method's default.
    mosaic : str or None
        Colour mosaic of which the photograph is a raw frame, "auto" for what its metadata say.
    tau, noise, iterations, time_s, tolerance, stop_at_noise
        As :func:`recon.reconstruct`. Without ``iterations`` and ``time_s`` a default count applies.
    wishes : recon.reconstruction.overrides.Wishes or None
        With the model ``"auto"``: choices that are not to be left to the program.
    precision : "float32", "float64" or None
        Of the arithmetic; None: what ``"auto"`` chooses, else float32.
    """

    model: ModelName = "auto"
    dark: DarkChoice = "auto"
    crop: Crop | None = None
    binning: Binning = None
    erasures: ErasuresChoice = "saturated"
    noise: NoiseChoice = None
    prior: str | None = None
    tau: float | None = None
    iterations: int | None = None
    time_s: float | None = None
    tolerance: float | None = None
    stop_at_noise: bool = False
    mosaic: MosaicChoice = "auto"
    wishes: Wishes | None = None
    precision: Precision | None = None

    def require(self, *, z_um: float | None = None) -> None:
        """Check what can be checked before any file is read; InputError or BenchError says what is wrong."""
        if z_um is not None:
            require_distance(z_um)
        require_options(
            iterations=self.iterations,
            time_s=self.time_s,
            tolerance=self.tolerance,
            tau=self.tau,
            noise=None if isinstance(self.noise, str) else self.noise,
        )

    def asked(self, **more: Any) -> ReconstructionOptions:
        """Return what is asked of the reconstruction."""
        return ReconstructionOptions(
            model=self.model,
            prior=self.prior,
            tau=self.tau,
            iterations=self.iterations,
            time_s=self.time_s,
            tolerance=self.tolerance,
            stop_at_noise=self.stop_at_noise,
            choose=self.wishes,
            precision=self.precision or "auto",
            **more,
        )

    @property
    def limit(self) -> int | None:
        """The largest count of iterations: as given, or the default, or none where time is the end."""
        return ITERATIONS if self.iterations is None and self.time_s is None else self.iterations

    def done_share(self, record: IterationRecord) -> float:
        """Return how much of the work is done, 0 to 1: whichever of count and time is nearer to its end."""
        by_count = 0.0 if self.limit is None else record.iteration / self.limit
        by_time = 0.0 if self.time_s is None else record.seconds / self.time_s
        return min(max(by_count, by_time), 1.0)


def _require_one_depth(calibration: Calibration, z_um: float | None) -> None:
    """Refuse a picture of a calibration of several depths without one of them."""
    if z_um is None and len(members_of_depths(calibration.source_positions_um)) > 1:
        select_psf(calibration, z_um)  # which says what there is


def _measured(job: Job, noise: NoiseChoice) -> Measurement:
    """Return a job's photograph with what is known of it."""
    erasures = None if job.valid is None else ~job.valid
    return Measurement(job.measurement, job.binned_noise(noise), erasures=erasures)


@dataclass(frozen=True, slots=True, kw_only=True)
class PictureRequest:
    """A picture of one depth, from a photograph and either a PSF file or a calibration.

    Attributes
    ----------
    image : Path
        The photograph.
    psf, calibration : Path or None
        One of the two.
    z_um : float or None
        Distance of the scene; a PSF is refocused to it.
    method : str
        One of :data:`recon.reconstruction.solvers.SOLVERS`.
    estimate_background, positive_background, memory_gib, device
        As of :class:`VolumeRequest`.
    allow_saturated, allow_mixed_depth : bool
        With ``psf``: as :func:`instrument.reconstruction.job.job_from_files`.
    settings : Settings
    """

    image: Path
    psf: Path | None = None
    calibration: Path | None = None
    z_um: float | None = None
    method: str = "admm"
    estimate_background: bool | None = None
    positive_background: bool = False
    memory_gib: float | None = None
    device: Device = "cpu"
    allow_saturated: bool = False
    allow_mixed_depth: bool = False
    settings: Settings = field(default_factory=Settings)

    @property
    def options(self) -> ReconstructionOptions:
        """What is asked of the reconstruction."""
        return self.settings.asked(
            z_um=self.z_um,
            solver=self.method,
            estimate_background=self.estimate_background,
            positive_background=self.positive_background,
            memory_gib=self.memory_gib,
            device=self.device,
        )

    def prepare(self) -> Job:
        """Read the files and bring them together; the options are checked first.

        Raises
        ------
        InputError
            When an option cannot be.
        FileError, BenchError
            When a file cannot be used, or the files do not belong together.
        """
        given = self.settings
        given.require(z_um=self.z_um)
        require_solver(self.method)
        if self.positive_background and self.estimate_background is False:
            raise BenchError("--positive-background and --no-background exclude each other.")
        if given.prior is not None:
            require_prior(given.prior)
        if given.wishes is not None:
            _require_choice("--choose", given.model)
        rules = (given.iterations, given.time_s, given.tolerance, given.stop_at_noise or None)
        if self.method == "wiener" and rules != (None, None, None, None):
            raise BenchError(
                "wiener is one shot: --iterations, --time, --tolerance and --stop-at-noise do not apply "
                "to it."
            )
        if self.calibration is not None and self.psf is None:
            job = job_from_calibration(
                self.calibration,
                self.image,
                dark=given.dark,
                crop=given.crop,
                binning=given.binning,
                erasures=given.erasures,
                mosaic=given.mosaic,
            )
        elif self.psf is not None and self.calibration is None:
            job = job_from_files(
                self.psf,
                self.image,
                dark=given.dark,
                crop=given.crop,
                binning=given.binning,
                erasures=given.erasures,
                mosaic=given.mosaic,
                allow_saturated=self.allow_saturated,
                allow_mixed_depth=self.allow_mixed_depth,
            )
        else:
            raise BenchError("Give either --psf FILE or --calibration FOLDER (one of them).")
        return job if self.z_um is None else refocused(job, self.z_um)

    def solve(
        self,
        job: Job,
        *,
        watch: Watch | None = None,
        cancel: threading.Event | None = None,
        keeper: Keeper | None = None,
    ) -> Reconstruction:
        """Reconstruct what :meth:`prepare` returned.

        Raises
        ------
        InputError
            When the input does not allow it.
        """
        _require_one_depth(job.calibration, self.z_um)
        return reconstruct(
            _measured(job, self.settings.noise),
            job.calibration,
            self.options,
            on_progress=None if watch is None else lambda record, volume: watch(record, lambda: volume()[0]),
            cancel=cancel,
            keeper=keeper,
        )

    def explain(self, job: Job) -> Choice:
        """Say what the model ``"auto"`` would choose, and why; errors as :meth:`solve`.

        Raises
        ------
        BenchError
            Where it would not be asked for all of it.
        """
        _require_choice("--explain", self.settings.model)
        _require_one_depth(job.calibration, self.z_um)
        return choice_for(Problem.of(_measured(job, self.settings.noise), job.calibration, self.options))

    def share(self, record: IterationRecord) -> float:
        """Return how much of the work is done, 0 to 1."""
        return self.settings.done_share(record)


@dataclass(frozen=True, slots=True, kw_only=True)
class VolumeRequest:
    """A volume, from a photograph and PSFs at several depths.

    Attributes
    ----------
    image : Path
        The photograph.
    psfs : Path
        As :func:`instrument.reconstruction.volume_job.volume_job`.
    positive_background : bool
        One that is nowhere negative.
    estimate_background : bool or None
        Estimate a smooth background as well; None: ``"auto"`` decides, other models do.
    scratch : Path or None
        Folder on a fast disk for what does not fit into memory.
    memory_gib : float or None
        Memory that may be taken; None: what is free.
    device : "cpu" or "gpu"
    settings : Settings
        Its prior must be one of :data:`recon.reconstruction.solvers.VOLUME_PRIORS`.
    """

    image: Path
    psfs: Path
    positive_background: bool = False
    estimate_background: bool | None = None
    scratch: Path | None = None
    memory_gib: float | None = None
    device: Device = "cpu"
    settings: Settings = field(default_factory=Settings)

    @property
    def options(self) -> ReconstructionOptions:
        """What is asked of the reconstruction."""
        return self.settings.asked(
            estimate_background=self.estimate_background,
            positive_background=self.positive_background,
            scratch=self.scratch,
            memory_gib=self.memory_gib,
            device=self.device,
        )

    def prepare(self) -> Job:
        """Read the files and bring them together; errors as :meth:`PictureRequest.prepare`."""
        given = self.settings
        given.require()
        _require_volume_prior(given.prior or "tv")
        if given.wishes is not None:
            _require_choice("--choose", given.model)
        if self.positive_background and self.estimate_background is False:
            raise BenchError("--positive-background and --no-background exclude each other.")
        return volume_job(
            self.psfs,
            self.image,
            dark=given.dark,
            crop=given.crop,
            binning=given.binning,
            erasures=given.erasures,
            mosaic=given.mosaic,
        )

    def solve(
        self,
        job: Job,
        *,
        watch: Watch | None = None,
        cancel: threading.Event | None = None,
        keeper: Keeper | None = None,
    ) -> Reconstruction:
        """Reconstruct what :meth:`prepare` returned; errors as :meth:`PictureRequest.solve`."""
        return reconstruct(
            _measured(job, self.settings.noise),
            job.calibration,
            self.options,
            on_progress=watch,
            cancel=cancel,
            keeper=keeper,
        )

    def explain(self, job: Job) -> Choice:
        """Say what the model ``"auto"`` would choose, and why; errors as :meth:`solve`.

        Raises
        ------
        BenchError
            Where it would not be asked for all of it.
        """
        _require_choice("--explain", self.settings.model)
        return choice_for(Problem.of(_measured(job, self.settings.noise), job.calibration, self.options))

    def share(self, record: IterationRecord) -> float:
        """Return how much of the work is done, 0 to 1."""
        return self.settings.done_share(record)
