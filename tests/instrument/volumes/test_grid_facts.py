"""Depths that an OME file cannot tell are told in words."""

import numpy as np
import pytest

from instrument.volumes.grid_facts import middle_step_um, uneven_steps


@pytest.mark.parametrize(
    "z_um", [[100.0], [100.0, 300.0], [100.0, 200.0, 300.0], [300.0, 200.0, 100.2], [np.nan, 2.0, 7.0]]
)
def test_even_or_unknown_steps_need_no_word(z_um):
    assert uneven_steps(np.array(z_um)) == ""


def test_planes_even_in_one_over_z_are_told_with_the_step_that_is_written():
    z_um = 1 / np.linspace(1 / 10_000, 1 / 40_000, 7)
    text = uneven_steps(z_um)
    steps = np.diff(z_um)
    assert f"{steps.min():.4g} to {steps.max():.4g} µm" in text
    assert f"{middle_step_um(z_um):.4g} µm, that of the middle" in text
    assert middle_step_um(z_um) == pytest.approx(steps[3])
    assert uneven_steps(z_um[::-1]).startswith(text[:20])
