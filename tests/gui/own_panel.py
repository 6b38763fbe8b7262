"""A panel of somebody's own, as CONTRIBUTING.md has it: this file, and one line in the table of panels."""

from __future__ import annotations

from dataclasses import dataclass

from PySide6.QtWidgets import QPushButton, QVBoxLayout, QWidget

from gui.forms.options_form import OptionsForm
from gui.panel import Panel
from gui.session import BenchSession
from recon.base.as_python import expression
from recon.base.declare import option


@dataclass(frozen=True, kw_only=True)
class BlinkOptions:
    times: int = option(3, help="How often.", least=1)
    every_ms: float = option(100.0, help="From one to the next.", unit="ms", above=0)


class BlinkPanel(Panel):
    """Says how it would blink."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.form = OptionsForm([BlinkOptions])
        self.form.refused.connect(self.refused)
        self.button = QPushButton("Blink")
        self.button.clicked.connect(self.blink)
        layout = QVBoxLayout(self.body)
        layout.addWidget(self.form)
        layout.addWidget(self.button)

    def blink(self) -> None:
        if self.form.check():
            self.session.log("info", f"Blinks {self.form.make(BlinkOptions).times} times.")

    def as_python(self) -> str:
        made = expression(self.form.make(BlinkOptions))
        return f"from tests.gui.own_panel import BlinkOptions\n\noptions = {made}\n"
