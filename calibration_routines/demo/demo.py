"""The main job, start to end, on the simulated bench: calibrate, photograph, reconstruct, compare, show.

What it left where, its stages and their times stand in ``demo.json``, which is always whole.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from calibration_routines.demo.demo_picture import Comparison, Viewer, compare, write_pictures
from calibration_routines.demo.demo_settings import DemoSettings
from calibration_routines.optics.photograph import Photograph, photograph
from calibration_routines.procedure import Listener
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.psf.field_response import FieldResponse, measure_field_response
from calibration_routines.psf.sweep import SweepCalibration, calibrate_sweep
from calibration_routines.psf.sweep_plan import SweepExposures, expose_sweep
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.runs.finish import CtrlC
from instrument.runs.runner import RunStatus
from recon import Reconstruction, reconstruct

FILE = "demo.json"


def new_folder(parent: Path) -> Path:
    """Make a folder ``demo-DATE-TIME`` in ``parent``, which is made as well where missing.

    Raises
    ------
    FileError
        When it cannot be made.
    """
    name = f"demo-{datetime.now(UTC):%Y-%m-%d-%H%M%S}"
    for suffix in ("", *(f"-{n}" for n in range(2, 100))):
        folder = parent / f"{name}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if not parent.is_dir():
                raise FileError(parent, "is no folder.", "Name a folder with --out.") from None
            continue
        except OSError as error:
            raise FileError(folder, f"cannot be made: {error.strerror or error}.") from error
        return folder
    raise FileError(parent / name, "and 98 more of the same second exist already.")


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
        self._write()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; while it runs the file names it."""
        self.note(stage=name)
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - started, 2)

    def _write(self) -> None:
        write_text(self.path, json.dumps(self._record | {"seconds": self.seconds}, indent=1) + "\n")


Advance = Callable[[float, float], None]
Stage = Callable[[str], AbstractContextManager[Advance]]


class Audience(Protocol):
    """Whom the demo tells what it does."""

    def stage(self, name: str) -> AbstractContextManager[Advance]:
        """Enter a stage; gives what is called with how much of it is done and how much there is."""

    def on_bench(self, bench: Bench, folder: Path) -> None:
        """Learn which bench is used, and where everything goes."""

    def on_exposures(self, bench: Bench, settings: DemoSettings, exposures: SweepExposures) -> None:
        """Learn the exposures, and what the sweep will do and cost, before it starts."""

    def on_sweep(self, done: SweepCalibration) -> None:
        """Learn how good the sweep is."""


@dataclass(frozen=True, slots=True)
class Measured:
    """What the demo brings home from the bench."""

    calibration: SweepCalibration
    response: FieldResponse
    photo: Photograph
    bench_label: str


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo made and how good it is.

    Attributes
    ----------
    folder : Path
    measured : Measured
    reconstruction : Reconstruction
    comparison : Comparison
        Of the reconstruction with the ground truth, inside the picture on the screen.
    seconds : dict
        Seconds of each stage.
    files : dict
        What it is, and where.
    """

    folder: Path
    settings: DemoSettings
    measured: Measured
    reconstruction: Reconstruction
    comparison: Comparison
    seconds: dict[str, float]
    files: dict[str, Path]


def run_demo(folder: Path | str, audience: Audience, settings: DemoSettings | None = None) -> DemoResult:
    """Run the main job on the simulated bench, into a new folder inside ``folder``.

    Its ``demo.json`` always says how far it came: ``state`` is ``running``, ``completed``, ``failed`` or
    ``aborted``. On every way out the light is off and the stage stands.

    Raises
    ------
    BenchError, DeviceError, OSError
        What made it fail.
    KeyboardInterrupt, SystemExit
        After the bench was made safe and the run marked as aborted.
    """
    settings = settings or DemoSettings()
    place = new_folder(Path(folder))
    journal = Journal(place)
    try:
        journal.note(state="running")
        with CtrlC() as ctrl_c:
            return _run(place, audience, settings, journal, ctrl_c)
    except BaseException as error:
        aborted = isinstance(error, KeyboardInterrupt | SystemExit)
        journal.note(state="aborted" if aborted else "failed", error=str(error) or type(error).__name__)
        error.add_note(f"The demo {'was stopped' if aborted else 'failed'}; what it made is in {place}")
        raise


def _run(
    place: Path, audience: Audience, settings: DemoSettings, journal: Journal, ctrl_c: CtrlC
) -> DemoResult:
    @contextmanager
    def stage(name: str) -> Iterator[Advance]:
        with journal.stage(name), audience.stage(name) as tell:

            def advance(done: float, total: float) -> None:
                ctrl_c.check()
                tell(done, total)

            yield advance
            ctrl_c.check()

    write_text(place / "bench.toml", settings.bench_toml())
    with stage("open the bench"):
        bench = open_bench(parse_config(settings.bench_toml(), place / "bench.toml"))
    with bench:
        journal.note(simulated=bool(bench.simulated_kinds), bench=bench.label)
        audience.on_bench(bench, place)
        try:
            measured = _measure(bench, place, settings, audience, stage)
        finally:
            bench.stop()
            journal.note(left=_state_of(bench))
        viewer = Viewer(_world(bench), settings, measured)
    with stage("compile kernels (kept)"):
        _warm_up()
    with stage("reconstruct") as advance:
        result = reconstruct(
            measured.photo.measurement,
            measured.calibration.calibration,
            z_um=settings.scene_z_um,
            time_s=settings.reconstruction_s,
            on_progress=viewer.watch(lambda seconds: advance(seconds, settings.reconstruction_s)),
        )
    comparison = compare(viewer.picture(result.image), viewer.truth, viewer.field)
    with stage("write the pictures"):
        files = write_pictures(place, settings, measured, result, viewer, comparison)
    journal.note(
        state="completed", psnr_db=round(comparison.psnr_db, 2), ssim=round(comparison.ssim, 4), stage=""
    )
    return DemoResult(place, settings, measured, result, comparison, dict(journal.seconds), files)


def _measure(bench: Bench, place: Path, settings: DemoSettings, audience: Audience, stage: Stage) -> Measured:
    """Do everything that needs the bench."""
    if bench.stage is None:
        raise ValueError("The demo's bench has a stage.")
    sweep = settings.sweep.points()
    with stage("home the stage"):
        bench.stage.home()
    with stage("place the point source"):
        bench.place_source(*sweep.points_um[0])
    with stage("expose without saturating"):
        exposures = expose_sweep(bench, sweep)
    audience.on_exposures(bench, settings, exposures)
    with stage("dark frames and axial sweep") as advance:
        done = calibrate_sweep(bench, sweep, place, exposures=exposures, listener=_Frames(advance))
    audience.on_sweep(done)
    with stage("response over the field") as advance:
        height, width = settings.scene_size_um
        response = measure_field_response(
            bench,
            (height / 2, width / 2),
            settings.scene_z_um,
            exposures.exposures_ms[settings.scene_plane],
            place,
            listener=_Frames(advance),
        )
    with stage("photograph the scene") as advance:
        _world(bench).set_scene(settings.scene())
        exposure = expose_scene(bench)
        photo = photograph(
            bench,
            exposure.exposure_ms,
            place,
            average=settings.average,
            dark_frames=settings.average,
            binning=settings.binning,
            listener=_Frames(advance),
        )
    return Measured(done, response, photo, bench.label)


def _warm_up() -> None:
    """Have the solver's kernels compiled, which the first run on a machine must, outside the timing."""
    psf = np.zeros((16, 16), np.float32)
    psf[4:12:3, 5:11:2] = 1.0
    reconstruct(psf + 1.0, psf, iterations=2)


class _Frames(Listener):
    def __init__(self, advance: Advance) -> None:
        self._advance = advance

    def frame(self, status: RunStatus) -> None:
        self._advance(status.done, status.total)


def _world(bench: Bench) -> SimulatedWorld:
    world = bench.shared[SimulatedWorld.table]
    if not isinstance(world, SimulatedWorld):
        raise TypeError(f"The demo's bench is simulated, not {type(world).__name__}.")
    return world


def _state_of(bench: Bench) -> dict[str, Any]:
    """Return what the bench is left as, for the record."""
    return {
        "light": bench.led_array.pattern.description if bench.led_array is not None else "none",
        "stage_moving": bench.stage is not None and bench.stage.is_moving,
        "scene_lit": _world(bench).scene_lit,
    }
