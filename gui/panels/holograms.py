"""Holograms: target and what counts in it, computing, showing on the SLM, what the camera saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFormLayout,
    QHBoxLayout,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QSplitter,
    QVBoxLayout,
    QWidget,
)

from gui.background_reading import NewestOnly
from gui.hologram_work import (
    Computed,
    HologramOrder,
    Progress,
    compute,
    compute_lines,
    photograph,
    show_on_slm,
)
from gui.jobs import BusyError, Job
from gui.panel import Panel
from gui.python_lines import expression
from gui.session import BenchSession
from gui.theme import colours
from gui.widgets.entry import Entry, PathEntry, existing_path, narrow, number
from gui.widgets.hologram_words import (
    brush_radius,
    depth_mm,
    expansion,
    further_planes,
    maybe_path,
    pattern_png,
    share,
)
from gui.widgets.image_view import ImageView
from gui.widgets.plot import curve_pen, plot_widget, restyle
from gui.widgets.result_views import FactsView, ViewGrid
from gui.widgets.weights_view import WEIGHTS_SHAPE, WeightsView
from instrument.bench.display_setup import depth_limit_mm
from instrument.display.hologram_job import HologramResult, field_picture
from instrument.files.errors import BenchError
from instrument.files.images import read_image
from instrument.reconstruction.result_list import free_result
from recon.errors import InputError
from recon.holography import LOSSES, HologramOptions, Scores
from recon.holography.display import require_defocus

_IMAGES = "Pictures (*.png *.tif *.tiff *.jpg *.bmp *.npy)"
_PREVIEW_ITERATIONS = 8
_AVERAGE = 4
_MODES = {"all alike": "uniform", "a fovea, dragged": "fovea", "painted": "painted"}
_DEFAULT = HologramOptions()


class HologramsPanel(Panel):
    """A hologram of one picture, from the target to its photograph."""

    title = "Holograms"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.computed: Computed | None = None
        self.job: Job | None = None
        self._suggested: Path | None = None
        self._reader = NewestOnly(session.jobs, "Reading the picture")
        self._target_asked: tuple[Any, ...] | None = None
        self.picture = Entry(existing_path, tip="The picture to show: its values are intensities")
        self.fit = _choice(
            ["cover", "contain", "stretch"], "How a picture that is not square fills the field"
        )
        self.srgb = QCheckBox("sRGB-coded")
        self.srgb.setToolTip("The picture's values are decoded to intensities first")
        self.z_mm = Entry(
            self._depth_mm, tip="Depth behind the focal plane in mm", placeholder="0 mm: the focal plane"
        )
        self.further = Entry(
            self._further_planes,
            tip="Pictures in other planes: FILE @ DEPTH mm; several are separated by semicolons",
            placeholder="none (FILE @ 40 mm; …)",
        )
        self.expansion = Entry(
            expansion,
            tip="Étendue expansion: 4, 16, 36 …, a square",
            placeholder=f"{session.config.display.expansion}: the bench's",
        )
        self.weights_mode = _choice(list(_MODES), "Which part of the picture counts")
        self.periphery = Entry(
            share, "0.1", tip="Weight outside the fovea, or where nothing is painted (0 to 1)"
        )
        self.brush = Entry(brush_radius, "0.06", tip="Radius of the brush, as a fraction of the field")
        self.clear = QPushButton("Clear")
        self.clear.setToolTip("Take off all that was painted (left button paints, right button rubs out)")
        self.loss = _choice([], "\n".join(f"{loss.name}: {loss.help}" for loss in LOSSES.values()))
        self.envelope = _choice(
            ["shade", "correct", "ignore"],
            "The mask pixels' envelope: shade the target too, correct it in the hologram, or ignore it",
        )
        self.frames = Entry(
            number("The number of frames", "", above_zero=True, whole=True),
            "1",
            tip="Time-multiplexed frames",
        )
        self.iterations = Entry(
            number("The number of iterations", "", above_zero=True, whole=True),
            str(_DEFAULT.iterations),
            tip="At most so many",
        )
        self.psnr_db = Entry(
            number("The PSNR", "dB", above_zero=True), tip="Stop at this PSNR", placeholder="no limit (dB)"
        )
        self.alignment = Entry(maybe_path, tip="From align mask: alignment.json", placeholder="not aligned")
        self.correction = Entry(maybe_path, tip="From calibrate slm", placeholder="an ideal SLM")
        self.out = Entry(pattern_png, tip="8-bit phase, 256 levels a turn; .json and a preview go beside it")
        self.preview_button = QPushButton("Preview")
        self.preview_button.setToolTip(f"{_PREVIEW_ITERATIONS} iterations, nothing is written")
        self.compute_button = QPushButton("Compute")
        self.compute_button.setObjectName("primary")
        self.compute_button.setToolTip("Compute and write the pattern (Ctrl+Return)")
        self.compute_button.setShortcut("Ctrl+Return")
        self.stop_button = QPushButton("Stop and keep")
        self.stop_button.setToolTip("End after the iteration in progress; what there is then is kept")
        self.show_button = QPushButton("Show on SLM")
        self.show_button.setToolTip("Put the pattern on the SLM, its look-up table and flatness applied")
        self.capture_button = QPushButton("Show and photograph")
        self.capture_button.setToolTip(
            "Show it, register the camera by the mask's speckle, photograph, compare with the target"
        )
        self.progress = QProgressBar()
        self.progress.setRange(0, 1000)
        self.progress.setTextVisible(False)
        self.target = WeightsView()
        self.target.graphics.setToolTip(
            "A fovea is dragged, or moved by arrow keys (Alt with Up and Down: its radius). Painting: left "
            "button or Space paints, right button or Backspace rubs out, arrow keys move the brush"
        )
        self.seen, self.phase, self.captured = ImageView(), ImageView(), ImageView()
        self.plane = _choice([], "The plane that is looked at")
        self.plane.currentIndexChanged.connect(self._show_plane)
        self.plane.hide()
        self.metrics = FactsView()
        self.plot = plot_widget("iteration", "PSNR", y_unit="dB")
        self.plot.setMinimumSize(120, 80)
        for view in (self.target, self.seen, self.phase, self.captured):
            view.setMinimumSize(70, 50)
        self.plot.setToolTip("PSNR of the seen image, computed, as the optimiser goes")
        self._arrange()
        self._connect()
        self._show_mode()
        self._set_running(False)

    def _arrange(self) -> None:
        rows = QFormLayout()
        rows.setVerticalSpacing(4)
        rows.setContentsMargins(2, 6, 8, 2)
        rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        painting = QHBoxLayout()
        painting.addWidget(self.brush)
        painting.addWidget(self.clear)
        self._painting = QWidget()
        self._painting.setLayout(painting)
        painting.setContentsMargins(0, 0, 0, 0)
        for name, widget in (
            ("Picture", PathEntry(self.picture, "open", _IMAGES)),
            ("Fit", self.fit),
            ("", self.srgb),
            ("Depth", self.z_mm),
            ("Further planes", self.further),
            ("Counts", self.weights_mode),
            ("Elsewhere", self.periphery),
            ("Brush", self._painting),
            ("Loss", self.loss),
            ("Expansion", self.expansion),
            ("Envelope", self.envelope),
            ("Frames", self.frames),
            ("Iterations", self.iterations),
            ("PSNR", self.psnr_db),
            ("Alignment", PathEntry(self.alignment, "open", "Alignments (*.json)")),
            ("SLM's table", PathEntry(self.correction, "open", "SLM calibrations (*.json)")),
            ("Pattern", PathEntry(self.out, "save", "Patterns (*.png)")),
        ):
            rows.addRow(name, widget)
        self._rows = rows
        inside = QWidget()
        inside.setLayout(rows)
        scroll = QScrollArea()
        scroll.setWidget(inside)
        scroll.setWidgetResizable(True)
        scroll.setFrameShape(QScrollArea.Shape.NoFrame)
        scroll.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        left = QWidget()
        column = QVBoxLayout(left)
        column.setContentsMargins(0, 0, 0, 0)
        column.addWidget(scroll, 1)
        column.addWidget(self.plane)
        column.addWidget(self.progress)
        for buttons in (
            (self.preview_button, self.compute_button, self.stop_button),
            (self.show_button, self.capture_button),
        ):
            row = QHBoxLayout()
            for button in buttons:
                row.addWidget(button)
            column.addLayout(row)
        top = ViewGrid(
            [
                ("target, and what counts in it", self.target),
                ("seen by an eye (computed)", self.seen),
                ("phase on the SLM, 0 to 2π", self.phase),
                ("photographed", self.captured),
            ]
        )
        below = QSplitter(Qt.Orientation.Horizontal)
        below.addWidget(self.metrics)
        below.addWidget(self.plot)
        below.setSizes([480, 480])
        right = QSplitter(Qt.Orientation.Vertical)
        right.addWidget(top)
        right.addWidget(below)
        right.setStretchFactor(0, 4)
        right.setSizes([560, 150])
        whole = QSplitter(Qt.Orientation.Horizontal)
        whole.addWidget(left)
        whole.addWidget(right)
        whole.setStretchFactor(1, 1)
        whole.setSizes([280, 900])
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(whole)

    def _connect(self) -> None:
        for entry in self._entries():
            entry.refused.connect(lambda why, field=entry: self.refused(field, why))
        self.picture.understood.connect(self._picture_changed)
        for depths in (self.z_mm, self.further):  # the expansion sets how far they reach
            self.expansion.understood.connect(depths.check)
        self.fit.currentTextChanged.connect(lambda _: self._picture_changed())
        self.srgb.toggled.connect(lambda _: self._picture_changed())
        self.weights_mode.currentTextChanged.connect(lambda _: self._show_mode())
        self.periphery.understood.connect(lambda: self.target.set_periphery(self.periphery.value()))
        self.brush.understood.connect(lambda: self.target.set_brush_radius(self.brush.value()))
        self.clear.clicked.connect(self.target.clear_strokes)
        self.preview_button.clicked.connect(lambda: self.compute(preview=True))
        self.compute_button.clicked.connect(lambda: self.compute())
        self.stop_button.clicked.connect(self.stop)
        self.show_button.clicked.connect(self.show_on_slm)
        self.capture_button.clicked.connect(self.photograph)

    # What is asked for ---------------------------------------------------------------------------
    def order(self, *, preview: bool = False) -> HologramOrder:
        """Return what the fields ask for.

        Raises
        ------
        BenchError, InputError
            When a field is not understood, or nothing counts.
        """
        weights = self.target.weights()
        iterations = _PREVIEW_ITERATIONS if preview else self.iterations.value() or _DEFAULT.iterations
        options = HologramOptions(
            fit=self.fit.currentText(),  # type: ignore[arg-type]
            srgb=self.srgb.isChecked(),
            expansion=self.expansion.value(),
            loss=self.loss.currentText(),
            weights=weights,
            frames=self.frames.value() or 1,
            envelope=self.envelope.currentText(),  # type: ignore[arg-type]
            iterations=iterations,
            psnr_db=self.psnr_db.value(),
        )
        return HologramOrder(
            picture=self.picture.value(),
            out=self.out.value(),
            z_mm=self.z_mm.value(),
            alignment=self.alignment.value(),
            further=self.further.value(),
            options=options,
        )

    def _depth_mm(self, text: str) -> float:
        z_mm = depth_mm(text)
        self._require_reach(z_mm)
        return z_mm

    def _further_planes(self, text: str) -> tuple[tuple[Path, float], ...]:
        planes = further_planes(text)
        for _, z_mm in planes:
            self._require_reach(z_mm)
        return planes

    def _require_reach(self, z_mm: float) -> None:
        """Refuse a depth that the display cannot show; without its SLM that is not known."""
        slm = self.session.bench.slm
        if slm is None or not self.session.is_open("slm"):
            return
        try:
            q = self.expansion.value()
        except BenchError:
            return  # refused at its own field
        limit_mm = depth_limit_mm(self.session.config, (slm.shape, slm.pixel_pitch_um), expansion=q)
        try:
            require_defocus(z_mm, limit_mm)
        except InputError as error:
            raise BenchError(str(error)) from error

    def as_python(self) -> str:
        """Return lines that compute and write this hologram."""
        try:
            return compute_lines(self.order(), self.session.config, self._weights_expression())
        except (BenchError, InputError) as error:
            return f"# The form is not complete: {' '.join(str(error).split())}\n"

    def _weights_expression(self) -> str | None:
        view = self.target
        if view.mode == "uniform":
            return None
        if view.mode == "fovea":
            return (
                f"foveal_weights({WEIGHTS_SHAPE}, centre={view.centre}, radius={view.radius}, "
                f"periphery={view.periphery})"
            )
        return f"painted_weights({WEIGHTS_SHAPE}, {expression(view.strokes)}, background={view.periphery})"

    # Doing it ------------------------------------------------------------------------------------
    def compute(self, *, preview: bool = False) -> Job | None:
        """Compute the hologram; a preview takes few iterations and writes nothing."""
        if not all(self._understood(entry) for entry in self._entries()):
            return None
        slm = self.session.bench.slm
        if slm is None or not self.session.is_open("slm"):
            self.refused(None, "The bench's SLM is not open: it is not known what to compute a hologram for.")
            return None
        try:
            order = self.order(preview=preview)
        except (BenchError, InputError) as error:
            self.refused(None, str(error))
            return None
        self.accepted()
        if order.out == self._suggested and not preview:
            order.out.parent.mkdir(parents=True, exist_ok=True)
        config, size = self.session.config, (slm.shape, slm.pixel_pitch_um)
        title = "Previewing a hologram" if preview else f"Computing {order.out.name}"
        job = self.tells(
            self.jobs.compute(title, lambda context: compute(order, config, size, context, write=not preview))
        )
        self.job = job
        self._set_running(True)
        job.progressed.connect(self._progressed)
        job.succeeded.connect(self._computed)
        job.ended.connect(lambda: self._set_running(False))
        return job

    def _understood(self, entry: Entry) -> bool:
        if not entry.check():
            entry.setFocus()
            return False
        return True

    def stop(self) -> None:
        """End the computation, or the frames that follow each other on the SLM."""
        if self.job is not None:
            self.job.cancel()

    def show_on_slm(self) -> Job | None:
        """Put the computed pattern on the SLM."""
        computed = self.computed
        if computed is None or not self._understood(self.correction):
            return None
        correction = self.correction.value()
        bench = self.session.bench
        return self._device_job(
            lambda: self.session.device_job(
                f"Showing {computed.order.out.stem}",
                lambda context: show_on_slm(bench, computed, correction, context),
                {"slm"},
                endless=len(computed.result.hologram.slm) > 1,
            )
        )

    def photograph(self) -> Job | None:
        """Show the pattern, photograph it, and say how close it is to the target."""
        computed = self.computed
        if computed is None or not self._understood(self.correction):
            return None
        correction, bench = self.correction.value(), self.session.bench
        suggested = computed.order.out.parent == self._suggestions
        job = self._device_job(
            lambda: self.session.exclusive_job(
                f"Photographing {computed.order.out.stem}",
                lambda context: photograph(
                    bench, computed, correction, _AVERAGE, context, make_folder=suggested
                ),
            )
        )
        if job is not None:
            job.succeeded.connect(self._photographed)
        return job

    def _device_job(self, start: Any) -> Job | None:
        try:
            job: Job = start()
        except BusyError as error:
            self.refused(None, str(error))
            return None
        self.job = self.tells(job)
        self._set_running(True)
        job.ended.connect(lambda: self._set_running(False))
        return job

    # Showing it ----------------------------------------------------------------------------------
    def _progressed(self, progress: Progress) -> None:
        self.progress.setValue(round(1000 * progress.share))
        self.phase.show_image(progress.phase_rad, 0.0, 2 * np.pi)
        self._draw_history(progress.history)

    def _draw_history(self, history: Any) -> None:
        self.plot.clear()
        self.plot.plot([r.iteration for r in history], [r.psnr_db for r in history], pen=curve_pen(0))

    def _computed(self, computed: Computed) -> None:
        self.computed = computed
        result = computed.result
        self.progress.setValue(1000)
        self._list_planes(computed)
        self.phase.show_image(result.hologram.phase_rad[0], 0.0, 2 * np.pi)
        self.captured.clear()
        self._draw_history(result.hologram.history)
        self.metrics.show_facts(self._facts(result, computed))
        for path in computed.patterns:
            self.session.log("info", f"Wrote {path}")
        self._suggest_out()
        self._set_running(False)

    def _list_planes(self, computed: Computed) -> None:
        """Let the plane be chosen that is looked at; shows the first."""
        order = computed.order
        depths = [order.z_mm, *(z_mm for _, z_mm in order.further)]
        self.plane.blockSignals(True)
        self.plane.clear()
        self.plane.addItems([f"seen at {z_mm:g} mm" for z_mm in depths])
        self.plane.blockSignals(False)
        self.plane.setVisible(len(depths) > 1)
        self._show_plane(0)

    def _show_plane(self, number: int) -> None:
        if self.computed is not None and number >= 0:
            self.seen.show_image(np.maximum(self.computed.result.seen[number], 0), 0.0, 1.0)

    def _facts(self, result: HologramResult, computed: Computed) -> list[tuple[str, str]]:
        last, display = result.hologram.history[-1], computed.display
        facts = [
            *(
                (f"Seen (computed){'' if len(result.scores) == 1 else f' at {z_mm:g} mm'}", _scores(scores))
                for (_, z_mm), scores in zip(
                    ((None, computed.order.z_mm), *computed.order.further), result.scores, strict=True
                )
            ),
            ("Stopped", f"after {last.iteration} iterations, {result.hologram.seconds:.1f} s: "
                f"{result.hologram.stop_reason}"),
            ("Expansion", f"{display.expansion}x on {display.slm_shape[1]} x {display.slm_shape[0]} pixels, "
                f"{display.wavelength_nm:g} nm"),
        ]  # fmt: skip
        facts += [("Pattern", str(path)) for path in computed.patterns]
        return facts

    def _photographed(self, outcome: Any) -> None:
        found, path = outcome
        assert self.computed is not None
        self.captured.show_image(np.maximum(found.capture.seen, 0), 0.0, 1.0)
        warnings = []
        if found.capture.saturated_fraction > 1e-3:
            warnings.append(f"{found.capture.saturated_fraction:.1%} of the camera's pixels are saturated.")
        if self.computed.order.alignment is None:
            warnings.append(
                "Computed without an alignment of the mask: a mask out of place shows nothing of it."
            )
        facts = [
            ("Photographed", _scores(found.capture.scores)),
            ("Camera", f"registered to {found.camera_residual_px:.2f} px"),
            ("Picture", str(path)),
            *self._facts(self.computed.result, self.computed),
        ]
        self.metrics.show_facts(facts, warnings, simulated=found.simulated)
        self.session.log("info", f"Wrote {path}")

    def _picture_changed(self) -> None:
        """Show the target as it fills the field."""
        try:
            path = self.picture.value()
            wanted = (path, path.stat().st_mtime_ns, self.fit.currentText(), self.srgb.isChecked())
        except (BenchError, OSError):
            return  # refused at its field
        self._suggest_out()
        if wanted == self._target_asked:
            return
        self._target_asked = wanted
        fit, srgb = wanted[2:]

        def read() -> npt.NDArray[Any] | str:
            try:
                return field_picture(read_image(path).pixels, fit=fit, srgb=srgb)  # type: ignore[arg-type]
            except (BenchError, InputError) as error:
                return str(error)

        self._reader.ask(read, lambda found: self._target_read(wanted, found))

    def _target_read(self, wanted: object, found: npt.NDArray[Any] | str) -> None:
        if wanted != self._target_asked:
            return  # another picture is on its way
        if isinstance(found, str):
            self._target_asked = None
            self.refused(self.picture, found)
        else:
            self.target.show_target(found)

    @property
    def _suggestions(self) -> Path:
        """The folder of the names that are suggested: made when it is needed."""
        return self.session.runs_folder / "holograms"

    def _suggest_out(self) -> None:
        if self.out.text() not in ("", str(self._suggested)):
            return  # a name that was chosen stays
        self._suggested = free_result(self._suggestions, Path(self.picture.text()).stem or "slm", ".png")
        self.out.setText(str(self._suggested))

    def _show_mode(self) -> None:
        mode = _MODES[self.weights_mode.currentText()]
        self._rows.setRowVisible(self.periphery, mode != "uniform")
        self._rows.setRowVisible(self._painting, mode == "painted")
        self._offer_losses(weighted=mode != "uniform")
        self.target.set_mode(mode)  # type: ignore[arg-type]

    def _offer_losses(self, *, weighted: bool) -> None:
        """Offer the losses that take weights, or those that do not."""
        names = [loss.name for loss in LOSSES.values() if loss.takes_weights == weighted]
        if [self.loss.itemText(n) for n in range(self.loss.count())] != names:
            self.loss.clear()
            self.loss.addItems(names)
            if _DEFAULT.loss in names:
                self.loss.setCurrentText(str(_DEFAULT.loss))

    def _set_running(self, running: bool) -> None:
        for button in (self.preview_button, self.compute_button):
            button.setEnabled(not running)
        for button in (self.show_button, self.capture_button):
            button.setEnabled(not running and self.computed is not None)
        self.stop_button.setEnabled(running)
        if not running:
            self.progress.setValue(0)

    def _entries(self) -> list[Entry]:
        return [
            self.picture,
            self.z_mm,
            self.further,
            self.periphery,
            self.brush,
            self.expansion,
            self.frames,
            self.iterations,
            self.psnr_db,
            self.alignment,
            self.correction,
            self.out,
        ]

    def take(self, path: Path) -> None:
        """Put an alignment of the mask into the form."""
        self.alignment.setText(str(path))
        self.alignment.editingFinished.emit()

    def theme_changed(self) -> None:
        """Take over the theme's colours and colour map."""
        now = colours()
        for view in (self.target, self.seen, self.phase, self.captured):
            view.graphics.setBackground(now.window)
            view.set_colour_map(now.colour_map)
        restyle(self.plot)
        self.metrics.restyle()

    def shutdown(self) -> None:
        """End the computation."""
        self.stop()


# What is written in fields ---------------------------------------------------------------------------
def _choice(names: list[str], tip: str) -> QComboBox:
    box = QComboBox()
    box.addItems(names)
    box.setToolTip(tip)
    narrow(box)
    return box


def _scores(scores: Scores) -> str:
    return (
        f"{scores.psnr_db:.2f} dB, SSIM {scores.ssim:.3f}; middle quarter {scores.crop_psnr_db:.2f} dB, "
        f"SSIM {scores.crop_ssim:.3f}"
    )
