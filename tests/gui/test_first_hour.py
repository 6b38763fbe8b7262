"""The first hour: the start page, benches opened from it, panels not served, files of one's own."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import QSettings, Qt
from PySide6.QtWidgets import QApplication, QFileDialog, QLineEdit, QWidget
from pytestqt.qtbot import QtBot

from drivers.device import FoundDevice
from drivers.registry.registry import Listing
from gui.help import KEYS
from gui.main_window import MainWindow
from gui.panels import PANELS
from gui.panels.holograms import HologramsPanel
from gui.panels.reconstructions import ReconstructionsPanel
from gui.panels.start import StartPanel
from gui.panels.unserved import UnservedPanel, why_not
from gui.session import BenchSession
from gui.widgets.dialogues import TextWindow
from gui.widgets.tab_order import stops_of
from instrument.bench.config import BenchConfig
from instrument.bench.config_file import TEMPLATES, no_bench, parse_config, template
from instrument.files.images import write_image
from tests.gui.looks import tabbed

LEFT = Qt.MouseButton.LeftButton
WAIT_MS = 60_000


@pytest.fixture
def bare(qtbot: QtBot, tmp_path: Path, settings: QSettings) -> Iterator[MainWindow]:
    """The window without a bench."""
    session = BenchSession(no_bench(tmp_path))
    window = MainWindow(session, settings)
    window.show()
    with qtbot.waitSignal(session.opened, timeout=WAIT_MS):
        session.open()
    yield window
    for panel in window._panels.values():
        panel.shutdown()
    if not session.is_closed:
        with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
            session.close()
    window._may_close = True
    window.close()
    window.deleteLater()


def start_of(window: MainWindow) -> StartPanel:
    panel = window.show_panel("start")
    assert isinstance(panel, StartPanel)
    return panel


def choose(qtbot: QtBot, window: MainWindow, path: Path) -> None:
    """Type a path into the file dialogue that is open, and press Return."""
    (dialogue,) = (d for d in window.findChildren(QFileDialog) if d.isVisible())
    dialogue.selectFile(str(path))
    dialogue.findChild(QLineEdit).setText(str(path))
    qtbot.keyClick(dialogue, Qt.Key.Key_Return)


def test_own_files_are_reconstructed_by_three_clicks_without_a_bench(
    qtbot: QtBot, bare: MainWindow, tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    psf = (rng.random((40, 50)) > 0.98).astype(np.float32)
    write_image(tmp_path / "point.tif", psf)
    write_image(tmp_path / "photo.tif", np.roll(psf, (4, 5), (0, 1)) + np.roll(psf, (-6, 2), (0, 1)))
    assert bare.tabs.currentWidget() is bare._places["start"]
    qtbot.mouseClick(start_of(bare).cards["files"], LEFT)  # one
    choose(qtbot, bare, tmp_path / "point.tif")
    choose(qtbot, bare, tmp_path / "photo.tif")
    panel = bare.panel("reconstructions")
    assert isinstance(panel, ReconstructionsPanel)
    qtbot.waitUntil(lambda: panel.job is not None, timeout=WAIT_MS)  # begun: that was what was asked for
    job = panel.job
    assert job is not None
    assert bare.tabs.currentWidget() is bare._places["reconstructions"]
    qtbot.waitUntil(
        lambda: job.is_over and (job.error is not None or panel.result is not None), timeout=WAIT_MS
    )
    assert job.error is None
    assert panel.result is not None
    assert panel.result.path.is_relative_to(tmp_path / "runs")
    assert not list(tabbed(bare)), "without a bench the bar of docks that are hidden is no stop"


def test_own_files_are_opened_reconstructed_and_saved_by_keys_alone(
    qtbot: QtBot, bare: MainWindow, tmp_path: Path
) -> None:
    psf = (np.random.default_rng(3).random((40, 50)) > 0.98).astype(np.float32)
    write_image(tmp_path / "point.tif", psf)
    write_image(tmp_path / "photo.tif", np.roll(psf, (4, 5), (0, 1)))

    def goes_to(part: QWidget) -> None:
        """Press Tab until a part has the keyboard: as often as there are stops, at most."""
        for _ in stops_of(bare):
            if part.hasFocus():
                return
            qtbot.keyClick(QApplication.focusWidget() or bare, Qt.Key.Key_Tab)
        raise AssertionError(f"Tab does not come to {part.accessibleName() or part.toolTip()}")

    def types(path: Path) -> None:
        """Type a path where the keyboard is in the dialogue that has just come, and press Return."""
        qtbot.waitUntil(lambda: any(d.isVisible() for d in bare.findChildren(QFileDialog)), timeout=WAIT_MS)
        (dialogue,) = (d for d in bare.findChildren(QFileDialog) if d.isVisible())
        dialogue.activateWindow()
        assert isinstance(dialogue.focusWidget(), QLineEdit), "one can type at once"
        choose(qtbot, bare, path)
        qtbot.waitUntil(lambda: not dialogue.isVisible(), timeout=WAIT_MS)
        bare.activateWindow()

    bare.activateWindow()
    qtbot.waitUntil(bare.isActiveWindow, timeout=WAIT_MS)
    qtbot.waitUntil(start_of(bare).cards["default"].hasFocus, timeout=WAIT_MS)
    card = start_of(bare).cards["files"]
    goes_to(card)
    qtbot.keyClick(card, Qt.Key.Key_Return)
    types(tmp_path / "point.tif")
    types(tmp_path / "photo.tif")
    panel = bare.panel("reconstructions")
    assert isinstance(panel, ReconstructionsPanel)
    qtbot.waitUntil(lambda: panel.result is not None, timeout=WAIT_MS)
    goes_to(panel.export_button)
    qtbot.keyClick(panel.export_button, Qt.Key.Key_Space)
    types(tmp_path / "saved.png")
    qtbot.waitUntil((tmp_path / "saved.png").is_file, timeout=WAIT_MS)


def test_each_simulated_bench_is_written_and_opened_from_the_start_page(
    qtbot: QtBot, bare: MainWindow, tmp_path: Path
) -> None:
    wanted: list[BenchConfig] = []
    bare.session.bench_wanted.disconnect(bare.change_bench)
    bare.session.bench_wanted.connect(wanted.append)
    start = start_of(bare)
    assert set(TEMPLATES) < set(start.cards)
    for number, name in enumerate(TEMPLATES):
        qtbot.mouseClick(start.cards[name], LEFT)
        qtbot.waitUntil(lambda n=number: len(wanted) > n, timeout=WAIT_MS)
    assert [config.path for config in wanted] == [
        tmp_path / f"simulated-{name.replace('_', '-')}" / "bench.toml" for name in TEMPLATES
    ]
    assert len({config.data_folder for config in wanted}) == len(TEMPLATES)


def test_a_bench_is_opened_in_the_place_of_another(qtbot: QtBot, bare: MainWindow, bench_text: str) -> None:
    start = start_of(bare)
    file = start.session.runs_folder.parent / "my.toml"
    file.write_text(bench_text)
    with qtbot.waitSignal(bare.session.closed, timeout=WAIT_MS):
        start.dropped([file])
    assert bare.next_bench is not None
    assert bare.next_bench.path == file


def test_panels_say_why_and_what_would_serve(qtbot: QtBot, bare: MainWindow, window: MainWindow) -> None:
    for name, entry in PANELS.items():
        panel = bare.show_panel(name)
        assert isinstance(panel, UnservedPanel) == bool(entry.needs), name
        if isinstance(panel, HologramsPanel):
            assert panel.shown.currentWidget() is panel.empty
            assert "needs a bench with an SLM; no bench is open" in panel.empty.words.text()
            assert panel.empty.button.text() == "Open the simulated holographic display"
    alignment = window.show_panel("alignment")
    assert isinstance(alignment, UnservedPanel)
    wanted: list[object] = []
    window.session.bench_wanted.disconnect(window.change_bench)
    window.session.bench_wanted.connect(wanted.append)
    proxy = alignment.focusProxy()
    assert proxy is not None
    qtbot.keyClick(proxy, Qt.Key.Key_Space)
    qtbot.waitUntil(lambda: bool(wanted), timeout=WAIT_MS)
    assert "simulated display" in wanted[0].label  # type: ignore[attr-defined]


def test_f1_tells_of_the_panel_in_front_and_of_every_key(
    bare: MainWindow, pytestconfig: pytest.Config
) -> None:
    start_of(bare)
    bare.show_help()
    (said,) = bare.findChildren(TextWindow)
    text = said.view.toPlainText()
    assert text.index("Try the camera: ") < text.index("KEYS")
    manual = (pytestconfig.rootpath / "docs" / "desktop.md").read_text()
    told = {keys for keys, _ in KEYS} | {entry.shortcut for entry in PANELS.values()}
    for keys in told:
        assert f"{keys}  " in text
        assert all(part.split("+")[-1].removeprefix(" ") in manual for part in keys.split(", ")), keys


def test_a_new_bench_is_written_of_what_is_ticked(
    qtbot: QtBot, bare: MainWindow, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def found(kind: str | None, address: str) -> FoundDevice:
        return FoundDevice("usb", address, f"A {kind}", driver=kind and "simulated", kind=kind)

    listing = Listing((found(None, "1"), found("stage", "2"), found("camera", "3"), found("camera", "4")), ())
    monkeypatch.setattr("gui.panels.new_bench.list_devices", lambda *, probe: listing)
    start = start_of(bare)
    qtbot.mouseClick(start.cards["new"], LEFT)
    page = start.new_bench
    qtbot.waitUntil(lambda: page.list.count() == 4, timeout=WAIT_MS)
    assert [device.address for device in page.chosen] == ["2", "3"]
    assert page.write_button.isEnabled()
    page.list.item(2).setCheckState(Qt.CheckState.Checked)
    assert not page.write_button.isEnabled()
    assert "Two devices" in page.said.text()
    page.list.item(2).setCheckState(Qt.CheckState.Unchecked)
    with qtbot.waitSignal(bare.session.closed, timeout=WAIT_MS):
        page.write(tmp_path / "mine" / "bench.toml")
    assert bare.next_bench is not None
    assert sorted(bare.next_bench.devices) == ["camera", "stage"]
    assert bare.next_bench.bench.name == "mine"


@pytest.mark.parametrize("name", TEMPLATES)
def test_a_simulated_bench_serves_its_panels(qtbot: QtBot, name: str) -> None:
    session = BenchSession(parse_config(template(name), None))
    unserved = {
        key for key, entry in PANELS.items() if why_not(session, entry.title, entry.needs, entry.tried_on)
    }
    assert (
        unserved
        == {
            "default": {"alignment"},
            "display": set(),
            "led_microscope": {"alignment", "stage", "slm"},
            "screen": {"alignment"},
        }[name]
    )
    with qtbot.waitSignal(session.closed, timeout=WAIT_MS):
        session.close()
