"""Lost frames are counted from frame numbers, through their wrapping."""

from __future__ import annotations

import pytest

from drivers.common.drops import FrameNumberCounter


def test_frame_numbers_count_exactly() -> None:
    counter = FrameNumberCounter()
    assert [counter.lost(n) for n in (5, 6, 9, 10)] == [0, 0, 2, 0]
    with pytest.raises(ValueError, match="came after"):
        counter.lost(10)


def test_frame_numbers_that_wrap() -> None:
    counter = FrameNumberCounter(modulus=2**16)
    assert [counter.lost(n) for n in (65534, 65535, 0, 2)] == [0, 0, 0, 1]
    without_zero = FrameNumberCounter(modulus=2**16, first_after_wrap=1)
    assert [without_zero.lost(n) for n in (65534, 65535, 1, 3)] == [0, 0, 0, 1]
    assert FrameNumberCounter(modulus=2**16, first_after_wrap=1).lost(1) == 0
    for first, lost in ((0, [0, 2]), (1, [0, 1])):  # from 7 to 2: 0 and 1, or 1 where there is no 0
        counter = FrameNumberCounter(modulus=8, first_after_wrap=first)
        assert [counter.lost(n) for n in (7, 2)] == lost
    uses_zero_all_the_same = FrameNumberCounter(modulus=8, first_after_wrap=1)
    assert [uses_zero_all_the_same.lost(n) for n in (7, 0)] == [0, 0]


def test_a_number_given_twice_or_out_of_order_is_no_wrap() -> None:
    for number, then in ((100, 100), (100, 99), (40_000, 10_000), (40_000, 40_000 - 2**15)):
        counter = FrameNumberCounter(modulus=2**16)
        counter.lost(number)
        with pytest.raises(ValueError, match="came after"):
            counter.lost(then)
