"""The start page: a simulated bench to try, a bench of one's own, or files of one's own."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from PySide6.QtCore import Qt
from PySide6.QtGui import QColor, QDragEnterEvent, QDropEvent, QFont, QIcon, QPaintEvent
from PySide6.QtWidgets import (
    QCommandLinkButton,
    QGridLayout,
    QStackedWidget,
    QStyle,
    QStyleOptionButton,
    QStylePainter,
    QWidget,
)

from gui.panel import Panel
from gui.panels.new_bench import NewBench
from gui.session import BenchSession
from gui.session_news import OwnFiles
from gui.theme import colours
from gui.widgets.building import fill, in_row, label
from gui.widgets.dialogues import IMAGES, choose_path
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import load_config, tried_bench
from recon.base.as_python import Imports, expression

_TRIED = {
    "default": (
        "Try the camera",
        "A simulated camera behind a diffuser: calibrate, photograph, reconstruct",
        "PSFs of a moving point source; pictures and volumes by inverse problems",
    ),
    "display": (
        "Try the display",
        "A simulated SLM and scattering mask: align, compute, show holograms",
        "A phase-only SLM before a random mask, which widens its field of view (étendue expansion)",
    ),
    "led_microscope": (
        "Try the microscope",
        "A simulated LED array microscope: phase from half circles",
        "Differential phase contrast (DPC)",
    ),
    "screen": (
        "Try a screen",
        "A simulated monitor before the camera: calibrate by pictures",
        "PSF from photographs of known pictures, without a stage",
    ),
}
_WRITTEN = "its bench.toml is written into a folder of its own, with its runs beside it"
_COLUMNS = 2
_WIDEST_PX = 900
_CARD_PX = 70
"""Height of a button: its name and two lines."""
_INSIDE = (12, 9, -12, -6)


class Card(QCommandLinkButton):
    """A large button: its name, and below it, quieter, what it leads to."""

    def __init__(self, words: str, about: str) -> None:
        super().__init__(words, about)
        self.setObjectName("card")

    def paintEvent(self, event: QPaintEvent) -> None:  # noqa: N802 - Qt's name
        """Paint it: Qt's own goes to the very edge at the right, all of it in one colour."""
        painter, option = QStylePainter(self), QStyleOptionButton()
        self.initStyleOption(option)
        option.text, option.icon = "", QIcon()
        painter.drawControl(QStyle.ControlElement.CE_PushButton, option)
        inside = self.rect().adjusted(*_INSIDE)
        named = QFont(self.font())
        named.setBold(True)
        painter.setFont(named)
        painter.setPen(QColor(colours().text))
        painter.drawText(inside, Qt.AlignmentFlag.AlignTop, self.text())
        inside.setTop(inside.top() + painter.fontMetrics().lineSpacing() + 2)
        painter.setFont(self.font())
        painter.setPen(QColor(colours().dim))
        painter.drawText(inside, Qt.TextFlag.TextWordWrap, self.description())


class StartPanel(Panel):
    """What can be done first, each by one button."""

    def __init__(self, session: BenchSession, parent: QWidget | None = None) -> None:
        super().__init__(session, parent)
        self.setAcceptDrops(True)
        self.cards: dict[str, QCommandLinkButton] = {}
        has_bench = bool(session.kinds)
        at = f"Open now: {session.config.label}." if has_bench else "No bench is open."
        self.place = label(f"{at} What is made goes to {session.runs_folder}.", "dim", wraps=True)
        self.place.setContentsMargins(0, 0, 0, 6)
        parts: list[QWidget] = [label("What would you like to do?", "title"), self.place]
        tried = {
            name: (words, about, f"{tip}; {_WRITTEN}.", partial(self.try_bench, name))
            for name, (words, about, tip) in _TRIED.items()
        }
        own: dict[str, tuple[str, str, str, Callable[[], object]]] = {
            "open": (
                "Open a bench…",
                "A bench.toml that names your devices",
                "One table a device, its driver and address; Ctrl+O leads here from any panel",
                self._choose_bench,
            ),
            "new": (
                "New bench from what is connected…",
                "Finds devices and writes a bench.toml",
                "Looks at every bus for about a quarter of a minute; nothing moves or lights up",
                self._new_bench,
            ),
        }
        files: dict[str, tuple[str, str, str, Callable[[], object]]] = {
            "files": (
                "Reconstruct my own files…",
                "A PSF and a photograph from anywhere; or drop them here",
                "PSF: the picture of one point of light (point spread function). No bench is needed",
                self._choose_psf,
            ),
            "results": (
                "Open files…",
                "A picture, a volume or a record that was made before",
                "Results of Reconstruct or of the terminal, looked at in Reconstructions",
                self._choose_result,
            ),
        }
        for heading, cards in (
            ("TRY IT, SIMULATED: nothing real moves or lights up", tried),
            ("YOUR BENCH", own),
            ("YOUR FILES", files),
        ):
            grid = QGridLayout()
            grid.setSpacing(8)
            for number, (name, (words, about, tip, call)) in enumerate(cards.items()):
                grid.addWidget(
                    self._card(name, words, about, tip, call), number // _COLUMNS, number % _COLUMNS
                )
            parts += [label(heading, "heading"), _holding(grid)]
        self.page = fill(QWidget(), *parts, None, margins=(16, 12, 16, 8), spacing=6)
        self.page.setMaximumWidth(_WIDEST_PX)
        self.new_bench = NewBench(session, self)
        self.pages = QStackedWidget()
        self.pages.addWidget(fill(QWidget(), in_row(None, (self.page, 100), None)))
        self.pages.addWidget(self.new_bench)
        self.new_bench.left.connect(lambda: self.pages.setCurrentIndex(0))
        self.setFocusProxy(self.cards["default"])
        fill(self.body, self.pages)

    def _card(
        self, name: str, words: str, about: str, tip: str, call: Callable[[], object]
    ) -> QCommandLinkButton:
        card = Card(words, about)
        card.setMinimumHeight(_CARD_PX)
        card.setAccessibleDescription(f"{about}. {tip}")
        card.setToolTip(tip)
        card.clicked.connect(lambda: call())
        self.cards[name] = card
        return card

    # Benches -------------------------------------------------------------------------------------
    def try_bench(self, name: str) -> None:
        """Open a simulated bench, whose file is written below the folder of this one if it is not there."""
        here = self.session.config.path
        folder = self.session.runs_folder.parent
        if here is not None and here.parent.name.startswith("simulated-"):
            folder = here.parent.parent  # they lie beside each other
        self._open(f"Opening the simulated bench: {name}", lambda: tried_bench(name, folder))

    def open_bench(self, path: Path) -> None:
        """Open the bench of a file in this one's place."""
        self._open(f"Opening {path.name}", lambda: load_config(path))

    def _open(self, title: str, load: Callable[[], BenchConfig]) -> None:
        job = self.follow(self.jobs.watch(title, lambda _: load()))
        job.succeeded.connect(self.session.bench_wanted.emit)

    def _choose_bench(self) -> None:
        start = str(self.session.config.path or self.session.runs_folder.parent)
        choose_path(self, "open", "Open a bench", start, self.open_bench, "Benches (*.toml)")

    def _new_bench(self) -> None:
        self.pages.setCurrentWidget(self.new_bench)
        self.new_bench.look()

    # Files ---------------------------------------------------------------------------------------
    def _choose_psf(self) -> None:
        words = "First the PSF: what one point of light gives"
        choose_path(self, "open", words, "", self._psf_chosen, IMAGES)

    def _psf_chosen(self, psf: Path) -> None:
        def then(photograph: Path) -> None:
            self.session.handed_on.emit("reconstructions", OwnFiles(photograph, psf))

        choose_path(self.page, "open", "Now the photograph", str(psf.parent), then, IMAGES)

    def _choose_result(self) -> None:
        def chosen(path: Path) -> None:
            self.session.handed_on.emit("reconstructions", OwnFiles(result=path))

        start = str(self.session.runs_folder)
        choose_path(self, "open", "Open a result", start, chosen, "Results (*.tif *.tiff *.npy *.json)")

    def take(self, what: str) -> None:
        """Try a simulated bench, by its name."""
        self.try_bench(what)

    # Dropped files -------------------------------------------------------------------------------
    def dragEnterEvent(self, event: QDragEnterEvent) -> None:  # noqa: N802 - Qt's name
        """Let files be dropped here."""
        if event.mimeData().hasUrls():
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent) -> None:  # noqa: N802 - Qt's name
        """Open what was dropped."""
        self.dropped([Path(url.toLocalFile()) for url in event.mimeData().urls() if url.isLocalFile()])

    def dropped(self, paths: list[Path]) -> None:
        """Open a bench.toml, or a photograph with its PSF, told apart by "psf" in one file's name."""
        if len(paths) == 1 and paths[0].suffix == ".toml":
            self.open_bench(paths[0])
            return
        psfs = [path for path in paths if "psf" in path.stem.lower()]
        others = [path for path in paths if path not in psfs]
        if len(psfs) == len(others) == 1:
            self.session.handed_on.emit("reconstructions", OwnFiles(others[0], psfs[0]))
            return
        self.refused(
            None,
            f"{len(paths)} dropped, {len(psfs)} with psf in the name: a bench.toml is expected, or a "
            "photograph and its PSF, whose name has psf in it. Or choose them: Reconstruct my own files.",
        )

    def as_python(self) -> str:
        """Return lines that open this bench."""
        if not self.session.kinds:
            return "import diffuserbench as db\n\nresult = db.reconstruct('photograph.tif', 'psf.tif')\n"
        imports = Imports({("instrument.bench.bench", "open_bench")})
        path = self.session.config.path
        given = "" if path is None else expression(path, imports)
        lines = [f"with open_bench({given}) as bench:", "    print(bench.label)", ""]
        return "\n".join([*imports.lines(), "", *lines])


def _holding(grid: QGridLayout) -> QWidget:
    holder = QWidget()
    grid.setContentsMargins(0, 0, 0, 6)
    for column in range(_COLUMNS):
        grid.setColumnStretch(column, 1)
    holder.setLayout(grid)
    return holder
