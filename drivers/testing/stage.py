"""What every motion stage must do."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from drivers.common.checked import checked
from drivers.errors import LimitError, StoppedError
from drivers.stage import Stage
from drivers.testing.device import DeviceContract

PATIENCE_S = 30.0


class StageContract(DeviceContract):
    """Tests for every stage; ``make`` gives a closed one that has not been homed."""

    kind = "stage"

    @pytest.fixture
    def stage(self) -> Iterator[Stage]:
        device = self.make()
        assert isinstance(device, Stage)
        with device:
            device.home()
            yield device

    def far(self, stage: Stage) -> dict[str, float]:
        """Return a target far away on the first axis, one that takes a while to reach."""
        axis = stage.axes[0]
        here = stage.position()[axis.name]
        ends = (axis.lower_limit, axis.upper_limit)
        return {axis.name: max(ends, key=lambda end: abs(end - here))}

    def test_axes_are_named_for_their_units(self, stage: Stage) -> None:
        assert 1 <= len(stage.axes) <= 6
        for axis in stage.axes:
            assert axis.unit in ("um", "mrad")
            assert axis.lower_limit < axis.upper_limit
            assert axis.speed_per_s > 0
            assert axis.resolution > 0
        assert set(stage.position()) == {axis.name for axis in stage.axes} == set(stage.limits)

    def test_moves_before_homing_are_refused(self) -> None:
        device = self.make()
        assert isinstance(device, Stage)
        with device:
            assert not device.is_homed
            before = device.position()
            with pytest.raises(LimitError, match="hom"):
                device.move_to(before)
            device.home()
            assert device.is_homed
            assert not device.is_moving

    def test_it_works_as_a_bench_uses_it(self) -> None:
        device = self.make()
        device.__class__ = checked(type(device))
        assert isinstance(device, Stage)
        with device:
            device.home()
            place = device.position()
            assert device.move_to(place) == pytest.approx(place)
            assert device.settings() is not None

    def test_moves_end_where_they_should(self, stage: Stage) -> None:
        for share in (0.3, 0.6):
            target = {a.name: a.lower_limit + share * (a.upper_limit - a.lower_limit) for a in stage.axes}
            reached = stage.move_to(target)
            assert not stage.is_moving
            assert reached == stage.position()
            for axis in stage.axes:
                assert reached[axis.name] == pytest.approx(target[axis.name], abs=2 * axis.resolution)
                assert stage.commanded_position()[axis.name] == pytest.approx(target[axis.name])

    def test_unnamed_axes_stay(self, stage: Stage) -> None:
        if len(stage.axes) == 1:
            pytest.skip("a stage of one axis")
        before = stage.position()
        stage.move_to(self.far(stage))
        for axis in stage.axes[1:]:
            assert stage.position()[axis.name] == before[axis.name]

    def test_steps_add_up_without_drift(self, stage: Stage) -> None:
        axis = stage.axes[0]
        middle = (axis.lower_limit + axis.upper_limit) / 2
        stage.move_to({axis.name: middle})
        step = 10.37 * axis.resolution
        for _ in range(7):
            stage.move_by({axis.name: step})
        assert stage.commanded_position()[axis.name] == pytest.approx(middle + 7 * step)
        assert stage.position()[axis.name] == pytest.approx(middle + 7 * step, abs=axis.resolution)

    def test_limits_refuse_and_nothing_moves(self, stage: Stage) -> None:
        before = stage.position()
        axis = stage.axes[0]
        beyond = axis.upper_limit + axis.resolution
        for wrong in (beyond, axis.lower_limit - 1e9, float("nan"), float("inf")):
            with pytest.raises(LimitError, match=axis.name):
                stage.move_to({axis.name: wrong})
        with pytest.raises(LimitError, match="warp_um"):
            stage.move_to({axis.name: before[axis.name], "warp_um": 0.0})
        with pytest.raises(LimitError, match=axis.name):
            stage.move_by({axis.name: 10 * (axis.upper_limit - axis.lower_limit)})
        assert stage.position() == before
        assert not stage.is_moving

    def test_every_offending_axis_is_named(self, stage: Stage) -> None:
        with pytest.raises(LimitError) as caught:
            stage.move_to({axis.name: axis.upper_limit * 10 + 1e6 for axis in stage.axes})
        for axis in stage.axes:
            assert axis.name in str(caught.value)

    def test_a_move_without_waiting_can_be_waited_for(self, stage: Stage) -> None:
        target = self.far(stage)
        stage.move_to(target, wait=False)
        stage.wait(PATIENCE_S)
        assert not stage.is_moving
        ((name, place),) = target.items()
        assert stage.position()[name] == pytest.approx(place, abs=2 * stage.axes[0].resolution)

    def test_stop_from_another_thread_ends_a_blocking_move(self, stage: Stage) -> None:
        target = self.far(stage)
        ((name, place),) = target.items()
        start = stage.position()[name]
        outcome: list[BaseException | None] = []

        def move() -> None:
            try:
                stage.move_to(target)
                outcome.append(None)
            except StoppedError as error:
                outcome.append(error)

        mover = threading.Thread(target=move)
        mover.start()
        deadline = time.monotonic() + PATIENCE_S
        while not stage.is_moving and time.monotonic() < deadline:
            time.sleep(0.001)
        stage.stop()
        mover.join(PATIENCE_S)
        assert isinstance(outcome[0], StoppedError)
        assert not stage.is_moving
        here = stage.position()[name]
        assert min(start, place) <= here <= max(start, place)
        assert here != pytest.approx(place, abs=stage.axes[0].resolution)
        assert stage.commanded_position()[name] == pytest.approx(here)
        # It can go on afterwards.
        stage.move_to({name: start})

    def test_stop_without_a_move_does_nothing(self, stage: Stage) -> None:
        before = stage.position()
        stage.stop()
        stage.wait(PATIENCE_S)
        assert stage.position() == before
        assert stage.is_homed

    def test_duration_grows_with_distance(self, stage: Stage) -> None:
        here = stage.position()
        ((name, place),) = self.far(stage).items()
        whole = stage.move_duration_s(here, {name: place})
        half = stage.move_duration_s(here, {name: (here[name] + place) / 2})
        assert 0 < half < whole
        assert stage.move_duration_s(here, here) == 0
