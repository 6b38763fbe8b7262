"""The reconstructions that are in the data folder, the newest first."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QListWidget, QListWidgetItem, QWidget

from gui.jobs import JobRunner
from gui.widgets.building import button, fill, hint, in_row
from gui.widgets.dialogues import choose_path
from instrument.files.results import find_results

_FILTERS = "Results (*.tif *.tiff *.npy *.json)"


class ResultsList(QWidget):
    """Results by name and age; one is opened by a click, or from anywhere.

    Signals
    -------
    chosen : Path
        To be opened.
    failed : str
        Why the folder cannot be looked into.

    Parameters
    ----------
    jobs : JobRunner
        The folder is looked through in one.
    folder : Path
    """

    chosen = Signal(object)
    failed = Signal(str)

    def __init__(self, jobs: JobRunner, folder: Path, parent: QWidget | None = None) -> None:
        super().__init__(parent)
        self._jobs, self._folder = jobs, folder
        self.list = QListWidget()
        self.list.setAccessibleName("Reconstructions")
        self.list.setToolTip("Reconstructions in the data folder, the newest first (Enter opens)")
        self.list.setAlternatingRowColors(True)
        for picked in (self.list.itemActivated, self.list.itemClicked):
            picked.connect(lambda item: self.chosen.emit(item.data(Qt.ItemDataRole.UserRole)))
        tip = "Open any picture or volume: TIFF, OME-Zarr, .npy, or a record"
        self.open_button = button("Open…", tip, self._choose)
        self.refresh_button = button("Refresh", "Look into the data folder again", self.refresh)
        self.none = hint("No reconstruction is in the data folder yet.")
        self.none.hide()
        buttons = in_row(self.open_button, self.refresh_button)
        fill(self, (self.none, 1), (self.list, 1), buttons, margins=(0, 6, 0, 0))

    def refresh(self) -> None:
        """List the results in the data folder."""
        folder = self._folder
        look = self._jobs.watch("Looking for results", lambda _: [(p, _age(p)) for p in find_results(folder)])
        look.succeeded.connect(self._show)
        look.failed.connect(self.failed)

    def _show(self, records: list[tuple[Path, str]]) -> None:
        self.list.clear()
        self.none.setVisible(not records)
        self.list.setVisible(bool(records))
        for record, changed in records:
            item = QListWidgetItem(f"{record.stem}\n    {changed}  {record.parent.name}")
            item.setToolTip(str(record))
            item.setData(Qt.ItemDataRole.UserRole, record)
            self.list.addItem(item)

    def _choose(self) -> None:
        choose_path(self.list, "open", "Open a result", str(self._folder), self.chosen.emit, _FILTERS)


def _age(record: Path) -> str:
    """Return when a record was written; nothing for one that is gone by now."""
    try:
        return datetime.fromtimestamp(record.stat().st_mtime).strftime("%Y-%m-%d %H:%M")
    except OSError:
        return ""
