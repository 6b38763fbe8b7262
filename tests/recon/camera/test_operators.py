"""Operators: exact adjoints, agreement with brute force, safe norm bounds, centring."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import convolve2d

from recon.camera.base import LinearOperator, estimate_norm
from recon.camera.convolution import Convolution
from recon.camera.factors import Erasures, as_cropped_convolution
from recon.errors import StructureError


def matrix(operator: LinearOperator) -> np.ndarray:
    columns = np.eye(int(np.prod(operator.domain_shape)), dtype=operator.dtype)
    return np.stack([operator.forward(c.reshape(operator.domain_shape)).ravel() for c in columns], axis=1)


def dot_test(operator: LinearOperator, seed: int = 0) -> float:
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(operator.domain_shape).astype(operator.dtype)
    y = rng.standard_normal(operator.range_shape).astype(operator.dtype)
    ax, aty = operator.forward(x).astype(float), operator.adjoint(y).astype(float)
    return abs(np.vdot(ax, y) - np.vdot(x, aty)) / (np.linalg.norm(ax) * np.linalg.norm(y))


CASES = [
    ((1, 7, 9), (7, 9), 1),
    ((1, 8, 6), (8, 6), 3),
    ((3, 5, 4), (7, 10), 3),
    ((1, 12, 11), (6, 5), 1),
    ((2, 1, 1), (4, 3), 2),
    ((1, 1, 1), (1, 1), 1),
]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("psf_shape", "sensor_shape", "n_channels"), CASES)
def test_convolution_adjoint(psf_shape, sensor_shape, n_channels, dtype):
    psfs = np.random.default_rng(1).random(psf_shape)
    operator = Convolution(psfs, sensor_shape, n_channels=n_channels, dtype=dtype)
    assert dot_test(operator) < (1e-5 if dtype == np.float32 else 1e-13)
    assert operator.forward(np.ones(operator.domain_shape, dtype)).dtype == dtype


@pytest.mark.parametrize(("psf_shape", "sensor_shape", "n_channels"), CASES)
def test_convolution_equals_direct_sum(psf_shape, sensor_shape, n_channels):
    rng = np.random.default_rng(2)
    psfs = rng.random(psf_shape)
    operator = Convolution(psfs, sensor_shape, n_channels=n_channels, dtype=np.float64)
    height, width = operator.field_shape
    x = np.zeros(operator.domain_shape)
    x[:, :height, :width] = rng.random((n_channels, height, width))
    for channel, data in enumerate(operator.forward(x)):
        # "valid" of scipy swaps its inputs when the second is larger; the full sum cropped does not.
        full = convolve2d(x[channel, :height, :width], psfs[channel % len(psfs)])
        top, left = psf_shape[1] - 1, psf_shape[2] - 1
        assert data == pytest.approx(full[top : top + sensor_shape[0], left : left + sensor_shape[1]])


def test_pixels_beyond_the_field_do_not_reach_the_sensor():
    operator = Convolution(np.ones((1, 6, 6)), (6, 6), dtype=np.float64)
    height, width = operator.field_shape
    assert operator.grid_shape > operator.field_shape
    x = np.ones(operator.domain_shape)
    x[:, :height, :width] = 0
    assert np.abs(operator.forward(x)).max() < 1e-12


@pytest.mark.parametrize(
    ("psf_shape", "sensor_shape"), [((7, 9), (7, 9)), ((8, 6), (8, 6)), ((5, 4), (8, 11))]
)
def test_a_point_on_the_axis_casts_the_psf_with_centre_on_centre(psf_shape, sensor_shape):
    psf = np.random.default_rng(3).random(psf_shape)
    operator = Convolution(psf[None], sensor_shape, dtype=np.float64)
    x = np.zeros(operator.domain_shape)
    x[0, operator.centre[0], operator.centre[1]] = 1
    image = operator.forward(x)[0]
    expected = np.zeros(sensor_shape)
    top, left = (s // 2 - p // 2 for s, p in zip(sensor_shape, psf_shape, strict=True))
    expected[top : top + psf_shape[0], left : left + psf_shape[1]] = psf
    assert image == pytest.approx(expected)
    shifted = operator.forward(np.roll(x, (1, -1), (1, 2)))[0]
    assert shifted[1:, :-1] == pytest.approx(expected[:-1, 1:])


def test_norm_bound_is_above_the_norm():
    psfs = np.random.default_rng(4).random((2, 5, 6))
    operator = Convolution(psfs, (6, 7), dtype=np.float64)
    norm = np.linalg.norm(matrix(operator), 2)
    assert norm <= operator.norm_bound < 1.5 * norm
    assert estimate_norm(operator, iterations=300) == pytest.approx(norm, rel=1e-3)


def test_erasures_compose_with_the_camera():
    rng = np.random.default_rng(5)
    camera = Convolution(rng.random((1, 4, 5)), (5, 6), n_channels=2, dtype=np.float64)
    valid = rng.random((5, 6)) > 0.5
    erased = Erasures(valid, camera.range_shape, np.float64) @ camera
    assert dot_test(erased) < 1e-13
    x = rng.random(camera.domain_shape)
    assert np.array_equal(erased @ x, (camera @ x) * valid)
    assert matrix(erased) == pytest.approx(matrix(camera) * np.tile(valid.ravel(), 2)[:, None])
    assert erased.norm_bound >= np.linalg.norm(matrix(erased), 2)


def test_what_is_no_convolution_of_a_picture_is_told_as_what_it_is():
    camera = Convolution(np.ones((1, 4, 5)), (5, 6))
    erased = Erasures(np.ones((5, 6), bool), (1, 5, 6)) @ (Erasures(np.eye(5, 6) > 0, (1, 5, 6)) @ camera)
    cropped = as_cropped_convolution(erased)
    assert cropped.convolution is camera
    np.testing.assert_array_equal(cropped.weight[0], np.eye(5, 6))
    for other in (2 * camera, Convolution(np.ones((2, 1, 4, 5)), (5, 6))):
        with pytest.raises(StructureError, match="needs a Convolution of a picture"):
            as_cropped_convolution(other)


def test_composition_refuses_what_does_not_fit():
    camera = Convolution(np.ones((1, 4, 5)), (5, 6))
    with pytest.raises(ValueError, match=r"takes .1, 6, 5., the inner one gives .1, 5, 6."):
        Erasures(np.ones((6, 5), bool), (1, 6, 5)) @ camera
    with pytest.raises(ValueError, match="PSFs of 2 channels do not serve 3"):
        Convolution(np.ones((2, 4, 5)), (5, 6), n_channels=3)


def test_a_larger_grid_changes_no_measurement():
    rng = np.random.default_rng(3)
    psf = rng.random((1, 9, 11)).astype(np.float32)
    plain, wide = (Convolution(psf, (12, 10), grid_shape=grid) for grid in (None, (25, 24)))
    x = np.zeros(plain.domain_shape, np.float32)
    height, width = plain.field_shape
    x[:, :height, :width] = rng.random((height, width))
    larger = np.zeros(wide.domain_shape, np.float32)
    larger[:, :height, :width] = x[:, :height, :width]
    np.testing.assert_allclose(plain.forward(x), wide.forward(larger), rtol=1e-5)
    with pytest.raises(ValueError, match="does not hold"):
        Convolution(psf, (12, 10), grid_shape=(19, 24))


def two_cameras(dtype=np.float64):
    rng = np.random.default_rng(7)
    first, second = (Convolution(rng.random((2, 4, 5)), (6, 5), dtype=dtype) for _ in range(2))
    return first, second, Erasures(rng.random((2, 6, 5)) > 0.3, (2, 6, 5), dtype)


COMPOSITIONS = {
    "adjoint": lambda A, B, E: (A.H, lambda a, b, e: a.T),
    "scaled": lambda A, B, E: (2.5 * A, lambda a, b, e: 2.5 * a),
    "scaled from the right": lambda A, B, E: (A * np.float32(-0.5), lambda a, b, e: -0.5 * a),
    "NumPy's number": lambda A, B, E: (np.float64(3) * A, lambda a, b, e: 3 * a),
    "scaled twice": lambda A, B, E: (2 * (3 * A), lambda a, b, e: 6 * a),
    "negated": lambda A, B, E: (-A, lambda a, b, e: -a),
    "sum": lambda A, B, E: (A + B, lambda a, b, e: a + b),
    "difference": lambda A, B, E: (A - B, lambda a, b, e: a - b),
    "composition": lambda A, B, E: (E @ A, lambda a, b, e: e @ a),
    "normal operator": lambda A, B, E: (A.H @ A, lambda a, b, e: a.T @ a),
    "all of it": lambda A, B, E: ((E @ (2 * A - B)).H @ E, lambda a, b, e: (e @ (2 * a - b)).T @ e),
}


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("case", COMPOSITIONS.values(), ids=COMPOSITIONS)
def test_compositions_have_their_adjoint_their_matrix_and_a_safe_bound(case, dtype):
    parts = two_cameras(dtype)
    operator, of_matrices = case(*parts)
    assert operator.dtype == dtype
    assert operator.forward(np.ones(operator.domain_shape, dtype)).dtype == dtype
    assert dot_test(operator) < (1e-5 if dtype == np.float32 else 1e-13)
    expected = of_matrices(*(matrix(part) for part in parts))
    np.testing.assert_allclose(matrix(operator), expected, atol=1e-5 if dtype == np.float32 else 1e-12)
    assert np.linalg.norm(expected, 2) <= operator.norm_bound * (1 + 1e-5)
    out = np.empty(operator.range_shape, dtype)
    x = np.random.default_rng(0).random(operator.domain_shape).astype(dtype)
    assert operator.forward(x, out) is out
    np.testing.assert_array_equal(out, operator @ x)


def test_the_adjoints_adjoint_is_the_operator():
    camera, *_ = two_cameras()
    assert camera.H.H is camera


def test_an_operator_is_called_as_scipy_calls_it():
    from scipy.sparse.linalg import aslinearoperator, lsqr

    camera, _, erasures = two_cameras()
    operator = erasures @ camera
    x = np.random.default_rng(1).random(operator.domain_shape)
    np.testing.assert_array_equal(operator(x), operator @ x)
    for scipys in (operator.as_scipy(), aslinearoperator(operator)):
        assert scipys.shape == operator.shape == matrix(operator).shape
        np.testing.assert_array_equal(scipys @ x.ravel(), operator(x).ravel())
        np.testing.assert_array_equal(scipys.rmatvec(operator(x).ravel()), (operator.H @ operator(x)).ravel())
    found, *_ = lsqr(operator.as_scipy(), operator(x).ravel(), atol=1e-12, btol=1e-12)
    np.testing.assert_allclose(operator(found.reshape(x.shape)), operator(x), atol=1e-8)


def test_what_does_not_fit_is_refused_by_shape():
    camera, _, erasures = two_cameras()
    with pytest.raises(ValueError, match=r"Convolution takes arrays of shape \(2, 9, 10\), not \(3,\)"):
        camera(np.zeros(3))
    with pytest.raises(ValueError, match="takes arrays of shape"):
        camera.H @ np.zeros(camera.domain_shape)
    with pytest.raises(ValueError, match="domains"):
        camera + erasures
    with pytest.raises(ValueError, match="Cannot compose"):
        camera @ erasures
    with pytest.raises(ValueError, match="dtypes are float64 and float32"):
        camera - two_cameras(np.float32)[1]
    with pytest.raises(TypeError):
        1j * camera
    with pytest.raises(TypeError):
        camera + 1
