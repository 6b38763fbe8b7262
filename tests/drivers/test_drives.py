"""The axes of Thorlabs controllers, message by message, against the protocol document's numbers."""

from __future__ import annotations

import struct
from typing import Any, cast

import pytest

from drivers.apt.drives import InertiaChannel, InertiaUnit, Motor
from drivers.apt.link import Link
from drivers.apt.protocol import CONTROLLERS, Message
from drivers.errors import DeviceError

MOVING, HOMED = 0x10, 0x400


class ScriptedLink:
    """Answers from a list, and keeps what is sent."""

    device, port = "stage (apt)", "/dev/none"

    def __init__(self, model: str) -> None:
        self.name = model
        self.controller = CONTROLLERS[model]  # type: ignore[index]
        self.sent: list[str] = []
        self.asked: list[tuple[str, int, int | None, int | None]] = []
        self.answers: list[bytes | tuple[int, int]] = []
        self.on_send: Any = None

    def send_now(self, message: bytes) -> None:
        self.sent.append(message.hex())
        if self.on_send is not None:
            self.on_send()

    def ask(self, request: bytes, number: int, source: int | None, channel: int | None = None) -> Message:
        self.asked.append((request.hex(), number, source, channel))
        answer = self.answers.pop(0)
        if isinstance(answer, tuple):
            return Message(number, *answer, 1, source or 0)
        return Message(number, 0, 0, 1, source or 0, answer)


def motor(model: str, channel: int = 1) -> tuple[Motor, ScriptedLink]:
    link = ScriptedLink(model)
    return Motor(cast("Link", link), channel), link


def test_a_servo_is_switched_on_asked_and_moved() -> None:
    axis, link = motor("KDC101")
    link.answers = [(1, 1)]
    axis.prepare()
    assert link.sent == ["120000005001", "100201015001"]  # no messages unasked; channel 1 on
    assert link.asked == [("110201005001", 0x0212, 0x50, 1)]
    link.answers = [struct.pack("<HlHHL", 1, -34_304, 0, 0, MOVING | HOMED)]
    state = axis.state()
    assert (state.counts, state.moving, state.homed, state.faults) == (-34_304, True, True, [])
    assert link.asked[-1] == ("920400005001" + "900401005001", 0x0491, 0x50, 1)  # with the sign of life
    link.sent.clear()
    axis.move(4_096_000)
    axis.home()
    axis.stop()
    assert link.sent == ["53040600d001" + "0100" + "00803e00", "430401005001", "650401015001"]


def test_a_stepper_of_a_rack_is_asked_by_its_bay() -> None:
    axis, link = motor("BSC203", 2)
    link.answers = [(1, 1), (1, 1)]
    axis.prepare()
    assert link.asked == [("600001001101", 0x0061, 0x11, 1), ("110201002201", 0x0212, 0x22, 1)]
    link.answers = [struct.pack("<HlHHL", 1, 7, 0, 0, 0)]
    state = axis.state()
    assert (state.counts, state.moving, state.homed) == (7, False, False)
    assert link.asked[-1] == ("800401002201", 0x0481, 0x22, 1)  # without
    for answers, words in (
        ([(1, 2)], "bay 2 of /dev/none is empty"),
        ([(1, 1), (1, 2)], "does not switch on"),
    ):
        link.answers = list(answers)
        with pytest.raises(DeviceError, match=words):
            axis.prepare()


def test_a_motors_speed_is_scaled_and_its_acceleration_kept() -> None:
    axis, link = motor("KDC101")
    scale = 65_536 * 2048 / 6e6
    told = struct.pack("<Hlll", 1, 5, 4506, round(1000 * scale))
    link.answers = [told, told]
    assert axis.speed() == pytest.approx(1000, rel=1e-4)
    axis.set_speed(2000.0)
    assert link.asked == 2 * [("140401005001", 0x0415, 0x50, 1)]
    assert link.sent == ["13040e00d001" + struct.pack("<Hlll", 1, 5, 4506, round(2000 * scale)).hex()]


def inertia(*channels: int) -> tuple[list[InertiaChannel], ScriptedLink]:
    link = ScriptedLink("KIM101")
    unit = InertiaUnit(cast("Link", link))
    return [InertiaChannel(unit, channel) for channel in channels], link


def status(*axes: tuple[int, int]) -> bytes:
    """Counts and bits of the channels, in order."""
    return b"".join(struct.pack("<HllL", 1 << i, counts, 0, bits) for i, (counts, bits) in enumerate(axes))


SELECT = "c0080400d0012b00"
MOVE = "d4080600d001"


def test_an_inertia_drive_moves_one_channel_after_the_other() -> None:
    (one, four), link = inertia(1, 4)
    one.move(100)
    four.move(-7)
    four.move(-8)  # the latest counts
    assert link.sent == [SELECT + "0100" + MOVE + "0100" + "64000000"]
    link.answers[:] = 4 * [status((50, MOVING), (0, 0), (0, 0), (3, 0))]
    assert (one.state().moving, four.state().moving) == (True, True)  # one moves, four waits
    assert link.asked == 2 * [("e20800005001" + "e00801005001", 0x08E1, 0x50, None)]
    one.move(90)  # its own move is replaced at once
    assert link.sent[1:] == [SELECT + "0100" + MOVE + "0100" + "5a000000"]
    link.answers = [status((90, 0), (0, 0), (0, 0), (3, 0))]
    assert not one.state().moving
    assert link.sent[2:] == [SELECT + "0400" + MOVE + "0800" + "f8ffffff"]
    link.answers = [status((90, 0), (0, 0), (0, 0), (3, 0))]
    assert four.state().moving  # begun a moment ago, and not there yet
    link.answers = [status((90, 0), (0, 0), (0, 0), (-8, 0))]
    assert not four.state().moving
    assert link.sent[3:] == []


def test_a_move_that_never_began_does_not_hold_up_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [50.0]
    monkeypatch.setattr("drivers.apt.drives.time.monotonic", lambda: now[0])
    (one, two), link = inertia(1, 2)
    one.move(100)
    two.move(5)
    still = status((3, 0), (0, 0))
    for now_s, moves in ((50.25, 1), (50.35, 2)):
        now[0] = now_s
        link.answers = [still]
        one.state()
        assert len(link.sent) == moves
    one.move(6)
    now[0] = 60.0
    link.answers = [status((3, 0), (0, MOVING))]  # two moves for ever: it is waited for
    assert two.state().moving
    assert len(link.sent) == 2
    link.answers = [status((3, 0))]  # the unit does not speak of a second channel
    one.state()
    assert len(link.sent) == 3


def test_stopping_an_inertia_drive_drops_what_waits_and_a_move_that_is_being_sent() -> None:
    (one, three), link = inertia(1, 3)
    stopped = "650404015001" + "c0080400d0012b000000"  # channel 3 at once, then none enabled
    one.move(100)
    three.move(5)
    three.stop()
    assert link.sent[1:] == [stopped]
    link.answers = [status((20, 0), (0, 0), (0, 0))]
    assert not three.state().moving
    assert len(link.sent) == 2

    def interrupt() -> None:
        link.on_send = None
        three.stop()

    link.on_send = interrupt
    three.move(9)  # STOP comes while the move is on its way: it is stopped again after it
    assert link.sent[3:] == [stopped, stopped]
    assert not three._unit.is_busy(3)


@pytest.mark.parametrize(
    ("last", "now", "kept"), [(500, 500, True), (500, 499, False), (0, 0, False)], ids=str
)
def test_the_zero_of_an_inertia_drive_is_believed_where_it_stands_as_it_stood(
    last: int, now: int, kept: bool
) -> None:
    (two,), link = inertia(2)
    two.home()
    assert link.sent == ["c0080c00d001" + "0500" + "0200" + "00000000" + "00000000"]
    link.answers = [status((0, 0), (last, 0))]
    assert two.state().homed
    two._unit._waiting = {1: 5}
    link.sent.clear()
    link.answers += 2 * [status((0, 0), (now, 0))]
    two.prepare()
    assert link.sent == ["120000005001"]
    assert not two._unit.is_busy(1)
    assert two.state().homed is kept


def test_an_inertia_drive_that_was_never_zeroed_is_not_homed() -> None:
    (two,), link = inertia(2)
    link.answers = [status((0, 0), (4, 0))]
    assert not two.state().homed
    two.prepare()
    link.answers = [status((0, 0), (4, 0))]
    assert not two.state().homed
    (three,), link = inertia(3)
    three.home()
    three.prepare()  # where it stands was never asked
    link.answers = [status((0, 0), (0, 0), (1, 0))]
    assert not three.state().homed


def test_an_inertia_channels_step_rate_is_set_and_the_rest_kept() -> None:
    (three, four), link = inertia(3, 4)
    link.answers[:] = 2 * [struct.pack("<HHHll", 7, 4, 85, 1500, 100_000)]
    assert three.speed() == 1500.0
    three.set_speed(900.4)
    assert link.asked == 2 * [("c10807045001", 0x08C2, 0x50, 7)]
    assert link.sent == ["c0080e00d001" + struct.pack("<HHHll", 7, 4, 85, 900, 100_000).hex()]
    link.answers = [b"\x07\x00\x04\x00"]
    with pytest.raises(DeviceError, match="for its step rate"):
        four.speed()
    link.answers = [status((0, 0), (0, 0), (0, 0))]
    with pytest.raises(DeviceError, match="KIM101 has no channel 4"):
        four.state()
