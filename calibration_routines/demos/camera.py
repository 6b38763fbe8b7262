"""The main job, start to end, on the simulated bench: calibrate, photograph, reconstruct, compare, show.

What it left where, its stages and their times stand in ``demo.json``, which is always whole.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from calibration_routines.demos.chart import chart_of
from calibration_routines.demos.journal import Stages, demo_bench, told_in, world_of
from calibration_routines.demos.measured import Measured
from calibration_routines.demos.picture import Viewer, compare
from calibration_routines.demos.result import DemoResult
from calibration_routines.demos.settings import GREEN, DemoSettings
from calibration_routines.demos.write import write_pictures
from calibration_routines.optics.field_response import measure_field_response
from calibration_routines.optics.photograph import Photograph, photograph
from calibration_routines.procedure import Listener
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.sweep import calibrate_sweep
from calibration_routines.psf.sweep_plan import expose_sweep, plan_lines, sweep_plan
from calibration_routines.psf.sweep_procedure import quality_lines
from instrument.bench.bench import Bench
from recon import reconstruct
from recon.optics.scene import Scene

VOLUME_ITERATIONS = 8
"""Of the lights: they are in their planes long before the last change is small."""


def run_demo(
    folder: Path | str, listener: Listener | None = None, settings: DemoSettings | None = None
) -> DemoResult:
    """Run the main job on the simulated bench, into a new folder inside ``folder``.

    Its ``demo.json`` always says how far it came: ``state`` is ``running``, ``completed``, ``failed`` or
    ``aborted``. On every way out the light is off and the stage stands.

    Raises what made it fail (BenchError, DeviceError, OSError); KeyboardInterrupt or SystemExit after the
    bench was made safe and the run marked as aborted.
    """
    listener, settings = listener or Listener(), settings or DemoSettings()
    with told_in(Path(folder), "demo", listener) as (place, stages):
        return _run(place, listener, settings, stages)


def _run(place: Path, listener: Listener, settings: DemoSettings, stages: Stages) -> DemoResult:
    stage, journal = stages.stage, stages.journal
    with demo_bench(settings.bench_toml(), place, listener, stages) as bench:
        measured = _measure(bench, place, settings, listener, stages)
        viewer = Viewer(world_of(bench), settings, measured)
    with stage("compile kernels (kept)"):
        _warm_up()
    limit_s = settings.reconstruction_s
    with stage("reconstruct the picture"):
        result = reconstruct(
            measured.colours,
            measured.calibration.calibration,
            z_um=settings.scene_z_um,
            time_s=limit_s,
            on_progress=lambda record, _: stages.share(record.seconds, limit_s, at_most=True),
        )
    with stage("reconstruct the volume"):
        volume = reconstruct(
            measured.lights.measurement,
            measured.calibration.calibration,
            prior="l1",
            model="convolution",
            judged=False,
            iterations=VOLUME_ITERATIONS,
            time_s=limit_s / 2,
            on_progress=lambda record, _: stages.share(record.seconds, limit_s / 2, at_most=True),
        )
    with stage("chart methods"):
        chart = chart_of(
            measured.photos[GREEN],
            measured.calibration.calibration.part([settings.scene_plane]),
            viewer.collected,
            settings.chart_s,
            lambda done: stages.share(done, 1.0),
        )
    comparison = compare(viewer.picture(result.image), viewer.truth, viewer.field)
    placed = settings.volume.placed(volume, measured.calibration.calibration)
    done = DemoResult(
        place, settings, measured, result, comparison, volume, placed, chart, journal.seconds, {}
    )
    with stage("write the pictures"):
        done.files.update(write_pictures(done, viewer))
    journal.note(
        state="completed",
        psnr_db=round(comparison.psnr_db, 2),
        ssim=round(comparison.ssim, 4),
        lights_in_their_plane=placed.in_plane,
        stage="",
    )
    return done


def _measure(
    bench: Bench, place: Path, settings: DemoSettings, listener: Listener, stages: Stages
) -> Measured:
    """Do everything that needs the bench."""
    stage = stages.stage
    if bench.stage is None:
        raise ValueError("The demo's bench has a stage.")
    sweep = settings.sweep.points()
    with stage("home the stage"):
        bench.stage.home()
    with stage("place the point source"):
        bench.place_source(*sweep.points_um[0])
    with stage("expose without saturating"):
        exposures = expose_sweep(bench, sweep)
    listener.exposures(exposures)
    listener.planned(plan_lines(bench, sweep, sweep_plan(sweep, exposures.exposures_ms), None))
    with stage("dark frames and axial sweep"):
        done = calibrate_sweep(bench, sweep, place, exposures=exposures, listener=stages)
    for line in quality_lines(done):
        listener.said(line)
    with stage("response over the field"):
        height, width = settings.scene_size_um
        response = measure_field_response(
            bench,
            (height / 2, width / 2),
            settings.scene_z_um,
            exposures.exposures_ms[settings.scene_plane],
            place,
            listener=stages,
        )
    with stage("photograph the scene in three colours"):
        photos = [
            _photographed(bench, settings.scene(np.arange(3) == band), place, settings, stages)
            for band in range(3)
        ]
    with stage("photograph lights in a volume"):
        lights = _photographed(bench, settings.volume.scene(), place, settings, stages)
    sensitivity = world_of(bench).sensor.quantum_efficiency
    return Measured(done, response, (photos[0], photos[1], photos[2]), lights, bench.label, sensitivity)


def _photographed(
    bench: Bench, scene: Scene, place: Path, settings: DemoSettings, stages: Stages
) -> Photograph:
    """Put a scene in front of the camera, and photograph it."""
    world_of(bench).set_scene(scene)
    return photograph(
        bench,
        expose_scene(bench).exposure_ms,
        place,
        average=settings.photograph_average,
        dark_frames=settings.photograph_average,
        binning=settings.binning,
        listener=stages,
    )


def _warm_up() -> None:
    """Have the solver's kernels compiled, which the first run on a machine must, outside the timing."""
    psf = np.zeros((16, 16), np.float32)
    psf[4:12:3, 5:11:2] = 1.0
    reconstruct(psf + 1.0, psf, iterations=2)
