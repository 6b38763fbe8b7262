"""Condition numbers against a dense SVD; the window's reconstruction against a dense solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import nnls

from recon.analysis.gram import Voxel, WindowProblem, condition_curve, condition_number, gram_matrix, group
from recon.analysis.points import smallest_dip
from recon.errors import InputError


def planes(n_z: int = 4, shape: tuple[int, int] = (24, 30), seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random((n_z, *shape)).astype(np.float32)


def column(stack: np.ndarray, voxel: Voxel) -> np.ndarray:
    """The voxel's column of A, by brute force: every sensor pixel asks its PSF pixel."""
    height, width = stack.shape[1:]
    image = np.zeros((height, width))
    for row in range(height):
        for col in range(width):
            y, x = row - voxel.row, col - voxel.column
            if 0 <= y < height and 0 <= x < width:
                image[row, col] = stack[voxel.plane, y, x]
    return image.ravel()


@pytest.mark.parametrize(("direction", "count"), [("x", 2), ("x", 5), ("z", 3), ("xz", 4)])
@pytest.mark.parametrize("separation", [1, 3])
def test_condition_number_is_that_of_a_dense_svd(direction: str, count: int, separation: int) -> None:
    stack = planes(10)
    voxels = group(direction, count, separation)  # type: ignore[arg-type]
    assert len(voxels) == count
    dense = np.stack([column(stack, v) for v in voxels], axis=1)
    dense /= np.linalg.norm(dense, axis=0)
    values = np.linalg.svd(dense, compute_uv=False)
    assert condition_number(gram_matrix(stack, voxels)) == pytest.approx(values[0] / values[-1], rel=1e-9)


def test_columns_cropped_by_the_sensor_and_rows_count() -> None:
    stack = planes(2)
    voxels = [Voxel(0, -5, 20), Voxel(1, 7, -11), Voxel(0, -20, 0), Voxel(1, 3, 29)]
    dense = np.stack([column(stack, v) for v in voxels], axis=1)
    assert gram_matrix(stack, voxels) == pytest.approx(dense.T @ dense, rel=1e-12)


def test_dependent_columns_are_infinitely_ill_conditioned() -> None:
    stack = np.repeat(planes(1), 2, axis=0)
    assert condition_number(gram_matrix(stack, group("z", 2, 1))) == np.inf


def test_curves_fall_with_separation_and_grow_with_the_number_of_sources() -> None:
    """Fig. 4.5: smooth patterns are more alike when closer, and more of them are worse."""
    y, x = np.mgrid[:40, :120]
    rng = np.random.default_rng(0)
    psf = sum(
        np.exp(-((y - a) ** 2 + (x - b) ** 2) / 8) for a, b in rng.uniform(0.2, 0.8, (20, 2)) * (40, 120)
    )
    two, four = (condition_curve(np.asarray(psf)[None], "x", n, (1, 2, 4, 8)) for n in (2, 4))
    assert list(two.values) == sorted(two.values, reverse=True)
    assert all(b > a for a, b in zip(two.values, four.values, strict=True))


def test_groups_outside_the_stack_are_left_out_or_refused() -> None:
    assert condition_curve(planes(3), "z", 3, (1, 2)).separations == (1,)
    with pytest.raises(InputError, match="square"):
        group("xz", 5, 1)
    with pytest.raises(InputError, match="not within"):
        gram_matrix(planes(1), [Voxel(1)])


def test_a_window_is_reconstructed_as_by_a_dense_solver() -> None:
    """Non-negative least squares on explicit columns, on a sensor with a dark rim."""
    rng = np.random.default_rng(3)
    stack = np.zeros((2, 30, 40))
    stack[:, 8:-8, 10:-10] = rng.random((2, 14, 20))
    half = (1, 3)
    voxels = [Voxel(z, r, c) for z in range(2) for r in range(-1, 2) for c in range(-3, 4)]
    dense = np.stack([column(stack, v) for v in voxels], axis=1)
    truth = np.maximum(rng.normal(0, 1, len(voxels)), 0)
    data = dense @ truth + rng.normal(0, 0.05, dense.shape[0])
    expected, _ = nnls(dense, data)
    solution = WindowProblem(stack, half).solve(data.reshape(30, 40))
    assert solution.ravel() == pytest.approx(expected, abs=1e-4)


def test_the_windows_adjoint_is_the_columns_inner_products() -> None:
    stack = planes(2)
    problem = WindowProblem(stack, (2, 3))
    data = np.random.default_rng(4).random((24, 30))
    norms = np.linalg.norm(stack.reshape(2, -1).astype(float), axis=1)
    value = problem.adjoint(data)[1, 2 + 1, 3 - 2]
    assert value == pytest.approx(column(stack, Voxel(1, 1, -2)) @ data.ravel() / norms[1])


def test_dips_between_peaks_on_a_map() -> None:
    seen = np.zeros((1, 11))
    seen[0, [3, 7]] = 1.0, 0.8
    seen[0, 5] = 0.2
    places = np.array([[[0.0, 3.0], [0.0, 7.0]]])
    assert smallest_dip(seen + 0.1 * (seen == 0), places) == pytest.approx(1 - 0.1 / 0.8)
    merged = np.zeros((1, 11))
    merged[0, 3:8] = 1.0
    assert smallest_dip(merged, places) == 0.0
