"""Pictures turned and mirrored: what is seen where, clicks and keys on it, kept with the bench."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from PySide6.QtCore import QPoint, Qt
from pytestqt.qtbot import QtBot

from gui.panel import whole
from gui.session import BenchSession
from gui.widgets.image_view import ImageView
from gui.widgets.live_picture import LivePicture
from gui.widgets.orientation import read_turned
from instrument.files.orientation import Orientation

ALL = [Orientation(quarters, mirrored) for quarters in range(4) for mirrored in (False, True)]


def test_steps_and_further_turns_agree_with_the_pixels() -> None:
    picture = np.arange(12).reshape(3, 4)
    for orientation in ALL:
        seen = orientation.apply(picture)
        np.testing.assert_array_equal(orientation.turned(1).apply(picture), np.rot90(seen))
        np.testing.assert_array_equal(orientation.flipped(upright=False).apply(picture), seen[:, ::-1])
        np.testing.assert_array_equal(orientation.flipped(upright=True).apply(picture), seen[::-1])
        row, column = np.argwhere(seen == picture[1, 1])[0]
        for across, down in ((1, 0), (0, 1)):
            x, y = (int(part) for part in orientation.step_of(across, down))
            if 0 <= row + down < seen.shape[0] and 0 <= column + across < seen.shape[1]:
                assert seen[row + down, column + across] == picture[1 + y, 1 + x]


@pytest.mark.parametrize("orientation", ALL)
def test_the_preview_of_a_result_is_turned_and_other_pictures_are_not(
    tmp_path: Path, orientation: Orientation
) -> None:
    path = tmp_path / "picture.png"
    pixels = np.arange(12, dtype=np.uint8).reshape(3, 4) * 20
    cv2.imwrite(str(path), pixels)

    def seen() -> np.ndarray:
        image = read_turned(path, orientation)
        return np.array(
            [[image.pixelColor(x, y).red() for x in range(image.width())] for y in range(image.height())]
        )

    np.testing.assert_array_equal(seen(), pixels)
    path.with_suffix(".json").write_text('{"preview": {}}')
    np.testing.assert_array_equal(seen(), orientation.apply(pixels))


def test_what_makes_no_sense_in_the_file_turns_nothing() -> None:
    for kept in (None, 3, [], {"quarters": "x"}, {"mirrored": 1}):
        assert Orientation.of(kept) == Orientation()


@pytest.mark.parametrize("orientation", ALL)
def test_a_click_means_the_pixel_that_is_seen_there(qtbot: QtBot, orientation: Orientation) -> None:
    view = ImageView("grey")
    qtbot.addWidget(view)
    view.resize(300, 200)
    view.show()
    picture = np.zeros((40, 60), np.uint8)
    picture[5:10, 10:20] = 255  # near the upper left
    view.show_image(picture, 0, 255)
    view.orient(orientation)
    qtbot.wait(20)
    shown = view.graphics.grab().toImage()
    bright = [
        (x, y)
        for x, y in itertools.product(range(0, shown.width(), 2), range(0, shown.height(), 2))
        if shown.pixelColor(x, y).red() > 200
    ]
    middle = QPoint(*(round(sum(c) / len(bright)) for c in zip(*bright, strict=True)))
    rows, columns = np.nonzero(orientation.apply(picture))
    height, width = orientation.apply(picture).shape
    assert (middle.x() < shown.width() / 2) == (columns.mean() < width / 2)
    assert (middle.y() < shown.height() / 2) == (rows.mean() < height / 2)
    with qtbot.waitSignal(view.clicked) as clicked:
        qtbot.mouseClick(view.graphics.viewport(), Qt.MouseButton.LeftButton, pos=middle)
    assert clicked.args is not None
    column, row = clicked.args
    assert 13 <= column <= 16
    assert 6 <= row <= 8
    moved: list[tuple[float, float]] = []
    view.keys.moved.connect(lambda *step: moved.append(step))
    qtbot.keyClick(view.graphics, Qt.Key.Key_Right)
    assert moved == [orientation.step_of(1, 0)]


def test_it_is_kept_with_the_bench_and_all_views_follow(qtbot: QtBot, session: BenchSession) -> None:
    pictures = [whole(LivePicture(session)), whole(LivePicture(session))]
    for picture in pictures:
        qtbot.addWidget(picture)
    pictures[0].turn_button.menu().actions()[1].trigger()
    assert [p.view.graphics.orientation for p in pictures] == 2 * [Orientation(3)]
    assert "turned 270" in pictures[1].turn_button.toolTip()
    qtbot.waitUntil(lambda: session.kept.path.is_file())
    assert '"quarters": 3' in session.kept.path.read_text()
    pictures[1].turn_button.menu().actions()[-1].trigger()
    assert pictures[0].view.graphics.orientation == Orientation()
