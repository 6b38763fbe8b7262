"""The camera's settings as it reads them back, editable in place."""

from __future__ import annotations

from collections.abc import Callable

from PySide6.QtCore import QTimer
from PySide6.QtWidgets import QComboBox, QFormLayout, QLabel, QLineEdit, QPushButton, QWidget

from drivers.camera import Camera, Roi
from gui.jobs import BusyError, Job
from gui.panel import Panel
from gui.widgets.dialogues import TextWindow
from gui.widgets.number_edit import NumberEdit
from instrument.bench.camera_settings import CameraState, read_camera

_READ_BACK_MS = 3000


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
        self.exposure = NumberEdit("ms", tip="Exposure time, milliseconds. Enter sets it, Up and Down step")
        self.gain = NumberEdit("×", tip="Electronic gain as a factor; 1 is the base gain")
        self.black_level = NumberEdit("counts", minimum=0.0, tip="Offset that the camera adds, counts")
        self.binning = QComboBox()
        self.binning.setToolTip("Sensor pixels summed along each axis")
        self.pixel_format = QComboBox()
        self.pixel_format.setToolTip("Pixel format by its GenICam name")
        self.region = QLineEdit()
        self.region.setToolTip(
            "Region of interest in sensor pixels before binning: top, left, height, width. Enter sends it"
        )
        self.region.returnPressed.connect(self._region_typed)
        self.temperature = QLabel("–")
        self.temperature.setToolTip("Of the sensor or camera, degrees Celsius, where it has a thermometer")
        self.all_button = QPushButton("All settings …")
        self.all_button.setToolTip("Everything that the camera reports of itself")
        self.all_button.clicked.connect(self._show_all)
        self.exposure.submitted.connect(
            lambda value: self._set(self.exposure, "Exposure", lambda c: c.set_exposure_ms(value))
        )
        self.gain.submitted.connect(lambda value: self._set(self.gain, "Gain", lambda c: c.set_gain(value)))
        self.black_level.submitted.connect(
            lambda value: self._set(
                self.black_level, "Black level", lambda c: c.set_black_level(value), idle=True
            )
        )
        self.binning.activated.connect(self._set_binning)
        self.pixel_format.activated.connect(self._set_format)
        for field in (self.exposure, self.gain, self.black_level):
            field.refused.connect(lambda why: panel.refused(None, why))
        form = QFormLayout(self)
        form.setContentsMargins(0, 0, 0, 0)
        form.setVerticalSpacing(5)
        form.addRow("Exposure", self.exposure)
        form.addRow("Gain", self.gain)
        form.addRow("Black level", self.black_level)
        form.addRow("Binning", self.binning)
        form.addRow("Format", self.pixel_format)
        form.addRow("Region", self.region)
        self._temperature_name = QLabel("Temperature")
        form.addRow(self._temperature_name, self.temperature)
        form.addRow("", self.all_button)
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
        return self._set(self.region, "Region", lambda c: c.set_roi(region), idle=True)

    def _region_typed(self) -> None:
        words = self.region.text().replace(",", " ").split()
        if len(words) != 4 or not all(word.isdecimal() for word in words):
            why = f"{self.region.text()!r} is no region: four whole numbers, top, left, height, width."
            self._panel.refused(self.region, why)
            return
        self.region.setModified(False)
        self.set_region(Roi(*map(int, words)))

    def _set(
        self, field: QWidget, what: str, action: Callable[[Camera], object], *, idle: bool = False
    ) -> Job | None:
        def work(camera: Camera) -> CameraState:
            action(camera)
            return read_camera(camera)

        try:
            job = self._session.camera_job(f"{what} of the camera", work, idle=idle)
        except BusyError as error:
            self._refuse(field, str(error))
            return None
        job.succeeded.connect(self._show)
        job.succeeded.connect(lambda _: self._panel.accepted(field))
        job.failed.connect(lambda why: self._refuse(field, why))
        return job

    def _refuse(self, field: QWidget, why: str) -> None:
        if isinstance(field, NumberEdit):
            field.refuse(why)
        else:
            self._panel.refused(field, why)
            self._show(self.state)

    def _set_binning(self) -> None:
        value = int(self.binning.currentData())
        self._set(self.binning, "Binning", lambda c: c.set_binning(value), idle=True)

    def _set_format(self) -> None:
        value = self.pixel_format.currentText()
        self._set(self.pixel_format, "Format", lambda c: c.set_pixel_format(value), idle=True)

    def _device_changed(self, kind: str) -> None:
        if kind == "camera":
            self.setEnabled(self._session.is_open("camera"))
            self.read_back()

    def _show(self, state: CameraState | None) -> None:
        """Show what was read back."""
        if state is None:
            return
        self.state = state
        self.exposure.set_limits(*state.exposure_limits_ms)
        self.exposure.set_value(state.exposure_ms)
        self.gain.set_limits(*state.gain_limits)
        self.gain.set_value(state.gain)
        self.black_level.set_value(state.black_level)
        _choose(self.binning, [(f"{b} × {b}", b) for b in state.binnings], state.binning)
        _choose(self.pixel_format, [(f, f) for f in state.pixel_formats], state.pixel_format)
        roi = state.roi
        if not self.region.isModified() or not self.region.hasFocus():
            self.region.setText(", ".join(map(str, roi.as_tuple())))
        has_thermometer = state.temperature_c is not None
        self.temperature.setVisible(has_thermometer)
        self._temperature_name.setVisible(has_thermometer)
        if has_thermometer:
            self.temperature.setText(f"{state.temperature_c:.1f} °C")

    def _show_all(self) -> None:
        if self.state is not None:
            lines = "\n".join(f"{name} = {value}" for name, value in sorted(self.state.settings.items()))
            TextWindow("Settings of the camera, as read back", lines, self).show()


def _choose(box: QComboBox, items: list[tuple[str, object]], now: object) -> None:
    """Fill a box where its choices have changed, and show the one in use."""
    if [box.itemData(i) for i in range(box.count())] != [data for _, data in items]:
        box.clear()
        for text, data in items:
            box.addItem(text, data)
    if not box.view().isVisible():
        box.setCurrentIndex(next((i for i, (_, data) in enumerate(items) if data == now), -1))
