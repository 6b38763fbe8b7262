"""Gain as a factor, from whatever number a camera calls its gain."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

GainUnit = Literal["dB", "factor", "steps"]


@dataclass(frozen=True, slots=True)
class GainScale:
    """What a camera's gain number means.

    Attributes
    ----------
    unit : str
        ``"dB"``: the number times ``per_count`` is decibels of the signal, ``factor = 10**(dB/20)``;
        ``"factor"``: the number times ``per_count`` is the factor; ``"steps"``: the meaning is not known, and
        the factor reported is ``1 + (number - lowest) * per_count``: it orders settings, no more.
    per_count : float
    lowest : float
        The smallest number that the camera takes.
    """

    unit: GainUnit
    per_count: float
    lowest: float

    def factor(self, number: float) -> float:
        """Return the factor that a number stands for."""
        match self.unit:
            case "dB":
                return float(10 ** (number * self.per_count / 20))
            case "factor":
                return number * self.per_count
            case "steps":
                return 1 + (number - self.lowest) * self.per_count

    def number(self, factor: float) -> float:
        """Return the number that stands for a factor."""
        match self.unit:
            case "dB":
                return 20 * math.log10(factor) / self.per_count if factor > 0 else -math.inf
            case "factor":
                return factor / self.per_count
            case "steps":
                return self.lowest + (factor - 1) / self.per_count
