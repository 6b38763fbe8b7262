"""What is known of reconstructions with a truth: one case each, its evidence and whether it failed.

Cases come from the shipped stability maps, and from scenes that mix what the maps keep apart: several
stresses at once, all diffusers, all families (``mixed.json``, made by ``benchmarks/verdicts.py --cases``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.stability.shipped import shipped_maps

Floats = npt.NDArray[np.float64]

FEATURES = (
    "detail",
    "unexplained",
    "load",
    "signal",
    "similarity",
    "dimming",
    "erased",
    "saturated",
    "unsettled",
    "ambiguity",
    "grain",
)
"""Evidence by which cases are alike; ``grain`` is that of edges over lit voxels."""
FLOOR = {
    "detail": 0.05,
    "unexplained": 0.02,
    "load": 0.005,
    "signal": 0.1,
    "saturated": 0.01,
    "unsettled": 0.05,
    "dimming": 0.01,
    "grain": 0.05,
}
"""Below these nothing can be told from zero; above, ratios count."""
NOTHING = 1e-3
INVISIBLE = ("shift",)
"""Maps whose failures leave no trace in the data: a shifted diffuser gives a good picture elsewhere."""
WEIGHT = {"similarity": 2.0, "unsettled": 0.3, "signal": 0.5, "ambiguity": 4.0}
"""How much a feature's difference counts, relative to a ratio of ``e`` in the others."""

RANDOM_LENSLETS = 0.25
"""``ambiguity`` of entries from before it was kept: those maps have random lenslets, 0.17 to 0.33."""
MIXED = Path(__file__).with_name("mixed.json")

GROUPS = {
    "picture tv": ("admm tv", "admm-sensor tv", "fista tv"),
    "picture l1": ("admm l1", "fista l1", "admm-sensor l1"),
    "wiener": ("wiener",),
    "volume tv": ("volume tv",),
    "volume l1": ("volume l1", "volume nonnegative"),
}
"""Methods that reach the same minimiser, and so fail alike."""


def group_of(method: str) -> str | None:
    """Return the group of a method, or None where no map has one like it."""
    return next((g for g, methods in GROUPS.items() if method in methods), None)


@dataclass(frozen=True)
class Cases:
    """Cases of a group of methods.

    Attributes
    ----------
    places : ndarray, (n, n_features)
        In the space in which distances tell how alike they are.
    severities : ndarray, (n,)
    scenes : ndarray of int, (n,)
        Numbers of the mixed scenes that they come from; -1 for those of maps.
    maps : tuple of str
        The maps that they come from.
    """

    places: Floats
    severities: Floats
    scenes: npt.NDArray[np.int_]
    maps: tuple[str, ...]

    def without(self, scene: int) -> Cases:
        """Return the cases but for those of a mixed scene, to judge that scene by the others."""
        kept = self.scenes != scene
        return Cases(self.places[kept], self.severities[kept], self.scenes[kept], self.maps)


def place_of(evidence: Mapping[str, Any]) -> Floats:
    """Return where evidence lies in the space of :class:`Cases`."""
    coordinates = []
    # Surfaces have fewer edges than lit voxels, points more: priors fail on them in different ways.
    numbers = {
        "ambiguity": RANDOM_LENSLETS,
        **evidence,
        "grain": (evidence["edges"] + NOTHING) / (evidence["lit"] + NOTHING),
    }
    for name in FEATURES:
        value = float(numbers[name])
        if name in FLOOR:
            value = float(np.log(max(value, 0.0) + FLOOR[name]))
        coordinates.append(WEIGHT.get(name, 1.0) * value)
    return np.asarray(np.minimum(coordinates, 1e3))


@cache
def mixed_scenes() -> tuple[Mapping[str, Any], ...]:
    """Return the entries of ``mixed.json``: ``scene``, ``method``, ``severity`` and ``evidence``."""
    return tuple(json.loads(MIXED.read_text(encoding="utf-8"))["cases"])


@cache
def cases_of(group: str) -> Cases:
    """Return the cases of a group: the shipped maps' and those of mixed scenes."""
    places, severities, scenes, names = [], [], [], []
    for name, stress in shipped_maps().items():
        if name in INVISIBLE:
            continue
        for method, result in stress["methods"].items():
            # "admm tv, left out": what follows the comma is how the data was handled.
            if method.partition(",")[0] not in GROUPS[group]:
                continue
            for entry in result["evidence"]:
                places.append(place_of(entry))
                severities.append(float(entry["severity"]))
                scenes.append(-1)
                names.append(name)
    for entry in mixed_scenes():
        if entry["method"] in GROUPS[group]:
            places.append(place_of(entry["evidence"]))
            severities.append(float(entry["severity"]))
            scenes.append(int(entry["scene"]))
    return Cases(
        np.array(places).reshape(-1, len(FEATURES)),
        np.array(severities),
        np.array(scenes, int),
        tuple(dict.fromkeys(names)),
    )
