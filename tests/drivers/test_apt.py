"""The Thorlabs driver over emulated controllers, and the emulator under other people's client."""

from __future__ import annotations

import logging
import math
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from drivers.apt import stage as apt_stage
from drivers.apt.drives import InertiaUnit
from drivers.apt.protocol import (
    CONTROLLERS,
    HW_GET_INFO,
    HW_STOP_UPDATEMSGS,
    MOT_GET_DCSTATUSUPDATE,
    PZMOT_GET_STATUSUPDATE,
    SPEED_SCALE,
    AptFramer,
    Message,
    decode,
    fault_words,
    long,
    short,
)
from drivers.apt.stage import AptOptions, AptStage
from drivers.device import FoundDevice
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.testing.stage import StageContract
from tests.mocks.apt_controller import STATUS_WITHOUT_SIGN_OF_LIFE, AptController
from tests.mocks.moving_axis import MovingAxis
from tests.mocks.pty_device import Answer

SERVO_UM = 1e3 / 34_304


@pytest.fixture
def servo(tmp_path: Path) -> Iterator[AptController]:
    controller = AptController(tmp_path / "servo", "KDC101", [MovingAxis(0, 205_824, 1_000_000, 777)])
    yield controller
    controller.close()


@pytest.fixture
def rack(tmp_path: Path) -> Iterator[AptController]:
    axes = [MovingAxis(0, 6_553_600, 2.5e7, 50_000), MovingAxis(0, 6_553_600, 2.5e7, 0)]
    controller = AptController(tmp_path / "rack", "BSC203", axes, 70_000_001)
    yield controller
    controller.close()
    assert controller.strange == []


@pytest.fixture
def inertia(tmp_path: Path) -> Iterator[AptController]:
    axes = [MovingAxis(-(2**31), 2**31, 20_000, 300 * index) for index in range(4)]
    controller = AptController(tmp_path / "inertia", "KIM101", axes, 97_000_001)
    yield controller
    controller.close()


def stage_of(**axes: dict[str, object]) -> AptStage:
    return AptStage(AptOptions.model_validate({"axes": axes}))


def servo_axis(controller: AptController, **more: object) -> dict[str, object]:
    return {"port": str(controller.port.link), "controller": "KDC101", "actuator": "Z806"} | more


def rack_axis(controller: AptController, bay: int, **more: object) -> dict[str, object]:
    place = {"port": str(controller.port.link), "controller": "BSC203", "channel": bay}
    return place | {"actuator": "DRV001"} | more


def inertia_axis(controller: AptController, channel: int, **more: object) -> dict[str, object]:
    place = {"port": str(controller.port.link), "controller": "KIM101", "channel": channel}
    return place | {"counts_per_mm": 50_000.0, "lower_limit": -60.0, "upper_limit": 60.0} | more


@pytest.mark.parametrize(
    ("model", "controller", "actuator", "axis", "counts"),
    [
        ("KST101", "KST101", "ZST213", "x_um", 2008.64563),
        ("LTS300", "LTS", "LTS300", "x_um", 409.6),
        ("K10CR1", "K10CR1", "K10CR1", "yaw_mrad", 409_600 * 120 / 6283.185307),
        ("KBD101", "KBD101", "DDSM100", "x_um", 2.0),
        ("BBD202", "BBD202", "DDS220", "x_um", 20.0),
    ],
)
def test_units_speeds_and_limits_of_each_family(
    tmp_path: Path, model: str, controller: str, actuator: str, axis: str, counts: float
) -> None:
    emulated = AptController(tmp_path / "unit", model, [MovingAxis(0, 200_000_000, 3e7, 0)], 45_000_001)
    place = {"port": str(emulated.port.link), "controller": controller, "actuator": actuator}
    with stage_of(**{axis: place}) as stage:
        stage.home()
        assert stage.move_to({axis: 1000.0})[axis] == pytest.approx(1000.0, abs=1 / counts)
        assert emulated.axes[0].motion.place == pytest.approx(1000 * counts, abs=1)
        assert stage.axes[0].speed_per_s == pytest.approx(3e7 / counts, rel=1e-4)
    emulated.close()
    assert emulated.strange == []


def test_what_is_built_into_a_controller_is_driven_by_no_other() -> None:
    for controller, actuator in (
        ("KST101", "LTS150"),
        ("LTS", "NRT150"),
        ("K10CR1", "LTS300"),
        ("KBD101", "Z825"),
    ):
        with pytest.raises(ValidationError, match=f"a {controller} cannot drive a {actuator}"):
            stage_of(x_um={"port": "/dev/none", "controller": controller, "actuator": actuator})


@pytest.fixture
def stage(servo: AptController, rack: AptController) -> Iterator[AptStage]:
    with stage_of(x_um=servo_axis(servo), z_um=rack_axis(rack, 1, reverse=True)) as stage:
        stage.home()
        yield stage


class TestServoAndStepperStage(StageContract):
    @pytest.fixture(autouse=True)
    def _controllers(self, servo: AptController, rack: AptController) -> None:
        self.servo, self.rack = servo, rack

    def make(self) -> AptStage:
        return stage_of(
            x_um=servo_axis(self.servo),
            y_um=rack_axis(self.rack, 1),
            z_um=rack_axis(self.rack, 2, reverse=True),
        )


class TestInertiaStage(StageContract):
    @pytest.fixture(autouse=True)
    def _controller(self, inertia: AptController) -> None:
        self.inertia = inertia

    def make(self) -> AptStage:
        rotation = {
            "counts_per_mm": None,
            "counts_per_deg": 2000.0,
            "lower_limit": -20.0,
            "upper_limit": 20.0,
        }
        return stage_of(
            x_um=inertia_axis(self.inertia, 1), pitch_mrad=inertia_axis(self.inertia, 3, **rotation)
        )


# What the protocol is -----------------------------------------------------------------------------------
def test_messages_are_the_documents() -> None:
    # The document's own examples: MGMSG_MOD_IDENTIFY and MGMSG_MOT_MOVE_ABSOLUTE to 10 mm in 409600 a mm.
    assert short(0x0223, 0x50) == bytes([0x23, 0x02, 0x00, 0x00, 0x50, 0x01])
    assert long(0x0453, 0x21, "Hl", 1, 4_096_000) == bytes.fromhex("53 04 06 00 A1 01 01 00 00 80 3E 00")


def status(counts: int, bits: int = 0) -> bytes:
    data = long(MOT_GET_DCSTATUSUPDATE, 1, "HlHHL", 1, counts, 0, 0, bits)
    return data[:5] + bytes([0x50]) + data[6:]


@given(st.lists(st.binary(max_size=40), max_size=8))
def test_garbage_ends_in_no_message_or_a_sound_one(pieces: list[bytes]) -> None:
    framer = AptFramer(clock=lambda: 0.0)
    for piece in pieces:
        for frame in framer.feed(piece):
            message = decode(frame)
            assert len(frame) == 6 + len(message.data)
            fault_words(int.from_bytes(message.data[-4:], "little"))


@given(
    counts=st.lists(st.integers(-(2**31), 2**31 - 1), min_size=1, max_size=4),
    cuts=st.data(),
    noise=st.binary(),
)
def test_messages_survive_any_cutting_and_noise_before_them(
    counts: list[int], cuts: st.DataObject, noise: bytes
) -> None:
    stream = noise.replace(b"\x04", b"") + b"".join(map(status, counts))  # no number begins with another byte
    cut = cuts.draw(st.integers(0, len(stream)))
    framer = AptFramer(clock=lambda: 0.0)
    frames = framer.feed(stream[:cut]) + framer.feed(stream[cut:])
    found = [decode(frame) for frame in frames if decode(frame).number == MOT_GET_DCSTATUSUPDATE]
    assert [int.from_bytes(m.data[2:6], "little", signed=True) for m in found] == counts


def test_a_torn_message_does_not_take_its_rest_from_the_next() -> None:
    now_s = [0.0]
    framer = AptFramer(clock=lambda: now_s[0])
    assert framer.feed(status(5)[:9]) == []
    now_s[0] = 0.2
    assert framer.feed(status(7)) == [status(7)]


def test_faults_are_said_in_words() -> None:
    assert fault_words(0x0100_0000 | 0x400 | 1) == [
        "motor current limit reached (blocked?)",
        "at its forward limit switch",
    ]
    assert fault_words(0x400 | 1) == []


def test_messages_encode_as_they_decode() -> None:
    message = Message(HW_GET_INFO, 0, 0, 1, 0x50, bytes(84))
    assert decode(message.encode()) == message


# What the driver does -----------------------------------------------------------------------------------
def test_identity_names_every_controller(stage: AptStage) -> None:
    assert stage.identity.model == "KDC101 + BSC203"
    assert stage.identity.serial_number == "27000001 + 70000001"
    assert stage.identity.firmware == "1.2.3 + 1.2.3"


def test_counts_are_exact_and_limits_the_travel(stage: AptStage, servo: AptController) -> None:
    assert stage.limits == {"x_um": (0.0, 6000.0), "z_um": (-8000.0, 0.0)}
    stage.move_to({"x_um": 1000.0})
    assert servo.axes[0].motion.place == 34_304
    stage.move_to({"x_um": 1000.0 + 2.4 * SERVO_UM})
    assert servo.axes[0].motion.place == 34_306


def test_axes_of_several_controllers_move_together(
    stage: AptStage, servo: AptController, rack: AptController
) -> None:
    stage.move_to({"x_um": 6000.0, "z_um": -8000.0}, wait=False)
    assert servo.axes[0].motion.moving
    assert rack.axes[0].motion.moving
    stage.stop()
    assert not servo.axes[0].motion.moving
    assert not rack.axes[0].motion.moving
    at_once = bytes.fromhex("65 04 01 01")
    assert at_once + b"\x50\x01" in servo.port.received
    assert at_once + b"\x21\x01" in rack.port.received


@pytest.mark.usefixtures("stage")
def test_controllers_are_told_to_say_nothing_unasked(servo: AptController, rack: AptController) -> None:
    assert short(HW_STOP_UPDATEMSGS, 0x50) in servo.port.received
    assert short(HW_STOP_UPDATEMSGS, 0x21) in rack.port.received


def test_status_is_had_for_as_long_as_one_likes(stage: AptStage) -> None:
    for _ in range(3 * STATUS_WITHOUT_SIGN_OF_LIFE):
        assert stage.position()["x_um"] == 0.0


def test_speed_is_set_and_what_the_controller_makes_of_it_is_said(
    servo: AptController, caplog: pytest.LogCaptureFixture
) -> None:
    with stage_of(x_um=servo_axis(servo, speed_per_s=2000.0)) as stage:
        assert stage.axes[0].speed_per_s == pytest.approx(2000.0, rel=1e-4)
        assert servo.axes[0].motion.speed_per_s == pytest.approx(68_608, rel=1e-4)
        assert servo.axes[0].acceleration == 4506
    assert not caplog.text
    servo.axes[0].fastest = 17_152.0
    with caplog.at_level(logging.WARNING), stage_of(x_um=servo_axis(servo, speed_per_s=1000.0)) as stage:
        assert stage.axes[0].speed_per_s == pytest.approx(500.0, rel=1e-4)
    assert "x_um moves at 500 a second, not at the 1000 of bench.toml" in caplog.text


def test_a_fault_ends_the_move_in_words_until_the_next_homing(
    stage: AptStage, servo: AptController, rack: AptController
) -> None:
    stage.move_to({"x_um": 6000.0, "z_um": -8000.0}, wait=False)
    servo.axes[0].motion.halt()
    servo.axes[0].faults = 0x0000_4000
    with pytest.raises(DeviceError, match=r"x_um \(KDC101 on .*\): the position error is too great"):
        stage.wait(10.0)
    wait_for(lambda: not rack.axes[0].motion.moving)
    with pytest.raises(DeviceError, match="position error"):
        stage.move_to({"z_um": 0.0})
    stage.home()  # the bit stays: it was said, and homing is what was asked for
    stage.move_to({"x_um": 10.0})


def test_a_complaint_of_the_controller_is_an_error(stage: AptStage, servo: AptController) -> None:
    servo.complain(17, "Invalid parameter")
    time.sleep(0.1)
    with pytest.raises(DeviceError, match=r"KDC101 on .*: Invalid parameter \(code 17\)"):
        stage.position()
    assert stage.position()["x_um"] == 0.0


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Wait half as long for replies as one would for real devices."""
    monkeypatch.setattr("drivers.apt.link._REPLY_S", 0.25)


def late(seconds: float) -> Callable[[bytes], list[Answer]]:
    return lambda reply: [seconds, reply]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda reply: [],
        lambda reply: [b"\xff\xfe\x80" * 9],
        lambda reply: [reply[:13]],
        lambda reply: [reply[7:]],
        lambda reply: [b"\x91\x04" + reply],
        late(0.4),
    ],
    ids=["silence", "garbage", "torn", "headless", "noise before", "late"],
)
@pytest.mark.usefixtures("impatient")
def test_damaged_replies_are_asked_for_again(
    stage: AptStage, servo: AptController, spoil: Callable[[bytes], list[Answer]]
) -> None:
    here = stage.move_to({"x_um": 600.0})["x_um"]
    servo.spoil.append(spoil)
    assert stage.position()["x_um"] == here
    assert stage.move_to({"x_um": 700.0})["x_um"] == pytest.approx(700.0, abs=SERVO_UM)


@pytest.mark.usefixtures("impatient")
def test_silence_names_controller_and_port(stage: AptStage, servo: AptController) -> None:
    servo.spoil += [lambda reply: []] * 40
    with pytest.raises(DeviceTimeoutError):
        stage.position()
    servo.spoil.clear()


def test_unplugged_and_plugged_in_again(stage: AptStage, servo: AptController) -> None:
    stage.move_to({"x_um": 6000.0}, wait=False)
    servo.port.unplug()
    with pytest.raises(DeviceError, match="apt"):
        stage.wait(10.0)
    assert stage.is_open  # what is left can be stopped
    with pytest.raises(DeviceError, match="no port"):
        stage.open()
    assert not stage.is_open
    servo.axes[0].enabled = False  # it lost its power
    servo.axes[0].motion.homed = False
    servo.port.plug_in()
    stage.open()
    assert not stage.is_homed
    stage.home()
    assert stage.move_to({"x_um": 50.0})["x_um"] == pytest.approx(50.0, abs=SERVO_UM)


def test_another_controller_than_configured_is_refused(rack: AptController) -> None:
    with pytest.raises(DeviceError, match=r"is a BSC203, not a KDC101"):
        stage_of(x_um=servo_axis(rack)).open()


def test_an_empty_bay_is_refused(rack: AptController) -> None:
    with pytest.raises(DeviceError, match=r"bay 3 of .* is empty"):
        stage_of(x_um=rack_axis(rack, 3)).open()


# The piezo inertia drive --------------------------------------------------------------------------------
def test_channels_of_an_inertia_drive_take_turns(inertia: AptController) -> None:
    with stage_of(x_um=inertia_axis(inertia, 1), y_um=inertia_axis(inertia, 2)) as stage:
        stage.home()
        stage.move_to({"x_um": 20.0, "y_um": -20.0}, wait=False)
        assert [axis.motion.moving for axis in inertia.axes[:2]] == [True, False]
        stage.wait(10.0)
        assert [axis.motion.place for axis in inertia.axes[:2]] == [1000, -1000]
        stage.move_to({"x_um": -60.0, "y_um": 60.0}, wait=False)
        stage.stop()
        with pytest.raises(StoppedError):
            stage.wait(10.0)
        assert inertia.axes[1].motion.place == -1000


class Told:
    """A link without a port: it keeps what it is sent, and says what it is told to."""

    device, name, port = "stage (test)", "KIM101", "none"

    def __init__(self, model: str, *replies: bytes) -> None:
        self.controller, self.replies, self.sent = CONTROLLERS[model], list(replies), bytearray()

    def send_now(self, message: bytes) -> None:
        self.sent += message

    def ask(self, *_: object) -> Message:
        return Message(PZMOT_GET_STATUSUPDATE, 0, 0, 0x50, 1, self.replies.pop(0))


def test_a_channel_that_has_not_set_out_yet_keeps_its_turn() -> None:
    resting = struct.pack("<HllL", 1, 0, 0, 0) + struct.pack("<HllL", 2, 0, 0, 0)
    arrived = struct.pack("<HllL", 1, 500, 0, 0) + resting[14:]
    link = Told("KIM101", resting, arrived)
    unit = InertiaUnit(link)  # type: ignore[arg-type]
    unit.queue(1, 500)
    unit.queue(2, 70)
    before = len(link.sent)
    assert unit.status() == {1: (0, 0), 2: (0, 0)}  # the first is asked before it moves
    assert (len(link.sent), unit.is_busy(1), unit.is_busy(2)) == (before, True, True)
    unit.status()
    assert not unit.is_busy(1)
    assert link.sent[before:].endswith(struct.pack("<Hl", 2, 70))


def test_a_move_that_waited_does_not_begin_after_reconnecting(inertia: AptController) -> None:
    stage = stage_of(x_um=inertia_axis(inertia, 1), y_um=inertia_axis(inertia, 2))
    stage.open()
    stage.home()
    stage.move_to({"x_um": 60.0, "y_um": 60.0}, wait=False)
    inertia.port.unplug()
    while stage.is_open:
        time.sleep(0.01)
    for axis in inertia.axes:
        axis.motion.halt()
    time.sleep(0.35)  # after that a move counts as ended
    sent = len(inertia.port.received)
    inertia.port.plug_in()
    with stage:
        assert not stage.is_moving
    assert not any(message.startswith(b"\xd4\x08") for message in inertia.port.received[sent:])


def test_closing_stops_the_controllers_that_are_left(
    stage: AptStage, servo: AptController, rack: AptController
) -> None:
    stage.move_to({"x_um": 6000.0, "z_um": -8000.0}, wait=False)
    servo.port.unplug()
    while stage._is_connected:
        time.sleep(0.005)
    stage.close()
    wait_for(lambda: not rack.axes[0].motion.moving)
    assert rack.axes[0].motion.place < 6_553_600
    servo.port.plug_in()


def test_opening_in_vain_stops_the_controllers_that_are_left(
    stage: AptStage, servo: AptController, rack: AptController
) -> None:
    stage.move_to({"x_um": 6000.0, "z_um": -8000.0}, wait=False)
    servo.port.unplug()
    while stage._is_connected:
        time.sleep(0.005)
    with pytest.raises(DeviceError, match="no port"):
        stage.open()
    wait_for(lambda: not rack.axes[0].motion.moving)
    assert rack.axes[0].motion.place < 6_553_600
    servo.port.plug_in()


def test_the_zero_of_an_inertia_drive_is_kept_as_long_as_its_power(inertia: AptController) -> None:
    stage = stage_of(x_um=inertia_axis(inertia, 1))
    with stage:
        stage.home()
        stage.move_to({"x_um": 10.0})
    with stage:
        assert stage.is_homed
        assert stage.position() == {"x_um": 10.0}
    inertia.axes[0].motion.set_place(0)  # switched off and on
    with stage, pytest.raises(LimitError, match="not homed"):
        stage.move_to({"x_um": 10.0})


def test_the_step_rate_of_an_inertia_drive(inertia: AptController) -> None:
    with stage_of(x_um=inertia_axis(inertia, 4, speed_per_s=30.0)) as stage:
        assert stage.axes[0].speed_per_s == 30.0
        assert inertia.axes[3].motion.speed_per_s == 1500


# Options and discovery ----------------------------------------------------------------------------------
KDC = {"port": "/dev/ttyUSB0", "controller": "KDC101"}
KIM = {"port": "/dev/ttyUSB0", "controller": "KIM101", "counts_per_mm": 5e4}
ENDS = {"lower_limit": 0.0, "upper_limit": 1.0}


@pytest.mark.parametrize(
    ("axes", "words"),
    [
        ({"x_um": KDC}, "needs one of actuator, counts_per_mm and counts_per_deg"),
        ({"x_um": KDC | {"actuator": "Z825", "counts_per_mm": 1.0}}, "needs one of"),
        ({"x_um": KDC | {"actuator": "NRT150"}}, "a KDC101 cannot drive a NRT150"),
        ({"x_um": KDC | {"actuator": "PRM1-Z8"}}, "an actuator that turns cannot be x_um"),
        ({"yaw_mrad": KDC | {"actuator": "Z825"}}, "an actuator that shifts cannot be yaw_mrad"),
        ({"x_um": KIM}, "needs lower_limit and upper_limit"),
        ({"x_um": KDC | {"actuator": "Z825", "channel": 2}}, "a KDC101 has 1 channel"),
        (
            {"x_um": KDC | {"actuator": "Z825", "speed_per_s": 1e9}},
            r"axes.x_um: speed_per_s = 1e\+09: a Z825 on a KDC101 moves at 0.0013 to 3000 um a second",
        ),
        ({"x_um": KDC | {"actuator": "Z825", "speed_per_s": 3e4}}, "to 3000 um a second"),
        ({"x_um": KDC | {"actuator": "Z825", "speed_per_s": 1e-9}}, "speed_per_s = 1e-09: a Z825"),
        ({"x_um": KDC | {"counts_per_mm": 34304.0, "speed_per_s": math.inf} | ENDS}, "a KDC101 moves at"),
        ({"x_um": KIM | ENDS | {"speed_per_s": 41.0}}, "a KIM101 moves at 0.02 to 40 um a second"),
        ({"x_um": KIM | ENDS | {"speed_per_s": 0.01}}, "a KIM101 moves at 0.02 to 40 um a second"),
        ({"yaw_mrad": KDC | {"actuator": "PRM1-Z8", "speed_per_s": 437.0}}, "to 436.3 mrad a second"),
        ({"x_um": KDC | {"actuator": "Z9"}}, "Input should be 'MTS25-Z8'"),
        (
            {"x_um": KDC | {"actuator": "Z825"}, "y_um": KDC | {"actuator": "Z825"}},
            "axes.y_um and axes.x_um are both channel 1",
        ),
        (
            {
                "x_um": KDC | {"actuator": "Z825"},
                "y_um": KIM | {"channel": 2, "lower_limit": 0.0, "upper_limit": 1.0},
            },
            "is a KDC101 in another axis",
        ),
    ],
)
def test_options_that_make_no_sense(axes: object, words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        AptOptions.model_validate({"axes": axes})


@pytest.mark.parametrize(
    ("family", "actuator"),
    [("KDC101", "Z825"), ("KDC101", "PRM1-Z8"), ("BSC203", "DRV001"), ("KIM101", None)],
)
@given(share=st.floats(0, 1), reverse=st.booleans())
def test_every_speed_that_is_allowed_is_sent_as_it_is(
    family: str, actuator: str | None, share: float, reverse: bool
) -> None:
    scale = SPEED_SCALE[CONTROLLERS[family].family]  # type: ignore[index]
    name = "yaw_mrad" if actuator == "PRM1-Z8" else "x_um"
    keys: dict[str, object] = {"port": "/dev/ttyUSB0", "controller": family, "reverse": reverse}
    keys |= {"actuator": actuator} if actuator else {"counts_per_mm": 5e4} | ENDS
    speed = 10 ** (-9 + share * 18)
    try:
        axis = AptOptions.model_validate({"axes": {name: keys | {"speed_per_s": speed}}}).axes[name]
    except ValidationError:
        return
    assert 1 <= round(speed / abs(axis.axis_map(name).scale) * scale) < 2**31


def test_controllers_are_discovered_by_vendor_and_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    def port(address: str, usb_id: str, serial_number: str) -> FoundDevice:
        return FoundDevice("serial", address, "port", usb_id=usb_id, serial_number=serial_number)

    ports = (
        port("/dev/ttyUSB0", "0403:faf0", "27501971"),
        port("/dev/ttyUSB1", "0403:6001", "27501971"),
        port("/dev/ttyUSB2", "0403:faf0", "99501971"),
        port("/dev/ttyUSB3", "0403:faf0", "97000001"),
    )
    monkeypatch.setattr(apt_stage, "serial_ports", lambda: ports)
    found = AptStage.discover()
    assert [(device.address, device.product) for device in found] == [
        ("/dev/ttyUSB0", "KDC101"),
        ("/dev/ttyUSB3", "KIM101"),
    ]
    assert 'driver = "apt"' in found[0].bench_lines()
    assert "# fill in actuator" in found[0].bench_lines()


# The emulator under other people's client ---------------------------------------------------------------
def test_anothers_client_finds_the_emulator_right(servo: AptController) -> None:
    devices = pytest.importorskip(
        "thorlabs_apt_device.devices.kdc101", reason="thorlabs-apt-device is not installed (dev extra)"
    )
    client = devices.KDC101(serial_port=str(servo.port.link), home=False)
    client.keepalive_message = None
    try:
        client.set_enabled(True)
        client.home()
        wait_for(lambda: client.status["homed"] and client.status["position"] == 0)
        client.move_absolute(34_304)
        wait_for(lambda: client.status["position"] == 34_304)
        assert servo.axes[0].motion.place == 34_304
        client.move_relative(-304)
        wait_for(lambda: client.status["position"] == 34_000)
        client.move_absolute(200_000)
        wait_for(lambda: client.status["moving_forward"] or client.status["moving_reverse"])
        client.stop(immediate=True)
        wait_for(lambda: not servo.axes[0].motion.moving)
        assert 34_000 < servo.axes[0].motion.place < 200_000
        assert client.velparams["max_velocity"] == round(1_000_000 * 65_536 * 2048 / 6e6)
    finally:
        client.close()
        client._thread.join(5.0)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + 20.0
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.005)
