"""One stage of several controllers: x, y, z on GRBL, pitch and yaw on a Zaber chain."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers.composite_stage import CompositeOptions, CompositeStage
from drivers.device import SharedPart
from drivers.errors import DeviceError, DeviceTimeoutError, LimitError, StoppedError
from drivers.grbl.stage import GrblStage
from drivers.testing.stage import StageContract
from drivers.zaber.stage import ZaberOptions, ZaberStage
from tests.mocks.grbl_controller import GrblController
from tests.mocks.moving_axis import MovingAxis
from tests.mocks.zaber_chain import ZaberChain, ZaberDevice

ROTATIONS = {
    "pitch_mrad": {"device": 1, "axis": 1, "microstep_deg": 0.001},
    "yaw_mrad": {"device": 1, "axis": 2, "microstep_deg": 0.001, "reverse": True},
}


@pytest.fixture
def board(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[GrblController]:
    # A controller on a busy machine is waited for; tests of silence ask for less of it.
    monkeypatch.setattr(GrblStage, "reply_s", 30.0)
    monkeypatch.setattr("drivers.zaber.stage._REPLY_S", 30.0)
    (tmp_path / "grbl").mkdir()
    board = GrblController(tmp_path / "grbl")
    yield board
    board.unplug()


@pytest.fixture
def chain(tmp_path: Path) -> Iterator[ZaberChain]:
    (tmp_path / "zaber").mkdir()
    axes = [MovingAxis(0, 12_000, 60_000, 700), MovingAxis(0, 12_000, 60_000, 500)]
    chain = ZaberChain(tmp_path / "zaber", {1: ZaberDevice(axes)})
    yield chain
    chain.close()


def composite(board: GrblController, chain: ZaberChain, **axes: object) -> CompositeStage:
    parts = {
        "xyz": {"driver": "grbl", "port": str(board.link)},
        "tilt": {"driver": "zaber", "port": str(chain.port.link), "axes": ROTATIONS | axes},
    }
    return CompositeStage(CompositeOptions.model_validate({"parts": parts}))


@pytest.fixture
def stage(board: GrblController, chain: ZaberChain) -> Iterator[CompositeStage]:
    with composite(board, chain) as stage:
        stage.home()
        yield stage


class TestCompositeStage(StageContract):
    @pytest.fixture(autouse=True)
    def _controllers(self, board: GrblController, chain: ZaberChain) -> None:
        self.board, self.chain = board, chain

    def make(self) -> CompositeStage:
        return composite(self.board, self.chain)


def middle(stage: CompositeStage) -> dict[str, float]:
    return {axis.name: (axis.lower_limit + axis.upper_limit) / 2 for axis in stage.axes}


def test_the_parts_are_one_stage(stage: CompositeStage) -> None:
    assert [axis.name for axis in stage.axes] == ["x_um", "y_um", "z_um", "pitch_mrad", "yaw_mrad"]
    assert "GRBL" in stage.identity.vendor
    assert "Zaber" in stage.identity.vendor
    assert {"xyz.homed", "tilt.homed", "tilt.position_yaw_mrad"} <= set(stage.settings())
    assert len(stage.claims(stage.options)) == 2


def test_a_target_beyond_the_limits_of_one_part_moves_none(stage: CompositeStage) -> None:
    before = stage.position()
    with pytest.raises(LimitError) as caught:
        stage.move_to(middle(stage) | {"yaw_mrad": 1e6, "y_um": -1e9})
    assert "y_um" in str(caught.value)
    assert "yaw_mrad" in str(caught.value)
    assert stage.position() == before


def test_parts_move_at_the_same_time(stage: CompositeStage, chain: ZaberChain) -> None:
    stage.move_to(middle(stage), wait=False)
    assert chain.devices[1].axes[0].moving
    assert stage._parts["xyz"].is_moving
    stage.wait(30.0)
    for name, place in middle(stage).items():
        assert stage.position()[name] == pytest.approx(place, abs=20.0)


def test_stop_stops_every_part_while_a_move_is_waited_for(stage: CompositeStage, chain: ZaberChain) -> None:
    outcome: list[BaseException] = []

    def move() -> None:
        try:
            stage.move_to(middle(stage))
        except StoppedError as error:
            outcome.append(error)

    mover = threading.Thread(target=move)
    mover.start()
    while not chain.devices[1].axes[1].moving:
        time.sleep(0.001)
    stage.stop()
    mover.join(20.0)
    assert isinstance(outcome[0], StoppedError)
    assert not stage.is_moving
    stage.move_to({"pitch_mrad": 1.0})  # it goes on, and the other part's stopped move is no concern


def test_a_part_that_fails_stops_the_others(stage: CompositeStage, chain: ZaberChain) -> None:
    stage.move_to(middle(stage), wait=False)
    chain.stall(1, 1)
    with pytest.raises(DeviceError, match=r"pitch_mrad \(device 1 axis 1\): stalled and stopped"):
        stage.wait(30.0)
    assert not stage._parts["xyz"].is_moving
    assert stage.position()["x_um"] != pytest.approx(middle(stage)["x_um"], abs=1.0)


def test_a_part_that_an_alarm_locks_is_unlocked_alone(
    board: GrblController, chain: ZaberChain, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(GrblStage, "reply_s", 1.0)  # what is reset or locked answers nothing
    board.settings |= {20: 0, 21: 1, 22: 0}  # no homing switches
    here = {"homing": "here", "axes": {"x_um": {"lower_limit": -9e3, "upper_limit": 9e3}}}
    parts = {
        "xyz": {"driver": "grbl", "port": str(board.link), **here},
        "tilt": {"driver": "zaber", "port": str(chain.port.link), "axes": ROTATIONS},
    }
    with CompositeStage(CompositeOptions.model_validate({"parts": parts})) as stage:
        board.press_reset()
        stage._parts["xyz"].home()
        with pytest.raises(DeviceError, match="has no lock"):
            stage.unlock()
        board.hit_limit_switch()
        while not stage.needs_unlocking:
            stage.position()
        stage.unlock()
        stage.position()
        assert not stage.needs_unlocking


def test_a_part_that_is_unplugged_stops_the_others_and_comes_back(
    stage: CompositeStage, chain: ZaberChain
) -> None:
    stage.move_to(middle(stage), wait=False)
    chain.port.unplug()
    with pytest.raises(DeviceError, match=r"^stage \(zaber, .*\), part tilt: was lost"):
        stage.wait(30.0)
    assert not stage._parts["xyz"].is_moving
    assert stage.is_open  # what is left can be stopped
    asks: list[Callable[[], object]] = [
        stage.stop,
        stage.home,
        stage.position,
        lambda: stage.move_to({"pitch_mrad": 5.0}),
    ]
    for ask in asks:
        with pytest.raises(DeviceError, match=r"^stage \(zaber, .*\), part tilt: (was lost|is not open)"):
            ask()
    chain.port.plug_in()
    stage.open()
    stage.home()
    stage.move_to({"pitch_mrad": 5.0, "x_um": middle(stage)["x_um"]})


def test_opening_in_vain_leaves_the_part_that_is_connected_as_it_was(
    stage: CompositeStage, chain: ZaberChain
) -> None:
    chain.port.unplug()
    with pytest.raises(DeviceError, match="part tilt"):
        stage.position()
    with pytest.raises(DeviceError, match="part tilt: there is no port"):
        stage.open()
    assert stage.is_open
    assert stage._parts["xyz"].is_homed
    chain.port.plug_in()
    stage.open()
    assert stage._parts["xyz"].is_homed
    assert stage._parts["tilt"].is_open


def test_waiting_no_longer_stops_nothing(stage: CompositeStage) -> None:
    stage.move_to(middle(stage), wait=False)
    with pytest.raises(DeviceTimeoutError, match="still moves"):
        stage.wait(0.01)
    assert stage.is_moving
    stage.wait(30.0)


def test_looking_whether_a_move_has_ended_stops_nothing(stage: CompositeStage) -> None:
    target = middle(stage)
    stage.move_to(target, wait=False)
    with pytest.raises(DeviceTimeoutError, match="still moves"):
        stage.wait(0.0)
    stage.wait(30.0)
    assert stage.position() == pytest.approx(target, abs=5.0)


def test_a_part_that_arrives_when_the_wait_is_over_stops_no_other(stage: CompositeStage) -> None:
    tilt, xyz, target = stage._parts["tilt"], stage._parts["xyz"], middle(stage)
    wait_tilt, wait_xyz = tilt.wait, xyz.wait
    asked_again = threading.Event()

    def arrives_late(timeout_s: float | None = None) -> None:
        try:
            wait_tilt(timeout_s)
            asked_again.set()
        except DeviceTimeoutError:
            while tilt.is_moving:
                time.sleep(0.002)
            raise

    def is_late(timeout_s: float | None = None) -> None:
        asked_again.wait(5)
        wait_xyz(timeout_s)

    tilt.wait, xyz.wait = arrives_late, is_late  # type: ignore[method-assign]
    stage.move_to(target, wait=False)
    with pytest.raises(DeviceTimeoutError, match="still moves"):
        stage.wait(0.01)
    stage.wait(30.0)
    assert stage.position() == pytest.approx(target, abs=5.0)


def test_stop_between_homing_two_parts_homes_no_more(board: GrblController, chain: ZaberChain) -> None:
    with composite(board, chain) as stage:
        parts = list(stage._parts.values())
        home_first = parts[0].home

        def home_and_stop() -> None:
            home_first()
            stage.stop()

        parts[0].home = home_and_stop  # type: ignore[method-assign]
        with pytest.raises(StoppedError, match="homing was stopped"):
            stage.home()
        assert not parts[1].is_homed


def test_stop_as_a_part_is_about_to_home_stops_its_homing(board: GrblController, chain: ZaberChain) -> None:
    with composite(board, chain) as stage:
        tilt = stage._parts["tilt"]
        home, stop = tilt.home, tilt.stop
        about_to, stopped = threading.Event(), threading.Event()
        for axis in chain.devices[1].axes:
            axis.set_place(12_000)
            axis.speed_per_s = 2_000  # six seconds

        def late() -> None:
            about_to.set()
            assert stopped.wait(10)
            home()

        def noticed() -> None:
            stop()
            stopped.set()

        tilt.home, tilt.stop = late, noticed  # type: ignore[method-assign]
        outcome: list[object] = []

        def run() -> None:
            try:
                outcome.append(stage.home())
            except DeviceError as error:
                outcome.append(error)

        thread = threading.Thread(target=run)
        thread.start()
        assert about_to.wait(10)
        stage.stop()
        thread.join(20)
        assert isinstance(outcome[0], StoppedError)
        assert not tilt.is_homed


def test_a_part_that_does_not_open_closes_the_others_and_is_named(
    board: GrblController, chain: ZaberChain
) -> None:
    chain.port.unplug()
    stage = composite(board, chain)
    with pytest.raises(DeviceError, match=r"^stage \(zaber, .*\), part tilt: there is no port"):
        stage.open()
    assert not any(part.is_open for part in stage._parts.values())
    chain.port.plug_in()


def test_an_axis_that_two_parts_have_is_refused(board: GrblController, chain: ZaberChain) -> None:
    """Most drivers' options say it before anything is opened; of the others it shows then."""
    axes = {"y_um": {"device": 1, "axis": 2, "microstep_um": 1.0}}
    stage = composite(board, chain)
    stage._parts["tilt"] = ZaberStage(
        ZaberOptions.model_validate({"port": str(chain.port.link), "axes": axes})
    )
    with pytest.raises(DeviceError, match="parts xyz and tilt both have an axis y_um"):
        stage.open()
    assert not stage.is_open


ZABER = {"driver": "zaber", "port": "/dev/ttyUSB0", "axes": {"x_um": {"microstep_um": 1.0}}}


@pytest.mark.parametrize(
    ("parts", "place", "words"),
    [
        ({}, ("parts",), "at least 1 item"),
        ({"a": ZABER, "b": ZABER}, (), "parts a and b both use port /dev/ttyUSB0"),
        ({"a": ZABER, "b": ZABER | {"port": "/dev/ttyUSB1"}}, (), "parts a and b both have an axis x_um"),
        ({"a": ZABER | {"prot": 1}}, ("parts", "a", "prot"), "Extra inputs"),
        ({"a": {"driver": "zabr"}}, ("parts", "a", "driver"), "must be one of apt, "),
        ({"a": {"driver": "composite"}}, ("parts", "a", "driver"), "must be one of apt, "),
        ({"a": {"port": "x"}}, ("parts", "a", "driver"), "Field required"),
        ({"a": 3}, ("parts", "a"), "should be a valid dictionary"),
    ],
)
def test_options_that_make_no_sense(parts: object, place: tuple[str, ...], words: str) -> None:
    with pytest.raises(ValidationError, match=words) as caught:
        CompositeOptions.model_validate({"parts": parts})
    assert [detail["loc"] for detail in caught.value.errors()] == [place]


def test_a_driver_that_shares_a_table_with_the_bench_is_no_part(monkeypatch: pytest.MonkeyPatch) -> None:
    class World(SharedPart):
        table = "world"

    class Sharing(ZaberStage):
        Shared = World

    monkeypatch.setattr("drivers.composite_stage.load_driver", lambda kind, name: Sharing)
    with pytest.raises(ValidationError, match=r"does not share \[world\] with the bench"):
        CompositeOptions.model_validate({"parts": {"a": ZABER}})


def test_options_come_back_from_what_they_are_kept_as() -> None:
    options = CompositeOptions.model_validate({"parts": {"a": ZABER}})
    kept = options.model_dump(mode="json")
    assert kept["parts"]["a"]["baud_rate"] == 115_200
    assert CompositeOptions.model_validate(kept).model_dump(mode="json") == kept
