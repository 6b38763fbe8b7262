"""Which settings the held-out pixels cannot tell from the best: scores that differ less than they scatter.

The same pixels are held out for every setting, so that their noise is common to all scores. What scatters is
the ratio of two of them, told by how much it differs from one part of the pixels to the next. Where
most settings are even, the score says little, and the quickest of them is as good a choice as the best. They
are settings of one binning, compared pixel by pixel: the blocks on which settings of different binnings are
scored are far fewer, and do not see what is finer.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from recon.evaluation.scored import Point, is_known

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
