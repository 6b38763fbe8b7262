"""The spatial light modulator interface."""

from __future__ import annotations

from abc import abstractmethod

import numpy as np
import numpy.typing as npt

from drivers.errors import LimitError
from drivers.sequence import PlaysSequences


def read_only(levels: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
    """Return a view that cannot be written to."""
    view = levels.view()
    view.flags.writeable = False
    return view


class Slm(PlaysSequences[npt.NDArray[np.uint8]]):
    """A spatial light modulator that shows 8-bit grey levels. It is blank (all zero) after ``open``.

    Attributes
    ----------
    mirrors : bool
        Whether a level is how much light a pixel sends, 255 all of it; else it is a phase.
    is_screen : bool
        Whether it gives light of its own, as a monitor does.
    """

    mirrors: bool = False
    is_screen: bool = False

    @property
    @abstractmethod
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` in pixels."""

    @property
    @abstractmethod
    def pixel_pitch_um(self) -> float:
        """Pixel pitch, micrometres."""

    @property
    @abstractmethod
    def settle_ms(self) -> float:
        """Time from a confirmed image to settled optics, milliseconds; ``display`` waits for it."""

    @abstractmethod
    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show ``(height, width)`` uint8 grey levels, confirmed and settled when this returns.

        Raises LimitError when shape or dtype do not fit; the image shown stays.
        """

    @property
    @abstractmethod
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels shown now, ``(height, width)`` uint8, read only; told without asking the device."""

    def _check(self, levels: npt.NDArray[np.uint8]) -> None:
        """Refuse what does not fit, for drivers."""
        if levels.shape != self.shape or levels.dtype != np.uint8:
            raise LimitError(
                self.name, f"cannot show {levels.dtype} {levels.shape}.", f"It takes uint8 {self.shape}."
            )

    def blank(self) -> None:
        """Show all zeros."""
        self.display(np.zeros(self.shape, np.uint8))
