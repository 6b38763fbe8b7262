"""How the pace goes coarser soon and finer late, picture after picture."""

from __future__ import annotations

import pytest

from recon.streams.pace import HOLD, Pace, Spent


def tell(pace: Pace, fixed_ms: float, step_ms: float, busy: float = 1.0, waiting_ms: float = 0.0) -> None:
    """Seven pictures of two iterations; everything takes ``busy`` times its work, and ``waiting_ms`` more."""
    for _ in range(7):
        fixed = Spent(busy * fixed_ms + waiting_ms, fixed_ms)
        pace.note(fixed, Spent(2 * busy * step_ms, 2 * step_ms), 2)


def turns(pace: Pace, budget_ms: float, at_most: int = 400) -> tuple[int, int]:
    """Return after how many pictures another level is wanted, and which; 0 if none is."""
    here = pace.next_level(budget_ms)
    for count in range(1, at_most):
        if here != pace._level:
            return count, here
        here = pace.next_level(budget_ms)
    return 0, here


def test_pace_goes_coarser_soon_and_finer_late() -> None:
    pace = Pace([1, 2, 3, 4])
    assert pace.affordable(1, 33) == 2  # before anything is known
    tell(pace, 2, 12)
    assert pace.affordable(1, 33) == 2
    assert turns(pace, 33) == (0, 1)
    tell(pace, 2, 30)
    assert turns(pace, 33) == (3, 2)
    pace.enter(2)
    tell(pace, 0.5, 7)
    assert turns(pace, 33) == (0, 2)  # the finer one is known not to fit
    tell(pace, 0.5, 3)
    assert pace.cost(1).step.work_ms == 30
    assert turns(pace, 100) == (20, 1)


def test_pace_tries_a_finer_level_it_does_not_know_sooner() -> None:
    pace = Pace([1, 2, 3, 4])
    pace.enter(3)
    tell(pace, 1, 2)
    assert turns(pace, 33) == (5, 2)


def test_pace_takes_one_slow_picture_for_what_it_is() -> None:
    pace = Pace([1, 2])
    tell(pace, 2, 12)
    pace.note(Spent(5000, 2), Spent(24, 24), 2)
    assert pace.affordable(1, 33) == 2


def test_pace_takes_back_a_coarser_level_that_did_not_help() -> None:
    pace = Pace([1, 2, 3, 4])
    tell(pace, 5, 20, busy=2.5)  # work of 45 ms takes 112: pixels seem to matter
    assert turns(pace, 33) == (3, 2)
    pace.enter(2)
    tell(pace, 1, 5, waiting_ms=95)  # they did not
    assert pace.next_level(33) == 1
    pace.enter(1)
    tell(pace, 5, 20, busy=2.5)
    count, level = turns(pace, 33)
    assert (level, count) == (2, HOLD + 2)  # tried again, much later


def test_pace_keeps_a_coarser_level_that_helped_though_not_enough() -> None:
    pace = Pace([1, 2, 3, 4])
    tell(pace, 5, 20, busy=4)
    pace.enter(2)
    tell(pace, 1, 5, waiting_ms=60)
    assert pace.next_level(33) == 2
    assert turns(pace, 33) == (0, 2)  # it is not work that takes the time: no coarser


@pytest.mark.parametrize(("took_ms", "level"), [(89, 10), (92, 9)])
def test_pace_asks_of_a_small_step_half_of_what_it_can_save(took_ms: float, level: float) -> None:
    """Pixels a tenth larger are 19 % fewer: 9.5 % less time is what helps."""
    pace = Pace([9, 10])
    tell(pace, 20, 40)
    pace.enter(10)
    tell(pace, 20, (took_ms - 20) / 2)
    assert pace.next_level(33) == level


def test_pace_waits_longer_for_a_finer_level_that_failed() -> None:
    pace = Pace([1, 2])
    tell(pace, 2, 30)
    pace.enter(2)
    tell(pace, 1, 3)
    assert turns(pace, 100)[0] == 20
    pace.enter(1)
    tell(pace, 2, 30, busy=3)
    assert turns(pace, 100)[1] == 2
    pace.enter(2)
    tell(pace, 1, 3)
    assert turns(pace, 100)[0] == 40


def test_pace_tells_from_wiener_pictures_that_there_is_time_again() -> None:
    pace = Pace([1])
    tell(pace, 2, 12)
    pace.note_filter(Spent(5, 5))
    for _ in range(7):
        pace.note_filter(Spent(50, 5))
    assert pace.affordable(1, 33) == 0
    for _ in range(7):
        pace.note_filter(Spent(5, 5))
    assert pace.affordable(1, 33) == 2
