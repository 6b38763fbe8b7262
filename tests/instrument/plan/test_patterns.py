"""LED patterns by name: what each lights, and that a registered one is in plans, terminal and window."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import instrument.cli.plan  # noqa: F401 - its help lists the patterns that there are when it is imported
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.cli import main
from instrument.plan import Light, Part, Plan, PlanError, check
from instrument.plan.led_shapes import (
    Annulus,
    BrightField,
    DarkField,
    GridCell,
    HalfCircle,
    LedPlaces,
    LedShape,
    Single,
)
from instrument.plan.model import load_plan, save_plan
from instrument.plan.patterns import LED_PATTERNS, led_shape, shape_buttons, shape_from_text, shape_text
from instrument.runs.acquire import abilities_of, acquire
from instrument.runs.run import Run
from recon import InputError
from recon.arrays import BoolArray, Float64Array

BENCH = """
[bench]
name = "tiny"
[camera]
driver = "simulated"
replay_frames = 2
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0.0
"""


@dataclass
class Square:
    """A square array, 5 x 5, one LED a tenth of aperture."""

    def __post_init__(self) -> None:
        x, y = np.meshgrid(np.arange(-2.0, 3), np.arange(-2.0, 3))
        self.led_na: Float64Array = 0.1 * np.column_stack([x.ravel(), y.ravel()])
        self.led_positions_mm: Float64Array = np.column_stack([self.led_na * 100, np.full(25, 50.0)])


ARRAY = Square()
RADIUS = np.hypot(*ARRAY.led_na.T)


def leds(shape: LedShape, array: LedPlaces = ARRAY) -> list[int]:
    return [int(led) for led in np.flatnonzero(shape.lit(array))]


# What each lights ----------------------------------------------------------------------------------
def test_bright_and_dark_field_complete_each_other() -> None:
    bright, dark = leds(BrightField(0.15)), leds(DarkField(0.15))
    assert (RADIUS[bright] <= 0.15).all()
    assert sorted(bright + dark) == list(range(25))


def test_halves_share_no_led_and_complete_each_other() -> None:
    for one, other, axis in (("left", "right", 0), ("bottom", "top", 1)):
        lower, upper = leds(HalfCircle(one, 0.2)), leds(HalfCircle(other, 0.2))
        assert (ARRAY.led_na[lower, axis] < 0).all()
        assert (ARRAY.led_na[upper, axis] > 0).all()
        edge = [led for led in leds(BrightField(0.2)) if ARRAY.led_na[led, axis] == 0]
        assert sorted(lower + upper + edge) == leds(BrightField(0.2))
    assert [half.side for half in HalfCircle().series(ARRAY)] == ["left", "right", "top", "bottom"]


def test_an_annulus_is_what_lies_between_two_apertures() -> None:
    ring = leds(Annulus(0.2, inner=0.6))
    assert ring
    assert ((RADIUS[ring] > 0.12) & (RADIUS[ring] <= 0.2)).all()
    assert sorted(ring + leds(BrightField(0.12))) == leds(BrightField(0.2))


def test_single_leds() -> None:
    assert leds(Single(7)) == [7]
    assert [leds(one) for one in Single().series(ARRAY)] == [[led] for led in range(25)]


def test_cells_of_a_grid_hold_every_led_once_by_place() -> None:
    x, y = np.meshgrid([-1.0, 0.0, 1.0], [-1.0, 1.0])
    flat = Square()
    flat.led_positions_mm = np.column_stack([x.ravel(), y.ravel()])
    assert [leds(cell, flat) for cell in GridCell(2).series(flat)] == [[0], [1, 2], [3], [4, 5]]
    flat.led_positions_mm = np.array([[0.0, 0.0], [1.0, 0.0]])
    assert [leds(cell, flat) for cell in GridCell(1).series(flat)] == [[0, 1]]
    assert [cell.cell for cell in GridCell(2).series(flat)] == [0, 1]  # the empty ones are left out


# How it is written ---------------------------------------------------------------------------------
@pytest.mark.parametrize("text", ["bright-field", "half side=top na=0.3", "grid cell=2", "single led=3"])
def test_text_and_back(text: str) -> None:
    assert shape_text(led_shape(*shape_from_text(text))) == text


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("half-circle", "not known. Choose one of bright-field"),
        ("half side=front", "side must be one of left, right"),
        ("half na=2", "na must be a number, above 0, 1 or less"),
        ("half nan=0.1", "no option 'nan'. Did you mean 'na'"),
        ("half 0.3", "'0.3' in 'half 0.3' is no option"),
        ("grid side=0", "side must be a whole number, 1 or more"),
    ],
)
def test_mistakes_are_sentences(text: str, says: str) -> None:
    with pytest.raises(InputError) as caught:
        led_shape(*shape_from_text(text))
    assert says in str(caught.value)


# In plans ------------------------------------------------------------------------------------------
def test_plans_name_them_in_three_ways(tmp_path: Path) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(
        'label = "x"\n[[parts]]\nlabel = "a"\n'
        'light = ["half side=top na=0.2", { kind = "half", side = "top", na = 0.2 }, '
        '{ kind = "half na=0.2", options = { side = "top" }, rgb = [0, 9, 0] }, "annulus", "off"]\n'
    )
    plan = load_plan(file)
    first, second, green, *_ = plan.parts[0].light
    assert first == second
    assert str(first) == "half side=top na=0.2"
    assert (green.options, green.rgb) == (first.options, (0, 9, 0))
    save_plan(plan, tmp_path / "again.toml")
    assert load_plan(tmp_path / "again.toml") == plan
    assert Plan.from_json(plan.to_json()) == plan


def test_lights_of_before_are_written_as_before() -> None:
    light = Light(kind="pattern", description="two", leds=((1, 2, 3, 4),))
    assert light.model_dump() == {"kind": "pattern", "description": "two", "leds": ((1, 2, 3, 4),)}


@pytest.mark.parametrize(
    ("light", "says"),
    [
        ('"sorce"', "light 'sorce' is not known; there are off, source, pattern, bright-field"),
        ('"half side=front"', "side must be one of"),
        ('{ kind = "half", size = 3 }', "no option 'size'"),
        ('{ kind = "source", na = 0.3 }', "Extra inputs are not permitted"),
        ('{ kind = "half", leds = [[0, 1, 1, 1]] }', "leds belong to"),
    ],
)
def test_wrong_lights_are_named(tmp_path: Path, light: str, says: str) -> None:
    file = tmp_path / "plan.toml"
    file.write_text(f'label = "x"\n[[parts]]\nlabel = "a"\nlight = {light}\n')
    with pytest.raises(PlanError) as caught:
        load_plan(file)
    assert says in str(caught.value)


def test_a_run_keeps_the_leds_that_were_lit(tmp_path: Path) -> None:
    light = Light(kind="bright-field", options={"na": 0.2}, rgb=(0, 100, 0))
    with open_bench(parse_config(BENCH, None)) as bench:
        assert bench.led_array is not None
        run = acquire(bench, Plan(label="x", parts=(Part(label="a", light=(light,)),)), tmp_path)
        pattern = BrightField(0.2).on(bench.led_array, (0, 100, 0))
    (step,) = Run.open(run.path).steps()
    assert step.light.pattern() == pattern
    assert run.metadata(0).led_pattern == "bright field NA 0.2 rgb (0, 100, 0)"


def test_a_pattern_that_lights_nothing_is_refused_before_anything_moves() -> None:
    plan = Plan(label="x", parts=(Part(label="a", light=(Light(kind="single", options={"led": 10**6}),)),))
    with open_bench(parse_config(BENCH, None)) as bench, pytest.raises(PlanError, match="lights no LED"):
        check(plan, abilities_of(bench))


# One of a user's own -------------------------------------------------------------------------------
@dataclass(frozen=True)
class Odd(LedShape):
    """What a stranger writes."""

    name = "odd"
    help = "Every other LED"

    def lit(self, array: LedPlaces) -> BoolArray:
        return np.arange(len(array.led_na)) % 2 == 1

    @property
    def words(self) -> str:
        return "odd LEDs"


@pytest.fixture
def odd() -> Iterator[None]:
    LED_PATTERNS.register(Odd)
    yield
    del LED_PATTERNS._foreign["odd"]


@pytest.mark.usefixtures("odd")
def test_a_pattern_of_ones_own_is_there_everywhere(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(BENCH)
    # The plan
    Path("plan.toml").write_text('label = "x"\n[[parts]]\nlabel = "a"\nlight = "odd"\nexposure_ms = 1\n')
    assert main(["plan", "show", "plan.toml"]) == 0
    assert "light odd" in capsys.readouterr().out
    assert main(["run", "plan.toml", "--out", "runs"]) == 0
    (path,) = Path("runs").iterdir()
    assert {led[0] % 2 for led in Run.open(path).steps()[0].light.leds} == {1}
    # The terminal
    capsys.readouterr()
    assert main(["plan", "patterns"]) == 0
    assert "odd: Every other LED." in capsys.readouterr().out
    assert main(["plan", "illumination", "lit.toml", "--pattern", "odd", "--exposure-ms", "1"]) == 0
    assert [str(light) for light in load_plan("lit.toml").parts[1].light] == ["odd"]
    # The window
    assert shape_buttons()["Odd"] == Odd()


def test_the_terminal_writes_whole_series(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(BENCH)
    for words, count in ((["--pattern", "half na=0.3"], 4), (["--lattice", "2"], 4)):
        Path("lit.toml").unlink(missing_ok=True)
        assert main(["plan", "illumination", "lit.toml", *words, "--level", "9", "--exposure-ms", "1"]) == 0
        lights = load_plan("lit.toml").parts[1].light
        assert len(lights) == count
        assert {light.rgb for light in lights} == {(9, 9, 9)}
    assert (
        main(["plan", "illumination", "no.toml", "--pattern", "half", "--lattice", "2", "--exposure-ms", "1"])
        == 2
    )
