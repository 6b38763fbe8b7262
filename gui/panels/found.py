"""What a task found: its sentences, tables and pictures, and the files that it wrote."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from PySide6.QtCore import Qt, QTimer, QUrl, Signal
from PySide6.QtGui import QDesktopServices, QFontDatabase, QImage, QPixmap
from PySide6.QtWidgets import QListWidget, QListWidgetItem, QTableWidget, QVBoxLayout, QWidget

from gui.background import NewestOnly
from gui.jobs import JobRunner
from gui.widgets.building import button, cell, fill, in_row, mark, split, table, tabs, text_view
from gui.widgets.orientation import read_turned
from gui.widgets.picture import Picture
from gui.words import in_two_lines, with_signs
from instrument.files.orientation import Orientation

_PICTURES = (".png", ".jpg", ".svg")
_ROW_PX = 26


class FoundView(QWidget):
    """Sentences and tables, a picture, and below them what was written, once there is anything.

    Signals
    -------
    lacks : int
        So many pixels of width are missing for a table or a picture to be seen whole.
    opened : Path
        A file to be opened in the panel that works with it, else as the desktop does.
    used
        Go on with the result.

    Parameters
    ----------
    jobs : JobRunner
        Pictures are read in one.
    turned : callable
        How pictures are turned now.
    """

    lacks = Signal(int)
    opened = Signal(object)
    used = Signal()

    def __init__(
        self, jobs: JobRunner, turned: Callable[[], Orientation], parent: QWidget | None = None
    ) -> None:
        super().__init__(parent)
        self._turned = turned
        self._reader = NewestOnly(jobs, "Reading a picture")
        self.files: tuple[Path, ...] = ()
        self.words = text_view(tip="Can be copied", empty="What is found stands here.")
        self.words.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        self.tables = QWidget()
        self._tables = QVBoxLayout(self.tables)
        self._tables.setContentsMargins(0, 0, 0, 0)
        self.picture = Picture()
        self.list = QListWidget()
        self.list.setAccessibleName("Files that were written")
        self.list.setToolTip("What was written; a click shows a picture, a double click opens a file")
        self.list.itemClicked.connect(lambda item: self._show(_path_of(item)))
        self.list.itemActivated.connect(lambda item: self.opened.emit(_path_of(item)))
        self.folder_button = button("Open folder", "Show it in the file manager", self._open_folder)
        tip = "Take the result to the panel that works with it"
        self.use_button = button("Go on with it…", tip, self.used)
        told = fill(QWidget(), (self.words, 1), (self.tables, 1), margins=(6, 0, 0, 0))
        self.results = tabs({"What was found": told, "Picture": self.picture})
        self.below = QWidget()
        """What was written; nothing stands there before."""
        foot = in_row((self.list, 1), fill(QWidget(), self.use_button, self.folder_button, None))
        fill(self.below, foot, margins=(6, 0, 0, 0))
        fill(self, split(self.results, self.below, sizes=[560, 130], down=True, firm=True))
        self.clear()

    def clear(self) -> None:
        """Show nothing of what was found before."""
        self._reader.forget()  # a picture of what was there before
        self.words.setPlainText("")
        self.words.show()
        self.results.setCurrentIndex(0)  # a picture comes to the front once there is one
        self.mark_wrong(False)
        while (item := self._tables.takeAt(0)) is not None:
            if (widget := item.widget()) is not None:
                widget.deleteLater()
        self.tables.hide()
        self.picture.clear()
        self.list.clear()
        self.files = ()
        self.folder_button.setEnabled(False)
        self.below.hide()
        self.use_button.setEnabled(False)

    def mark_wrong(self, wrong: bool) -> None:
        """Have it seen without being read that something is wrong, or no longer."""
        mark(self.words, "refused", wrong)

    def say(self, text: str) -> None:
        """Add a sentence."""
        self.words.appendPlainText(text)
        self.words.show()

    def add_table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str) -> None:
        """Add a table."""
        made = table([in_two_lines(with_signs(heading)) for heading in headings], title, row_px=_ROW_PX)
        made.setRowCount(len(rows))
        for row, texts in enumerate(rows):
            for column, shown in enumerate(texts):
                made.setItem(row, column, cell(with_signs(shown), number=True))
        made.verticalHeader().hide()
        self._tables.addWidget(made)
        self.tables.show()
        self.words.setVisible(bool(self.words.toPlainText()))
        QTimer.singleShot(0, self, self._tell_what_lacks)  # once it has its place

    def show_files(self, files: tuple[Path, ...], *, usable: bool) -> None:
        """List what was written, and show the first picture of it."""
        self.files = files
        for path in files:
            item = QListWidgetItem(path.name)
            item.setToolTip(str(path))
            item.setData(Qt.ItemDataRole.UserRole, path)
            self.list.addItem(item)
        self.below.setVisible(bool(files))
        self.folder_button.setEnabled(bool(files))
        self.use_button.setEnabled(usable)
        pictures = [path for path in files if path.suffix in _PICTURES]
        previews = [
            path for path in pictures if path.stem.endswith("-preview")
        ]  # of a pattern that says little
        if pictures:
            self._show([*previews, *pictures][0])

    def forget(self) -> None:
        """Read nothing more."""
        self._reader.forget()

    def _show(self, path: Path) -> None:
        if path.suffix in _PICTURES:
            seen = self._turned()
            self._reader.ask(lambda: read_turned(path, seen), self._show_picture)

    def _show_picture(self, picture: QImage) -> None:
        self.picture.show_pixmap(QPixmap.fromImage(picture))
        self.results.setCurrentWidget(self.picture)
        self._tell_what_lacks()

    def _tell_what_lacks(self) -> None:
        """Say what width is missing: for a table's columns, or for a picture in its own size."""
        shown = self.tables.findChildren(QTableWidget) if self.results.currentIndex() == 0 else []
        lacking = max((t.horizontalHeader().length() - t.viewport().width() for t in shown), default=0)
        if self.results.currentWidget() is self.picture:
            lacking = self.picture.lacks_px
        if lacking > 0:
            self.lacks.emit(lacking)

    def open_as_desktop(self, path: Path) -> None:
        """Open a file or folder as the desktop does."""
        QDesktopServices.openUrl(QUrl.fromLocalFile(str(path)))

    def _open_folder(self) -> None:
        if self.files:
            self.open_as_desktop(self.files[0].parent)


def _path_of(item: QListWidgetItem) -> Path:
    path: Path = item.data(Qt.ItemDataRole.UserRole)
    return path
