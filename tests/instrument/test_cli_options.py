"""Commands from declared options: flags, help, mistakes, what was given."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
import typer

from instrument.cli.app import App
from instrument.cli.options import _missing
from instrument.files.errors import BenchError
from instrument.tasks.task import Given, Only
from recon.base.declare import RARE, identity, option, options_of, require, with_overrides
from recon.errors import InputError

KINDS = ["plain", "fancy"]


class Way(enum.StrEnum):
    """Ways."""

    LEFT = "left"
    RIGHT = "right"


def _pair(text: str) -> tuple[float, float]:
    y, x = (float(part) for part in text.split(","))
    return y, x


@dataclass(frozen=True, kw_only=True)
class Main:
    """Options of the tests."""

    rare: bool = option(True, help="Is rare.", group=RARE, applies=("film",))
    count: int = option(3, help="How many.", least=1, most=9, flags=("--count", "-n"), group="Main")
    kind: str = option(
        "plain", help="Which.", choices=lambda: KINDS, flags=("--kind", "--sort"), group="Main"
    )
    z_um: float | None = option(
        None, help="Where.", unit="um", shown_unit="mm", shown_factor=1e3, above=0, below=1e6, group="Main"
    )
    level: Literal["auto"] | float | Path = option("auto", help="Of dark.", group="Main")
    binning: int | None = option(None, help="Of pixels.", least=1, none_word="auto", group="Main")
    background: bool | None = option(None, help="As well.", default_words="as it comes", identifies=False)
    centre: tuple[float, float] = option((0.5, 0.5), help="Of it.", parse=_pair, metavar="Y,X")
    depths: tuple[float, ...] = option((), help="Of each.", above=0)
    lasers: tuple[float, float] = option((638.0, 520.0), help="Two.")
    place: tuple[float, float] = option((0.5, 0.5), help="Of it.", metavar="Y,X")
    way: Way = option(Way.LEFT, help="Where to.")
    hidden: int = option(7, help="Not on the command line.", flags=("",))

    def __post_init__(self) -> None:
        if self.count == 8:
            raise InputError("8 is not liked.")


@dataclass(frozen=True, kw_only=True)
class More:
    """Required ones."""

    out: Path = option(help="Where to.", flags=("--out", "-o"))
    speed: float = option(1.0, help="How fast.")


def run(*words: str) -> tuple[Path, Main, More, Given, bool]:
    """Run a command with these words; return what it was called with."""
    app, calls = App(), []

    @app.command()
    def made(
        source: Annotated[Path, typer.Argument()],
        main: Main,
        more: Annotated[More, Only("out")],
        given: Given,
        loud: Annotated[bool, typer.Option("--loud")] = False,
    ) -> None:
        """Say something."""
        calls.append((source, main, more, given, loud))

    parser = typer.main.get_command(app)
    with parser.make_context("made", list(words)) as context:
        parser.invoke(context)
    return calls[0]


@pytest.mark.parametrize(
    ("words", "told"),
    [("TIFF stack.", "TIFF stack"), ("A run.", "a run"), ("PSFs, one a depth.", "PSFs, one a depth")],
)
def test_what_is_missing_is_told_with_its_capitals(words: str, told: str) -> None:
    @dataclass(frozen=True, kw_only=True)
    class Film:
        film: Path = option(help=words)

    (declared,) = options_of(Film)
    assert _missing(declared) == f"--film must be given: {told}."


def test_nothing_given_is_every_default() -> None:
    source, main, more, given, loud = run("in.tif", "--out", "x")
    assert (source, main, more, loud) == (Path("in.tif"), Main(), More(out=Path("x")), False)
    assert list(given.options) == ["out"]


def test_words_become_values_in_the_units_of_python() -> None:
    words = "--no-rare -n 4 --sort fancy --z-mm 25 --level 12.5 --binning 2 --no-background --centre 0.1,0.2"
    words += " --depths 1 --depths 2 --lasers 500 600 --place 0.1,0.2 --way right --loud"
    _, main, _, given, loud = run("in.tif", "-o", "x", *words.split())
    assert main == Main(
        rare=False,
        count=4,
        kind="fancy",
        z_um=25000.0,
        level=12.5,
        binning=2,
        background=False,
        centre=(0.1, 0.2),
        depths=(1.0, 2.0),
        lasers=(500.0, 600.0),
        place=(0.1, 0.2),
        way=Way.RIGHT,
    )
    assert loud
    assert "kind" in given
    assert "hidden" not in given
    assert run("in.tif", "-o", "x", "--level", "dark.tif", "--binning", "auto")[1] == Main(
        level=Path("dark.tif")
    )


def test_a_default_that_was_typed_was_given() -> None:
    assert "count" in run("in.tif", "-o", "x", "--count", "3")[3]


def test_all_mistakes_are_told_at_once_with_their_flags_and_the_units_that_people_type() -> None:
    with pytest.raises(BenchError) as raised:
        run(
            "in.tif", "--count", "10", "--kind", "fancie", "--z-mm", "-2", "--binning", "few", "--depths", "0"
        )
    assert str(raised.value).splitlines() == [
        "--count must be a whole number, 1 or more, 9 or less, not 10.",
        "--kind must be one of plain, fancy, not 'fancie'. Did you mean 'fancy'?",
        "--z-mm must be a number, above 0, below 1000 (mm), not -2.",
        "--binning must be auto or a whole number, 1 or more, not 'few'.",
        "--depths must be a number, above 0, not 0.",
        "--out must be given: where to.",
    ]
    with pytest.raises(BenchError, match="--centre 'middle': could not convert"):
        run("in.tif", "-o", "x", "--centre", "middle")
    with pytest.raises(BenchError, match="--place must be Y,X, 2 numbers, not '1,2,3'"):
        run("in.tif", "-o", "x", "--place", "1,2,3")
    with pytest.raises(BenchError, match="--way must be one of left, right, not 'up'"):
        run("in.tif", "-o", "x", "--way", "up")
    with pytest.raises(BenchError, match=r"--z-mm must be a number.*not 'nan'"):
        run("in.tif", "-o", "x", "--z-mm", "nan")
    with pytest.raises(InputError, match="not liked"):
        run("in.tif", "-o", "x", "--count", "8")


def test_messages_name_the_flag_that_was_typed() -> None:
    with pytest.raises(BenchError, match="--sort must be one of plain, fancy, not 'x'"):
        run("in.tif", "-o", "x", "--sort=x")
    given = run("in.tif", "-o", "x", "--sort", "fancy")[3]
    assert given.flags("kind") == ["--sort"]
    assert run("in.tif", "-o", "x", "--kind", "fancy")[3].flags("kind") == ["--kind"]


def test_an_old_name_is_answered_in_python_with_the_new_one() -> None:
    with pytest.raises(InputError, match=r"no option 'sort'\. It is called 'kind'"):
        with_overrides(Main(), {"sort": "fancy"})


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"kind": 5}, "kind must be one of plain, fancy, not 5"),
        ({"level": [1.0]}, r"level must be auto, the name of a file or a number, not \[1.0\]"),
        ({"count": "3"}, "count must be a whole number, 1 or more, 9 or less, not '3'"),
        ({"rare": 1}, "rare must be True or False, not 1"),
        ({"background": "yes"}, "background must be True or False, not 'yes'"),
        ({"centre": (1.0, 2.0, 3.0)}, r"centre must be 2 values, not \(1.0, 2.0, 3.0\)"),
        ({"depths": 3.0}, "depths must be several values, not 3.0"),
        ({"way": 2}, "way must be one of left, right, not 2"),
    ],
)
def test_a_value_of_another_type_is_refused_in_words(wrong: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        require(with_overrides(Main(), wrong))


def test_what_does_not_apply_is_refused_from_its_declaration() -> None:
    given = run("in.tif", "-o", "x", "--rare")[3]
    given.refuse("--film", "film", "picture")
    with pytest.raises(BenchError, match=r"With --picture these do not apply: --rare \(for a film\)\. Leave"):
        given.refuse("--picture", "picture")


def test_help_has_groups_and_what_is_registered_later(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(globals(), "KINDS", ["plain", "fancy", "late"])
    with pytest.raises(typer.Exit):
        run("--help")
    shown = capsys.readouterr().out
    headings = [line for line in shown.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == ["Arguments:", "Main:", "Options:", f"{RARE}:"]
    assert "-n, --count N" in shown
    assert "How many.  [default: 3; 9 or less]" in shown
    assert "--kind plain|fancy|late" in shown
    assert "--sort" not in shown
    assert "--z-mm MM" in shown
    assert "below 1000" in shown
    assert "--level auto|X|FILE" in shown
    assert "--background/--no-background" in shown
    assert "[default: as it comes]" in shown
    assert "[required]" in shown
    assert "hidden" not in shown


def test_what_only_says_when_to_stop_does_not_identify_kept_work() -> None:
    assert "background" not in identity(Main())
    assert identity(Main())["way"] == "left"
