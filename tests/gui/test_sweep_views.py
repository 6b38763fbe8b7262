"""The pictures of a sweep's PSFs do not fill the memory."""

from __future__ import annotations

import numpy as np
import pytest
from PySide6.QtGui import QColor, QPixmap
from pytestqt.qtbot import QtBot

from gui.theme import RED
from gui.widgets.image_view import usual_levels
from gui.widgets.picture import Picture
from gui.widgets.sweep_views import PathPlot, PsfPictures, PsfTable, small


def test_a_long_sweep_stays_small_and_every_psf_can_be_looked_at() -> None:
    pictures = PsfPictures()
    rng = np.random.default_rng(0)
    image = rng.random((600, 800), dtype=np.float32)
    for number in range(200):
        pictures.keep(number, image.copy())
    kept = [picture.image.nbytes for picture in map(pictures.get, range(200)) if picture is not None]
    assert len(kept) == 200
    assert sum(kept) < 0.2 * 200 * image.nbytes
    newest, oldest = pictures.get(199), pictures.get(0)
    assert newest is not None
    assert oldest is not None
    assert newest.reduced == 1
    np.testing.assert_array_equal(newest.image, image)
    assert (oldest.reduced, oldest.image.shape, oldest.image.dtype) == (4, (150, 200), np.uint8)
    assert pictures.get(200) is None


def test_between_two_psfs_stands_no_number(qtbot: QtBot) -> None:
    psfs = PsfTable()
    qtbot.addWidget(psfs)
    axis = psfs.plot.getAxis("bottom")
    for most in (1.4, 5.2, 300.0):
        places = [place for _, level in axis.tickValues(0.6, most, 300) for place in level]
        assert places
        assert all(place % 1 == 0 for place in places)


def test_one_that_is_taken_again_takes_the_place_of_the_old_one() -> None:
    pictures = PsfPictures()
    for number in range(40):
        pictures.keep(number, np.full((4, 4), float(number)))
    pictures.keep(0, np.full((4, 4), 99.0))
    again = pictures.get(0)
    assert again is not None
    assert again.reduced == 1
    assert again.image[0, 0] == 99
    assert all(pictures.get(number) is not None for number in range(40))


def test_a_small_picture_shows_the_same_spot() -> None:
    image = np.zeros((1024, 512), np.float32)
    image[400:408, 100:108] = 5000
    found = small(image)
    assert found.image.shape == (256, 128)
    assert np.unravel_index(found.image.argmax(), found.image.shape) == (100, 25)
    assert found.image[100, 25] == 255
    assert small(np.ones((1, 3000), np.float32)).image.shape == (1, 250)


def test_a_psf_is_shown_by_its_own_values_and_counts_by_no_less_than_one() -> None:
    psf = np.random.default_rng(0).random((40, 60), np.float32)
    low, high = usual_levels(psf / psf.sum())
    assert 0 <= low < high <= psf.max() / psf.sum(), "not black: its sum is 1"
    assert usual_levels(np.full((8, 8), 3, np.uint16)) == (3, 4)
    assert usual_levels(np.zeros((8, 8), np.float32)) == (0, 1)


def test_a_page_is_red_and_darker_than_stop_in_the_dark_room(
    qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = QPixmap(60, 40)
    page.fill(QColor("white"))
    picture = Picture()
    qtbot.addWidget(picture)
    picture.resize(160, 120)
    picture.show_pixmap(page)
    assert picture.grab().toImage().pixelColor(80, 60) == QColor("white")
    monkeypatch.setattr("gui.widgets.picture.colours", lambda: RED)
    seen = picture.grab().toImage().pixelColor(80, 60)
    assert (seen.green(), seen.blue()) == (0, 0)
    assert 100 < seen.red() < QColor(RED.error).red()


def test_a_plan_that_moves_nothing_is_not_said_to_be_impossible(qtbot: QtBot) -> None:
    path = PathPlot()
    qtbot.addWidget(path)
    list(path.parts())
    path.clear("No path: this cannot be carried out as it stands.")
    path.show_path(())  # of what is typed then
    assert path.nothing.text() == "Nothing moves."
