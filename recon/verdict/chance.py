"""The chance that a reconstruction has failed, by what the data alone tell.

Two regressions on the logarithms of the evidence, fitted to reconstructions of scenes whose truth is known,
and the mean of what they say, in logits. One tells whether it failed by their steps and squares: each number
has its own share, so that it can be blamed, and none that is known to do harm does good, though among the
cases it may come with what does. The other tells how badly (the logarithm of the severity) by their products
as well, for what only comes together, and a logistic curve makes a chance of it. They err in different
places. How far a place lies from the middle of the cases, in their own scatter, tells whether they know
anything of it.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import BoolArray, Float64Array

Parts = npt.NDArray[np.int_]
Regress = Callable[[Float64Array, Float64Array, float], Float64Array]

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
JOINT_PENALTIES, JOINT_BENT = (10.0, 30.0, 100.0, 300.0), 2.0
"""The same of the severity's regression, of squares and products: that with which it is missed by least."""
SEVERE = (0.5, 2.0)
"""Severities beyond which more or less makes no difference."""
ALLOWED = 0.04
"""Share of failures among those called reliable that the threshold is set for; of unseen 5 % are allowed."""
HIGHEST = 0.3
"""Chance of failing up to which anything may be called reliable."""
BETTER: Mapping[str, int] = {
    **{"detail": 1, "signal": 1, "dimming": 1, "height": 1},
    **{"unexplained": -1, "load": -1, "similarity": -1, "erased": -1, "saturated": -1, "ambiguity": -1},
    **{"peaks": -1, "ends": -1, "unsettled": -1, "residual": -1, "missed": -1},
}
"""Whether more of it is better (1) or worse (-1), all else equal; of others neither is known."""


@dataclass(frozen=True)
class Chances:
    """What is known of a group of methods."""

    features: tuple[str, ...]
    centre: Float64Array
    spread: Float64Array
    """``centre`` and ``spread``: (n_features,): mean and standard deviation of the cases' places."""
    best: Float64Array
    """(n_features, 2): the lowest and the highest among the cases."""
    typical: Float64Array
    """(n_features,): the median of the good cases."""
    coefficients: Float64Array
    """(1 + 2 n_features,): of :func:`_terms`, for the logarithm of the odds."""
    joint: Float64Array
    """(1 + n_features (n_features + 3) / 2,): of :func:`_joint_terms`, likewise, by the severity."""
    precision: Float64Array
    """(n_features, n_features): inverse of the cases' scatter, in units of ``spread``."""
    far: float
    """The farthest case's distance: beyond, a measurement is unlike every case."""
    reliable: float
    """Chance of failing up to which a reconstruction is called reliable."""
    n_cases: int
    n_scenes: int

    def chance(self, places: Float64Array) -> Float64Array:
        """Return the chance of failing at places (..., n_features)."""
        steps = self._steps(places)
        return _logistic((_terms(steps) @ self.coefficients + _joint_terms(steps) @ self.joint) / 2)

    def blame(self, places: Float64Array) -> Float64Array:
        """Return the chance of failing by the regression in which each number has its own share."""
        return _logistic(_terms(self._steps(places)) @ self.coefficients)

    def _steps(self, places: Float64Array) -> Float64Array:
        return np.asarray(np.clip((places - self.centre) / self.spread, -MOST, MOST))

    def distance(self, place: Float64Array) -> float:
        """Return how far a place (n_features,) is from the cases' middle."""
        step = (place - self.centre) / self.spread
        return float(np.sqrt(step @ self.precision @ step))

    def no_better_than_any(self, place: Float64Array) -> Float64Array:
        """Return a place moved to the best case's where it is better: more light than the most is as good."""
        moved = place.copy()
        for index, name in enumerate(self.features):
            if BETTER.get(name, 0) > 0:
                moved[index] = min(moved[index], self.best[index, 1])
            elif BETTER.get(name, 0) < 0:
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


def place_of(evidence: Mapping[str, float], features: Sequence[str]) -> Float64Array:
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


def fitted(
    features: Sequence[str],
    places: Float64Array,
    severities: Float64Array,
    scenes: npt.ArrayLike,
    decides: BoolArray | None = None,
) -> Chances:
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
    decides : ndarray of bool, (n,), optional
        Of which the chance decides whether they are called reliable: the threshold counts these, if any.
    """
    centre, spread = places.mean(axis=0), np.maximum(places.std(axis=0), ALIKE)
    steps = (places - centre) / spread
    near, failed = np.clip(steps, -MOST, MOST), (severities >= 1).astype(np.float64)
    terms, joint, severe = _terms(near), _joint_terms(near), np.log(np.clip(severities, *SEVERE))
    groups, group = np.unique(scenes, return_inverse=True)
    rng = np.random.default_rng(0)
    folds = [rng.permutation(len(groups))[group] % FOLDS for _ in range(SPLITS)]
    signs = np.array([-BETTER.get(name, 0) for name in features])

    def regressed(terms: Float64Array, failed: Float64Array, strength: float) -> Float64Array:
        return _regressed(terms, failed, strength, signs)

    odds = {p: _left_out(regressed, terms, failed, folds, p) for p in PENALTIES}
    penalty = min(odds, key=lambda p: _surprise(odds[p], failed))
    told = {p: _left_out(_ridge, joint, severe, folds, p) for p in JOINT_PENALTIES}
    joint_penalty = min(told, key=lambda p: float(np.sum((told[p] - severe) ** 2)))
    offset, slope = _curve(told[joint_penalty], failed)
    by_severity = slope * _ridge(joint, severe, joint_penalty)
    by_severity[0] += offset
    unseen = _logistic((odds[penalty] + offset + slope * told[joint_penalty]) / 2)
    order = np.argsort(unseen)
    if decides is not None and decides.any():
        order = order[decides[order]]
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
        regressed(terms, failed, penalty),
        by_severity,
        precision,
        float(distances.max()),
        float(unseen[order][among[-1]]) if len(among) else 0.0,
        len(failed),
        len(groups),
    )


def _terms(steps: Float64Array) -> Float64Array:
    """Return 1, the steps and their squares: (..., n) to (..., 1 + 2 n)."""
    return np.concatenate([np.ones((*steps.shape[:-1], 1)), steps, steps**2], axis=-1)


def _joint_terms(steps: Float64Array) -> Float64Array:
    """Return 1, the steps, their squares and products: (..., n) to (..., 1 + n + n (n + 1) / 2)."""
    one, other = np.triu_indices(steps.shape[-1])
    products = steps[..., one] * steps[..., other]
    return np.concatenate([np.ones((*steps.shape[:-1], 1)), steps, products], axis=-1)


def _logistic(logits: Float64Array) -> Float64Array:
    return np.asarray(1 / (1 + np.exp(-np.clip(logits, -50, 50))))


def _surprise(logits: Float64Array, failed: Float64Array) -> float:
    return float(np.sum(np.logaddexp(0, logits) - failed * logits))


def _left_out(
    regress: Regress, terms: Float64Array, wanted: Float64Array, folds: Sequence[Parts], penalty: float
) -> Float64Array:
    """Return what regressions on the other parts say of each case, the mean over partings."""
    told = np.zeros(len(wanted))
    for fold in folds:
        for k in np.unique(fold):
            others = fold != k
            told[~others] += terms[~others] @ regress(terms[others], wanted[others], penalty) / len(folds)
    return told


def _ridge(terms: Float64Array, wanted: Float64Array, strength: float) -> Float64Array:
    """Return the coefficients of a linear ridge regression on :func:`_joint_terms`."""
    n = int((2 * terms.shape[1]) ** 0.5) - 1  # of (n + 1) (n + 2) / 2 terms
    penalty = strength * np.repeat([0.0, 1.0, JOINT_BENT], [1, n, terms.shape[1] - 1 - n])
    return np.asarray(np.linalg.solve(terms.T @ terms + np.diag(penalty), terms.T @ wanted))


def _curve(told: Float64Array, failed: Float64Array) -> tuple[float, float]:
    """Return offset and slope of the logistic curve from what was told to the chance (Platt, 1999)."""
    from scipy.optimize import minimize

    found = minimize(lambda c: _surprise(c[0] + c[1] * told, failed), [0.0, 1.0], method="Nelder-Mead").x
    return float(found[0]), float(found[1])


def _regressed(
    terms: Float64Array, failed: Float64Array, strength: float, signs: npt.NDArray[np.int_]
) -> Float64Array:
    """Return the coefficients of a logistic ridge regression on :func:`_terms`.

    A feature of sign 1 never lowers the chance within :data:`MOST`, one of -1 never lifts it: what is fitted
    are the slopes at both ends, of that sign or none, of which the coefficients are mean and difference.
    """
    from scipy.optimize import minimize

    n = len(signs)
    penalty = np.concatenate([[1e-3], strength * np.repeat([1.0, BENT], n)])
    of_slopes = np.eye(1 + 2 * n)
    mean, bend = np.eye(n) / 2, np.eye(n) / (4 * MOST)
    of_slopes[1:, 1:] = np.block([[mean, mean], [-bend, bend]])

    def objective(slopes: Float64Array) -> tuple[float, Float64Array]:
        at = of_slopes @ slopes
        logits = terms @ at
        slope = terms.T @ (_logistic(logits) - failed) + penalty * at
        return _surprise(logits, failed) + float(penalty @ at**2) / 2, of_slopes.T @ slope

    ends = [(0.0 if sign > 0 else None, 0.0 if sign < 0 else None) for sign in signs]
    bounds = [(None, None), *ends, *ends]
    found = minimize(objective, np.zeros(1 + 2 * n), jac=True, method="L-BFGS-B", bounds=bounds).x
    return np.asarray(of_slopes @ found)
