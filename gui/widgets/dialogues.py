"""Questions, file dialogues and long texts that stand in front of the window and keep no click from STOP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal

from PySide6.QtCore import Qt
from PySide6.QtGui import QFontDatabase, QGuiApplication
from PySide6.QtWidgets import (
    QDialog,
    QDialogButtonBox,
    QFileDialog,
    QLabel,
    QLineEdit,
    QMessageBox,
    QPushButton,
    QWidget,
)

from gui.theme import dress
from gui.widgets.building import button, fill, text_view

IMAGES = "Images (*.tif *.tiff *.png *.jpg *.jpeg *.bmp *.npy *.npz *.h5 *.hdf5 *.mat);;All files (*)"
"""What of PSFs and photographs can be read; a folder of pictures, or an OME-Zarr, is typed."""

Browse = Literal["open", "folder", "save"]


class Question(QMessageBox):
    """A question that blocks nothing: the window behind it takes clicks, above all on STOP.

    ``open`` and ``exec`` would make it modal, and so would a platform's own dialogue, which also keeps Escape
    to itself. Gone when it is closed.

    Parameters
    ----------
    parent : QWidget
        In front of its window it stays.
    title, text : str
    answers : (str, str)
        What the buttons say: yes, and no, which is also the answer where it is just closed.
    answered : callable
        Called with whether it was yes.
    icon : QMessageBox.Icon
    """

    def __init__(
        self,
        parent: QWidget,
        title: str,
        text: str,
        answers: tuple[str, str],
        answered: Callable[[bool], object],
        icon: QMessageBox.Icon = QMessageBox.Icon.Question,
    ) -> None:
        super().__init__(icon, title, text, parent=parent)
        dress(self)
        self.setOption(QMessageBox.Option.DontUseNativeDialog)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowModality(Qt.WindowModality.NonModal)
        yes = self.addButton(answers[0], QMessageBox.ButtonRole.AcceptRole)
        no = self.addButton(answers[1], QMessageBox.ButtonRole.RejectRole)
        if icon is not QMessageBox.Icon.Information:  # what breaks something off is not one key away
            self.setDefaultButton(no)
        self.finished.connect(lambda _: answered(self.clickedButton() is yes))

    def ask(self) -> None:
        """Show it, in front and with the keyboard."""
        self.show()
        self.raise_()
        self.activateWindow()


def choose_path(
    parent: QWidget, browse: Browse, title: str, start: str, then: Callable[[Path], object], filters: str = ""
) -> QFileDialog:
    """Let a file or folder be chosen; ``then`` is called with it. Returns at once.

    Parameters
    ----------
    parent : QWidget
        Has one such dialogue at a time: asked again, the one that is open comes to the front.
    browse : "open", "folder" or "save"
        A name to save under may be that of a file which exists: whoever writes it asks or refuses.
    title, start : str
        ``start`` is the path to begin with; may be empty.
    then : callable
    filters : str
        As QFileDialog's name filters.
    """
    present = parent.findChild(QFileDialog, options=Qt.FindChildOption.FindDirectChildrenOnly)
    if isinstance(present, QFileDialog):
        present.raise_()
        present.activateWindow()
        return present
    dialogue = QFileDialog(parent, title)
    dress(dialogue)
    dialogue.setOption(QFileDialog.Option.DontUseNativeDialog)
    dialogue.setOption(QFileDialog.Option.DontConfirmOverwrite)  # its own question is modal
    dialogue.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
    dialogue.setWindowModality(Qt.WindowModality.NonModal)
    modes = QFileDialog.FileMode
    dialogue.setFileMode(
        {"open": modes.ExistingFile, "folder": modes.Directory, "save": modes.AnyFile}[browse]
    )
    if browse == "folder":
        dialogue.setOption(QFileDialog.Option.ShowDirsOnly)
    if browse == "save":
        dialogue.setAcceptMode(QFileDialog.AcceptMode.AcceptSave)
    if filters and browse != "folder":
        dialogue.setNameFilter(filters)
    if start:
        path = Path(start).expanduser()
        dialogue.setDirectory(str(path if path.is_dir() else path.parent))
        if not path.is_dir():
            dialogue.selectFile(path.name)
    dialogue.fileSelected.connect(lambda name: then(Path(name)))
    dialogue.show()
    return dialogue


def path_field(
    words: str,
    tip: str,
    load: Callable[[], object],
    *,
    browse: Browse = "open",
    filters: str = "",
    start: Path | None = None,
) -> tuple[QLineEdit, QPushButton]:
    """Return a field for a path, and the button to choose one, first from ``start``; both load it."""
    field = QLineEdit()
    field.setPlaceholderText(words)
    field.setToolTip(f"{tip}; Enter loads it")
    field.setAccessibleName(words)
    field.returnPressed.connect(load)

    def chosen(path: Path) -> None:
        field.setText(str(path))
        load()

    def choose() -> None:
        choose_path(field, browse, tip, field.text() or str(start or ""), chosen, filters)

    what = f"Choose a {'folder' if browse == 'folder' else 'file'}"
    browse_button = button("…", what, choose)
    browse_button.setAccessibleName(f"{what}: {words}")
    return field, browse_button


_MOST_CHARACTERS = 220


def elided(label: QLabel, text: str) -> None:
    """Show a text's beginning on a label, all of it as its tool tip."""
    first = " ".join(text.split())
    short = first if len(first) <= _MOST_CHARACTERS else first[: _MOST_CHARACTERS - 1] + "…"
    label.setText(short)
    label.setToolTip(text)


class TextWindow(QDialog):
    """A long text in a window of its own, which can be selected and copied; gone when it is closed.

    To be shown by ``show``: ``open`` and ``exec`` would keep clicks from STOP.

    Parameters
    ----------
    title, text : str
    """

    def __init__(self, title: str, text: str, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        dress(self)
        self.setAttribute(Qt.WidgetAttribute.WA_DeleteOnClose)
        self.setWindowTitle(title)
        self.resize(760, 420)
        self.view = text_view(text)
        self.view.setFont(QFontDatabase.systemFont(QFontDatabase.SystemFont.FixedFont))
        buttons = QDialogButtonBox(QDialogButtonBox.StandardButton.Close)
        copy = buttons.addButton("Copy all", QDialogButtonBox.ButtonRole.ActionRole)
        copy.clicked.connect(lambda: QGuiApplication.clipboard().setText(self.view.toPlainText()))
        copy.setToolTip("Put all of the text on the clipboard")
        buttons.button(QDialogButtonBox.StandardButton.Close).setToolTip(
            "Close this window (Esc, which stops, too)"
        )
        buttons.rejected.connect(self.reject)
        fill(self, (self.view, 1), buttons, margins=(8, 8, 8, 8))
