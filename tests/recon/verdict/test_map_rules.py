"""A map's severities by their definitions: errors, a ring of frequencies, limits; cells, rows and borders."""

from __future__ import annotations

import numpy as np
import pytest

from recon.solvers.base import IterationRecord, StopReason
from recon.verdict.map import (
    WORST,
    Cell,
    Failure,
    Stress,
    Trial,
    boundary,
    bounded,
    cell_of,
    convergence_severity,
    relative_error,
    resolution_severity,
    ring_correlation,
    trivial_error,
    worst,
)

RNG = np.random.default_rng(11)
SIZE = 48


def waves(period_px: float, *, turned: bool = False, phase: float = 0.0) -> np.ndarray:
    """Return waves along the rows, or the columns, about a mean that does not count."""
    places = np.mgrid[:SIZE, :SIZE][0 if turned else 1]
    return np.asarray(5 + np.cos(2 * np.pi * places / period_px + phase))


def test_the_trivial_picture_may_choose_its_scale_and_its_offset() -> None:
    truth, other = RNG.random((3, 5, 6)), RNG.random((3, 5, 6))
    assert trivial_error(2.5 - 0.3 * truth, truth) == pytest.approx(0, abs=1e-12)
    assert trivial_error(np.ones_like(truth), truth) == pytest.approx(
        np.std(truth) / np.sqrt(np.mean(truth**2))
    )
    # Of what is left after the best line the error is the share that does not correlate.
    r = np.corrcoef(other.ravel(), truth.ravel())[0, 1]
    expected = np.std(truth) * np.sqrt(1 - r**2) / np.sqrt(np.mean(truth**2))
    assert trivial_error(other, truth) == pytest.approx(expected)


@pytest.mark.parametrize("shape", [(7, 9), (2, 5, 6), (2, 3, 4, 5)])
def test_an_error_is_the_sine_of_the_angle_whatever_the_dimensions(shape: tuple[int, ...]) -> None:
    found, truth = RNG.random(shape), RNG.random(shape)
    cosine = np.vdot(found, truth) / np.linalg.norm(found) / np.linalg.norm(truth)
    assert relative_error(found, truth) == pytest.approx(np.sqrt(1 - cosine**2))
    assert relative_error(3 * truth, truth) == pytest.approx(0, abs=1e-7)


def test_only_frequencies_near_the_period_correlate() -> None:
    here, beside, noise = waves(8), waves(8, turned=True), RNG.normal(size=(SIZE, SIZE))
    assert ring_correlation(here, here, 8) == pytest.approx(1)
    assert ring_correlation(7 - 2 * here, here, 8) == pytest.approx(-1)
    assert ring_correlation(waves(8, phase=np.pi / 3), here, 8) == pytest.approx(0.5, abs=0.02)
    assert ring_correlation(beside, here, 8) == pytest.approx(0, abs=0.02)
    for other in (waves(4), waves(16)):  # strong, and off the ring
        assert ring_correlation(here + 30 * other, here + noise / 10, 8) > 0.9
    for period_px in (8 * 1.15, 8 / 1.15):  # within a fifth of its frequency
        assert ring_correlation(waves(period_px), waves(period_px), 8) == pytest.approx(1)
        assert ring_correlation(here + waves(period_px), here, 8) < 0.9
    long = np.pad(RNG.normal(size=(30, 20)), ((0, 1), (0, 4)))
    assert -1 <= ring_correlation(long, long[::-1], 5) < 1
    assert ring_correlation(1e-9 * here, here, 8) == pytest.approx(1)
    assert ring_correlation(np.ones((SIZE, SIZE)), here, 8) == 0


def test_a_ring_weighs_the_middle_as_a_window_does() -> None:
    """By hand: Hann windows without their zeros, the mean taken off before."""
    found, truth = RNG.random((12, 10)), RNG.random((12, 10))
    windowed = [
        (v - v.mean())
        * np.sin(np.pi * np.arange(1, 13) / 13)[:, None] ** 2
        * np.sin(np.pi * np.arange(1, 11) / 11) ** 2
        for v in (found, truth)
    ]
    a, b = (np.fft.rfft2(v) for v in windowed)
    frequency = np.hypot(np.fft.fftfreq(12)[:, None], np.fft.rfftfreq(10))
    ring = (frequency >= 0.8 / 4) & (frequency <= 1.2 / 4)
    expected = np.sum((a * b.conj()).real[ring]) / np.sqrt(
        np.sum(np.abs(a[ring]) ** 2) * np.sum(np.abs(b[ring]) ** 2)
    )
    assert ring_correlation(found, truth, 4) == pytest.approx(expected)


def test_resolution_is_lost_where_half_the_details_are() -> None:
    here = waves(8)
    assert resolution_severity(here, here, 4) == pytest.approx(0.5)  # twice what is resolved
    assert resolution_severity(waves(8, phase=np.pi / 3), here, 4) == pytest.approx(1, rel=0.05)
    assert resolution_severity(-here, here, 4) == WORST


@pytest.mark.parametrize(
    ("reason", "tolerance", "change", "severity"),
    [
        (StopReason.ITERATIONS, 1e-3, 0.01, 1.0),
        (StopReason.ITERATIONS, 1e-3, 0.002, 0.2),
        (StopReason.ITERATIONS, 1e-3, 90.0, WORST),
        (StopReason.ITERATIONS, 0.0, 0.01, 0.0),
        (StopReason.ITERATIONS, 0.5, 5.0, 1.0),
        (StopReason.CONVERGED, 1e-3, 0.01, 0.0),
        (StopReason.NOT_FINITE, 1e-3, 0.01, WORST),
        (None, 1e-3, 0.01, 0.0),
    ],
)
def test_a_run_that_a_limit_ended_is_as_bad_as_its_last_change(
    reason: StopReason | None, tolerance: float, change: float, severity: float
) -> None:
    history = tuple(IterationRecord(n, 1.0, change=c) for n, c in enumerate((7.0, 8.0, change)))
    assert convergence_severity(history, reason, tolerance) == pytest.approx(severity)
    if reason is StopReason.ITERATIONS:
        assert convergence_severity((), reason, tolerance) == 0


def test_severities_have_an_end_and_the_worst_counts() -> None:
    nan = float("nan")
    assert [bounded(s) for s in (-1.0, 0.3, 99.0, 1e9, nan)] == [0.0, 0.3, WORST, WORST, WORST]
    assert worst({Failure.SPOTS: 0.9, Failure.DIP: 0.4}) == (0.9, None)
    assert worst({Failure.SPOTS: 1.0, Failure.DIP: 0.4}) == (1.0, Failure.SPOTS)
    assert worst({Failure.SPOTS: 1.0, Failure.DIP: 1e9}) == (WORST, Failure.DIP)
    with pytest.raises(ValueError, match="at least one criterion"):
        worst({})


def test_a_cell_keeps_its_scenes_evidence_and_has_none_where_nothing_was_reconstructed() -> None:
    stress = Stress("a", "a", "e", (1.0, 2.0, 3.0), (1.0, 3.0))
    assert (stress.at("full"), stress.at("quick")) == ((1.0, 2.0, 3.0), (1.0, 3.0))
    cell = cell_of("admm tv", 2, 1, Trial(0.5, {Failure.DIP: 2.0}, {"lit": 0.1}), 0.25)
    assert (cell.ix, cell.iy, cell.error, cell.severity, cell.seconds) == (2, 1, 0.5, 2.0, 0.25)
    assert (cell.failure, cell.evidence) == (Failure.DIP, ({"lit": 0.1, "severity": 2.0},))
    assert cell.as_json()["failure"] == "dip"
    assert Cell.from_json(cell.as_json()) == cell
    works = cell_of("admm tv", 0, 0, Trial(0.5, {Failure.DIP: 0.5}), 0.0)
    assert (works.evidence, works.failure, works.as_json()["failure"]) == ((), None, None)
    assert Cell.from_json(works.as_json()) == works


@pytest.mark.parametrize(
    ("row", "at"),
    [
        ([4.0, 0.25, 0.25, 0.25], [1.5]),  # as many times above as below: half way
        ([0.25, 0.25, 4.0, 4.0], [2.5]),
        ([2.0, 0.25, 0.1, 0.1], [1 + 1 / 3]),
        ([1.0, 0.5, 0.5, 0.5], [1.0]),  # from 1 on it fails
        ([9.0, 9.0, 0.0, 0.0], [2 + np.log(9) / np.log(9e6)]),
        ([4.0, 0.25, float("nan"), 0.25], []),
        ([4.0, 4.0, 1.0, 1.0], []),
        ([0.25, 4.0, 0.25, 0.25], [2.5]),  # one odd cell at the edge
    ],
)
def test_a_row_crosses_where_its_severity_is_one(row: list[float], at: list[float]) -> None:
    found = boundary((1.0, 2.0, 3.0, 4.0), (7.0,), np.array([row]), logarithmic=False)
    assert found == [(pytest.approx(place), 7.0) for place in at]
    x = (1.0, 10.0, 100.0, 1000.0)
    found = boundary(x, (7.0,), np.array([row]), logarithmic=True)
    assert found == [(pytest.approx(10 ** (place - 1)), 7.0) for place in at]
    two = boundary(x, (7.0, 8.0), np.array([row, [4.0, 0.25, 0.25, 0.25]]), logarithmic=True)
    assert two[-1] == (pytest.approx(10**0.5), 8.0), "a row without a border does not end the others"


def test_a_map_with_other_rows_than_values_has_no_border() -> None:
    with pytest.raises(ValueError, match="shorter"):
        boundary((1.0, 2.0), (1.0, 2.0), np.array([[4.0, 0.25]]), logarithmic=False)


def test_of_several_crossings_that_counts_which_leaves_the_fewest_cells_on_the_wrong_side() -> None:
    def misplaced(fails: list[bool], border: int) -> int:
        sides = [fails[border]] * (border + 1) + [fails[border + 1]] * (len(fails) - border - 1)
        return sum(one != other for one, other in zip(fails, sides, strict=True))

    for _ in range(60):
        row = RNG.choice([0.25, 4.0], 9)
        fails = [bool(severity > 1) for severity in row]
        borders = [c for c in range(8) if fails[c] != fails[c + 1]]
        if not borders:
            continue
        [(at, _)] = boundary(tuple(range(9)), (1.0,), row[None], logarithmic=False)
        fewest = min(misplaced(fails, c) for c in borders)
        assert at == next(c for c in borders if misplaced(fails, c) == fewest) + 0.5
