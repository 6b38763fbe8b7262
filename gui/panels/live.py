"""The live view: the camera's newest frame, its histogram, settings, photographs and recordings."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QButtonGroup, QWidget

from drivers.frame import Frame
from gui.jobs import BusyError, Job, JobContext
from gui.journey import AGAIN, EXPOSE
from gui.panel import Panel, on_bench
from gui.session import BenchSession
from gui.way_on import ReconnectButton
from gui.widgets.building import button, every, fill, in_row, label, split
from gui.widgets.camera_controls import CameraForm, trigger_words
from gui.widgets.entry import NumberEdit
from gui.widgets.live_picture import LivePicture
from gui.widgets.record_bar import RecordBar
from instrument.bench.lit import LightState, led_pattern, light_of
from instrument.bench.photograph_file import (
    PHOTOGRAPHS,
    check_photograph_file,
    photograph_name,
    write_snapshot,
)
from instrument.files.errors import duration
from instrument.live.frame_view import sensor_roi
from instrument.live.live_camera import LiveCameraStatus
from recon.base.as_python import Imports, expression

_LOOK_MS = 8
"""Between two looks whether there is another frame: a look costs next to nothing."""
_LEAST_GAP_S = 0.020
"""Between two frames on the screen. Well below the 33 ms of a camera at 30 frames a second: one that comes
early, after one that was late, must not be held back until the next is there."""
_STATISTICS_MS = 333
_RATE_WINDOW_S = 2.0
_SLOW_MS = 1000.0
"""Exposures beyond it are told in the place of rates, which two seconds do not tell."""
_PATIENCE_S = 1.5
"""Without a frame for longer than this and three exposures, the panel says that it waits."""
_LIGHTS = {
    LightState.SCENE: ("Scene", "Light the scene"),
    LightState.SOURCE: ("Source", "Light the point source"),
    LightState.DARK: ("Dark", "Light nothing"),
}


class LivePanel(Panel):
    """Shows the newest frame of the live view, or of the run that goes on; owns nothing of it."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.photograph: Path | None = None
        """The last one that was taken here."""
        self._began = False
        """Whether the scene is being lit, or need not be, to begin with."""
        self._lighting: Job | None = None
        """Lights the scene, to begin with."""
        self._lit_ns = 0
        """When it had."""
        self._pictured = False
        """Whether there was a frame in the light that it begins with, or a coarse picture of it."""

    def wholes(self) -> list[QWidget]:
        """Return the picture and the camera's form: they have most of the panel's widgets."""
        return [self.picture, self.form]

    def parts(self) -> Iterator[None]:
        """Make the widgets."""
        session = self.session
        above, pictures, side = QWidget(), QWidget(), QWidget()
        both = split(pictures, side, sizes=[900, 240], stretch=0)
        self.picture = LivePicture(session)
        yield
        yield from self.picture.parts()
        self.picture.region_sent.connect(self.send_region)
        yield
        self.form = CameraForm(self)
        yield from self.form.parts()
        yield
        self.record_bar = RecordBar(self)
        self.status = label("Waiting for the first frame …", "dim", selectable=True, wraps=True, yields=True)
        self.under_mouse = label()
        self.picture.view.hovered.connect(self.under_mouse.setText)
        self._came_s = time.monotonic()
        """When the last frame came, or could have begun to."""
        self._shown_at: deque[float] = deque(maxlen=400)
        yield
        fill(self.body, above, (both, 1), self.record_bar)
        yield
        self._make_buttons(above)
        yield
        fill(pictures, (self.picture, 1), in_row((self.status, 1), self.under_mouse))
        yield
        heading = label("HISTOGRAM, RAW DATA", "heading")
        self._of_frames = (heading, self.picture.histogram)
        """What there is room for while the camera is open."""
        fill(
            side,
            label("CAMERA", "heading"),
            self.form,
            6,
            heading,
            (self.picture.histogram, 100),
            None,
            margins=(8, 0, 0, 0),
        )
        yield
        session.device_changed.connect(self._device_changed)
        session.stop_pressed.connect(self._leave_dark)
        self.put_below(ReconnectButton(session, ("camera",), self))
        tip = "It is tried again by itself, too, after a while"
        self.again_button = button("Start the live view again", tip, session.viewing.start)
        self.again_button.hide()
        self.put_below(self.again_button)
        every(self, _LOOK_MS, self.look).setTimerType(Qt.TimerType.PreciseTimer)
        every(self, _STATISTICS_MS, self.count)

    # Layout --------------------------------------------------------------------------------------
    def _make_buttons(self, row: QWidget) -> None:
        tip = "Run the camera, or hold the last frame (Ctrl+L)"
        self.live_button = button("▶ Live", tip, self.toggle_live, checkable=True)
        self.live_button.setChecked(self.session.viewing.wanted)
        tip = "Take a photograph and keep it in the runs' folder (Ctrl+K)"
        self.snap_button = button("Snap", tip, self.snap)
        self.reconstruct_button = button(
            "Reconstruct…",
            "Reconstruct the last photograph",
            lambda: self.session.handed_on.emit("reconstructions", self.photograph),
            enabled=False,
        )
        self.average = NumberEdit("frames", 1, minimum=1, integer=True, tip="Frames averaged in a photograph")
        self.average.setFixedWidth(90)
        self.heed(self.average)
        self.light_buttons = QButtonGroup(self)
        self.light_buttons.setExclusive(False)  # what is lit is shown as it is, not as it was clicked
        light = in_row(spacing=2)
        for choice, (words, tip) in _LIGHTS.items():
            switch = button(
                words, tip, lambda _=False, choice=choice: self.switch_light(choice), checkable=True
            )
            switch.setProperty("light", choice.value)
            self.light_buttons.addButton(switch)
            light.addWidget(switch)
        tip = "Read the whole sensor again"
        self.whole_button = button("Whole sensor", tip, lambda: self.form.set_region(None))
        self.form.buttons.insertWidget(0, self.whole_button)
        first = (self.live_button, self.snap_button, self.average, self.reconstruct_button)
        fill(row, *first, 10, light, None, across=True, spacing=6)
        self.only_with(("camera",), self.live_button, self.snap_button)
        for lit in self.light_buttons.buttons():
            if lit.property("light") != LightState.DARK:  # which darkens what it can
                self.only_with(("led_array",), lit)

    # Panel ---------------------------------------------------------------------------------------
    def as_python(self) -> str:
        """Return lines that bring the camera to these settings and take the same photograph."""
        imports = Imports(
            {
                ("instrument.bench.lit", "LightState"),
                ("instrument.bench.lit", "switch_light"),
                ("instrument.bench.photograph_file", "photograph_name"),
                ("instrument.bench.photograph_file", "write_snapshot"),
            }
        )
        light, bench = self.light, self.session.bench
        lines = []
        if (state := self.form.state) is not None:
            lines += [
                f"bench.camera.set_{name}({expression(getattr(state, name), imports)})"
                for name in ("pixel_format", "binning", "roi", "black_level", "gain", "exposure_ms")
            ]
        if light is LightState.AS_IS:
            lines.append(
                f"bench.led_array.set_pattern({expression(led_pattern(bench), imports, indent='    ')})"
            )
            lines += ["bench.scene_on()"] if bench.scene_lit else []
        else:
            lines.append(f"switch_light(bench, {expression(light, imports)})")
        lines += [
            f"taken = bench.snap({int(self.average.value or 1)})",
            f"write_snapshot(bench, Path(photograph_name()), taken, {expression(light, imports)})",
        ]
        imports.names.add(("pathlib", "Path"))
        return on_bench(self.session.config.path, lines, imports)

    def take(self, what: str) -> None:
        """Find an exposure, the step to a picture that can be used, or start the view that did not start."""
        if what == EXPOSE:
            self.form.expose()
        elif what == AGAIN:
            self.session.viewing.start()

    # Frames --------------------------------------------------------------------------------------
    def look(self) -> None:
        """Show the newest frame, if it is another than the one shown."""
        self.session.lights.note()
        if not self.isVisible():
            return
        if not self._began and self.session.is_ready:
            self._began = self._light_the_scene()
        if self._shown_at and time.monotonic() - self._shown_at[-1] < _LEAST_GAP_S:
            return
        frame, shown = self.session.live.newest(), self.picture.frame
        if frame is None or frame is shown:
            self._look_coarsely()
            return
        self._came_s = time.monotonic()
        self._shown_at.append(self._came_s)
        if shown is None:
            self.picture.frame = frame
            self.count()
        if self._began and self._lighting is None and frame.metadata.host_time_ns > self._lit_ns:
            self._say_pictured()
        self.picture.show_frame(frame)
        self.picture.view.set_caption(self._caption(frame))
        self.picture.view.caution_against("")
        self.under_mouse.setText(self.picture.view.under_mouse())

    def _look_coarsely(self) -> None:
        """Show a coarse picture where a simulated frame is not there soon."""
        found = None if self.picture.is_coarse else self.session.live.coarse()
        if found is None:
            return
        counts, factor = found
        self.picture.show_coarse(counts, factor)
        self._say_pictured()
        view = self.picture.view
        view.set_caption("What the next frame will show, SIMULATED")
        view.caution_against(
            f"Coarse for now: {factor} × {factor} pixels are one, without noise. The frame is being computed."
        )
        self.under_mouse.clear()

    def _say_pictured(self) -> None:
        """Tell what waits for the first picture of what is lit; a dark one is not what one waits for."""
        if not self._pictured:
            self._pictured = True
            self.session.pictured.emit()

    @property
    def screen_rate(self) -> float:
        """Frames a second that were shown, over the last two seconds."""
        now = time.monotonic()
        return sum(1 for t in self._shown_at if now - t <= _RATE_WINDOW_S) / _RATE_WINDOW_S

    def count(self) -> None:
        """Make histogram, levels, profile and the line of figures from the frame shown."""
        if not self.isVisible():
            return
        self._show_light()
        frame = self.picture.frame
        if self.picture.is_coarse and not self.session.live.is_running and frame is not None:
            self.picture.show_frame(frame)
            self.picture.view.set_caption(self._caption(frame))
        if frame is not None and not self.picture.is_coarse:
            self._judge_age(frame)
        if self._waits() or self.picture.is_coarse or frame is None or not self.session.is_open("camera"):
            return  # the line says what is waited for, or what failed
        self.picture.measure()
        self.status.setText(self._figures(frame))

    def _caption(self, frame: Frame) -> str:
        """Say when a frame came, what lit it, and which job took it."""
        holder = self.session.jobs.exclusive_job
        by = f", taken by: {holder.title}" if holder is not None else ""
        return self.session.describe_frame(frame.metadata) + by

    @property
    def _exposure_ms(self) -> float:
        """How long the frame to come is exposed: as that before, or as the camera is set now."""
        frame, state = self.picture.frame, self.form.state
        before_ms = 0.0 if frame is None else frame.metadata.exposure_ms
        return max(before_ms, 0.0 if state is None else state.exposure_ms)

    def _judge_age(self, frame: Frame) -> None:
        """Veil a picture that is not of now, and say since when."""
        age_s = (time.monotonic_ns() - frame.metadata.host_time_ns) / 1e9
        if age_s < _PATIENCE_S + 3e-3 * frame.metadata.exposure_ms:
            return
        since = "Held" if not self.session.viewing.wanted else "Old picture, no other has come"
        self.picture.view.caution_against(f"{since} for {duration(age_s)}", old=self.session.viewing.wanted)

    def _waits(self) -> bool:
        """Tell where no frame comes although one is wanted, and why; return whether it is so."""
        stuck = "" if self.session.jobs.exclusive_job is not None else self.session.viewing.failure
        self.again_button.setVisible(bool(stuck))
        if stuck:
            self.status.setText(f"The live view does not start: {stuck}")
            return True
        frame, state = self.picture.frame, self.form.state
        longest_s = self._exposure_ms / 1e3
        if not self.session.live.is_running:  # another job has the camera: nothing is waited for
            self._came_s = time.monotonic()
        seconds = time.monotonic() - self._came_s
        if not self.session.live.is_running or seconds < _PATIENCE_S + 3 * longest_s:
            return False
        words = f"Waiting for {'the first' if frame is None else 'a'} frame for {seconds:.0f} s."
        if state is not None and state.trigger_mode != "free_run":
            by = f"pulse on {state.trigger_line}" if state.trigger_mode == "hardware" else "program's trigger"
            mode, free = trigger_words(state.trigger_mode), trigger_words("free_run")
            words += f" Trigger is “{mode}”: each {by} takes one; “{free}” needs none."
        elif self.session.state("camera").simulated:
            words += (
                " The simulated scene is computed once for each new light, at 5 megapixels some 5 s; "
                "what computes it is compiled before the very first, some 10 s where nothing else runs."
            )
        self.status.setText(words)
        return True

    def _figures(self, frame: Frame) -> str:
        now = self.session.live.status()
        height, width = frame.image.shape[:2]
        rates = [f"screen {self.screen_rate:.1f}/s", self._camera_words(now)]
        if now.running and frame.metadata.exposure_ms > _SLOW_MS:
            rates = [f"{duration(frame.metadata.exposure_ms / 1e3)} a frame"]
        words = [
            f"{width} × {height}, {frame.metadata.significant_bits} bit",
            *rates,
            f"dropped {now.dropped}",
        ]
        return "   ".join([*words, *filter(None, (self.picture.under_cross(), self.picture.region_words()))])

    def _camera_words(self, now: LiveCameraStatus) -> str:
        if now.running:
            return f"camera {now.frames_per_s:.1f}/s"
        user = next((job.title for job in self.session.jobs.jobs if _holds_camera(job)), "")
        return f"camera used by: {user}" if user else "held"

    # What the operator does ----------------------------------------------------------------------
    def toggle_live(self) -> None:
        """Run the camera, or hold the last frame."""
        if why := self.lacks(("camera",)):
            self.refused(None, why)
        elif self.session.viewing.wanted:
            self.session.viewing.hold()
        else:
            self.session.viewing.start()
        self.live_button.setChecked(self.session.viewing.wanted)

    def snap(self) -> None:
        """Take a photograph into the runs' folder."""
        if why := self.lacks(("camera",)):
            self.refused(None, why)
            return
        if not self.average.submit():
            self.average.setFocus()
            return
        bench, average = self.session.bench, int(self.average.value or 1)
        target = self.session.runs_folder / PHOTOGRAPHS / photograph_name()

        def work(context: JobContext) -> None:
            target.parent.mkdir(parents=True, exist_ok=True)
            check_photograph_file(target, average)
            with self.session.live.paused():
                light = light_of(bench)
                taken = bench.snap(average, on_progress=lambda n, _: context.report(n))
            write_snapshot(bench, target, taken, light)

        job = self.begin(lambda: self.jobs.device("Photograph", work, {"camera"}), self.snap_button)
        if job is not None:
            job.succeeded.connect(lambda _: self._taken(target))

    def _taken(self, photograph: Path) -> None:
        self.accepted(self.snap_button)
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

    def switch_light(self, light: LightState) -> None:
        """Light the scene, the point source, or nothing."""
        job = self.begin(lambda: self.session.switch_light(light))
        if job is not None:
            job.ended.connect(self._show_light)

    def send_region(self) -> None:
        """Send the dragged region to the camera."""
        rectangle, frame = self.picture.region_box.rectangle, self.picture.frame
        if rectangle is not None and frame is not None:
            self.form.set_region(sensor_roi(frame.metadata, *rectangle))
            self.picture.region_button.setChecked(False)

    def _light_the_scene(self) -> bool:
        """Begin with something to see, where the simulated world can light it by itself.

        Before the first frame: a dark one of megapixels takes a second that nobody wants to wait for.
        Returns whether that is settled: not while something else has the light.
        """
        if self.session.config.scene.control != "simulated" or self.light is not LightState.DARK:
            return True

        def start() -> Job:
            if "led_array" in self.session.kinds:
                return self.session.switch_light(LightState.SCENE, quiet=True)
            # nobody is asked to darken a point source that may not be there
            return self.jobs.device(
                "Light: scene", lambda _: self.session.bench.scene_on(), {"light"}, quiet=True
            )

        try:
            self._lighting = self.follow(start())
        except BusyError:
            return False
        self._lighting.ended.connect(self._scene_lit)
        return True

    def _leave_dark(self) -> None:
        """After STOP nothing is lit by itself any more."""
        self._began = True

    def _scene_lit(self) -> None:
        self._lighting, self._lit_ns = None, time.monotonic_ns()
        self._show_light()

    def _show_light(self) -> None:
        now, known = self.light, self.session.bench.knows_scene
        for switch in self.light_buttons.buttons():
            # Dark is not what an operator's own lamp may be.
            switch.setChecked(switch.property("light") == now.value and (known or now is not LightState.DARK))

    def _device_changed(self, kind: str) -> None:
        if kind != "camera":
            return
        self._came_s = time.monotonic()
        for part in self._of_frames:
            part.setVisible(self.session.state("camera").condition != "failed")
        if self.session.is_open("camera"):
            self.status.setText("Waiting for the first frame …")
        else:
            state = self.session.state("camera")
            self.status.setText(" ".join(state.text.split()) or f"The camera is {state.condition}.")


def _holds_camera(job: Job) -> bool:
    return not job.quiet and (job.exclusive or "camera" in job.lanes)
