"""The 3D camera against brute force, and its adjoint."""

import numpy as np
import pytest
from scipy.signal import convolve2d

from recon.base import threads
from recon.camera.base import estimate_norm
from recon.camera.convolution import GROUPS, Convolution, PlaneGroups, field_of
from recon.errors import InputError


def dot_test(operator, rtol, seed=0):
    rng = np.random.default_rng(seed)
    x = rng.standard_normal(operator.domain_shape).astype(operator.dtype)
    y = rng.standard_normal(operator.range_shape).astype(operator.dtype)
    left = np.vdot(operator.forward(x).astype(np.float64), y)
    right = np.vdot(x.astype(np.float64), operator.adjoint(y))
    scale = np.linalg.norm(operator.forward(x)) * np.linalg.norm(y)
    assert abs(left - right) <= rtol * scale


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float32, 1e-6), (np.float64, 1e-14)])
@pytest.mark.parametrize(
    ("psf_shape", "sensor", "n_z", "channels"),
    [
        ((7, 6), (9, 11), 3, 1),
        ((12, 13), (5, 4), 2, 3),
        ((1, 1), (1, 1), 1, 1),
        ((8, 8), (8, 8), 11, 2),
        ((5, 6), (7, 8), 1, 2),
    ],
    ids=["odd", "PSF larger than sensor", "one pixel", "many planes", "one plane"],
)
def test_adjoint(psf_shape, sensor, n_z, channels, dtype, rtol):
    psfs = np.random.default_rng(1).random((n_z, 1, *psf_shape)).astype(dtype)
    dot_test(Convolution(psfs, sensor, n_channels=channels, dtype=dtype), rtol)


def test_equals_a_sum_of_full_convolutions():
    rng = np.random.default_rng(2)
    psfs = rng.random((3, 2, 5, 6))
    operator = Convolution(psfs, (7, 8), dtype=np.float64)
    x = np.zeros(operator.domain_shape)
    height, width = operator.field_shape
    x[..., :height, :width] = rng.random((2, 3, height, width))
    expected = np.zeros(operator.range_shape)
    for c in range(2):
        for z in range(3):
            expected[c] += convolve2d(x[c, z, :height, :width], psfs[z, c], "valid")
    np.testing.assert_allclose(operator.forward(x), expected, rtol=1e-12)


def test_one_depth_is_the_camera_of_one_depth():
    rng = np.random.default_rng(3)
    psf = rng.random((1, 1, 6, 5))
    flat = Convolution(psf[0], (8, 9), dtype=np.float64)
    deep = Convolution(psf, (8, 9), dtype=np.float64)
    x = rng.random(flat.domain_shape)
    np.testing.assert_allclose(deep.forward(x[:, None]), flat.forward(x), rtol=1e-12)
    assert deep.centre == flat.centre
    assert deep.norm_bound == pytest.approx(flat.norm_bound)


@pytest.mark.parametrize("n_z", [1, 3])
def test_power_is_that_of_the_psfs_transforms(n_z):
    psfs = np.random.default_rng(4).random((n_z, 2, 5, 4))
    camera = Convolution(psfs, (6, 7), dtype=np.float64)
    expected = np.sum(np.abs(np.fft.rfft2(psfs, camera.grid_shape)) ** 2, axis=0)
    np.testing.assert_allclose(camera.power(), expected)


@pytest.mark.parametrize("n_z", [1, 2, 4])
def test_norm_bound_holds(n_z):
    operator = Convolution(np.random.default_rng(4).random((n_z, 1, 8, 8)), (8, 8), dtype=np.float64)
    assert 0.3 * operator.norm_bound < estimate_norm(operator) <= operator.norm_bound


def test_threads_do_not_change_a_bit():
    rng = np.random.default_rng(5)
    operator = Convolution(rng.random((13, 1, 9, 8)).astype(np.float32), (9, 8))
    x = rng.random(operator.domain_shape).astype(np.float32)
    before = threads.get_threads()
    try:
        results = []
        for n in (1, 3):
            threads.set_threads(n)
            results.append(operator.forward(x))
    finally:
        threads.set_threads(before)
    np.testing.assert_array_equal(*results)


@pytest.mark.parametrize("n_planes", [0, 1, 5, GROUPS, 11])
def test_each_plane_is_in_one_run_of_few(n_planes):
    runs = {}
    PlaneGroups(n_planes).run(lambda group, first, last: runs.update({group: range(first, last)}))
    assert [z for group in sorted(runs) for z in runs[group]] == list(range(n_planes))
    assert len(runs) == min(n_planes, GROUPS)
    assert [group for group in sorted(runs) for _ in runs[group]] == list(PlaneGroups(n_planes).of_plane)


def test_refuses_an_empty_depth_list():
    with pytest.raises(InputError, match="list of depths is empty"):
        Convolution(np.zeros((0, 1, 4, 4), np.float32), (4, 4))


@pytest.mark.parametrize(("sensor", "psf_shape"), [((7, 9), (5, 4)), ((8, 6), (4, 5))])
def test_a_source_on_the_axis_casts_the_psfs_centre_on_the_sensors(sensor, psf_shape) -> None:
    (height, width), (row, column) = field_of(sensor, psf_shape)
    assert (height, width) == (sensor[0] + psf_shape[0] - 1, sensor[1] + psf_shape[1] - 1)
    psf = np.random.default_rng(0).random(psf_shape)
    camera = Convolution(psf[None], sensor, dtype=np.float64)
    scene = np.zeros(camera.domain_shape)
    scene[..., row, column] = 1.0  # an index: a whole number
    seen = camera.forward(scene)[0]
    assert seen[sensor[0] // 2, sensor[1] // 2] == pytest.approx(psf[psf_shape[0] // 2, psf_shape[1] // 2])


def test_planes_of_an_adjoint_are_the_whole_ones():
    rng = np.random.default_rng(6)
    for channels in (1, 2):
        operator = Convolution(rng.random((3, channels, 5, 6)), (7, 8), n_channels=2, dtype=np.float64)
        y = rng.random(operator.range_shape)
        whole = operator.adjoint(y)
        for channel in (0, 1):
            planes = np.stack(list(operator.adjoint_planes(y, channel)))
            np.testing.assert_allclose(planes, whole[channel], atol=1e-12)


def test_psfs_may_be_a_list_and_have_to_be_numbers():
    listed = Convolution([[[1.0, 2.0], [3.0, 4.0]]], (4, 4))
    assert listed.is_picture
    assert listed.domain_shape[0] == 1
    for nonsense in (np.full((1, 2, 2), "a"), np.full((1, 2, 2), 1j), None):
        with pytest.raises(InputError, match="psfs must be an array"):
            Convolution(nonsense, (4, 4))
