"""Forms behind each other, each on a page that scrolls, made a field at a time when they are asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from PySide6.QtWidgets import QScrollArea, QStackedWidget, QWidget

from gui.forms.options_form import OptionsForm
from gui.theme import dress
from gui.widgets.building import scrolled


class FormStack(QStackedWidget):
    """The forms of routines or tasks: begun when one is chosen, whole when it is asked for.

    Parameters
    ----------
    begin : callable
        Given a name, returns its form, of which no part is made yet.
    made : callable
        Called with the name of a form that has become whole.
    """

    def __init__(self, begin: Callable[[str], OptionsForm], made: Callable[[str], object]) -> None:
        super().__init__()
        self._make, self._made = begin, made
        self._begun: dict[str, tuple[OptionsForm, QScrollArea]] = {}
        self._parts: dict[str, Iterator[None]] = {}

    def __getitem__(self, name: str) -> OptionsForm:
        """Return a form, made to its end now if it was not yet."""
        for _ in self.parts(name):
            pass
        return self._begun[name][0]

    def page(self, name: str) -> QScrollArea:
        """Return the page of a form, which is begun now if it was not yet."""
        if name not in self._begun:
            form = self._make(name)
            self._begun[name] = form, (page := scrolled(form))
            self.addWidget(page)
            dress(page)
            self._parts[name] = form.parts()
        return self._begun[name][1]

    def pages(self) -> list[QWidget]:
        """Return the pages of all forms that are begun."""
        return [page for _, page in self._begun.values()]

    def show_page(self, name: str) -> None:
        """Show a form, or the place that it is made in."""
        self.setCurrentWidget(self.page(name))

    def is_whole(self, name: str) -> bool:
        """Whether a form has all of its fields."""
        return name in self._begun and name not in self._parts

    def parts(self, name: str) -> Iterator[None]:
        """Make what a form lacks, with a ``yield`` after each field."""
        self.page(name)
        while name in self._parts:
            try:
                next(self._parts[name])
            except StopIteration:
                del self._parts[name]
                self._made(name)
            yield
