"""The shade that falls off towards a photograph's edges: what its numbers are, and how they are fitted."""

from __future__ import annotations

import numpy as np
import pytest

from recon.arrays import Float64Array
from recon.camera.vignetting import DEEPEST, ENOUGH, LEAST, NUMBERS, least_squares, shade_of

SLOPES = np.random.default_rng(3).standard_normal((40, NUMBERS))


def never(_: Float64Array) -> bool:
    return False


@pytest.mark.parametrize("shape", [(31, 41), (40, 24)])
def test_numbers_of_a_shade_are_of_squares_fourth_power_and_slopes(shape: tuple[int, int]) -> None:
    numbers = np.array([0.4, 0.7, 0.2, 0.3, -0.5])
    half = max(shape) / 2
    light = np.zeros(shape)
    for row in range(shape[0]):
        for column in range(shape[1]):
            y, x = (row - (shape[0] - 1) / 2) / half, (column - (shape[1] - 1) / 2) / half
            fallen = 0.4 * x**2 + 0.7 * y**2 + 0.2 * (x**2 + y**2) ** 2 + 0.3 * x - 0.5 * y
            light[row, column] = np.exp(-fallen)
    np.testing.assert_allclose(shade_of(numbers, shape), light / light.max(), rtol=1e-5)


def test_no_shade_is_deeper_than_the_deepest() -> None:
    assert shade_of(np.array([9.0, 9.0, 0, 0, 0]), (30, 30)).min() == np.float32(DEEPEST)


def test_what_is_fitted_has_the_least_misfit_and_penalty() -> None:
    wanted = 10 * np.random.default_rng(4).standard_normal(len(SLOPES))
    found = least_squares(lambda n: SLOPES @ n - wanted, never)
    assert found is not None
    normal = SLOPES.T @ SLOPES / len(SLOPES) + LEAST * np.eye(NUMBERS)
    best = np.linalg.solve(normal, SLOPES.T @ wanted / len(SLOPES))
    np.testing.assert_allclose(found, best, rtol=0.03, atol=0.01)


def test_a_slight_shade_is_found_where_much_speaks_for_it() -> None:
    found = least_squares(lambda n: 10 * SLOPES @ (n - 0.05), never)
    np.testing.assert_allclose(found, 0.05, rtol=0.05)


def test_where_nothing_is_gained_it_ends() -> None:
    """A reconstruction each: one try at each damping, at most."""
    tried: list[Float64Array] = []
    unexplained = np.linalg.qr(SLOPES, mode="complete")[0][:, -1] * 30

    def left(numbers: Float64Array) -> Float64Array:
        tried.append(numbers)
        return np.asarray(SLOPES @ numbers + unexplained)

    found = least_squares(left, never)
    np.testing.assert_allclose(found, 0, atol=1e-6)
    np.testing.assert_array_equal(tried[0], 0)
    assert len(tried) <= 1 + NUMBERS + 6


def test_it_ends_where_no_more_is_left_than_usual_errors_leave() -> None:
    truth = 0.2 * np.random.default_rng(5).standard_normal(NUMBERS) - 2
    tried: list[float] = []

    def left(numbers: Float64Array) -> Float64Array:
        rest = np.asarray(2 * SLOPES @ (numbers - truth) + 0.5)
        tried.append(float(np.mean(rest**2)))
        return rest

    found = least_squares(left, never)
    assert found is not None
    assert tried[0] > ENOUGH > tried[-1]
    assert len(tried) == 1 + NUMBERS + 1


def test_a_step_that_goes_too_far_is_damped_and_so_are_those_after_it() -> None:
    tried: list[Float64Array] = []

    def left(numbers: Float64Array) -> Float64Array:
        tried.append(numbers)
        return np.asarray(50 * np.arctan(4 * (np.append(numbers, numbers[0]) - 1.5)))

    found = least_squares(left, never)
    np.testing.assert_allclose(found, 1.5, atol=0.01)
    assert len(tried) <= 24  # 22 found, 25 and 1.1 where each step is damped anew


def test_what_comes_to_the_deepest_shade_is_none() -> None:
    wanted = SLOPES @ np.full(NUMBERS, 3.0)
    seen: list[Float64Array] = []

    def is_deepest(numbers: Float64Array) -> bool:
        seen.append(numbers)
        return bool(numbers[0] > 1)

    assert least_squares(lambda n: SLOPES @ n - wanted, is_deepest) is None
    assert len(seen) == 1
