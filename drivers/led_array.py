"""The LED array interface and the patterns it shows."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from drivers.errors import LimitError
from drivers.sequence import PlaysSequences

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class LedPattern:
    """Which LEDs are lit and how brightly.

    Attributes
    ----------
    description : str
        In words, as logs and metadata show it: ``"off"``, ``"bright field NA 0.25"``, ``"LED 12"``.
    levels : tuple of (index, (red, green, blue))
        LEDs that are on; each level 0 to 255. All others are dark.
    """

    description: str
    levels: tuple[tuple[int, Rgb], ...] = ()

    @classmethod
    def of_mask(cls, description: str, lit: npt.NDArray[np.bool_], rgb: Rgb) -> LedPattern:
        """Return the pattern that lights some LEDs of an array, ``(n_leds,)``, all in one colour."""
        return cls(description, tuple((int(index), rgb) for index in np.flatnonzero(lit)))

    @property
    def is_dark(self) -> bool:
        """Whether no LED is lit."""
        return all(rgb == (0, 0, 0) for _, rgb in self.levels)


OFF = LedPattern("off")


class LedArray(PlaysSequences[LedPattern]):
    """An array of RGB LEDs. It is dark after ``open`` and after ``close``."""

    @property
    @abstractmethod
    def led_positions_mm(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 3)`` positions x, y, z of the LEDs in millimetres, in the array's own frame."""

    @property
    @abstractmethod
    def led_na(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 2)`` sines of the illumination angle in x and y at the array's centre of view."""

    @property
    @abstractmethod
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Centre wavelengths of red, green and blue, nanometres."""

    @property
    @abstractmethod
    def pattern(self) -> LedPattern:
        """The pattern shown now: the last one that the device confirmed, told without asking it."""

    @abstractmethod
    def set_pattern(self, pattern: LedPattern) -> LedPattern:
        """Show a pattern and return it once the device has confirmed.

        Raises LimitError when an index or a level is out of range; the pattern shown stays.
        """

    def check(self, pattern: LedPattern) -> None:
        """Refuse a pattern that the array cannot show.

        Raises LimitError when an index or a level is out of range.
        """
        count = len(self.led_positions_mm)
        for led, rgb in pattern.levels:
            if not 0 <= led < count:
                raise LimitError(self.name, f"has no LED {led}.", f"It has LEDs 0 to {count - 1}.")
            if len(rgb) != 3 or not all(0 <= level <= 255 for level in rgb):
                raise LimitError(self.name, f"cannot show level {rgb} on LED {led}.", "Levels are 0 to 255.")

    @abstractmethod
    def off(self) -> None:
        """Turn every LED off. Callable from any thread; overtakes whatever is running."""

    def single(self, index: int, rgb: Rgb = (255, 255, 255)) -> LedPattern:
        """Return the pattern of one LED; others are :mod:`instrument.plan.patterns`' matter."""
        return LedPattern(f"LED {index} rgb {rgb}", ((index, rgb),))
