"""A frame is shown before what shows it fast is compiled, and looks the same; its figures and its places."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from datetime import UTC, datetime
from typing import Any, NoReturn

import numpy as np
import pytest

from drivers.frame import FrameMetadata
from instrument.live import frame_view
from instrument.live.frame_view import (
    SATURATED,
    FrameFigures,
    fill_indices,
    grouped,
    histogram,
    index_table,
    line_profile,
    not_stretched,
    percentiles,
    sensor_roi,
    show_indices,
)


def _hangs(*_: Any) -> NoReturn:
    raise AssertionError("it would have waited for a compiler")


@pytest.mark.parametrize("step", [1, 2, 3])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_what_numpy_shows_until_then_is_what_is_shown_later(
    step: int, dtype: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(1)
    image = rng.integers(0, 200, (31, 44)).astype(dtype)
    image[rng.random(image.shape) < 0.05] = 250  # saturated pixels here and there
    image.flags.writeable = False
    table = index_table(dtype, 20, 180, full_scale=250)
    for turned in (image, image.T, image[::-1]):
        height, width = (side // step for side in turned.shape)
        soon, later = (np.zeros((height, width), np.uint8) for _ in range(2))
        fill_indices(turned, table, step, later)
        with monkeypatch.context() as early:
            early.setattr(frame_view, "_compiled", threading.Event())
            early.setattr(frame_view, "fill_indices", _hangs)
            show_indices(turned, table, step, soon)
        np.testing.assert_array_equal(soon, later)
        assert (later == SATURATED).any()


def test_once_every_kind_of_frame_is_compiled_for_nothing_is_shown_by_numpy(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kinds = set()

    def filled(image: Any, *_: Any) -> None:
        kinds.add((image.dtype.name, image.flags.c_contiguous, image.strides[0] < 0, image.flags.writeable))

    monkeypatch.setattr(frame_view, "_compiled", threading.Event())
    monkeypatch.setattr(frame_view, "fill_indices", filled)
    frame_view.compile_for_frames()
    whole, turned, mirrored = (True, False, False), (False, False, False), (False, True, False)
    assert kinds == {(name, *kind) for name in ("uint8", "uint16") for kind in (whole, turned, mirrored)}
    assert frame_view._compiled.is_set()


def test_counts_are_shown_from_low_to_high_and_saturated_ones_apart() -> None:
    table = index_table(np.uint8, 10, 137, full_scale=200)
    assert [int(table[count]) for count in (0, 10, 11, 74, 137, 199, 200, 255)] == [
        *(0, 0, 2, 128, 254, 254),
        *(SATURATED, SATURATED),
    ]
    assert len(index_table(np.uint16, 0, 1)) == 65536
    assert index_table(np.uint8, 5, 5).tolist() == [0] * 6 + [254] * 250  # no span: below and above it


def test_a_histogram_is_of_all_pixels_and_channels_at_full_depth() -> None:
    image = np.zeros((4, 5, 3), np.uint16)
    image[0, 0], image[1, 2] = (1, 65535, 300), 300
    counts = histogram(image)
    assert len(counts) == 65536
    assert {int(n): int(counts[n]) for n in np.flatnonzero(counts)} == {0: 54, 1: 1, 300: 4, 65535: 1}


def test_a_histogram_is_grouped_from_one_count_to_another_with_both() -> None:
    counts = np.arange(20, dtype=np.float32)
    bars, size = grouped(counts, 3, 12, bins=4)  # ten counts: three a bar, the last not full
    assert (bars.tolist(), size) == ([12.0, 21.0, 30.0, 12.0], 3)
    bars, size = grouped(counts, 0, 3, bins=4)
    assert (bars.tolist(), size) == ([0.0, 1.0, 2.0, 3.0], 1)


def test_figures_of_a_frame_are_those_of_its_counts() -> None:
    counts = np.zeros(4096, np.float32)
    counts[[130, 1000]] = 3, 1
    figures = FrameFigures.of(counts, 4095)
    assert (figures.least, figures.largest, figures.mean) == (130, 1000, 347.5)
    assert figures.share == 1000 / 4095
    assert figures.saturated == 0
    assert figures.span == (128, 1023)  # in 64 parts of the sensor's range
    counts[4095] = 4
    clipped = FrameFigures.of(counts, 4095)
    assert clipped.saturated == 0.5
    assert clipped.span == (128, 4095)
    few = np.zeros(16, np.float32)
    few[5] = 1
    assert FrameFigures.of(few, 15).span == (5, 5)


def test_figures_of_thirty_frames_a_second_keep_no_other_thread_busy() -> None:
    script = """
import time
import numpy as np
from instrument.live.frame_view import FrameFigures
counts = np.ones(65536, np.float32)
FrameFigures.of(counts, 65535)
own_s, all_s = time.thread_time(), time.process_time()
for _ in range(30):
    FrameFigures.of(counts, 65535)
    time.sleep(1 / 30)
own_s = time.thread_time() - own_s
print((time.process_time() - all_s) / own_s)
"""  # in a process of its own, where no other test's threads are
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, check=True, capture_output=True, text=True
    )
    assert float(done.stdout) < 2


def test_percentiles_are_of_pixels_and_apart() -> None:
    counts = np.ones(200, np.float32)
    assert percentiles(counts, 1.0, 99.0) == (1.0, 197.0)
    counts[:] = 0
    counts[7] = 100
    assert percentiles(counts, 1.0, 99.0) == (7.0, 8.0)


def test_noise_in_the_dark_is_not_stretched() -> None:
    assert not_stretched((100.0, 110.0), 1600) == (100.0, 200.0)
    assert not_stretched((100.0, 210.0), 1600) == (100.0, 210.0)


def test_a_line_is_sampled_once_a_pixel_between_the_pixels_and_within_the_frame() -> None:
    ramp = np.add.outer(10.0 * np.arange(4), np.arange(6.0))
    distance, value = line_profile(ramp, (0.5, 1.5), (4.5, 1.5))  # along the centres of the second row
    np.testing.assert_allclose(distance, np.arange(5))
    np.testing.assert_allclose(value, 10 + np.arange(5.0))
    distance, value = line_profile(ramp, (2.5, 0.5), (2.5, 3.0))
    np.testing.assert_allclose(distance, [0, 2.5 / 2, 2.5])
    np.testing.assert_allclose(value, [2, 14.5, 27])
    distance, value = line_profile(ramp, (-2.0, 0.5), (8.0, 0.5))
    np.testing.assert_allclose(distance, np.arange(3, 8))  # its ends lie outside, and the very border
    np.testing.assert_allclose(value, [0.5, 1.5, 2.5, 3.5, 4.5])
    down = line_profile(ramp, (1.5, -2.0), (1.5, 6.0))
    np.testing.assert_allclose(down[0], [3, 4, 5])
    np.testing.assert_allclose(down[1], [6, 16, 26])
    assert [len(of) for of in line_profile(ramp, (1.2, 1.2), (1.2, 1.2))] == [2, 2]
    corner = line_profile(ramp, (5.9, 3.9), (5.6, 3.6))  # within the last pixel
    np.testing.assert_allclose(corner[1], [35, 35])
    colour = np.stack([ramp, ramp + 3, ramp + 6], axis=2)
    np.testing.assert_allclose(line_profile(colour, (0.5, 1.5), (4.5, 1.5))[1], 13 + np.arange(5.0))


def test_a_rectangle_on_a_frame_is_a_region_of_the_sensor_cut_at_the_frames_borders() -> None:
    taken = datetime.now(UTC)
    frame = FrameMetadata(0, None, 0, taken, 1.0, 1.0, "Mono8", 8, 0.0, (100, 40, 60, 80), 2)
    assert sensor_roi(frame, 3.4, 5.6, 10.0, 4.0).as_tuple() == (112, 46, 8, 20)
    assert sensor_roi(frame, -3.0, -2.0, 100.0, 100.0).as_tuple() == (100, 40, 60, 80)
    assert sensor_roi(frame, 50.0, 40.0, 5.0, 5.0).as_tuple()[2:] == (0, 0)
