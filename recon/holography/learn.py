"""Fit what a display differs in from photographs of known patterns, by Gauss-Newton on what an eye resolves.

The unknowns are few and smooth; a photograph of random phases has as many numbers as the SLM has pixels. The
Jacobian is made of differences of the model itself: a photograph each for every unknown. Small lags come
first: a wavefront error enters them by its differences over short ways only, so that errors of several
radians are still on the right side of the valley. A mask that is too deep and one that is too shallow lie in
two valleys, between which the little light that passes a mask undiffracted changes its sign: both are
searched. Each photograph's brightness is free.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon.arrays import Array
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.learned import Learned, terms
from recon.holography.model import HologramModel
from recon.holography.panel import Panel
from recon.holography.pose import NODES
from recon.holography.target import ORDER, Target

CUTS = (0.25, 0.5, 1.0, 1.0, 1.0)
"""Of the eye's cut-off, up to which lags count, round by round."""
_MIRRORED, _LAST = 2, 2
"""Rounds from the other valley, and from the better of the two."""
_WORTH = 0.9
"""Of the power not explained by the description: what is left must be less, or the description stays."""
AT_ONCE = 2
"""Photographs that a round fits at least, and that it has in memory at a time."""
_FIRST_CROSSTALK = 0.2
"""SLM pixels: it has to be there to be felt."""
_BELIEF = 30.0
"""How much more than by noise of as many lags what the photographs hardly tell is held where it was: what is
left of them is not noise."""
_BEND = 3
"""Order of the polynomials of the mask's displacement."""


@dataclass(frozen=True, slots=True)
class Look:
    """A photograph of a known pattern.

    Attributes
    ----------
    slm : ndarray, complex, (height, width)
        Asked for.
    lags : ndarray, complex, as ``HologramModel.lags``
        Of the light over the field, any unit.
    """

    slm: Array
    lags: Array


@dataclass(frozen=True, slots=True)
class Lesson:
    """What was learned, and how much better it explains photographs that were not fitted.

    Attributes
    ----------
    display : Display
        With what was learned, or as it was where that did not help.
    before, after : float
        Part of those photographs' contrast that is not explained, rms.
    rounds : tuple of float
        The same after each round; from the sixth on the mask's depth is first mirrored, then the better of
        the two.
    helps : bool
        Whether enough less is unexplained; else the display is as it was.
    """

    display: Display
    before: float
    after: float
    rounds: tuple[float, ...]
    helps: bool


def nothing_learned(display: Display) -> Learned:
    """Return what is to be learned of a display before anything is: the display as it is described."""
    amplitude, phase = (np.zeros(len(terms(order))) for order in (4, 6))
    light = display.dc.amplitude
    response = np.zeros((6, 2))
    response[:, 0] = display.dc.modulated
    dc = np.array([light.real, light.imag])
    return Learned(response, dc, np.zeros(2), amplitude, phase, np.zeros((2, 4)), 1.0)


@dataclass(frozen=True, slots=True)
class _Unknown:
    """Some of the unknowns: how many, how large they may be expected, and the step of their differences."""

    name: str
    count: int
    scale: float


class _Fit:
    """Displays of a vector of unknowns, and what they show."""

    def __init__(self, display: Display, looks: Sequence[Look]) -> None:
        self.start = display
        learned = display.learned or nothing_learned(display)
        mixed = np.maximum(np.abs(learned.crosstalk_px), _FIRST_CROSSTALK)
        self.learned = replace(learned, crosstalk_px=mixed)
        self._panel: Panel | None = None
        self._bare: dict[Any, Array] = {}
        """Fields before illumination, of the patterns and displays of a round."""
        self.model = HologramModel(display, [Target(np.ones((8, 8)))], loss="frequency")
        y, x = self.model.band.lags()
        self.radius = np.hypot(y[:, None], x) / self.model.band.cutoff
        self.mirror = np.where(x == 0, 1.0, np.sqrt(2.0))
        if any(look.lags.shape != self.radius.shape for look in looks):
            raise InputError(f"Photographs must be given by {self.radius.shape} lags.")
        nodes = display.displacement
        self.nodes = np.zeros((*NODES, 2)) if nodes is None else np.asarray(nodes, float)
        v, u = (np.linspace(-1, 1, n) for n in self.nodes.shape[:2])
        self.bends = [np.multiply.outer(v**i, u**j) for i, j in [(0, 0), *terms(_BEND)]]
        found = self.learned
        self.unknowns = (
            _Unknown("response", found.response.size, 0.3),
            _Unknown("dc", 2, 0.3),
            _Unknown("crosstalk_px", 2, 0.3),
            _Unknown("amplitude", found.amplitude.size, 0.3),
            _Unknown("phase", found.phase.size, 1.0),
            _Unknown("shade", found.shade.size, 0.3),
            _Unknown("mask_depth", 1, 0.1),
            _Unknown("bend", 2 * len(self.bends), 0.3),
        )
        self.scales = np.concatenate([np.full(u.count, u.scale) for u in self.unknowns])

    def display(self, vector: Array) -> Display:
        """Return the display at a vector of changes from the start."""
        parts, at = {}, 0
        for unknown in self.unknowns:
            parts[unknown.name] = vector[at : at + unknown.count]
            at += unknown.count
        bend = parts.pop("bend").reshape(2, -1)
        old = self.learned
        values: dict[str, Any] = {
            name: np.asarray(getattr(old, name), float) + change.reshape(np.shape(getattr(old, name)))
            for name, change in parts.items()
        }
        values["mask_depth"] = float(values["mask_depth"])
        nodes = self.nodes
        if bend.any():
            nodes = nodes + np.stack([np.tensordot(row, self.bends, 1) for row in bend], axis=-1)
        elif self.start.displacement is not None:
            nodes = self.start.displacement
        return replace(self.start, displacement=nodes).taught(Learned(**values))

    def mirrored(self, vector: Array) -> Array:
        """Return the unknowns with a mask as much too deep as it was too shallow."""
        at = sum(u.count for u in self.unknowns[: [u.name for u in self.unknowns].index("mask_depth")])
        other = vector.copy()
        other[at] = 2 * (1 - self.learned.mask_depth) - vector[at]
        return other

    def lags(self, display: Display, slm: Array) -> Array:
        """Return what a display shows of a pattern, at the lags of the photographs."""
        if display is not self.model.display:
            self.model.take(display)
            self._panel = None if display.learned is None else Panel(display, np.complex64)
        learned = display.learned
        if learned is None or self._panel is None:
            return np.asarray(self.model.lags(np.asarray(slm, np.complex64)[None]), np.complex64)
        # Most unknowns leave what the SLM does as it was, which costs the most.
        key = (id(slm), learned.response.tobytes(), learned.dc.tobytes(), learned.crosstalk_px.tobytes())
        bare = self._bare.get(key)
        if bare is None:
            bare = self._panel.bare(slm)
            if len(self._bare) < 2 * AT_ONCE:
                self._bare[key] = bare
        return np.asarray(self.model.lags_of_field((self._panel.light * bare)[None]), np.complex64)

    def forget(self) -> None:
        """Keep nothing of the round before."""
        self._bare.clear()

    def weights(self, cut: float) -> Array:
        """Return weights of the lags; the mean, which is brightness, has none."""
        weights = self.mirror / (1 + (self.radius / cut) ** (2 * ORDER))
        weights[0, 0] = 0
        return np.asarray(weights, np.float32)

    def unexplained(self, display: Display, looks: Sequence[Look], cut: float = 1.0) -> float:
        """Return the rms part of photographs' contrast that a display leaves unexplained."""
        weights = self.weights(cut)
        parts = []
        for look in looks:
            wanted = look.lags * weights
            left, _ = _without(wanted, self.lags(display, look.slm) * weights)
            parts.append(_power(left) / _power(wanted))
        return float(np.sqrt(np.mean(parts)))

    def best(self, vectors: Sequence[Array], looks: Sequence[Look]) -> Array:
        """Return the unknowns that explain photographs best."""
        return min(vectors, key=lambda vector: self.unexplained(self.display(vector), looks))


def learn_display(
    display: Display,
    looks: Sequence[Look],
    *,
    aside: int = 3,
    on_progress: Callable[[float, str], object] | None = None,
) -> Lesson:
    """Learn how a display differs from its description.

    Parameters
    ----------
    display : Display
        As described, with the mask's displacement where it is known; what it has learned is gone on from.
    looks : sequence of Look
        Random phases, at least ``aside`` + 2.
    aside : int
        So many of the last ones, at least one, are not fitted; they judge.
    on_progress : callable, optional
        ``on_progress(share, words)``; it may raise to end the work.

    Raises InputError for too few photographs, and for photographs of which next to nothing is explained even
    afterwards: another mask, or one that is not aligned.
    """
    if aside < 1:
        raise InputError(f"At least one photograph must judge what is learned, not {aside}.")
    if len(looks) < aside + 2:
        raise InputError(f"At least {aside + 2} photographs are needed, not {len(looks)}.")
    fitted, kept = looks[:-aside], looks[-aside:]
    fit = _Fit(display, looks)
    before = fit.unexplained(display, kept)
    rounds: list[float] = []
    found = [np.zeros(len(fit.scales))]
    plan = (*CUTS, *[CUTS[-1]] * (_MIRRORED + _LAST))
    per = _in_a_round(len(fitted))
    for number, cut in enumerate(plan):
        if number == len(CUTS):
            found.append(fit.mirrored(found[0]))
        elif number == len(CUTS) + _MIRRORED:
            found = [fit.best(found, fitted)]
        some = [fitted[(number * per + n) % len(fitted)] for n in range(per)]

        def tell(share: float, number: int = number) -> None:
            if on_progress is not None:
                done = (number + share) / len(plan)
                on_progress(done, f"round {number + 1} of {len(plan)}")

        found[-1] = _stepped(fit, found[-1], some, cut, _system(fit, found[-1], some, cut, tell))
        rounds.append(fit.unexplained(fit.display(found[-1]), kept))
    learned = fit.display(fit.best(found, fitted))
    after = fit.unexplained(learned, kept)
    if min(before, after) > HOPELESS:
        raise InputError(
            f"The photographs are not this display's: {1 - before**2:.0%} of their contrast was explained "
            f"before, {1 - after**2:.0%} after learning. Align the mask (align mask), and give its alignment."
        )
    helps = after**2 < _WORTH * before**2
    return Lesson(learned if helps else display, before, after, tuple(rounds), helps)


def _in_a_round(fitted: int) -> int:
    """Return how many photographs a round fits, so that each of them is fitted in some round."""
    return min(max(AT_ONCE, -(-fitted // len(CUTS))), fitted)


def learning_work(mask_pixels: int, fitted: int) -> float:
    """Return what learning from so many fitted photographs computes, in transforms of 1024 x 1024.

    Measured once with two photographs a round behind a mask of 0.92 megapixels; one of 0.083, of which a step
    was, takes 790 by that and 760 by this.
    """
    return _OF_A_PHOTOGRAPH * float((1e-6 * mask_pixels) ** 1.5) * _in_a_round(fitted)


_OF_A_PHOTOGRAPH = 28000.0 / 2 / 0.9216**1.5


def unexplained(display: Display, looks: Sequence[Look]) -> float:
    """Return the rms part of photographs' contrast that a display leaves unexplained."""
    return _Fit(display, looks).unexplained(display, looks)


HOPELESS = 0.8
"""Unexplained part of photographs beyond which nothing was learned."""


@dataclass(frozen=True, slots=True)
class _System:
    """Normal equations of a round."""

    matrix: Array
    right: Array
    power: float
    """Of what is not explained yet, all photographs together."""
    unexplained: float


def _system(
    fit: _Fit, vector: Array, looks: Sequence[Look], cut: float, tell: Callable[[float], object]
) -> _System:
    """Form the normal equations, in units of the unknowns' scales."""
    n = len(vector)
    weights = fit.weights(cut)
    used = weights > 1e-3
    matrix, right = np.zeros((n, n)), np.zeros(n)
    power = 0.0
    display = fit.display(vector)
    for first in range(0, len(looks), AT_ONCE):
        few = looks[first : first + AT_ONCE]
        fit.forget()
        here = [fit.lags(display, look.slm) for look in few]
        rows = [np.empty((n, int(used.sum())), np.complex64) for _ in few]
        for i, scale in enumerate(fit.scales):
            step = _STEP * scale
            moved = fit.display(vector + step * np.eye(n)[i])
            for look, now, jacobian in zip(few, here, rows, strict=True):
                jacobian[i] = ((fit.lags(moved, look.slm) - now) * weights)[used] * (scale / step)
            tell((first + len(few) * (i + 1) / n) / len(looks))
        for look, now, jacobian in zip(few, here, rows, strict=True):
            wanted, shown = (look.lags * weights)[used], (now * weights)[used]
            left, gain = _without(wanted, shown)
            jacobian *= np.float32(gain / np.sqrt(_power(wanted)))
            left /= np.float32(np.sqrt(_power(wanted)))
            unit = shown / np.float32(np.sqrt(_power(shown)))
            jacobian -= np.outer((jacobian @ unit.conj()).real, unit)  # brightness is free
            flat = jacobian.view(np.float32)
            matrix += flat @ flat.T
            right += flat @ left.view(np.float32)
            power += _power(left)
    return _System(matrix, right, power, float(np.sqrt(power / len(looks))))


_STEP = 0.02
"""Of an unknown's scale, of the differences that its derivative is made of."""


def _stepped(fit: _Fit, vector: Array, looks: Sequence[Look], cut: float, system: _System) -> Array:
    """Step to the normal equations' solution, less far where that does not explain the photographs better."""
    scaled = vector / fit.scales
    lags = max(int((fit.weights(cut) > 0.5).sum()) * len(looks), 1)
    prior = _BELIEF * system.power / lags
    for damping in (0.0, 1e-3, 1e-2, 1e-1):
        matrix = system.matrix + np.diag(prior + damping * np.diag(system.matrix))
        change = np.linalg.solve(matrix, system.right - prior * scaled)
        trial: Array = vector + np.clip(change, -3, 3) * fit.scales
        now = fit.unexplained(fit.display(trial), looks, cut)
        if now < system.unexplained:
            return trial
    return vector


def _power(values: Array) -> float:
    return float(np.vdot(values, values).real)


def _without(wanted: Array, shown: Array) -> tuple[Array, float]:
    """Return what is left of wanted values after the best multiple of what is shown, and that multiple."""
    gain = float(np.vdot(shown, wanted).real) / max(_power(shown), 1e-30)
    return np.asarray(wanted - np.float32(gain) * shown, np.complex64), gain
