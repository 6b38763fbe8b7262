"""Point spread functions at very many places of a small volume, from wave-optical ones at a few."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from recon.arrays import Float32Array
from recon.optics.fall_off import FallOff, response_on
from recon.optics.grid import FloatArray, PixelGrid, Spectrum
from recon.optics.wave import Caustic, Source, WavePropagator


class NearPsfs:
    """Isotropic sources anywhere between nodes: light of the nodes about, each on its own straight rays.

    What diffraction makes of the diffuser varies slowly with the source's place once it is laid on the grid
    of straight rays through the diffuser (:class:`~recon.optics.wave.Caustic`), whose borders are exact for
    any place; it is interpolated linearly between nodes. The pixels' angular response is exact.

    Parameters
    ----------
    propagator : WavePropagator
    fall_off : FallOff
        The pixels' angular response.
    grid : PixelGrid
        The sensor's pixels.
    spectrum : Spectrum
    nodes_um : sequence of three ndarray
        Ascending places along x, y and z; sources lie between them.
    diameter_um : float
        Of every source.
    """

    def __init__(
        self,
        propagator: WavePropagator,
        fall_off: FallOff,
        grid: PixelGrid,
        spectrum: Spectrum,
        nodes_um: Sequence[FloatArray],
        diameter_um: float = 0.0,
    ) -> None:
        self._propagator, self._fall_off, self._grid = propagator, fall_off, grid
        self._nodes = tuple(np.asarray(along, np.float64) for along in nodes_um)
        pitch = propagator.diffuser.pitch_um
        # Wide enough for all light of every node; what misses the sensor is cut off on its pixels.
        side = 40 * max(grid.shape) * grid.pitch_um
        everything = PixelGrid((4, 4), side, grid.center_um)
        self._caustics = {}
        for place in np.ndindex(*(len(along) for along in self._nodes)):
            x, y, z = (float(along[i]) for along, i in zip(self._nodes, place, strict=True))
            self._caustics[place] = propagator.caustic(
                (x, y, z), everything, spectrum, diameter_um=diameter_um, emission="isotropic"
            ).energy
        self._pitch_um = pitch

    def __call__(self, source_um: Source) -> Float32Array:
        """Return the light of a source of unit intensity on the pixels, as ``WavePropagator.psf`` does.

        With the angular response. Raises ValueError for a place outside the nodes.
        """
        weights = [_between(along, at) for along, at in zip(self._nodes, source_um, strict=True)]
        light = np.zeros(self._grid.shape, np.float32)
        parts: dict[tuple[int, int], Float32Array] = {}
        for i, along_x in weights[0]:
            for j, along_y in weights[1]:
                for k, along_z in weights[2]:
                    energy = self._caustics[i, j, k]
                    part = np.float32(along_x * along_y * along_z) * energy
                    known = parts.get(energy.shape)
                    parts[energy.shape] = part if known is None else known + part
        for energy in parts.values():
            light += self._laid(energy, source_um).on(self._grid)
        light *= response_on(self._grid, source_um, self._propagator.distance_um, self._fall_off)
        return light

    def _laid(self, energy: Float32Array, source_um: Source) -> Caustic:
        """Lay light on the straight rays of a source through samples about the diffuser's centre."""
        x, y, z = source_um
        magnification = self._propagator.distance_um / z
        edges = [
            (np.arange(n + 1) - n / 2) * self._pitch_um * (1 + magnification) - magnification * at
            for n, at in zip(energy.shape, (y, x), strict=True)
        ]
        return Caustic(energy, edges[0], edges[1])


def _between(nodes: FloatArray, at: float) -> list[tuple[int, float]]:
    """Return the nodes about a place, and their weights."""
    if not nodes[0] - 1e-6 <= at <= nodes[-1] + 1e-6:
        raise ValueError(f"{at:g} um lies outside the nodes from {nodes[0]:g} to {nodes[-1]:g} um.")
    if len(nodes) == 1:
        return [(0, 1.0)]
    right = int(np.clip(np.searchsorted(nodes, at), 1, len(nodes) - 1))
    share = float(np.clip((at - nodes[right - 1]) / (nodes[right] - nodes[right - 1]), 0, 1))
    return [(i, w) for i, w in ((right - 1, 1 - share), (right, share)) if w > 0]
