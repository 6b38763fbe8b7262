"""Which ways to reconstruct there are for a problem, and which do not apply to it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

from recon.base.namespace import array_namespace
from recon.camera.camera_model import ModelName, members_of_depths
from recon.errors import InputError
from recon.priors import PRIORS
from recon.reconstruction.overrides import PRECISIONS, Precision
from recon.reconstruction.solvers import VOLUME_PRIORS

if TYPE_CHECKING:
    from recon.evaluation.chart_reconstruction import ChartProblem

PICTURE_METHODS: dict[str, tuple[str, ...]] = {
    "wiener": ("nonnegative", "none"),
    "admm": tuple(p for p in PRIORS if p != "tv-haar"),
    "admm-sensor": tuple(p for p in PRIORS if p != "tv-haar"),
    "fista": tuple(PRIORS),
}
"""Methods of a picture, each with the priors that it has a way for. Wiener's knows bounds only."""
ON_DEVICE = "admm-gpu"
"""How charts call ``"admm"`` of a picture with its arrays on a GPU, where there is one."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to reconstruct.

    Attributes
    ----------
    method : str
        A name of ``recon.reconstruction.solvers.SOLVERS``, :data:`ON_DEVICE`, or ``"volume"``.
    model, prior : str
    binning : int
    background : bool
        Whether a smooth one is estimated as well.
    precision : str
        Of the arithmetic.
    """

    method: str
    model: ModelName
    prior: str
    binning: int = 1
    background: bool = False
    precision: Precision = "float32"

    @property
    def name(self) -> str:
        """Say it briefly."""
        parts = [self.method, self.model, self.prior]
        if self.background:
            parts.append("background")
        if self.binning > 1:
            parts.append(f"bin {self.binning}")
        if self.precision != "float32":
            parts.append(self.precision)
        return " ".join(parts)

    @property
    def family(self) -> str:
        """Method and model."""
        return f"{self.method} {self.model}"


def settings_for(problem: ChartProblem) -> tuple[Setting, ...]:
    """Return every applicable setting, the quick ones first.

    Which are not applicable, and why: :func:`left_out`.
    """
    models: tuple[ModelName, ...] = ("convolution",)
    if _varies(problem):
        models = ("convolution", "lowrank", "local")
    found: list[Setting] = []
    for binning in binnings_of(problem):
        if not problem.volume:
            found += [
                Setting(method, "convolution", prior, binning, precision=precision)
                for precision in PRECISIONS
                for method, priors in PICTURE_METHODS.items()
                for prior in priors
            ]
            if _has_gpu():
                found += [
                    Setting(ON_DEVICE, "convolution", prior, binning, precision=precision)
                    for precision in PRECISIONS
                    for prior in VOLUME_PRIORS
                ]
        found += [
            Setting("volume", model, prior, binning, background, precision)
            for precision in PRECISIONS
            for prior in VOLUME_PRIORS
            for model in models
            for background in (False, True)
            # Without either, the methods of a picture solve the same problem.
            if problem.volume or model != "convolution" or background
        ]
    return tuple(sorted(found, key=_cost))


def left_out(problem: ChartProblem) -> tuple[str, ...]:
    """Say which settings are not applicable to a problem, and why."""
    found = []
    if problem.volume:
        found.append(
            f"the methods {', '.join(PICTURE_METHODS)}: they are for one depth, volumes have their own"
        )
    else:
        found.append("tv-haar but for fista, and any prior for wiener: these methods have no way for them")
    if not _varies(problem):
        found.append("the local and low-rank models: the calibration has one PSF a depth")
    if binnings_of(problem) == [1]:
        small = problem.erasures is None
        found.append(
            f"binning: {'too few pixels would be left' if small else 'erased pixels cannot be averaged'}"
        )
    if not problem.volume and not _has_gpu():
        found.append(f"{ON_DEVICE}: there is no GPU that CuPy can use")
    return tuple(found)


def _varies(problem: ChartProblem) -> bool:
    positions = problem.calibration.source_positions_um
    return len(positions) > len(members_of_depths(positions))


@cache
def _has_gpu() -> bool:
    try:
        array_namespace("gpu")
    except InputError:
        return False
    return True


def require_applicable(problem: ChartProblem, setting: Setting) -> None:
    """Raise InputError for a setting that does not apply: it would be run as another one, or not at all."""
    if setting not in settings_for(problem):
        raise InputError(f"The setting '{setting.name}' does not apply to this problem.")


def binnings_of(problem: ChartProblem) -> list[int]:
    """Return the binnings that leave enough pixels; erased ones cannot be averaged with others."""
    largest = max(problem.measurement.shape)
    return [1, *(b for b in (2, 4) if largest // b >= 24 and problem.erasures is None)]


def _cost(setting: Setting) -> float:
    """Rough order of time, and of how much there is to learn."""
    slow = {"convolution": 1.0, "lowrank": 20.0, "local": 30.0}[setting.model]
    methods = {"wiener": 0.01, "admm": 1.0, "fista": 1.5, "admm-sensor": 2.0, ON_DEVICE: 2.0, "volume": 3.0}
    # What differs from the usual way by little comes after what differs by much.
    usual = setting.prior in ("tv", "l1") or setting.method == "wiener"
    rank = (1 if usual else 4) * (1 if setting.precision == "float32" else 8)
    return slow * methods[setting.method] / setting.binning**2 * rank
