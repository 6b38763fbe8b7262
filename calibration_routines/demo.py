"""The main job, start to end, on the simulated bench: calibrate, photograph, reconstruct, compare, show.

What it left where, its stages and their times stand in ``demo.json``, which is always whole.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from calibration_routines.demo_chart import chart_of
from calibration_routines.demo_picture import Comparison, Viewer, compare
from calibration_routines.demo_volume import Lights, Placed
from calibration_routines.demo_write import write_pictures
from calibration_routines.optics.field_response import FieldResponse, measure_field_response
from calibration_routines.optics.photograph import Photograph, photograph
from calibration_routines.procedure import Listener
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.sweep import SweepCalibration, calibrate_sweep
from calibration_routines.psf.sweep_options import AxialSweep
from calibration_routines.psf.sweep_plan import expose_sweep, plan_lines, sweep_plan
from calibration_routines.psf.sweep_procedure import quality_lines
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.evaluation.chart import ChartData
from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.runs.interrupts import ctrl_c_remembered
from instrument.runs.runner import RunStatus
from instrument.runs.writer import free_name
from recon import Reconstruction, reconstruct
from recon.base.declare import option
from recon.optics.scene import Scene, picture

FILE = "demo.json"
GREEN = 1
"""Of red, green and blue: the light of PSFs, of the second scene and of the chart."""
PICTURE = Path(__file__).with_name("demo_picture.jpg")
"""A cup of coffee; photograph by Rachel Michetti, CC0 (docs/reference/demo.md)."""


VOLUME_ITERATIONS = 8
"""Of the lights: they are in their planes long before the last change is small."""
SCREEN_PIXELS = (420, 280)
"""Width and height of the picture on the screen: no finer than the camera's binned pixels see it."""

_HIDDEN: dict[str, Any] = {"flags": ("",)}  # not offered: the demo is the same for everybody


@dataclass(frozen=True)
class DemoSettings:
    """The demo's settings; everything that could flatter the result is here, in the open."""

    preset: str = option(
        "pco",
        help="The simulated optics; pco: the dissertation's prototype (Kuo 2020, Sec. 4.3).",
        **_HIDDEN,
    )
    camera_binning: int = option(2, least=1, help="In the camera, 2 as in Kuo 2020, Sec. 4.3.", **_HIDDEN)
    binning: int = option(
        2, least=1, help="Of PSFs and photographs in software: to the optical resolution.", **_HIDDEN
    )
    z_mm: tuple[float, float] = option(
        (100.0, 500.0), unit="mm", help="Nearest and farthest plane of the sweep.", **_HIDDEN
    )
    planes: int = option(7, least=1, help="Planes of the sweep.", **_HIDDEN)
    scene_plane: int = option(
        5, least=0, help="The plane, counted from the nearest, in which the scene stands.", **_HIDDEN
    )
    half_field_deg: float = option(
        18.0, unit="deg", help="Half the angle under which the picture's width is seen.", **_HIDDEN
    )
    lights: int = option(32, least=2, help="Green lights that wind away from the camera.", **_HIDDEN)
    average: int = option(2, least=1, help="Frames averaged for PSFs.", **_HIDDEN)
    photograph_average: int = option(8, least=1, help="The same of photographs.", **_HIDDEN)
    reconstruction_s: float = option(
        60.0,
        unit="s",
        least=0.1,
        flags=("--reconstruction-s",),
        metavar="S",
        help="Time for the picture, at most; half as much for the volume.",
    )
    chart_s: float = option(
        12.0, unit="s", least=0.1, help="Time for the chart of methods, at most.", **_HIDDEN
    )
    time_scale: float = option(
        0.02, least=0, help="Real seconds per simulated second of motion and exposure.", **_HIDDEN
    )
    seed: int = option(0, least=0, help="Of the simulated diffuser, sensor and noise.")

    @property
    def sweep(self) -> AxialSweep:
        """The axial sweep."""
        return AxialSweep(
            z_min_um=1e3 * self.z_mm[0],
            z_max_um=1e3 * self.z_mm[1],
            planes=self.planes,
            average=self.average,
            binning=self.binning,
            dark_frames=2 * self.average,
        )

    @property
    def scene_z_um(self) -> float:
        """Depth of the scene."""
        return self.sweep.z_um[self.scene_plane]

    @property
    def scene_size_um(self) -> tuple[float, float]:
        """Height and width of the picture on the screen."""
        width = 2 * self.scene_z_um * float(np.tan(np.radians(self.half_field_deg)))
        rows, columns = read_picture().shape[:2]
        return width * rows / columns, width

    def scene(self, shown: Sequence[bool] = (True, True, True)) -> Scene:
        """Return the scene: the picture on a screen, or what it shows in some of red, green and blue."""
        radiance = read_picture() * np.asarray(shown, np.float32)
        return picture(radiance, self.scene_z_um, self.scene_size_um[1], name="a cup of coffee on a screen")

    @property
    def volume(self) -> Lights:
        """The second scene: lights in a spiral from the nearest plane to the farthest."""
        half = float(np.tan(np.radians(self.half_field_deg)))
        return Lights(self.lights, self.sweep.z_um, (0.62 * half, half))

    def bench_toml(self) -> str:
        """Return the configuration of the demo's bench."""
        return f"""\
# The bench of diffuserbench demo: SIMULATED.
[bench]
name = "demo bench"
data_folder = "."

[camera]
driver = "simulated"
binning = {self.camera_binning}

[stage]
driver = "simulated"

[led_array]
driver = "simulated"

[source]
rgb = [0, 255, 0]

[scene]
control = "simulated"

[simulated]
preset = "{self.preset}"
seed = {self.seed}
time_scale = {self.time_scale:g}
"""


def read_picture() -> npt.NDArray[np.float32]:
    """Return the demo's picture as light from a screen: linear, 0 to 1, (280, 420, 3) float32."""
    levels = cv2.imread(str(PICTURE), cv2.IMREAD_COLOR)
    if levels is None:
        raise FileNotFoundError(f"The demo's picture {PICTURE} is missing: install diffuserbench again.")
    light = (np.asarray(levels[..., ::-1], np.float32) / 255.0) ** np.float32(2.2)
    return np.asarray(cv2.resize(light, SCREEN_PIXELS, interpolation=cv2.INTER_AREA), np.float32)


def new_folder(parent: Path, kind: str = "demo") -> Path:
    """Make a folder ``KIND-DATE-TIME`` in ``parent``, which is made as well where missing.

    Raises FileError when it cannot be made.
    """
    if parent.exists() and not parent.is_dir():
        raise FileError(parent, "is no folder.", "Name a folder with --out.")
    folder = free_name(parent, f"{kind}-{datetime.now(UTC):%Y-%m-%d-%H%M%S}")
    try:
        folder.mkdir(parents=True)
    except OSError as error:
        raise FileError(folder, f"cannot be made: {error.strerror or error}.") from error
    return folder


class Journal:
    """The demo's record, ``demo.json`` in its folder; written from the first :meth:`note` on.

    Attributes
    ----------
    seconds : dict
        Name of each stage done to the seconds it took, in order.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self.seconds: dict[str, float] = {}
        self._record: dict[str, Any] = {}

    def note(self, **entries: Any) -> None:
        """Add entries (JSON-compatible) and write the file."""
        self._record |= entries
        write_text(self.path, json.dumps(self._record | {"seconds": self.seconds}, indent=1) + "\n")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; while it runs the file names it."""
        self.note(stage=name)
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - started, 2)


class Stages(Listener):
    """Times a demo's stages, and hands on how each goes; Ctrl-C ends it at any of these moments."""

    def __init__(self, journal: Journal, listener: Listener, check: Callable[[], None]) -> None:
        self.journal, self._listener, self._check = journal, listener, check

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Enter a stage."""
        with self.journal.stage(name):
            self._listener.step(name)
            yield
            self._check()

    def step(self, words: str) -> None:
        """Hand on that a stage's next step begins, unless it is to end."""
        self._check()
        self._listener.step(words)

    def share(self, done: float, total: float, *, at_most: bool = False) -> None:
        """Hand on how much is done, unless it is to end."""
        self._check()
        self._listener.share(done, total, at_most=at_most)

    def frame(self, status: RunStatus) -> None:
        """Hand on how much of a run is done."""
        self.share(status.done, status.total)


@dataclass(frozen=True, slots=True)
class Measured:
    """What the demo brings home from the bench."""

    calibration: SweepCalibration
    response: FieldResponse
    photos: tuple[Photograph, Photograph, Photograph]
    """Of the screen in red, green and blue, one after the other."""
    lights: Photograph
    """Of the second scene."""
    bench_label: str
    sensitivity: tuple[float, float, float]
    """Of the sensor to red, green and blue, from its data sheet."""

    @property
    def colours(self) -> npt.NDArray[np.float32]:
        """The three photographs as one measurement, (height, width, 3), each as if exposed as the green one.

        The colours are balanced by the sensor's sensitivity.
        """
        green = self.photos[GREEN].exposure_ms * self.sensitivity[GREEN]
        shares = zip(self.photos, self.sensitivity, strict=True)
        return np.stack(
            [photo.measurement * np.float32(green / (photo.exposure_ms * s)) for photo, s in shares], axis=-1
        )


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo made and how good it is."""

    folder: Path
    settings: DemoSettings
    measured: Measured
    reconstruction: Reconstruction
    comparison: Comparison
    """Of the reconstruction with the ground truth, inside the picture on the screen."""
    volume: Reconstruction
    placed: Placed
    """Where the second scene's lights are, and were found."""
    chart: ChartData
    seconds: dict[str, float]
    """Seconds of each stage."""
    files: dict[str, Path]
    """What it is, and where."""


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


@contextmanager
def told_in(parent: Path, kind: str, listener: Listener) -> Iterator[tuple[Path, Stages]]:
    """Give a new folder and the stages of what is done in it; its journal says how that ended, whatever."""
    place = new_folder(parent, kind)
    journal = Journal(place)
    try:
        journal.note(state="running")
        with ctrl_c_remembered() as check:
            yield place, Stages(journal, listener, check)
    except BaseException as error:
        aborted = isinstance(error, KeyboardInterrupt | SystemExit)
        journal.note(state="aborted" if aborted else "failed", error=str(error) or type(error).__name__)
        error.add_note(f"The demo {'was stopped' if aborted else 'failed'}; what it made is in {place}")
        raise


def _run(place: Path, listener: Listener, settings: DemoSettings, stages: Stages) -> DemoResult:
    stage, journal = stages.stage, stages.journal
    write_text(place / "bench.toml", settings.bench_toml())
    with stage("open the bench"):
        bench = open_bench(parse_config(settings.bench_toml(), place / "bench.toml"))
    with bench:
        bench.foretell(bench.config.bench.name)
        journal.note(simulated=bool(bench.simulated_kinds), bench=bench.label)
        listener.said(f"Bench: {bench.label}")
        listener.said(f"Everything goes to {place}")
        try:
            measured = _measure(bench, place, settings, listener, stages)
        finally:
            bench.stop()
            journal.note(left=state_of(bench))
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


def world_of(bench: Bench) -> SimulatedWorld:
    """Return a demo's simulated world."""
    world = bench.shared[SimulatedWorld.table]
    if not isinstance(world, SimulatedWorld):
        raise TypeError(f"The demo's bench is simulated, not {type(world).__name__}.")
    return world


def state_of(bench: Bench) -> dict[str, Any]:
    """Return what the bench is left as, for the record."""
    return {
        "light": bench.led_array.pattern.description if bench.led_array is not None else "none",
        "stage_moving": bench.stage is not None and bench.stage.is_moving,
        "scene_lit": world_of(bench).scene_lit,
    }
