"""An animal filmed on the simulated microscope, from calibration to dF/F beside the truth (Kuo 2020, Ch. 6).

What the demo does is what a user does: a grid of PSFs, a recording, ``reconstruct --video`` with ``auto``,
``activity``. What it alone can do is look at the truth.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from calibration_routines.demos.film_figure import write_film_figure
from calibration_routines.demos.film_judge import FOLLOWED, ROI_UM, Judged, Truth, judge, truth_of
from calibration_routines.demos.journal import Stages, demo_bench, told_in, world_of
from calibration_routines.procedure import Listener
from calibration_routines.psf.sweep import calibrate_sweep
from calibration_routines.psf.sweep_options import LateralSweep
from calibration_routines.psf.sweep_procedure import quality_lines
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench
from instrument.reconstruction.activity import (
    WINDOW_S,
    Activity,
    ActivitySettings,
    find_activity,
    write_activity,
)
from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.video import VideoRequest, finish_video, prepare_video, solve_video
from instrument.reconstruction.video_files import VideoPictures
from instrument.runs.recorder import record
from instrument.runs.run import Run
from recon.base.declare import option

EXPOSURE_MS = 100.0
CAMERA_BINNING = 4
WARM_ITERATIONS = 6
"""What ``activity`` asks of a film."""


@dataclass(frozen=True)
class FilmSettings:
    """The demo's settings; the rest of its bench is in the configuration beside the film.

    What flatters it: a frame is the light at one instant, so that nothing is blurred by motion.
    """

    frames: int = option(200, least=40, help="Of the film, ten a second.")
    binning: int = option(
        1, least=1, flags=("--bin",), help="Of the frames in software, beside the camera's 4."
    )
    seed: int = option(0, least=0, help="Of the animal, the optics and the noise.")

    def bench_toml(self) -> str:
        """Return the configuration of the demo's bench."""
        return f"""\
# The bench of diffuserbench demo film: SIMULATED, Kuo 2020, Ch. 6.
[bench]
name = "film demo bench"
data_folder = "."

[camera]
driver = "simulated"
binning = {CAMERA_BINNING}

[stage]
driver = "simulated"

[led_array]
driver = "simulated"

[source]
rgb = [0, 255, 0]

[scene]
control = "simulated"

[simulated]
preset = "microscope"
scene = "animal"
seed = {self.seed}
time_scale = 0
"""


@dataclass(frozen=True, slots=True)
class FilmResult:
    """What the demo made and how good it is."""

    folder: Path
    settings: FilmSettings
    activity: Activity
    truth: Truth
    judged: Judged
    model: str
    """Of the camera, as ``auto`` chose it, and why."""
    seconds: dict[str, float]
    """Of each stage."""
    files: dict[str, Path]
    """What it is, and where."""

    def lines(self) -> list[str]:
        """Return in sentences how the film agrees with the truth."""
        judged = self.judged
        return [
            f"Cells: dF/F follows the truth (correlation {FOLLOWED:g} and up) in {judged.followed_clear:.0%} "
            f"of the {judged.clear_active} that flash and stand clear; {judged.active} flash in all.",
            f"Regions: {judged.found} at cells that flash, {judged.on_tissue} at what is static, "
            f"{judged.elsewhere} where nothing is.",
            f"Blood: {judged.median_um_s:.0f} um/s along the vessel; true: "
            f"{judged.true_median_um_s:.0f} um/s.",
        ]


def run_film(
    folder: Path | str, listener: Listener | None = None, settings: FilmSettings | None = None
) -> FilmResult:
    """Film the animal into a new folder inside ``folder``; its ``demo.json`` always says how far it came.

    Raises what made it fail (BenchError, DeviceError, OSError); KeyboardInterrupt or SystemExit after the
    bench was made safe.
    """
    listener, settings = listener or Listener(), settings or FilmSettings()
    with told_in(Path(folder), "film", listener) as (place, stages):
        return _run(place, listener, settings, stages)


def _run(place: Path, listener: Listener, settings: FilmSettings, stages: Stages) -> FilmResult:
    stage, journal = stages.stage, stages.journal
    with demo_bench(settings.bench_toml(), place, listener, stages) as bench:
        calibration, run = _filmed(bench, place, settings, listener, stages)
        world = world_of(bench)
    with stage("reconstruct the film"):
        video, model = _reconstructed(place, calibration, run, settings, stages)
    listener.said(f"Camera model: {model}")
    with stage("find what is active"):
        pixel_um = video.attributes["diffuserbench"]["pitch_um"][0]
        chosen = ActivitySettings(align=True, smooth_px=ROI_UM / pixel_um)
        activity = find_activity(video, chosen)
        written = write_activity(activity, video, place / "activity", chosen)
    with stage("compare with the truth"):
        truth = _truth(world, run, video)
        period_s = 1e-3 * EXPOSURE_MS
        judged = judge(activity, truth, period_s, round(WINDOW_S / period_s))
        figure = place / "film.png"
        write_film_figure(figure, activity, truth, judged)
    journal.note(state="completed", stage="", model=model, **judged.figures())
    files = {
        "calibration": calibration,
        "recording": run.path,
        "film, OME-Zarr": video.path,
        "film, MP4": place / "film.mp4",
        **{f"activity: {path.name}": path for path in written},
        "page beside the truth": figure,
        "record": place / "demo.json",
    }
    return FilmResult(place, settings, activity, truth, judged, model, dict(journal.seconds), files)


def _filmed(
    bench: Bench, place: Path, settings: FilmSettings, listener: Listener, stages: Stages
) -> tuple[Path, Run]:
    """Do everything that needs the bench; return the calibration's folder and the recording."""
    stage, world = stages.stage, world_of(bench)
    if bench.stage is None or world.animal is None:
        raise ValueError("The demo's bench has a stage and an animal.")
    (left, right), (low, high), (near, far) = world.animal.extent_um
    with stage("home the stage"):
        bench.stage.home()
    with stage("calibrate: 3 x 3 PSFs"):
        half_x, half_y = 1.2 * max(right, -left), 1.2 * max(high, -low)
        sweep = LateralSweep(
            z_um=(near + far) / 2,
            half_field_x_um=half_x,
            half_field_y_um=half_y,
            spacing_um=max(half_x, half_y),
        )
        done = calibrate_sweep(bench, sweep, place, listener=stages)
    for line in quality_lines(done):
        listener.said(line)
    with stage("render the animal's light"):
        bench.scene_on()
        bench.camera.set_exposure_ms(EXPOSURE_MS)
        bench.camera.snap()
    with stage(f"record {settings.frames} frames"):
        run = record(
            bench,
            place,
            n_frames=settings.frames,
            on_progress=lambda status: stages.share(status.written, settings.frames),
        )
    return done.path.parent, run


def _reconstructed(
    place: Path, calibration: Path, run: Run, settings: FilmSettings, stages: Stages
) -> tuple[VideoPictures, str]:
    """Reconstruct the recording as ``reconstruct --video`` does; return the film and the camera's model."""
    request = VideoRequest(
        run=run.path,
        out=place / "film.ome.zarr",
        calibration=calibration,
        inputs=InputOptions(binning=settings.binning),
        video=VideoOptions(warm_iterations=WARM_ITERATIONS),
    )
    prepared = prepare_video(request)
    done, cancel = 0, threading.Event()

    def on_progress(report: Any) -> None:
        nonlocal done
        done += report.solved
        stages.share(done, settings.frames)

    solve_video(prepared, on_progress, cancel)
    finish_video(prepared)
    return VideoPictures(request.out), prepared.notes["Model"]


def _truth(world: SimulatedWorld, run: Run, video: VideoPictures) -> Truth:
    """Return what the film should show, at the middle of each of its exposures."""
    animal, facts = world.animal, video.attributes["diffuserbench"]
    if animal is None:
        raise ValueError("The demo's bench has an animal.")
    ended_ns = [run.metadata(index).device_time_ns or 0 for index in sorted(run.records)]
    times_s = np.array([world.alive_at(ns) for ns in ended_ns]) - 0.5e-3 * EXPOSURE_MS
    pixel_um = facts["pitch_um"][0] * world.distance_um / facts["z_um"][0]
    row, column = facts["centre"]
    return truth_of(animal, times_s, (row, column), pixel_um, world.distance_um)
