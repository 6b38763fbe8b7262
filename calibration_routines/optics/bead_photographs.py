"""Photographs of bead slides at unknown places, each a run that knows those before it; what is asked for.

The next exposure follows from the last slide, so that no plan can tell all of them beforehand. Whoever finds
the newest run of slides that never became a calibration can go on from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from calibration_routines.optics.photograph import (
    Photograph,
    photograph_findings,
    photograph_of,
    photograph_plan,
)
from calibration_routines.options import MM, Checked, Size
from calibration_routines.procedure import Listener
from calibration_routines.psf.exposure import expose_scene
from calibration_routines.purpose import CalibrationError, Purpose, completed
from calibration_routines.scatter import STEADY, Scatter, pooled
from instrument.bench.bench import Bench
from instrument.files.atomic import named_by_worth, require_new
from instrument.files.errors import BenchError, OperatorNeededError, SettingsError, count
from instrument.files.images import write_image
from instrument.files.record import RecordFormat, plain
from instrument.runs.results import BEADS_FILE
from instrument.runs.run import Run
from instrument.runs.run_control import RunControl
from recon.arrays import Array, Float32Array
from recon.base.declare import RARE, option
from recon.blind import BlindSettings
from recon.types import Geometry

BEADS_FOLDER = "calibration-beads"
"""Where the command line writes the calibration."""
SLIDE_FILE = "beads.tif"
"""Of a photograph of a slide, in its run's folder: no scene to reconstruct."""
SLIDE = "photographing bead slide"
"""What the step of each begins with; its number follows."""
_DARK_FRAMES = 4
_TAKES, _SHORTER = 3, 0.7
"""Times that a slide which saturates is photographed, and the share of the exposure each time."""


@runtime_checkable
class SlideChanger(Protocol):
    """A shared part that can put another slide of beads before the camera: the simulated world."""

    @property
    def slide_z_um(self) -> float:
        """How far from the diffuser its slides are."""

    def change_slide(self, number: int) -> None:
        """Show slide ``number``; each has its beads at other places."""


_SOLVER = BlindSettings()
_DEFLECTION_DEG = 1.0  # by which the diffuser bends light, for the window


@dataclass(frozen=True, kw_only=True)
class BeadSlides(Checked):
    """What to photograph, and how to solve it."""

    z_um: float | None = option(
        None,
        **MM,
        flags=("--z",),
        above=0,
        label="Depth",
        help="Depth of the slide, from the diffuser; only a simulated bench knows it.",
        default_words="the simulated bench's",
    )
    images: int = option(
        9, least=2, label="Photographs", help="Photographs to take, the slide moved by any amount in between."
    )
    average: int = option(4, least=1, label="Frames a photograph", help="Frames a photograph, averaged.")
    binning: int = option(1, least=1, help="Software binning, on top of the camera's.")
    grid: Size = option(
        Size(*_SOLVER.grid),
        flags=("--psfs",),
        metavar="RxC",
        label="PSFs",
        help="Rows and columns of PSFs over the field.",
        parse=Size.of,
    )
    rank: int = option(
        max(_SOLVER.ranks),
        least=1,
        label="Highest rank",
        help="Highest rank tried with beads on the pixel grid; raised step by step up to this.",
    )
    degree: int = option(
        _SOLVER.degree,
        least=0,
        most=2,
        help="How PSFs vary over the field in the end: 0 not, 1 linearly, 2 quadratically.",
        group=RARE,
    )
    iterations: int = option(
        _SOLVER.iterations,
        least=1,
        flags=("--iterations", "-n"),
        help="Of each half-step.",
        group=RARE,
    )
    tau: float = option(
        _SOLVER.tau, label="Sparsity", help="Weight of the beads' sparsity, relative.", group=RARE
    )
    reach: float = option(_SOLVER.reach, help="Part of the sensor's field that the PSFs span.", group=RARE)
    window_px: Size | None = option(
        None,
        flags=("--window",),
        metavar="HxW",
        label="Window",
        help="Height and width that hold the whole pattern, binned pixels.",
        default_words="from the aperture",
        parse=Size.of,
        group=RARE,
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FOLDER",
        label="Folder",
        help="Where the calibration goes.",
        default_words=f"{BEADS_FOLDER}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Replace a calibration that exists.")

    def planned(self, bench: Bench) -> BeadSlides:
        """Return them with their depth filled in, where the simulated world knows it."""
        changer = _slide_changer(bench)
        return self if self.z_um is not None or changer is None else replace(self, z_um=changer.slide_z_um)

    @property
    def distance_um(self) -> float:
        """The depth; SettingsError where nobody has said it."""
        if self.z_um is None:
            raise SettingsError(
                [("z_um", "the slide's distance from the diffuser, which nothing else tells")]
            )
        return self.z_um

    @property
    def solver(self) -> BlindSettings:
        """How the images are solved."""
        return BlindSettings(
            grid=self.grid.shape,
            ranks=tuple(range(1, self.rank + 1)),
            iterations=self.iterations,
            degree=self.degree,
            tau=self.tau,
            reach=self.reach,
        )

    def refuse_existing(self) -> None:
        """Refuse to write over a calibration that nobody allowed to be replaced."""
        if self.out is not None:
            require_new(self.out, overwrite=self.overwrite)

    def record(self) -> dict[str, Any]:
        """Return what is kept of it with a calibration."""
        taken = {name: getattr(self, name) for name in ("z_um", "images", "average", "binning")}
        window = None if self.window_px is None else self.window_px.shape
        return {**taken, "window_px": window, "solver": asdict(self.solver)}


@dataclass(frozen=True, slots=True)
class SlideRecord:
    """What a photograph of a slide was taken for."""

    slides: BeadSlides
    number: int
    """Of the slide, from 0."""
    before: tuple[str, ...]
    """Run folders of the slides before it, beside its own."""
    geometry: Geometry
    """Of the camera's pixels."""
    bench: str
    simulated: bool


BEADS = Purpose(
    SlideRecord,
    "bead_slide.json",
    BEADS_FILE,
    RecordFormat(
        "diffuserbench bead slide",
        "run of calibrate beads",
        restore="The frames beside it stay; their means can be solved as image files.",
    ),
)
"""The result of such a run is a note of where it went on: the next photograph, or the calibration. Of slides
that never became one the newest run lacks it."""
_WENT_ON = RecordFormat("diffuserbench bead slide's next", "note of where a bead slide went on")


def went_on(run: Path, where: Path) -> None:
    """Note in the run of a slide where it went on."""
    _WENT_ON.write(BEADS.place(run, doubted=False), {"in": where})


@dataclass(frozen=True, slots=True)
class BeadPhotographs:
    """What was photographed of slides of beads."""

    images: Float32Array
    """(n_images, height, width): dark frame subtracted, colours averaged, binned."""
    runs: tuple[Path, ...] = ()
    findings: tuple[str, ...] = ()
    """What is wrong with place and other light in them."""
    scatter: Scatter = STEADY
    """Of their frames, all photographs together."""


def _slide_changer(bench: Bench) -> SlideChanger | None:
    return next((part for part in bench.shared.values() if isinstance(part, SlideChanger)), None)


def photograph_slides(
    bench: Bench,
    slides: BeadSlides,
    folder: Path | None,
    control: RunControl,
    listener: Listener,
    begun: Run | None = None,
) -> BeadPhotographs:
    """Photograph a slide of beads several times, moved in between by the simulated world or the operator.

    A slide that saturates is photographed again, shorter, and those after it as short: a bead's brightness is
    free anyway. The listener is told. ``begun`` is the newest run of slides that were left: they are read and
    go on at its exposure; where it is saturated, with the same slide at an exposure that is found anew.

    Raises OperatorNeededError when the slide has to be moved by hand and nobody can be asked;
    CalibrationError when an image saturates still, the last time or at the camera's shortest exposure.
    """
    if _slide_changer(bench) is None and bench.ask is None:
        raise OperatorNeededError(
            "The bead slide must be moved by hand between photographs, and there is no terminal to ask at. "
            "Photograph it with snap, and give the images: calibrate beads FILE FILE ..."
        )
    series = _Series(bench, slides, folder, control, listener)
    try:
        if begun is not None:
            series.take_up(begun)
        while len(series.photographs) < slides.images:
            series.photograph_next()
    except BaseException as error:
        if series.photographs:
            before = count(len(series.photographs), "slide")
            error.add_note(f"{before} photographed before. To go on: diffuserbench resume {series.newest}")
        raise
    return BeadPhotographs(
        mean_images([one.measurement for one in series.photographs]),
        tuple(one.run.path for one in series.photographs),
        photograph_findings(series.photographs),
        pooled([one.scatter for one in series.photographs]),
    )


class _Series:
    """Photographs of slides, one after the other; ``photographs`` has those that are done."""

    def __init__(
        self, bench: Bench, slides: BeadSlides, folder: Path | None, control: RunControl, listener: Listener
    ) -> None:
        self._bench, self._slides, self._folder = bench, slides, folder
        self._control, self._listener = control, listener
        self._exposure_ms: float | None = None
        self.newest: Path | None = None
        """The run that knows all before it."""
        self.photographs: list[Photograph] = []

    def take_up(self, begun: Run) -> None:
        """Read the photographs up to a complete run, which is the newest."""
        before = [begun.path.parent / name for name in BEADS.read(begun.path).before]
        for number, path in enumerate(before):
            self._control.check()
            self.photographs.append(photograph_of(Run.open(path), self._slides.binning))
            self._listener.share(number + 1, len(before) + 1)
        taken = photograph_of(begun, self._slides.binning)
        self.newest = begun.path
        if taken.saturated_pixels == 0:
            self._exposure_ms = taken.exposure_ms
            self._keep(taken)
        said = f"{count(len(self.photographs), 'slide')} of {self._slides.images} photographed before"
        self._listener.said(said + ("" if taken.saturated_pixels == 0 else "; the next one saturated"))

    def photograph_next(self) -> None:
        """Have the slide moved, and photograph it until nothing saturates."""
        number = len(self.photographs)
        self._control.check()
        self._move(number)
        if self._exposure_ms is None:
            # Slides differ in brightness where beads overlap: leave room.
            self._exposure_ms = expose_scene(self._bench, target=0.5).exposure_ms
        shortest_ms = self._bench.camera.exposure_limits_ms[0]
        for take in range(1, _TAKES + 1):
            exposure_ms = self._exposure_ms
            taken = self._take(number, exposure_ms)
            shorter_ms = max(_SHORTER * exposure_ms, shortest_ms)
            if taken.saturated_pixels == 0 or take == _TAKES or not shorter_ms < exposure_ms:
                break
            self._listener.said(
                f"Photograph {number + 1} saturates in {taken.saturated_pixels} pixels at {exposure_ms:.4g} "
                f"ms: it is taken again at {shorter_ms:.4g} ms, and those that follow as short."
            )
            self._exposure_ms = shorter_ms
        if taken.saturated_pixels > 0:
            least = ", the camera's shortest exposure" if exposure_ms <= shortest_ms else ""
            raise CalibrationError(
                f"Photograph {number + 1} saturates in {taken.saturated_pixels} pixels, taken {take} "
                f"{'time' if take == 1 else 'times'}, at {exposure_ms:.4g} ms{least}: dim the light or "
                "spread the beads, and go on with it. " + " ".join(taken.findings)
            )
        self._keep(taken)

    def _move(self, number: int) -> None:
        if (changer := _slide_changer(self._bench)) is not None:
            changer.change_slide(number)
        elif (ask := self._bench.ask) is not None:
            ask(f"Photograph {number + 1} of {self._slides.images}: move the bead slide somewhere else.")

    def _take(self, number: int, exposure_ms: float) -> Photograph:
        self._listener.step(f"{SLIDE} {number + 1} of {self._slides.images}")
        bench, before = self._bench, tuple(one.run.path.name for one in self.photographs)
        simulated = bool(bench.simulated_kinds)
        record = SlideRecord(self._slides, number, before, bench.geometry, bench.label, simulated)
        plan = photograph_plan(exposure_ms, self._slides.average, _DARK_FRAMES)
        plan = plan.model_copy(update={"label": f"bead slide {number + 1}"})
        runner = BEADS.prepare(bench, plan, self._folder, record, self._control, self._listener)
        if self.newest is not None:
            went_on(self.newest, runner.path)
        self.newest = runner.path
        return photograph_of(completed(runner.execute()), self._slides.binning)

    def _keep(self, taken: Photograph) -> None:
        """Count a slide as done, and write its mean for whoever solves it otherwise."""
        bench = self._bench
        facts = {"bench": bench.label, "simulated": bool(bench.simulated_kinds)}
        facts |= {"binning": self._slides.binning, "dark": "taken off", "scatter": plain(taken.scatter)}
        file = named_by_worth(taken.run.path / SLIDE_FILE, doubted=bool(taken.findings), overwrite=True)
        write_image(file, taken.measurement, facts)
        self.photographs.append(taken)


def show_slide_again(run: Run, bench: Bench, _first: int) -> None:
    """Have the slide before the camera that the first frames of a run saw."""
    record = BEADS.read(run.path)
    if (changer := _slide_changer(bench)) is not None:
        changer.change_slide(record.number)
    elif bench.ask is not None:
        of = f"Photograph {record.number + 1} of {record.slides.images}"
        bench.ask(f"{of} goes on: the bead slide must lie as it lay for its first frames.")


def mean_images(frames: Sequence[Array]) -> Float32Array:
    """Stack grey or colour images of one shape as float32, colours averaged.

    Raises BenchError when shapes differ.
    """
    grey = [image if image.ndim == 2 else image.mean(axis=-1) for image in frames]
    shapes = {image.shape for image in grey}
    if len(shapes) != 1:
        found = ", ".join(f"{h} x {w}" for h, w in sorted(shapes))
        raise BenchError(f"The images differ in size ({found}); all must come from one camera setting.")
    return np.stack(grey).astype(np.float32)
