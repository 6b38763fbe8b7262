"""A scene lit part by part: by single LEDs of an array in front of it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array
from recon.optics.scene import Beads, Layer, Scene


@dataclass(frozen=True, slots=True)
class Lamp:
    """An LED that shines.

    Attributes
    ----------
    x_um, y_um : float
        Its place across the array.
    rgb : tuple of float
        Brightness in red, green and blue, 1 at the most.
    """

    x_um: float
    y_um: float
    rgb: tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class SceneLight:
    """Light of an array of LEDs on a scene.

    Attributes
    ----------
    lamps : tuple of Lamp
    distance_um : float
        From the array to the scene's places, whatever their depth.
    """

    lamps: tuple[Lamp, ...]
    distance_um: float

    @property
    def grey(self) -> bool:
        """Whether every lamp is as bright in all bands."""
        return all(len(set(lamp.rgb)) == 1 for lamp in self.lamps)

    def at(self, x_um: npt.ArrayLike, y_um: npt.ArrayLike) -> Float32Array:
        """Return the light on places across the axis, (..., 3), relative to one LED right opposite.

        Of each LED the cosine fourth of the angle: inverse square, and the tilt at both ends.
        """
        x, y = np.broadcast_arrays(np.asarray(x_um, float), np.asarray(y_um, float))
        light = np.zeros((*x.shape, 3), np.float32)
        for lamp in self.lamps:
            across = ((x - lamp.x_um) ** 2 + (y - lamp.y_um) ** 2) / self.distance_um**2
            light += ((1 + across) ** -2)[..., None] * np.array(lamp.rgb)
        return light

    def on(self, scene: Scene) -> Scene:
        """Return the scene as this light shows it: what it reflects is its radiance in even light."""
        layers = tuple(
            replace(layer, radiance=layer.radiance * self._on_layer(layer)) for layer in scene.layers
        )
        beads = tuple(
            Beads(
                b.positions_um, b.powers * self.at(b.positions_um[:, 0], b.positions_um[:, 1]), b.diameter_um
            )
            for b in scene.beads
        )
        return Scene(scene.name, layers, beads)

    def _on_layer(self, layer: Layer) -> Float32Array:
        x, y = ((edges[:-1] + edges[1:]) / 2 for edges in (layer.x_edges_um, layer.y_edges_um))
        return self.at(x[None, :], y[:, None])
