"""What the photographs of given calibrations buy on a given frame: parts of each, scored on held-out pixels.

Each calibration takes part as it is and thinned: the PSF on the axis alone, every second point of a grid,
every second depth. All predict the same held-out pixels of one photograph, so that their scores compare.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Float64Array
from recon.camera.camera_model import ModelName, members_of_depths
from recon.camera.varying_psfs import grid_axes
from recon.errors import InputError
from recon.evaluation.chart_calibration import ITERATIONS
from recon.evaluation.chart_judge import Judge
from recon.evaluation.chart_reconstruction import SCORES, ChartProblem
from recon.evaluation.scene import make_scene
from recon.evaluation.scored import Aside, Curve, Point
from recon.evaluation.trial import Setting, Subject, Turn, in_turns
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.reconstruct import reconstruct
from recon.reconstruction.result import Reconstruction
from recon.types import Calibration

Members = npt.NDArray[np.intp]
_SCENES: dict[str, str] = {"tv": "as an extended scene (tv)", "l1": "as a sparse scene (l1)"}
"""What a photograph is of is for its owner to say: both fronts are drawn."""


@dataclass(frozen=True)
class OwnCalibration:
    """A calibration, and the photograph that it is tried on."""

    label: str
    """Different for each."""
    problem: ChartProblem
    """The same photograph for all; the calibration of this one."""
    photographs: float = 1.0
    """How many were taken for each of its PSFs; of a blind one: for all of them together, over their
    number."""
    whole: bool = False
    """Whether it can only be had as a whole: a blind one."""


@dataclass(frozen=True, slots=True)
class OwnSetting:
    """A part of a calibration."""

    label: str
    part: str
    members: tuple[int, ...]
    """Its PSFs."""
    images: int
    """Photographs."""
    model: ModelName

    @property
    def name(self) -> str:
        """Say it briefly."""
        return f"{self.label}, {self.part}"


@dataclass(frozen=True)
class OwnCalibrationsProblem(Subject[OwnSetting]):
    """Calibrations that compete on one photograph.

    PSFs that cannot be used together are an InputError of their run.
    """

    kind = "calibration"

    calibrations: tuple[OwnCalibration, ...]

    def __post_init__(self) -> None:
        labels = [c.label for c in self.calibrations]
        if len(set(labels)) != len(labels):
            raise InputError(f"Each calibration needs a name of its own; found {', '.join(labels)}.")
        first = self.calibrations[0]
        for other in self.calibrations[1:]:
            if other.problem.measurement.shape != first.problem.measurement.shape:
                shapes = (" x ".join(map(str, c.problem.measurement.shape)) for c in (first, other))
                raise InputError(
                    "Calibrations are compared on the same pixels: the photograph has {2} with {0}, and {3} "
                    "with {1}. Take such as were made with one binning and window.".format(
                        first.label, other.label, *shapes
                    )
                )

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the photograph."""
        return self.calibrations[0].problem.measurement.shape

    def settings(self) -> tuple[OwnSetting, ...]:
        """Return every calibration and its parts, few photographs first."""
        found = [s for c in self.calibrations for s in _parts(c)]
        return tuple(sorted(found, key=lambda s: s.images))

    def _curve(self, setting: OwnSetting, limit_s: float | None, aside: Aside) -> Curve:
        """Reconstruct with either prior, and score."""
        own = next(c for c in self.calibrations if c.label == setting.label)
        calibration = own.problem.calibration.part(list(setting.members))
        problem = replace(self.calibrations[0].problem, volume=True, calibration=calibration)
        return in_turns((_turn(problem, setting, prior) for prior in _SCENES), limit_s, aside)

    def warm_up(self, setting: OwnSetting) -> None:
        """Reconstruct a small scene of the same sort."""
        scene = make_scene("beads", size=16, grid=3, depths=2)
        small = ChartProblem(scene.measurement, scene.calibration, volume=True)
        for prior in _SCENES:
            small.run(_way(setting, prior), counts=(1,))

    def _identity(self) -> Iterator[str]:
        yield f"own calibrations {SCORES} {[s.name for s in self.settings()]}"
        for c in self.calibrations:
            yield f"{c.label} {c.photographs} {c.whole} {c.problem.fingerprint()}"


def _way(setting: OwnSetting, prior: str) -> Setting:
    return Setting("admm", setting.model, prior, background=True)


def _turn(problem: ChartProblem, setting: OwnSetting, prior: str) -> Turn:
    way = _way(setting, prior)
    judge = Judge(problem, way, 0)

    def reconstructed(left_s: float | None) -> Reconstruction:
        return reconstruct(
            Measurement(judge.measurement, erasures=judge.erasures, noise=judge.noise),
            judge.calibration,
            way.options(iterations=ITERATIONS, time_s=left_s, field="full", judged=False),
        )

    def scored(result: Reconstruction) -> Point:
        point = judge.point(result.volume, len(result.histories[0]), result.seconds)
        point = replace(point, setting=setting.name, family=setting.label)
        return replace(point, images=setting.images, group=_SCENES[prior])

    return reconstructed, scored


def _parts(own: OwnCalibration) -> list[OwnSetting]:
    """Return a calibration as a whole, and thinned over field and depth."""
    calibration = own.problem.calibration
    positions = calibration.source_positions_um
    depths = members_of_depths(positions)
    parts: dict[tuple[int, ...], str] = {}
    middle = len(depths) // 2
    thinned = [depths, depths[::2], depths[middle : middle + 1]]
    choosers: tuple[Callable[[Members], Any], ...] = (
        lambda group: group,
        partial(_every_second, calibration),
        lambda group: [calibration.nearest_to_axis(group)],
    )
    ways = [(chosen, chooser) for chosen in thinned for chooser in choosers]
    for chosen, chooser in ways[:1] if own.whole else ways:
        members = tuple(sorted(int(m) for group in chosen for m in chooser(group)))
        psfs = f"{len(members)} PSF" + ("s" if len(members) > 1 else "")
        parts.setdefault(members, psfs + _which(chosen, depths, positions))
    return [
        OwnSetting(
            own.label,
            words,
            members,
            round(own.photographs * len(members)),
            "local" if any(np.isin(group, members).sum() > 1 for group in depths) else "convolution",
        )
        for members, words in parts.items()
    ]


def _which(
    chosen: list[Members],
    depths: list[Members],
    positions: Float64Array,
) -> str:
    """Say at which of several depths; of a single one its number too: z may be unknown, or the steps fine."""
    if len(depths) == 1:
        return ""
    if len(chosen) > 1:
        return f" at {len(chosen)} of {len(depths)} depths"
    number = next(n for n, group in enumerate(depths, 1) if group is chosen[0])
    z_mm = float(positions[chosen[0], 2].mean()) / 1e3
    return f" at depth {number} of {len(depths)}" + (f" (z {z_mm:.4g} mm)" if np.isfinite(z_mm) else "")


def _every_second(calibration: Calibration, group: Members) -> Members:
    """Return every second point of a grid of 5 x 5 or more, with its corners; else all."""
    places = calibration.source_positions_um[group][:, 1::-1]
    if len(group) < 25 or not np.isfinite(places).all():
        return group
    grid = grid_axes(places)
    if grid is None or any(len(axis) < 5 or len(axis) % 2 == 0 for axis in grid[:2]):
        return group
    rows, columns, order = grid
    table = group[order].reshape(len(rows), len(columns))
    return table[::2, ::2].ravel()
