"""The Illuminate driver over its emulator: exact light, OFF, sequences, triggers, faults."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.illuminate.led_array import IlluminateLedArray, IlluminateOptions
from drivers.led_array import OFF, LedPattern
from instrument.plan.led_shapes import BrightField
from tests.mocks.illuminate_emulator import IlluminateEmulator
from tests.mocks.pty_device import Answer
from tests.mocks.waiting import in_background, until

BUILDS = {"1.32": ("1.32", False), "1.32 of 2021": ("1.32", True), "2.32": ("2.32", True)}
"""Version, and whether ``sc`` scales colours."""


def driver_of(array: IlluminateEmulator, **options: object) -> IlluminateLedArray:
    return IlluminateLedArray(IlluminateOptions.model_validate({"port": str(array.link), **options}))


@pytest.fixture(params=BUILDS)
def array(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[IlluminateEmulator]:
    version, normalises = BUILDS[request.param]
    array = IlluminateEmulator(tmp_path, version, normalises=normalises)
    yield array
    array.unplug()
    assert array.corrupted == []


@pytest.fixture
def new_array(tmp_path: Path) -> Iterator[IlluminateEmulator]:
    array = IlluminateEmulator(tmp_path, "2.32")
    yield array
    array.unplug()


@pytest.fixture
def leds(array: IlluminateEmulator) -> Iterator[IlluminateLedArray]:
    with driver_of(array) as leds:
        yield leds


@pytest.fixture
def new_leds(new_array: IlluminateEmulator) -> Iterator[IlluminateLedArray]:
    with driver_of(new_array) as leds:
        yield leds


def repeat(act: Callable[[], object]) -> None:
    """Until the operating system has noticed that the cable is gone."""
    for _ in range(100):
        act()


def spoil(command: bytes, *answers: Answer) -> Callable[[bytes, bytes], list[Answer]]:
    """Answer one command otherwise, once; the rest as it should be."""
    left = [list(answers)]

    def fault(line: bytes, reply: bytes) -> list[Answer]:
        return left.pop() if left and line.startswith(command) else [reply]

    return fault


# Light -------------------------------------------------------------------------------------------
@pytest.mark.parametrize("rgb", [(255, 255, 255), (1, 2, 3), (200, 7, 0), (0, 0, 99)])
def test_leds_shine_with_exactly_the_levels_asked_for(
    array: IlluminateEmulator, leds: IlluminateLedArray, rgb: tuple[int, int, int]
) -> None:
    pattern = BrightField(0.3).on(leds, rgb)
    assert len(pattern.levels) > 20  # more than firmware 1 takes in one line
    leds.set_pattern(pattern)
    expected = np.zeros_like(array.lit)
    expected[[led for led, _ in pattern.levels]] = rgb
    np.testing.assert_array_equal(array.lit, expected)


def test_firmware_that_scales_colours_shows_every_level_exactly(tmp_path: Path) -> None:
    array = IlluminateEmulator(tmp_path, "1.32", normalises=True)
    with driver_of(array) as leds:
        for level in range(1, 256):
            rgb = (level, level // 3, max(level - 1, 0))
            leds.set_pattern(leds.single(0, rgb))
            assert tuple(array.lit[0]) == rgb
        leds.sequencer.load([leds.single(3, (9, 9, 9)), LedPattern("dark")])
        thread, outcome = in_background(lambda: leds.sequencer.run(300))
        assert until(lambda: array.lit[3].all())
        assert array.lit[3].tolist() == [9, 9, 9]
        thread.join(20)
        assert outcome == [None]
    array.unplug()


def test_lines_are_short_where_the_parser_loses_bytes(tmp_path: Path) -> None:
    for waits, longest_line in ((False, 64), (True, 8192)):
        array = IlluminateEmulator(tmp_path, "2.32", waits=waits)
        with driver_of(array, longest_line=longest_line) as leds:
            pattern = LedPattern("many", tuple((led, (5, 5, 5)) for led in range(100, 200)))
            leds.set_pattern(pattern)
            assert array.lit[:, 0].nonzero()[0].tolist() == list(range(100, 200))
            assert max(map(len, array.received)) < longest_line
            if waits:
                leds.sequencer.load([pattern])
                assert array.sequence == [tuple(range(100, 200))]
            else:
                with pytest.raises(LimitError, match="for firmware 2 see longest_line"):
                    leds.sequencer.load([pattern])
        array.unplug()
    lossy = IlluminateEmulator(tmp_path, "2.32")
    with driver_of(lossy, longest_line=8192) as leds:
        leds.set_pattern(pattern)
        assert lossy.lit[:, 0].nonzero()[0].tolist() != list(range(100, 200))  # what short lines avoid
    lossy.unplug()


def test_several_colours_at_once_and_then_one_leaves_nothing_behind(
    array: IlluminateEmulator, leds: IlluminateLedArray
) -> None:
    leds.set_pattern(
        LedPattern("three", ((0, (9, 0, 0)), (7, (0, 255, 1)), (256, (9, 0, 0)), (3, (0, 0, 0))))
    )
    assert array.lit.nonzero()[0].tolist() == [0, 7, 7, 256]
    assert array.lit[7].tolist() == [0, 255, 1]
    leds.set_pattern(leds.single(5, (4, 4, 4)))
    assert array.lit.sum(axis=1).nonzero()[0].tolist() == [5]
    leds.set_pattern(LedPattern("dark"))
    assert not array.lit.any()


def test_brightness_scales_what_is_shown_and_keeps_faint_light(
    array: IlluminateEmulator, leds: IlluminateLedArray
) -> None:
    leds.set_pattern(leds.single(2, (200, 100, 1)))
    assert leds.set_brightness(51) == 51
    assert array.lit[2].tolist() == [40, 20, 1]
    assert leds.settings()["brightness"] == 51
    with pytest.raises(LimitError, match="1 to 255"):
        leds.set_brightness(0)


def test_nothing_out_of_range_is_sent(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    leds.set_pattern(leds.single(0))
    sent = len(array.received)
    for pattern in (leds.single(257), leds.single(-1), leds.single(0, (0, 0, 256))):
        with pytest.raises(LimitError):
            leds.set_pattern(pattern)
        with pytest.raises(LimitError):
            leds.sequencer.load([pattern])
    assert len(array.received) == sent


def test_an_array_of_one_colour(tmp_path: Path) -> None:
    array = IlluminateEmulator(tmp_path, channels=1)
    with driver_of(array) as leds:
        leds.set_pattern(leds.single(4, (77, 77, 77)))
        assert array.lit[4].tolist() == [77]
        with pytest.raises(LimitError, match="one colour"):
            leds.set_pattern(leds.single(4, (77, 0, 0)))
        assert leds.wavelengths_nm == (625.0, 625.0, 625.0)
    array.unplug()


# What it says of itself --------------------------------------------------------------------------
def test_geometry_comes_from_the_array(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    assert leds.identity.firmware == array.version
    assert leds.identity.model == "sci-round"
    assert leds.identity.serial_number == "12"
    assert leds.wavelengths_nm == (625.0, 525.0, 480.0)
    np.testing.assert_allclose(leds.led_positions_mm, array.places_mm + np.array([0, 0, 60.0]))
    x, y, z = leds.led_positions_mm[100]
    np.testing.assert_allclose(leds.led_na[100], np.array([x, y]) / np.sqrt(x * x + y * y + z * z))


def test_the_distance_may_be_said_in_the_configuration(new_array: IlluminateEmulator) -> None:
    with driver_of(new_array, distance_mm=30.0) as leds:
        assert set(leds.led_positions_mm[:, 2]) == {30.0}
        assert np.hypot(*leds.led_na.T).max() > 0.75


def test_objective_na_is_not_ten_times_what_was_asked(
    array: IlluminateEmulator, leds: IlluminateLedArray
) -> None:
    assert leds.set_objective_na(0.04) == 0.04 == array.na
    assert leds.settings()["objective_na"] == 0.04
    for wrong in (0.0, 1.01, float("nan")):
        with pytest.raises(LimitError):
            leds.set_objective_na(wrong)


@pytest.mark.parametrize("version", ["1.10", "3.00"])
def test_unknown_firmware_is_refused(tmp_path: Path, version: str) -> None:
    array = IlluminateEmulator(tmp_path, version)
    with pytest.raises(DeviceError, match=rf"firmware {version}; known are 1\.16 to 1\.x, and 2\.x"):
        driver_of(array).open()
    array.unplug()


def test_probe_recognises_an_array_and_leaves_it_dark(
    array: IlluminateEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = IlluminateLedArray.probe(str(array.link))
    assert found is not None
    assert (found.driver, found.kind, found.options) == ("illuminate", "led_array", {"port": str(array.link)})
    assert array.version in found.description
    array.silent = True
    monkeypatch.setattr(IlluminateLedArray, "reply_s", 0.1)
    assert IlluminateLedArray.probe(str(array.link)) is None


# OFF ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("inputs", [(), (1,)])
def test_off_overtakes_a_running_sequence(
    array: IlluminateEmulator, leds: IlluminateLedArray, inputs: tuple[int, ...]
) -> None:
    leds.sequencer.load([leds.single(k) for k in range(3)])
    thread, outcome = in_background(lambda: leds.sequencer.run(50, 1000, inputs=inputs, timeout_s=60.0))
    assert until(lambda: array.lit.any())
    assert not leds.pattern.is_dark
    leds.off()
    assert not array.lit.any()
    assert leds.pattern == OFF
    thread.join(20)
    assert isinstance(outcome[0], StoppedError)
    # Every reply still belongs to its command.
    leds.set_pattern(leds.single(9, (1, 2, 3)))
    assert array.lit[9].tolist() == [1, 2, 3]


def test_off_during_a_pattern_leaves_it_dark(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    array.fault = lambda line, reply: [0.3, reply] if line.startswith(b"l.") else [reply]
    many = LedPattern("many", tuple((k, (k + 1, 0, 0)) for k in range(10)))
    thread, outcome = in_background(lambda: leds.set_pattern(many))
    assert until(lambda: array.lit.any())
    leds.off()
    thread.join(20)
    assert isinstance(outcome[0], StoppedError)
    assert not array.lit.any()
    assert leds.pattern == OFF


def test_off_from_many_threads_at_once(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    leds.set_pattern(BrightField(0.2).on(leds))
    runs = [in_background(leds.off) for _ in range(4)]
    for thread, _ in runs:
        thread.join(30)
    assert [outcome for _, outcome in runs] == [[None]] * 4
    assert not array.lit.any()


def test_off_says_when_the_light_may_be_on(
    array: IlluminateEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IlluminateLedArray, "reply_s", 0.3)
    with driver_of(array) as leds:
        leds.set_pattern(leds.single(0))
        array.silent = True
        with pytest.raises(DeviceError, match=r"does not confirm that it is off.*The light may be on"):
            leds.off()
        array.silent = False


def test_off_of_a_lost_array_says_that_the_light_may_be_on(
    array: IlluminateEmulator, leds: IlluminateLedArray
) -> None:
    leds.set_pattern(leds.single(0))
    array.unplug()
    assert until(lambda: not leds.is_open)
    with pytest.raises(DeviceError, match=r"was lost on .*The light may be on: look, and pull its supply"):
        leds.off()
    array.plug_in()


def test_off_overtakes_a_sequence_that_begins_meanwhile(
    array: IlluminateEmulator, leds: IlluminateLedArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    leds.sequencer.load([leds.single(k) for k in range(3)])
    command, darken = leds.link.command, leds.link.darken_at_once
    about_to_run, overtaken = threading.Event(), threading.Event()

    def late(words: bytes, timeout_s: float | None = None) -> list[bytes]:
        if words.startswith(b"rseq"):
            about_to_run.set()
            assert overtaken.wait(10)
        return command(words, timeout_s)

    def notice() -> None:
        darken()
        overtaken.set()

    monkeypatch.setattr(leds.link, "command", late)
    monkeypatch.setattr(leds.link, "darken_at_once", notice)
    thread, outcome = in_background(lambda: leds.sequencer.run(50, 400))  # a minute
    assert about_to_run.wait(10)
    stopper, stopped = in_background(leds.off)
    stopper.join(20)
    assert stopped == [None]
    assert not array.lit.any()
    thread.join(20)
    assert isinstance(outcome[0], StoppedError)


# Sequences and triggers --------------------------------------------------------------------------
def test_a_sequence_runs_in_the_array(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    patterns = [
        leds.single(3, (5, 6, 7)),
        LedPattern("none"),
        LedPattern("pair", ((8, (5, 6, 7)), (2, (5, 6, 7)))),
    ]
    leds.sequencer.load(patterns)
    assert leds.sequencer.run(5, 2, outputs=(1, 2)) == 6
    assert array.shown == [(3,), (), (2, 8)] * 2
    assert array.pulses == [6, 4]
    assert not array.lit.any()
    assert leds.pattern.is_dark


def test_a_sequence_waits_for_its_triggers(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    leds.sequencer.load([leds.single(k) for k in range(2)])
    with pytest.raises(LimitError, match="timeout_s"):
        leds.sequencer.run(5, inputs=(0, 1))
    array.input_levels[1] = True
    assert leds.sequencer.run(5, inputs=(0, 1), timeout_s=20.0) == 2
    array.input_levels[1] = False
    with pytest.raises(DeviceTimeoutError):
        leds.sequencer.run(5, inputs=(0, 1), timeout_s=0.3)
    assert not array.lit.any()
    assert leds.pattern.is_dark


def test_what_a_sequence_cannot_do_is_refused(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    with pytest.raises(DeviceError, match="Load one first"):
        leds.sequencer.run(10)
    with pytest.raises(LimitError, match="one colour"):
        leds.sequencer.load([leds.single(0, (1, 0, 0)), leds.single(1, (2, 0, 0))])
    with pytest.raises(LimitError, match="more than firmware"):
        leds.sequencer.load([BrightField(1.0).on(leds)])
    leds.sequencer.load([leds.single(0)])
    for interval_ms, repeats in ((-1, 1), (65_536, 1), (10, 0)):
        with pytest.raises(LimitError):
            leds.sequencer.run(interval_ms, repeats)
    with pytest.raises(LimitError, match="no trigger output 2"):
        leds.sequencer.run(10, outputs=(0, 0, 1))
    with pytest.raises(DeviceError, match="shorter than LED update rate"):
        leds.sequencer.run(1)
    assert not array.lit.any()


def test_trigger_outputs(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    assert leds.sequencer.set_output(1, 250, 10) == (250, 10)
    assert (array.widths_us, array.delays_us) == ([1000, 250], [0, 10])
    leds.sequencer.trigger(1)
    assert array.pulses == [0, 1]
    for line in (-1, 2):
        with pytest.raises(LimitError, match="no trigger output"):
            leds.sequencer.trigger(line)
    with pytest.raises(LimitError, match="1 to 65535"):
        leds.sequencer.set_output(0, 0)


# Faults ------------------------------------------------------------------------------------------
def test_a_refusal_neither_hangs_nor_shifts_the_replies(leds: IlluminateLedArray) -> None:
    began = time.monotonic()
    for _ in range(3):
        with pytest.raises(DeviceError, match=r"refuses 'warp\.9': .*(Invalid command|not implemented)"):
            leds.link.command(b"warp.9")
        assert leds.set_objective_na(0.3) == 0.3
    assert time.monotonic() - began < 10


def test_no_power_says_what_to_check(new_array: IlluminateEmulator, new_leds: IlluminateLedArray) -> None:
    new_array.fault = spoil(b"l.", b"ERROR[3]: (LedArray::sourceConnected): Source Disconnected\n")
    with pytest.raises(DeviceError, match="power supply"):
        new_leds.set_pattern(new_leds.single(0))
    assert new_leds.pattern.is_dark


def test_a_pattern_that_fails_halfway_leaves_nothing_lit(
    array: IlluminateEmulator, leds: IlluminateLedArray
) -> None:
    array.fault = spoil(b"l.7", b"ERROR[3]: Source Disconnected\n-==-\n")
    with pytest.raises(DeviceError, match="Disconnected"):
        leds.set_pattern(LedPattern("two", ((0, (9, 0, 0)), (7, (0, 9, 0)))))
    assert b"l.7" in array.received
    assert not array.lit.any()
    assert leds.pattern.is_dark
    leds.set_pattern(leds.single(7, (0, 9, 0)))
    assert array.lit[7].tolist() == [0, 9, 0]


def test_ctrl_c_in_a_sequence_leaves_nothing_lit(
    array: IlluminateEmulator, leds: IlluminateLedArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    leds.sequencer.load([leds.single(k) for k in range(3)])
    command = leds.link.command

    def interrupted(words: bytes, timeout_s: float | None = None) -> list[bytes]:
        if words.startswith(b"rseq"):
            leds.link.send_now(words + b"\n")
            assert until(lambda: array.lit.any())
            raise KeyboardInterrupt
        return command(words, timeout_s)

    monkeypatch.setattr(leds.link, "command", interrupted)
    with pytest.raises(KeyboardInterrupt):
        leds.sequencer.run(50, 1000)
    assert not array.lit.any()
    assert leds.pattern.is_dark


def test_late_replies_and_garbage(array: IlluminateEmulator, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(IlluminateLedArray, "reply_s", 0.4)
    with driver_of(array) as leds:
        array.fault = spoil(b"na", 0.6, b"NA.99\n-==-\n")
        with pytest.raises(DeviceTimeoutError):
            leds.settings()
        assert leds.settings()["objective_na"] == 0.25
        array.fault = spoil(b"na", b"\xff\x00\xfeN", b"\n-==-\n")
        with pytest.raises(DeviceError, match=r"NA\.NUMBER was expected"):
            leds.settings()
        assert leds.settings()["objective_na"] == 0.25


def test_levels_that_are_not_what_was_asked_are_an_error(
    new_array: IlluminateEmulator, new_leds: IlluminateLedArray
) -> None:
    new_array.fault = spoil(b"ssc.2", b"CO.1.2.9\n-==-\n")
    with pytest.raises(DeviceError, match=r"has levels \(1, 2, 9\) after it was told \(1, 2, 3\)"):
        new_leds.set_pattern(new_leds.single(0, (1, 2, 3)))
    new_leds.set_pattern(new_leds.single(0, (1, 2, 3)))
    assert new_array.lit[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize("command", [b"pledpos", b"pledposna", b"pprops"])
def test_a_geometry_cut_short_is_no_geometry(new_array: IlluminateEmulator, command: bytes) -> None:
    def cut(line: bytes, reply: bytes) -> list[Answer]:
        return [reply[: len(reply) // 2] + b"\n-==-\n"] if line == command else [reply]

    new_array.fault = cut
    leds = driver_of(new_array)
    with pytest.raises(DeviceError, match=command.decode()):
        leds.open()
    assert not leds.is_open
    new_array.fault = None
    with leds:
        assert len(leds.led_na) == 257


def test_a_silent_port_is_an_error_in_words(
    new_array: IlluminateEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(IlluminateLedArray, "reply_s", 0.1)
    new_array.silent = True
    with pytest.raises(DeviceTimeoutError, match="Check its power, cable and baud rate"):
        driver_of(new_array).open()


def test_unplugged_and_plugged_in_again(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    leds.set_brightness(128)
    leds.set_objective_na(0.4)
    leds.sequencer.set_output(0, 77)
    leds.sequencer.load([leds.single(1)])
    leds.set_pattern(leds.single(3))
    array.unplug()
    with pytest.raises(DeviceError, match=r"led_array \(illuminate, .*was lost.*Check its cable"):
        repeat(lambda: leds.set_pattern(leds.single(4)))
    assert not leds.is_open
    with pytest.raises(DeviceError, match="there is no port"):
        leds.open()
    array.plug_in()
    leds.open()
    assert leds.pattern.is_dark
    assert leds.settings()["brightness"] == 128
    assert (array.na, array.widths_us[0], array.sequence) == (0.4, 77, [(1,)])
    leds.set_pattern(leds.single(3))
    assert array.lit[3].tolist() == [128] * 3


def test_closing_a_lost_array_is_no_error(array: IlluminateEmulator, leds: IlluminateLedArray) -> None:
    array.unplug()
    with pytest.raises(DeviceError):
        repeat(leds.settings)
    leds.close()
    array.plug_in()
