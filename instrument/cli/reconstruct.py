"""``diffuserbench reconstruct``: from a PSF and a photograph, or a recording, to the scene."""

from __future__ import annotations

from pathlib import Path

from instrument.cli.app import App, examples
from instrument.cli.reconstruct_options import (
    AllowSaturatedOption,
    BackgroundOption,
    BayerOption,
    BinningOption,
    BlockOption,
    CalibrationOption,
    CheckpointOption,
    ChooseOption,
    CropOption,
    DarkOption,
    DeviceOption,
    DistanceOption,
    ErasuresOption,
    ExplainOption,
    FigureOption,
    FilmOption,
    ForceOption,
    FpsOption,
    ImageOption,
    IterationsOption,
    MemoryOption,
    Method,
    MethodOption,
    MixedDepthOption,
    ModelOption,
    NoiseOption,
    OutOption,
    OverTimeOption,
    PatternedOption,
    PositiveBackgroundOption,
    PrecisionOption,
    PriorOption,
    PsfOption,
    RotateOption,
    Rotation,
    RunArgument,
    SchedulerOption,
    ScratchOption,
    StopAtNoiseOption,
    TauOption,
    TimeOption,
    ToleranceOption,
    VideoOption,
    VolumeOption,
    WarmOption,
    WorkersOption,
    parse_settings,
)
from instrument.files.errors import BenchError
from instrument.reconstruction.request import PictureRequest, VolumeRequest, known_device
from instrument.reconstruction.result_file import Outputs

app = App()


@app.command(
    epilog=examples(
        "diffuserbench reconstruct --psf psf.tif --image raw.tif",
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --dark dark.tif --bin 4 --out hand.tif",
        "diffuserbench reconstruct --psf psf.npy --image raw.npy --method fista --prior l1 --time 30",
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --method wiener --tau 0.01",
        "diffuserbench reconstruct --volume psfs/ --image raw.tif --out volume.tif",
        "diffuserbench reconstruct --calibration demo/calibration --image photo.tif --z-mm 30 --rotate 180",
        "diffuserbench reconstruct --volume psfs/ --image raw.tif --prior l1 --checkpoint kept/",
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --bayer RGGB --bin 2",
        "diffuserbench reconstruct --calibration field/ --image photo.tif --model local",
        "diffuserbench reconstruct runs/2026-11-21-recording --video --calibration demo/calibration",
        "diffuserbench reconstruct runs/scene --patterned runs/sheet --calibration demo/calibration",
        "diffuserbench reconstruct --volume field/ --image photo.tif --explain",
        "diffuserbench reconstruct --volume field/ --image photo.tif --choose planes=all",
    )
)
def reconstruct(
    run: RunArgument = None,
    image: ImageOption = None,
    psf: PsfOption = None,
    calibration: CalibrationOption = None,
    volume: VolumeOption = None,
    model: ModelOption = "auto",
    positive_background: PositiveBackgroundOption = False,
    explain: ExplainOption = False,
    choices: ChooseOption = None,
    background: BackgroundOption = None,
    z_mm: DistanceOption = None,
    dark: DarkOption = "auto",
    crop: CropOption = None,
    binning: BinningOption = "auto",
    erasures: ErasuresOption = "saturated",
    bayer: BayerOption = "auto",
    noise: NoiseOption = None,
    scratch: ScratchOption = None,
    memory_gib: MemoryOption = None,
    method: MethodOption = Method.ADMM,
    prior: PriorOption = None,
    tau: TauOption = None,
    iterations: IterationsOption = None,
    time_s: TimeOption = None,
    tolerance: ToleranceOption = None,
    stop_at_noise: StopAtNoiseOption = False,
    checkpoint: CheckpointOption = None,
    out: OutOption = None,
    rotate: RotateOption = Rotation.NONE,
    figure: FigureOption = None,
    device: DeviceOption = "cpu",
    precision: PrecisionOption = "auto",
    force: ForceOption = False,
    allow_saturated: AllowSaturatedOption = False,
    mixed_depth: MixedDepthOption = False,
    patterned: PatternedOption = None,
    video: VideoOption = False,
    warm: WarmOption = None,
    block: BlockOption = None,
    over_time: OverTimeOption = None,
    workers: WorkersOption = None,
    scheduler: SchedulerOption = None,
    fps: FpsOption = None,
    film: FilmOption = True,
) -> None:
    """Reconstruct the scene from a PSF and a photograph: TIFF, PNG, JPEG, BMP or NumPy files from anywhere.

    Both must come from the same camera with the same region of interest and binning, 8 to 16 bit or float,
    grey or colour. Ctrl-C ends the work and keeps the picture so far; a second Ctrl-C gives it up.

    With --patterned, one picture of a scene photographed under one pattern of light after the other.

    With --video, every frame of a recording; an interrupted video is taken up again by the same command.
    """
    settings = parse_settings(
        model=model,
        dark=dark,
        crop=crop,
        binning=binning,
        erasures=erasures,
        noise=noise,
        prior=prior,
        tau=tau,
        iterations=iterations,
        time_s=time_s,
        tolerance=tolerance,
        stop_at_noise=stop_at_noise,
        bayer=bayer,
        choices=choices,
        precision=precision,
    )
    if explain and model != "auto":
        raise BenchError(
            f"--explain says what --model auto chooses; --model {model} leaves nothing to choose."
        )
    if patterned is not None:
        not_patterned = {
            "--video": video,
            "--image": image is not None,
            "--psf": psf is not None,
            "--volume": volume is not None,
            "--model": model != "auto",
            "--explain": explain,
            "--choose": bool(choices),
            "--background/--no-background": background is not None,
            "--positive-background": positive_background,
            "--dark": dark != "auto",
            "--crop": crop is not None,
            "--erasures": erasures != "saturated",
            "--bayer": bayer not in ("auto", "none"),
            "--noise": noise is not None,
            "--scratch": scratch is not None,
            "--memory": memory_gib is not None,
            "--method": method is not Method.ADMM,
            "--time": time_s is not None,
            "--tolerance": tolerance is not None,
            "--stop-at-noise": stop_at_noise,
            "--checkpoint": checkpoint is not None,
            "--figure": figure is not None,
            "--device": device != "cpu",
            "--precision": precision != "auto",
            "--allow-saturated": allow_saturated,
            "--mixed-depth": mixed_depth,
            "--warm": warm is not None,
            "--block": block is not None,
            "--over-time": over_time is not None,
            "--workers": workers is not None,
            "--scheduler": scheduler is not None,
            "--fps": fps is not None,
            "--no-mp4": not film,
        }
        if given := [option for option, is_given in not_patterned.items() if is_given]:
            raise BenchError(f"With --patterned these do not apply: {', '.join(given)}. Leave them out.")
        if run is None or calibration is None:
            raise BenchError(
                "--patterned needs a run and a calibration: "
                "diffuserbench reconstruct RUN --patterned SHEET --calibration FOLDER"
            )
        from instrument.cli.patterned import reconstruct_to_patterned
        from instrument.reconstruction.patterned import PatternedRequest

        reconstruct_to_patterned(
            PatternedRequest(
                run=run,
                sheet=patterned,
                calibration=calibration,
                z_um=None if z_mm is None else 1e3 * z_mm,
                binning=settings.binning or 1,
                prior=prior,
                tau=tau,
                iterations=iterations,
            ),
            Outputs.named(out or Path("reconstruction.tif")),
            rotate_deg=int(rotate),
            force=force,
        )
        return
    videos_only = {
        "RUN": run is not None,
        "--warm": warm is not None,
        "--block": block is not None,
        "--over-time": over_time is not None,
        "--workers": workers is not None,
        "--scheduler": scheduler is not None,
        "--fps": fps is not None,
        "--no-mp4": not film,
    }
    if video:
        no_videos = {
            "--image": image is not None,
            "--volume": volume is not None,
            "--figure": figure is not None,
            "--method": method is not Method.ADMM,
            "--explain": explain,
            "--choose": bool(choices),
            "--positive-background": positive_background,
            "--bayer": bayer not in ("auto", "none"),
            "--checkpoint": checkpoint is not None,
            "--stop-at-noise": stop_at_noise,
            "--scratch": scratch is not None,
            "--memory": memory_gib is not None,
            "--device": device != "cpu",
            "--precision (videos are computed in float32)": precision != "auto",
            "--workers and --scheduler together": workers is not None and scheduler is not None,
        }
        if given := [option for option, is_given in no_videos.items() if is_given]:
            raise BenchError(f"With --video these do not apply: {', '.join(given)}. Leave them out.")
        from instrument.cli.video import reconstruct_to_video
        from instrument.reconstruction.video import VideoRequest
        from recon.streams.joint import OVER_TIME
        from recon.streams.video import WARM_ITERATIONS

        chosen = next((name for name in OVER_TIME if name == over_time), None)
        if over_time is not None and chosen is None:
            raise BenchError(f"--over-time {over_time!r} is not known; choose one of {', '.join(OVER_TIME)}.")
        if chosen is not None and warm is not None:
            raise BenchError("--warm does not apply with --over-time: frames are solved together.")
        if run is None:
            raise BenchError("--video needs a recording: diffuserbench reconstruct RUN --video ...")
        reconstruct_to_video(
            VideoRequest(
                run=run,
                out=out or Path("video.ome.zarr"),
                psf=psf,
                calibration=calibration,
                z_um=None if z_mm is None else 1e3 * z_mm,
                settings=settings,
                rotate_deg=int(rotate),
                fps=fps,
                film=film,
                block=block,
                over_time=chosen,
                estimate_background=background,
                warm_iterations=WARM_ITERATIONS if warm is None else warm,
            ),
            workers=workers,
            scheduler=scheduler,
            force=force,
        )
        return
    if given := [option for option, is_given in videos_only.items() if is_given]:
        raise BenchError(f"{', '.join(given)}: for videos; give --video as well, or leave it out.")
    if image is None:
        raise BenchError("Give a photograph with --image FILE, or a recording: RUN --video.")
    outputs = Outputs.named(out or Path("reconstruction.tif"), figure, volume=volume is not None)
    if volume is not None:
        pictures_only = {
            "--psf": psf is not None,
            "--calibration": calibration is not None,
            "--z-mm": z_mm is not None,
            "--method": method is not Method.ADMM,
            "--rotate": rotate is not Rotation.NONE,
            "--figure": figure is not None,
            "--allow-saturated": allow_saturated,
            "--mixed-depth": mixed_depth,
        }
        if given := [option for option, is_given in pictures_only.items() if is_given]:
            raise BenchError(f"With --volume these do not apply: {', '.join(given)}. Leave them out.")
        from instrument.cli.volume import reconstruct_to_volume

        reconstruct_to_volume(
            VolumeRequest(
                image=image,
                psfs=volume,
                estimate_background=background,
                positive_background=positive_background,
                scratch=scratch,
                memory_gib=memory_gib,
                device=known_device(device),
                settings=settings,
            ),
            outputs,
            checkpoint=checkpoint,
            force=force,
            explain=explain,
        )
        return
    volumes_only = {
        "--positive-background": positive_background,
        "--background/--no-background": background is not None,
        "--scratch": scratch is not None,
        "--memory": memory_gib is not None,
        "--device": device != "cpu",
    }
    for option, is_given in volumes_only.items():
        if is_given:
            raise BenchError(f"{option} is for volumes: give --volume, or leave it out.")
    from instrument.cli.picture import reconstruct_to_picture

    reconstruct_to_picture(
        PictureRequest(
            image=image,
            psf=psf,
            calibration=calibration,
            z_um=None if z_mm is None else 1e3 * z_mm,
            method=method.value,
            allow_saturated=allow_saturated,
            allow_mixed_depth=mixed_depth,
            settings=settings,
        ),
        outputs,
        rotate_deg=int(rotate),
        checkpoint=checkpoint,
        force=force,
        explain=explain,
    )
