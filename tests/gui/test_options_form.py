"""The one form: all that a field says and does comes from the declaration."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import pytest
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QCheckBox, QComboBox, QLabel, QScrollArea
from pytestqt.qtbot import QtBot

from gui.forms.fields import AUTOMATIC, Behaviour
from gui.forms.options_form import OptionsForm
from instrument.files.errors import BenchError
from instrument.plan.illumination import IlluminationOptions
from recon.base.declare import option, options_of
from recon.errors import InputError

WORDS = ["plain", "fine"]


@dataclass(frozen=True, kw_only=True)
class Wanted:
    far_um: float | None = option(
        None, help="How far.", unit="um", shown_unit="mm", shown_factor=1e3, above=0, default_words="anywhere"
    )
    count: int = option(2, help="How many.", least=1, most=9, label="Number")
    how: str = option("plain", help="In what manner.", choices=lambda: WORDS, group="Manner")
    which: Literal["left", "right"] | None = option(None, help="Which side.", group="Manner")
    both: bool | None = option(None, help="Both?", default_words="as it comes", group="Manner")
    at_once: bool = option(False, help="Without waiting.", group="Manner", applies=("volume",))
    file: Path | None = option(None, help="A table.", metavar="FILE", group="Manner")
    place: tuple[int, int] = option((1, 2), help="Where.", metavar="Y,X", group="Manner")
    slack: float = option(0.0, help="0: none.", least=0, group="Rarely needed")
    secret: int = option(3, help="Not for people.", flags=("",))

    def __post_init__(self) -> None:
        if self.count > 5 and self.how == "fine":
            raise InputError("So many cannot be fine.")


@pytest.fixture
def form(qtbot: QtBot) -> OptionsForm:
    def only_plain(present: dict[str, Any]) -> str:
        return "" if present["how"] == "plain" else "Fine ones have no slack."

    form = OptionsForm([Wanted], {"slack": Behaviour(enabled_when=only_plain)})
    scroll = QScrollArea()
    scroll.setWidget(form)
    scroll.setWidgetResizable(True)
    qtbot.addWidget(scroll)
    scroll.resize(300, 400)
    scroll.show()
    form.kept = scroll
    return form


def type_in(qtbot: QtBot, form: OptionsForm, name: str, text: str) -> None:
    field: Any = form.widgets[name]
    field.setFocus()
    field.selectAll()
    qtbot.keyClicks(field, text)
    qtbot.keyClick(field, Qt.Key.Key_Return)


def test_every_word_is_the_declarations(form: OptionsForm) -> None:
    labels = [label.text() for label in form.findChildren(QLabel)]
    assert "secret" not in form.widgets
    for o in options_of(Wanted):
        if o.name in form.widgets:
            assert (
                o.declaration.help in form.widgets[o.name].toolTip() or not form.widgets[o.name].isEnabled()
            )
    assert {"Far", "Number", "How", "Manner", "Slack"} <= set(labels)
    far: Any = form.widgets["far_um"]
    assert far.placeholderText() == "anywhere (mm)"
    assert "Above 0 mm" in far.toolTip()
    assert "1 or more, 9 or less" in form.widgets["count"].toolTip()
    which: Any = form.widgets["which"]
    assert [which.itemText(i) for i in range(which.count())] == [AUTOMATIC, "left", "right"]
    assert isinstance(form.widgets["both"], QComboBox)
    assert isinstance(form.widgets["at_once"], QCheckBox)
    assert form.make(Wanted) == Wanted()


def test_a_choice_that_is_registered_later_is_in_the_next_form(
    qtbot: QtBot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "WORDS", [*WORDS, "my-own"])
    form = OptionsForm([Wanted])
    qtbot.addWidget(form)
    form.set_values({"how": "my-own"})
    assert form.make(Wanted).how == "my-own"


def test_values_have_the_options_own_units(qtbot: QtBot, form: OptionsForm) -> None:
    heard: list[bool] = []
    form.changed.connect(lambda: heard.append(True))
    type_in(qtbot, form, "far_um", "2.5 cm")
    type_in(qtbot, form, "place", "7,8")
    assert heard
    form.set_values({"which": "left", "both": False, "file": Path("a.csv")})
    made = form.make(Wanted)
    assert (made.far_um, made.place, made.which, made.both) == (25e3, (7, 8), "left", False)
    assert made.file == Path("a.csv")


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("far_um", "0", "Far must be a number, above 0 (mm), not 0."),
        ("far_um", "wide", "no number of mm"),
        ("count", "10", "Number must be a whole number, 1 or more, 9 or less, not 10."),
        ("count", "2.5", "whole number"),
        ("place", "1", "Place must be Y,X"),
        ("place", "1,b", "whole number"),
    ],
)
def test_what_is_wrong_is_told_where_it_stands(
    qtbot: QtBot, form: OptionsForm, name: str, text: str, reason: str
) -> None:
    told: list[str] = []
    form.refused.connect(lambda _, why: told.append(why))
    type_in(qtbot, form, name, text)
    assert reason in form.reason(name)
    assert told
    assert form.widgets[name].property("refused")
    assert not form.check()
    assert form.values() is None
    with pytest.raises(BenchError, match=re.escape(reason)):
        form.make(Wanted)
    type_in(qtbot, form, name, "3,3" if name == "place" else "3")
    assert not form.reason(name)
    assert form.check()


def test_what_is_rare_is_folded_away_and_zero_is_no_mistake(qtbot: QtBot, form: OptionsForm) -> None:
    slack: Any = form.widgets["slack"]
    assert not slack.isVisible()
    form.more.setFocus()
    qtbot.keyClick(form.more, Qt.Key.Key_Space)
    assert slack.isVisible()
    type_in(qtbot, form, "slack", "0")
    assert form.check()
    type_in(qtbot, form, "slack", "-1")
    form.more.setChecked(False)
    assert not form.check()
    assert slack.isVisible()  # where it was refused


def test_what_does_not_go_with_the_others_is_disabled_with_the_reason(form: OptionsForm) -> None:
    form.set_values({"slack": 0.5})
    assert form.make(Wanted).slack == 0.5
    form.set_values({"how": "fine"})
    assert not form.widgets["slack"].isEnabled()
    assert form.widgets["slack"].toolTip() == "Fine ones have no slack."
    assert form.make(Wanted).slack == 0.0
    form.set_values({"how": "plain"})
    assert form.make(Wanted).slack == 0.5
    form.set_values({"how": "fine", "count": 6})
    with pytest.raises(BenchError, match="So many"):
        form.make(Wanted)


def test_only_what_applies_is_shown(form: OptionsForm) -> None:
    form.set_values({"at_once": True})
    form.show_for("picture")
    assert not form.widgets["at_once"].isVisible()
    assert form.make(Wanted).at_once is False
    form.show_for("picture", "volume")
    assert form.widgets["at_once"].isVisible()
    assert form.make(Wanted).at_once is True


def test_a_form_is_made_a_field_at_a_time(qtbot: QtBot) -> None:
    form = OptionsForm([Wanted], whole=False)
    qtbot.addWidget(form)
    made = [len(form.fields) for _ in form.parts()]
    assert made[0] == 1
    assert len(made) >= 2 * len(form.fields), "each field, then each row"
    assert form.values() == OptionsForm([Wanted]).values()


@pytest.mark.parametrize(
    ("said", "shown"),
    [
        ("--count 7: take --far-mm.", "“Number” 7: take “Far”."),
        (
            "Leave --no-both out, or give --slm-calibration FILE.",
            "Leave “Both” off out, or give “slm calibration” FILE.",
        ),
        (
            "Run dask scheduler --host 127.0.0.1, then --count.",
            "Run dask scheduler --host 127.0.0.1, then “Number”.",
        ),
    ],
)
def test_messages_name_fields_and_no_flags(form: OptionsForm, said: str, shown: str) -> None:
    assert form.in_its_words(said) == shown


def test_a_reason_speaks_of_fields_not_of_the_terminals_options(qtbot: QtBot) -> None:
    form = OptionsForm([IlluminationOptions])
    qtbot.addWidget(form)
    form.refuse("groups", "Give the patterns as one of --groups, --lattice and --pattern")
    assert form.reason("groups") == "Give the patterns as one of “Groups”, “Lattice” and “Pattern”."
    assert "--" not in form.widgets["groups"].toolTip()
