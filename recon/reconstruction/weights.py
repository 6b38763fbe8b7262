"""How heavy a prior is where nobody says: one table by prior and camera."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from recon.errors import InputError
from recon.priors import PRIORS, Prior

CameraClass = Literal["picture", "planes", "varying", "varying, with a background"]
"""One PSF for one plane without a background; one PSF a depth; PSFs that vary over the field."""


@dataclass(frozen=True, slots=True)
class DefaultWeight:
    """A default weight: in units of the noise, and at least so much.

    Attributes
    ----------
    noise : float
        In units of the noise, which the adjoint of a unit-energy PSF passes on unchanged.
    least : float
        Relative to ``max |A^H b|``: what errors of the model ask for when noise does not.
    why : str
    """

    noise: float
    least: float
    why: str


_AS_NOISE = "as large as the noise that the adjoint passes on"
_VARYING = (
    "near the best from 100 to 20000 photons, in the mean 0.9 dB (pictures by TV), 0.7 dB (volumes by TV) "
    "and 0.6 dB (points by l1) better than the weights of one PSF, at four to twelve times the distance of "
    "diffuser and sensor; strokes on black as near as that stand more. One convolution leaves errors of the "
    "model, which larger weights hide as they hide noise; the true model leaves noise alone"
)
DEFAULT_WEIGHTS: Mapping[tuple[str, CameraClass], DefaultWeight] = {
    ("tv", "picture"): DefaultWeight(1.0, 1e-5, _AS_NOISE),
    ("tv", "planes"): DefaultWeight(1.0, 1e-5, _AS_NOISE),
    ("tv", "varying"): DefaultWeight(0.5, 1e-5, _VARYING),
    ("tv", "varying, with a background"): DefaultWeight(0.5, 1e-5, _VARYING),
    ("l1", "picture"): DefaultWeight(1.0, 1e-5, f"{_AS_NOISE}: a picture has as many unknowns as data"),
    ("l1", "planes"): DefaultWeight(
        1.5, 1e-2, "what noise exceeds in few of the many voxels; errors of the model stand out among them"
    ),
    ("l1", "varying"): DefaultWeight(1.0, 4e-3, _VARYING),
    ("l1", "varying, with a background"): DefaultWeight(
        1.0, 1e-2, "with a background points lose the hold that the total of the light gives them"
    ),
}
"""By what the prior counts ("tv": differences, "l1": light) and the camera."""


def kind_of(prior: str) -> Literal["tv", "l1"]:
    """Return what a prior counts: differences, or light; of one without a name differences."""
    return PRIORS[prior].kind if prior in PRIORS else "tv"


def is_weighted(prior: str) -> bool:
    """Whether a prior by name has a weight: bounds have none."""
    return prior not in PRIORS or PRIORS[prior].weighted


def default_tau(prior: str, camera: CameraClass, peak: float) -> tuple[float, float]:
    """Return the default weight relative to ``max |A^H b|`` (``peak``, in units of the noise), and noise's.

    The second is what noise alone asks for, without a least weight.
    """
    row = DEFAULT_WEIGHTS[kind_of(prior), camera]
    of_noise = row.noise / peak if peak > 0 else 0.0
    return max(of_noise, row.least), of_noise


def penalty_of(prior: str | Prior, weight: float) -> Prior:
    """Return a prior of some weight, in units of the scaled problem; one of the user's own as it is."""
    return prior if isinstance(prior, Prior) else PRIORS[prior](weight)


def name_of(prior: str | Prior) -> str:
    """Return how a prior is recorded."""
    return prior if isinstance(prior, str) else "+".join(type(t).__name__ for t in prior.terms())


def require_prior(prior: object) -> None:
    """Raise InputError for what is neither a prior nor the name of one."""
    if isinstance(prior, Prior):
        return
    if not isinstance(prior, str):
        names = ", ".join(PRIORS)
        raise InputError(
            f"A prior is a name ({names}) or an object like TotalVariation(0.1); found {prior!r}."
        )
    PRIORS.named(prior)
