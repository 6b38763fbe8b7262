"""What solvers and priors refuse, in words, and what lies just within."""

from __future__ import annotations

import re
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest

from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution
from recon.errors import InputError, StructureError
from recon.priors import L1, Box, HaarTotalVariation, NonNegativity, TotalVariation
from recon.priors.base import Prior, Separable, require_weight
from recon.priors.total_variation import Differences
from recon.solvers.admm import Admm
from recon.solvers.base import StoppingRules
from recon.solvers.douglas_rachford import SparseDouglasRachford
from recon.solvers.fista import Fista
from recon.solvers.prior_splits import ratio, require_exact, soft_pair
from recon.solvers.splitting import SensorData

PSFS = np.random.default_rng(0).random((2, 1, 5, 6))
DATA = np.ones((1, 8, 9))


def volume(prior: Separable, channels: int = 1) -> SparseDouglasRachford:
    camera = Convolution(PSFS, (8, 9), n_channels=channels, dtype=np.float64)
    return SparseDouglasRachford(camera, SensorData(DATA.repeat(channels, 0), np.ones((8, 9), bool)), prior)


class Cropping(L1):
    """Written by somebody in a hurry."""

    def prox(self, x: np.ndarray, step: float) -> np.ndarray:
        return super().prox(x, step)[..., :2]


class Complex(L1):
    """Filters in the frequency domain, and keeps what comes back."""

    def prox(self, x: np.ndarray, step: float) -> np.ndarray:
        return super().prox(x, step) + 0j


class Valued(L1):
    """Has a value a pixel, or none at all."""

    def __init__(self, value: object) -> None:
        super().__init__(0.1)
        self.told = value

    def value(self, x: np.ndarray) -> float:
        return self.told  # type: ignore[return-value]


class Plain(L1):
    """As it is, and not known for what it is."""

    def joined(self, other: Prior) -> Prior | None:
        return None


class InPlace(Plain):
    """Writes its prox over what it is given."""

    def prox(self, x: np.ndarray, step: float) -> np.ndarray:
        x[:] = super().prox(x, step)
        return x


class Bare(LinearOperator):
    """Does not call its parent's ``__init__``."""

    norm_bound = 1.0

    def __init__(self) -> None:
        pass

    def forward(self, x: np.ndarray, out: np.ndarray | None = None) -> np.ndarray:
        return x

    adjoint = forward


def of_own(prior: Prior, operator: LinearOperator | None = None) -> object:
    camera = operator or Convolution(PSFS[:1, 0], (8, 9), dtype=np.float64)
    return Fista(camera, DATA, prior).run(StoppingRules(2))


WITHIN: list[Callable[[], object]] = [
    lambda: volume(L1(0.1)),
    lambda: volume(L1(0.1) + NonNegativity()),
    lambda: Box(1.0, 1.0),
    lambda: L1(0.0),
    *(lambda value=value: of_own(Valued(value)) for value in (1, np.float32(1), np.array(1), Fraction(1, 2))),
    lambda: Differences((1, 4, 5), (1, 1, 1)),
    lambda: Differences((1, 3, 4, 5), np.ones((3, 3)), (True, False, True)),
]
REFUSED: list[tuple[Callable[[], object], type[Exception], str]] = [
    (lambda: volume(L1(0.1), channels=2), ValueError, "One channel at a time, not 2"),
    (lambda: volume(Box(-1.0, 1.0)), StructureError, "for l1 and non-negativity alone"),
    (lambda: volume(Separable(0.1, lower=-1.0)), StructureError, "for l1 and non-negativity alone"),
    (lambda: require_exact(L1(0.1), HaarTotalVariation(0.1)), StructureError, "HaarTotalVariation is only"),
    (lambda: of_own(Cropping(0.1)), InputError, "Cropping: its prox must return an array like its argument"),
    (lambda: of_own(Complex(0.1)), InputError, "Complex: its prox must return real numbers as its argument"),
    (lambda: of_own(Valued(np.ones((3, 4)))), InputError, "a real number, not an array (3, 4)"),
    (lambda: of_own(Valued(None)), InputError, "value must return a real number, not NoneType"),
    (lambda: of_own(Valued(1j)), InputError, "value must return a real number, not complex"),
    (lambda: of_own(Valued(np.complex64(1j))), InputError, "a real number, not complex64"),
    (lambda: of_own(Valued(np.array(1j))), InputError, "a real number, not an array of complex128"),
    (lambda: of_own(Valued(np.array("3"))), InputError, "a real number, not an array of <U1"),
    (lambda: of_own(Valued(np.ones(1))), InputError, "a real number, not an array (1,)"),
    (lambda: of_own(Valued("3")), InputError, "value must return a real number, not str"),
    (lambda: Convolution(np.full((1, 5, 6), np.nan), (8, 9)), InputError, "The PSF holds 30 values"),
    (lambda: of_own(L1(0.1), Bare()), AttributeError, "Bare has no range_shape: its __init__ must call"),
    (lambda: L1(-0.1), ValueError, "must be a number, 0 or more, not -0.1"),
    (lambda: require_weight(float("nan")), ValueError, "must be a number, 0 or more, not nan"),
    (lambda: TotalVariation(-1.0), ValueError, "must be a number, 0 or more, not -1"),
    (lambda: Box(2.0, 1.0), ValueError, "lower limit 2 is above its upper limit 1"),
    (lambda: Box(float("nan"), 1.0), ValueError, "lower limit must be a number, not nan"),
    (lambda: Differences((4, 5), (1, 1, 1)), ValueError, "Weights (3,) do not fit an object of shape (4, 5)"),
    (lambda: Differences((1, 3, 4, 5), np.ones((2, 3))), ValueError, "Weights (2, 3) do not fit"),
    (lambda: Differences((4, 5), np.ones((4, 2))), ValueError, "Weights (4, 2) do not fit"),
    (lambda: Differences((1, 4, 5), (1, 1), (True,)), ValueError, "wrap has 1 entries for 2 weights"),
]  # fmt: skip


@pytest.mark.parametrize("number", range(len(REFUSED)))
def test_it_is_refused_in_words(number: int) -> None:
    call, kind, says = REFUSED[number]
    with pytest.raises(kind, match=re.escape(says)):
        call()


@pytest.mark.parametrize("number", range(len(WITHIN)))
def test_what_lies_just_within_is_taken(number: int) -> None:
    assert WITHIN[number]() is not None


def test_residuals_are_relative_and_nothing_of_nothing_is_none() -> None:
    assert (ratio(0.0, 0.0), ratio(2.0, 0.0), ratio(0.0, 3.0)) == (0.0, 1.0, 0.0)
    assert ratio(2.0, 8.0) == 0.5


def test_a_pair_of_differences_is_shrunk_by_its_length_or_each_by_itself() -> None:
    tx, ty = np.array([3.0, 0.3, 0.0]), np.array([-4.0, 0.4, 0.0])
    together = soft_pair(tx, ty, 1.0, isotropic=True)
    np.testing.assert_allclose(together, [[2.4, 0, 0], [-3.2, 0, 0]])
    each = soft_pair(tx, ty, 0.35, isotropic=False)
    np.testing.assert_allclose(each, [[2.65, 0, 0], [-3.65, 0.05, 0]], atol=1e-12)


def test_a_prior_of_ones_own_may_write_into_its_argument() -> None:
    camera = Convolution(PSFS[:1, 0], (8, 9), dtype=np.float64)
    own, ours = (
        Admm(camera, DATA, prior + NonNegativity()).run(StoppingRules(5)).solution
        for prior in (InPlace(0.1), Plain(0.1))
    )
    np.testing.assert_array_equal(own, ours)
