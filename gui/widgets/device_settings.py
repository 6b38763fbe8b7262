"""All settings of a device, as read back, and fields for those that are its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from PySide6.QtWidgets import QComboBox, QFormLayout, QLineEdit, QVBoxLayout, QWidget
from shiboken6 import isValid

from drivers.device import Device, OwnSetting, Setting
from gui.jobs import BusyError, Job
from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import choice, label, mark, scrolled
from gui.widgets.dialogues import TextWindow, elided
from instrument.bench.config import Kind


class DeviceSettings(TextWindow):
    """Who a device is and all of its settings; its own, where its driver can change any, below.

    A setting is sent when Return is pressed or another value chosen. All are read again then: a device may
    change others along with it. The live view pauses for a camera's.

    Parameters
    ----------
    session : BenchSession
    kind : str
        Of device.
    parent : QWidget
    """

    def __init__(self, session: BenchSession, kind: Kind, parent: QWidget) -> None:
        state = session.state(kind)
        self._who = state.text or state.condition
        super().__init__(f"Settings of the {name_of(kind)}, as read back", self._who, parent)
        self._session, self._kind = session, kind
        self._own: dict[str, Setting] = {}
        self.fields: dict[str, QComboBox | QLineEdit] = {}
        self.note = label(role="dim", wraps=True)
        layout = self.layout()
        assert isinstance(layout, QVBoxLayout)
        self._layout = layout
        layout.insertWidget(1, self.note)
        self.note.hide()
        session.device_changed.connect(self._changed)
        if session.is_open(kind):
            read = partial(_read, session.bench.devices[kind])
            self._begin(f"Reading the {name_of(kind)}", read, self._fill, pauses=False)

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
        self.note.show()

    def _fill(self, read: _Read) -> None:
        """Show what was read, and make the fields."""
        self._show(read)
        own = read[1]
        if not own:
            self._say("Its driver has no further settings that can be changed here.")
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

        def work() -> tuple[Setting, _Read]:
            now = device.set_own(name, value)
            return now, _read(device)

        title = f"{name} of the {name_of(self._kind)}"
        mark(self.fields[name], "refused", True)  # until it is in force
        self._begin(title, work, partial(self._is_set, name))

    def _is_set(self, name: str, done: tuple[Setting, _Read]) -> None:
        now, read = done
        mark(self.fields[name], "refused", False)
        changed = {n: setting.value for n, setting in read[1].items() if n in self.fields} | {name: now}
        others = [
            f"{n} is {value}" for n, value in changed.items() if n != name and value != self._own.get(n)
        ]
        self._show(read)
        for other, value in changed.items():
            field = self.fields[other]
            if isinstance(field, QComboBox):
                field.setCurrentText(str(value))
            elif other == name or not field.hasFocus():  # what is being typed stays
                field.setText(str(value))
        along = f" Changed along with it: {', '.join(others)}." if others else ""
        self._say(f"{name} is {now} now.{along}")

    def _show(self, read: _Read) -> None:
        settings, own = read
        self._own = {name: setting.value for name, setting in own.items()}
        lines = (f"{name} = {value}" for name, value in sorted(settings.items()))
        self.view.setPlainText("\n".join([self._who, "", *lines]))

    def _changed(self, kind: str) -> None:
        if kind == self._kind:
            for field in self.fields.values():
                field.setEnabled(self._session.is_open(kind))


_Read = tuple[Mapping[str, Setting], Mapping[str, OwnSetting]]
"""All settings of a device, and those that are its own."""


def _read(device: Device) -> _Read:
    return device.settings(), device.own_settings()
