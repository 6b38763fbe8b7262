"""What Illuminate firmware says is understood, or refused; never something else."""

from __future__ import annotations

import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.common.framing import Belongs, LineFramer
from drivers.errors import DeviceError
from drivers.illuminate.geometry import read_geometry
from drivers.illuminate.link import Firmware1, Firmware2, Link, dialect_of
from drivers.illuminate.protocol import (
    Version,
    parse_properties,
    parse_short,
    parse_table,
    parse_trigger_outputs,
    parse_version,
    payload,
    refusal,
    reply_matcher,
    version_matcher,
)

LED_LISTS = st.lists(st.integers(0, 4095), max_size=400, unique=True)


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_arbitrary_bytes_never_raise(chunks: list[bytes]) -> None:
    framer = LineFramer()
    lines = [line for chunk in chunks for line in framer.feed(chunk)]
    judge = version_matcher()
    for line in lines:
        assert reply_matcher(line) is not Belongs.OTHER
        judge(line)
    parse_version(lines)
    parse_properties(lines)
    parse_short(lines, "CO")
    parse_table(lines, 3)
    parse_trigger_outputs(lines)
    refusal(lines)


@given(
    st.lists(st.tuples(*[st.floats(-500, 500, allow_nan=False)] * 3), min_size=1, max_size=30),
    st.data(),
)
def test_a_table_is_whole_or_none(rows: list[tuple[float, float, float]], data: st.DataObject) -> None:
    body = ",\n".join(f'"{k}" : [{x:.2f}, {y:.2f}, {z:.2f}]' for k, (x, y, z) in enumerate(rows))
    text = f'{{\n"led_position_list_cartesian" : {{\n{body}\n}}\n}}-==-'.encode()
    whole = parse_table(text.split(b"\n"), 3)
    assert whole is not None
    np.testing.assert_array_equal(whole, [[float(f"{number:.2f}") for number in row] for row in rows])
    # Bytes lost somewhere: the same numbers, fewer rows from the end, or nothing. Never a hole.
    begin = data.draw(st.integers(0, len(text)))
    end = data.draw(st.integers(begin, len(text)))
    cut = parse_table((text[:begin] + text[end:]).split(b"\n"), 3)
    if cut is not None:
        assert len(cut) <= len(rows)


@pytest.mark.parametrize(
    "text",
    [
        b'"0" : [1, 2, 3], "2" : [1, 2, 3]',  # a hole
        b'"0" : [1, 2, 3], "0" : [1, 2, 3]',
        b'"0" : [1, 2]',
        b'"0" : [1, 2, x]',
        b'"0" : [1, 2, nan]',
        b'"0" : [1, 2, 1e999]',
        b"",
    ],
)
def test_tables_that_are_none(text: bytes) -> None:
    assert parse_table([text], 3) is None


def test_refusals_of_both_firmwares() -> None:
    assert refusal([b"ERROR[16]: Invalid command."]) == (16, "Invalid command.")
    assert refusal([b"Command [q] is not implemented yet.-==-"]) == (
        None,
        "Command [q] is not implemented yet.",
    )
    assert refusal([b"ERROR (LedArray::setColor): Invalid color value ", b"-==-"]) is not None
    assert refusal([b"CO.1.2.3", b"-==-"]) is None
    assert reply_matcher(b"ERROR[16]: Invalid command.") is Belongs.END
    assert reply_matcher(b"ERROR (LedArray): text") is Belongs.PART  # its terminator follows
    assert reply_matcher(b"}-==-") is Belongs.END
    assert payload([b'{"a": 1', b"}-==-"]) == [b'{"a": 1', b"}"]


def test_an_old_terminator_does_not_end_the_reply_to_version() -> None:
    judge = version_matcher()
    assert [judge(line) for line in (b"-==-", b"CO.1.2.3", b"2.32", b"-==-", b"-==-")] == [
        Belongs.OTHER,
        Belongs.OTHER,
        Belongs.PART,
        Belongs.END,
        Belongs.OTHER,
    ]


def test_versions_are_compared_as_numbers() -> None:
    assert parse_version([b"2.32", b"-==-"]) == Version(2, 32)
    assert parse_version([b"r1.21.0"]) == Version(1, 21)
    assert parse_version([b"2.", b"two"]) is None
    assert dialect_of(Version(1, 15)) is None
    assert isinstance(dialect_of(Version(1, 32)), Firmware1)
    assert isinstance(dialect_of(Version(2, 0)), Firmware2)
    assert dialect_of(Version(3, 0)) is None


@given(LED_LISTS, st.sampled_from([Firmware1(), Firmware2()]))
def test_led_lists_fit_the_firmware_and_lose_none(leds: list[int], dialect: Firmware1 | Firmware2) -> None:
    found: list[int] = []
    for words in dialect.led_lists(leds):
        assert len(words) + 1 <= dialect.longest_line
        name, *numbers = words.split(b".")
        assert name == b"l"
        assert 1 <= len(numbers) <= dialect.most_arguments
        found += map(int, numbers)
    assert found == leds


class ToldLink(Link):
    """Answers as a test says, without a port."""

    def __init__(self, properties: object) -> None:
        super().__init__("none", "led_array (test)")
        self._dialect = Firmware2()
        self._told = json.dumps(properties).encode()

    def command(self, words: bytes, timeout_s: float | None = None) -> list[bytes]:
        table = {
            b"pledpos": b'"0" : [0, 0, 50], "1" : [4, 0, 50]',
            b"pledposna": b'"0" : [0, 0], "1" : [0.08, 0]',
        }
        return [table.get(words, self._told), b"-==-"]


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.sampled_from(["r", "green", ""]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.sampled_from("rgb"), inner),
    max_leaves=6,
)
KEYS = (
    "led_count",
    "color_channels",
    "color_channel_count",
    "color_channel_center_wavelengths",
    "device_name",
)


@given(st.dictionaries(st.sampled_from([*KEYS, "trigger_output_count", "serial_number"]), JSON))
def test_whatever_the_properties_say_the_geometry_is_whole_or_refused(properties: dict[str, object]) -> None:
    try:
        found = read_geometry(ToldLink(properties), None)
    except DeviceError:
        return
    assert found.positions_mm.shape == (2, 3)
    assert found.channels in (1, 3)
    assert found.outputs >= 0
    assert found.wavelengths_nm is None or all(0 < nm < 1e5 for nm in found.wavelengths_nm)


def test_the_two_layouts_of_a_sequence() -> None:
    assert Firmware1().sequence_pattern([3, 12]) == b"ssv.2.3.1.12.1"
    assert Firmware2().sequence_pattern([3, 12]) == b"ssv.3.12"
    assert Firmware1().sequence_pattern([]) == b"ssz.1"
    assert Firmware2().sequence_pattern([]) == b"ssv.none"
    # Outputs 1 and 2, then inputs; or output and input of line 0, then of line 1.
    assert Firmware1().run(10, 2, [1, 2], [3, 4]) == b"rseq.10.2.1.2.3.4"
    assert Firmware2().run(10, 2, [1, 2], [3, 4]) == b"rseq.10.2.1.3.2.4"
    assert Firmware1().run(10, 2, [1], []) == b"rseq.10.2.1.0.0.0"
    assert Firmware2().run(10, 2, [1], [0]) == b"rseq.10.2.1.0"
