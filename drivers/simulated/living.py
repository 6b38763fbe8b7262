"""A scene that lives: the light of an animal on the sensor, at any time."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from drivers.errors import DeviceError
from recon.arrays import Float32Array
from recon.optics.animal import Animal
from recon.optics.grid import FloatArray, mixed_spectrum
from recon.optics.near_psfs import NearPsfs

if TYPE_CHECKING:
    from drivers.simulated.world import Rgb, SimulatedWorld


POWER = 6e-4
"""Of a cell at rest, relative to a bead."""
BLOOD = 2.5
"""Of a blood cell, relative to a cell at rest."""
STRAY = 0.5
"""Light of filters and of excitation on the sensor, relative to the animal's mean light at rest; it does not
fade, and fills the sensor smoothly, brightest away from the middle."""
NODES = (7, 3, 2)
"""Places along x, y and z whose light is computed by diffraction; between them it is interpolated."""
MOST_BYTES = 1 << 30


class LivingLight:
    """Light of an animal on a world's binned pixels; each part's picture is made once, at the first light.

    Parameters
    ----------
    world : SimulatedWorld
    animal : Animal
    weights : tuple of float
        Sensitivity to red, green and blue, times the scene's light.
    binning : int

    Raises DeviceError when the pictures would take too much memory.
    """

    def __init__(self, world: SimulatedWorld, animal: Animal, weights: Rgb, binning: int) -> None:
        self.animal = animal
        self._world, self._weights, self._grid = world, weights, world.sensor_grid(binning)
        parts = len(animal.cells_um) + len(animal.vessel_um) + 2
        need = 4 * parts * int(np.prod(self._grid.shape))
        if need > MOST_BYTES:
            raise DeviceError(
                "camera (simulated)",
                f"the animal's {parts} parts on {self._grid.shape[0]} x {self._grid.shape[1]} pixels would "
                f"take {need / 2**30:.1f} GiB of memory.",
                f"Bin the camera at least {binning * int(np.ceil(np.sqrt(need / MOST_BYTES)))} x.",
            )

    @cached_property
    def _parts(self) -> tuple[Float32Array, Float32Array, Float32Array]:
        """Pictures of each cell at rest, of all tissue, and of a blood cell at each place of the vessel."""
        world, animal = self._world, self.animal
        nodes: list[FloatArray] = [
            np.linspace(low, high, n) for (low, high), n in zip(animal.extent_um, NODES, strict=True)
        ]
        spectrum = mixed_spectrum(self._weights, world.options.spectral_samples)
        psf = NearPsfs(world.propagator, world.fall_off, self._grid, spectrum, nodes, animal.diameter_um)
        photons = POWER * world.preset.bead_photons_per_s_sr

        def of(places: FloatArray) -> Float32Array:
            return np.stack([psf((float(x), float(y), float(z))) for x, y, z in places])

        cells = of(animal.cells_um)
        cells *= np.float32(photons) * animal.rest[:, None, None].astype(np.float32)
        tissue = np.zeros(self._grid.shape, np.float32)
        for glow, (x, y, z) in zip(animal.glow, animal.tissue_um, strict=True):
            tissue += np.float32(glow) * psf((float(x), float(y), float(z)))
        blood = np.float32(BLOOD * photons) * of(animal.vessel_um)
        return cells, np.float32(photons) * tissue, blood

    @cached_property
    def _stray(self) -> Float32Array:
        cells, tissue, _ = self._parts
        level = STRAY * float((cells.sum(axis=0) + tissue).mean())
        height, width = self._grid.shape
        y, x = np.linspace(-1, 1, height)[:, None], np.linspace(-1, 1, width)
        shape = 1 + 0.35 * x + 0.2 * y + 0.5 * (x**2 + y**2)
        stray: Float32Array = (level * shape / shape.mean()).astype(np.float32)
        return stray

    def at(self, time_s: float) -> Float32Array:
        """Return photons a second on each pixel."""
        from scipy import ndimage

        animal = self.animal
        cells, tissue, blood = self._parts
        light = np.tensordot(1 + animal.change(time_s)[:, 0].astype(np.float32), cells, 1)
        light += tissue
        light *= np.float32(animal.faded(time_s)[0])
        light += np.tensordot(animal.blood(time_s).astype(np.float32), blood, 1)
        # A moved sample moves its pattern: the planes' magnifications differ by less than the sway tells.
        x, y = animal.sway_um(time_s)[0]
        z_um = float(np.mean(animal.extent_um[2]))
        moved = -np.array([y, x]) * self._world.distance_um / z_um / self._grid.pitch_um
        light = ndimage.shift(light, moved, order=3, mode="nearest", prefilter=True)
        np.maximum(light, 0, out=light)
        seen: Float32Array = light + self._stray
        return seen
