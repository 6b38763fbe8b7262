"""Scored settings: points, what they cost and how good they are, and the fronts that nothing beats."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

SETTLED_ITERATIONS = 30
"""Before these a run's error is of another kind: it is not bright or sharp yet, whatever it will come to."""
_SCATTERS = 2.0
"""Standard errors of the mean ratio within which two scores are even."""
_LEAST_PARTS = 4
_LEAST = 1e-12
"""Mean square below which parts do not differ, in units of the noise'."""


def even_with_best(points: Iterable[Point], least_iterations: int = SETTLED_ITERATIONS) -> tuple[Point, ...]:
    """Return the settled point with the best score on held-out pixels, and those even with it, best first.

    Points of fewer than ``least_iterations`` do not take part, but for one-shot methods.
    All have the best one's binning. Empty where no point tells its scatter.
    """
    told = [
        p
        for p in points
        if is_known(p, "held_out")
        and len(p.held_out_parts) >= _LEAST_PARTS
        and (p.iterations == 0 or p.iterations >= least_iterations)
    ]
    if not told:
        return ()
    chosen = _binning(min(told, key=lambda p: p.held_out))
    alike = sorted((p for p in told if _binning(p) == chosen), key=lambda p: float(np.mean(p.held_out_parts)))
    return tuple(p for p in alike if p is alike[0] or _is_even(p, alike[0]))


def _binning(point: Point) -> float:
    return point.binning if is_known(point, "binning") else 1.0


def _is_even(point: Point, best: Point) -> bool:
    if len(point.held_out_parts) != len(best.held_out_parts):
        return False  # other pixels: there is nothing that both have in common
    # Ratios: of differences one bright pixel that both miss would make most of the scatter.
    mine, its = (np.log(np.maximum(p.held_out_parts, _LEAST)) for p in (point, best))
    apart = mine - its
    scatter = float(np.std(apart, ddof=1)) / len(apart) ** 0.5
    return bool(np.mean(apart) <= _SCATTERS * scatter)


NAN = float("nan")
Aside = Callable[[], AbstractContextManager[object]]
"""Opens a context in which memory is taken that is not the setting's own: scoring."""


def nothing_aside() -> AbstractContextManager[object]:
    """Be an :data:`Aside` for those who do not measure memory."""
    return nullcontext()


@dataclass(frozen=True, slots=True)
class Axis:
    """Something that a point has a number of."""

    key: str
    """The attribute of :class:`Point`."""
    words: str
    """With the unit."""
    more_is_better: bool = False
    logarithmic: bool = False
    """Whether it is drawn so."""


SECONDS = Axis("seconds", "time of the solver (s)", logarithmic=True)
MEMORY = Axis("peak_mib", "memory beyond the input's, at the peak (MiB)", logarithmic=True)
IMAGES = Axis("images", "photographs taken for the calibration", logarithmic=True)
SSIM = Axis("ssim", "SSIM", more_is_better=True)
NRMSE = Axis("nrmse", "NRMSE")
HELD_OUT = Axis("held_out", "error on held-out pixels (noise = 1)", logarithmic=True)
RESIDUAL = Axis("residual", "residual (noise = 1)", logarithmic=True)

KindName = Literal["reconstruction", "hologram", "calibration"]


@dataclass(frozen=True, slots=True)
class Kind:
    """What is charted."""

    name: KindName
    costs: tuple[Axis, ...]
    """The first is the one that fronts are made of."""
    scores: tuple[Axis, ...]
    """The first that is known of any point is the one that fronts are made of."""

    def score_of(self, points: Iterable[Point]) -> Axis:
        """Return the first score that some point has."""
        points = list(points)
        return next((s for s in self.scores if any(is_known(p, s.key) for p in points)), self.scores[0])


_OF_PICTURES = (SSIM, NRMSE, HELD_OUT, RESIDUAL)
KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "reconstruction",
            (SECONDS, MEMORY),
            (Axis("psnr_db", "PSNR (dB)", more_is_better=True), *_OF_PICTURES),
        ),
        Kind(
            "hologram",
            (SECONDS, MEMORY),
            (
                Axis("psnr_db", "PSNR of the seen image (dB)", more_is_better=True),
                Axis("middle_psnr_db", "PSNR of its middle quarter (dB)", more_is_better=True),
                SSIM,
                Axis("middle_ssim", "SSIM of the middle quarter", more_is_better=True),
            ),
        ),
        Kind(
            "calibration",
            (IMAGES, SECONDS, MEMORY),
            (Axis("psnr_db", "PSNR of the reconstruction (dB)", more_is_better=True), *_OF_PICTURES),
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Point:
    """One score of one setting; NaN is what was not measured or makes no sense."""

    setting: str
    """Its name."""
    iterations: int
    """0 for one-shot methods."""
    seconds: float
    """Wall time of the solver up to here."""
    residual: float = NAN
    """Norm of the residual over that of the noise, on the pixels that were used, as ``held_out``."""
    held_out: float = NAN
    """Root mean square error of the predicted held-out blocks' means, in units of these means' noise, as
    :mod:`recon.evaluation.chart_judge` has it; the blocks are those of the coarsest binning."""
    psnr_db: float = NAN
    ssim: float = NAN
    nrmse: float = NAN
    """``psnr_db``, ``ssim`` and ``nrmse``: against the truth."""
    peak_mib: float = NAN
    """Memory at the run's peak beyond what the process took before it."""
    middle_psnr_db: float = NAN
    middle_ssim: float = NAN
    """``middle_psnr_db`` and ``middle_ssim``: of the middle quarter of a hologram's field."""
    images: float = NAN
    """Photographs that a calibration took."""
    family: str = ""
    """Settings of one family share a colour."""
    group: str = ""
    """Only settings of one group compete."""
    binning: float = NAN
    """Of the pixels that were computed with."""
    held_out_parts: tuple[float, ...] = ()
    """Mean squares of the errors on held-out pixels, each by itself and not in blocks, apart for parts of
    them that all settings of one binning share."""

    def to_json(self) -> dict[str, Any]:
        """Return it with None for what is not known."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


def is_known(point: Point, key: str) -> bool:
    """Whether a point has a number (and not NaN) there."""
    value = getattr(point, key)
    return bool(value == value)


@dataclass(frozen=True, slots=True)
class Curve:
    """One setting's scores."""

    points: tuple[Point, ...]
    finished: bool
    """False where the time limit cut the run off: given longer, it would go on."""


def pareto(points: Iterable[Point], score: Axis, cost: Axis = SECONDS) -> list[Point]:
    """Return the points that no other is both cheaper and better than, the cheapest first, without groups.

    Points that lack one of the two numbers do not compete.
    """
    sign = 1.0 if score.more_is_better else -1.0
    known = [p for p in points if is_known(p, score.key) and is_known(p, cost.key)]
    front: list[Point] = []
    best = -np.inf
    for point in sorted(known, key=lambda p: (getattr(p, cost.key), -sign * getattr(p, score.key))):
        value = sign * getattr(point, score.key)
        if value > best:
            front.append(point)
            best = value
    return front


def fronts(points: Sequence[Point], kind: Kind) -> dict[str, list[Point]]:
    """Return each group's front, of the kind's first cost and the first score that is known."""
    score = kind.score_of(points)
    groups = dict.fromkeys(p.group for p in points)
    return {g: pareto([p for p in points if p.group == g], score, kind.costs[0]) for g in groups}
