"""Maps of volumes: light and number of depths."""

from __future__ import annotations

from recon.scenes import SceneSpec
from recon.stability.map import Axis, StressMap
from recon.stability.maps_light import ELECTRONS, scene_map

DEPTHS = Axis("depths", "depth planes over the same range", "planes", (2, 4, 8, 12), (2, 8), logarithmic=True)


MAPS: tuple[StressMap, ...] = (
    scene_map(
        "light-volume",
        "Light and number of depths: points in a volume",
        "How much light do thirty points in a volume need, and into how many depths may it be divided?",
        SceneSpec("beads", depths=2),
        ELECTRONS,
        DEPTHS,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "light-dense-volume",
        "Light and number of depths: sheets, blobs and threads",
        "The same for a volume that is full of things.",
        SceneSpec("dense-volume", depths=2),
        ELECTRONS,
        DEPTHS,
        ("volume tv", "volume l1"),
    ),
)
