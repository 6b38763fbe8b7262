"""All settings of a device, as read back, and fields for those that are its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from PySide6.QtWidgets import QComboBox, QFormLayout, QLineEdit, QVBoxLayout, QWidget
from shiboken6 import isValid

from drivers.device import OwnSetting, Setting
from gui.jobs import BusyError, Job
from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import choice, label, mark, scrolled
from gui.widgets.dialogues import TextWindow, elided
from instrument.bench.config import Kind


class DeviceSettings(TextWindow):
    """What a device says of itself; its own settings, where its driver can change any, below.

    A setting is sent when Return is pressed or another value chosen; the field then shows what the device
    made of it. The live view pauses for a camera's.

    Parameters
    ----------
    session : BenchSession
    kind : str
        Of device.
    text : str
    parent : QWidget
    """

    def __init__(self, session: BenchSession, kind: Kind, text: str, parent: QWidget) -> None:
        super().__init__(f"Settings of the {name_of(kind)}, as read back", text, parent)
        self._session, self._kind = session, kind
        self.fields: dict[str, QComboBox | QLineEdit] = {}
        self.note = label(role="dim", wraps=True)
        layout = self.layout()
        assert isinstance(layout, QVBoxLayout)
        self._layout = layout
        layout.insertWidget(1, self.note)
        session.device_changed.connect(self._changed)
        if session.is_open(kind):
            device = session.bench.devices[kind]
            self._begin("Reading its own settings", lambda: device.own_settings(), self._fill, pauses=False)

    def _begin(
        self, title: str, work: Callable[[], object], then: Callable[[Any], object], *, pauses: bool = True
    ) -> Job | None:
        session = self._session

        def in_sight(do: Callable[[Any], object], what: Any) -> None:
            if isValid(self):  # else it was closed meanwhile
                do(what)

        try:
            if self._kind == "camera" and pauses:
                job = session.camera_job(title, lambda _: work(), idle=True)
            else:
                job = session.jobs.device(title, lambda _: work(), {self._kind}, quiet=not pauses)
        except BusyError as error:
            self._say(str(error))
            return None
        job.succeeded.connect(partial(in_sight, then))
        job.failed.connect(partial(in_sight, self._say))
        return job

    def _say(self, words: str) -> None:
        elided(self.note, words)

    def _fill(self, own: Mapping[str, OwnSetting]) -> None:
        """Make the fields."""
        if not own:
            return
        form = QFormLayout()
        for name, setting in own.items():
            if setting.choices:
                field: QComboBox | QLineEdit = choice(setting.choices)
                assert isinstance(field, QComboBox)
                field.setCurrentText(str(setting.value))
                field.textActivated.connect(partial(self._set, name))
            else:
                field = QLineEdit(str(setting.value))
                field.returnPressed.connect(lambda name=name, field=field: self._set(name, field.text()))
            field.setAccessibleName(name)
            field.setToolTip(f"{name}: {setting.takes}")
            self.fields[name] = field
            form.addRow(label(name), field)
        page = QWidget()
        page.setLayout(form)
        self._layout.insertWidget(1, scrolled(page), 2)
        self._say("Return, or another choice, sets it; bench.toml keeps it for the next time.")

    def _set(self, name: str, value: str) -> None:
        device = self._session.bench.devices[self._kind]
        title = f"{name} of the {name_of(self._kind)}"
        mark(self.fields[name], "refused", True)  # until it is in force
        self._begin(title, lambda: device.set_own(name, value), partial(self._is_set, name))

    def _is_set(self, name: str, now: Setting) -> None:
        field = self.fields[name]
        mark(field, "refused", False)
        if isinstance(field, QComboBox):
            field.setCurrentText(str(now))
        else:
            field.setText(str(now))
        self._say(f"{name} is {now} now.")

    def _changed(self, kind: str) -> None:
        if kind == self._kind:
            for field in self.fields.values():
                field.setEnabled(self._session.is_open(kind))
