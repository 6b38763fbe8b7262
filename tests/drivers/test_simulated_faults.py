"""The simulated bench with something wrong on purpose: what the frames show of it."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.simulated.faults import FaultOptions, disturbed
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config

TINY = """
[camera]
driver = "simulated"
exposure_ms = 20
[stage]
driver = "simulated"
{stage}
[led_array]
driver = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
noise = 0
{world}
"""
PATTERN = np.zeros((40, 60), np.float32)
PATTERN[18:22, 28:32] = 100.0


def test_a_frame_is_disturbed_by_as_much_as_the_options_say_and_each_time_alike() -> None:
    faults = FaultOptions(flicker=0.2, vibration_px=0.5)
    seen = np.array([disturbed(PATTERN, faults, (0, k), 0.0, 1) for k in range(200)])
    assert np.array_equal(seen[7], disturbed(PATTERN, faults, (0, 7), 0.0, 1))
    light = seen.sum(axis=(1, 2))
    assert light.std() / light.mean() == pytest.approx(0.2, rel=0.15)
    rows, columns = np.indices(PATTERN.shape)
    for places, middle in ((rows, 19.5), (columns, 29.5)):
        found = (seen * places).sum(axis=(1, 2)) / light
        assert found.mean() == pytest.approx(middle, abs=0.15)
        assert found.std() == pytest.approx(0.5, rel=0.15)


def test_what_changes_with_time_does_so_by_the_worlds_clock() -> None:
    drifting = disturbed(PATTERN, FaultOptions(drift_per_min=0.1), (0, 0), 120.0, 1)
    assert drifting.sum() == pytest.approx(1.2 * PATTERN.sum())
    crept = disturbed(PATTERN, FaultOptions(creep_px_per_min=4.0), (0, 0), 30.0, 2)
    assert np.allclose(crept, np.roll(PATTERN, (1, 1), axis=(0, 1)), atol=1e-3)
    even = disturbed(np.ones((20, 30), np.float32), FaultOptions(creep_px_per_min=6.0), (0, 0), 60.0, 1)
    assert np.allclose(even, 1, atol=1e-5)  # no dark rim comes in
    ambient = FaultOptions(ambient_e_per_s=8.0, ambient_period_s=10.0)
    assert disturbed(PATTERN, ambient, (0, 0), 5.0, 2)[0, 0] == pytest.approx(32.0)
    assert disturbed(PATTERN, ambient, (0, 0), 10.0, 2)[0, 0] == pytest.approx(0.0, abs=1e-4)


def test_pixels_turn_hot_late_and_stay_so() -> None:
    hot = "late_hot_pixels = 30\nlate_hot_after_s = 0.05\nlate_hot_e_per_s = 5e5"
    with open_bench(parse_config(TINY.format(world=hot, stage=""), None)) as bench:
        frames = [bench.snap().image.astype(float) for _ in range(5)]  # in the dark, 20 ms each
    assert [np.count_nonzero(frame - frames[0] > 1000) for frame in frames] == [0, 0, 30, 30, 30]


def test_a_rail_that_leans_a_screw_of_wrong_scale_and_lost_steps_move_the_source() -> None:
    wrong = (
        "mount_tilt_mrad = [5, -3]\naxes.z_um = {scale = 1.02, backlash = 0, slip = 500, slip_at_move = 2}"
    )
    with open_bench(parse_config(TINY.format(world="", stage=wrong), None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        places = []
        for z_um in (150e3, 200e3):
            bench.place_source(0.0, 0.0, z_um)
            places.append(bench.shared["simulated"].source_position_um)  # type: ignore[attr-defined]
    assert places[0] == pytest.approx((755.0, -453.0, 151e3), abs=5)
    assert places[1] == pytest.approx((1012.5, -607.5, 202.5e3), abs=5)
