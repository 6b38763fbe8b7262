"""The Zaber driver over an emulated chain, and the emulator under Zaber's own client."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.device import FoundDevice
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.stage import StageAxis
from drivers.testing.stage import StageContract
from drivers.zaber.protocol import Message, command, flag_words, parse
from drivers.zaber.stage import Chain, ZaberAxis, ZaberOptions, ZaberStage
from tests.mocks.pty_device import Answer
from tests.mocks.zaber_chain import ZaberChain

MICROSTEP_UM = 0.5
AXES = {
    "x_um": ZaberAxis(device=1, axis=1, microstep_um=MICROSTEP_UM),
    "z_um": ZaberAxis(device=2, axis=1, microstep_um=MICROSTEP_UM, reverse=True, lower_limit=-4000.0),
    "pitch_mrad": ZaberAxis(device=1, axis=2, microstep_deg=0.001),
}


@pytest.fixture
def chain(tmp_path: Path) -> Iterator[ZaberChain]:
    chain = ZaberChain(tmp_path)
    yield chain
    chain.close()


def stage_on(chain: ZaberChain, **options: object) -> ZaberStage:
    table = {"port": str(chain.port.link), "axes": AXES} | options
    return ZaberStage(ZaberOptions.model_validate(table))


@pytest.fixture
def stage(chain: ZaberChain) -> Iterator[ZaberStage]:
    with stage_on(chain) as stage:
        stage.home()
        yield stage


class TestZaberStage(StageContract):
    @pytest.fixture(autouse=True)
    def _chain(self, chain: ZaberChain) -> None:
        self.chain = chain

    def make(self) -> ZaberStage:
        return stage_on(self.chain)


# What the protocol is -----------------------------------------------------------------------------------
def test_commands_carry_the_manuals_checksum() -> None:
    # The sum of all bytes between "/" and ":", and of the checksum, is zero modulo 256.
    sent = command("tools echo", 1, 0)
    assert sent.startswith(b"/1 0 tools echo:")
    assert (sum(sent[1:-4]) + int(sent[-3:-1], 16)) % 256 == 0
    assert command("move abs 1000", 1, 2, 5).startswith(b"/1 2 05 move abs 1000:")


@pytest.mark.parametrize(
    ("line", "message"),
    [
        (b"@01 2 05 OK BUSY -- 0", Message("@", 1, 2, 5, True, True, "--", "0")),
        (b"@12 0 RJ IDLE WR BADDATA", Message("@", 12, 0, None, False, False, "WR", "BADDATA")),
        (b"!03 1 IDLE FS", Message("!", 3, 1, None, False, False, "FS", "")),
        (b"#01 0 Visit www.zaber.com", Message("#", 1, 0, None, False, False, "--", "Visit www.zaber.com")),
        (b"@01 1 07 OK IDLE -- -250:87", None),
        (b"@01 1 07 OK IDLE", None),
        (b"\xff\x00garbage", None),
        (b"", None),
    ],
)
def test_messages_are_read_or_refused(line: bytes, message: Message | None) -> None:
    assert parse(line) == message


@given(st.binary(max_size=100))
def test_garbage_is_never_a_message(line: bytes) -> None:
    message = parse(line, need_checksum=True)
    assert message is None or line[:1] in b"@#!"


@given(place=st.integers(-(2**31), 2**31), damage=st.integers(0, 10_000), byte=st.integers(0, 255))
def test_a_damaged_reply_never_gives_another_position(place: int, damage: int, byte: int) -> None:
    body = f"@01 1 07 OK IDLE -- {place}".encode()
    whole = body + b":%02X" % (-sum(body[1:]) & 0xFF)
    at = damage % len(whole)
    for damaged in (whole[:at], whole[:at] + bytes([byte]) + whole[at + 1 :], whole[at:]):
        message = parse(damaged, need_checksum=True)
        if message is not None and message.kind == "@" and message.number == 7:
            assert (message.device, message.axis, message.data) == (1, 1, str(place))


def test_flags_are_said_in_words() -> None:
    assert flag_words("FS") == "stalled and stopped (FS)"
    assert flag_words("XY") == "unknown warning (XY)"


# What the driver does -----------------------------------------------------------------------------------
def test_identity_names_every_device(stage: ZaberStage) -> None:
    assert stage.identity.model == "device 50419 + 50081"
    assert stage.identity.serial_number == "123456 + 777"
    assert not stage.identity.simulated
    assert (stage.identity.kind, stage.identity.vendor) == ("stage", "Zaber")


def test_limits_are_the_devices_narrowed_and_reversed(stage: ZaberStage) -> None:
    assert stage.limits["x_um"] == (0.0, 6000.0)
    assert stage.limits["z_um"] == (-4000.0, 1500.0)  # -3000 to 9000 microsteps against the direction
    assert stage.limits["pitch_mrad"] == pytest.approx((0.0, 209.4395))


def test_an_axis_rests_within_a_microstep_or_what_a_direct_drive_needs(stage: ZaberStage) -> None:
    assert [axis.resolution for axis in stage.axes] == pytest.approx([0.5, 0.5, 0.0174533], rel=1e-5)
    for name, resolution, tolerance in (
        ("x_um", 0.5, 1.0),
        ("x_um", 50.0, 50.5),
        ("pitch_mrad", 0.001, 0.02),
        ("pitch_mrad", 1.0, 1.01),
    ):
        assert stage._tolerance(StageAxis(name, 0.0, 1.0, 1.0, resolution)) == pytest.approx(tolerance)


def test_an_axis_without_the_size_of_its_microstep_is_no_axis() -> None:
    for name in ("x_um", "yaw_mrad"):
        with pytest.raises(ValueError, match="is no scale"):
            ZaberAxis(device=1).axis_map(name)
        with pytest.raises(ValueError, match="is no scale"):
            ZaberAxis(device=1, reverse=True).axis_map(name)
    assert ZaberAxis(microstep_um=0.25, reverse=True).axis_map("x_um").scale == -0.25


def test_what_is_no_number_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    stage = ZaberStage(ZaberOptions(port="none", axes={"x_um": ZaberAxis(microstep_um=1.0)}))
    reply = Message("@", 1, 1, 5, True, False, "--", "1O")
    monkeypatch.setattr(stage._chain, "_ask_once", lambda *_: reply)
    with pytest.raises(DeviceError, match="device 1 axis 1 says it is at '1O'"):
        stage._state()
    with pytest.raises(DeviceError, match="answers '1O' to 'get maxspeed'; a number is expected"):
        stage._chain.number("get maxspeed", 1)


def test_a_silent_device_is_asked_three_times(monkeypatch: pytest.MonkeyPatch) -> None:
    chain, asked = Chain("none", "stage (test)", 115_200), []

    def silent(*words: object) -> Message:
        asked.append(words)
        raise DeviceTimeoutError("stage (test)", "silence")

    monkeypatch.setattr(chain, "_ask_once", silent)
    with pytest.raises(DeviceTimeoutError, match="device 1 did not answer 'get pos' on none"):
        chain.ask("get pos", 1)
    assert asked == [("get pos", 1, 0, number) for number in range(3)]


def test_zabers_are_discovered_by_who_made_them_and_probed_at_their_speed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ports = [
        FoundDevice("serial", f"/dev/ttyUSB{n}", "port", vendor=who)
        for n, who in enumerate(("Zaber", "FTDI"))
    ]
    monkeypatch.setattr("drivers.zaber.stage.serial_ports", lambda: ports)
    assert [found.address for found in ZaberStage.discover()] == ["/dev/ttyUSB0"]
    opened: list[int] = []
    monkeypatch.setattr(Chain, "open", lambda self: opened.append(self._baud_rate))
    monkeypatch.setattr(Chain, "number", lambda *_: 50419.0)
    assert ZaberStage.probe("none") is not None
    assert opened == [115_200]


@pytest.mark.usefixtures("stage")
def test_homing_clears_the_warnings_of_each_axis_first(chain: ZaberChain) -> None:
    for place in (b"/1 1 ", b"/1 2 ", b"/2 1 "):
        told = [line for line in chain.port.received if line.startswith(place)]
        assert [b"home" in line for line in told if b"home" in line or b"warnings clear" in line] == [
            False,
            True,
        ]


def test_what_a_rejection_says_and_that_it_is_of_this_port(monkeypatch: pytest.MonkeyPatch) -> None:
    chain = Chain("none", "stage (test)", 115_200)
    told = {
        "--": r"is out of its range \(BADDATA 7\)\.$",
        "FS": r"\(BADDATA 7\); stalled and stopped \(FS\)\.$",
    }
    for flag, words in told.items():
        reply = Message("@", 1, 2, 5, False, False, flag, "BADDATA 7")
        monkeypatch.setattr(chain, "_ask_once", lambda *_, reply=reply: reply)
        with pytest.raises(DeviceError, match=f"device 1 axis 2 rejects 'move abs 9': .*{words}"):
            chain.ask("move abs 9", 1, 2)
    chain._checksummed.add(1)
    with pytest.raises(DeviceError, match="no port"):
        chain.open()
    assert not chain._checksummed  # whatever is plugged in now was told nothing yet


def test_microsteps_are_exact(stage: ZaberStage, chain: ZaberChain) -> None:
    stage.move_to({"x_um": 1234.5, "z_um": -1000.26})
    assert chain.devices[1].axes[0].place == 2469
    assert chain.devices[2].axes[0].place == 2001
    assert stage.position()["z_um"] == -1000.5


def test_axes_of_several_devices_move_together(stage: ZaberStage, chain: ZaberChain) -> None:
    axes = [*chain.devices[1].axes, *chain.devices[2].axes]
    for axis in axes:
        axis.halt()  # it stands there whatever its speed was
        axis.speed_per_s = 600.0  # none arrives before it is looked at, however busy the machine
    stage.move_to({"x_um": 6000.0, "z_um": -4000.0, "pitch_mrad": 200.0}, wait=False)
    assert [axis.moving for axis in axes] == [True, True, True]
    stage.stop()
    assert [axis.moving for axis in axes] == [False, False, False]


def test_speed_is_set_once_and_read_back(chain: ZaberChain) -> None:
    axes = AXES | {"x_um": AXES["x_um"].model_copy(update={"speed_per_s": 5000.0})}
    for _ in range(2):
        with stage_on(chain, axes=axes) as stage:
            assert stage.axes[0].speed_per_s == pytest.approx(5000.0, rel=1e-3)
    assert sum(b"set maxspeed" in line for line in chain.port.received) == 1


def test_a_speed_that_is_refused_names_its_key(chain: ZaberChain) -> None:
    axes = AXES | {"x_um": AXES["x_um"].model_copy(update={"speed_per_s": 1e9})}
    with pytest.raises(DeviceError, match="value is out of its range") as caught:
        stage_on(chain, axes=axes).open()
    assert "[stage.axes.x_um]" in "".join(caught.value.__notes__)


def test_a_stall_ends_the_move_in_words_and_wants_homing(stage: ZaberStage, chain: ZaberChain) -> None:
    stage.move_to({"x_um": 6000.0, "z_um": -4000.0}, wait=False)
    chain.stall(1, 1)
    with pytest.raises(DeviceError, match=r"x_um \(device 1 axis 1\): stalled and stopped \(FS\)"):
        stage.wait(10.0)
    stage.stop()
    assert not chain.devices[2].axes[0].moving
    with pytest.raises(DeviceError, match="stalled and stopped"):
        stage.move_to({"x_um": 0.0})
    assert not stage.is_homed
    stage.home()
    stage.move_to({"x_um": 10.0})


def test_a_stall_of_before_is_said_on_opening(chain: ZaberChain, caplog: pytest.LogCaptureFixture) -> None:
    chain.devices[1].axes[0].homed = True
    chain.stall(1, 1)
    with caplog.at_level(logging.WARNING), stage_on(chain) as stage:
        assert not stage.is_homed
        assert stage.settings()["faults"] == ("x_um (device 1 axis 1): stalled and stopped (FS)",)
    assert "stalled and stopped (FS)" in caplog.text


def test_a_fault_that_lasts_refuses_moves(stage: ZaberStage, chain: ZaberChain) -> None:
    chain.devices[2].flags[0].add("FD")
    with pytest.raises(DeviceError, match=r"z_um \(device 2 axis 1\): driver disabled by a fault \(FD\)"):
        stage.move_to({"x_um": 10.0})


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait half as long for replies as one would for real devices."""
    monkeypatch.setattr("drivers.zaber.stage._REPLY_S", 0.25)


def late(seconds: float) -> Callable[[bytes], list[Answer]]:
    return lambda reply: [seconds, reply]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda reply: [],
        lambda reply: [b"\xff\xfe\x80\r\n"],
        lambda reply: [reply[:-7] + b"\r\n"],  # the last digits and the checksum are lost
        lambda reply: [reply[:9] + b"X" + reply[10:]],
        lambda reply: [reply.split(b":")[0][:-1] + b"\r\n"],
        late(0.4),
    ],
    ids=["silence", "garbage", "torn", "garbled", "without checksum", "late"],
)
@pytest.mark.usefixtures("impatient")
def test_damaged_replies_are_asked_for_again(
    stage: ZaberStage, chain: ZaberChain, spoil: Callable[[bytes], list[Answer]]
) -> None:
    stage.move_to({"x_um": 600.0})
    chain.spoil.append(spoil)
    assert stage.position()["x_um"] == 600.0
    assert stage.move_to({"x_um": 700.0})["x_um"] == 700.0


@pytest.mark.usefixtures("impatient")
def test_a_late_reply_is_not_taken_for_the_answer_to_the_next_question(
    stage: ZaberStage, chain: ZaberChain
) -> None:
    def answer_late_and_move(reply: bytes) -> list[Answer]:
        chain.devices[1].axes[0].set_place(998)
        return [0.4, reply]

    chain.spoil.append(answer_late_and_move)
    assert stage.position()["x_um"] == 499.0


@pytest.mark.usefixtures("impatient")
def test_silence_names_the_device_that_is_silent(stage: ZaberStage, chain: ZaberChain) -> None:
    del chain.devices[2]
    with pytest.raises(DeviceTimeoutError, match=r"device 2 did not answer 'get pos'"):
        stage.position()
    chain.devices[2] = chain.devices[1]


def test_alerts_are_no_replies(stage: ZaberStage, chain: ZaberChain) -> None:
    for _ in range(20):
        chain.alert(1, 1)
        assert stage.position()["x_um"] == 0.0


def test_a_fault_that_is_told_unasked_is_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    chain = Chain("none", "stage (test)", 115_200)
    with caplog.at_level(logging.DEBUG):
        chain._unasked(b"!01 1 IDLE FS")
        chain._unasked(b"!01 1 IDLE WR")
        chain._unasked(b"!01 1 IDLE --")
        chain._unasked(b"garbage")
    assert [(r.levelno, r.args[-1]) for r in caplog.records] == [  # type: ignore[index]
        (logging.WARNING, flag_words("FS")),
        (logging.INFO, flag_words("WR")),
        (logging.INFO, b"garbage"),
    ]


def test_checksums_are_put_back(chain: ZaberChain) -> None:
    chain.devices[2].settings["comm.checksum"] = "1"
    with stage_on(chain):
        assert chain.devices[1].settings["comm.checksum"] == "1"
    assert chain.devices[1].settings["comm.checksum"] == "0"
    assert chain.devices[2].settings["comm.checksum"] == "1"
    with (stage := stage_on(chain)):
        pass
    chain.devices[1].settings["comm.checksum"] = "1"  # as somebody else wants it since
    with stage:
        pass
    assert chain.devices[1].settings["comm.checksum"] == "1"


def test_checksums_are_put_back_after_a_reconnection_too(chain: ZaberChain) -> None:
    stage = stage_on(chain)
    stage.open()
    chain.port.unplug()
    while stage.is_open:
        time.sleep(0.005)
    chain.port.plug_in()
    stage.open()
    stage.close()
    assert {device.settings["comm.checksum"] for device in chain.devices.values()} == {"0"}


def test_checksums_are_put_back_when_another_device_is_missing(chain: ZaberChain) -> None:
    del chain.devices[2]
    with pytest.raises(DeviceTimeoutError, match="device 2 did not answer"):
        stage_on(chain).open()
    assert chain.devices[1].settings["comm.checksum"] == "0"


def test_unplugged_and_plugged_in_again(stage: ZaberStage, chain: ZaberChain) -> None:
    stage.move_to({"x_um": 6000.0}, wait=False)
    chain.port.unplug()
    with pytest.raises(DeviceError, match="zaber"):
        stage.wait(10.0)
    assert not stage.is_open
    with pytest.raises(DeviceError, match="no port"):
        stage.open()
    chain.port.plug_in()
    stage.open()
    assert chain.devices[1].settings["comm.checksum"] == "1"
    stage.home()
    assert stage.move_to({"x_um": 50.0})["x_um"] == 50.0


def test_stop_gets_through_while_a_reply_is_awaited(stage: ZaberStage, chain: ZaberChain) -> None:
    outcome: list[BaseException] = []

    def move() -> None:
        try:
            stage.move_to({"x_um": 6000.0})
        except StoppedError as error:
            outcome.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    while not chain.devices[1].axes[0].moving:
        time.sleep(0.001)
    chain.spoil.append(lambda reply: [])  # a poll stays without an answer
    stage.stop()
    mover.join(10.0)
    assert isinstance(outcome[0], StoppedError)
    assert chain.devices[1].axes[0].place < 12_000


def test_a_port_of_nobody_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(DeviceError, match="there is no port"):
        ZaberStage(ZaberOptions(port=str(tmp_path / "ttyNONE"), axes=AXES)).open()


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"x_um": {"device": 1}}, "axes.x_um needs microstep_um"),
        ({"yaw_mrad": {"microstep_um": 1.0}}, "axes.yaw_mrad needs microstep_deg .* and not microstep_um"),
        ({"x_um": {"microstep_um": 1.0}, "y_um": {"microstep_um": 1.0}}, "are both device 1 axis 1"),
        ({}, "at least 1 item"),
        ({"q_um": {"microstep_um": 1.0}}, "must be an axis of the bench"),
    ],
)
def test_options_that_make_no_sense(axes: object, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        ZaberOptions.model_validate({"port": "/dev/ttyUSB0", "axes": axes})


@pytest.mark.usefixtures("impatient")
def test_probe_recognises_a_chain(chain: ZaberChain) -> None:
    found = ZaberStage.probe(str(chain.port.link))
    assert found is not None
    assert (found.driver, found.kind, found.description) == ("zaber", "stage", "Zaber device 50419")
    assert found.options["axes"] == {"x_um": {"device": 1, "axis": 1, "microstep_um": 0.0}}
    assert "microstep_um = 0.0" in found.bench_lines()
    chain.devices.clear()
    assert ZaberStage.probe(str(chain.port.link)) is None


# The emulator under Zaber's own client ------------------------------------------------------------------
def test_zabers_own_client_finds_the_emulator_right(chain: ZaberChain) -> None:
    zaber = pytest.importorskip("zaber_motion.ascii", reason="zaber-motion is not installed (dev extra)")
    with zaber.Connection.open_serial_port(str(chain.port.link)) as connection:
        connection.checksum_enabled = True
        devices = connection.detect_devices(identify_devices=False)
        assert [device.device_address for device in devices] == [1, 2]
        axis = devices[0].get_axis(1)
        assert not axis.is_homed()
        assert axis.warnings.get_flags() == {"WR"}
        axis.home()
        assert axis.is_homed()
        axis.move_absolute(1500)
        assert axis.get_position() == 1500
        axis.move_relative(-500)
        assert axis.get_position() == chain.devices[1].axes[0].place == 1000
        axis.move_absolute(12_000, wait_until_idle=False)
        assert axis.is_busy()
        axis.stop()
        assert 1000 < axis.get_position() < 12_000
        with pytest.raises(Exception, match="BADDATA"):
            axis.move_absolute(1_000_000)
        axis.settings.set("maxspeed", 16384)
        assert axis.settings.get("maxspeed") == 16384
        chain.stall(1, 1)
        with pytest.raises(Exception, match="FS"):
            axis.wait_until_idle()
