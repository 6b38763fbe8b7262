"""From a plan and an open bench to a run: check, make the folder, carry out; resume one that did not end."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from instrument.bench.bench import Bench
from instrument.bench.camera_settings import camera_settings, restore_camera
from instrument.bench.photograph import Progress
from instrument.files.atomic import free_bytes
from instrument.plan import BenchAbilities, Plan, check
from instrument.runs.inspection import Verification, verify
from instrument.runs.run import FinishReason, Run, RunCondition
from instrument.runs.run_control import RunControl
from instrument.runs.run_files import SLM_IMAGES, RunError
from instrument.runs.runner import Runner, RunProgress
from instrument.runs.writer import BenchRecord, RunWriter


def acquire(
    bench: Bench,
    plan: Plan,
    folder: Path | str | None = None,
    *,
    on_progress: RunProgress | None = None,
    calibrations: Sequence[str] = (),
    control: RunControl | None = None,
) -> Run:
    """Check a plan, carry it out and return the run.

    The run's folder is made in ``folder`` (None: the bench's own data folder). ``on_progress`` is called
    after every step; the identifiers of ``calibrations`` in use are kept with the run; ``control`` pauses,
    aborts or stops it from another thread.

    Raises PlanError when the plan cannot be carried out (nothing moved, nothing was written); DeviceError or
    RunError when a device or the disk fails (the bench is safe, the run is marked as failed).
    """
    return prepare(
        bench, plan, folder, on_progress=on_progress, calibrations=calibrations, control=control
    ).execute()


def prepare(
    bench: Bench,
    plan: Plan,
    folder: Path | str | None = None,
    *,
    on_progress: RunProgress | None = None,
    calibrations: Sequence[str] = (),
    control: RunControl | None = None,
) -> Runner:
    """Check a plan, make the run's folder and return the runner, for those who want to pause or stop it."""
    if control is not None:
        control.check()
    folder = Path(folder) if folder is not None else bench.config.data_folder
    check(plan, abilities_of(bench, folder))
    plan = plan.on(bench.led_array)
    writer = RunWriter.create(
        folder, label=plan.label, bench=record_of(bench), plan=plan, calibrations=calibrations
    )
    runner = Runner(bench, plan, writer, on_progress=on_progress)
    if control is not None:
        control.follow(runner)
    return runner


def abilities_of(bench: Bench, folder: Path | None = None) -> BenchAbilities:
    """Read once what plans are checked against: the devices' limits, and the free space in ``folder``."""
    camera, stage, slm = bench.camera, bench.stage, bench.slm
    return BenchAbilities(
        frame_shape=camera.frame_shape,
        frame_dtype=camera.frame_dtype,
        exposure_ms=camera.exposure_ms,
        exposure_limits_ms=camera.exposure_limits_ms,
        gain_limits=camera.gain_limits,
        stage_axes=stage.axes if stage is not None else (),
        stage_position=stage.position() if stage is not None else {},
        stage_homed=stage is None or stage.is_homed,
        stage_target=(lambda source: bench.source_mount.target(*source)) if stage is not None else None,
        play=bench.play,
        can_switch_source=bench.can_switch_source,
        no_source=bench.no_source,
        can_switch_scene=bench.can_switch_scene,
        n_leds=len(bench.led_array.led_positions_mm) if bench.led_array is not None else 0,
        led_array=bench.led_array,
        slm_shape=slm.shape if slm is not None else None,
        slm_settle_ms=slm.settle_ms if slm is not None else 0.0,
        has_trigger_wire=bench.trigger_source is not None,
        trigger_lines=camera.trigger_lines,
        trigger_edges=camera.trigger_edges,
        time_scale=time_scale(bench),
        free_bytes=free_bytes(folder) if folder is not None else None,
    )


def time_scale(bench: Bench) -> float:
    """Return the real seconds that a second of exposures and motion takes: 1 unless all is simulated."""
    if len(bench.simulated_kinds) < len(bench.devices):
        return 1.0
    return max((getattr(s.options, "time_scale", 1.0) for s in bench.config.shared.values()), default=1.0)


def record_of(bench: Bench) -> BenchRecord:
    """Return what a run keeps about its bench."""
    return BenchRecord(
        config=bench.config.as_dict(),
        toml=bench.config.text,
        devices={kind: str(device.identity) for kind, device in bench.devices.items()},
        simulated=bool(bench.simulated_kinds),
        pixel_pitch_um=bench.camera.pixel_pitch_um * bench.camera.binning,
        camera=camera_settings(bench.camera),
        stage=bench.stage.position() if bench.stage is not None and bench.stage.is_homed else {},
    )


def look(path: Path | str, on_verify: Progress | None = None) -> Verification:
    """Verify a run that is to be resumed; ``on_verify`` gets frames read and frames to read.

    Raises RunError when some program writes to it: what is found could be gone the next moment.
    """
    run = Run.open(path)
    if run.is_being_written:
        raise RunError(run.path, "another program is writing to this run.", "Wait until it ends.")
    return verify(run, on_verify)


def prepare_resume(
    bench: Bench,
    path: Path | str,
    found: Verification | None = None,
    *,
    on_progress: RunProgress | None = None,
) -> Runner:
    """Mend a run's files, and return the runner of the steps that are left.

    ``found`` is what :func:`look` found; None: it is looked now. The camera gets the settings that it had
    when the run began. Settings that the plan left as they were are brought back as the steps before had
    them. The bench is as a rule opened from the run's own ``bench.toml``. ``on_progress`` as in
    :func:`acquire`.

    Raises RunError when the folder is no run of a plan, or some program writes to it or did since it was
    looked at; PlanError when the bench cannot do what is left; DeviceError or BenchError when the camera does
    not take the settings of the run.
    """
    found = found or look(path)
    if found.is_recording:
        raise RunError(Path(path), "is a recording; only runs of a plan can be continued.")
    writer = RunWriter.reopen(path, log_bytes=found.log_bytes)
    try:
        run = Run.open(path)
        plan = run.plan
        assert plan is not None
        _require_slm_images(found, plan)
        restore_camera(bench.camera, run.provenance["camera"])
        check(plan, abilities_of(bench, run.path), todo=found.todo, start=run.start)
        writer.note("found", text="\n  ".join([str(found), *writer.mended]))
    except BaseException:
        writer.close()
        raise
    return Runner(bench, plan, writer, start=run.start, todo=found.todo, on_progress=on_progress)


def _require_slm_images(findings: Verification, plan: Plan) -> None:
    """Refuse to show an SLM image that is not the one that the run began with."""
    wrong = {file.name for file in findings.files}
    for image in plan.slm_images:
        if f"{SLM_IMAGES}/{image.name}" in wrong or (findings.todo and not image.is_file()):
            raise RunError(image, "is not the image that the run began with.", "Put it back from a backup.")


def settle(path: Path | str, found: Verification | None = None) -> list[str]:
    """Mend and close a run that needs no frame taken; returns what was done, in words. No bench is needed.

    Of a recording, frames that are missing or damaged are marked as lost, and images without a line in the
    log are listed there and stay. ``found`` as in :func:`prepare_resume`.

    Raises RunError when frames of a plan are still to be taken, when some program writes to the run or did
    since it was looked at, or when its log is another run's.
    """
    found = found or look(path)
    if found.todo:
        raise RunError(Path(path), f"{len(found.todo)} frames of its plan are still to be taken.")
    ended = found.condition in (_ANY_END if found.is_recording else (RunCondition.COMPLETED,))
    if found.is_as_written and ended:
        return []
    with RunWriter.reopen(path, log_bytes=found.log_bytes) as writer:
        words = [*writer.mended, *writer.settle({f.index: f.problem for f in found.damaged})]
        reason, error = FinishReason.COMPLETED, ""
        if found.is_recording and ended:
            run = Run.open(path)
            reason, error = FinishReason(found.condition), run.error
        elif found.is_recording:
            reason, error = FinishReason.ABORTED, "its program ended without finishing it"
        if not ended:
            kind = "recording" if found.is_recording else "run"
            how = "cut off" if found.condition is RunCondition.CRASHED else found.condition
            words.append(f"the {kind} was {how}; it is closed now")
        writer.note("found", text="\n  ".join([str(found), *words]))
        writer.finish(reason, error)
    return words


_ANY_END = tuple(RunCondition(reason) for reason in FinishReason)
