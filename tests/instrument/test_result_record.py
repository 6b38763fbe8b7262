"""Records beside results whose parts are of another kind, and marks of what they were made of."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from instrument.files.errors import FileError
from instrument.files.images import read_image, write_image
from instrument.files.reading import parse_json
from instrument.files.record import of_kind
from instrument.reconstruction.job import source_record
from instrument.reconstruction.stored_result import _TOLD, open_result
from instrument.volumes.grid_facts import grid_of
from recon.base.marks import Likeness, likeness, marks_of

RESULTS = Path(__file__).parents[1] / "fixtures" / "v813d646" / "results"
RNG = np.random.default_rng(4)


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        (("provenance",), [], "'provenance' is no object"),
        (("provenance", "auto"), "a", "'provenance.auto' is no object"),
        (("provenance", "auto", "decisions"), [{"value": 1}], "'provenance.auto.decisions' has no 'name'"),
        (("history",), [{"iteration": 1}], "'history' has no 'seconds'"),
        (("history",), [None], "'history' is no object"),
        (("verdict", "sentences"), "good", "'verdict.sentences' is no list"),
        (("warnings",), 3, "'warnings' is no list"),
        (("inputs", "image"), {"pixels": "a"}, "'inputs.image' has no 'path'"),
        (("inputs", "image"), 3, "'inputs.image' is '3', no text and no object of names and values"),
        (("tau",), "small", "'tau' is 'small', no number"),
        (("seconds",), True, "'seconds' is 'True', no number"),
        (("grid", "shape"), ["a"], "'grid.shape' is 'a', no whole number"),
        (("tau",), 10**400, "more than 300 digits"),
    ],
)
def test_what_is_of_another_kind_is_named(
    place: tuple[str, ...], value: object, words: str, tmp_path: Path
) -> None:
    for end in ("json", "tif"):
        shutil.copyfile(RESULTS / f"picture.{end}", tmp_path / f"picture.{end}")
    record = json.loads((tmp_path / "picture.json").read_text())
    inside: Any = record
    for name in place[:-1]:
        inside = inside[name]
    for put, says in ((value, words), (None, "")):
        inside[place[-1]] = put
        (tmp_path / "picture.json").write_text(json.dumps(record))
        if says:
            with pytest.raises(FileError, match=r"picture\.json") as caught:
                open_result(tmp_path / "picture.tif")
            assert says in str(caught.value)
        else:  # null is what is not known
            assert dict(open_result(tmp_path / "picture.tif").facts())["Size"]


def numbers_of(kind: Any, *at: str | int) -> list[tuple[tuple[str | int, ...], Any]]:
    """Every place of a table of kinds that may hold a number, and its kind."""
    if isinstance(kind, tuple):
        return [place for one in kind for place in numbers_of(one, *at)]
    if isinstance(kind, dict):
        return [place for key, one in kind.items() for place in numbers_of(one, *at, key.rstrip("!"))]
    if isinstance(kind, list):
        return numbers_of(kind[0], *at, 0)
    return [(at, kind)] if kind in (int, float) else []


def sound(kind: Any) -> Any:
    """The least that is of a kind, with an item in each list."""
    if isinstance(kind, tuple):
        return sound(kind[-1])
    if isinstance(kind, dict):
        return {key.rstrip("!"): sound(one) for key, one in kind.items()}
    return [sound(kind[0])] if isinstance(kind, list) else {float: 0.5, int: 1}.get(kind, "a")


PLACES = numbers_of(_TOLD)


@pytest.mark.parametrize(("place", "kind"), PLACES, ids=[".".join(map(str, place)) for place, _ in PLACES])
def test_every_number_of_a_record_may_be_a_whole_one(
    place: tuple[str | int, ...], kind: type, tmp_path: Path
) -> None:
    shutil.copyfile(RESULTS / "picture.tif", tmp_path / "picture.tif")
    for value in (0, 10, -3, 10**20) if kind is float else (0, 10):
        record = sound(_TOLD)
        inside = record
        for name in place[:-1]:
            inside = inside[name]
        inside[place[-1]] = value
        (tmp_path / "picture.json").write_text(json.dumps(record))
        told: Any = open_result(tmp_path / "picture.tif").record
        for name in place:
            told = told[name]
        assert told == value


def test_of_several_kinds_each_is_tried_and_all_are_named() -> None:
    for value in (10, 10.5, "10"):
        assert of_kind(value, (float, str), "a") == value
    for wrong in (True, [], {}):
        with pytest.raises(TypeError, match="no number and no text"):
            of_kind(wrong, (float, str), "a")
    with pytest.raises(TypeError, match=r"'a\.b' is 'c', no number"):
        of_kind({"b": "c"}, (str, {"b": float}, float), "a")
    with pytest.raises(TypeError, match="no list and no whole number"):
        of_kind("a", ([int], int), "a")


@pytest.mark.parametrize("exposure_ms", [10, 10.0, "10", [1, 2], True, {}, None])
def test_a_result_of_a_photograph_that_says_anything_of_its_exposure_is_read(
    exposure_ms: object, tmp_path: Path
) -> None:
    image = np.zeros((12, 16), np.uint16)
    write_image(tmp_path / "photo.tif", image, {"exposure_ms": exposure_ms})
    shutil.copyfile(RESULTS / "picture.tif", tmp_path / "picture.tif")
    record = json.loads((RESULTS / "picture.json").read_text())
    record["inputs"]["image"] = source_record(read_image(tmp_path / "photo.tif"))
    (tmp_path / "picture.json").write_text(json.dumps(record))
    told = dict(open_result(tmp_path / "picture.tif").facts()).get("Taken", "")
    assert told == ("10 ms" if exposure_ms in (10, "10") and exposure_ms is not True else "")


def test_numbers_that_are_no_sizes_are_not_known() -> None:
    facts = {"z_um": [1e4, 2e4], "pitch_um": [10.0, 20.0], "centre": [1, 2]}
    assert grid_of(facts, (2, 3, 4)).pitch_um.tolist() == [10.0, 20.0]
    for wrong in ([0.0, 20.0], [-1.0, 20.0], [1e300, 1.0], [10**400, 1.0]):
        assert np.isnan(grid_of({**facts, "pitch_um": wrong}, (2, 3, 4)).z_um).all()
    assert grid_of({**facts, "centre": [1e300, 0]}, (2, 3, 4)).centre == (1, 2)
    assert parse_json("9" * 300)
    assert parse_json('["' + "9" * 301 + '", -1]') == ["9" * 301, -1]
    for text in ("9" * 301, b"[1" + b"0" * 301 + b"]"):
        with pytest.raises(ValueError, match="more than 300 digits"):
            parse_json(text)


OTHER, UNKNOWN, NEAR, ALIKE, SAME = Likeness


def test_marks_are_the_same_but_for_rounding_and_no_others() -> None:
    array = RNG.gamma(1.0, 100.0, (3, 170, 260)).astype(np.float32)  # of more than one piece
    marks = marks_of(array)
    told = json.loads(json.dumps(marks))
    assert likeness([told], [marks_of(array.copy())]) is SAME
    assert likeness([told], [marks_of(array * (1 + 3e-7 * RNG.standard_normal(array.shape)))]) is NEAR
    a_little = array.copy()
    a_little[0, 0, 0] *= 1.01
    assert likeness([told], [marks_of(a_little)]) is NEAR, "said, though not told from rounding"
    one = array.copy()
    one[1, 80, 100] += 0.01 * np.linalg.norm(array)
    swapped = array.reshape(-1).copy()
    swapped[[5, 70_000]] = 0.0, 9000.0
    moved = array.reshape(-1).copy()
    moved[[5, 70_000]] = 9000.0, 0.0
    assert likeness([marks_of(swapped)], [marks_of(moved)]) is OTHER
    others = (one, np.roll(array, 1, 2), np.roll(array, 1, 0), array[::-1], array + 1, 1.001 * array, array.T)
    for other in (*others, array[:, :, :-1], np.concatenate([array, 0 * array[:1]])):
        assert likeness([told], [marks_of(np.asarray(other))]) is OTHER
    assert likeness([told, told], [marks]) is OTHER
    assert likeness([told, told], [marks, marks_of(one)]) is OTHER
    kept = np.array([[True, False, True]])
    assert likeness([marks_of(kept)], [marks_of(kept)]) is SAME
    assert likeness([marks_of(kept)], [marks_of(~kept)]) is OTHER
    assert likeness([marks_of(np.zeros(3))], [marks_of(np.zeros(3))]) is SAME
    for wrong in (None, 3, [], [3], [{**told, "marks": None}], [{**told, "norm": ["a"]}]):
        assert likeness(wrong, [marks]) is UNKNOWN
    for wrong in (
        [{**told, "marks": [float("nan")]}],
        [{**told, "shape": [10**400]}],
        [{**told, "norm": 1.0}],
        [{**told, "gaps": None}],
    ):
        assert likeness(wrong, [marks]) is UNKNOWN
    assert likeness([{**told, "marks": [0.0]}], [marks]) is OTHER


def test_numbers_that_are_none_are_no_zeros_nor_others() -> None:
    whole = RNG.gamma(1.0, 100.0, (40, 50)).astype(np.float32)
    whole[3, 7] = whole[8, 9] = 0
    lacking, elsewhere = whole.copy(), whole.copy()
    lacking[3, 7], elsewhere[8, 9] = np.nan, np.inf
    told = {name: marks_of(array) for name, array in (("whole", whole), ("lacking", lacking))}
    assert likeness([told["lacking"]], [marks_of(lacking)]) is SAME
    assert likeness([told["lacking"]], [marks_of(whole)]) is OTHER
    assert likeness([told["whole"]], [marks_of(lacking)]) is OTHER
    assert likeness([told["lacking"]], [marks_of(elsewhere)]) is OTHER
    before = {name: told["whole"][name] for name in ("shape", "norm", "marks")}  # of before 2026-12
    assert likeness([before], [marks_of(whole)]) is ALIKE, "no checksum tells more"
    assert likeness([{**before, "crc32": ["12"]}], [marks_of(whole)]) is ALIKE
    assert likeness([before], [marks_of(lacking)]) is UNKNOWN
    assert likeness([before], [marks_of(2 * lacking)]) is OTHER, "known, though not which are none"
    assert likeness([before], [marks_of(lacking[1:])]) is OTHER
    for name in ("shape", "norm", "marks"):
        assert likeness([{**before, name: None}], [marks_of(whole)]) is UNKNOWN
        assert likeness([{**before, name: None}], [marks_of(-2 * whole[1:])]) is OTHER
    of_two = [marks_of(lacking), marks_of(2 * whole)]
    assert likeness([before, before], of_two) is OTHER
    assert likeness([told["whole"], before], [marks_of(whole)] * 2) is ALIKE
