"""What terminal and window ask for, from declared options to the request that is carried out."""

from __future__ import annotations

from instrument.files.errors import BenchError
from instrument.reconstruction.options import InputOptions, SourceOptions
from instrument.reconstruction.request import PictureRequest, Settings, VolumeRequest
from recon.reconstruction.options import ReconstructionOptions


def settings_of(inputs: InputOptions, options: ReconstructionOptions) -> Settings:
    """Return what pictures, volumes and videos are all asked for."""
    return Settings(
        model=options.model,
        dark=inputs.dark,
        crop=inputs.crop,
        binning=inputs.binning,
        erasures=inputs.erasures,
        noise=inputs.noise,
        prior=None if options.prior is None else str(options.prior),
        tau=options.tau,
        iterations=options.iterations,
        time_s=options.time_s,
        tolerance=options.tolerance,
        stop_at_noise=options.stop_at_noise,
        mosaic=inputs.mosaic,
        wishes=options.choose,
        precision=None if options.precision == "auto" else options.precision,
    )


def request_of(
    source: SourceOptions, inputs: InputOptions, options: ReconstructionOptions
) -> PictureRequest | VolumeRequest:
    """Return what a photograph is to be made into: a volume where PSFs of several depths are given.

    Raises
    ------
    BenchError
        When there is no photograph.
    """
    if source.image is None:
        raise BenchError("Give a photograph: --image FILE.")
    settings = settings_of(inputs, options)
    if source.volume is not None:
        return VolumeRequest(
            image=source.image,
            psfs=source.volume,
            estimate_background=options.estimate_background,
            positive_background=options.positive_background,
            scratch=options.scratch,
            memory_gib=options.memory_gib,
            device=options.device,
            settings=settings,
        )
    return PictureRequest(
        image=source.image,
        psf=source.psf,
        calibration=source.calibration,
        z_um=options.z_um,
        method="admm" if options.solver == "auto" else options.solver,
        estimate_background=options.estimate_background,
        positive_background=options.positive_background,
        memory_gib=options.memory_gib,
        device=options.device,
        allow_saturated=inputs.allow_saturated,
        allow_mixed_depth=inputs.allow_mixed_depth,
        settings=settings,
    )
