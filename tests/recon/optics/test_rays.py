"""Rays and waves are two ways to the same caustic."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from recon.optics.diffuser import Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.grid import PixelGrid
from recon.optics.wave import WavePropagator
from tests.recon.optics.rays import RayPropagator

DISTANCE_UM = 3000.0


@pytest.mark.parametrize(
    "source_um", [(0.0, 0.0, 1e5), (0.0, 0.0, 5e3), (3e4, -2e4, 1e5), (1500.0, 1000.0, 4e3)]
)
def test_waves_of_short_wavelength_are_rays(source_um: tuple[float, float, float]) -> None:
    # At a tenth of the wavelength diffraction is small; a blur of a pixel takes the fringes away.
    diffuser = smooth_diffuser((500.0, 500.0), 1.0, feature_size_um=60.0, mean_slope_deg=1.0, seed=6)
    light = ((60.0, 1.0),)
    diffuser = Diffuser(diffuser.heights_um, 1.0, (500.0, 500.0), diffuser.glass.__class__(1.58))
    x, y, z = source_um
    grid = PixelGrid((110, 110), 8.0, (-x * DISTANCE_UM / z, -y * DISTANCE_UM / z))
    wave = WavePropagator(diffuser, DISTANCE_UM).psf(source_um, grid, light)
    rays = RayPropagator(diffuser, DISTANCE_UM).psf(source_um, grid, light)
    assert rays.sum() == pytest.approx(wave.sum(), rel=0.01)
    wave, rays = (ndimage.gaussian_filter(image, 1.0) for image in (wave, rays))
    inner = (wave * rays).sum() / np.linalg.norm(wave) / np.linalg.norm(rays)
    error = np.linalg.norm(wave - rays) / np.linalg.norm(rays)
    assert inner > 0.99
    assert error < 0.12


def test_rays_obey_snells_law_at_a_prism() -> None:
    # A steep wedge, where the thin-element formula is off by per cents and rays are exact.
    slope, pitch = 0.3, 5.0
    x = ((np.arange(40) - 19.5) * pitch).astype(np.float32)
    wedge = Diffuser(np.tile(np.float32(slope) * x, (40, 1)), pitch, (200.0, 200.0))
    grid = PixelGrid((200, 1000), 5.0)
    psf = RayPropagator(wedge, DISTANCE_UM).psf((0.0, 0.0, 1e9), grid, ((589.3, 1.0),))
    tilt = np.arctan(slope)
    deflection = np.arcsin(1.58 * np.sin(tilt)) - tilt
    landed = (psf.sum(axis=0) * grid.x_um).sum() / psf.sum()
    assert landed == pytest.approx(DISTANCE_UM * np.tan(deflection), rel=1e-3)


def test_rays_of_a_disc_keep_light_and_blur() -> None:
    lens = microlens_diffuser((500.0, 500.0), 2.0, focal_length_um=2500.0, seed=1)
    grid = PixelGrid((200, 200), 4.0)
    tracer = RayPropagator(lens, DISTANCE_UM)
    light = ((515.0, 1.0),)
    point = tracer.psf((0.0, 0.0, 15e3), grid, light)
    disc = tracer.psf((0.0, 0.0, 15e3), grid, light, diameter_um=200.0)
    assert disc.sum() == pytest.approx(point.sum(), rel=0.01)
    assert disc.max() < 0.5 * point.max()
