"""The chance that a reconstruction has failed, by what the data alone tell.

A logistic regression on the logarithms of the evidence and their squares, fitted to reconstructions of scenes
whose truth is known. How far a place lies from the middle of those, in their own scatter, tells
whether they know anything of it.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

SHIPPED = Path(__file__).with_name("chances.json")
"""The regressions that come with the program, by group of methods."""
FLOOR: Mapping[str, float] = {
    "detail": 0.05,
    "unexplained": 0.02,
    "load": 0.005,
    "signal": 0.1,
    "grain": 0.05,
    "height": 0.5,
    "peaks": 1.0,
    "missed": 0.03,
}
"""Below these nothing can be told from zero, :data:`LEAST` for others; above, ratios count."""
LEAST = 0.01
NOTHING = 1e-3
FEATURES = (
    *("detail", "unexplained", "load", "signal", "erased", "saturated", "ambiguity"),
    *("grain", "lit", "edges", "residual"),
)
"""Evidence that is asked of pictures. ``grain`` is that of edges over lit voxels, ``residual`` what is left
of the data in units of their noise."""
FEATURES_OF_VOLUMES = (
    *FEATURES,
    *("planes", "similarity", "dimming", "missed", "height", "peaks", "ends"),
)
"""Likewise of volumes. ``missed`` is the share of the measurement's variance, noise included, that the result
does not throw onto the sensor."""
DERIVED = ("grain", "residual", "missed")
"""What follows from other evidence, and is not kept with it."""
MOST = 1.5
"""Standard deviations beyond which more counts no more: measured volumes are larger than any case."""
BLUNT = 0.1
"""Variance added to the cases' scatter, relative: a direction that none varies in tells nothing by itself."""
ALIKE = 0.1
"""Least deviation of a feature: a tenth more or less is no difference."""
FOLDS, SPLITS = 10, 4
"""Parts of the cases that are left out in turn, and how often they are parted anew."""
PENALTIES, BENT = (1.0, 2.0, 4.0, 8.0), 4.0
"""Of the coefficients' squares, that with which cases left out are the least surprising, and how much greater
it is for those of the squared steps."""
ALLOWED = 0.04
"""Share of failures among those called reliable that the threshold is set for; of unseen 5 % are allowed."""
HIGHEST = 0.3
"""Chance of failing up to which anything may be called reliable."""
STEPS = 30


@dataclass(frozen=True)
class Chances:
    """What is known of a group of methods."""

    features: tuple[str, ...]
    centre: Floats
    spread: Floats
    """``centre`` and ``spread``: (n_features,): mean and standard deviation of the cases' places."""
    best: Floats
    """(n_features, 2): the lowest and the highest among the cases."""
    typical: Floats
    """(n_features,): the median of the good cases."""
    coefficients: Floats
    """(1 + 2 n_features,): of :func:`_terms`."""
    precision: Floats
    """(n_features, n_features): inverse of the cases' scatter, in units of ``spread``."""
    far: float
    """The farthest case's distance: beyond, a measurement is unlike every case."""
    reliable: float
    """Chance of failing up to which a reconstruction is called reliable."""
    n_cases: int
    n_scenes: int

    def chance(self, places: Floats) -> Floats:
        """Return the chance of failing at places (..., n_features)."""
        steps = np.clip((places - self.centre) / self.spread, -MOST, MOST)
        return np.asarray(_logistic(_terms(steps) @ self.coefficients))

    def distance(self, place: Floats) -> float:
        """Return how far a place (n_features,) is from the cases' middle."""
        step = (place - self.centre) / self.spread
        return float(np.sqrt(step @ self.precision @ step))

    def no_better_than_any(self, place: Floats, better: Mapping[str, int]) -> Floats:
        """Return a place moved to the best case's where it is better: more light than the most is as good."""
        moved = place.copy()
        for index, name in enumerate(self.features):
            if better.get(name, 0) > 0:
                moved[index] = min(moved[index], self.best[index, 1])
            elif better.get(name, 0) < 0:
                moved[index] = max(moved[index], self.best[index, 0])
        return moved

    def as_json(self) -> dict[str, Any]:
        """Return it for a file."""
        arrays = {k: v for k, v in asdict(self).items() if isinstance(v, np.ndarray)}
        rounded = {k: [float(f"{x:.6g}") for x in v.ravel()] for k, v in arrays.items()}
        return {**asdict(self), **rounded}

    @classmethod
    def from_json(cls, entry: Mapping[str, Any]) -> Chances:
        """Return that of a file's entry."""
        n = len(entry["features"])
        arrays = {
            k: np.asarray(v, float) for k, v in entry.items() if isinstance(v, list) and k != "features"
        }
        shaped = {"best": arrays["best"].reshape(n, 2), "precision": arrays["precision"].reshape(n, n)}
        return cls(**{**entry, **arrays, **shaped, "features": tuple(entry["features"])})


@cache
def shipped_chances() -> Mapping[str, Chances]:
    """Return the shipped regressions by group of methods."""
    groups = json.loads(SHIPPED.read_text(encoding="utf-8"))
    return {group: Chances.from_json(entry) for group, entry in groups.items()}


def is_whole(evidence: Mapping[str, Any], features: Sequence[str]) -> bool:
    """Tell whether evidence holds all that is asked."""
    return {*features} - {*DERIVED} <= {*evidence}


def place_of(evidence: Mapping[str, float], features: Sequence[str]) -> Floats:
    """Return where evidence lies among cases, (n_features,): logarithms."""
    beyond2 = (evidence["signal"] * evidence["unexplained"]) ** 2
    numbers = {
        **evidence,
        # Surfaces have fewer edges than lit voxels, points more: priors fail on them in different ways.
        "grain": (evidence["edges"] + NOTHING) / (evidence["lit"] + NOTHING),
        "residual": (1 + beyond2) ** 0.5,
        "missed": min((1 + beyond2) / (1 + evidence["signal"] ** 2), 1.0),
    }
    place = [np.log(max(float(numbers[name]), 0.0) + FLOOR.get(name, LEAST)) for name in features]
    return np.asarray(np.minimum(place, 1e3))


def value_of(name: str, coordinate: float) -> float:
    """Return the evidence that lies at a coordinate of :func:`place_of`."""
    return float(np.exp(coordinate)) - FLOOR.get(name, LEAST)


def fitted(features: Sequence[str], places: Floats, severities: Floats, scenes: npt.ArrayLike) -> Chances:
    """Fit the regression to cases.

    Parameters
    ----------
    features : sequence of str
    places : ndarray, (n, n_features)
    severities : ndarray, (n,)
        From 1 on it failed.
    scenes : array_like of int, (n,)
        Those of one scene are left out together when the threshold is set: that with at most
        :data:`ALLOWED` of failures among those below it.
    """
    centre, spread = places.mean(axis=0), np.maximum(places.std(axis=0), ALIKE)
    steps = (places - centre) / spread
    terms, failed = _terms(np.clip(steps, -MOST, MOST)), (severities >= 1).astype(np.float64)
    groups, group = np.unique(scenes, return_inverse=True)
    rng = np.random.default_rng(0)
    folds = [rng.permutation(len(groups))[group] % FOLDS for _ in range(SPLITS)]
    chances = {p: np.mean([_left_out(terms, failed, fold, p) for fold in folds], 0) for p in PENALTIES}
    penalty = min(chances, key=lambda p: -float(np.sum(np.log(np.abs(1 - failed - chances[p])))))
    unseen = chances[penalty]
    order = np.argsort(unseen)
    share = np.cumsum(failed[order]) / np.arange(1, len(order) + 1)
    among = np.flatnonzero((share <= ALLOWED) & (unseen[order] <= HIGHEST))
    scatter = steps.T @ steps / len(steps) + BLUNT * np.eye(len(features))
    precision = np.linalg.inv(scatter)
    distances = np.sqrt(np.einsum("ij,jk,ik->i", steps, precision, steps))
    good = places[severities < 0.7]
    return Chances(
        tuple(features),
        centre,
        spread,
        np.stack([places.min(axis=0), places.max(axis=0)], axis=1),
        np.median(good if len(good) else places, axis=0),
        _regressed(terms, failed, penalty),
        precision,
        float(distances.max()),
        float(unseen[order][among[-1]]) if len(among) else 0.0,
        len(failed),
        len(groups),
    )


def _terms(steps: Floats) -> Floats:
    """Return 1, the steps and their squares: (..., n) to (..., 1 + 2 n)."""
    return np.concatenate([np.ones((*steps.shape[:-1], 1)), steps, steps**2], axis=-1)


def _logistic(logits: Floats) -> Floats:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -50, 50))))


def _left_out(terms: Floats, failed: Floats, fold: npt.NDArray[np.int_], penalty: float) -> Floats:
    """Return the chance of failing of each case by the regression on those of other folds."""
    chance = np.zeros(len(failed))
    for k in np.unique(fold):
        others = fold != k
        chance[~others] = _logistic(terms[~others] @ _regressed(terms[others], failed[others], penalty))
    return chance


def _regressed(terms: Floats, failed: Floats, strength: float) -> Floats:
    """Return the ridge regression's coefficients by Newton's method; steps are halved until it descends."""
    penalty = np.concatenate([[1e-3], strength * np.repeat([1.0, BENT], terms.shape[1] // 2)])

    def objective(at: Floats) -> float:
        logits = terms @ at
        likelihood = np.sum(np.logaddexp(0, logits) - failed * logits)
        return float(likelihood + penalty @ at**2 / 2)

    found = np.zeros(terms.shape[1])
    value = objective(found)
    for _ in range(STEPS):
        chance = _logistic(terms @ found)
        slope = terms.T @ (chance - failed) + penalty * found
        curvature = (terms * (chance * (1 - chance))[:, None]).T @ terms + np.diag(penalty)
        step = np.linalg.solve(curvature, slope)
        while (new := objective(found - step)) > value and np.abs(step).max() > 1e-9:
            step /= 2
        found, gained, value = found - step, value - new, new
        if gained < 1e-6:
            break
    return found
