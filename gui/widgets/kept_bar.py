"""What is kept with the bench under names: chosen, used, saved under what is typed, removed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from PySide6.QtCore import QSignalBlocker
from PySide6.QtWidgets import QComboBox, QWidget

from gui.session import BenchSession
from gui.widgets.building import button, choice, fill, narrow


class KeptBar(QWidget):
    """Names to choose from, and to type; a button that uses what is chosen; Save and Remove.

    Wheel, keys and typing only choose: the stage moves by the button alone. What is saved without a name gets
    one.

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
        Called with a name and what is kept under it, when it is to be used.
    answer : str
        On the button that uses it.
    """

    def __init__(
        self,
        session: BenchSession,
        kind: str,
        words: str,
        take: Callable[[], Any],
        apply: Callable[[str, Any], object],
        answer: str,
    ) -> None:
        super().__init__()
        self._session, self._kind, self._take, self._apply = session, kind, take, apply
        self._one = words.lower().removesuffix("s")
        self.names = narrow(choice((), f"{words}, kept with the bench: choose one, or type a name and save"))
        self.names.setEditable(True)
        self.names.setInsertPolicy(QComboBox.InsertPolicy.NoInsert)
        self.names.setCompleter(None)  # type: ignore[arg-type] # Qt takes none; its stub does not
        self.names.setAccessibleName(words)
        entry = self.names.lineEdit()
        assert entry is not None
        entry.setPlaceholderText(words)
        self.use_button = button(answer, "Use what is kept under this name", self.use)
        self.save_button = button("Save", "Keep what is set now under this name", self.save)
        self.remove_button = button("Remove", "Keep it no longer", self.remove)
        fill(self, (self.names, 1), self.use_button, self.save_button, self.remove_button, across=True)
        self.names.currentTextChanged.connect(lambda _: self._set_usable())
        session.kept_changed.connect(self.show_names)
        self.show_names()

    def show_names(self) -> None:
        """Offer what is kept."""
        typed = self.names.currentText()
        with QSignalBlocker(self.names):
            self.names.clear()
            self.names.addItems(sorted(self._session.kept.of(self._kind)))
            self.names.setCurrentText(typed)
        self._set_usable()

    def _set_usable(self) -> None:
        is_kept = self.names.currentText().strip() in self._session.kept.of(self._kind)
        self.use_button.setEnabled(is_kept)
        self.remove_button.setEnabled(is_kept)

    def save(self) -> None:
        """Keep what is set now."""
        kept = self._session.kept.of(self._kind)
        free = (f"{self._one} {number}" for number in range(1, len(kept) + 2))
        name = self.names.currentText().strip() or next(name for name in free if name not in kept)
        if (value := self._take()) is not None:
            self._session.keep(self._kind, name, value)
            self.names.setCurrentText(name)

    def remove(self) -> None:
        """Keep what is chosen no longer."""
        self._session.keep(self._kind, self.names.currentText().strip(), None)
        self.names.setCurrentText("")

    def use(self) -> None:
        """Use what is kept under the name."""
        name = self.names.currentText().strip()
        value = self._session.kept.of(self._kind).get(name)
        if value is not None:
            self._apply(name, value)
