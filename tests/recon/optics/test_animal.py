"""The animal: what it is over time, and its light on the sensor against wave optics at every place."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.simulated.living import LivingLight
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from recon.optics.animal import BLEACH_S, draw_animal
from recon.optics.diffuser import microlens_diffuser
from recon.optics.fall_off import gaussian_fall_off, response_on
from recon.optics.grid import PixelGrid, mixed_spectrum
from recon.optics.near_psfs import NearPsfs
from recon.optics.wave import WavePropagator

GREEN = (0.0, 1.0, 0.0)


def test_flashes_fade_flow_and_sway() -> None:
    """Half of the cells flash and come back to rest; all fade; blood goes on; nothing jumps."""
    animal = draw_animal(2500.0, 1000.0, seed=3)
    times = np.arange(0, 60, 0.05)
    change = animal.change(times)
    active = change.max(axis=1) > 0.1
    assert 0.3 < active.mean() < 0.7
    assert np.all(change >= 0)
    assert np.all(change[~active] == 0)
    # A lone transient reaches its size.
    first = np.argmax([len(onsets) == 1 for onsets in animal.onsets_s])
    fine = animal.onsets_s[first][0] + np.linspace(0, 2, 4000)
    assert animal.change(fine)[first].max() == pytest.approx(animal.sizes[first][0], rel=0.01)
    assert animal.faded(BLEACH_S)[0] == pytest.approx(np.exp(-1))
    assert np.all(np.diff(animal.flowed_um(times)) > 0)
    assert np.all(np.abs(np.diff(animal.sway_um(times), axis=0)) < 0.2)
    light = np.array([animal.blood(t).sum() for t in times])
    assert np.allclose(light, len(animal.blood_um))
    assert len(np.unique(animal.cells_um[:, 2])) > 20


def test_light_between_nodes_is_wave_optics_there() -> None:
    """Between nodes 0.2 mm apart the light is that of a source there, angular response included."""
    diffuser = microlens_diffuser((400.0, 400.0), 1.25, lenslet_um=130.0, focal_length_um=1500.0, seed=1)
    optics = WavePropagator(diffuser, 3800.0)
    fall_off, grid = gaussian_fall_off(13.0), PixelGrid((96, 128), 23.2)
    spectrum = mixed_spectrum(GREEN, 1)
    nodes = (np.array([0.0, 200.0]), np.array([100.0]), np.array([2450.0, 2550.0]))
    near = NearPsfs(optics, fall_off, grid, spectrum, nodes, diameter_um=10.0)
    source = (110.0, 100.0, 2480.0)
    exact = optics.psf(source, grid, spectrum, diameter_um=10.0, emission="isotropic")
    exact *= response_on(grid, source, 3800.0, fall_off)
    found = near(source)
    assert np.corrcoef(found.ravel(), exact.ravel())[0, 1] > 0.99
    assert found.sum() == pytest.approx(exact.sum(), rel=0.01)
    with pytest.raises(ValueError, match="outside the nodes"):
        near((300.0, 100.0, 2500.0))


def test_an_animal_on_too_many_pixels_is_refused_in_words() -> None:
    """Its parts' pictures are kept in memory: the error says how to bin."""
    world = SimulatedWorld(WorldOptions(preset="microscope", scene="animal"))
    assert world.animal is not None
    with pytest.raises(DeviceError, match="Bin the camera at least 2 x"):
        LivingLight(world, world.animal, GREEN, 1)
    world.set_scene(None)
    assert world.animal is None
