"""From a photograph to its picture: the newest calibration is offered, and its depths are asked for."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QFileDialog
from pytestqt.qtbot import QtBot

from gui.panels.reconstructions import ReconstructionsPanel
from gui.widgets.entry import PathEntry
from instrument.files.calibration_file import (
    CalibrationFileError,
    calibrated_depths_um,
    newest_calibration,
    save_calibration,
)
from recon.types import Calibration

WAIT_MS = 60_000
SIZE = 32


def _calibration(folder: Path, depths_um: tuple[float, ...]) -> Path:
    rng = np.random.default_rng(0)
    psfs = np.zeros((len(depths_um), 1, SIZE, SIZE), np.float32)
    for psf in psfs:
        psf[0, rng.integers(8, 24, 9), rng.integers(8, 24, 9)] = 100
    places = np.array([(0.0, 0.0, z) for z in depths_um])
    return save_calibration(Calibration(psfs, places), folder)


@pytest.fixture
def photograph(tmp_path: Path) -> Path:
    file = tmp_path / "photo.tif"
    tifffile.imwrite(file, np.random.default_rng(1).integers(100, 200, (SIZE, SIZE)).astype(np.uint16))
    return file


def test_the_depth_is_asked_for_at_its_field_and_one_is_chosen_by_keys(
    qtbot: QtBot, panel: ReconstructionsPanel, photograph: Path
) -> None:
    runs = panel.session.runs_folder
    calibration = _calibration(runs / "a-sweep" / "calibration", (80e3, 22e3, 38.9381e3))
    panel.take(photograph)
    form = panel.form
    z_mm = form.widgets["z_um"]
    qtbot.waitUntil(lambda: "which one" in z_mm.placeholderText(), timeout=WAIT_MS)
    assert form.text("calibration") == str(calibration)
    qtbot.mouseClick(form.start, Qt.MouseButton.LeftButton)
    assert panel.job is None
    assert z_mm.property("refused")
    assert "22, 38.938, 80 mm" in z_mm.toolTip()
    assert "z_um" not in z_mm.toolTip()
    completer = z_mm.completer()
    z_mm.setFocus()
    completer.complete()
    popup = completer.popup()
    qtbot.keyClick(popup, Qt.Key.Key_Down)
    qtbot.keyClick(popup, Qt.Key.Key_Down)
    qtbot.keyClick(popup, Qt.Key.Key_Return)
    assert z_mm.text() == "38.938"
    z_mm.submit()
    assert not z_mm.property("refused")
    assert form.request().options.z_um == pytest.approx(38938)


def test_with_one_depth_nothing_is_asked_and_a_calibration_that_was_named_stays(
    qtbot: QtBot, panel: ReconstructionsPanel, photograph: Path, tmp_path: Path
) -> None:
    _calibration(panel.session.runs_folder / "other" / "calibration", (22e3, 80e3))
    mine = _calibration(tmp_path / "mine", (50e3,))
    panel.take(mine)
    panel.take(photograph)
    qtbot.waitUntil(lambda: not panel.jobs.jobs, timeout=WAIT_MS)
    assert panel.form.text("calibration") == str(mine)
    assert panel.form.request().options.z_um is None
    panel.form.options.set_values(
        {"calibration": Path("/nowhere")}
    )  # no calibration: no depths, and no mistake of their own
    qtbot.waitUntil(lambda: not panel.jobs.jobs, timeout=WAIT_MS)
    assert "which one" not in panel.form.widgets["z_um"].placeholderText()


def test_the_depths_are_those_of_the_calibration_that_was_chosen_in_the_dialogue(
    qtbot: QtBot, panel: ReconstructionsPanel, photograph: Path, tmp_path: Path
) -> None:
    form, z_mm = panel.form, panel.form.widgets["z_um"]
    panel.take(photograph)
    panel.take(_calibration(tmp_path / "several", (22e3, 80e3)))
    qtbot.waitUntil(lambda: "which one" in z_mm.placeholderText(), timeout=WAIT_MS)
    one = _calibration(tmp_path / "one", (50e3,))
    row = form.widgets["calibration"].parent()
    assert isinstance(row, PathEntry)
    qtbot.mouseClick(row.button, Qt.MouseButton.LeftButton)
    (dialogue,) = row.findChildren(QFileDialog)
    dialogue.fileSelected.emit(str(one))
    dialogue.close()
    qtbot.waitUntil(lambda: "which one" not in z_mm.placeholderText(), timeout=WAIT_MS)
    assert form.request().options.z_um is None


def test_depths_of_a_calibration(tmp_path: Path) -> None:
    assert newest_calibration(tmp_path) is None
    path = _calibration(tmp_path / "run" / "calibration", (3e4, 1e4))
    assert calibrated_depths_um(path) == (1e4, 3e4)
    assert newest_calibration(tmp_path) == path
    unknown = save_calibration(
        Calibration(np.ones((1, 1, 8, 8), np.float32), np.full((1, 3), np.nan)), tmp_path / "unknown"
    )
    assert calibrated_depths_um(unknown) == ()
    record = json.loads((path / "calibration.json").read_text()) | {"source_positions_um": 3}
    (path / "calibration.json").write_text(json.dumps(record))
    with pytest.raises(CalibrationFileError, match="damaged calibration"):
        calibrated_depths_um(path)
