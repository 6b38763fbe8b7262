"""The true scene on a reconstruction's grid, to judge the reconstruction by."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from recon.optics.fall_off import FallOff
from recon.optics.scene import Scene

Weights = tuple[float, float, float]


def true_scene(
    scene: Scene,
    shape: tuple[int, int],
    pitch_um: float,
    distance_um: float,
    *,
    z_um: Sequence[float] | None,
    source_um: tuple[float, float, float],
    light: Weights,
    sensitivity: Weights | None,
    layer_scale: float,
    bead_scale: float,
    fall_off: FallOff | None,
) -> npt.NDArray[np.float32]:
    """Sample a scene on a reconstruction's grid, for each depth plane and colour.

    Parameters
    ----------
    scene : Scene
    shape, pitch_um, distance_um, source_um, layer_scale, bead_scale
        As for :meth:`recon.optics.scene.Scene.true_image`.
    z_um : sequence of float, optional
        Depth planes; everything goes to the plane nearest in ``1 / z``.
    light : tuple of float
        The scene's light in red, green and blue.
    sensitivity : tuple of float, optional
        A monochrome sensor's; left out, the bands stay apart.
    fall_off : FallOff, optional
        Weigh every direction by what aperture and pixels collect from there, relative to the axis.

    Returns
    -------
    ndarray, float32
        ``shape``, with the depth planes as first axis and the bands as last one where asked for.
    """
    if sensitivity is None:
        mixes = [(light[0], 0.0, 0.0), (0.0, light[1], 0.0), (0.0, 0.0, light[2])]
    else:
        total = sum(sensitivity)
        red, green, blue = (part * s / total for part, s in zip(light, sensitivity, strict=True))
        mixes = [(red, green, blue)]
    tan_y = _tangents(shape[0], pitch_um / distance_um)[:, None]
    tan_x = _tangents(shape[1], pitch_um / distance_um)
    cos = 1 / np.sqrt(1 + tan_y**2 + tan_x**2)
    seen = np.ones(shape) if fall_off is None else fall_off(tan_y, tan_x) * cos**3
    planes = []
    for near, far in _ranges(z_um):
        channels = []
        for mix in mixes:
            layers = scene.true_image(
                shape,
                pitch_um,
                distance_um,
                mix,
                z_range_um=(near, far),
                source_um=source_um,
                layer_scale=layer_scale,
                bead_scale=0.0,
            )
            beads = scene.true_image(
                shape,
                pitch_um,
                distance_um,
                mix,
                z_range_um=(near, far),
                source_um=source_um,
                layer_scale=0.0,
                bead_scale=bead_scale,
            )
            # A surface sends less light sideways, a bead does not.
            channels.append(seen * (layers * (cos if fall_off is not None else 1.0) + beads))
        planes.append(channels[0] if sensitivity is not None else np.stack(channels, axis=-1))
    return np.asarray(planes[0] if z_um is None else np.stack(planes), np.float32)


def _tangents(count: int, step: float) -> npt.NDArray[np.float64]:
    return np.asarray((np.arange(count) - count // 2) * step, np.float64)


def _ranges(z_um: Sequence[float] | None) -> list[tuple[float, float]]:
    """Range of depths that belongs to each plane: borders half way in ``1 / z``."""
    if z_um is None:
        return [(0.0, np.inf)]
    order = np.argsort(z_um)
    depths = np.asarray(z_um, np.float64)[order]
    if np.any(depths <= 0) or np.any(np.diff(depths) == 0):
        raise ValueError(f"Depth planes are positive and different, not {list(z_um)}.")
    middles = 2 / (1 / depths[1:] + 1 / depths[:-1])
    lows, highs = np.concatenate([[0.0], middles]), np.concatenate([middles, [np.inf]])
    ranges = [(0.0, np.inf)] * len(depths)
    for position, plane in enumerate(order):
        ranges[plane] = (float(lows[position]), float(highs[position]))
    return ranges
