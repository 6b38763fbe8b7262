"""How fine a live picture may be, number by number: what is measured, guessed, voted for and taken back."""

from __future__ import annotations

import pytest

from recon.streams.pace import HELPED, HOLD, LARGEST_PATIENCE, MEMORY, PATIENCE_FINER, SOON, Cost, Pace, Spent


def measured(pace: Pace, fixed: Spent, step: Spent, times: int = MEMORY) -> Pace:
    for _ in range(times):
        pace.note(fixed, step.scaled(2), 2)
    return pace


def test_times_add_and_scale() -> None:
    assert Spent(6, 2) + Spent(1, 0.5) == Spent(7, 2.5)
    assert Spent(6, 2) - Spent(1, 0.5) == Spent(5, 1.5)
    assert Spent(6, 2).for_work(5) == Spent(15, 5)
    assert Spent(6, 0).for_work(0.002) == Spent(pytest.approx(12), 0.002)
    assert Cost(Spent(6, 2), Spent(10, 4)).scaled(0.5) == Cost(Spent(3, 1), Spent(5, 2))
    assert Cost(Spent(6, 2), Spent(10, 4)).least == Spent(26, 10)


def test_the_median_of_the_last_seven_pictures_tells_what_one_takes() -> None:
    pace = Pace([1, 2])
    assert pace.cost(1) is pace.cost(2) is None
    for n in range(10):
        pace.note(Spent(n, n / 2), Spent(30 + 3 * n, 15), 3)
    assert pace.cost(1) == Cost(Spent(6, 3), Spent(16, 5))  # of n = 3 to 9
    assert pace.cost(2) == Cost(Spent(1.5, 0.75), Spent(4, 1.25))  # a quarter of the pixels


def test_a_filter_tells_how_busy_the_machine_is() -> None:
    pace = Pace([1])
    pace.note_filter(Spent(2, 2))
    assert pace.cost(1) is None
    pace.note(Spent(1, 1), Spent(20, 8), 2)
    steps = pace._record.step
    pace.note_filter(Spent(4, 4))  # twice as long as at best, so a step does too
    assert steps[-1] == Spent(20, 4)
    pace.note_filter(Spent(0.5, 0.5))  # the best by now
    assert steps[-1] == Spent(10, 4)
    for _ in range(5):
        pace.note(Spent(1, 1), Spent(50, 40), 1)
    pace.note(Spent(1, 1), Spent(5, 1), 1)
    pace.note_filter(Spent(0.5, 0.5))
    assert steps[-1] == Spent(5, 5)  # no more work than there is time


def test_what_another_level_takes_is_guessed_from_its_own_work_and_the_machine_s_waiting() -> None:
    pace = measured(Pace([1, 2, 4]), Spent(8, 4), Spent(20, 10))
    pace.enter(2)
    assert pace.cost(1) is None  # nothing is known of the one in use
    measured(pace, Spent(3, 1), Spent(9, 3))
    assert pace.cost(2) == Cost(Spent(3, 1), Spent(9, 3))
    assert pace.cost(1) == Cost(Spent(12, 4), Spent(30, 10))
    assert pace.cost(4) == Cost(Spent(0.75, 0.25), Spent(2.25, 0.75))


@pytest.mark.parametrize(
    ("fixed_ms", "step_ms", "budget_ms", "count"),
    [(3, 15, 33, 2), (3, 15, 32.9, 1), (3, 15, 48, 3), (3, 15, 2, 0), (3, 0, 4, 1000)],
)
def test_so_many_iterations_fit(fixed_ms: float, step_ms: float, budget_ms: float, count: int) -> None:
    pace = measured(Pace([1]), Spent(fixed_ms, fixed_ms), Spent(step_ms, step_ms))
    assert pace.affordable(1, budget_ms) == count
    assert pace.fits(1, budget_ms) is (count >= 2)


@pytest.mark.parametrize(
    ("here", "level", "left"),
    [(1, 3, (1, 2, 4)), (2, 2, (3, 4)), (3, 2, (3, 4)), (3, 1, (2, 3, 4)), (2, 4, (1, 2, 3)), (4, 4, ())],
)
def test_a_level_that_cannot_be_had_is_chosen_no_more(here: int, level: int, left: tuple[int, ...]) -> None:
    pace = Pace([1, 2, 3, 4])
    pace.enter(here)
    pace._came_from, pace._votes = (1, 5.0), 2
    pace.give_up(level)
    assert pace.levels == left
    assert (pace._came_from, pace._votes) == (None, 0)


@pytest.mark.parametrize(
    ("budget_ms", "step", "votes", "wanted"),
    [
        (33, Spent(10, 10), 3, 1),  # two fit
        (23, Spent(11, 11), 3, 2),  # they do not: the next that holds them
        (5, Spent(20, 20), 3, 4),  # two levels on
        (0.5, Spent(20, 20), 3, 4),  # none does: the coarsest
        (23, Spent(11, 2.1), 3, 1),  # it waits, it does not work: pixels cost nothing
        (23, Spent(11, 2.6), 3, 2),
        (23, Spent(11, 11), 2, 1),  # too few pictures to tell
    ],
)
def test_the_finest_level_that_leaves_time_for_two_iterations(
    budget_ms: float, step: Spent, votes: int, wanted: int
) -> None:
    pace = measured(Pace([1, 2, 4]), Spent(2, 0.2 * 2), step, votes)
    assert pace._right(budget_ms) == wanted
    pace._held = 1
    assert pace._right(budget_ms) == 1  # no coarser one while that is known not to help


def test_a_fifth_of_the_time_being_work_is_enough_to_try_coarser_pixels() -> None:
    assert measured(Pace([1, 2]), Spent(5, 1), Spent(10, 2))._right(20) == 2


@pytest.mark.parametrize(("budget_ms", "wanted"), [(54, 4), (56, 2), (219, 2), (221, 1), (13, 4), (9, 4)])
def test_a_finer_level_wants_a_quarter_more_than_it_takes(budget_ms: float, wanted: int) -> None:
    pace = Pace([1, 2, 4])
    pace.enter(4)
    measured(pace, Spent(1, 1), Spent(5, 5))  # 11 for a picture, so 44 of the next finer and 176
    assert pace._right(budget_ms) == wanted


def test_a_level_is_changed_when_several_pictures_in_a_row_ask_for_it() -> None:
    pace = measured(Pace([1, 2]), Spent(2, 2), Spent(20, 20))
    assert [pace.next_level(33) for _ in range(3)] == [1, 1, 2]
    assert [pace.next_level(33) for _ in range(2)] == [1, 1]  # not entered: voted for anew
    assert pace.next_level(500) == 1  # one that asks for nothing
    assert [pace.next_level(33) for _ in range(3)] == [1, 1, 2]
    pace.enter(2)
    measured(pace, Spent(0.5, 0.5), Spent(5, 5))
    assert [pace.next_level(500) for _ in range(PATIENCE_FINER)] == [2] * (PATIENCE_FINER - 1) + [1]
    new = Pace([1, 2])
    new.enter(2)
    measured(new, Spent(0.5, 0.5), Spent(5, 5))
    assert [new.next_level(500) for _ in range(5)] == [2, 2, 2, 2, 1]  # one that was never tried: sooner
    three = Pace([1, 2, 4])
    three.enter(2)
    measured(three, Spent(1, 1), Spent(10, 10))
    told = [three.next_level(budget_ms) for budget_ms in (500, 500, 5, 5, 500, 5, 5, 5)]
    assert told == [2] * 7 + [4]  # finer and coarser in turn count for nothing


def test_a_finer_level_that_had_to_be_left_soon_is_waited_for_longer() -> None:
    pace = Pace([1, 2])
    patience = []
    for pictures in (SOON - 1, SOON - 1, SOON - 1, SOON - 1, SOON - 1, SOON, SOON + 1):
        pace.enter(2)
        pace.enter(1)
        for _ in range(pictures):
            pace.next_level(33)
        pace.enter(2)
        patience.append(pace._patience)
    assert patience == [40, 80, 160, LARGEST_PATIENCE, LARGEST_PATIENCE, PATIENCE_FINER, PATIENCE_FINER]
    pace.enter(2)
    pace.enter(2)  # not left for a coarser one
    assert pace._patience == PATIENCE_FINER
    assert (pace._votes, pace._since, pace._went_finer) == (0, 0, False)


@pytest.mark.parametrize(
    ("level", "share", "helped"),
    [
        (2, HELPED - 0.01, True),
        (2, HELPED, True),
        (2, HELPED + 0.01, False),
        (1.25, 0.81, True),
        (1.25, 0.83, False),
    ],
)
def test_a_coarser_level_that_is_hardly_faster_is_left_again(
    level: float, share: float, helped: bool
) -> None:
    pace = measured(Pace([1, level]), Spent(10, 10), Spent(45, 45))
    pace.enter(level)
    assert pace._came_from == (1, 100)
    measured(pace, Spent(10 * share, 10 * share), Spent(45 * share, 45 * share), MEMORY - 1)
    assert pace.next_level(150) == level  # one picture more
    assert pace._came_from == (1, 100)
    measured(pace, Spent(10 * share, 10 * share), Spent(45 * share, 45 * share), 1)
    assert pace.next_level(150) == (level if helped else 1)
    assert (pace._came_from is None, pace._held) == (helped, 0 if helped else HOLD)


def test_after_a_coarser_level_did_not_help_none_is_tried_for_long() -> None:
    pace = measured(Pace([1, 2]), Spent(10, 10), Spent(45, 45))
    pace._held = HOLD
    told = [pace.next_level(33) for _ in range(HOLD + 3)]
    assert told.index(2) == HOLD + 1  # the hold is over with the last of its pictures; three have to ask
    pace._held = 1
    pace.enter(2)
    assert pace._came_from is None  # and what is entered meanwhile is not judged
    unknown = Pace([1, 2])
    unknown.enter(2)
    assert (unknown._came_from, unknown._known) == (None, {})
