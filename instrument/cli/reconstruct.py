"""``diffuserbench reconstruct``: from a PSF and a photograph, or a recording, to the scene."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from instrument.cli.app import App, examples
from instrument.cli.tasks import Terminal, finish
from instrument.files.calibration_file import is_calibration
from instrument.files.errors import BenchError
from instrument.reconstruction.options import InputOptions, OutputOptions, SourceOptions, VideoOptions
from instrument.reconstruction.request import VolumeRequest, request_of
from instrument.reconstruction.result_file import Outputs
from instrument.tasks.task import Given, guarded
from recon.reconstruction.options import ReconstructionOptions

app = App()

_PICTURE = Path("reconstruction.tif")
RunArgument = Annotated[
    Path | None,
    typer.Argument(
        metavar="RUN",
        help="With --video: the recording's folder; with --patterned: the run's.",
        show_default=False,
    ),
]


@dataclass(frozen=True)
class _Asked:
    """Everything that was asked for."""

    source: SourceOptions
    inputs: InputOptions
    options: ReconstructionOptions
    output: OutputOptions
    video: VideoOptions
    given: Given


@app.command(
    epilog=examples(
        "diffuserbench reconstruct --psf psf.tif --image raw.tif --dark dark.tif --bin 4 --out hand.tif",
        "diffuserbench reconstruct --calibration demo/calibration --image photo.tif --z-mm 30 --rotate 180",
        "diffuserbench reconstruct --volume psfs/ --image raw.tif --prior l1 --checkpoint kept/ --out v.tif",
        "diffuserbench reconstruct runs/2026-11-21-recording --video --calibration demo/calibration",
        "diffuserbench reconstruct runs/scene --patterned runs/sheet --calibration demo/calibration",
    )
)
def reconstruct(
    source: SourceOptions,
    inputs: InputOptions,
    options: ReconstructionOptions,
    output: OutputOptions,
    video: VideoOptions,
    given: Given,
    run: RunArgument = None,
) -> None:
    """Reconstruct the scene from a PSF and a photograph: TIFF, PNG, JPEG, BMP or NumPy files from anywhere.

    Both come from one camera with one region of interest and binning, 8 to 16 bit or float, grey or colour.
    Ctrl-C keeps the picture so far, a second one gives it up; the same command goes on with a video.
    """
    asked = _Asked(source, inputs, options, output, video, given)
    if options.choose is not None and options.choose.precision is not None and "precision" in given:
        raise BenchError("--precision and --choose precision=... say the same twice: leave one of them out.")
    if source.patterned is not None:
        _patterned(asked, run)
    elif source.video:
        _video(asked, run)
    elif run is not None:
        photograph = run.is_file() and "image" not in given
        calibration = is_calibration(run) and "calibration" not in given
        raise BenchError(
            f"{run}: no option says what it is for. With --video it is a video's run; else leave it out."
            + (f" A photograph is given by --image {run}, its PSF by --psf FILE." if photograph else "")
            + (f" A calibration is given by --calibration {run}." if calibration else "")
        )
    else:
        _photograph(asked)


def _photograph(asked: _Asked) -> None:
    from instrument.tasks.solving import reconstruct_photograph

    given, source, output = asked.given, asked.source, asked.output
    request = request_of(source, asked.inputs, asked.options)
    is_volume = isinstance(request, VolumeRequest)
    if is_volume:
        given.refuse("--volume", "volume")
    else:
        given.refuse("a picture (give --volume, or --video with a recording)", "picture")
    if source.calibration is not None and (flags := given.flags("allow_saturated", "allow_mixed_depth")):
        raise BenchError(
            f"{' and '.join(flags)}: for a PSF image (--psf); a calibration's PSFs were judged when they "
            f"were measured. Leave {'it' if len(flags) == 1 else 'them'} out."
        )
    out = output.out or _PICTURE
    outputs = Outputs.named(out, output.figure, volume=is_volume, uncertainty=asked.options.uncertainty)
    with guarded({"source": source, "inputs": asked.inputs, "out": out}):  # its own name was not asked before
        finish(reconstruct_photograph(Terminal(), request, outputs, output))


def _video(asked: _Asked, run: Path | None) -> None:
    from instrument.tasks.video import Recording
    from instrument.tasks.video import video as task

    source, output, video = asked.source, asked.output, asked.video
    asked.given.refuse("--video", "video")
    if video.workers is not None and video.scheduler is not None:
        raise BenchError("--workers and --scheduler exclude each other: leave one of them out.")
    if video.over_time is not None and "warm_iterations" in asked.given:
        raise BenchError("--warm does not apply with --over-time: frames are solved together.")
    if run is None:
        raise BenchError("--video needs a recording: diffuserbench reconstruct RUN --video ...")
    finish(task.do(Terminal(), Recording(run=run), source, output, video, asked.inputs, asked.options))


def _patterned(asked: _Asked, run: Path | None) -> None:
    asked.given.refuse("--patterned", "patterned picture")
    if run is None:
        raise BenchError(
            "--patterned needs a run and a calibration: "
            "diffuserbench reconstruct RUN --patterned SHEET --calibration FOLDER"
        )
    from instrument.tasks.solving import PatternedRuns, patterned

    finish(
        patterned.do(
            Terminal(), PatternedRuns(run=run), asked.source, asked.inputs, asked.options, asked.output
        )
    )
