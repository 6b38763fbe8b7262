"""A new bench.toml from the devices that are connected: found, ticked, written, opened."""

from __future__ import annotations

from pathlib import Path

from PySide6.QtCore import Qt, Signal
from PySide6.QtWidgets import QCheckBox, QListWidget, QListWidgetItem, QWidget

from drivers.device import FoundDevice
from drivers.registry.registry import Listing, list_devices
from gui.jobs import Job
from gui.panel import Panel
from gui.session import BenchSession
from gui.session_news import name_of
from gui.widgets.building import button, fill, in_row, label
from gui.widgets.dialogues import choose_path
from instrument.bench.config_file import DEFAULT_NAME, connected_bench, load_config
from instrument.files.atomic import require_new, write_text


class NewBench(QWidget):
    """A page of the start panel.

    Signals
    -------
    left
        The operator goes back.
    """

    left = Signal()

    def __init__(self, session: BenchSession, panel: Panel) -> None:
        super().__init__()
        self._session = session
        self._panel = panel
        self._looking: Job | None = None
        self.list = QListWidget()
        self.list.setAccessibleName("Devices that are connected")
        self.list.setToolTip("Tick what belongs to the bench: a camera, and one of each other kind at most")
        self.list.itemChanged.connect(lambda _: self._show_choice())
        self.said = label(wraps=True)
        self.probe = QCheckBox("Ask at serial ports too (writes to them)")
        self.probe.setToolTip("Finds stages behind common adapters; not where a stray command can do harm")
        self.look_button = button("Look again", "Look at every bus once more", self.look)
        tip = "Choose where the bench.toml goes, write it, open the bench; then its light and motion are real"
        self.write_button = button("Write and open…", tip, self._choose_file, primary=True, enabled=False)
        back = button("Back", "To the start page", self.left)
        heading = label("New bench from what is connected", "title")
        row = in_row(back, self.look_button, self.probe, None, self.write_button)
        fill(self, heading, self.said, (self.list, 1), row, margins=(16, 12, 16, 8))

    def look(self) -> None:
        """Look what is connected, in a job."""
        if self._looking is not None:
            return
        probe = self.probe.isChecked()
        self.said.setText("Looking at USB, serial ports, video devices, GenICam cameras, displays …")
        self._looking = job = self._panel.follow(
            self._session.jobs.watch("Looking what is connected", lambda _: list_devices(probe=probe))
        )
        job.succeeded.connect(self.show_found)
        job.failed.connect(self.said.setText)
        job.ended.connect(lambda: setattr(self, "_looking", None))

    def show_found(self, listing: Listing) -> None:
        """List the devices; those that a driver is sure of can be ticked, the first of each kind is."""
        self.list.clear()
        kinds: set[str] = set()
        for device in sorted(listing.found, key=lambda device: device.kind is None):
            known = bool(device.bench_lines())
            what = name_of(device.kind) if device.kind else "no driver knows it"
            item = QListWidgetItem(f"{device.description}   {device.address}   ({what})")
            item.setData(Qt.ItemDataRole.UserRole, device)
            item.setToolTip(device.bench_lines() or "Listed only: no driver is sure of it")
            if known:
                item.setFlags(item.flags() | Qt.ItemFlag.ItemIsUserCheckable)
                first = str(device.kind) not in kinds
                kinds.add(str(device.kind))
                item.setCheckState(Qt.CheckState.Checked if first else Qt.CheckState.Unchecked)
            else:
                item.setFlags(Qt.ItemFlag.ItemIsSelectable)
            self.list.addItem(item)
        self._unavailable = "\n".join(listing.unavailable)
        self._show_choice()

    @property
    def chosen(self) -> list[FoundDevice]:
        """The devices that are ticked."""
        items = [self.list.item(row) for row in range(self.list.count())]
        ticked = [item for item in items if item.checkState() is Qt.CheckState.Checked]
        return [item.data(Qt.ItemDataRole.UserRole) for item in ticked]

    def _show_choice(self) -> None:
        chosen = self.chosen
        kinds = [str(device.kind) for device in chosen]
        self.write_button.setEnabled("camera" in kinds and len(set(kinds)) == len(kinds))
        if "camera" not in kinds:
            words = (
                "No camera is ticked, and a bench needs one. Connect and power it, then Look again; or try a "
                "simulated bench first."
            )
        elif len(set(kinds)) < len(kinds):
            words = "Two devices of one kind are ticked: a bench has one of each. Untick one."
        else:
            words = f"The bench will have: {', '.join(map(name_of, kinds))}."
        notes = [f"{device.description}: {device.note}" for device in chosen if device.note]
        self.said.setText("\n".join([words, *notes, *filter(None, [getattr(self, "_unavailable", "")])]))

    def _choose_file(self) -> None:
        start = str(self._session.runs_folder.parent / "my-bench" / DEFAULT_NAME)
        choose_path(self, "save", "Where the bench.toml goes", start, self.write, "Benches (*.toml)")

    def write(self, path: Path) -> Job:
        """Write the bench of what is ticked, and open it."""
        chosen = self.chosen

        def work(_: object) -> object:
            text = connected_bench(chosen, path.parent.name or "bench")
            path.parent.mkdir(parents=True, exist_ok=True)
            require_new(path, overwrite=False)
            write_text(path, text)
            return load_config(path)

        job = self._panel.follow(self._session.jobs.watch(f"Writing {path.name}", work))
        job.succeeded.connect(self._session.bench_wanted.emit)
        return job
