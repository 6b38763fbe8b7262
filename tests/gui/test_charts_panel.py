"""Stability maps in the window: what is drawn is what the file says."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QApplication, QGraphicsSimpleTextItem
from pytestqt.qtbot import QtBot

from gui.panel import whole
from gui.panels.charts import ChartsPanel, _ticks, describe
from instrument.evaluation.chart import read_chart
from instrument.evaluation.figures import boundary_lines, map_figure
from instrument.files.errors import FileError
from instrument.files.figures import ACCENT
from instrument.files.images import read_image
from instrument.files.stability_file import read_stability
from recon.verdict.cases import SHIPPED

WAIT_MS = 60_000


@pytest.fixture
def panel(qtbot: QtBot, make_session) -> ChartsPanel:
    panel = whole(ChartsPanel(make_session()))
    panel.resize(900, 600)
    qtbot.addWidget(panel)
    panel.show()
    qtbot.waitUntil(lambda: panel.stability.record is not None, timeout=WAIT_MS)
    return panel


def made(tmp_path: Path) -> Path:
    """A file with one planted map: the first method fails from x = 100 on, the second never."""
    grid = [[0.1, 1.0, 10.0], [0.1, 1.0, None]]
    methods = {
        "admm tv": {
            "error": [[0.1, 0.5, 0.9], [0.2, 0.6, None]],
            "severity": grid,
            "failure": [[None, "spots", "trivial"], [None, "spots", None]],
            "boundary": [[100.0, 1.0], [100.0, 2.0]],
        },
        "fista": {
            "error": [[0.1] * 3] * 2, "severity": [[0.5] * 3] * 2,
            "failure": [[None] * 3] * 2, "boundary": [],
        },
    }  # fmt: skip
    record = {
        "format": "diffuserbench-stability", "version": 1, "program": "diffuserbench 1", "utc": "today",
        "machine": "m", "command": "planted",
        "maps": {"planted": {
            "title": "Planted", "question": "Where?", "size": "quick", "error": "NRMSE", "methods": methods,
            "x": {"key": "n", "label": "points", "unit": "", "values": [10, 100, 1000], "logarithmic": True},
            "y": {"key": "a", "label": "spread", "unit": "px", "values": [1, 2], "logarithmic": False},
        }},
    }  # fmt: skip
    path = tmp_path / "stability.json"
    path.write_text(json.dumps(record))
    return path


def test_every_shipped_map_and_method_is_drawn(panel: ChartsPanel) -> None:
    view = panel.stability
    maps = read_stability(SHIPPED)["maps"]
    assert [view.map.itemData(i) for i in range(view.map.count())] == list(maps)
    for index, record in enumerate(maps.values()):
        view.map.setCurrentIndex(index)
        for number in range(len(record["methods"])):
            view.method.setCurrentIndex(number)
            assert view.image.image.shape[:2] == np.shape(
                list(record["methods"].values())[number]["severity"]
            )
        assert view.describe(0, 0).startswith(record["x"]["label"])


def test_boundaries_colours_and_words_are_those_of_the_file(
    qtbot: QtBot, panel: ChartsPanel, tmp_path: Path
) -> None:
    panel.open(made(tmp_path))
    view = panel.stability
    qtbot.waitUntil(lambda: view.map.currentText() == "Planted", timeout=WAIT_MS)
    (line,) = view.boundaries["admm tv"]
    np.testing.assert_allclose(sorted(line.tolist()), [[1, 0], [1, 1]], atol=1e-9)
    assert not view.boundaries["fista"]
    assert "none" in view.legend.text()
    works, fails = view.image.image[0, 0].astype(int), view.image.image[0, 2].astype(int)
    assert works[1] > works[0] + 30
    assert fails[0] > fails[1] + 30
    said = view.describe(1, 0)
    assert "points 100, spread 1 px" in said
    assert "admm tv: fails (points lost or made up), NRMSE 0.5, severity 1.00" in said
    assert "fista: works" in said
    assert "not made" in view.describe(2, 1)
    assert view.describe(3, 0) == ""
    view.method.setCurrentText("fista")
    assert len(np.unique(view.image.image.reshape(-1, 3), axis=0)) == 1


def test_the_printed_map_draws_the_boundaries_of_the_window(panel: ChartsPanel) -> None:
    view, maps = panel.stability, read_stability(SHIPPED)["maps"]
    for index, record in enumerate(maps.values()):
        view.map.setCurrentIndex(index)
        printed = map_figure(record)
        for axes, (name, lines) in zip(printed.axes, view.boundaries.items(), strict=False):
            drawn = [line.get_xydata() for line in axes.get_lines() if line.get_color() == ACCENT]
            assert len(drawn) == len(lines), name
            assert all(np.array_equal(one, other) for one, other in zip(drawn, lines, strict=True))


def test_a_boundary_goes_round_what_is_not_known_and_through_a_map_of_one_row() -> None:
    (line,) = boundary_lines(np.array([[0.1, 10.0]]))
    np.testing.assert_allclose(sorted(line.tolist()), [[0.5, -0.5], [0.5, 0.5]])
    severity = np.array([[0.1, 10.0, 10.0], [0.1, 10.0, np.nan], [np.nan, 10.0, 10.0]])
    (line,) = boundary_lines(severity)
    np.testing.assert_allclose(line[:, 0], 0.5)
    np.testing.assert_allclose([line[:, 1].min(), line[:, 1].max()], [0.0, 1.5])
    assert boundary_lines(np.full((3, 3), 0.5)) == []


def test_figures_stand_on_their_cells_colour_above_the_boundaries(
    qtbot: QtBot, panel: ChartsPanel, tmp_path: Path
) -> None:
    panel.open(made(tmp_path))
    view = panel.stability
    qtbot.waitUntil(lambda: view.map.currentText() == "Planted", timeout=WAIT_MS)
    texts = [i for i in view.plot.scene().items() if isinstance(i, QGraphicsSimpleTextItem)]
    assert len(texts) == 5
    for text in texts:
        patch = text.parentItem()
        cell = view.image.image[round(patch.pos().y()), round(patch.pos().x())]
        assert patch.brush().color().getRgb()[:3] == tuple(cell)
        assert patch.rect().contains(text.boundingRect())
        assert patch.parentItem().zValue() > 0, "lines and ends are at 0"


def test_cells_by_arrow_keys(qtbot: QtBot, panel: ChartsPanel) -> None:
    view = panel.stability
    view.plot.setFocus()
    assert view.cell == (0, 0)
    assert view.place.text() == view.describe(0, 0)
    qtbot.keyClick(view.plot, Qt.Key.Key_Right)
    qtbot.keyClick(view.plot, Qt.Key.Key_Up)
    qtbot.keyClick(view.plot, Qt.Key.Key_Up)
    assert view.cell == (1, 2)
    assert view.place.text() == view.describe(1, 2)
    for _ in range(30):
        qtbot.keyClick(view.plot, Qt.Key.Key_Left)
    assert view.cell == (0, 2)


def test_copied_lines_draw_the_map_and_a_wrong_file_is_told(
    qtbot: QtBot, panel: ChartsPanel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel.open(made(tmp_path))
    qtbot.waitUntil(lambda: panel.stability.map.currentText() == "Planted", timeout=WAIT_MS)
    qtbot.mouseClick(panel.copy_button, Qt.MouseButton.LeftButton)
    monkeypatch.chdir(tmp_path)
    exec(QApplication.clipboard().text(), {})
    assert read_image(tmp_path / "planted.png").is_colour
    (tmp_path / "other.json").write_text("{}")
    panel.open(tmp_path / "other.json")
    qtbot.waitUntil(lambda: "neither stability maps nor a chart" in panel._note.toolTip(), timeout=WAIT_MS)


POINTS = [
    # setting, iterations, seconds, PSNR: the third is beaten by the second.
    ("wiener", 0, 0.01, 12.0),
    ("admm tv", 10, 0.1, 20.0),
    ("fista tv", 10, 0.2, 18.0),
    ("admm tv", 40, 0.4, 26.0),
    ("fista tv", 40, 0.8, 25.0),
]


def chart(tmp_path: Path) -> Path:
    points = [
        {"setting": s, "iterations": n, "seconds": t, "psnr_db": p, "ssim": None, "held_out": 30 - p,
         "peak_mib": 9.0}
        for s, n, t, p in POINTS
    ]  # fmt: skip
    record = {
        "schema": 2,
        "kind": "reconstruction",
        "about": {"scene": "beads", "simulated": True},
        "points": points,
        "pareto": [],
        "failed": {"local tv": "one PSF only"},
        "missing": ["volume l1"],
    }
    path = tmp_path / "chart.json"
    path.write_text(json.dumps(record))
    return path


def test_a_chart_shows_the_front_and_ranks_the_settings(
    qtbot: QtBot, panel: ChartsPanel, tmp_path: Path
) -> None:
    panel.take(chart(tmp_path))  # as the panel of tasks hands it on
    view = panel.chart
    qtbot.waitUntil(lambda: bool(view.front), timeout=WAIT_MS)
    assert panel.tabs.currentWidget() is view
    assert [(p.setting, p.iterations) for p in view.front] == [
        ("wiener", 0), ("admm tv", 10), ("admm tv", 40),
    ]  # fmt: skip
    rows = [[view.table.item(r, c).text() for c in range(3)] for r in range(view.table.rowCount())]
    assert rows == [
        ["● admm tv", "26.00", "0.400"],
        ["fista tv", "25.00", "0.800"],
        ["● wiener", "12.00", "0.0100"],
    ]
    assert "SIMULATED" in panel.heading.text()
    assert "local tv: one PSF only" in panel.heading.toolTip()
    assert "admm l1: no time" in panel.heading.toolTip()
    # Less is better for errors, and scores that nobody knows are not on offer.
    assert [view.measure.itemData(i) for i in range(view.measure.count())] == ["psnr_db", "held_out"]
    view.measure.setCurrentIndex(1)
    assert [p.seconds for p in view.front] == [0.01, 0.1, 0.4]
    view.table.selectRow(1)
    assert describe(view.front[1]) == (
        "admm tv, 0.1 s, 10 iterations, PSNR (dB) 20, error on held-out pixels (noise = 1) 10, memory 9 MiB"
    )
    qtbot.mouseClick(panel.copy_button, Qt.MouseButton.LeftButton)
    names: dict = {}
    exec(QApplication.clipboard().text(), names)
    assert names["ranked"][0].psnr_db == 26.0


def test_a_chart_of_calibrations_is_drawn_against_photographs_scene_by_scene(
    qtbot: QtBot, panel: ChartsPanel, tmp_path: Path
) -> None:
    rows = [
        ("one PSF", 1, "flat picture", 18.0), ("3 x 3", 9, "flat picture", 22.0),
        ("5 x 5", 25, "flat picture", 21.0), ("one PSF", 1, "beads", 20.0), ("axial", 5, "beads", 27.0),
    ]  # fmt: skip
    points = [
        {"setting": s, "iterations": 40, "seconds": 0.5, "psnr_db": p, "images": n, "group": g, "family": s}
        for s, n, g, p in rows
    ]
    record = {
        "schema": 2, "kind": "calibration", "about": {"simulated": True}, "points": points,
        "pareto": [], "failed": {}, "missing": [],
    }  # fmt: skip
    path = tmp_path / "chart.json"
    path.write_text(json.dumps(record))
    panel.open(path)
    view = panel.chart
    qtbot.waitUntil(lambda: bool(view.front), timeout=WAIT_MS)
    assert panel.heading.text() == "the simulated microscope (SIMULATED)"
    assert view.cost_key == "images"
    assert [p.setting for p in view.front] == ["one PSF", "3 x 3"]
    assert view.table.rowCount() == 3
    view.group.setCurrentText("beads")
    assert [p.setting for p in view.front] == ["one PSF", "axial"]
    assert view.table.rowCount() == 2
    view.table.selectRow(0)
    assert view.place.text() == (
        "axial, 0.5 s, 40 iterations, 5 photographs, PSNR of the reconstruction (dB) 27"
    )
    view.cost.setCurrentIndex(view.cost.findData("seconds"))
    assert [p.setting for p in view.front] == ["axial"]


def test_a_chart_of_another_version_is_refused(qtbot: QtBot, panel: ChartsPanel, tmp_path: Path) -> None:
    path = chart(tmp_path)
    path.write_text(path.read_text().replace('"schema": 2', '"schema": 7'))
    with pytest.raises(FileError, match="version 7"):
        read_chart(path)
    path.write_text("no JSON")
    panel.open(path)
    qtbot.waitUntil(lambda: "is no valid JSON" in panel._note.toolTip(), timeout=WAIT_MS)


@pytest.mark.parametrize(
    ("costs", "words"),
    [
        ([0.15, 2.4], ["0.1", "0.2", "0.5", "1", "2", "5", "10", "20", "50"]),
        ([0.902, 0.916], ["0.905", "0.91", "0.915"]),
        ([0.55, 1.1], ["0.6", "0.8", "1"]),
        ([0.523], ["0.523"]),
    ],
)
def test_the_axis_of_costs_has_figures_however_close_they_lie(costs: list[float], words: list[str]) -> None:
    ticks = _ticks(costs)
    assert [word for _, word in ticks] == words
    assert all(abs(10**place - float(word)) < 1e-9 for place, word in ticks)
