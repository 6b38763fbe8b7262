"""What is kept with the bench under names: chosen, saved under what is typed, removed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QSignalBlocker
from PySide6.QtWidgets import QWidget

from gui.session import BenchSession
from gui.widgets.building import button, choice, fill, narrow


class KeptBar(QWidget):
    """Names to choose from, and to type; Save and Remove.

    Parameters
    ----------
    session : BenchSession
    kind : str
        Of what is kept.
    words : str
        What it is called, in the plural.
    take : callable
        Returns what is to be kept now; None where there is nothing.
    apply : callable
        Called with a name and what is kept under it, when it was chosen.
    """

    def __init__(
        self,
        session: BenchSession,
        kind: str,
        words: str,
        take: Callable[[], Any],
        apply: Callable[[str, Any], object],
    ) -> None:
        super().__init__()
        self._session, self._kind, self._take, self._apply = session, kind, take, apply
        self.names = narrow(choice((), f"{words}, kept with the bench: choose one, or type a name and save"))
        self.names.setEditable(True)
        self.names.setAccessibleName(words)
        entry = self.names.lineEdit()
        assert entry is not None
        entry.setPlaceholderText(words)
        self.names.activated.connect(lambda _: self._chosen())
        self.save_button = button("Save", "Keep what is set now under this name", self.save)
        self.remove_button = button("Remove", "Keep it no longer", self.remove)
        fill(self, (self.names, 1), self.save_button, self.remove_button, across=True)
        session.kept_changed.connect(self.show_names)
        self.show_names()

    def show_names(self) -> None:
        """Offer what is kept."""
        typed = self.names.currentText()
        with QSignalBlocker(self.names):
            self.names.clear()
            self.names.addItems(sorted(self._session.kept.of(self._kind)))
            self.names.setCurrentText(typed)

    def save(self) -> None:
        """Keep what is set now."""
        name, value = self.names.currentText().strip(), self._take()
        if name and value is not None:
            self._session.keep(self._kind, name, value)

    def remove(self) -> None:
        """Keep what is chosen no longer."""
        self._session.keep(self._kind, self.names.currentText().strip(), None)
        self.names.setCurrentText("")

    def _chosen(self) -> None:
        name = self.names.currentText()
        value = self._session.kept.of(self._kind).get(name)
        if value is not None:
            self._apply(name, value)
