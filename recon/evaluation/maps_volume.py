"""Maps of volumes: light and number of depths."""

from __future__ import annotations

from recon.evaluation.maps_light import BACKGROUND, ELECTRONS, scene_map
from recon.evaluation.scene import SceneSpec
from recon.evaluation.scene_trial import Options
from recon.verdict.map import Axis, StressMap

BEADS = SceneSpec("beads", depths=4, density=0.4, z_near=3.0, z_far=5.0)
DEPTHS = Axis("depths", "depth planes over the same range", "planes", (2, 4, 8, 12), (2, 8), logarithmic=True)
ROTATION = Axis("drift_deg", "rotation", "degrees", (0.1, 0.3, 0.6, 1, 2, 4), (0.1, 0.5, 2), logarithmic=True)
SWELLING = Axis(
    "drift_scale", "swelling", "relative", (0.001, 0.003, 0.01, 0.03), (0.001, 0.005, 0.02), logarithmic=True
)
FARTHEST = Axis(
    "z_far",
    "farthest plane (nearest: 3)",
    "distances from diffuser to sensor",
    (4, 5, 7, 10, 15),
    (4, 6, 9, 15),
    logarithmic=True,
)

MAPS: tuple[StressMap, ...] = (
    scene_map(
        "light-volume",
        "Light and number of depths: points in a volume",
        "How much light do twelve points in a volume need, and into how many depths may it be divided?",
        BEADS,
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
    scene_map(
        "depth-range",
        "Range of depths and light",
        "How far behind the nearest points may others lie? Light falls with the square of the distance.",
        BEADS,
        FARTHEST,
        ELECTRONS,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "drift-volume",
        "Drift of the diffuser before a volume: rotation and swelling",
        "How far may the diffuser turn and swell before points in a volume are lost?",
        BEADS,
        ROTATION,
        SWELLING,
        ("volume l1", "volume tv"),
    ),
    scene_map(
        "background-volume",
        "Background and light: a volume",
        "How much smooth stray light does a volume stand that nobody subtracts or estimates?",
        BEADS,
        BACKGROUND,
        ELECTRONS,
        ("volume l1", "volume tv"),
        Options(subtract_background=False),
    ),
)
