"""A film in the window: played, pulled, its regions followed, written for others."""

from __future__ import annotations

import csv
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import zarr
from PIL import Image, ImageSequence
from PySide6.QtCore import QPointF
from pytestqt.qtbot import QtBot

from gui.panel import whole
from gui.panels.films import FilmsPanel
from gui.session import BenchSession
from instrument.cli import main
from instrument.files.orientation import Orientation
from instrument.reconstruction.film import slowed
from instrument.reconstruction.video_files import VideoPictures, create_output
from recon.camera.grid import Grid
from tests.gui.conftest import WAIT_MS

COUNT, LOST = 30, 7


@pytest.fixture
def film(tmp_path: Path) -> Path:
    """A spot that flashes over even ground; one picture was not made."""
    path = tmp_path / "film.ome.zarr"
    create_output(path, COUNT, (24, 32), period_s=0.05, grid=None, attributes={"simulated": True})
    pictures = VideoPictures(path, write=True)
    for index in range(COUNT):
        picture = np.full((24, 32), 0.5, np.float32)
        picture[8:12, 10:16] += 2.0 if 15 <= index < 20 else 1.0
        if index != LOST:
            pictures.write(index, picture)
    return path


def test_a_film_is_played_followed_and_written(
    qtbot: QtBot, make_session: Callable[[], BenchSession], film: Path, tmp_path: Path
) -> None:
    session = make_session()
    panel = whole(FilmsPanel(session))
    qtbot.addWidget(panel)
    panel.resize(900, 700)
    panel.show()
    with qtbot.waitSignal(panel.open(film).ended, timeout=WAIT_MS):
        pass
    assert "29 pictures, 20 a second   SIMULATED" in panel.heading.text()
    assert not panel.reconstruct_button.isEnabled()  # it is reconstructed
    session.keep("orientation", "results", {"quarters": 1})
    assert panel.view.graphics.orientation == Orientation(1)
    panel.slider.setValue(20)
    qtbot.waitUntil(lambda: panel.words.text() == "1.050 s, picture 21 of 29", timeout=WAIT_MS)
    panel.speed.setCurrentText("4 ×")
    panel.play_button.click()
    assert panel._step * 1000 / panel._timer.interval() == 80  # pictures a second
    qtbot.waitUntil(lambda: panel.slider.value() < 20, timeout=WAIT_MS)  # round at the end
    panel.play_button.click()
    assert not panel._timer.isActive()
    assert panel.plot.getViewBox().viewRange()[0] == pytest.approx([0, 1.45], abs=0.05)
    assert panel.plot.getPlotItem().titleLabel.text.startswith("Regions, dragged")
    panel.region_button.click()
    panel.measure._dragged(QPointF(10, 8), QPointF(15, 11))
    qtbot.waitUntil(lambda: panel.courses.size == 29, timeout=WAIT_MS)
    assert panel.courses[0, [0, 14, 19]] == pytest.approx([1.5, 2.5, 1.5])
    assert panel.plot.getPlotItem().titleLabel.isVisible() is False
    panel.quantity.setCurrentIndex(1)
    (item,) = panel.plot.listDataItems()
    assert item.getData()[1].max() == pytest.approx(1 / 1.5)
    for name in ("curves.csv", "film.gif", "film.mp4", "copy.ome.zarr"):
        job = panel.export_to(tmp_path / name)
        assert job is not None
        with qtbot.waitSignal(job.succeeded, timeout=WAIT_MS):
            pass
    rows = list(csv.DictReader((tmp_path / "curves.csv").read_text().splitlines()))
    assert [float(rows[14][name]) for name in ("frame", "time_s", "mean_8-12_10-16")] == [15, 0.75, 2.5]
    with Image.open(tmp_path / "film.gif") as gif:
        assert sum(frame.info["duration"] for frame in ImageSequence.Iterator(gif)) == 29 * 50
    assert int(cv2.VideoCapture(str(tmp_path / "film.mp4")).get(cv2.CAP_PROP_FRAME_COUNT)) == 29
    copy = VideoPictures(tmp_path / "copy.ome.zarr")
    assert copy.read(15)[9, 12] == 2.5  # at its own time
    assert len(copy) == COUNT
    assert not copy.is_written(LOST)
    exec(panel.as_python(), {})
    handed: list[object] = []
    session.handed_on.connect(lambda name, what: handed.append((name, what)))
    panel.activity_button.click()
    assert handed == [("tasks", ("activity", {"video": film}))]
    words = ["export", str(film), str(tmp_path / "again.csv"), "--region", "8,10,4,6"]
    assert main(words) == 0
    assert (tmp_path / "again.csv").read_text() == (tmp_path / "curves.csv").read_text()
    assert main(words) == 2  # it is there
    assert main([*words[:2], str(tmp_path / "x.csv"), "--region", "8,10,40,6"]) == 2
    with qtbot.waitSignal(panel.open(tmp_path).failed, timeout=WAIT_MS):
        pass
    assert panel.film is not None  # the one before stays
    held = threading.Event()
    first = session.jobs.compute("Exporting", lambda _: held.wait(WAIT_MS / 1000))
    second = session.jobs.compute("Reading curves", lambda _: None)
    panel._show_progress(first)
    panel._show_progress(second)
    with qtbot.waitSignal(second.ended, timeout=WAIT_MS):
        pass
    assert not panel.progress.isHidden(), "the other goes on"
    held.set()
    qtbot.waitUntil(panel.progress.isHidden, timeout=WAIT_MS)
    panel.shutdown()


def test_a_video_of_volumes_is_copied_with_its_planes_and_their_places(tmp_path: Path) -> None:
    grid = Grid((2, 4, 5), (2, 2), np.array([2e3, 3e3]), np.array([4.0, 6.0]))
    video, copy = tmp_path / "deep.ome.zarr", tmp_path / "copy.ome.zarr"
    assert "plays at 0.5 x" in slowed(tmp_path / "film.gif", 100.0)
    facts = {"calibrated_px": [0.0, 1.0, 3.0, 4.0], "model": "local"}
    create_output(video, 1, grid.shape, period_s=0.1, grid=grid, attributes=facts)
    volume = np.arange(40, dtype=np.float32).reshape(grid.shape)
    VideoPictures(video, write=True).write(0, volume)
    assert main(["export", str(video), str(copy)]) == 0
    made = VideoPictures(copy)
    np.testing.assert_array_equal(made.read(0), volume)
    assert made.attributes["diffuserbench"]["pitch_um"] == [4.0, 6.0]
    assert made.calibrated_px == (0.0, 1.0, 3.0, 4.0)  # activity asks for it
    assert made.attributes["diffuserbench"]["model"] == "local"
    for path in (video, copy):
        (level,) = zarr.open_group(path, mode="r").attrs["ome"]["multiscales"][0]["datasets"]
        scale, place = (level["coordinateTransformations"][i] for i in (0, 1))
        assert scale["scale"] == [0.1, 1e3, 6.0, 6.0]
        assert place["translation"] == [0.0, 2e3, -12.0, -12.0]
