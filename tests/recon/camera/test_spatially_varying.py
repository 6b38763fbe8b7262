"""Local and low-rank models against brute force, and their adjoints."""

import numpy as np
import pytest

from recon.base import fft
from recon.camera.base import estimate_norm
from recon.camera.convolution import Convolution
from recon.camera.spatially_varying import Axis
from recon.camera.varying_psfs import (
    FieldOfPsfs,
    cut_to_support,
    interpolation_weights,
    local_convolution,
    low_rank,
    principal_psfs,
)
from recon.errors import InputError

GRID = np.array([(y, x) for y in (-8, 1, 7) for x in (-9, 0, 8)], float)
SCATTERED = np.array([(-7, -8), (-6, 7), (0, 1), (8, -5), (7, 9), (2, -9)], float)
PLACES = pytest.mark.parametrize("points", [GRID, SCATTERED, SCATTERED[:1], SCATTERED[:2]])


def field(points, psf=(7, 6), channels=1, seed=0):
    rng = np.random.default_rng(seed)
    psfs = rng.random((len(points), channels, *psf))
    psfs[..., :1, :] = psfs[..., -2:] = 0  # so that cutting to the support has something to cut
    return FieldOfPsfs(psfs, points)


def brute_force(fields, sensor, x):
    """Eq. 5.5 pixel by pixel: every object pixel casts its own interpolated PSF."""
    height, width = fields[0].psfs.shape[2:]
    centre = sensor[0] // 2 + height - 1 - height // 2, sensor[1] // 2 + width - 1 - width // 2
    data = np.zeros((x.shape[0], sensor[0] + 2 * height, sensor[1] + 2 * width))
    for z, f in enumerate(fields):
        rows, columns = np.arange(x.shape[2]) - centre[0], np.arange(x.shape[3]) - centre[1]
        weights = interpolation_weights(f.points, np.eye(len(f.points)), rows, columns)
        for c in range(x.shape[0]):
            psfs = f.psfs[:, min(c, f.psfs.shape[1] - 1)]
            for i, j in np.ndindex(*x.shape[2:]):
                psf = np.tensordot(weights[:, i, j], psfs, 1)
                data[c, i : i + height, j : j + width] += x[c, z, i, j] * psf
    return data[:, height - 1 : height - 1 + sensor[0], width - 1 : width - 1 + sensor[1]]


def test_a_psf_is_cut_where_it_holds_less_than_a_millionth_of_its_maximum():
    psf = np.zeros((2, 1, 8, 9))
    psf[0, 0, 3, 4], psf[1, 0, 5, 4], psf[0, 0, 3, 7], psf[1, 0, 1, 4] = 100, 50, 5e-4, 5e-5
    cut, corner = cut_to_support(psf)
    assert corner == (3, 4)
    np.testing.assert_array_equal(cut, psf[..., 3:6, 4:8])
    assert cut_to_support(0 * psf)[0].shape == (2, 1, 1, 1)


@PLACES
def test_weights_are_a_partition_of_unity_and_exact_at_the_points(points):
    rows, columns = np.arange(-12, 13), np.arange(-11, 12)
    weights = interpolation_weights(points, np.eye(len(points)), rows, columns)
    assert (weights >= -1e-12).all()
    np.testing.assert_allclose(weights.sum(axis=0), 1, atol=1e-12)
    for i, (y, x) in enumerate(points.astype(int)):
        assert weights[i, y + 12, x + 11] == pytest.approx(1)


def test_weights_are_bilinear_on_a_grid():
    weights = interpolation_weights(GRID, np.eye(9), [-3.5], [4.0])[:, 0, 0]
    expected = np.zeros((3, 3))
    expected[:2, 1:] = 0.25
    np.testing.assert_allclose(weights.reshape(3, 3), expected)


@PLACES
@pytest.mark.parametrize("channels", [1, 2])
def test_local_convolution_masks_first_then_convolves(points, channels):
    fields = [field(points, channels=channels), field(points, channels=channels, seed=1)]
    operator = local_convolution(fields, (9, 11), dtype=np.float64)
    x = np.random.default_rng(2).random(operator.domain_shape)
    np.testing.assert_allclose(operator.forward(x), brute_force(fields, (9, 11), x), rtol=1e-10)


def test_light_that_reaches_no_sensor_has_no_norm():
    dark = FieldOfPsfs(np.zeros((1, 1, 4, 4)), GRID[:1])
    assert local_convolution([dark], (5, 5)).norm_bound == 0
    dim = FieldOfPsfs(np.full((1, 1, 4, 4), 1e-3), GRID[:1])  # rows and columns sum to 0.016
    assert local_convolution([dim], (5, 5)).norm_bound == pytest.approx(0.016, rel=1e-3)


@PLACES
def test_full_rank_equals_the_local_model(points):
    fields = [field(points)]
    local = local_convolution(fields, (9, 11), dtype=np.float64)
    full = low_rank(fields, (9, 11), rank=len(points), dtype=np.float64)
    x = np.random.default_rng(3).random(local.domain_shape)
    np.testing.assert_allclose(full.forward(x), local.forward(x), rtol=1e-6)


def test_one_point_is_the_camera_of_one_psf():
    f = field(GRID[:1])
    operator = local_convolution([f], (9, 11), dtype=np.float64)
    camera = Convolution(f.psfs[0], (9, 11), dtype=np.float64)
    height, width = operator.domain_shape[2:]
    x = np.zeros(camera.domain_shape)
    x[0, :height, :width] = np.random.default_rng(4).random((height, width))
    np.testing.assert_allclose(operator.forward(x[None, :, :height, :width][0][None]), camera.forward(x))


@PLACES
@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 1e-6), (np.float64, 1e-13)])
@pytest.mark.parametrize("build", [local_convolution, lambda f, s, **o: low_rank(f, s, error=0.3, **o)])
def test_adjoint_and_norm(points, build, dtype, rtol):
    operator = build([field(points, channels=2), field(points, channels=2)], (9, 11), dtype=dtype)
    rng = np.random.default_rng(5)
    x = rng.standard_normal(operator.domain_shape).astype(dtype)
    y = rng.standard_normal(operator.range_shape).astype(dtype)
    left, right = np.vdot(operator.forward(x), y), np.vdot(x, operator.adjoint(y))
    assert abs(left - right) <= rtol * np.linalg.norm(x) * np.linalg.norm(y) * operator.norm_bound
    norm = estimate_norm(operator, 200)
    assert norm <= operator.norm_bound * (1 + 1e-5)
    assert operator.norm_bound < 1.6 * norm


@PLACES
@pytest.mark.parametrize("build", [local_convolution, lambda f, s, **o: low_rank(f, s, error=1e-9, **o)])
def test_support_leaves_out_what_is_not_needed(points, build):
    fields = [field(points), field(points, seed=1)]
    whole = build(fields, (9, 11), dtype=np.float64)
    support = np.zeros(whole.domain_shape[1:], bool)
    support[1, 3:6, 4:11] = True
    support[1, 4, 5] = False
    part = build(fields, (9, 11), support=support, dtype=np.float64)
    x = np.random.default_rng(6).random(whole.domain_shape) * support
    np.testing.assert_allclose(part.forward(x), whole.forward(x), atol=1e-10)
    y = np.random.default_rng(7).random(whole.range_shape)
    np.testing.assert_allclose(part.adjoint(y), whole.adjoint(y) * support, atol=1e-10)
    assert part.fft_pixels < whole.fft_pixels / 2


def test_rank_follows_the_stated_error():
    rng = np.random.default_rng(8)
    basis, scores = rng.random((2, 1, 6, 6)), rng.random((9, 2))
    psfs = np.tensordot(scores, basis, 1) + 1e-4 * rng.standard_normal((9, 1, 6, 6))
    f = FieldOfPsfs(psfs, GRID)
    two = principal_psfs(f, error=0.01)
    assert two.components.shape[0] == 2
    assert two.error < 0.01
    rebuilt = np.tensordot(two.scores, two.components, 1)
    assert np.linalg.norm(rebuilt - psfs) == pytest.approx(two.error * np.linalg.norm(psfs), rel=1e-3)
    assert principal_psfs(f, rank=1).error > two.error


def test_refuses_in_words():
    with pytest.raises(InputError, match="list of depths is empty"):
        local_convolution([], (4, 4))
    with pytest.raises(InputError, match="row, column"):
        FieldOfPsfs(np.zeros((2, 1, 4, 4)), [(0, 0)])
    with pytest.raises(InputError, match="ranks from 1 to 9"):
        principal_psfs(field(GRID), rank=10)


def test_without_a_rank_or_an_error_two_per_cent_are_missed_at_most():
    psfs = np.diag([1, 0.03, 0.01]).reshape(3, 1, 1, 3)  # missed by one component 3.2 %, by two 1 %
    assert principal_psfs(FieldOfPsfs(psfs, SCATTERED[:3])).components.shape[0] == 2


def test_psfs_of_other_channels_are_refused():
    with pytest.raises(InputError, match="PSFs of 2 channels do not serve 3"):
        local_convolution([field(GRID, channels=2), field(GRID, channels=3)], (9, 9))


@pytest.mark.parametrize(("start", "length"), [(0, 26), (-8, 26), (-3, 23), (12, 26)])
def test_an_axis_is_as_long_as_what_must_not_be_wrapped_onto(start, length):
    axis = Axis.of(start, 17, 10, 20, real=True)
    assert axis.length == fft.fast_length(length, real=True)
