"""The way on after a fault or STOP, where it happened: devices to reconnect, a run to go on with."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from PySide6.QtCore import Signal
from PySide6.QtWidgets import QPushButton, QWidget

from gui.session import BenchSession
from gui.session_news import names_of
from gui.widgets.building import button, fill
from instrument.bench.config import Kind


class ReconnectButton(QPushButton):
    """Opens devices again; there while one of them has failed.

    Parameters
    ----------
    session : BenchSession
    kinds : sequence of str
        Of devices.
    parent : QWidget
    words : str, optional
        On it; default: with the names of those that failed.
    """

    def __init__(
        self, session: BenchSession, kinds: Sequence[Kind], parent: QWidget, words: str = ""
    ) -> None:
        super().__init__(words or "Reconnect", parent)
        self.setToolTip("Open the devices that failed again")
        self._session, self._kinds, self._words = session, kinds, words
        self._failed: list[Kind] = []
        self.clicked.connect(self._reconnect)
        session.device_changed.connect(self._changed)
        self._changed()

    def _reconnect(self) -> None:
        for kind in self._failed.copy():
            self._session.reconnect(kind)

    def _changed(self, _kind: str = "") -> None:
        failed = [kind for kind in self._kinds if self._session.state(kind).condition == "failed"]
        if failed and failed != self._failed:
            self.setText(self._words or f"Reconnect the {names_of(failed)}")
            self.setToolTip(f"Open the {names_of(failed)} again")
        self._failed = failed
        self.setVisible(bool(failed))


class WayOn(QWidget):
    """A button for the devices that have failed, and one for a run that did not end.

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
        self.reconnect = ReconnectButton(session, session.kinds, self)
        self.go_on_button = button("Go on with it", clicked=lambda: self.go_on.emit(self.run))
        fill(self, self.reconnect, self.go_on_button)
        self.offer(None)

    def offer(self, run: Path | None, words: str = "Go on with it") -> None:
        """Offer a run, or none."""
        self.run = run
        self.go_on_button.setText(words)
        self.go_on_button.setToolTip(f"Take what {run} lacks, and make what it was taken for")
        self.go_on_button.setVisible(run is not None)
