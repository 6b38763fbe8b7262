"""A reconstruction that is asked for: its form, what the form comes to, and the job that does it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PySide6.QtCore import Signal
from PySide6.QtWidgets import QCompleter, QWidget

from gui.forms.fields import Behaviour
from gui.forms.options_form import FOLDED, OptionsForm
from gui.jobs import JobContext
from gui.widgets.building import button, fill, in_row, label, scrolled, share_bar
from gui.widgets.dialogues import IMAGES
from gui.widgets.tab_order import take_turns
from instrument.files.errors import BenchError
from instrument.reconstruction.checkpointing import checkpoint_for, require_kept, settle_checkpoint
from instrument.reconstruction.forecast import Forecast
from instrument.reconstruction.foretold import Foretold, Like
from instrument.reconstruction.job import Job as Prepared
from instrument.reconstruction.options import InputOptions, OutputOptions, SourceOptions
from instrument.reconstruction.request import (
    PictureRequest,
    VolumeRequest,
    request_of,
)
from instrument.reconstruction.result_file import Outputs, write_reconstruction, write_volume
from recon.arrays import Float32Array
from recon.base.as_python import Imports, expression
from recon.base.declare import option, options_of
from recon.priors import PRIORS
from recon.reconstruction.choice import Decision
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import IterationRecord

CALIBRATION, PSF, VOLUME = "Picture (calibration)", "Picture (PSF image)", "Volume (PSFs)"
SOURCES = {CALIBRATION: "calibration", PSF: "psf", VOLUME: "volume"}
"""The option that names the PSFs of each kind."""
_OF_A_PSF_IMAGE = ("allow_saturated", "allow_mixed_depth")
_MOST_DEPTHS = 8
"""More of them are named as a range."""
_FOLDED = (*FOLDED, "Computing")


@dataclass(frozen=True, kw_only=True)
class _KindOptions:
    """What only the window asks for."""

    kind: str = option(
        CALIBRATION,
        help="What to reconstruct, and from what the PSFs come.",
        choices=tuple(SOURCES),
        label="What",
        group="Input",
    )


class ReconstructForm(QWidget):
    """The options of a reconstruction, its progress, and the buttons that start and end it.

    ``parts`` makes it, best where it has its place.

    Signals
    -------
    asked
        Reconstruct now: the fields are understood.
    questioned
        Only say what would be chosen, and why.
    stopped
        End the work and keep what there is.
    refused : object, str
        A field and why it is refused.
    """

    asked = Signal()
    questioned = Signal()
    stopped = Signal()
    refused = Signal(object, str)

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._depths_mm: tuple[str, ...] = ()
        self._kind = CALIBRATION

    def parts(self) -> Iterator[None]:
        """Make the fields, then what goes round them."""
        source = [o for o in options_of(SourceOptions) if o.name in ("image", *SOURCES.values())]
        output = [o for o in options_of(OutputOptions) if o.name in ("out", "rotate_deg", "checkpoint")]
        iterated = Behaviour(enabled_when=_one_shot)
        self.options = OptionsForm(
            [_KindOptions, *source, ReconstructionOptions, InputOptions, *output],
            {
                "image": Behaviour(filters=IMAGES, must_exist=True, needed=True),
                "psf": Behaviour(filters=IMAGES, must_exist=True, needed=True),
                "calibration": Behaviour(must_exist=True, needed=True),
                "volume": Behaviour(browse="folder", must_exist=True, needed=True),
                "z_um": Behaviour(needed_when=self._which_depth),
                "scratch": Behaviour(must_exist=True),
                "solver": Behaviour(help_of=lambda name: SOLVERS[name].help if name in SOLVERS else ""),
                "prior": Behaviour(help_of=lambda name: PRIORS[name].help if name in PRIORS else ""),
                "out": Behaviour(
                    browse="save", filters="Results (*.tif *.ome.zarr)", needed=True, require=self._no_result
                ),
                **dict.fromkeys(("iterations", "time_s", "tolerance", "stop_at_noise"), iterated),
            },
            folded=_FOLDED,
            whole=False,
        )
        self.widgets = self.options.widgets
        tip = "Reconstruct with these settings (Ctrl+Return)"
        self.start = button(
            "Reconstruct", tip, lambda: self._ask(self.asked), shortcut="Ctrl+Return", primary=True
        )
        tip = "Say what would be chosen and why, and what time and memory it takes; nothing is written"
        self.explain = button("Explain", tip, lambda: self._ask(self.questioned))
        tip = "End after the iteration in progress; what there is then is kept"
        self.stop = button("Stop and keep", tip, self.stopped, enabled=False)
        self.progress = share_bar()
        self.note = label(role="dim", wraps=True)
        buttons = in_row((self.start, 1), self.explain, self.stop)
        fill(self, (scrolled(self.options), 1), self.note, self.progress, buttons)
        yield
        yield from self.options.parts()
        self.options.refused.connect(self.refused)
        self.options.settled.connect(lambda name: self._show_kind() if name == "kind" else None)
        yield
        self._show_kind()
        self.show_depths(())

    # What is asked for ---------------------------------------------------------------------------
    @property
    def kind(self) -> str:
        """What is to be reconstructed: one of :data:`SOURCES`."""
        return str(self.options.value("kind"))

    @property
    def source(self) -> str:
        """The option that names the PSFs of this kind of reconstruction."""
        return SOURCES[self.kind]

    def text(self, name: str) -> str:
        """Return what is typed in a field."""
        return str(self.options.fields[name].raw()).strip()

    def request(self) -> PictureRequest | VolumeRequest:
        """Return what the form asks for.

        Raises BenchError when a field is not understood, or does not go with the others.
        """
        make = self.options.make
        return request_of(make(SourceOptions), make(InputOptions), make(ReconstructionOptions))

    def work(self) -> ReconstructionWork:
        """Return all that the form asks for: what, whereto, kept where; errors as :meth:`request`."""
        output, request, outputs = self.options.make(OutputOptions), self.request(), self.outputs()
        require_kept(output.checkpoint, request, outputs.files())
        return ReconstructionWork(request, outputs, output.checkpoint, int(output.rotate_deg))

    def outputs(self) -> Outputs:
        """Return where the result goes.

        Raises FileError when the name does not end as it must.
        """
        volume = self.kind == VOLUME
        uncertainty = bool(self.options.value("uncertainty")) and not volume
        return Outputs.named(self.options.value("out"), volume=volume, uncertainty=uncertainty)

    def as_python(self) -> str:
        """Return lines that make this reconstruction; errors as :meth:`work`."""
        return lines_of(self.work())

    def show_depths(self, depths_um: Sequence[float]) -> None:
        """Offer the depths that the calibration has PSFs of; none where there is one, or none is known."""
        self._depths_mm = tuple(f"{z_um / 1e3:.5g}" for z_um in depths_um)
        several = len(self._depths_mm) > 1
        field: Any = self.widgets["z_um"]
        words = f"{self._depths_words()}: which one? (mm)" if several else "the calibrated one (mm)"
        field.setPlaceholderText(words)
        offered = QCompleter(list(self._depths_mm) if several else [], field)
        offered.setCompletionMode(QCompleter.CompletionMode.UnfilteredPopupCompletion)
        field.setCompleter(offered)

    def _depths_words(self) -> str:
        shown = self._depths_mm
        if len(shown) > _MOST_DEPTHS:
            return f"{len(shown)} from {shown[0]} to {shown[-1]}"
        return ", ".join(shown)

    # While it runs -------------------------------------------------------------------------------
    def set_running(self, running: bool, *, keeps: bool = True) -> None:
        """Let it be started, or stopped, which ``keeps`` what there is then or nothing."""
        self.stop.setText("Stop and keep" if keeps or not running else "Stop")
        begin, end = (self.start, self.explain), (self.stop,)
        take_turns(*((end, begin) if running else (begin, end)))
        if not running:
            self.progress.setValue(0)

    def show_progress(self, share: float, note: str) -> None:
        """Show how much is done, 0 to 1, and a few words."""
        self.progress.setValue(round(1000 * share))
        self.note.setText(note)

    # Inside --------------------------------------------------------------------------------------
    def _show_kind(self) -> None:
        """Show what applies; a folder of PSFs that was named for one kind is offered to the next."""
        kind, before = self.kind, self._kind
        self._kind = kind
        named = self.text(SOURCES[before])
        others = [name for one, name in SOURCES.items() if one != kind]
        away = others if kind == PSF else [*others, *_OF_A_PSF_IMAGE]
        self.options.show_for("volume" if kind == VOLUME else "picture", but_not=away)
        if PSF not in (kind, before) and named and not self.text(self.source):
            self.options.set_values({self.source: Path(named)})

    def _which_depth(self) -> str:
        """Say why a distance is needed; empty where it is not."""
        if self.kind != CALIBRATION or len(self._depths_mm) < 2:
            return ""
        return f"The calibration has PSFs of several depths: {self._depths_words()} mm. Which one is it?"

    def _no_result(self, path: Path) -> str:
        try:
            Outputs.named(path, volume=self.kind == VOLUME)
        except BenchError as error:
            return str(error)
        return ""

    def _ask(self, signal: Any) -> None:
        """Refuse what is not understood, else ask for the work."""
        if self.options.check():
            signal.emit()


def _one_shot(present: dict[str, Any]) -> str:
    """Say why what ends iterations does not apply; empty where it does."""
    solver = str(present.get("solver"))
    one_step = solver in SOLVERS and SOLVERS[solver].one_step
    return f"{solver} is one shot: it has no iterations." if one_step else ""


@dataclass(frozen=True, slots=True)
class SoFar:
    """How far a reconstruction is.

    Attributes
    ----------
    share : float
        Of the work that is done, 0 to 1.
    note : str
    prepared : Prepared
        What went in, and what was chosen on the way, in words.
    image : ndarray, float32, or None
        The picture so far; of a volume the brightest over depth.
    history : tuple of IterationRecord
    """

    share: float
    note: str
    prepared: Prepared
    image: Float32Array | None = None
    history: tuple[IterationRecord, ...] = ()


@dataclass(frozen=True, slots=True)
class ReconstructionWork:
    """All that a reconstruction is asked for.

    Attributes
    ----------
    request : PictureRequest or VolumeRequest
    outputs : Outputs
    kept_in : Path or None
        The checkpoint's folder.
    rotate_deg : int
        A picture is turned by so much, counter-clockwise, when it is written.
    """

    request: PictureRequest | VolumeRequest
    outputs: Outputs
    kept_in: Path | None = None
    rotate_deg: int = 0


@dataclass(frozen=True, slots=True)
class Written:
    """The file that was written, and what became of the checkpoint, by headings."""

    path: Path
    checkpoint: dict[str, str]


def reconstruct_job(work: ReconstructionWork, context: JobContext) -> Written:
    """Do a reconstruction as the command line does; cancelled, what there is so far is written."""
    request, outputs = work.request, work.outputs
    outputs.check(0)
    prepared = request.prepare()
    n_planes = len(prepared.calibration.psfs) if isinstance(request, VolumeRequest) else 1
    outputs.check(n_planes * prepared.measurement.size)
    expected = warned = ""

    def foretell(words: str) -> None:
        nonlocal expected
        expected = f"; {words}"

    def warn(words: str) -> None:
        nonlocal warned
        warned = f"; {words}"

    keeper = checkpoint_for(work.kept_in, prepared, request, say=warn)
    context.report(SoFar(0.0, "Solving …", prepared))
    history: list[IterationRecord] = []
    share, note = 0.0, ""
    foretold = Foretold(foretell, Like.of(prepared, request.options))

    def watch(record: IterationRecord, present: Callable[[], Float32Array]) -> None:
        history.append(record)
        foretold.watch(record, present)
        # Of a picture its only plane.
        context.offer(lambda: SoFar(share, note, prepared, np.array(present().max(axis=0)), tuple(history)))

    def stage(done: float, what: str) -> None:
        nonlocal share, note
        foretold.stage(done, what)
        share, note = done, what + expected + warned
        context.offer(lambda: SoFar(share, note, prepared, None, tuple(history)))

    with foretold:
        if isinstance(request, VolumeRequest):
            volume = request.solve(
                prepared, watch=watch, cancel=context.cancel, keeper=keeper, on_stage=stage
            )
            foretold.ended(volume.stop_reasons)
            write_volume(outputs, volume, prepared)
            settled = settle_checkpoint(keeper, volume.stop_reasons)
        else:
            picture = request.solve(
                prepared, watch=watch, cancel=context.cancel, keeper=keeper, on_stage=stage
            )
            foretold.ended([picture.stop_reason])
            write_reconstruction(outputs, picture, prepared, rotate_deg=work.rotate_deg)
            settled = settle_checkpoint(keeper, [picture.stop_reason])
    return Written(outputs.image, settled)


@dataclass(frozen=True, slots=True)
class Explained:
    """What would be chosen (nothing, where a model was asked for), and what all of it takes, once known."""

    decisions: tuple[Decision, ...]
    takes: Forecast | None = None


def explain_job(request: PictureRequest | VolumeRequest, context: JobContext) -> Explained:
    """Say what ``--explain`` says: what would be chosen, and time and memory by the first iterations."""
    prepared = request.prepare()
    context.check()
    chosen = request.explain(prepared).decisions if request.options.model == "auto" else ()
    context.report(Explained(chosen))  # read while its time is tried

    def stage(share: float, what: str) -> None:
        context.check()
        context.offer(lambda: SoFar(share, f"Trying what it takes: {what}", prepared))

    return Explained(chosen, request.forecast(prepared, stage))


def lines_of(work: ReconstructionWork) -> str:
    """Return the Python that does a reconstruction."""
    volume = isinstance(work.request, VolumeRequest)
    write = "write_volume" if volume else "write_reconstruction"
    imports = Imports({("instrument.reconstruction.result_file", "Outputs")})
    imports.names.add(("instrument.reconstruction.result_file", write))
    lines = [f"request = {expression(work.request, imports)}", "job = request.prepare()"]
    settled: list[str] = []
    if work.kept_in is None:
        lines.append("result = request.solve(job)")
    else:
        kept = "instrument.reconstruction.checkpointing"
        imports.names |= {(kept, "checkpoint_for"), (kept, "settle_checkpoint")}
        reasons = "result.stop_reasons" if volume else "[result.stop_reason]"
        lines += [
            f"keeper = checkpoint_for({expression(work.kept_in, imports)}, job, request)",
            "result = request.solve(job, keeper=keeper)",
        ]
        settled.append(f"settle_checkpoint(keeper, {reasons})")
    kind = ", volume=True" if volume else ", uncertainty=True" if work.outputs.deviation is not None else ""
    named = f"Outputs.named({expression(work.outputs.image, imports)}{kind})"
    turned = f", rotate_deg={work.rotate_deg}" if work.rotate_deg and not volume else ""
    lines.append(f"{write}({named}, result, job{turned})")
    return "\n".join([*imports.lines(), "", *lines, *settled, ""])
