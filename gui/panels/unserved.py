"""In the place of a panel that this bench cannot serve: why, and what would."""

from __future__ import annotations

from collections.abc import Sequence

from PySide6.QtWidgets import QWidget

from gui.panel import Panel
from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import Hint, fill
from instrument.bench.config_file import TEMPLATES, not_tried_on


class UnservedPanel(Panel):
    """One sentence and a button to a simulated bench that serves the panel, or to a bench of one's own."""

    def __init__(
        self, session: BenchSession, title: str, why: str, tried_on: str, parent: QWidget | None = None
    ) -> None:
        super().__init__(session, parent)
        self.title = title
        tried_on = tried_on or "default"
        what = TEMPLATES[tried_on][0]
        hint = Hint(
            why,
            f"Open the simulated {what}",
            lambda: session.handed_on.emit("start", tried_on),
            ("Another bench…", lambda: session.handed_on.emit("start", "")),
        )
        self.setFocusProxy(hint.button)
        self.copy_button.hide()
        fill(self.body, hint)

    def as_python(self) -> str:
        """Return why there is nothing to be done."""
        return f"# {self.title}: this bench cannot serve it.\n"


def why_not(session: BenchSession, title: str, needs: Sequence[str], tried_on: str) -> str:
    """Return why a bench cannot serve what needs devices, simulated ones ``tried_on``; empty where it can."""
    missing = [name_of(kind) for kind in needs if kind not in session.kinds]
    if not session.kinds and needs:
        return f"{title} needs a bench with {_listed([name_of(kind) for kind in needs])}; no bench is open."
    if missing:
        return (
            f"{title} needs {_listed(missing)}, which this bench does not have. "
            "A table in its bench.toml adds one."
        )
    if tried_on and (wrong := not_tried_on(session.config, needs, tried_on)):
        return (
            f"{title} needs a simulated {TEMPLATES[tried_on][0]}: the simulated "
            f"{' and '.join(map(name_of, wrong))} of this bench would see nothing of it."
        )
    return ""


def _listed(names: Sequence[str]) -> str:
    words = [f"{'an' if name[0] in 'LS' else 'a'} {name}" for name in names]
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
