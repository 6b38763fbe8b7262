"""Which part of a camera moved, by how its pattern's shift and size changed at several depths.

A ray through the diffuser at ``u`` from a source at ``(x, z)`` meets the sensor at ``(1 + d/z) u - (d/z) x``.
So with the depth a pattern's shift goes as ``d/z`` where the source moved across, as ``1 + d/z`` where the
diffuser did, and stays where the sensor did. Its size changes by ``w / (z + d)`` where the diffuser moved
away by ``w``, by about ``-d c / (z (z + d))`` where the source did by ``c``. One depth tells none apart;
several do where the differences exceed what the shifts are known to.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.arrays import Float64Array

_SURE = 9.0
"""Sum of squares by which an explanation is worse that is ruled out: three standard deviations."""
_PARAXIAL = 0.01
"""Part of a shift or of a change of size to which straight rays tell it."""
_LEAST_PX = 0.02
"""To which blocks of a pattern are registered at best."""
_WORTH_PX = 0.05
"""Smaller changes are not told of: what stages and rooms do between any two sweeps."""
_SEEN = 5.0
"""Standard deviations from which a change is one: of 40 pairs of sweeps between which nothing moved, none."""


@dataclass(frozen=True, slots=True)
class Seen:
    """How a pattern changed at one depth."""

    z_um: float
    rows: float
    columns: float
    """Its shift, pixels."""
    growth: float
    """Its size over what it was, less 1."""
    place_error_px: float
    """Standard deviation of either shift."""
    growth_error: float
    extent_px: float
    """From its middle to its corner: what a change of size moves."""

    @property
    def edge_error_px(self) -> float:
        """Standard deviation of how far a change of size moves the pattern's edge."""
        return self.growth_error * self.extent_px


@dataclass(frozen=True, slots=True)
class Explanation:
    """Parts that may have moved, in words, the most likely first."""

    parts: tuple[str, ...]
    """Those that the depths allow; none: no single part explains what is seen."""

    @property
    def sentence(self) -> str:
        """What moved, or among what it cannot be told."""
        if not self.parts:
            return "No single part moved so: more than one did, or the pattern itself changed."
        if len(self.parts) == 1:
            return f"{self.parts[0][0].upper()}{self.parts[0][1:]}: the other parts would move it otherwise."
        return f"Which part moved cannot be told from these depths: {', or '.join(self.parts)}."


def seen_px(error_px: float) -> float:
    """Return from which size on a displacement is seen that is known to a standard deviation."""
    return max(_WORTH_PX, _SEEN * error_px)


def unseen(
    seen: Sequence[Seen],
    distance_um: float | None,
    pitch_um: float | None,
    told: tuple[float, float],
) -> str:
    """Return in a sentence what may have changed without being seen.

    ``told`` are the shift, pixels, that is told however little it is known, and the relative difference of
    light between depths.
    """
    told_px, drifted = told
    across = min(seen, key=lambda each: seen_px(each.place_error_px) * each.z_um)
    along = min(seen, key=lambda each: seen_px(each.edge_error_px) / each.extent_px * each.z_um)
    shift_px, edge_px = seen_px(across.place_error_px), seen_px(along.edge_error_px)
    turn = math.degrees(min(seen_px(each.edge_error_px) / each.extent_px for each in seen))
    if not math.isfinite(shift_px):
        moved = (
            f"what moves the pattern by less than {told_px:.2g} pixel{'s' * (told_px != 1)}, nor what moved "
            "along the axis or turned, as too few parts of the pattern were recognised"
        )
    elif distance_um is None or pitch_um is None:
        moved = (
            f"what moves the pattern by less than {shift_px:.2g} pixels, its edge by less than {edge_px:.2g}"
            f", or turns it by less than {turn:.2g} degrees"
        )
    else:
        by_um, ratio = shift_px * pitch_um, distance_um / across.z_um
        apart_um = edge_px / along.extent_px * (along.z_um + distance_um)
        moved = (
            f"a source that moved across by less than {_length(by_um / ratio)}, along the axis by less than "
            f"{_length(apart_um * along.z_um / distance_um)}; a diffuser that did by less than "
            f"{_length(by_um / (1 + ratio))} and {_length(apart_um)}, or it or the sensor turned by less "
            f"than {turn:.2g} degrees"
        )
    if len(seen) == 1:
        lamp = "any drift of the lamp during a sweep (one depth does not show it; several do)"
    else:
        lamp = f"a drift of the lamp during a sweep by less than {drifted:.0%}"
    return f"This comparison does not see {moved}; {lamp}."


def _length(um: float) -> str:
    if um >= 1e3:
        return f"{um / 1e3:.2g} mm"
    return f"{um:.{_decimals(um)}f} um"


def _decimals(um: float) -> int:
    """Return how many decimals a length is told with that is not to read as none: pixels may be small."""
    if um >= 10:
        return 0
    return min(max(1, math.ceil(-math.log10(um))), 4) if um > 0 else 1


def moved_across(seen: Sequence[Seen], distance_um: float, pitch_um: float) -> Explanation | None:
    """Return what moved sideways; None where nothing did by :data:`_WORTH_PX`, or there is one depth."""
    shifts = np.array([complex(each.columns, each.rows) for each in seen])
    worth = [abs(shift) > seen_px(e.place_error_px) for shift, e in zip(shifts, seen, strict=True)]
    if len(seen) < 2 or not any(worth):
        return None
    ratio = np.array([distance_um / each.z_um for each in seen])
    errors = np.array([each.place_error_px for each in seen])
    known = np.sqrt(errors**2 + _LEAST_PX**2 + (_PARAXIAL * np.abs(shifts)) ** 2)
    parts = {
        "the source": -ratio / pitch_um,
        "the diffuser": (1 + ratio) / pitch_um,
        "the sensor, or its region of interest,": np.full(len(seen), -1 / pitch_um),
    }
    found: dict[str, float] = {}
    for part, per_um in parts.items():
        by = complex((per_um * shifts / known**2).sum() / (per_um**2 / known**2).sum())
        misfit = float((np.abs(shifts - per_um * by) ** 2 / known**2).sum())
        digits = _decimals(abs(by))
        x, y = (round(part_um, digits) + 0.0 for part_um in (by.real, by.imag))  # no -0
        found[f"{part} moved across by ({x:+.{digits}f}, {y:+.{digits}f}) um"] = misfit
    return _allowed(found, 2 * (len(seen) - 1))


def moved_along(seen: Sequence[Seen], distance_um: float) -> Explanation | None:
    """Return what moved along the axis; None where it is not worth it, or there is one depth."""
    growth = np.array([each.growth for each in seen])
    extent = np.array([each.extent_px for each in seen])
    worth = [abs(e.growth) * e.extent_px > seen_px(e.edge_error_px) for e in seen]
    if len(seen) < 2 or not any(worth):
        return None
    z = np.array([each.z_um for each in seen])
    errors = np.array([each.growth_error for each in seen])
    known = np.sqrt(errors**2 + (_LEAST_PX / extent) ** 2 + (_PARAXIAL * growth) ** 2)

    def fitted(per_um: Float64Array, rest: Float64Array) -> float:
        return float((per_um * rest / known**2).sum() / (per_um**2 / known**2).sum())

    apart = fitted(1 / (z + distance_um), growth)
    nearer = 0.0
    for _ in range(5):  # of the source: not linear in where it stands
        size = (1 + distance_um / (z + nearer)) / (1 + distance_um / z)
        slope = -distance_um / (z + nearer) ** 2 / (1 + distance_um / z)
        nearer = max(nearer + fitted(slope, growth - (size - 1)), -0.9 * float(z.min()))
    size = (1 + distance_um / (z + nearer)) / (1 + distance_um / z)
    diffuser = ((growth - apart / (z + distance_um)) ** 2 / known**2).sum()
    source = ((growth - (size - 1)) ** 2 / known**2).sum()
    to, of = ("farther from", "nearer to")[apart < 0], ("farther away", "nearer")[nearer < 0]
    apart_um, nearer_um = (f"{um:.{_decimals(um)}f} um" for um in (abs(apart), abs(nearer)))
    return _allowed(
        {
            f"the diffuser moved, it is about {apart_um} {to} the sensor": float(diffuser),
            f"the source moved, it stands about {nearer_um} {of} than is recorded": float(source),
        },
        len(seen) - 1,
    )


def _allowed(misfits: dict[str, float], freedom: int) -> Explanation:
    """Return the explanations that fit, none of which is much worse than the best."""
    best = min(misfits.values())
    allowed = [words for words, misfit in misfits.items() if misfit <= min(best, freedom + _SURE) + _SURE]
    allowed = [words for words in allowed if misfits[words] <= freedom + 2 * _SURE]
    return Explanation(tuple(sorted(allowed, key=lambda words: misfits[words])))
