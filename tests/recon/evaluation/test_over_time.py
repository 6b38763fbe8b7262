"""Where priors over time help, and where they do harm."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from scipy.signal import fftconvolve

from recon.evaluation.map_trials import READ_NOISE_E, video_of
from recon.evaluation.maps import map_named
from recon.verdict.map import Failure


def test_points_are_cast_where_the_truth_has_them_and_move_as_asked() -> None:
    video = video_of(32, 6, 1.5, 0.0, 1e6, 3)
    assert video.frames.max() == pytest.approx(1e6, rel=0.02)
    columns = np.arange(32)
    places = [float(t.sum(axis=0) @ columns / t.sum()) for t in video.truth]
    np.testing.assert_allclose(np.diff(places), 1.5, atol=0.15)
    for frame, picture in zip(video.frames, video.truth, strict=True):
        expected = fftconvolve(picture, video.psf, "full")[16:48, 16:48]
        assert np.corrcoef(expected.ravel(), gaussian_filter(frame, 1.0).ravel())[0, 1] > 0.97
    dark = video_of(32, 6, 0.0, 0.0, 10.0, 3).frames[:, 0, 0]
    assert abs(dark.mean()) < 10 * READ_NOISE_E


def test_total_variation_over_time_helps_what_stands_and_harms_what_runs() -> None:
    trial = map_named("over-time-motion").trial
    stands, runs = (trial("temporal tv", v, 30.0, 0, "quick") for v in (0.0, 3.0))
    # -31 % and +41 % on 2026-11-23.
    assert -45 < stands.error < -15
    assert stands.severities[Failure.ALONE] == pytest.approx(1 + stands.error / 100)
    assert 20 < runs.error < 80
