"""Views of a volume from any side: against plain projections, and points where geometry puts them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from instrument.reconstruction import rendering
from instrument.reconstruction.rendering import Pose, Renderer, depth_shades
from instrument.volumes.source import volume_in_memory

GREY = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)


def test_along_the_axes_it_is_the_brightest_voxel() -> None:
    voxels = np.random.default_rng(0).integers(0, 65536, (9, 21, 31)).astype(np.uint16)
    renderer = Renderer(voxels, white=2.0)
    views = (
        (Pose(), (21, 31), voxels.max(0)),
        (Pose(90), (21, 9), voxels.max(2).T),
        (Pose(0, -90), (9, 31), voxels.max(1)),
    )
    for pose, size, expected in views:
        drawn = renderer.draw(pose, size, 1.0, (0.0, 2.0), GREY)[..., 0]
        wanted = (expected / 65535 * 255).astype(int)
        found = min(
            np.abs(drawn[:-1, :-1].astype(int) - turned[:-1, :-1]).max()
            for turned in (wanted, wanted[::-1], wanted[:, ::-1])
        )
        assert found <= 1


@pytest.mark.parametrize("pose", [Pose(25, 10), Pose(70, -35), Pose(200, 60), Pose(310, 5)])
def test_a_point_is_where_geometry_puts_it_and_keeps_its_depths_hue(pose: Pose) -> None:
    voxels = np.zeros((16, 41, 61), np.uint16)
    place, step, zoom = np.array([12, 8, 50]), 2.5, 2.0
    voxels[tuple(place)] = 65535
    shades = depth_shades(16)
    drawn = Renderer(voxels, step).draw(pose, (301, 301), zoom, (0.0, 1.0), shades).astype(float)
    middle = (np.array(voxels.shape) - 1) / 2
    expected = (pose.matrix @ ((place - middle) * (step, 1, 1)))[1:] * zoom + 150
    light = drawn.sum(axis=2)
    rows, columns = np.indices(light.shape)
    found = np.array([(rows * light).sum(), (columns * light).sum()]) / light.sum()
    assert np.abs(found - expected).max() <= zoom  # slices are moved by whole voxels
    brightest = drawn[np.unravel_index(light.argmax(), light.shape)]
    assert brightest / brightest.max() == pytest.approx(shades[12, 255] / shades[12, 255].max(), abs=0.03)


def test_a_large_volume_is_averaged_and_measured_in_its_own_values(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rendering, "MOST_VOXELS", 3 * 20 * 20)
    voxels = np.random.default_rng(1).random((3, 40, 41), np.float32) * 7
    voxels[1, 3, 4] = np.nan  # from elsewhere
    renderer = Renderer.of(volume_in_memory(voxels, Path("volume.npy")))
    assert (renderer.reduced, renderer.shape) == (2, (3, 20, 20))
    along = renderer.along_depth(slice(10, 30), slice(20, 40))
    assert along == pytest.approx(voxels[:, 10:30, 20:40].mean(axis=(1, 2)), rel=1e-3)
