"""Which differences between the seen and the wanted image count (Kuo 2020, Eqs. 7.16, 7.17, 7.19).

A loss is an object with a value and a gradient that is registered under a name; terminal, window and chart
ask :data:`LOSSES` what there is. A new one is a class in a file of its own and a line in :func:`_own`, or, in
an installed package, an entry point of the group ``diffuserbench.losses``.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import ClassVar

import numpy as np

from recon.arrays import Array
from recon.base.registry import Registry


class Loss(ABC):
    """What is made small: a function of an image and of the one that is wanted.

    Images are real, (height, width), in FFT order, in units of the mean intensity that an SLM of random
    phases gives; ``difference`` is the seen image minus the wanted one.

    Attributes
    ----------
    name, help : str
        How it is called, and one line about it.
    low_passed : bool
        Whether both images have passed the eye's low-pass (Eq. 7.18); else every pixel of the grid counts.
    takes_wanted, takes_weights : bool
        Whether it looks at the wanted image itself, and at weights over the field; else it gets None.
    mean_square : bool
        Whether its value is half the mean square of the difference: no image is formed then, the sum runs
        over Fourier coefficients.
    cost : float
        Rough time of an evaluation, relative to the loss "frequency".
    """

    name: ClassVar[str]
    help: ClassVar[str]
    low_passed: ClassVar[bool] = True
    takes_wanted: ClassVar[bool] = False
    takes_weights: ClassVar[bool] = False
    mean_square: ClassVar[bool] = False
    cost: ClassVar[float] = 1.5

    @property
    def title(self) -> str:
        """What a legend calls it."""
        return f"{self.name} loss"

    @abstractmethod
    def value(self, difference: Array, wanted: Array | None, weights: Array | None) -> float:
        """Return the loss.

        Parameters
        ----------
        difference : ndarray, real, (height, width)
        wanted, weights : ndarray, real, (height, width), or None
            The greatest weight is 1.
        """

    @abstractmethod
    def gradient(self, difference: Array, wanted: Array | None, weights: Array | None) -> Array:
        """Return the derivative of the value by each pixel of the seen image, (height, width)."""

    def evaluate(self, difference: Array, wanted: Array | None, weights: Array | None) -> tuple[float, Array]:
        """Return value and gradient; ``difference`` may be written over."""
        value = self.value(difference, wanted, weights)
        return value, self.gradient(difference, wanted, weights)


class _MeanSquare(Loss):
    mean_square = True

    def value(self, difference: Array, wanted: Array | None, weights: Array | None) -> float:
        """Return half the mean square."""
        return float(np.mean(difference.astype(np.float64) ** 2)) / 2

    def gradient(self, difference: Array, wanted: Array | None, weights: Array | None) -> Array:
        """Return ``difference / N``."""
        return difference / difference.size


class Everything(_MeanSquare):
    """``L = 1/2 mean((I - T)^2)`` (Eq. 7.16): also what no eye resolves."""

    name = "none"
    help = "Every pixel of the mask's grid counts, also what no eye resolves."
    low_passed = False
    cost = 1.3

    @property
    def title(self) -> str:
        """What a legend calls it."""
        return "no constraint"


class LowPassed(_MeanSquare):
    """``L = 1/2 mean((c_f (I - T))^2)`` (Eq. 7.17): what the eye resolves."""

    name = "frequency"
    help = "What the eye resolves counts."
    cost = 1.0


class Weighted(Loss):
    """``L = 1/2 mean((c_s c_f (I - T))^2)`` (Eq. 7.19): what the eye resolves, weighted over the field."""

    name = "spatial"
    help = "What the eye resolves counts, weighted over the field."
    takes_weights = True
    cost = 1.4

    def value(self, difference: Array, wanted: Array | None, weights: Array | None) -> float:
        """Return half the mean square of the weighted difference."""
        assert weights is not None
        return float(np.mean((weights * difference.astype(np.float64)) ** 2)) / 2

    def gradient(self, difference: Array, wanted: Array | None, weights: Array | None) -> Array:
        """Return ``weights^2 difference / N``."""
        assert weights is not None
        return weights**2 * difference / difference.size

    def evaluate(self, difference: Array, wanted: Array | None, weights: Array | None) -> tuple[float, Array]:
        """Return value and gradient, the latter in place of ``difference``."""
        from recon.holography import _kernels

        return _kernels.weigh(difference, weights) / 2, difference


def _own() -> Iterable[Loss]:
    return (Everything(), LowPassed(), Weighted())


LOSSES: Registry[Loss] = Registry("hologram loss", "diffuserbench.losses", _own)


def loss_of(loss: str | Loss) -> Loss:
    """Return the loss of a name, or the given one.

    Raises InputError when there is no such name.
    """
    return LOSSES.named(loss) if isinstance(loss, str) else loss
