"""The point tests on a simulated camera: the light of each point is propagated, not shifted."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.analysis.gram import WindowProblem
from recon.analysis.point_noise import AskedNoise, Noise
from recon.analysis.points import PointGrid, try_points

WORLD = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0, aperture_mm=(1.0, 1.0)))
Z_UM = 60e3
GREEN = (0.0, 1.0, 0.0)


def point(columns: float, _plane: float) -> np.ndarray:
    """One point's image, by wave optics, ``columns`` pixels off the axis on the sensor."""
    x_um = -columns * WORLD.sensor.pitch_um * Z_UM / WORLD.distance_um
    return WORLD.psf((x_um, 0.0, Z_UM), GREEN)


def dip(separation_px: float, noise: Noise) -> float:
    problem = WindowProblem(WORLD.psf((0.0, 0.0, Z_UM), GREEN)[None], (4, 12))
    return try_points(problem, point, PointGrid(2, separation_px=separation_px), noise).dip


def test_points_far_apart_are_resolved_and_near_ones_are_not() -> None:
    assert dip(4.0, Noise()) > 0.5
    assert dip(1.2, Noise()) < 0.2


def test_noise_costs_resolution() -> None:
    assert dip(2.5, Noise(1e6, 0.0)) > dip(2.5, Noise(30.0, 10.0))


def test_the_dip_is_found_where_a_reconstruction_on_the_whole_sensor_finds_it() -> None:
    """The window's solution has the same two peaks as :func:`recon.reconstruct` with tau = 0."""
    from recon import reconstruct

    psf = WORLD.psf((0.0, 0.0, Z_UM), GREEN)
    rng = np.random.default_rng(0)
    data = Noise().expose(point(-1.75, 0.0) + point(1.75, 0.0), rng)
    window = WindowProblem(psf[None], (4, 12)).solve(data)[0].sum(axis=0)
    whole = reconstruct(data, psf, prior="nonnegative", solver="fista", iterations=200).image
    row, column = (n // 2 for n in whole.shape)
    seen = whole[row - 4 : row + 5, column - 12 : column + 13].sum(axis=0)
    assert set(np.argsort(seen)[-2:]) <= set(np.argsort(window)[-4:])
    assert seen[12] / seen.max() == pytest.approx(window[12] / window.max(), abs=0.25)


def test_noise_is_the_calibrations_unless_it_is_given() -> None:
    quality = {"noise": {"electrons": 21_000.0, "read_e": 3.5, "counts_per_electron": 0.1}}
    assert AskedNoise().of(quality) == (Noise(21_000.0, 3.5), "measured in its frames")
    assert AskedNoise(read_e=1.0).of(quality) == (
        Noise(21_000.0, 1.0),
        "measured in its frames; the read noise given",
    )
    assert AskedNoise(500.0, 0.0).of(quality) == (Noise(500.0, 0.0), "given")
    for unknown in ({}, {"noise": None}, {"noise": {"electrons": float("nan"), "read_e": "2"}}):
        assert AskedNoise().of(unknown) == (Noise(), "assumed")
