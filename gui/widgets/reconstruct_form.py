"""The form of a reconstruction: what is typed becomes a request, the same that the command line makes."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import (
    QComboBox,
    QCompleter,
    QFormLayout,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QVBoxLayout,
    QWidget,
)

from gui.reconstruction_work import ReconstructionWork, lines_of
from gui.widgets.advanced_fields import AdvancedFields
from gui.widgets.entry import Entry, PathEntry, existing_path, narrow, number
from instrument.files.errors import BenchError
from instrument.reconstruction.preparation import Crop
from instrument.reconstruction.request import (
    PictureRequest,
    Settings,
    VolumeRequest,
    known_model,
)
from instrument.reconstruction.result_file import Outputs
from instrument.reconstruction.words import parse_binning, parse_dark, parse_erasures, parse_noise
from recon.camera.camera_model import MODELS
from recon.priors import PRIORS
from recon.reconstruction.solve import ITERATIONS
from recon.reconstruction.solvers import SOLVERS, VOLUME_PRIORS

CALIBRATION, PSF, VOLUME = "Picture, from a calibration", "Picture, from a PSF image", "Volume, from PSFs"
_IMAGES = "Images (*.tif *.tiff *.png *.npy *.npz *.bmp *.jpg);;All files (*)"
_AUTOMATIC = "automatic"
_MOST_DEPTHS = 8
"""More of them are told as a range."""
BACKGROUNDS = {_AUTOMATIC: None, "estimated": True, "none": False}


class ReconstructForm(QWidget):
    """Fields of a reconstruction, its progress, and the buttons that start and end it.

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
        self.kind = QComboBox()
        self.kind.addItems([CALIBRATION, PSF, VOLUME])
        self.kind.setToolTip("What to reconstruct, and from what the PSFs come")
        self.image = Entry(existing_path, tip="The photograph: TIFF, PNG or NumPy, raw counts")
        self.psfs = Entry(existing_path, tip="A calibration's folder, or a run that holds one")
        self.method = QComboBox()
        self.method.addItems(SOLVERS.names())
        self.method.setToolTip("admm: best; admm-sensor: dense scenes; fista: plain; wiener: one shot")
        self.model = QComboBox()
        self.model.addItems(MODELS)
        self.model.setToolTip("Camera model; auto: the smallest that explains the PSFs")
        self.prior = QComboBox()
        self.prior.setToolTip("What the scene is like; automatic: tv (for wiener: none)")
        self.z_mm = Entry(
            number("The distance", "mm", above_zero=True),
            tip="Distance of the scene in mm; needed where the calibration has several depths",
            placeholder="the calibrated one (mm)",
        )
        self.iterations = Entry(
            number("The number of iterations", "", above_zero=True, whole=True),
            tip="At most so many iterations",
        )
        self.time_s = Entry(
            number("The time", "s", above_zero=True),
            tip="At most so many seconds",
            placeholder="no limit (s)",
        )
        self.tau = Entry(
            number("tau", ""), tip="Weight of the prior, relative to the data", placeholder="from the noise"
        )
        self.noise = Entry(
            lambda text: parse_noise(text or None),
            tip="Camera noise: standard deviation in counts, or read noise in counts and counts per electron",
            placeholder="known, else estimated (counts)",
        )
        self.dark = Entry(parse_dark, "auto", tip="auto, an offset in counts, or the file of a dark frame")
        self.crop = Entry(
            lambda text: Crop.parse(text) if text else None,
            tip="Window in pixels: TOP,LEFT,HEIGHT,WIDTH, or HEIGHTxWIDTH in the middle",
            placeholder="whole image (pixels)",
        )
        self.binning = Entry(
            parse_binning, "auto", tip="Average N x N pixels; auto: to at most 0.5 megapixel"
        )
        self.erasures = Entry(
            parse_erasures,
            "saturated",
            tip="Pixels left out: none, saturated, a share (0.5), or a mask's file",
        )
        self.background = QComboBox()
        self.background.addItems(list(BACKGROUNDS))
        self.background.setToolTip(
            "Estimate a smooth background as well: stray light that no model explains ends up as haze"
        )
        self.advanced = AdvancedFields()
        self.out = Entry(self._understand_out, tip="Where the result is written; .png and .json go beside it")
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
        self._arrange()
        self.kind.currentTextChanged.connect(self._kind_changed)
        self.method.currentTextChanged.connect(self._method_changed)
        for entry in self._entries():
            entry.refused.connect(lambda why, field=entry: self.refused.emit(field, why))
        self._kind_changed()

    def _arrange(self) -> None:
        self._rows = QFormLayout()
        self._rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        self._rows.setContentsMargins(2, 6, 8, 2)
        for box in (self.kind, self.method, self.model, self.prior, self.background):
            narrow(box)
        self._rows.setRowWrapPolicy(QFormLayout.RowWrapPolicy.DontWrapRows)
        self._rows.setVerticalSpacing(4)
        self._psfs_row = PathEntry(self.psfs, "folder")
        for name, widget in (
            ("What", self.kind),
            ("Photograph", PathEntry(self.image, "open", _IMAGES)),
            ("PSFs", self._psfs_row),
            ("Distance", self.z_mm),
            ("Method", self.method),
            ("Model", self.model),
            ("Prior", self.prior),
            ("Iterations", self.iterations),
            ("Time", self.time_s),
            ("tau", self.tau),
            ("Noise", self.noise),
            ("Dark", self.dark),
            ("Crop", self.crop),
            ("Binning", self.binning),
            ("Erasures", self.erasures),
            ("Background", self.background),
            ("Result", PathEntry(self.out, "save", "Results (*.tif *.ome.zarr)")),
        ):
            self._rows.addRow(name, widget)
        self._rows.addRow(self.advanced)
        inside = QWidget()
        inside.setLayout(self._rows)
        scroll = QScrollArea()
        scroll.setWidget(inside)
        scroll.setWidgetResizable(True)
        scroll.setFrameShape(QScrollArea.Shape.NoFrame)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        buttons = QHBoxLayout()
        buttons.addWidget(self.start, 1)
        buttons.addWidget(self.explain)
        buttons.addWidget(self.stop)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(scroll, 1)
        layout.addWidget(self.note)
        layout.addWidget(self.progress)
        layout.addLayout(buttons)

    # What is asked for ---------------------------------------------------------------------------
    def request(self) -> PictureRequest | VolumeRequest:
        """Return what the fields ask for.

        Raises
        ------
        BenchError
            When a field is not understood; the text says which and why.
        """
        prior = self.prior.currentText()
        settings = Settings(
            model=known_model(self.model.currentText()),
            dark=self.dark.value(),
            crop=self.crop.value(),
            binning=self.binning.value(),
            erasures=self.erasures.value(),
            noise=self.noise.value(),
            prior=None if prior == _AUTOMATIC else prior,
            tau=self.tau.value(),
            iterations=None if self._is_one_shot else self.iterations.value(),
            time_s=None if self._is_one_shot else self.time_s.value(),
        )
        image, psfs = self.image.value(), self.psfs.value()
        kind = self.kind.currentText()
        if kind == VOLUME:
            return self.advanced.apply(
                VolumeRequest(
                    image=image,
                    psfs=psfs,
                    estimate_background=BACKGROUNDS[self.background.currentText()],
                    settings=settings,
                )
            )
        z_mm = self.z_mm.value()
        if kind == CALIBRATION and z_mm is None and len(self._depths_mm) > 1:
            why = f"The calibration has PSFs of several depths: {self._depths_words()} mm. Which one is it?"
            self.z_mm.refuse(why)
            raise BenchError(why)
        return self.advanced.apply(
            PictureRequest(
                image=image,
                psf=psfs if kind == PSF else None,
                calibration=psfs if kind == CALIBRATION else None,
                z_um=None if z_mm is None else 1e3 * z_mm,
                method=self.method.currentText(),
                settings=settings,
            )
        )

    def show_depths(self, depths_um: Sequence[float]) -> None:
        """Offer the depths that the calibration has PSFs of; none where there is one, or none is known."""
        self._depths_mm = tuple(f"{z_um / 1e3:.5g}" for z_um in depths_um)
        several = len(self._depths_mm) > 1
        words = f"{self._depths_words()}: which one? (mm)" if several else "the calibrated one (mm)"
        self.z_mm.setPlaceholderText(words)
        offered = QCompleter(list(self._depths_mm) if several else [], self.z_mm)
        offered.setCompletionMode(QCompleter.CompletionMode.UnfilteredPopupCompletion)
        self.z_mm.setCompleter(offered)

    def _depths_words(self) -> str:
        shown = self._depths_mm
        if len(shown) > _MOST_DEPTHS:
            return f"{len(shown)} from {shown[0]} to {shown[-1]}"
        return ", ".join(shown)

    def work(self) -> ReconstructionWork:
        """Return all that the fields ask for: what, whereto, kept where; errors as the parts."""
        return ReconstructionWork(
            self.request(), self.outputs(), self.advanced.kept_in, self.advanced.rotate_deg
        )

    def outputs(self) -> Outputs:
        """Return where the result goes.

        Raises
        ------
        FileError
            When the name does not end as it must.
        """
        outputs: Outputs = self.out.value()
        return outputs

    def as_python(self) -> str:
        """Return lines that make this reconstruction; errors as :meth:`work`."""
        return lines_of(self.work())

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
    @property
    def _is_one_shot(self) -> bool:
        return self.kind.currentText() != VOLUME and self.method.currentText() == "wiener"

    def _entries(self) -> list[Entry]:
        return [
            self.image,
            self.psfs,
            self.z_mm,
            self.iterations,
            self.time_s,
            self.tau,
            self.noise,
            self.dark,
            self.crop,
            self.binning,
            self.erasures,
            self.out,
            *self.advanced.entries,
        ]

    def _understand_out(self, text: str) -> Outputs:
        if not text:
            raise BenchError("The result needs a name that ends in .tif (volumes: or .ome.zarr).")
        return Outputs.named(Path(text).expanduser(), volume=self.kind.currentText() == VOLUME)

    def _kind_changed(self, _text: str = "") -> None:
        kind = self.kind.currentText()
        volume = kind == VOLUME
        self._psfs_row.set_browse("open" if kind == PSF else "folder")
        self.psfs.setToolTip(
            {
                CALIBRATION: "A calibration's folder, or a run that holds one",
                PSF: "An image of the PSF, from the photograph's camera",
                VOLUME: "A calibration, a stack or a folder of PSFs, one a depth",
            }[kind]
        )
        self.prior.clear()
        self.prior.addItems([_AUTOMATIC, *(VOLUME_PRIORS if volume else PRIORS)])
        self.iterations.setPlaceholderText(f"at most {ITERATIONS}; none with a time")
        for widget, shown in (
            (self.method, not volume),
            (self.z_mm, not volume),
            (self.background, volume),
        ):
            self._rows.setRowVisible(widget, shown)
        self.advanced.show_for(volume=volume, psf=kind == PSF)
        self._method_changed()

    def _method_changed(self, _text: str = "") -> None:
        for entry in (self.iterations, self.time_s):
            entry.setEnabled(not self._is_one_shot)

    def _ask(self, signal: Any) -> None:
        """Refuse the first field that is not understood, else ask for the work."""
        for entry in self._entries():
            if self._applies(entry) and not entry.check():
                self.advanced.reveal(entry)
                entry.setFocus()
                return
        signal.emit()

    def _applies(self, entry: Any) -> bool:
        return bool(entry.isEnabled()) and not (entry is self.z_mm and self.kind.currentText() == VOLUME)
