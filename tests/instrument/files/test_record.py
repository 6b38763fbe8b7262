"""JSON records: one codec for format, version, migration, fields of newer versions, and values' types."""

from __future__ import annotations

import enum
import json
import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest

from drivers.frame import FrameMetadata
from instrument.files.errors import FileError, percent
from instrument.files.record import RecordFormat, of_kind, plain, value_of
from recon.arrays import Float64Array

TEA = RecordFormat(
    "test tea",
    "recipe for tea",
    major=3,
    minor=1,
    make="Make one: brew",
    restore="Brew it again.",
    migrate={
        1: lambda fields: {**fields, "minutes": fields["seconds"] / 60},
        2: lambda fields: {"leaf": fields["herb"], "minutes": fields["minutes"]},
    },
    fields=("leaf", "minutes"),
)


def put(path: Path, record: Any) -> Path:
    path.write_text(record if isinstance(record, str) else json.dumps(record))
    return path


def test_a_record_s_text_and_what_names_its_format(tmp_path: Path) -> None:
    assert TEA.text({"leaf": "Grün"}, indent=None) == '{"format":"test tea","version":"3.1","leaf":"Grün"}\n'
    assert TEA.text({"leaf": 1}) == '{\n "format": "test tea",\n "version": "3.1",\n "leaf": 1\n}\n'
    assert '"leaf": null' in TEA.text({"leaf": math.nan})
    for text, is_tea in (
        ('{"format": "test tea"}', True),
        ('{"format": "coffee"}', False),
        ('["format"]', False),
        ("{", False),
    ):
        assert TEA.is_of(put(tmp_path / "tea.json", text)) is is_tea


def test_a_record_comes_back(tmp_path: Path) -> None:
    path = tmp_path / "tea.json"
    TEA.write(path, {"leaf": "mint", "minutes": np.float32(3)})
    assert json.loads(path.read_text()) == {
        "format": "test tea",
        "version": "3.1",
        "leaf": "mint",
        "minutes": 3,
    }
    assert TEA.read(path) == {"leaf": "mint", "minutes": 3}


def test_old_records_are_brought_up_to_date_step_by_step(tmp_path: Path) -> None:
    first = put(tmp_path / "1.json", {"format": "test tea", "seconds": 180, "herb": "mint"})  # no version yet
    second = put(tmp_path / "2.json", {"format": "test tea", "version": 2, "minutes": 3, "herb": "mint"})
    assert TEA.read(first) == TEA.read(second) == {"leaf": "mint", "minutes": 3}


def test_fields_of_a_newer_version_are_kept_with_a_word(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    newer = {"format": "test tea", "version": "3.7", "leaf": "mint", "minutes": 3, "sugar": 2}
    path = put(tmp_path / "tea.json", newer)
    with caplog.at_level(logging.WARNING):
        assert TEA.read(path)["sugar"] == 2
        TEA.read(path)
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: holds 'sugar', which this program does not know: left out."
    ]


def test_a_newer_version_of_free_facts_is_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    free = replace(TEA, fields=None)
    with caplog.at_level(logging.WARNING):
        free.read(put(tmp_path / "a.json", {"format": "test tea", "version": "3.1", "guest": "Ann"}))
        assert not caplog.records
        free.read(put(tmp_path / "b.json", {"format": "test tea", "version": "3.2"}))
    assert "newer than this program's" in caplog.text
    caplog.clear()
    replace(free, minor=0).read(put(tmp_path / "c.json", {"format": "test tea", "version": 3}))
    assert not caplog.records


def test_a_part_of_a_record_tells_what_is_new_in_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "tea.json"
    assert TEA.value(list[Inner], [{"x": 1, "y": 2}], path) == [Inner(1.0)]
    assert "holds 'y', which this program does not know: left out." in caplog.text
    with pytest.raises(FileError, match="is a damaged recipe for tea: it should be a table, not 3"):
        TEA.value(Inner, 3, path)


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ("{", r"no valid JSON.*Brew it again"),
        ("[]", r"no JSON object: it is no recipe for tea\. Make one"),
        ({"leaf": "mint"}, "holds no recipe for tea: 'format' is None, expected 'test tea'. Make one"),
        ({"format": 1}, "'format' is 1, expected"),
        ({"format": "test tea", "version": 4}, "version 4 is not known.*reads version 1 to 3. Update"),
        ({"format": "test tea", "version": "next"}, "version 'next' is not known"),
        ({"format": "test tea", "version": 0}, "version 0 is not known.*Brew it again"),
        ({"format": "test tea", "version": 2}, "is a damaged recipe for tea: lacks 'herb'. Brew it again"),
    ],
)
def test_what_is_wrong_is_said_in_a_sentence(tmp_path: Path, record: Any, message: str) -> None:
    path = put(tmp_path / "tea.json", record)
    with pytest.raises(FileError, match=message) as caught:
        TEA.read(path)
    assert str(caught.value).startswith(f"{path}: ")


def test_a_missing_file_says_how_to_make_one(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"tea\.json: there is no such file\. Make one: brew"):
        TEA.read(tmp_path / "tea.json")


def test_numbers_of_before_are_versions(tmp_path: Path) -> None:
    numbered = replace(TEA, numbered_before=True)
    assert numbered.read(put(tmp_path / "a.json", {"format": 3, "leaf": "mint"})) == {"leaf": "mint"}
    with pytest.raises(FileError, match="version 99 is not known"):
        numbered.read(put(tmp_path / "b.json", {"format": 99}))


# Values ------------------------------------------------------------------------------------------
class Colour(enum.Enum):
    RED = "red"


@dataclass(frozen=True)
class Inner:
    x: float
    pair: tuple[int, str] = (1, "a")


@dataclass(frozen=True)
class Outer:
    inner: Inner
    when: datetime
    path: Path
    colour: Colour
    grid: Float64Array
    maybe: Inner | None = None
    several: tuple[Inner, ...] = ()
    named: Mapping[str, float] = field(default_factory=dict)
    lost: float = 0.0


def test_values_come_back_by_their_declaration() -> None:
    value = Outer(
        inner=Inner(1.5, (2, "b")),
        when=datetime(2026, 1, 2, 3, 4, 5, 678, UTC),
        path=Path("a/b"),
        colour=Colour.RED,
        grid=np.eye(2),
        several=(Inner(1.0), Inner(2.0)),
        named={"x_um": 3.0},
        lost=math.nan,
    )
    data = json.loads(json.dumps(plain(value), allow_nan=False))
    back = value_of(Outer, data)
    np.testing.assert_array_equal(back.grid, value.grid)
    assert math.isnan(back.lost)
    same = {"grid": 0, "lost": 0.0}
    assert replace(back, **same) == replace(value, **same)


def test_arrays_have_their_declared_type_and_what_is_no_record_stays_as_it_is() -> None:
    data = plain(Outer(Inner(1.0), datetime.now(UTC), Path("a"), Colour.RED, np.eye(2, dtype=np.float64)))
    assert value_of(Outer, data | {"grid": [1, 2]}).grid.dtype == np.float64
    thing = object()
    assert plain(thing) is thing
    assert plain(Inner) is Inner


def test_a_union_is_read_as_its_only_type_and_pairs_by_place() -> None:
    @dataclass(frozen=True)
    class Local:  # readers are kept: a type of before would not show a mistake
        one: Path | None
        either: Path | str | None
        pair: tuple[Path, str]
        word: Literal["yes", "no"] = "no"
        whole: int = 1

    assert value_of(int, "as it is") == "as it is"  # type: ignore[comparison-overlap]
    data = {"one": "a", "either": "b", "pair": ["c", "d"]}
    assert value_of(Local, data) == Local(Path("a"), "b", (Path("c"), "d"))
    assert value_of(Local, data | {"one": None, "either": None}) == Local(None, None, (Path("c"), "d"))
    with pytest.raises(ValueError, match="shorter"):
        value_of(Local, data | {"pair": ["c"]})


def test_a_union_of_a_table_words_and_a_file_is_told_apart() -> None:
    @dataclass(frozen=True)
    class Choice:
        of: Literal["auto"] | float | Inner | Path | None = None

    for value in (
        Choice("auto"),
        Choice(2.5),
        Choice(Inner(1.0, (2, "b"))),
        Choice(Path("dark.tif")),
        Choice(),
    ):
        assert value_of(Choice, json.loads(json.dumps(plain(value)))) == value
    unknown: dict[str, Any] = {}
    value_of(Choice, {"of": {"x": 1, "z": 5}}, unknown)
    assert unknown == {"of.z": 5}


def test_unknown_fields_of_values_are_handed_over() -> None:
    unknown: dict[str, Any] = {}
    assert value_of(Inner, {"x": 1, "y": 2}, unknown) == Inner(1.0)
    assert unknown == {"y": 2}
    nested: dict[str, Any] = {}
    value_of(tuple[Inner, ...], [{"x": 1, "z": 5}], nested)
    assert nested == {"z": 5}


@pytest.mark.parametrize("data", [None, {}, {"x": "one"}, {"x": 1, "pair": [1]}, [1.0]])
def test_what_is_no_such_value_is_refused(data: Any) -> None:
    with pytest.raises((TypeError, ValueError)):
        value_of(Inner, data)


def test_metadata_of_frames_come_back() -> None:
    metadata = FrameMetadata(
        frame_id=3, device_time_ns=None, host_time_ns=12, utc=datetime.now(UTC), exposure_ms=1.5, gain=1.0,
        pixel_format="Mono12", significant_bits=12, black_level=3.25, roi=(0, 2, 4, 6), binning=1,
        stage_position={"x_um": 1.0}, led_pattern="off",
    )  # fmt: skip
    assert value_of(FrameMetadata, json.loads(json.dumps(plain(metadata)))) == metadata


@pytest.mark.parametrize(
    ("share", "words"),
    [
        (0.0, "0 %"),
        (4e-6, "less than 0.001 %"),
        (0.123456, "12.3 %"),
        (0.9998, "more than 99.9 %"),
        (1.0, "100 %"),
        (12.34, "1234 %"),
    ],
)
def test_shares_are_neither_nothing_nor_all_by_rounding(share: float, words: str) -> None:
    assert percent(share) == words


def test_a_number_that_no_float_holds_is_none_where_one_is_expected() -> None:
    with pytest.raises(TypeError, match="'gain' is a whole number of more than 300 digits"):
        of_kind(10**400, float, "gain")
    assert of_kind(10**400, int, "gain") == 10**400
    assert of_kind(10**300, float, "gain") == 10**300
