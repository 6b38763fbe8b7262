"""The form of a reconstruction: declared options become a request, the same that the command line makes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PySide6.QtCore import Signal
from PySide6.QtWidgets import (
    QCompleter,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QVBoxLayout,
    QWidget,
)

from gui.forms.fields import Behaviour
from gui.forms.options_form import FOLDED, OptionsForm, scrolled
from gui.reconstruction_work import ReconstructionWork, lines_of
from instrument.files.errors import BenchError
from instrument.reconstruction.checkpointing import require_kept
from instrument.reconstruction.options import InputOptions, OutputOptions, SourceOptions
from instrument.reconstruction.request import PictureRequest, VolumeRequest, request_of
from instrument.reconstruction.result_file import Outputs
from recon.base.declare import option, options_of
from recon.priors import PRIORS
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.solvers import SOLVERS

CALIBRATION, PSF, VOLUME = "Picture (calibration)", "Picture (PSF image)", "Volume (PSFs)"
SOURCES = {CALIBRATION: "calibration", PSF: "psf", VOLUME: "volume"}
"""The option that names the PSFs of each kind."""
_IMAGES = "Images (*.tif *.tiff *.png *.npy *.npz *.bmp *.jpg);;All files (*)"
_OF_A_PSF_IMAGE = ("allow_saturated", "allow_mixed_depth")
_MOST_DEPTHS = 8
"""More of them are told as a range."""
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
        source = [o for o in options_of(SourceOptions) if o.name in ("image", *SOURCES.values())]
        output = [o for o in options_of(OutputOptions) if o.name in ("out", "rotate_deg", "checkpoint")]
        iterated = Behaviour(enabled_when=_one_shot)
        self.options = OptionsForm(
            [_KindOptions, *source, ReconstructionOptions, InputOptions, *output],
            {
                "image": Behaviour(filters=_IMAGES, must_exist=True, needed=True),
                "psf": Behaviour(filters=_IMAGES, must_exist=True, needed=True),
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
        )
        self.widgets = self.options.widgets
        self.start = QPushButton("Reconstruct")
        self.start.setObjectName("primary")
        self.start.setToolTip("Reconstruct with these settings (Ctrl+Return)")
        self.start.setShortcut("Ctrl+Return")
        self.start.clicked.connect(lambda: self._ask(self.asked))
        self.explain = QPushButton("Explain")
        self.explain.setToolTip(
            "Say what model auto would choose, why, and what one step up or down would cost"
        )
        self.explain.clicked.connect(lambda: self._ask(self.questioned))
        self.stop = QPushButton("Stop and keep")
        self.stop.setToolTip("End after the iteration in progress; what there is then is kept")
        self.stop.setEnabled(False)
        self.stop.clicked.connect(self.stopped)
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setTextVisible(False)
        self.note = QLabel()
        self.note.setWordWrap(True)
        self.note.setProperty("role", "dim")
        buttons = QHBoxLayout()
        buttons.addWidget(self.start, 1)
        buttons.addWidget(self.explain)
        buttons.addWidget(self.stop)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(scrolled(self.options), 1)
        layout.addWidget(self.note)
        layout.addWidget(self.progress)
        layout.addLayout(buttons)
        self.options.refused.connect(self.refused)
        self.options.settled.connect(lambda name: self._show_kind() if name == "kind" else None)
        self._kind = CALIBRATION
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

        Raises
        ------
        BenchError
            When a field is not understood, or does not go with the others.
        """
        make = self.options.make
        return request_of(make(SourceOptions), make(InputOptions), make(ReconstructionOptions))

    def work(self) -> ReconstructionWork:
        """Return all that the form asks for: what, whereto, kept where; errors as :meth:`request`."""
        output, request = self.options.make(OutputOptions), self.request()
        if output.checkpoint is not None:
            require_kept(request)
        return ReconstructionWork(request, self.outputs(), output.checkpoint, int(output.rotate_deg))

    def outputs(self) -> Outputs:
        """Return where the result goes.

        Raises
        ------
        FileError
            When the name does not end as it must.
        """
        return Outputs.named(self.options.value("out"), volume=self.kind == VOLUME)

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
    def set_running(self, running: bool) -> None:
        """Let it be started, or stopped."""
        self.start.setEnabled(not running)
        self.explain.setEnabled(not running)
        self.stop.setEnabled(running)
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
    """Say why nothing tells it when to stop; empty where something does."""
    solver = str(present.get("solver"))
    one_step = solver in SOLVERS and SOLVERS[solver].one_step
    return f"{solver} is one shot: it has no iterations." if one_step else ""
