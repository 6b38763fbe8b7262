"""The live view: the camera's newest frame, its histogram, settings, photographs and recordings."""

from __future__ import annotations

import time
from collections import deque
from pathlib import Path

from PySide6.QtCore import Qt, QTimer
from PySide6.QtWidgets import (
    QButtonGroup,
    QComboBox,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSizePolicy,
    QSplitter,
    QVBoxLayout,
    QWidget,
)

from drivers.frame import Frame
from gui.forms.camera import CameraForm
from gui.jobs import BusyError, Job, JobContext
from gui.panel import Panel
from gui.session import BenchSession
from gui.theme import NAMES
from gui.widgets.image_view import ImageView
from gui.widgets.live_overlays import CrossHair, HistogramPlot, ProfileLine, RegionBox
from gui.widgets.number_edit import NumberEdit
from gui.widgets.plot import curve_pen, plot_widget
from gui.widgets.record_bar import RecordBar
from instrument.bench.photograph import (
    LightState,
    check_photograph_file,
    led_pattern,
    light_of,
    photograph_name,
    write_snapshot,
)
from instrument.live.frame_view import histogram, line_profile, percentiles, sensor_roi
from instrument.live.live_camera import LiveCameraStatus

_LOOK_MS = 8
"""Between two looks whether there is another frame: a look costs next to nothing."""
_LEAST_GAP_S = 0.020
"""Between two frames on the screen. Well below the 33 ms of a camera at 30 frames a second: one that comes
early, after one that was late, must not be held back until the next is there."""
_STATISTICS_MS = 333
_RATE_WINDOW_S = 2.0
_PATIENCE_S = 1.5
"""Without a frame for longer than this and three exposures, the panel says that it waits."""
LEVELS = {"full range": None, "0.1 – 99.9 %": (0.1, 99.9), "1 – 99 %": (1.0, 99.0), "by hand": None}


class LivePanel(Panel):
    """Shows the newest frame of the live view, or of the run that goes on; owns nothing of it."""

    title = "Live view"

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.view = ImageView()
        self.histogram = HistogramPlot()
        self.form = CameraForm(self)
        self.record_bar = RecordBar(self)
        self.cross_hair = CrossHair(self.view)
        self.profile_line = ProfileLine(self.view)
        self.region_box = RegionBox(self.view)
        self.profile_plot = plot_widget("along the line", "counts", x_unit="pixels")
        self._profile_curve = self.profile_plot.plot([], [], pen=curve_pen(1))
        self.profile_plot.setMaximumHeight(170)
        self.profile_plot.hide()
        self.status = QLabel("Waiting for the first frame …")
        self.status.setObjectName("dim")
        self.status.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
        # A line of figures that grows must not push the picture about.
        self.status.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)
        self.status.setWordWrap(True)
        self.under_mouse = QLabel()
        self.view.hovered.connect(self.under_mouse.setText)
        self.view.keys.moved.connect(lambda across, down: self._by_keys(across, down, alt=False))
        self.view.keys.resized.connect(lambda across, down: self._by_keys(across, down, alt=True))
        self.view.keys.acted.connect(lambda send: self.send_region() if send else None)
        self._levels = (0.0, 1.0)
        self._shown: Frame | None = None
        self._counted: Frame | None = None
        self._came_s = time.monotonic()
        """When the last frame came, or could have begun to."""
        self._shown_at: deque[float] = deque(maxlen=400)
        self._lay_out()
        self.histogram.levels_dragged.connect(self._levels_by_hand)
        session.device_changed.connect(self._device_changed)
        self._frame_timer = QTimer(self)
        self._frame_timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._frame_timer.timeout.connect(self.look)
        self._frame_timer.start(_LOOK_MS)
        self._statistics_timer = QTimer(self)
        self._statistics_timer.timeout.connect(self.count)
        self._statistics_timer.start(_STATISTICS_MS)

    # Layout --------------------------------------------------------------------------------------
    def _lay_out(self) -> None:
        self.live_button = QPushButton("▶ Live")
        self.live_button.setCheckable(True)
        self.live_button.setChecked(self.session.live_wanted)
        self.live_button.setToolTip("Run the camera, or hold the last frame (Ctrl+L)")
        self.live_button.clicked.connect(self.toggle_live)
        self.snap_button = QPushButton("Snap")
        self.snap_button.setToolTip("Take a photograph and keep it in the runs' folder (Ctrl+K)")
        self.snap_button.clicked.connect(self.snap)
        self.photograph: Path | None = None
        """The last one that was taken here."""
        self.reconstruct_button = QPushButton("Reconstruct…")
        self.reconstruct_button.setToolTip("Reconstruct the last photograph")
        self.reconstruct_button.setEnabled(False)
        self.reconstruct_button.clicked.connect(
            lambda: self.session.handed_on.emit("reconstructions", self.photograph)
        )
        self.average = NumberEdit("frames", 1, minimum=1, integer=True, tip="Frames averaged in a photograph")
        self.average.setFixedWidth(90)
        self.average.refused.connect(lambda why: self.refused(None, why))
        self.colour_map = QComboBox()
        self.colour_map.addItems(NAMES)
        self.colour_map.setCurrentText(self.view.colour_map)
        self.colour_map.setToolTip("Colour map; saturated pixels have a colour of their own")
        self.colour_map.currentTextChanged.connect(self.view.set_colour_map)
        self.stretch = QComboBox()
        self.stretch.addItems(list(LEVELS))
        self.stretch.setCurrentIndex(1)
        self.stretch.setToolTip("Counts shown darkest and brightest: full range, percentiles, or dragged")
        self.stretch.currentTextChanged.connect(lambda _: self._stretch_chosen())
        self.light_buttons = QButtonGroup(self)
        self.light_buttons.setExclusive(False)  # what is lit is shown as it is, not as it was clicked
        light = QHBoxLayout()
        light.setSpacing(2)
        for choice, words in (
            (LightState.SCENE, "Scene"),
            (LightState.SOURCE, "Source"),
            (LightState.DARK, "Dark"),
        ):
            button = QPushButton(words)
            button.setCheckable(True)
            button.setProperty("light", choice.value)
            button.setToolTip(
                {
                    LightState.SCENE: "Light the scene",
                    LightState.SOURCE: "Light the point source",
                    LightState.DARK: "Light nothing",
                }[choice]
            )
            button.clicked.connect(lambda _=False, choice=choice: self.switch_light(choice))
            self.light_buttons.addButton(button)
            light.addWidget(button)
        self.cross_button = _toggle(
            "✛", "Cross-hair: a click moves it, and arrow keys in the picture", self.cross_hair.set_enabled
        )
        self.profile_button = _toggle(
            "Profile",
            "Counts along a line: drag its ends, or arrow keys (Alt: one end)",
            self._toggle_profile,
        )
        self.region_button = _toggle(
            "Region",
            "Drag a region of interest, or arrow keys (Alt: its size; Return sends it)",
            self._toggle_region,
        )
        for button in (self.cross_button, self.profile_button, self.region_button):
            button.toggled.connect(lambda _: self._arrows_for())
        self.apply_region = QPushButton("Send")
        self.apply_region.setToolTip("Send the region to the camera")
        self.apply_region.clicked.connect(self.send_region)
        self.apply_region.hide()
        self.whole_button = QPushButton("Whole sensor")
        self.whole_button.setToolTip("Read the whole sensor again")
        self.whole_button.clicked.connect(lambda: self.form.set_region(None))
        self.fit_button = QPushButton("Fit")
        self.fit_button.setToolTip("Show the whole image (wheel zooms, dragging moves)")
        self.fit_button.clicked.connect(self.view.whole)
        bar = QHBoxLayout()
        bar.setSpacing(6)
        before: tuple[QWidget, ...] = (
            self.live_button,
            self.snap_button,
            self.average,
            self.reconstruct_button,
        )
        after: tuple[QWidget, ...] = (
            self.colour_map,
            self.stretch,
            self.cross_button,
            self.profile_button,
            self.region_button,
            self.apply_region,
            self.fit_button,
        )
        for widget in before:
            bar.addWidget(widget)
        bar.addSpacing(10)
        bar.addLayout(light)
        bar.addStretch(1)
        tools = QHBoxLayout()
        tools.setSpacing(6)
        for widget in after:
            tools.addWidget(widget)
        tools.addStretch(1)
        side = QWidget()
        column = QVBoxLayout(side)
        column.setContentsMargins(8, 0, 0, 0)
        column.addWidget(_heading("CAMERA"))
        column.addWidget(self.form)
        column.addWidget(self.whole_button)
        column.addSpacing(6)
        column.addWidget(_heading("HISTOGRAM, RAW DATA"))
        column.addWidget(self.histogram, 1)
        pictures = QWidget()
        left = QVBoxLayout(pictures)
        left.setContentsMargins(0, 0, 0, 0)
        left.addLayout(tools)
        left.addWidget(self.view, 1)
        left.addWidget(self.profile_plot)
        line = QHBoxLayout()
        line.addWidget(self.status, 1)
        line.addWidget(self.under_mouse)
        left.addLayout(line)
        split = QSplitter(Qt.Orientation.Horizontal)
        split.addWidget(pictures)
        split.addWidget(side)
        split.setStretchFactor(0, 1)
        split.setSizes([900, 240])
        layout = QVBoxLayout(self.body)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addLayout(bar)
        layout.addWidget(split, 1)
        layout.addWidget(self.record_bar)

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that bring the camera to these settings and take the same photograph."""
        path = self.session.config.path
        state = self.form.state
        lines = [
            "from pathlib import Path",
            "",
            "from drivers.camera import Roi",
            "from drivers.led_array import LedPattern",
            "from instrument.bench.bench import open_bench",
            "from instrument.bench.photograph import LightState, photograph_name",
            "from instrument.bench.photograph import switch_light, write_snapshot",
            "",
            f"with open_bench({str(path) if path else None!r}) as bench:",
        ]
        if state is not None:
            lines += [
                f"    bench.camera.set_pixel_format({state.pixel_format!r})",
                f"    bench.camera.set_binning({state.binning})",
                f"    bench.camera.set_roi({state.roi!r})",
                f"    bench.camera.set_black_level({state.black_level!r})",
                f"    bench.camera.set_gain({state.gain!r})",
                f"    bench.camera.set_exposure_ms({state.exposure_ms!r})",
            ]
        light, pattern = self.light, led_pattern(self.session.bench)
        if light is LightState.AS_IS:
            lines += [f"    bench.led_array.set_pattern({pattern!r})"]
            lines += ["    bench.scene_on()"] if self.session.bench.scene_lit else []
        else:
            lines += [f"    switch_light(bench, LightState.{light.name})"]
        lines += [
            f"    taken = bench.snap({int(self.average.value or 1)})",
            f"    write_snapshot(bench, Path(photograph_name()), taken, LightState.{light.name})",
        ]
        return "\n".join(lines) + "\n"

    def shutdown(self) -> None:
        """End the timers."""
        self._frame_timer.stop()
        self._statistics_timer.stop()
        self.form.shutdown()
        self.record_bar.shutdown()

    def theme_changed(self) -> None:
        """Take over the theme's colour map and plot colours."""
        from gui.theme import colours
        from gui.widgets.plot import restyle

        self.colour_map.setCurrentText(colours().colour_map)
        self.histogram.restyle()
        restyle(self.profile_plot)
        self.view.graphics.setBackground(colours().window)

    # Frames --------------------------------------------------------------------------------------
    def look(self) -> None:
        """Show the newest frame, if it is another than the one shown."""
        if not self.isVisible():
            return
        if self._shown_at and time.monotonic() - self._shown_at[-1] < _LEAST_GAP_S:
            return
        frame = self.session.live.newest()
        if frame is None or frame is self._shown:
            return
        first = self._shown is None
        self._shown = frame
        self._came_s = time.monotonic()
        if first:
            self.count()
            self._light_the_scene()
        self._shown_at.append(time.monotonic())
        self._draw(frame)

    def _draw(self, frame: Frame) -> None:
        low, high = self._levels
        self.view.show_image(frame.image, low, high, frame.full_scale)
        self.under_mouse.setText(self.view.under_mouse())

    @property
    def screen_rate(self) -> float:
        """Frames a second that were shown, over the last two seconds."""
        now = time.monotonic()
        return sum(1 for t in self._shown_at if now - t <= _RATE_WINDOW_S) / _RATE_WINDOW_S

    def count(self) -> None:
        """Make histogram, levels, profile and the line of figures from the frame shown."""
        frame = self._shown
        if not self.isVisible():
            return
        self._show_light()
        if self._waits():
            return
        if frame is None:
            return
        if frame is not self._counted:
            self._measure(frame)
        self.status.setText(self._figures(frame))

    def _measure(self, frame: Frame) -> None:
        self._counted = frame
        counts = histogram(frame.image)
        wanted = LEVELS[self.stretch.currentText()]
        if wanted is not None:
            self._levels = percentiles(counts, *wanted)
        elif self.stretch.currentText() == "full range":
            self._levels = (0.0, float(frame.full_scale))
        self.histogram.show_counts(counts, frame.full_scale, *self._levels)
        if (ends := self.profile_line.ends) is not None:
            self._profile_curve.setData(*line_profile(frame.image, *ends))

    def _stretch_chosen(self) -> None:
        if self._shown is not None:  # at once, and where the frame is held as well
            self._measure(self._shown)
            self._draw(self._shown)

    def _waits(self) -> bool:
        """Tell where no frame comes although the camera runs, and for how long; return whether it is so."""
        frame = self._shown
        exposure_s = 0.0 if frame is None else frame.metadata.exposure_ms / 1e3
        seconds = time.monotonic() - self._came_s
        if not self.session.live.is_running or seconds < _PATIENCE_S + 3 * exposure_s:
            return False
        words = f"Waiting for {'the first' if frame is None else 'a'} frame for {seconds:.0f} s."
        if self.session.state("camera").simulated:
            words += " The simulated scene is computed once for each new light: 15 to 30 s at 5 megapixels."
        self.status.setText(words)
        return True

    def _figures(self, frame: Frame) -> str:
        now = self.session.live.status()
        height, width = frame.image.shape[:2]
        words = [
            f"{width} × {height}, {frame.metadata.significant_bits} bit",
            f"screen {self.screen_rate:.1f}/s",
            self._camera_words(now),
            f"dropped {now.dropped}",
            f"saturated {frame.metadata.saturated_fraction:.3%}",
        ]
        state = self.form.state
        if state is not None and state.temperature_c is not None:
            words.append(f"{state.temperature_c:.1f} °C")
        if self.cross_hair.enabled and self.cross_hair.pixel is not None:
            column, row = self.cross_hair.pixel
            if row < height and column < width:
                words.append(f"✛ {self.view.describe(column, row)}")
        return "   ".join(words)

    def _camera_words(self, now: LiveCameraStatus) -> str:
        if now.running:
            return f"camera {now.frames_per_s:.1f}/s"
        user = next((job.title for job in self.session.jobs.jobs if _holds_camera(job)), "")
        return f"camera used by: {user}" if user else "held"

    def _levels_by_hand(self, low: float, high: float) -> None:
        self._levels = (low, high)
        if self.stretch.currentText() != "by hand":
            self.stretch.blockSignals(True)
            self.stretch.setCurrentText("by hand")
            self.stretch.blockSignals(False)
        if self._shown is not None:
            self._draw(self._shown)

    # What the operator does ----------------------------------------------------------------------
    def toggle_live(self) -> None:
        """Run the camera, or hold the last frame."""
        if self.session.live_wanted:
            self.session.stop_live()
        else:
            self.session.start_live()
        self.live_button.setChecked(self.session.live_wanted)

    def snap(self) -> None:
        """Take a photograph into the runs' folder."""
        if not self.average.submit():
            self.average.setFocus()
            return
        bench, average = self.session.bench, int(self.average.value or 1)
        target = self.session.runs_folder / "photographs" / photograph_name()

        def work(context: JobContext) -> None:
            target.parent.mkdir(parents=True, exist_ok=True)
            check_photograph_file(target, average)
            with self.session.live.paused():
                light = light_of(bench)
                taken = bench.snap(average, on_progress=lambda n, _: context.report(n))
            write_snapshot(bench, target, taken, light)

        try:
            job = self.tells(self.session.device_job("Photograph", work, {"camera"}))
        except BusyError as error:
            self.refused(self.snap_button, str(error))
            return
        job.succeeded.connect(lambda _: self._taken(target))
        job.succeeded.connect(lambda _: self.accepted(self.snap_button))

    def _taken(self, photograph: Path) -> None:
        self.session.log("info", f"Photograph: {photograph}")
        self.photograph = photograph
        self.reconstruct_button.setEnabled(True)

    def record(self) -> None:
        """Start a recording, or end the one that runs."""
        self.record_bar.toggle()

    @property
    def is_recording(self) -> bool:
        """Whether a recording runs, which ``record`` would end."""
        return self.record_bar.job is not None

    @property
    def light(self) -> LightState:
        """What is lit, as far as the program knows."""
        return light_of(self.session.bench)

    def switch_light(self, light: LightState, *, quiet: bool = False) -> None:
        """Light the scene, the point source, or nothing; ``quiet`` where nobody asked for it."""
        try:
            self.tells(self.session.switch_light(light, quiet=quiet)).ended.connect(self._show_light)
        except BusyError as error:
            self.refused(None, str(error))

    def send_region(self) -> None:
        """Send the dragged region to the camera."""
        rectangle, frame = self.region_box.rectangle, self._shown
        if rectangle is not None and frame is not None:
            self.form.set_region(sensor_roi(frame.metadata, *rectangle))
            self.region_button.setChecked(False)

    def _by_keys(self, across: float, down: float, *, alt: bool) -> None:
        """Move region, line or cross-hair, the first of them that is shown."""
        if self.region_box.item is not None:
            self.region_box.step(across, down, size_only=alt)
        elif self.profile_line.item is not None:
            self.profile_line.step(across, down, end_only=alt)
        elif self.cross_hair.enabled:
            self.cross_hair.step(across, down)

    def _arrows_for(self) -> None:
        """Give the arrow keys of the picture to what lies over it."""
        over = self.region_button, self.profile_button, self.cross_button
        self.view.arrows_pan = not any(button.isChecked() for button in over)
        if not self.view.arrows_pan:
            self.view.setFocus()

    def _toggle_profile(self, on: bool) -> None:
        self.profile_line.set_enabled(on)
        self.profile_plot.setVisible(on)

    def _toggle_region(self, on: bool) -> None:
        self.region_box.set_enabled(on)
        self.apply_region.setVisible(on)

    def _light_the_scene(self) -> None:
        """Begin with something to see, where the simulated world can light it by itself."""
        if self.session.config.scene.control != "simulated" or self.light is not LightState.DARK:
            return
        if "led_array" in self.session.kinds:
            self.switch_light(LightState.SCENE, quiet=True)
        else:  # nobody is asked to darken a point source that may not be there
            job = self.session.device_job(
                "Light: scene", lambda _: self.session.bench.scene_on(), {"light"}, quiet=True
            )
            self.tells(job).ended.connect(self._show_light)

    def _show_light(self) -> None:
        now = self.light
        for button in self.light_buttons.buttons():
            button.setChecked(button.property("light") == now.value)

    def _device_changed(self, kind: str) -> None:
        if kind != "camera":
            return
        self._came_s = time.monotonic()
        if self.session.is_open("camera"):
            self.status.setText("Waiting for the first frame …")
        else:
            state = self.session.state("camera")
            self.status.setText(" ".join(state.text.split()) or f"The camera is {state.condition}.")


def _holds_camera(job: Job) -> bool:
    return not job.quiet and (job.exclusive or "camera" in job.lanes)


def _toggle(text: str, tip: str, switched: object) -> QPushButton:
    button = QPushButton(text)
    button.setCheckable(True)
    button.setToolTip(tip)
    button.toggled.connect(switched)
    return button


def _heading(text: str) -> QLabel:
    label = QLabel(text)
    label.setProperty("role", "heading")
    return label
