"""Whether a scene stands still, whatever its light."""

from __future__ import annotations

import numpy as np
import pytest

from recon.streams.stillness import SceneState, SceneWatch
from tests.recon.live.streams import photograph


@pytest.mark.parametrize("photons", [0.3, 30, 3000])
def test_noise_alone_is_still_whatever_its_size(photons: float) -> None:
    light = photograph(0, 0).astype(float) / 100
    rng = np.random.default_rng(3)
    watch = SceneWatch()
    states = [watch.see(rng.poisson(light * photons)[None].astype(np.float32)) for _ in range(20)]
    assert states == [SceneState.NEW] + [SceneState.STILL] * 19
    assert watch.count == 8


def test_a_flickering_lamp_is_no_movement_but_a_shift_of_half_a_pixel_is() -> None:
    watch = SceneWatch()
    for seed, gain in enumerate((1.0, 1.1, 0.9)):
        state = watch.see(gain * photograph(0, seed)[None].astype(np.float32))
    assert state is SceneState.STILL
    assert watch.see(photograph(0.5, 9)[None].astype(np.float32)) is SceneState.MOVING


def test_a_slow_drift_is_noticed_because_frames_are_compared_with_their_mean() -> None:
    watch = SceneWatch(average=8)
    states = [watch.see(photograph(0.02 * n, n)[None].astype(np.float32)) for n in range(60)]
    assert SceneState.MOVING in states


def test_identical_frames_are_still() -> None:
    watch = SceneWatch()
    frame = np.zeros((1, 32, 32), np.float32)
    assert [watch.see(frame) for _ in range(2)] == [SceneState.NEW, SceneState.STILL]
