"""What ends a run, record by record, and what a run keeps and falls back on: of solvers that do as told."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from recon.priors import NonNegativity
from recon.solvers.base import IterationRecord, Solver, StopCheck, StoppingRules, StopReason

NAN = float("nan")


def ends(rules: StoppingRules, *records: dict[str, Any]) -> list[StopReason | None]:
    """Return what is said of records, one after the other, each of a second."""
    check = StopCheck(rules)
    return [check(IterationRecord(n, float(n), **known)) for n, known in enumerate(records, 1)]


def test_unrest_is_the_change_or_a_tenth_of_the_residuals_that_are_known() -> None:
    def unrest(**known: float) -> float:
        return IterationRecord(1, 1.0, **known).unrest

    assert unrest(change=0.25) == 0.25
    assert unrest(change=0.25, primal_residual=5.0) == 0.5
    assert unrest(change=0.25, dual_residual=5.0, primal_residual=4.0) == 0.5
    assert unrest(change=0.75, dual_residual=5.0) == 0.75


@pytest.mark.parametrize(
    ("known", "reason"),
    [
        ({"change": NAN}, StopReason.NOT_FINITE),
        ({"change": np.inf}, StopReason.NOT_FINITE),
        ({"change": 0.1, "data_residual": np.inf}, StopReason.NOT_FINITE),
        ({"change": 0.1, "objective": -np.inf}, StopReason.NOT_FINITE),
        ({"change": 0.1, "objective": NAN, "data_residual": NAN}, None),
        ({"change": 0.1, "data_residual": 2.0}, StopReason.NOISE_LEVEL),
        ({"change": 0.1, "data_residual": 2.001}, None),
    ],
)
def test_what_is_lost_and_what_is_down_to_the_noise_end_at_once(
    known: dict[str, float], reason: StopReason | None
) -> None:
    assert ends(StoppingRules(noise_norm=2.0), known) == [reason]


def test_calm_is_asked_for_three_times_in_a_row_and_below_the_tolerance() -> None:
    calm, at_it = {"change": 0.09}, {"change": 0.1}
    rules = StoppingRules(tolerance=0.1)
    assert ends(rules, calm, calm, at_it, calm, calm, calm) == [None] * 5 + [StopReason.CONVERGED]
    assert ends(StoppingRules(tolerance=0.1, patience=1), calm) == [StopReason.CONVERGED]
    rough = calm | {"primal_residual": 1.0}
    assert ends(rules, calm, calm, rough, calm) == [None] * 4
    still = {"change": 0.0}
    assert ends(StoppingRules(tolerance=0, patience=0), still, still) == [None, None]
    assert ends(StoppingRules(tolerance=0), *[still] * 5) == [None] * 5


def test_time_and_iterations_end_a_run_when_they_are_reached() -> None:
    known = {"change": 1.0}
    assert ends(StoppingRules(time_s=3.0), *[known] * 3) == [None, None, StopReason.TIME]
    assert ends(StoppingRules(iterations=3), *[known] * 3) == [None, None, StopReason.ITERATIONS]
    assert ends(StoppingRules(iterations=1), known) == [StopReason.ITERATIONS]
    assert ends(StoppingRules(iterations=None), *[known] * 3) == [None] * 3
    assert ends(StoppingRules(iterations=None, time_s=1.5, tolerance=0), known) == [None]


class Told(Solver):
    """Halves two numbers; a second of the test's clock an iteration."""

    state_names = ("_x", "part.count")

    def __init__(self, now_s: list[float], changes: list[float] | None = None) -> None:
        super().__init__()
        self._x = np.array([4.0, 8.0])
        self.part = SimpleNamespace(count=0)
        self._now_s, self._changes = now_s, list(changes or [])
        self.confirmed = 0
        self.confirms = True
        self.compiled = False

    def step(self) -> IterationRecord:
        self._now_s[0] += 1.0
        self._x /= 2
        self.part.count += 1
        return IterationRecord(0, 0.0, change=self._changes.pop(0) if self._changes else 1.0)

    def compile(self) -> None:
        self._now_s[0] += 1000.0
        self.compiled = True

    def confirm(self) -> bool:
        self.confirmed += 1
        return self.confirms

    @property
    def solution(self) -> np.ndarray:
        return self._x


@pytest.fixture
def now_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    clock = [50.0]
    monkeypatch.setattr("recon.solvers.base.time", SimpleNamespace(perf_counter=lambda: clock[0]))
    return clock


class Kept:
    """A keeper that notes when it was asked."""

    def __init__(self, history: tuple[IterationRecord, ...] = ()) -> None:
        self.history, self.calls = history, []

    def resume(self, part: str, solver: Solver) -> tuple[IterationRecord, ...]:
        self.calls.append((part, "resumed"))
        solver.iteration = len(self.history)
        return self.history

    def keep(self, part: str, solver: Solver, history: Any, *, ended: bool) -> None:
        self.calls.append((part, solver.iteration, len(history), ended))


def test_time_is_that_of_iterations_alone_and_a_keeper_sees_each_and_the_end(now_s: list[float]) -> None:
    solver, kept, seen = Told(now_s), Kept(), []

    def watch(_: Solver, record: IterationRecord) -> None:
        now_s[0] += 100.0
        seen.append((record.iteration, record.seconds))

    rules = StoppingRules(iterations=3, tolerance=0)
    out = solver.run(rules, callback=watch, keeper=kept, part="a")
    assert solver.compiled
    assert seen == [(1, 1.0), (2, 2.0), (3, 3.0)]
    assert [(r.iteration, r.seconds) for r in out.history] == seen
    assert out.seconds == 3.0
    assert kept.calls == [("a", "resumed"), *[("a", n, n, False) for n in (1, 2, 3)], ("a", 3, 3, True)]
    np.testing.assert_array_equal(out.solution, [0.5, 1.0])
    out.solution[:] = 9  # the caller's own
    np.testing.assert_array_equal(solver.solution, [0.5, 1.0])


def test_what_was_kept_counts_for_the_rules(now_s: list[float]) -> None:
    before = tuple(IterationRecord(n, 10.0 * n, change=c) for n, c in ((1, 1.0), (2, 0.05), (3, 0.05)))
    out = Told(now_s, [0.05, 0.05]).run(StoppingRules(tolerance=0.1), keeper=Kept(before))
    assert out.stop_reason is StopReason.CONVERGED
    assert [(r.iteration, r.seconds) for r in out.history] == [(1, 10.0), (2, 20.0), (3, 30.0), (4, 31.0)]
    calm = tuple(IterationRecord(n, 10.0 * n, change=0.05) for n in (1, 2, 3))
    solver = Told(now_s)
    assert len(solver.run(StoppingRules(tolerance=0.1), keeper=Kept(calm)).history) == 3
    assert solver.confirmed == 1
    solver = Told(now_s)
    solver.confirms = False  # something was left out: it goes on
    out = solver.run(StoppingRules(tolerance=0.1, iterations=5), keeper=Kept(calm))
    assert (len(out.history), out.stop_reason) == (5, StopReason.ITERATIONS)


def test_convergence_that_the_solver_denies_ends_nothing_and_other_rules_do(
    now_s: list[float],
) -> None:
    solver = Told(now_s, [0.05] * 9)
    solver.confirms = False
    out = solver.run(StoppingRules(tolerance=0.1, iterations=5))
    assert out.stop_reason is StopReason.ITERATIONS
    assert len(out.history) == 5, "not one more than was allowed"
    assert solver.confirmed == 3, "asked whenever it looks converged: from the third on"
    stop = threading.Event()
    stop.set()
    assert Told(now_s).run(StoppingRules(iterations=1), cancel=stop).stop_reason is StopReason.ITERATIONS
    out = Told(now_s).run(StoppingRules(iterations=9), cancel=stop)
    assert (out.stop_reason, len(out.history)) == (StopReason.CANCELLED, 1)


@pytest.mark.parametrize("falls_back", [True, False])
def test_an_iterate_that_is_lost_is_the_start_or_nothing(now_s: list[float], falls_back: bool) -> None:
    class Lost(Told):
        def _start(self) -> np.ndarray | None:
            return super()._start() if falls_back else None

        def step(self) -> IterationRecord:
            record = super().step()
            self._x[0] = NAN
            return record

    out = Lost(now_s).run(StoppingRules(iterations=2))
    assert out.stop_reason is StopReason.NOT_FINITE
    np.testing.assert_array_equal(out.solution, [4.0, 8.0] if falls_back else [0.0, 0.0])


def test_advancing_counts_and_a_checkpoint_is_a_copy_unless_asked_otherwise(now_s: list[float]) -> None:
    solver = Told(now_s)
    assert [solver.advance().iteration for _ in range(2)] == [1, 2]
    copied, shared = solver.checkpoint(), solver.checkpoint(copy=False)
    solver.advance()
    np.testing.assert_array_equal(copied["_x"], [1.0, 2.0])
    np.testing.assert_array_equal(shared["_x"], [0.5, 1.0])
    assert (copied["iteration"], copied["part.count"]) == (2, 2)
    other = Told(now_s)
    own = other.solution
    other.restore(copied)
    assert own is other.solution
    np.testing.assert_array_equal(own, [1.0, 2.0])
    assert (other.iteration, other.part.count) == (2, 2)
    with pytest.raises(KeyError, match="_x"):
        other.restore({"iteration": 1})


def test_what_priors_keep_is_kept_too(now_s: list[float]) -> None:
    class Split:
        kept = ("t",)

        def __init__(self) -> None:
            self.t = np.zeros(2)

        def checkpoint(self) -> dict[str, Any]:
            return {"t": self.t}

        def restore(self, kept: dict[str, Any]) -> None:
            self.t = kept["t"]

    def with_priors() -> Told:
        made = Told(now_s)
        made.prior, made.splits = NonNegativity(), [Split(), Split()]
        return made

    solver, other = with_priors(), with_priors()
    assert solver.prior is not None
    assert other.prior is not None
    other.prior.memory = np.ones(3)
    other.restore(solver.checkpoint())
    assert other.prior.memory is None
    solver.prior.memory = np.arange(3.0)
    first, second = solver.splits
    first.t, second.t = np.array([1.0, 2.0]), np.array([3.0, 4.0])  # type: ignore[attr-defined]
    state = solver.checkpoint()
    first.t[0] = 9  # type: ignore[attr-defined]
    other.restore(state)
    np.testing.assert_array_equal(other.prior.memory, [0, 1, 2])
    assert [list(split.t) for split in other.splits] == [[1, 2], [3, 4]]  # type: ignore[attr-defined]
