"""Plots: the numbers of their axes."""

from __future__ import annotations

import pytest
from PySide6.QtGui import QPainter, QPixmap
from pytestqt.qtbot import QtBot

from gui.widgets.plots import plot_widget


@pytest.mark.parametrize(
    "span", [(24.295, 24.312), (0.0004, 0.0031), (0.0, 1.0), (31.98, 32.02), (-0.4, 0.4)]
)
def test_all_numbers_of_an_axis_have_the_same_digits(qtbot: QtBot, span: tuple[float, float]) -> None:
    plot = plot_widget("x", "y")
    qtbot.addWidget(plot)
    plot.resize(400, 220)
    plot.plot([0, 1], span)
    plot.grab()  # it is laid out
    axis, picture = plot.getAxis("left"), QPixmap(10, 10)
    painter = QPainter(picture)
    texts = [text for _, _, text in axis.generateDrawSpecs(painter)[2]]
    painter.end()
    assert len(texts) > 2
    assert len({len(text.partition(".")[2]) for text in texts}) == 1, texts
    assert len(set(texts)) == len(texts)
    assert not any("-" in text for text in texts), "a minus is as long as everywhere else"


def test_a_logarithmic_axis_says_numbers_and_not_their_logarithms(qtbot: QtBot) -> None:
    plot = plot_widget("x", "y")
    qtbot.addWidget(plot)
    plot.resize(400, 220)
    plot.setLogMode(y=True)
    plot.plot([0, 1], [0.08, 1.1])
    plot.grab()
    axis, picture = plot.getAxis("left"), QPixmap(10, 10)
    painter = QPainter(picture)
    texts = [text for _, _, text in axis.generateDrawSpecs(painter)[2]]
    painter.end()
    assert {"0.1", "1"} <= set(texts), texts
