"""A reconstruction, from a photograph or from patterned light: what goes in, progress, result, verdict."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from instrument.files.errors import BenchError
from instrument.files.orientation import AS_IT_IS
from instrument.reconstruction.checkpointing import checkpoint_for, require_kept, settle_checkpoint
from instrument.reconstruction.forecast import Forecast
from instrument.reconstruction.foretold import Foretold, Like
from instrument.reconstruction.job import Job
from instrument.reconstruction.options import InputOptions, OutputOptions, SourceOptions
from instrument.reconstruction.patterned import (
    PatternedRequest,
    forecast_patterned,
    prepare_patterned,
    solve_patterned,
)
from instrument.reconstruction.request import PictureRequest, VolumeRequest
from instrument.reconstruction.result_file import Outputs, write_reconstruction, write_volume
from instrument.tasks.task import Desk, Done, Only, saying_what_is_left, task
from instrument.volumes.grid_facts import uneven_steps
from recon.base.declare import option
from recon.reconstruction.choice import Choice
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Stage
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import ITERATIONS
from recon.solvers.base import IterationRecord, StopReason
from recon.verdict.judge import Verdict

PICTURE = Path("reconstruction.tif")
"""Where a picture goes when nothing else is said."""


def reconstruct_photograph(
    desk: Desk, request: PictureRequest | VolumeRequest, outputs: Outputs, output: OutputOptions
) -> Done:
    """Reconstruct, tell, write. ``explain``: only say what with, and what it takes."""
    if output.explain:
        with desk.step("reading"):
            job = request.prepare()
        if request.options.model == "auto":
            with desk.step("choosing"):
                choice = request.explain(job)
            _tell_choice(desk, choice)
        else:
            desk.fact("Model", f"{request.options.model}, as asked for: nothing is chosen")
        return _told(desk, partial(request.forecast, job))
    require_kept(output.checkpoint, request, outputs.files())
    outputs.check(0, overwrite=output.force)
    is_volume = isinstance(request, VolumeRequest)
    with saying_what_is_left(*outputs.files()):
        with desk.step("reading"):
            job = request.prepare()
        planes = len(job.calibration.psfs) if is_volume else 1
        outputs.check(planes * job.measurement.size, overwrite=output.force)
        turned = "" if is_volume else _turned(desk, output)
        _tell_job(
            desk, job, f"{'PSFs' if is_volume else 'PSF'} or image come from the simulated bench{turned}"
        )
        keeper = checkpoint_for(output.checkpoint, job, request, say=desk.warn)
        what = "volume" if is_volume else "picture"
        with desk.interruptible() as cancel, desk.step(what, 100) as advance:
            like = Like.of(job, request.options)
            with Foretold(lambda words: desk.fact("Will take", words), like) as foretold:

                def stage(share: float, what: str) -> None:
                    advance(round(100 * share), note=what)
                    foretold.stage(share, what)

                watch = foretold.watch
                result = request.solve(job, watch=watch, cancel=cancel, keeper=keeper, on_stage=stage)
                foretold.ended(result.stop_reasons)
        _tell(desk, result)
        with desk.step("writing"):
            if is_volume:
                write_volume(outputs, result, job)
            else:
                _write_picture(outputs, result, job, int(output.rotate_deg))
        if is_volume and (steps := uneven_steps(result.grid.z_um)):
            desk.say(f"{'Planes':<12}{steps} Each plane's depth is in {outputs.record.name}.")
        for name, text in settle_checkpoint(keeper, result.stop_reasons).items():
            desk.fact(name, text)
    return _ended(outputs, result, what)


def _told(desk: Desk, forecast: Callable[[Stage], Forecast]) -> Done:
    """Say what time and memory it takes, by its first iterations."""
    with desk.step("the first iterations", 100) as advance:
        told = forecast(lambda share, what: advance(round(100 * share), note=what))
    desk.fact("Will take", str(told))
    return Done()


@dataclass(frozen=True, kw_only=True)
class PatternedRuns:
    """What was photographed in patterned light."""

    run: Path = option(
        help="The run of an illumination plan, the scene in place.",
        metavar="RUN",
        positional=True,
        group="Input",
    )


@task(subject="patterned picture", out=Path("patterned.tif"), needed=("patterned", "calibration"))
def patterned(
    desk: Desk,
    runs: PatternedRuns,
    source: Annotated[SourceOptions, Only("patterned", "calibration")],
    inputs: Annotated[InputOptions, Only("crop", "binning", "erasures", "mosaic", "noise")],
    options: ReconstructionOptions,
    output: Annotated[OutputOptions, Only("out", "rotate_deg", "figure", "checkpoint", "explain", "force")],
) -> Done:
    """Reconstruct one picture of a scene that was lit by patterns in turn (Kuo 2020, Section 8.2)."""
    if source.patterned is None or source.calibration is None:
        raise BenchError(
            "--patterned needs a run and a calibration: "
            "diffuserbench reconstruct RUN --patterned SHEET --calibration FOLDER"
        )
    request = PatternedRequest(
        run=runs.run,
        sheet=source.patterned,
        calibration=source.calibration,
        inputs=inputs,
        options=options,
    )
    return reconstruct_patterns(desk, request, Outputs.named(output.out or PICTURE, output.figure), output)


def reconstruct_patterns(
    desk: Desk, request: PatternedRequest, outputs: Outputs, output: OutputOptions
) -> Done:
    """Reconstruct the patterns, then the picture; tell, write. ``explain``: only say what it takes."""
    if output.explain:
        return _explain_patterns(desk, request)
    require_kept(output.checkpoint, request, outputs.files())
    outputs.check(0, overwrite=output.force)
    with saying_what_is_left(*outputs.files()):
        with desk.step("patterns") as advance:
            prepared = prepare_patterned(request, advance)
        job = prepared.job
        outputs.check(job.measurement.size, overwrite=output.force)
        _tell_job(desk, job, f"calibration or frames come from the simulated bench{_turned(desk, output)}")
        keeper = checkpoint_for(output.checkpoint, job, request, prepared.measurement, say=desk.warn)
        with (
            desk.interruptible() as cancel,
            desk.step("picture", request.options.iterations or ITERATIONS) as advance,
        ):

            def show(record: IterationRecord) -> None:
                advance(record.iteration, note=f"change {record.change:.1e}")

            result = solve_patterned(prepared, watch=show, cancel=cancel, keeper=keeper)
        _tell(desk, result)
        _write_picture(outputs, result, job, int(output.rotate_deg))
        for name, text in settle_checkpoint(keeper, result.stop_reasons).items():
            desk.fact(name, text)
    return _ended(outputs, result, "picture")


def _explain_patterns(desk: Desk, request: PatternedRequest) -> Done:
    """Reconstruct the patterns, and say what they and the picture take."""
    with desk.step("patterns") as advance:
        prepared = prepare_patterned(request, advance)
    return _told(desk, partial(forecast_patterned, prepared))


def _tell_choice(desk: Desk, choice: Choice) -> None:
    """Print what was chosen and why, and what one step up and down would cost."""
    for line in choice.lines():
        desk.say(line)
    desk.say(
        f"{'Chosen in':<12}{choice.seconds:.1f} s; --choose NAME=VALUE overrules any of it, --tolerance and "
        "--iterations the end"
    )


def _tell_verdict(desk: Desk, verdict: Verdict | None) -> None:
    """Print the verdict, one sentence a line; nothing where none was asked for."""
    for index, sentence in enumerate(verdict.sentences if verdict is not None else ()):
        desk.say(f"{'Verdict' if not index else '':<12}{sentence}")


def _turned(desk: Desk, output: OutputOptions) -> str:
    """Say how a picture of the simulated bench stands, which turns nothing: as on the sensor."""
    upside_down = output.rotate_deg == "0" and desk.seen("results") == AS_IT_IS
    return ", where pictures stand upside down: --rotate 180 turns them" if upside_down else ""


def _tell_job(desk: Desk, job: Job, simulated: str) -> None:
    for name, text in job.notes.items():
        desk.say(f"{name:<12}{text}")
    if job.simulated:
        desk.say(f"SIMULATED   {simulated}")
    for warning in job.warnings:
        desk.warn(f"Warning: {warning}")


def _tell(desk: Desk, result: Reconstruction) -> None:
    weight = "" if result.tau is None else f", tau {result.tau:.3g}"
    if result.choice is not None:
        for line in result.choice.lines(steps=False):
            desk.say(line)
    else:
        desk.say(f"{'Model':<12}{result.model}: {result.reason}")
    if result.refinement is not None:
        desk.say(f"{'Refined PSF':<12}{result.refinement}")
    desk.say(f"{'Method':<12}{result.solver}, prior {result.prior}{weight}")
    if chosen := result.provenance.get("weight"):
        desk.say(f"{'Weight':<12}{chosen}")
    if memory := result.provenance.get("memory"):
        desk.say(f"{'Memory':<12}{memory}")
    _tell_end(desk, result)
    _tell_verdict(desk, result.verdict)
    if (found := result.uncertainty) is not None:
        for index, sentence in enumerate(found.sentences):
            desk.say(f"{'Uncertainty' if not index else 'Points':<12}{sentence}")
    for warning in result.warnings:
        desk.warn(f"Warning: {warning}")


def _tell_end(desk: Desk, result: Reconstruction) -> None:
    count = _iterations(result)
    if not count:
        desk.say(f"{'Done':<12}in one step, {result.seconds:.1f} s")
        return
    each = f"{result.seconds / count * 1e3:.0f} ms each"
    desk.say(
        f"{'Stopped':<12}after {count} iterations, {result.seconds:.1f} s ({each}): {result.stop_reasons[0]}"
    )


def _iterations(result: Reconstruction) -> int:
    return max(len(history) for history in result.histories)


def _write_picture(outputs: Outputs, result: Reconstruction, job: Job, rotate_deg: int) -> None:
    write_reconstruction(outputs, result, job, rotate_deg=rotate_deg)
    if outputs.figure is not None:
        from instrument.reconstruction.result_figures import (
            write_figure,  # matplotlib, only where it is wanted
        )

        write_figure(outputs.figure, result, job, rotate_deg=rotate_deg)


def _ended(outputs: Outputs, result: Reconstruction, what: str) -> Done:
    kept = ""
    if StopReason.CANCELLED in result.stop_reasons:
        kept = f"Interrupted after {_iterations(result)} iterations: this is the {what} so far."
    return Done(tuple(outputs.written(result)), kept=kept)
