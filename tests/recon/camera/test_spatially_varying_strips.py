"""Strips laid by hand against full convolutions: what reaches no sensor, many tiles, signs, cost."""

import numpy as np
import pytest
from scipy.signal import convolve2d

from recon.base.threads import get_threads, set_threads
from recon.camera.base import estimate_norm
from recon.camera.spatially_varying import RUN, Part, SpatiallyVarying, Strip, _tiling
from recon.camera.varying_psfs import FieldOfPsfs, local_convolution
from recon.errors import InputError

FIELD, SENSOR = (15, 61), (12, 57)
RNG = np.random.default_rng(0)


def part(rows, members, psf=(4, 5), channels=2, lowest=0.0):
    members = np.array(members)
    weights = RNG.uniform(lowest, 1, (len(members), rows.stop - rows.start))
    return Part(rows, members, weights, RNG.random((channels, len(members), *psf)))


def strip(z, window, parts, offset=(-1, -3), masks=2, lowest=0.0):
    shape = (masks, *(side.stop - side.start for side in window))
    return Strip(z, window, RNG.uniform(lowest, 1, shape), tuple(parts), offset)


def strips():
    whole = slice(0, 15), slice(0, 61)
    return [
        strip(0, whole, [part(slice(0, 9), (0, 1)), part(slice(7, 15), (1,))]),
        strip(2, (slice(3, 15), slice(20, 41)), [part(slice(4, 12), (0,), channels=1)], masks=1),
        strip(2, whole, [part(slice(0, 3), (1, 0)), part(slice(12, 15), (0,))], (-4, 0)),
        strip(2, (slice(0, 2), slice(0, 61)), [part(slice(0, 2), (0,))], (-8, 0)),  # above the sensor
        strip(1, (slice(0, 15), slice(0, 4)), [part(slice(0, 15), (0,))], (0, 57)),  # beside it
    ]


def brute_force(laid, x):
    """Each strip's object, by its masks and weights, convolved whole, and laid where it falls."""
    (height, width), margin = SENSOR, 80
    data = np.zeros((x.shape[0], height + 2 * margin, width + 2 * margin))
    for one in laid:
        rows, columns = one.window
        for p in one.parts:
            own = slice(p.rows.start - rows.start, p.rows.stop - rows.start)
            for channel, n in np.ndindex(len(x), len(p.members)):
                light = x[channel, one.z, p.rows, columns] * p.weights[n][:, None]
                light = convolve2d(light * one.masks[p.members[n], own], p.psfs[channel % len(p.psfs), n])
                down, right = margin + p.rows.start + one.offset[0], margin + columns.start + one.offset[1]
                data[channel, down : down + light.shape[0], right : right + light.shape[1]] += light
    return data[:, margin : margin + height, margin : margin + width]


def camera(laid):
    return SpatiallyVarying(laid, FIELD, SENSOR, n_z=3, n_channels=2, dtype=np.float64)


@pytest.mark.parametrize("threads", [1, 3])
def test_strips_are_sums_of_weighted_psfs_and_what_reaches_no_sensor_is_nothing(threads):
    laid = strips()
    before = get_threads()
    set_threads(threads)
    try:
        operator = camera(laid)
        x, y = RNG.standard_normal(operator.domain_shape), RNG.standard_normal(operator.range_shape)
        for _ in range(2):  # what was in the work arrays before does not count
            seen = operator.forward(x)
            np.testing.assert_allclose(seen, brute_force(laid, x), atol=1e-12)
            back = operator.adjoint(y)
            assert np.vdot(seen, y) == pytest.approx(np.vdot(x, back), rel=1e-12)
    finally:
        set_threads(before)
    assert back[:, 2].any()
    assert not back[:, 1].any()
    given = np.full(operator.range_shape, np.nan), np.full(operator.domain_shape, np.nan)
    assert operator.forward(x, given[0]) is given[0]
    assert operator.adjoint(y, given[1]) is given[1]
    np.testing.assert_array_equal(given[0], seen)
    np.testing.assert_array_equal(given[1], back)


def test_what_is_held_is_counted_before_it_is_made():
    operator = camera(strips())
    told = operator.nbytes
    operator.forward(np.zeros(operator.domain_shape))
    placed = [s for depth in operator._depths for s in depth]
    held = sum(a.nbytes for s in placed for a in (s.spectra, s.masks, s.weights))
    assert told == operator.nbytes == held + operator._object_work.nbytes + operator._sensor_work.nbytes
    assert len(placed) == 3
    for depth in operator._depths:  # of one depth at a time
        assert operator._object_work.size >= sum(int(np.prod(s.object_shape)) for s in depth)
    assert operator._object_work.size == sum(int(np.prod(s.object_shape)) for s in operator._depths[2])


def test_the_cost_is_half_a_transform_along_each_axis_there_and_back():
    """One PSF: rows of the object and of the sensor, and one set of columns each."""
    one = FieldOfPsfs(np.ones((1, 1, 4, 5)), np.zeros((1, 2)))
    operator = local_convolution([one, one], SENSOR)
    (placed,) = operator._depths[1]
    assert placed.height == operator.domain_shape[2] == SENSOR[0] + 3
    long, tall = placed.axis.length, int(placed.parts[0, 1])
    assert operator.fft_pixels == 2 * (long * (SENSOR[0] + 3 + SENSOR[0]) + 2 * long * tall)


def test_each_part_of_a_strip_costs_its_own_columns():
    first, second = part(slice(0, 9), (0, 1)), part(slice(7, 15), (1,))
    costs = [
        SpatiallyVarying([strip(0, (slice(0, 15), slice(0, 61)), parts)], FIELD, SENSOR, n_channels=2)
        for parts in ([first], [second], [first, second])
    ]
    (alone,), (other,), (both,) = (operator._depths[0] for operator in costs)
    rows = [both.axis.length * (2 * 15 + s.bottom - s.top) for s in (alone, other, both)]
    columns = [operator.fft_pixels - n for operator, n in zip(costs, rows, strict=True)]
    assert columns[2] == columns[0] + columns[1]
    assert columns == [both.axis.length * n for n in (3 * 12, 2 * 11, 3 * 12 + 2 * 11)]


def test_a_strip_costs_the_same_wherever_it_lies():
    own = part(slice(0, 15), (0,))
    costs = {
        SpatiallyVarying(
            [strip(0, (slice(0, 15), slice(left, left + 21)), [own])], FIELD, SENSOR, n_channels=2
        ).fft_pixels
        for left in (5, 20, 30)
    }
    assert len(costs) == 1


def test_tall_strips_are_added_once_whoever_adds_them():
    """More rows than a worker takes at once, of strips that begin below the first."""
    height = 3 * RUN + 5
    field, sensor = (height, 9), (height - 3, 6)
    laid = [
        strip(0, (slice(top, height), slice(0, 9)), [part(slice(top, height), (0,))], (-1, -2), masks=1)
        for top in (0, 70)
    ]
    before, backs = get_threads(), []
    x, y = RNG.standard_normal((2, 1, *field)), RNG.standard_normal((2, *sensor))
    try:
        for threads in (1, 3):
            set_threads(threads)
            operator = SpatiallyVarying(laid, field, sensor, n_channels=2, dtype=np.float64)
            backs.append(operator.adjoint(y))
            assert np.vdot(operator.forward(x), y) == pytest.approx(np.vdot(x, backs[-1]), rel=1e-12)
    finally:
        set_threads(before)
    np.testing.assert_array_equal(*backs)


def test_the_bound_of_a_single_pixel_psf_is_not_below_its_norm():
    one = FieldOfPsfs(np.full((1, 1, 1, 1), 0.7), np.zeros((1, 2)))
    for dtype in (np.float32, np.float64):
        assert 0.7 <= local_convolution([one], SENSOR, dtype=dtype).norm_bound < 0.7001


@pytest.mark.parametrize("which", ["mask", "weight", "psf", "second psf"])
def test_one_negative_weight_or_psf_has_the_norm_estimated(which):
    """Sums of rows and columns bound the norm only of what is nowhere negative."""
    window = slice(0, 15), slice(0, 61)
    laid = [
        strip(0, window, [part(slice(0, 9), (0, 1)), part(slice(7, 15), (1,))]),
        strip(0, window, [part(slice(0, 9), (0, 1))]),
    ]
    for numbers in (laid[0].masks, *(a for p in laid[0].parts for a in (p.weights, p.psfs))):
        numbers[(-1,) * numbers.ndim] = 0
    plain = SpatiallyVarying(laid, FIELD, SENSOR, n_channels=2, dtype=np.float64)
    ones = plain.forward(np.ones(plain.domain_shape)), plain.adjoint(np.ones(plain.range_shape))
    assert plain.norm_bound == pytest.approx(np.sqrt(ones[0].max() * ones[1].max()), rel=2e-5)
    assert estimate_norm(plain, 200) <= plain.norm_bound
    changed = {
        "mask": laid[0].masks,
        "weight": laid[0].parts[0].weights[None],
        "psf": laid[0].parts[0].psfs,
        "second psf": laid[0].parts[1].psfs,
    }[which]
    changed[(0,) * changed.ndim] *= -1
    signed = SpatiallyVarying(laid, FIELD, SENSOR, n_channels=2, dtype=np.float64)
    assert signed.norm_bound == pytest.approx(1.1 * estimate_norm(signed), rel=1e-6)


@pytest.mark.parametrize(
    ("columns", "count", "width"),
    [(1, 1, 8), (16, 1, 16), (17, 2, 16), (33, 3, 16), (48, 3, 16), (50, 4, 16)],
)
def test_tiles_hold_all_columns_in_whole_registers(columns, count, width):
    assert _tiling(columns) == (count, width)


def test_a_psf_of_other_channels_is_refused_in_any_part():
    laid = [
        strip(
            0, (slice(0, 15), slice(0, 61)), [part(slice(0, 9), (0,)), part(slice(9, 15), (1,), channels=3)]
        )
    ]
    with pytest.raises(InputError, match="PSFs of 3 channels do not serve 2"):
        SpatiallyVarying(laid, FIELD, SENSOR, n_channels=2)
