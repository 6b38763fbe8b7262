"""The DLPC900 driver against an emulator that decodes its packets and images back to pixels."""

from __future__ import annotations

import contextlib
import re
import sys
import threading
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from pydantic import ValidationError

from drivers.device import Device
from drivers.dlpc900 import commands, link
from drivers.dlpc900.commands import Board, Command, encode, image_of
from drivers.dlpc900.link import parse_reply, reports
from drivers.dlpc900.slm import Dlpc900Options, Dlpc900Slm
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.testing.slm import SlmContract
from tests.mocks.dlpc900_device import BadImageError, Dlpc900Emulator, FakeHidraw, decode_image
from tests.mocks.waiting import until

SMALL = (24, 40)


@pytest.fixture(autouse=True)
def board(monkeypatch: pytest.MonkeyPatch) -> Dlpc900Emulator:
    """A DLP6500 with few mirrors, plugged in."""
    monkeypatch.setattr(commands, "BOARDS", {1: Board("DLP6500", SMALL, 7.56, 1)})
    monkeypatch.setattr(link, "_ANSWER_S", 0.3)
    emulator = Dlpc900Emulator(shape=SMALL)
    plug_in(monkeypatch, emulator)
    return emulator


def plug_in(monkeypatch: pytest.MonkeyPatch, *emulators: Dlpc900Emulator) -> None:
    monkeypatch.setitem(sys.modules, "hidraw", FakeHidraw(*emulators))


def slm(**changes: Any) -> Dlpc900Slm:
    return Dlpc900Slm(Dlpc900Options(**{"settle_ms": 0} | changes))


def pattern(seed: int = 0, shape: tuple[int, int] = SMALL) -> np.ndarray:
    """Smooth in places, noisy in others, with repeated lines."""
    rng = np.random.default_rng(seed)
    levels = rng.integers(0, 256, shape, dtype=np.uint8)
    levels[3:9] = levels[2]
    levels[:, shape[1] // 2 :] = rng.integers(0, 256, (shape[0], 1), dtype=np.uint8)
    return levels


class TestDlpc900(SlmContract):
    def make(self) -> Device:
        return slm()


# Images ------------------------------------------------------------------------------------------------
IMAGES = hnp.arrays(
    np.uint8,
    st.tuples(st.integers(1, 7), st.integers(1, 40)),
    elements=st.sampled_from([0, 1, 2, 255]) | st.integers(0, 255),
)


@given(IMAGES, st.sampled_from(["none", "rle", "enhanced_rle", "auto"]))
def test_every_image_comes_back_exactly(levels: np.ndarray, compression: str) -> None:
    decoded = decode_image(encode(image_of([levels], 8), compression))
    np.testing.assert_array_equal(decoded, np.repeat(levels[..., None], 3, axis=2))
    shifted = image_of([levels, levels[::-1], levels[:, ::-1]], 8)
    decoded = decode_image(encode(shifted, compression))
    np.testing.assert_array_equal(decoded, np.stack([levels[:, ::-1], levels[::-1], levels], axis=2))


@pytest.mark.parametrize("compression", ["none", "rle", "enhanced_rle"])
def test_long_runs_and_long_literals_come_back_exactly(compression: str) -> None:
    rng = np.random.default_rng(1)
    levels = np.zeros((6, 2560), np.uint8)
    levels[1] = rng.integers(0, 256, 2560)
    levels[2] = levels[1]
    levels[3, 100:2000] = 7
    levels[4] = np.arange(2560) % 255
    levels[5, ::256] = 9
    np.testing.assert_array_equal(decode_image(encode(image_of([levels], 8), compression))[..., 1], levels)


def test_the_guides_examples_of_compressed_data_are_decoded() -> None:
    """Tables 2-111 and 2-113 without their typing errors; holds the emulator to the document."""
    header = encode(np.zeros((2, 13), np.uint32), "rle")[:48]
    line = "03 040506 05 777777 00 03 040506 070809 0A0B0C 02 789ABC 00 00 000000"
    data = bytes.fromhex(f"{line} 07 1D1E1F 06 212223 00 01")
    assert len(data.split(b"\x00\x00", 1)[0]) == 25 - 2
    data += bytes(-len(data) % 4)
    decoded = decode_image(header[:8] + len(data).to_bytes(4, "little") + header[12:] + data)
    assert decoded[0, :3].tolist() == [[4, 5, 6]] * 3
    assert decoded[0, 8:11].tolist() == [[4, 5, 6], [7, 8, 9], [10, 11, 12]]
    assert decoded[1].tolist() == [[0x1D, 0x1E, 0x1F]] * 7 + [[0x21, 0x22, 0x23]] * 6


def test_a_blank_full_size_image_is_small_and_noise_no_larger_than_uncompressed() -> None:
    assert len(encode(np.zeros((1080, 1920), np.uint32))) < 10_000
    noise = np.random.default_rng(0).integers(0, 256, (64, 1920), dtype=np.uint8)
    assert len(encode(image_of([noise], 8))) <= 48 + 3 * noise.size


@given(st.binary(max_size=80))
def test_the_emulator_refuses_arbitrary_bytes_in_words(data: bytes) -> None:
    header = encode(np.zeros((2, 3), np.uint8), "enhanced_rle")[:48]
    body = data + bytes(-len(data) % 4)
    image = header[:8] + len(body).to_bytes(4, "little") + header[12:] + body
    with contextlib.suppress(BadImageError):
        assert decode_image(image).shape == (2, 3, 3)


# Packets -----------------------------------------------------------------------------------------------
def test_the_guides_examples_of_packets() -> None:
    """Tables 1-5 and 1-7, less the report number, with a reply asked for to the write."""
    (read,) = reports(0x1100, b"", 0x11, read=True)
    assert read == bytes.fromhex("C0 11 0200 0011").ljust(64, b"\0")
    (write,) = reports(0x1100, bytes.fromhex("FF01FF01FF01"), 0x12, read=False)
    assert write == bytes.fromhex("40 12 0800 0011 FF01FF01FF01").ljust(64, b"\0")
    reply = parse_reply(bytes.fromhex("C0 11 0600 FF01FF01FF01").ljust(64, b"\0"))
    assert reply is not None
    assert (reply.sequence, reply.refused, reply.data.hex()) == (0x11, False, "ff01ff01ff01")


@given(st.binary(max_size=600), st.integers(0, 255))
def test_messages_are_cut_into_full_reports(data: bytes, sequence: int) -> None:
    cut = list(reports(0x1A2B, data, sequence, read=False))
    assert all(len(report) == 64 for report in cut)
    joined = b"".join(cut)
    assert joined[6 : 6 + len(data)] == data
    assert int.from_bytes(joined[2:4], "little") == len(data) + 2
    assert len(cut) == -(-(6 + len(data)) // 64)


@given(st.binary(max_size=64))
def test_arbitrary_bytes_are_a_reply_or_none(report: bytes) -> None:
    reply = parse_reply(report)
    assert reply is None or len(reply.data) <= 60


# Showing -----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("compression", ["auto", "none", "rle", "enhanced_rle"])
def test_the_mirrors_show_the_levels_exactly(board: Dlpc900Emulator, compression: str) -> None:
    with slm(compression=compression) as device:
        assert board.shown is not None
        assert not board.shown.any()
        for seed in range(3):
            device.display(pattern(seed))
            np.testing.assert_array_equal(board.shown, pattern(seed))
    assert board.shown is None


def test_two_controllers_show_their_halves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands, "BOARDS", {2: Board("DLP9000", (16, 64), 7.56, 2)})
    emulator = Dlpc900Emulator(board=2, shape=(16, 64))
    plug_in(monkeypatch, emulator)
    with slm() as device:
        device.display(pattern(5, (16, 64)))
        np.testing.assert_array_equal(emulator.shown, pattern(5, (16, 64)))
        assert "DLP9000" in device.identity.model


def test_full_size_boards_have_the_guides_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    for number, shape in ((1, (1080, 1920)), (2, (1600, 2560))):
        emulator = Dlpc900Emulator(board=number)
        plug_in(monkeypatch, emulator)
        with slm() as device:
            assert device.shape == shape == emulator.shape
            levels = np.zeros(shape, np.uint8)
            levels[::7, 100:900] = 200
            device.display(levels)
            np.testing.assert_array_equal(emulator.shown, levels)


def test_binary_patterns_are_binary(board: Dlpc900Emulator) -> None:
    with slm(bit_depth=1, exposure_us=105, led="green", dark_us=20) as device:
        binary = np.where(pattern() > 127, 255, 0).astype(np.uint8)
        device.display(binary)
        np.testing.assert_array_equal(board.shown, binary)
        expected = {"bit_depth": 1, "exposure_us": 105, "dark_us": 20, "led": 2, "trigger": 0}
        assert {key: board.pattern[key] for key in expected} == expected
        with pytest.raises(LimitError, match="bit_depth = 8"):
            device.display(pattern())
        np.testing.assert_array_equal(device.displayed, binary)


@pytest.mark.parametrize(("depth", "count", "period_ms"), [(1, 51, 0.15), (8, 5, 6.0)])
@pytest.mark.parametrize("controllers", [1, 2])
def test_a_sequence_is_played_in_order_and_what_was_shown_comes_back(
    monkeypatch: pytest.MonkeyPatch, depth: int, count: int, period_ms: float, controllers: int
) -> None:
    monkeypatch.setattr(commands, "BOARDS", {controllers: Board("a board", SMALL, 7.56, controllers)})
    board = Dlpc900Emulator(board=controllers, shape=SMALL)
    plug_in(monkeypatch, board)
    rng = np.random.default_rng(0)
    patterns = [rng.integers(0, 256, SMALL, dtype=np.uint8) for _ in range(count)]
    if depth == 1:
        patterns = [np.where(levels > 127, 255, 0).astype(np.uint8) for levels in patterns]
    with slm(bit_depth=depth, dark_us=20, exposure_us=5000) as device:
        assert device.arm(patterns, period_ms, output=1) == pytest.approx(period_ms)
        assert board.shown is None
        board.commands.clear()
        device.play()
        device.play()
        assert 0x1A2B not in board.commands  # blank before, so nothing is uploaded again
        np.testing.assert_array_equal(board.played, patterns)
        assert (board.pattern["exposure_us"], board.pattern["no_trigger_2"]) == (1000 * period_ms - 20, 0)
        device.display(patterns[0])
        device.play()
        np.testing.assert_array_equal(board.played, patterns)
        np.testing.assert_array_equal(device.displayed, patterns[0])
        np.testing.assert_array_equal(board.shown, patterns[0])
        board.faults.never_ends = True
        device.arm(patterns[:2], 15_000.0)  # blanked long before it would end
        assert board.pattern["no_trigger_2"] == 1
        ended: list[bool] = []

        def play() -> None:
            with contextlib.suppress(StoppedError):
                device.play()
                return
            ended.append(True)

        player = threading.Thread(target=play)
        player.start()
        assert until(lambda: board.commands[-1] == Command.START_STOP)
        device.blank()
        player.join(5)
        assert ended == [True]
        assert board.shown is not None
        assert not board.shown.any()


def test_a_sequence_that_does_not_end_is_an_error(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.dlpc900.slm._START_S", 0.1)
    with slm() as device:
        device.arm([pattern(), pattern(1)], 5.0)
        board.faults.never_ends = True
        with pytest.raises(DeviceTimeoutError, match=r"did not end its sequence of 0\.01 s"):
            device.play()
        with pytest.raises(LimitError, match="1 to 50"):
            device.arm([pattern()] * 51, 5.0)


def test_the_messages_of_a_sequence_are_those_of_a_published_client(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Pycrafter6500's payloads for 26 patterns of 1 bit, 1000 and 50 us, shown once.

    It has patterns cleared after their exposure (bit 0 of the flags), which this driver leaves.
    """
    sent: list[tuple[int, bytes]] = []
    with slm(bit_depth=1, dark_us=50) as device:
        write = device._link.write
        monkeypatch.setattr(device._link, "write", lambda c, d: (sent.append((c, d)), write(c, d)))
        device.arm([np.zeros(SMALL, np.uint8)] * 26, 1.05)
    wanted = {
        0: "0000e8030071320000010000",
        1: "0100e8030071320000010008",
        23: "1700e80300713200000100b8",
        24: "1800e8030071320000010100",
        25: "1900e8030071320000010108",
    }
    defined = [data for command, data in sent if command == Command.PATTERN_DEFINITION]
    for number, payload in wanted.items():
        expected = bytearray.fromhex(payload)
        expected[5] &= 0xFE
        assert defined[number] == expected
    rest = [data.hex() for command, data in sent if command == Command.PATTERN_CONFIGURATION]
    assert rest == ["1a001a000000"]
    images = [data[:2].hex() for command, data in sent if command == Command.INITIALISE_PRIMARY_IMAGE]
    assert images == ["0100", "0000"]  # the last image first


def test_a_stopped_pattern_starts_again_without_another_upload(board: Dlpc900Emulator) -> None:
    with slm() as device:
        with pytest.raises(DeviceError, match="no stopped pattern"):
            device.start()
        device.display(pattern())
        device.stop()
        assert board.shown is None
        assert not device.displayed.any()
        board.commands.clear()
        device.stop()
        device.start()
        np.testing.assert_array_equal(board.shown, pattern())
        np.testing.assert_array_equal(device.displayed, pattern())
        assert 0x1A2B not in board.commands
        device.display(pattern(1))
        with pytest.raises(DeviceError, match="no stopped pattern"):
            device.start()


@pytest.mark.parametrize(
    ("given", "text"),
    [
        ({"bit_depth": 1, "exposure_us": 104}, "at least 105 with bit_depth = 1"),
        ({"bit_depth": 8, "exposure_us": 4045}, "at least 4046 with bit_depth = 8"),
        ({"exposure_us": 2**24}, "less than or equal to 16777215"),
        ({"bit_depth": 4}, "1 or 8"),
    ],
)
def test_times_outside_the_controllers_are_refused(given: dict[str, Any], text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        Dlpc900Options(**given)


def test_identity_and_status_are_the_controllers(board: Dlpc900Emulator) -> None:
    with slm() as device:
        assert str(device.identity) == (
            "Texas Instruments DLPC900 with DLP6500, serial LCR1, firmware 6.1.2 emulated board"
        )
        assert device.settings()["status"] == "DMD active, sequencer runs"
        assert device.settings()["mode"] == "pattern on the fly"
        board.running = False
        assert device.settings()["status"] == "DMD active, sequencer stopped"


# What goes wrong ---------------------------------------------------------------------------------------
def test_no_controller_several_and_a_wrong_one_are_named(
    monkeypatch: pytest.MonkeyPatch, board: Dlpc900Emulator
) -> None:
    with pytest.raises(DeviceError, match=r"no DLPC900 LCR7 .*Connected are serial numbers LCR1"):
        slm(serial_number="LCR7").open()
    plug_in(monkeypatch, board, Dlpc900Emulator(shape=SMALL, serial="LCR2"))
    with pytest.raises(DeviceError, match=r"several DLPC900 .*LCR1, LCR2.*serial_number"):
        slm().open()
    with slm(serial_number="LCR2") as device:
        assert device.identity.serial_number == "LCR2"
    plug_in(monkeypatch)
    with pytest.raises(DeviceError, match=r"no DLPC900 .*0451:c900.* is connected"):
        slm().open()


def test_a_device_file_without_permission_names_the_udev_rule(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError("open failed")

    monkeypatch.setattr("tests.mocks.dlpc900_device.FakeHidDevice.open_path", refuse)
    device = slm()
    with pytest.raises(DeviceError, match=r"/dev/hidraw0 cannot be opened .*udev rule"):
        device.open()
    assert not device.is_open


@pytest.mark.parametrize(
    ("status", "text"),
    [(0x00, "initialisation failed"), (0x03, "firmware is for another board"), (0x81, "sequencer detected")],
)
def test_faulty_hardware_is_refused_in_words(board: Dlpc900Emulator, status: int, text: str) -> None:
    board.faults.hardware_status = status
    device = slm()
    with pytest.raises(DeviceError, match=text):
        device.open()
    assert not device.is_open


def test_a_missing_secondary_controller_is_named() -> None:
    assert commands.hardware_faults(0x11, 2) == ()
    assert "secondary controller" in commands.hardware_faults(0x01, 2)[0]


def test_another_board_is_refused_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    plug_in(monkeypatch, Dlpc900Emulator(board=4))
    with pytest.raises(DeviceError, match=r"drives a DLP500YX.*knows DLP6500"):
        slm().open()


@pytest.mark.parametrize(("code", "text"), [(14, "exposure time out of range"), (77, "does not define")])
def test_a_refused_command_is_named_with_the_reason(board: Dlpc900Emulator, code: int, text: str) -> None:
    with slm() as device:
        board.faults.refuse[0x1A34] = code
        with pytest.raises(
            DeviceError, match=rf"refused pattern definition \(0x1A34\): .*{text}.*error {code}"
        ):
            device.display(pattern())
        with pytest.raises(DeviceError, match="unknown after a failed upload"):
            _ = device.displayed
        board.faults.refuse.clear()
        device.display(pattern())
        np.testing.assert_array_equal(board.shown, pattern())


def test_a_sequence_that_does_not_start_is_an_error(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.dlpc900.slm._START_S", 0.1)
    with slm() as device:
        board.faults.never_starts = True
        with pytest.raises(DeviceTimeoutError, match="did not start its sequence"):
            device.blank()


def test_a_controller_that_stays_in_its_mode_is_an_error(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.dlpc900.slm._START_S", 0.1)
    board.faults.stays_in_mode = True
    device = slm()
    with pytest.raises(DeviceError, match="stays in pre-stored pattern mode"):
        device.open()
    assert not device.is_open


def test_silence_is_an_error_and_later_commands_get_their_own_replies(board: Dlpc900Emulator) -> None:
    with slm() as device:
        board.faults.silent = True
        with pytest.raises(DeviceTimeoutError, match="did not answer start stop"):
            device.blank()
        board.faults.silent = False
        board.faults.late = True
        with pytest.raises(DeviceTimeoutError):
            device._link.read(Command.ERROR_CODE, 1)  # 0
        board.faults.late = False
        assert device._link.read(Command.DISPLAY_MODE, 1) == b"\x03"
        device.display(pattern())
        np.testing.assert_array_equal(board.shown, pattern())


@settings(max_examples=30, deadline=None)
@given(st.binary(max_size=64))
def test_garbage_before_replies_changes_nothing_or_is_an_error(garbage: bytes) -> None:
    emulator = Dlpc900Emulator(shape=SMALL)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(link, "_ANSWER_S", 0.3)
        plug_in(monkeypatch, emulator)
        with slm() as device:
            emulator.faults.garbage = garbage
            try:
                device.display(pattern())
            except DeviceError:
                return  # it looked like a reply to this very command
            finally:
                emulator.faults.garbage = None
            np.testing.assert_array_equal(device.displayed, pattern())


def test_truncated_replies_are_no_replies(board: Dlpc900Emulator) -> None:
    with slm() as device:
        board.faults.truncated = True
        with pytest.raises(DeviceTimeoutError):
            device.settings()


def test_unplugged_is_an_error_and_opening_again_shows_a_blank_pattern(board: Dlpc900Emulator) -> None:
    device = slm()
    device.open()
    device.display(pattern())
    board.faults.unplugged = True
    with pytest.raises(DeviceError, match=re.escape("slm (dlpc900): was unplugged or switched off")):
        device.display(pattern(1))
    assert not device.is_open
    with pytest.raises(DeviceError, match="no DLPC900"):
        device.open()
    board.power_cycle()
    board.faults.unplugged = False
    device.open()
    assert board.shown is not None
    assert not board.shown.any()
    device.display(pattern(1))
    np.testing.assert_array_equal(board.shown, pattern(1))
    device.close()


@pytest.mark.parametrize("end", ["close", "blank"])
def test_closing_and_blanking_end_an_upload(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch, end: str
) -> None:
    """STOP blanks the SLM: that does not wait for minutes of upload."""
    device = slm(compression="none")
    device.open()
    begun, errors = threading.Event(), []
    load = board._load

    def slow(half: int, data: bytes) -> None:
        if len(board.commands) < 40:  # of many
            begun.set()
            ending.wait(10)
        load(half, data)

    monkeypatch.setattr(board, "_load", slow)
    ending = threading.Event()
    board.commands.clear()

    def show() -> None:
        try:
            device.display(pattern())
        except DeviceError as error:
            errors.append(error)

    showing = threading.Thread(target=show)
    showing.start()
    assert begun.wait(10)
    stopping = threading.Thread(target=getattr(device, end))
    stopping.start()
    assert until(lambda: device._closing.is_set() or device._blanked > 0)
    ending.set()
    showing.join(10)
    stopping.join(10)
    assert isinstance(errors[0], StoppedError)
    assert board.shown is None if end == "close" else not board.shown.any()
    device.close()


def test_an_upload_that_begins_while_blanking_is_under_way_ends_too(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    with slm(compression="none") as device:
        blanking, ended = threading.Event(), threading.Event()

        def late(levels: np.ndarray, compression: str) -> bytes:
            if not levels.any():
                blanking.set()
                assert ended.wait(10)
            return encode(levels, compression)

        monkeypatch.setattr("drivers.dlpc900.slm.encode", late)
        stopping = threading.Thread(target=device.blank)
        stopping.start()
        assert blanking.wait(10)
        try:
            with pytest.raises(StoppedError):
                device.display(pattern())
        finally:
            ended.set()
            stopping.join(10)
        assert board.shown is not None
        assert not board.shown.any()
        device.display(pattern())  # afterwards all is as before
        np.testing.assert_array_equal(board.shown, pattern())


def test_ctrl_c_within_a_message_does_not_swallow_the_next_one(
    board: Dlpc900Emulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    with slm(compression="none") as device:
        device.display(pattern())
        write = device._link._hid.write
        left = [9]  # reports: within a message of image data

        def interrupted(report: bytes) -> int:
            written: int = write(report)
            left[0] -= 1
            if left[0] == 0:  # where Python raises what came during a call
                raise KeyboardInterrupt
            return written

        monkeypatch.setattr(device._link._hid, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            device.display(pattern(1))
        device.display(pattern(2))
        np.testing.assert_array_equal(board.shown, pattern(2))


def test_two_threads_may_blank_at_once(board: Dlpc900Emulator) -> None:
    with slm() as device:
        device.display(pattern())
        errors: list[BaseException] = []

        def blank() -> None:
            try:
                device.blank()
            except DeviceError as error:
                errors.append(error)

        threads = [threading.Thread(target=blank) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(10)
        assert errors == []
        assert board.shown is not None
        assert not board.shown.any()


def test_the_controller_is_discovered_with_its_lines() -> None:
    (found,) = Dlpc900Slm.discover()
    assert found.bench_lines() == '[slm]\ndriver = "dlpc900"\nserial_number = "LCR1"'
