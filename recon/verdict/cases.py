"""What is known of reconstructions with a truth: one case each, its evidence and whether it failed.

Cases come from the shipped stability maps, and from scenes that mix what the maps keep apart: several
stresses at once, all diffusers, all families (``mixed.json``, made by ``benchmarks/verdicts.py --cases``).
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

FLOOR = {
    "detail": 0.05,
    "unexplained": 0.02,
    "load": 0.005,
    "signal": 0.1,
    "saturated": 0.01,
    "unsettled": 0.05,
    "dimming": 0.01,
    "grain": 0.05,
    "height": 0.5,
    "peaks": 1.0,
    "missed": 0.03,
}
"""Below these nothing can be told from zero; above, ratios count."""
DERIVED = ("grain", "missed")
"""What follows from other evidence, and is not kept with it."""
NOTHING = 1e-3
INVISIBLE = ("shift",)
"""Maps whose failures leave no trace in the data: a shifted diffuser gives a good picture elsewhere."""
ALIKE: Mapping[str, float] = {
    "detail": 1.0,
    "unexplained": 1.0,
    "load": 1.0,
    "signal": 0.5,
    "similarity": 2.0,
    "dimming": 1.0,
    "erased": 1.0,
    "saturated": 1.0,
    "unsettled": 0.3,
    "ambiguity": 4.0,
    "grain": 1.0,
}
"""Evidence by which cases are alike, and how much a difference counts, relative to a ratio of ``e``.
``grain`` is that of edges over lit voxels."""
ALIKE_VOLUMES: Mapping[str, float] = {
    **ALIKE,
    "load": 0.5,
    "similarity": 3.0,
    "missed": 3.0,
    "height": 1.0,
    "peaks": 2.0,
    "ends": 2.0,
}
"""Likewise of volumes, whose bright points are asked as well (:class:`~recon.verdict.evidence.Points`).
``missed`` is the share of the measurement's variance, noise included, that the result does not throw onto the
sensor."""

RANDOM_LENSLETS = 0.25
"""``ambiguity`` of entries from before it was kept: those maps have random lenslets, 0.17 to 0.33."""
MIXED = Path(__file__).with_name("mixed.json")
SHIPPED = Path(__file__).with_name("shipped.json")
"""The stability maps that come with the program: a ``stability.json``."""

OF_VOLUMES = " of volumes"
"""Behind the solver and the prior in a method's name: where there is more than one depth."""
GROUPS = {
    "picture tv": ("admm tv", "admm-sensor tv", "fista tv"),
    "picture l1": ("admm l1", "fista l1", "admm-sensor l1"),
    "wiener": ("wiener",),
    "volume tv": ("admm tv" + OF_VOLUMES,),
    "volume l1": ("admm l1" + OF_VOLUMES, "admm nonnegative" + OF_VOLUMES),
}
"""Methods that reach the same minimiser, and so fail alike."""


def weights_of(group: str) -> Mapping[str, float]:
    """Return the evidence by which a group's cases are alike, with weights."""
    return ALIKE_VOLUMES if group.startswith("volume") else ALIKE


def group_of(method: str) -> str | None:
    """Return the group of a method, or None where no map has one like it."""
    return next((g for g, methods in GROUPS.items() if method in methods), None)


@dataclass(frozen=True)
class Cases:
    """Cases of a group of methods."""

    weights: Mapping[str, float]
    """The evidence that spans the space in which distances tell how alike they are, see :data:`ALIKE`."""
    places: Floats
    """(n, n_features): in that space."""
    severities: Floats
    """(n,)."""
    scenes: npt.NDArray[np.int_]
    """(n,): numbers of the mixed scenes that they come from; -1 for those of maps."""
    maps: tuple[str, ...]
    """The maps that they come from."""

    @cached_property
    def typical(self) -> Floats | None:
        """The median of the good cases' places, (n_features,); None where there are too few."""
        good = self.places[self.severities < 0.7]
        return None if len(good) < 5 else np.asarray(np.median(good, axis=0))

    @cached_property
    def n_scenes(self) -> int:
        """How many mixed scenes they come from."""
        return len(set(self.scenes.tolist()) - {-1})

    def without(self, scene: int) -> Cases:
        """Return the cases but for those of a mixed scene, to judge that scene by the others."""
        kept = self.scenes != scene
        return Cases(self.weights, self.places[kept], self.severities[kept], self.scenes[kept], self.maps)


def place_of(evidence: Mapping[str, Any], weights: Mapping[str, float]) -> Floats:
    """Return where evidence lies in the space of :class:`Cases`."""
    coordinates = []
    signal2 = evidence["signal"] ** 2
    numbers = {
        "ambiguity": RANDOM_LENSLETS,
        **evidence,
        # Surfaces have fewer edges than lit voxels, points more: priors fail on them in different ways.
        "grain": (evidence["edges"] + NOTHING) / (evidence["lit"] + NOTHING),
        "missed": min((1 + signal2 * evidence["unexplained"] ** 2) / (1 + signal2), 1.0),
    }
    for name, weight in weights.items():
        value = float(numbers[name])
        if name in FLOOR:
            value = float(np.log(max(value, 0.0) + FLOOR[name]))
        coordinates.append(weight * value)
    return np.asarray(np.minimum(coordinates, 1e3))


def is_whole(evidence: Mapping[str, Any], weights: Mapping[str, float]) -> bool:
    """Tell whether evidence holds all that is asked; cases from before something was measured do not."""
    return {*weights} - {*DERIVED, "ambiguity"} <= {*evidence}


@cache
def shipped_maps() -> dict[str, Any]:
    """Return the shipped maps by name."""
    maps: dict[str, Any] = json.loads(SHIPPED.read_text(encoding="utf-8"))["maps"]
    return maps


@cache
def mixed_scenes() -> tuple[Mapping[str, Any], ...]:
    """Return the entries of ``mixed.json``: ``scene``, ``method``, ``severity`` and ``evidence``."""
    return tuple(json.loads(MIXED.read_text(encoding="utf-8"))["cases"])


@cache
def cases_of(group: str) -> Cases:
    """Return the cases of a group: the shipped maps' and those of mixed scenes."""
    weights = weights_of(group)
    of_maps = [
        (entry, entry["severity"], -1, name)
        for name, stress in shipped_maps().items()
        if name not in INVISIBLE
        for method, result in stress["methods"].items()
        # "admm tv, left out": what follows the comma is how the data was handled.
        if method.partition(",")[0] in GROUPS[group]
        for entry in result["evidence"]
    ]
    mixed = [
        (entry["evidence"], entry["severity"], entry["scene"], entry["method"]) for entry in mixed_scenes()
    ]
    mixed = [case for case in mixed if case[3] in GROUPS[group]]
    cases = [case for case in of_maps + mixed if is_whole(case[0], weights)]
    return Cases(
        weights,
        np.array([place_of(evidence, weights) for evidence, *_ in cases]).reshape(-1, len(weights)),
        np.array([severity for _, severity, *_ in cases], float),
        np.array([scene for _, _, scene, _ in cases], int),
        tuple(dict.fromkeys(name for _, _, scene, name in cases if scene < 0)),
    )
