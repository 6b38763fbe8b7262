"""What the live view does with the camera: its settings, as it reads them back, and recordings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from PySide6.QtWidgets import QLineEdit, QWidget
from shiboken6 import isValid

from drivers.camera import Camera, Roi
from gui.forms.fields import Behaviour, ChoiceField, NumberField
from gui.forms.options_form import OptionsForm
from gui.jobs import BusyError, Job
from gui.journey import EXPOSING
from gui.panel import Panel
from gui.widgets.building import button, every, fill, in_row, label
from gui.widgets.device_settings import DeviceSettings
from gui.widgets.entry import Entry, NumberEdit
from gui.widgets.kept_bar import KeptBar
from instrument.bench.camera_settings import CameraOptions, CameraState, read_camera, restore_camera
from recon.base.declare import options_of

if TYPE_CHECKING:  # the first picture does not wait for what runs and routines need
    from calibration_routines.psf.exposure import AutoExposure

_READ_BACK_MS = 3000
_FIRST_READ_MS = 100
"""Until the camera has told its settings and limits: nothing can be set before."""
_WHILE_RUNNING = ("exposure_ms", "gain")
"""What is set while the stream runs; for the others it pauses."""
_OFFERED = {
    "binning": "binnings",
    "pixel_format": "pixel_formats",
    "trigger_mode": "trigger_modes",
    "trigger_line": "trigger_lines",
    "trigger_edge": "trigger_edges",
}
"""Settings that are chosen, and what the camera offers for each."""
_TRIGGERS = {"free_run": "none (free_run)", "software": "program (software)", "hardware": "pulse (hardware)"}
_OF_HARDWARE = ("trigger_line", "trigger_edge")
"""Settings that mean nothing without a hardware trigger."""
_SET = tuple(o.name for o in options_of(CameraOptions))


def trigger_words(mode: str) -> str:
    """Return what starts an exposure as an operator says it, the technical term beside it."""
    return _TRIGGERS.get(mode, mode)


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

    def parts(self) -> Iterator[None]:
        """Make the fields and buttons."""
        panel = self._panel
        tip = "Find the exposure that fills the sensor's range in the present light, nothing saturated"
        self.auto_button = button("Auto", tip, self.expose)
        behaviours = {
            name: Behaviour(offers=partial(self._offered, offered)) for name, offered in _OFFERED.items()
        }
        behaviours["trigger_mode"] = replace(behaviours["trigger_mode"], shown=trigger_words)
        behaviours["exposure_ms"] = Behaviour(beside=lambda: self.auto_button)
        self.form = OptionsForm([CameraOptions], behaviours, whole=False)
        self.widgets = self.form.widgets
        yield from self.form.parts()
        self.form.hide_fields(_OF_HARDWARE)
        self.form.refused.connect(panel.refused)
        self.form.settled.connect(self._settled)
        self.temperature = label("–")
        self.temperature.setToolTip("Of the sensor or camera, degrees Celsius, where it has a thermometer")
        self._temperature_name = label("Temperature")
        tip = "Everything that the camera reports of itself; its own settings can be changed there"
        self.all_button = button(
            "All settings…", tip, lambda: DeviceSettings(self._session, "camera", self).show()
        )
        self.presets = KeptBar(self._session, "camera", "Presets", self._preset, self._use_preset, "Use")
        self.buttons = in_row(self._temperature_name, (self.temperature, 1), self.all_button)
        yield
        fill(self, self.form, self.presets, self.buttons)
        yield
        self._session.device_changed.connect(self._device_changed)
        self._reads = every(self, _FIRST_READ_MS, self.read_back)
        self._device_changed("camera")

    def read_back(self) -> None:
        """Ask the camera for all settings, unless something else uses it."""
        is_open = self._session.is_open("camera")
        if is_open and self._session.jobs.is_busy("camera"):
            return
        self._reads.setInterval(_READ_BACK_MS)  # one that answers badly is asked no more often
        if not is_open:
            return
        job = self._session.jobs.device(
            "Reading the camera", lambda _: read_camera(self._session.bench.camera), {"camera"}, quiet=True
        )
        job.succeeded.connect(self._show)

    def expose(self) -> None:
        """Find an exposure for what is lit now, and say how good it is."""

        def work(camera: Camera) -> tuple[AutoExposure, CameraState]:
            from calibration_routines.psf.exposure import auto_expose

            return auto_expose(camera), read_camera(camera)

        start = partial(self._session.camera_job, EXPOSING, work, idle=True)
        job = self._panel.begin(start, self.auto_button)
        if job is not None:
            self.auto_button.setEnabled(False)
            job.succeeded.connect(self._exposed)
            job.ended.connect(lambda: self.auto_button.setEnabled(True))

    def _exposed(self, found: tuple[AutoExposure, CameraState]) -> None:
        exposure, state = found
        self._taken("exposure_ms", state)
        self._panel.accepted(self.auto_button)
        if exposure.usable:
            self._session.log("info", exposure.message)
        else:
            self._session.log("warning", exposure.message)
            self._panel.refused(self.auto_button, exposure.message)

    def _preset(self) -> dict[str, Any] | None:
        """Return the settings as the camera read them back last."""
        if self.state is None:
            return None
        now = {name: getattr(self.state, name) for name in _SET}
        return now | {"roi": list(self.state.roi.as_tuple())}

    def _use_preset(self, name: str, settings: dict[str, Any]) -> None:
        """Bring the camera to a preset's settings; what it does not take is said."""

        def work(camera: Camera) -> CameraState:
            restore_camera(camera, settings)
            return read_camera(camera)

        start = partial(self._session.camera_job, f"Preset {name}", work, idle=True)
        job = self._panel.begin(start, self.presets.names)
        if job is not None:
            job.succeeded.connect(lambda state: self._taken("exposure_ms", state))

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
            getattr(camera, f"set_{name}")(value)
            return read_camera(camera)

        words = f"{self.form.fields[name].bare_label} of the camera"
        try:
            job = self._session.camera_job(words, work, idle=name not in _WHILE_RUNNING)
        except BusyError as error:
            self._refuse(name, str(error))
            return None
        region = value if name == "roi" else None
        job.succeeded.connect(lambda state: self._taken(name, state, region))
        job.failed.connect(lambda why: self._refuse(name, why))
        return job

    def _taken(self, name: str, state: CameraState, asked: Roi | None = None) -> None:
        widget = self.widgets[name]
        if not isValid(widget):
            return
        if name == "roi" and asked is not None and asked != state.roi:
            now, wanted = (", ".join(map(str, region.as_tuple())) for region in (state.roi, asked))
            self._session.log("info", f"The camera reads region {now}; {wanted} was asked for.")
        self._panel.accepted()  # what Auto could not do in the settings before is over, too
        if isinstance(widget, QLineEdit):
            widget.setModified(False)
        self._show(state)

    def _refuse(self, name: str, why: str) -> None:
        widget = self.widgets[name]
        if not isValid(widget):
            return  # the window is closed; the session's log has said it
        if isinstance(widget, NumberEdit | Entry):
            widget.setModified(True)
            widget.refuse(why)  # what was typed stays to be corrected
        else:
            self._show(self.state)
            self.form.refuse(name, why)
            self._panel.refused(None, why)

    def _device_changed(self, kind: str) -> None:
        if kind == "camera":
            self.setEnabled(self._session.is_open("camera") and self.state is not None)
            self._reads.setInterval(_FIRST_READ_MS)
            self.read_back()

    def _show(self, state: CameraState | None) -> None:
        """Show what was read back."""
        if state is None:
            return
        self.state = state
        self.setEnabled(self._session.is_open("camera"))
        for name, limits in (("exposure_ms", state.exposure_limits_ms), ("gain", state.gain_limits)):
            number = self.form.fields[name]
            assert isinstance(number, NumberField)
            number.set_limits(*limits)
        for name, offered in _OFFERED.items():
            choice = self.form.fields[name]
            assert isinstance(choice, ChoiceField)
            if not choice.is_being_edited:
                choice.offer(self._offered(offered))
            choice.widget.setEnabled(bool(getattr(state, offered)))
        self.form.hide_fields(() if state.trigger_mode == "hardware" else _OF_HARDWARE)
        present = {name: getattr(state, name) for name in _SET}
        self.form.show_present(present | {"roi": ", ".join(map(str, state.roi.as_tuple()))})
        has_thermometer = state.temperature_c is not None
        self.temperature.setVisible(has_thermometer)
        self._temperature_name.setVisible(has_thermometer)
        if has_thermometer:
            self.temperature.setText(f"{state.temperature_c:.1f} °C")
