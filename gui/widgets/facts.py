"""What is known of a result, as a text that can be selected and copied: warnings first."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from PySide6.QtWidgets import QTextBrowser, QWidget

from gui.theme import colours


class FactsView(QTextBrowser):
    """Names and values, warnings in plain words above them."""

    def __init__(self, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self.setOpenLinks(False)
        self.setMinimumSize(120, 60)
        self._shown: tuple[Sequence[tuple[str, str]], Sequence[str], bool] = ((), (), False)

    def restyle(self) -> None:
        """Take over the colours of the theme in use."""
        facts, warnings, simulated = self._shown
        self.show_facts(facts, warnings, simulated=simulated)

    def show_facts(
        self, facts: Sequence[tuple[str, str]], warnings: Sequence[str] = (), *, simulated: bool = False
    ) -> None:
        """Show warnings and facts; SIMULATED where it came from the simulated bench."""
        self._shown = facts, warnings, simulated
        now = colours()
        parts = []
        if simulated:
            parts.append(f'<p style="color:{now.warning}"><b>SIMULATED</b></p>')
        parts += [f'<p style="color:{now.warning}">Warning: {escape(text)}</p>' for text in warnings]
        rows = "".join(
            f'<tr><td style="color:{now.dim};padding-right:10px">{escape(name)}</td>'
            f"<td>{escape(value)}</td></tr>"
            for name, value in facts
        )
        self.setHtml("".join([*parts, f"<table>{rows}</table>"]))
