"""The camera's settings as it reads them back, editable in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QHBoxLayout, QLabel, QLineEdit, QPushButton, QVBoxLayout, QWidget

from drivers.camera import Camera, Roi
from gui.forms.fields import Behaviour, ChoiceField, NumberField
from gui.forms.options_form import OptionsForm
from gui.jobs import BusyError, Job
from gui.panel import Panel
from gui.widgets.dialogues import TextWindow
from gui.widgets.entry import Entry
from gui.widgets.number_edit import NumberEdit
from instrument.bench.camera_settings import CameraOptions, CameraState, read_camera

_READ_BACK_MS = 3000
_WHILE_RUNNING = ("exposure_ms", "gain")
"""What is set while the stream runs; for the others it pauses."""
_SETTERS: dict[str, Callable[[Camera, Any], object]] = {
    "exposure_ms": lambda camera, value: camera.set_exposure_ms(value),
    "gain": lambda camera, value: camera.set_gain(value),
    "black_level": lambda camera, value: camera.set_black_level(value),
    "binning": lambda camera, value: camera.set_binning(value),
    "pixel_format": lambda camera, value: camera.set_pixel_format(value),
    "roi": lambda camera, value: camera.set_roi(value),
}


class CameraForm(QWidget):
    """Exposure, gain, binning, format, black level, region, temperature.

    Parameters
    ----------
    panel : Panel
        Where refusals are shown.
    """

    def __init__(self, panel: Panel) -> None:
        super().__init__(panel)
        self._panel = panel
        self._session = panel.session
        self.state: CameraState | None = None
        self.form = OptionsForm(
            [CameraOptions],
            {
                "binning": Behaviour(offers=lambda: self._offered("binnings")),
                "pixel_format": Behaviour(offers=lambda: self._offered("pixel_formats")),
            },
        )
        self.widgets = self.form.widgets
        self.form.refused.connect(panel.refused)
        self.form.settled.connect(self._settled)
        self.temperature = QLabel("–")
        self.temperature.setToolTip("Of the sensor or camera, degrees Celsius, where it has a thermometer")
        self.all_button = QPushButton("All settings …")
        self.all_button.setToolTip("Everything that the camera reports of itself")
        self.all_button.clicked.connect(self._show_all)
        self._temperature_name = QLabel("Temperature")
        below = QHBoxLayout()
        below.addWidget(self._temperature_name)
        below.addWidget(self.temperature, 1)
        below.addWidget(self.all_button)
        layout = QVBoxLayout(self)
        layout.setContentsMargins(0, 0, 0, 0)
        layout.addWidget(self.form)
        layout.addLayout(below)
        self._session.device_changed.connect(self._device_changed)
        self._timer = QTimer(self)
        self._timer.timeout.connect(self.read_back)
        self._timer.start(_READ_BACK_MS)
        self._device_changed("camera")

    def shutdown(self) -> None:
        """End the timer."""
        self._timer.stop()

    def read_back(self) -> None:
        """Ask the camera for all settings, unless something else uses it."""
        if not self._session.is_open("camera") or self._session.jobs.is_busy("camera"):
            return
        job = self._session.device_job(
            "Reading the camera", lambda _: read_camera(self._session.bench.camera), {"camera"}, quiet=True
        )
        job.succeeded.connect(self._show)

    def set_region(self, region: Roi | None) -> Job | None:
        """Send a region (None: the whole sensor) to the camera."""
        return self._set("roi", region)

    def _offered(self, name: str) -> list[str]:
        return [] if self.state is None else [str(word) for word in getattr(self.state, name)]

    def _settled(self, name: str) -> None:
        """Send what was typed or chosen, unless it is in force."""
        if self.state is None:
            return
        value = self.form.value(name)
        if value != getattr(self.state, name):
            self._set(name, value)

    def _set(self, name: str, value: Any) -> Job | None:
        def work(camera: Camera) -> CameraState:
            _SETTERS[name](camera, value)
            return read_camera(camera)

        words = f"{self.form.fields[name].bare_label} of the camera"
        try:
            job = self._session.camera_job(words, work, idle=name not in _WHILE_RUNNING)
        except BusyError as error:
            self._refuse(name, str(error))
            return None
        job.succeeded.connect(lambda state: self._taken(name, state))
        job.failed.connect(lambda why: self._refuse(name, why))
        return job

    def _taken(self, name: str, state: CameraState) -> None:
        self._panel.accepted()
        widget = self.widgets[name]
        if isinstance(widget, QLineEdit):
            widget.setModified(False)
        self._show(state)

    def _refuse(self, name: str, why: str) -> None:
        widget = self.widgets[name]
        if isinstance(widget, NumberEdit | Entry):
            widget.setModified(True)
            widget.refuse(why)  # what was typed stays to be corrected
        else:
            self._show(self.state)
            self.form.refuse(name, why)
            self._panel.refused(None, why)

    def _device_changed(self, kind: str) -> None:
        if kind == "camera":
            self.setEnabled(self._session.is_open("camera"))
            self.read_back()

    def _show(self, state: CameraState | None) -> None:
        """Show what was read back."""
        if state is None:
            return
        self.state = state
        for name, limits in (("exposure_ms", state.exposure_limits_ms), ("gain", state.gain_limits)):
            number = self.form.fields[name]
            assert isinstance(number, NumberField)
            number.set_limits(*limits)
        for name, offered in (("binning", "binnings"), ("pixel_format", "pixel_formats")):
            choice = self.form.fields[name]
            assert isinstance(choice, ChoiceField)
            if not choice.is_being_edited:
                choice.offer(self._offered(offered))
        present = {name: getattr(state, name) for name in _SETTERS}
        self.form.show_present(present | {"roi": ", ".join(map(str, state.roi.as_tuple()))})
        has_thermometer = state.temperature_c is not None
        self.temperature.setVisible(has_thermometer)
        self._temperature_name.setVisible(has_thermometer)
        if has_thermometer:
            self.temperature.setText(f"{state.temperature_c:.1f} °C")

    def _show_all(self) -> None:
        if self.state is not None:
            lines = "\n".join(f"{name} = {value}" for name, value in sorted(self.state.settings.items()))
            TextWindow("Settings of the camera, as read back", lines, self).show()
