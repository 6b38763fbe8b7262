"""Numbers typed with units: the field's own, another of its kind, none of its kind."""

from __future__ import annotations

import pytest
from PySide6.QtCore import QEvent, Qt
from PySide6.QtGui import QFocusEvent
from pytestqt.qtbot import QtBot

from gui.widgets.entry import Entry, NumberEdit, existing_path
from gui.words import grouped, quantity


def _field(qtbot: QtBot, unit: str = "ms", value: float | None = 10.0, **limits: float) -> NumberEdit:
    field = NumberEdit(unit, value, tip="What it is", **limits)  # type: ignore[arg-type]
    qtbot.addWidget(field)
    field.show()
    return field


def _type(qtbot: QtBot, field: NumberEdit, text: str) -> None:
    field.selectAll()
    qtbot.keyClicks(field, text)
    qtbot.keyClick(field, Qt.Key.Key_Return)


@pytest.mark.parametrize(
    ("unit", "typed", "value"),
    [
        ("ms", "2.5", 2.5),
        ("ms", "2,5 ms", 2.5),
        ("ms", "0.002 s", 2.0),
        ("ms", "300us", 0.3),
        ("µm", "250 mm", 250e3),
        ("µm", "7 um", 7.0),
        ("mm", "2 cm", 20.0),
        ("mm", "1e3 um", 1.0),
        ("mask px", "12 mask px", 12.0),
        ("×", "3×", 3.0),
        ("", "1e2", 100.0),
    ],
)
def test_a_number_may_carry_a_unit_of_the_same_kind(
    qtbot: QtBot, unit: str, typed: str, value: float
) -> None:
    field = _field(qtbot, unit)
    _type(qtbot, field, typed)
    assert not field.property("refused"), field.toolTip()
    assert field.value == value


@pytest.mark.parametrize("typed", ["3 mm", "three", "1e", "", "ms", "nan", "inf ms", "1 2"])
def test_what_is_no_number_of_the_unit_is_refused_with_the_reason(qtbot: QtBot, typed: str) -> None:
    field = _field(qtbot)
    field.selectAll()
    qtbot.keyClick(field, Qt.Key.Key_Delete)
    _type(qtbot, field, typed)
    assert field.property("refused")
    assert "number" in field.toolTip()
    assert field.value == 10.0
    assert not field.submit()


def test_a_refused_number_is_told_with_the_limits_and_the_one_in_force(qtbot: QtBot) -> None:
    field = _field(qtbot, minimum=0.05)
    _type(qtbot, field, "-3")
    assert field.toolTip() == "-3 ms is outside what is allowed: 0.05 ms or more. In force: 10 ms."
    _type(qtbot, field, "10")
    assert field.toolTip() == "What it is\n0.05 ms or more"


def test_the_tip_tells_the_unit_where_there_are_no_limits(qtbot: QtBot) -> None:
    assert _field(qtbot, "mm", None).toolTip() == "What it is\nin mm"


def test_thousands_are_kept_apart_and_read_again(qtbot: QtBot) -> None:
    assert [grouped(text) for text in ("9999", "12345.6", "-60000", "1e+06")] == [
        "9999",
        "12\u2009345.6",
        "-60\u2009000",
        "1e+06",
    ]
    field = NumberEdit("ms", 100000.0)
    qtbot.addWidget(field)
    assert field.text() == "100\u2009000 ms"
    assert field.typed() == (100000.0, "")


def test_lengths_from_a_millimetre_on_are_millimetres(qtbot: QtBot) -> None:
    pairs = ((999.4, "um"), (-1000, "µm"), (12345.678, "µm"), (3e5, "ms"), (0, "um"))
    assert [quantity(*pair) for pair in pairs] == ["999.4 µm", "-1 mm", "12.35 mm", "300\u2009000 ms", "0 µm"]
    long = NumberEdit("µm", minimum=-60000, maximum=60000, tip="To")
    near = NumberEdit("µm", 1100.0, minimum=0, maximum=5000)
    short, first, empty = NumberEdit("µm", 100.0), NumberEdit("µm"), NumberEdit("µm")
    for field in (long, near, short, first, empty):
        qtbot.addWidget(field)
    first.set_value(2500.0)
    for field, typed, value, text in (
        (long, "12.5", 12500.0, "12.5 mm"),
        (long, "40 um", 40.0, "0.04 mm"),
        (short, "2000", 2000.0, "2000 µm"),
        (first, "0.3", 300.0, "0.3 mm"),
        (near, "2", 2.0, "2 µm"),
        (empty, "3000", 3000.0, "3000 µm"),
        (empty, "3500", 3500.0, "3500 µm"),
    ):
        field.selectAll()
        qtbot.keyClicks(field, typed)
        assert field.submit()
        assert (field.value, field.text()) == (value, text)
    assert "-60 mm to 60 mm" in long.toolTip()
    first.set_value(80.0, overwrite=True)
    assert first.text() == "80 µm", "what is filled in anew chooses its unit anew"


def test_a_field_that_nobody_touched_is_not_refused_when_it_is_left(qtbot: QtBot) -> None:
    field = Entry(existing_path, "A file", "file")
    qtbot.addWidget(field)
    field.show()
    refused: list[str] = []
    field.refused.connect(refused.append)
    left = QFocusEvent(QEvent.Type.FocusOut)
    field.focusOutEvent(left)
    assert not refused
    qtbot.keyClicks(field, "x")
    qtbot.keyClick(field, Qt.Key.Key_Backspace)
    field.focusOutEvent(left)
    assert refused == ["A file or folder is needed here."]
    assert not field.check()  # whoever asks for it is told, touched or not
