"""The way on after a fault or STOP, where it happened: devices to reconnect, a run to go on with."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QPushButton, QWidget

from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import button, fill
from instrument.bench.config import Kind


class ReconnectButton(QPushButton):
    """Opens a device again; there while the device has failed.

    Parameters
    ----------
    session : BenchSession
    kind : str
        Of device.
    parent : QWidget
    words : str, optional
        On it; default: with the device's name.
    """

    def __init__(self, session: BenchSession, kind: Kind, parent: QWidget, words: str = "") -> None:
        super().__init__(words or f"Reconnect the {name_of(kind)}", parent)
        self.setToolTip(f"Open the {name_of(kind)} again")
        self._session, self._kind = session, kind
        self.clicked.connect(partial(session.reconnect, kind))
        session.device_changed.connect(self._changed)
        self._changed(kind)

    def _changed(self, kind: str) -> None:
        if kind == self._kind:
            self.setVisible(self._session.state(kind).condition == "failed")


class WayOn(QWidget):
    """A button for each device that has failed, and one for a run that did not end.

    Signals
    -------
    go_on : Path
        A run is to go on.
    """

    go_on = Signal(object)

    def __init__(self, session: BenchSession, parent: QWidget) -> None:
        super().__init__(parent)
        self.run: Path | None = None
        """The run that is offered."""
        self.reconnect = {kind: ReconnectButton(session, kind, self) for kind in session.kinds}
        self.go_on_button = button("Go on with it", clicked=lambda: self.go_on.emit(self.run))
        fill(self, *self.reconnect.values(), self.go_on_button)
        self.offer(None)

    def offer(self, run: Path | None, words: str = "Go on with it") -> None:
        """Offer a run, or none."""
        self.run = run
        self.go_on_button.setText(words)
        self.go_on_button.setToolTip(f"Take what {run} lacks, and make what it was taken for")
        self.go_on_button.setVisible(run is not None)
