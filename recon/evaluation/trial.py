"""What charts and maps have in common: subjects, the settings that compete on them, and how one is run.

Solvers, priors and camera models are asked, not listed: what is registered takes part where its solver
accepts the problem (:data:`recon.reconstruction.solvers.SOLVERS`, :data:`recon.priors.PRIORS`,
:data:`recon.camera.camera_model.CAMERAS`).
"""

from __future__ import annotations

import hashlib
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np

from recon.arrays import Array
from recon.base.namespace import Device
from recon.camera.camera_model import CAMERAS
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.evaluation.scored import Aside, Curve, KindName, Point, nothing_aside
from recon.priors import PRIORS
from recon.reconstruction.options import Precision, ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.base import StopReason
from recon.verdict.cases import OF_VOLUMES


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to reconstruct.

    Attributes
    ----------
    solver, prior : str
        Names of :data:`recon.reconstruction.solvers.SOLVERS` and :data:`recon.priors.PRIORS`.
    model : str
        Of the camera.
    background : bool
        Whether a smooth one is estimated as well.
    precision : str
        Of the arithmetic.
    """

    solver: str
    model: str
    prior: str
    binning: int = 1
    background: bool = False
    precision: Precision = "float32"
    device: Device = "cpu"

    @classmethod
    def named(cls, method: str, model: str = "convolution") -> Setting:
        """Return what a map's method is: a solver and a prior, "admm tv", or a solver alone.

        A camera model between them counts instead of ``model``; " of volumes" changes nothing.

        Raises InputError when there is no such solver or prior.
        """
        solver, *rest = method.removesuffix(OF_VOLUMES).split(" ")
        offered = SOLVERS.named(solver)
        prior = PRIORS.named(rest[-1] if rest else offered.prior)
        return cls(offered.name, " ".join(rest[:-1]) or model, prior.name)

    @property
    def name(self) -> str:
        """Say it briefly."""
        parts = [self.solver, self.model, self.prior]
        if self.background:
            parts.append("background")
        if self.binning > 1:
            parts.append(f"bin {self.binning}")
        return " ".join(parts + [p for p in (self.precision, self.device) if p not in ("float32", "cpu")])

    @property
    def family(self) -> str:
        """Solver and model."""
        return f"{self.solver} {self.model}"

    @property
    def is_plain(self) -> bool:
        """Whether it has one PSF a depth and estimates no background."""
        return self.model == "convolution" and not self.background

    @property
    def one_step(self) -> bool:
        """Whether its solver has no iterations."""
        return SOLVERS.named(self.solver).one_step

    def options(self, *, iterations: int | None = None, **more: Any) -> ReconstructionOptions:
        """Return the options that reconstruct so; limits do not apply to a solver without iterations."""
        if self.one_step:
            more |= {"time_s": None, "tolerance": None}
        return ReconstructionOptions(
            solver=self.solver,
            model=self.model,  # type: ignore[arg-type]
            prior=self.prior,
            device=self.device,
            precision=self.precision,
            estimate_background=self.background,
            iterations=None if self.one_step else iterations,
            **more,
        )

    def refusal(self, problem: Problem) -> str | None:
        """Say why its solver or camera does not take a problem (of any model and options); None: they do."""
        asked = replace(problem, options=self.options(), model=self.model, smooth=self.background)  # type: ignore[arg-type]
        reason = SOLVERS.named(self.solver).accepts(asked)
        if reason is None and self.model in CAMERAS:
            reason = CAMERAS[self.model].refuses(problem.depths)
        return reason

    def cost(self, *, volume: bool) -> float:
        """Rough order of time, and of how much there is to learn."""
        slow = {"convolution": 1.0, "lowrank": 20.0, "local": 30.0}.get(self.model, 30.0)
        # What differs from the usual way by little comes after what differs by much.
        usual = self.prior in ("tv", "l1") or self.one_step
        rank = (1 if usual else 4) * (1 if self.precision == "float32" else 8)
        more = 3.0 if volume or not self.is_plain else 1.0 if self.device == "cpu" else 2.0
        return slow * more * SOLVERS.named(self.solver).cost / self.binning**2 * rank


def own_methods(*, volume: bool) -> tuple[str, ...]:
    """Return the methods, for pictures or volumes, that others' packages or this program have registered.

    A prior or camera model comes with the first solver that takes it.
    """
    asked = list(_own_ways())
    if not asked:
        return ()
    scene = make_scene("beads", size=16, depths=2) if volume else make_scene("sparse-picture", size=16)
    options = ReconstructionOptions(model="convolution", judged=False)
    problem = Problem.of(scene.measurement, scene.calibration, options)
    taken = ((way for way in ways if Setting.named(way).refusal(problem) is None) for ways in asked)
    return tuple(way + (OF_VOLUMES if volume else "") for ways in taken for way in list(ways)[:1])


def _own_ways() -> Iterator[list[str]]:
    """Yield, of each that others have registered, the methods by which it can be tried."""
    yield from ([f"{name} {SOLVERS[name].prior}"] for name in SOLVERS if not SOLVERS.is_own(name))
    yield from ([f"{s} {name}" for s in SOLVERS] for name in PRIORS if not PRIORS.is_own(name))
    yield from ([f"{s} {name} {SOLVERS[s].prior}" for s in SOLVERS] for name in CAMERAS)


# Subjects -------------------------------------------------------------------------------------------
class Named(Protocol):
    """A setting, as far as those know it who do not run it."""

    @property
    def name(self) -> str:
        """Different for each setting of a subject."""
        ...


S = TypeVar("S", bound=Named)


class Subject(ABC, Generic[S]):
    """Something that settings compete on. It is sent to other processes: it can be pickled.

    A subclass says what its settings are, runs one, and names what scores depend on.
    """

    kind: ClassVar[KindName]
    """Which scores it has."""

    @property
    @abstractmethod
    def pixels(self) -> tuple[int, ...]:
        """Of what is computed, for titles."""

    @abstractmethod
    def settings(self) -> Sequence[S]:
        """Return every applicable setting, the quick ones first."""

    def run(
        self, setting: S, *, limit_s: float | None = None, aside: Aside = nothing_aside, **how: Any
    ) -> Curve:
        """Run one of its settings, scoring ``aside``.

        Raises InputError when the setting does not apply: it would be run as another one, or not at all.

        Parameters
        ----------
        setting
            One of :meth:`settings`.
        limit_s : float, optional
            Wall seconds after which the run stops.
        aside : Aside
            In which points are scored.
        **how
            What else this subject's runs can be told: ``counts``, the iterations to score at, ascending.
        """
        if setting not in self.settings():
            raise InputError(f"The setting '{setting.name}' does not apply to this {self.kind}.")
        return self._curve(setting, limit_s, aside, **how)

    @abstractmethod
    def _curve(self, setting: S, limit_s: float | None, aside: Aside) -> Curve: ...

    @abstractmethod
    def warm_up(self, setting: S) -> None:
        """Run a setting once in small, so that what it needs is loaded and compiled."""

    @abstractmethod
    def _identity(self) -> Iterable[str | Array | None]:
        """Yield all that scores depend on."""

    def fingerprint(self) -> str:
        """Return a digest of all that scores depend on."""
        digest = hashlib.sha256()
        for part in self._identity():
            words = "none" if part is None else part
            digest.update(words.encode() if isinstance(words, str) else np.ascontiguousarray(words).tobytes())
        return digest.hexdigest()[:16]


Turn = tuple[Callable[[float | None], Reconstruction], Callable[[Reconstruction], Point]]
"""A reconstruction within so many seconds, and its score."""


def in_turns(turns: Iterable[Turn], limit_s: float | None, aside: Aside) -> Curve:
    """Return the points of several reconstructions; those for which the time is not enough are left out."""
    points: list[Point] = []
    spent = 0.0
    for reconstructed, scored in turns:
        left_s = None if limit_s is None else limit_s - spent
        if left_s is not None and left_s <= 0:
            return Curve(tuple(points), finished=False)
        result = reconstructed(left_s)
        if StopReason.TIME in result.stop_reasons:
            return Curve(tuple(points), finished=False)
        spent += result.seconds
        with aside():
            points.append(scored(result))
    return Curve(tuple(points), finished=True)
