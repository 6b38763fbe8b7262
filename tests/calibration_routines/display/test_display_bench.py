"""What display procedures are told of the camera: full scale, and darkness; what they write of it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.hologram_photograph import (
    Capture,
    Photographed,
    write_capture,
)
from calibration_routines.display.slm_table import measure_look_up_table
from instrument.files.errors import BenchError
from instrument.files.images import read_image
from recon.holography import Scores

DARK = 100
"""Counts without light, of 12 bits: more than a fiftieth of full scale."""


def seen_of(light: np.ndarray, dark: int) -> DisplayBench:
    """Return a bench whose camera adds light, counts, to its dark level and clips at 12 bits."""
    camera = SimpleNamespace(
        name="camera",
        exposure_ms=1.0,
        exposure_limits_ms=(0.01, 100.0),
        set_exposure_ms=lambda wanted: wanted,
        gain=1.0,
        binning=1,
        roi=SimpleNamespace(as_tuple=lambda: (0, 0, 8, 8)),
        significant_bits=12,
    )
    bench = SimpleNamespace(
        camera=camera,
        slm=SimpleNamespace(shape=(8, 8), display=lambda levels: None, displayed=None),
        config=SimpleNamespace(display=SimpleNamespace(wavelength_nm=660.0)),
        lit=False,
    )
    bench.scene_on = lambda: setattr(bench, "lit", True)
    bench.scene_off = lambda: setattr(bench, "lit", False)
    bench.snap = lambda: SimpleNamespace(image=np.minimum(dark + light * bench.lit, 4095).astype(np.uint16))
    return DisplayBench(bench, 1)


def test_pixels_at_full_scale_are_told_above_a_dark_level():
    light = np.full((8, 8), 300)
    light[2, 3] = 5000
    light[4, 4] = 4095 - DARK - 1  # just below
    io = seen_of(light, DARK)
    assert np.argwhere(io.saturated(io.photograph(1.0))).tolist() == [[2, 3]]


def test_a_camera_that_sees_nothing_is_called_dark():
    with pytest.raises(BenchError, match="it is dark"):
        measure_look_up_table(seen_of(np.zeros((8, 8)), 0), n_levels=9)


def test_a_photograph_is_written_square_as_the_field_is(tmp_path: Path):
    disc = np.hypot(*np.mgrid[-1:1:20j, -1:1:30j]) < 0.7  # an SLM that is wider than high, without a mask
    capture = Capture(disc.astype(float), disc.astype(float), Scores(30.0, 1.0, 30.0, 1.0), 0.0)
    write_capture(tmp_path / "seen.png", Photographed(capture, None, 0.0, False, simulated=True))
    seen = read_image(tmp_path / "seen.png").pixels > 127
    assert seen.shape == (30, 30)
    assert abs(int(seen.any(axis=0).sum()) - int(seen.any(axis=1).sum())) <= 2
