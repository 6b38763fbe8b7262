"""Speed against accuracy: every applicable setting on one problem, scored as it goes.

A run is scored at several counts of iterations on the way, with the time the solver had spent by then
without the scoring. With a ground truth the score is PSNR, SSIM and NRMSE; always also the residual relative
to the noise, and the error on pixels that were held out: 5 % of them are erased, reconstructed from the rest
and predicted. They are held out in blocks of the coarsest binning, and the error is that of their means:
it is of the same light and in the same units whatever a setting's binning is.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.auto.reduced import binned, blocks, enlarged, reduced_calibration
from recon.chart.scored import Aside, Curve, KindName, Point, nothing_aside
from recon.errors import InputError
from recon.gpu import array_namespace
from recon.noise import NoiseModel
from recon.operators.local_convolution import field_of
from recon.picture import PRIORS, reconstruct
from recon.preparation import PRECISIONS, Precision, channel_noise, data_of
from recon.scenes import make_scene
from recon.scenes.scene import Family
from recon.scenes.score import score
from recon.solvers.stopping import IterationRecord, StopReason
from recon.types import Calibration
from recon.volume.channel import PRIORS as VOLUME_PRIORS
from recon.volume.channel import ChannelProblem
from recon.volume.model import ModelName, members_of_depths
from recon.volume.reconstruct import prepare_volume, reconstruct_volume

Array = npt.NDArray[Any]

COUNTS = (3, 5, 10, 20, 40, 80, 160, 320)
"""Iterations at which a run is scored."""
HELD_SHARE = 0.05
PICTURE_METHODS: dict[str, tuple[str, ...]] = {
    "wiener": ("nonnegative", "none"),
    "admm": tuple(p for p in PRIORS if p != "tv-haar"),
    "admm-sensor": tuple(p for p in PRIORS if p != "tv-haar"),
    "fista": tuple(PRIORS),
}
"""Methods of a picture, each with the priors that it has a way for. Wiener's knows bounds only."""
GPU_PRIORS = ("tv", "tv-isotropic", "l1", "nonnegative")
"""Those of ``admm-gpu``, where there is a GPU."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One way to reconstruct.

    Attributes
    ----------
    method : str
        A name of :func:`recon.methods.method_names`, or ``"volume"``.
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


@dataclass(frozen=True)
class ChartProblem:
    """What is reconstructed over and over.

    Attributes
    ----------
    measurement : ndarray, (height, width)
        One channel, counts, background subtracted.
    calibration : Calibration
    volume : bool
        Whether all depths take part; else the calibration holds one depth.
    erasures : ndarray of bool or None
    noise : NoiseModel, float or None
    truth : ndarray or None
        (height, width), or (n_z, height, width).
    """

    measurement: npt.NDArray[np.float32]
    calibration: Calibration
    volume: bool
    erasures: npt.NDArray[np.bool_] | None = None
    noise: NoiseModel | float | None = None
    truth: npt.NDArray[np.float32] | None = None
    kind: KindName = "reconstruction"

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the measurement."""
        return self.measurement.shape

    def settings(self) -> tuple[Setting, ...]:
        """As :func:`settings_for`."""
        return settings_for(self)

    def run(self, setting: Setting, *, limit_s: float | None, aside: Aside) -> Curve:
        """As :func:`run_setting`."""
        return run_setting(self, setting, limit_s=limit_s, aside=aside)

    def warm_up(self, setting: Setting) -> None:
        """Reconstruct a small scene of the same sort once."""
        family: Family = "beads" if self.volume else "sparse-picture"
        scene = make_scene(family, size=16, grid=3, **({"depths": 2} if self.volume else {}))
        small = ChartProblem(scene.measurement, scene.calibration, self.volume)
        run_setting(small, replace(setting, binning=1), counts=(1,))

    def fingerprint(self) -> str:
        """Digest measurement, calibration, erasures, noise and truth."""
        digest = hashlib.sha256()
        for array in (self.measurement, self.calibration.psfs, self.calibration.source_positions_um):
            digest.update(np.ascontiguousarray(array).data)
        for part in (self.erasures, self.truth):
            digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
        digest.update(f"{self.volume} {self.noise}".encode())
        return digest.hexdigest()[:16]


def settings_for(problem: ChartProblem) -> tuple[Setting, ...]:
    """Return every applicable setting, the quick ones first.

    Which are not applicable, and why: :func:`left_out`.
    """
    models: tuple[ModelName, ...] = ("convolution",)
    if _varies(problem):
        models = ("convolution", "lowrank", "local")
    found: list[Setting] = []
    for binning in _binnings(problem):
        if not problem.volume:
            found += [
                Setting(method, "convolution", prior, binning, precision=precision)
                for precision in PRECISIONS
                for method, priors in PICTURE_METHODS.items()
                for prior in priors
            ]
            if _has_gpu():
                found += [
                    Setting("admm-gpu", "convolution", prior, binning, precision=precision)
                    for precision in PRECISIONS
                    for prior in GPU_PRIORS
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
    if _binnings(problem) == [1]:
        small = problem.erasures is None
        found.append(
            f"binning: {'too few pixels would be left' if small else 'erased pixels cannot be averaged'}"
        )
    if not problem.volume and not _has_gpu():
        found.append("admm-gpu: there is no GPU that CuPy can use")
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


def _binnings(problem: ChartProblem) -> list[int]:
    """Return the binnings that leave enough pixels; erased ones cannot be averaged with others."""
    largest = max(problem.measurement.shape)
    return [1, *(b for b in (2, 4) if largest // b >= 24 and problem.erasures is None)]


def _cost(setting: Setting) -> float:
    """Rough order of time, and of how much there is to learn."""
    slow = {"convolution": 1.0, "lowrank": 20.0, "local": 30.0}[setting.model]
    methods = {"wiener": 0.01, "admm": 1.0, "fista": 1.5, "admm-sensor": 2.0, "admm-gpu": 2.0, "volume": 3.0}
    # What differs from the usual way by little comes after what differs by much.
    usual = setting.prior in ("tv", "l1") or setting.method == "wiener"
    rank = (1 if usual else 4) * (1 if setting.precision == "float32" else 8)
    return slow * methods[setting.method] / setting.binning**2 * rank


def run_setting(
    problem: ChartProblem,
    setting: Setting,
    *,
    limit_s: float | None = None,
    counts: Sequence[int] = COUNTS,
    seed: int = 0,
    aside: Aside = nothing_aside,
) -> Curve:
    """Reconstruct once and score on the way.

    Parameters
    ----------
    limit_s : float, optional
        Wall seconds after which the run stops.
    counts : sequence of int
        Iterations to score at, ascending.
    seed : int
        Of the pixels held out; the same for all settings that are compared.
    aside : Aside
        In which points are scored.

    Raises
    ------
    InputError
        When the setting does not apply to the problem.
    """
    require_applicable(problem, setting)
    judge = _Judge(problem, setting, seed)
    points: list[Point] = []

    def note(record: IterationRecord, now: Callable[[], Array]) -> None:
        if record.iteration not in counts:
            return
        with aside():
            points.append(judge.point(now(), record.iteration, record.seconds))

    common: dict[str, Any] = {
        "erasures": judge.erasures,
        "noise": judge.noise,
        "field": "full",
        "iterations": counts[-1],
        "time_s": limit_s,
        "judged": False,
    }
    if setting.method == "volume":
        volume = reconstruct_volume(
            judge.measurement,
            judge.calibration,
            prior=setting.prior,  # type: ignore[arg-type]
            model=setting.model,
            estimate_background=setting.background,
            tolerance=1e-7,
            callback=note,
            precision=setting.precision,
            **common,
        )
        return Curve(tuple(points), StopReason.TIME not in volume.stop_reasons)
    one_shot = setting.method == "wiener"
    if one_shot:
        common |= {"iterations": None, "time_s": None}
    result = reconstruct(
        judge.measurement,
        judge.central,
        method=setting.method,
        model="convolution",
        prior=setting.prior,
        tolerance=None if one_shot else 1e-7,
        callback=None if one_shot else note,
        precision=setting.precision,
        **common,
    )
    if one_shot:
        with aside():
            points = [judge.point(result.image, 0, result.seconds)]
    return Curve(tuple(points), result.stop_reason is not StopReason.TIME)


class _Judge:
    """Holds pixels out, and scores what was found from the rest."""

    def __init__(self, problem: ChartProblem, setting: Setting, seed: int) -> None:
        self.problem, self.setting = problem, setting
        factor = setting.binning
        shape = problem.measurement.shape
        kept = np.ones(shape, bool) if problem.erasures is None else ~problem.erasures
        # Blocks of the coarsest binning, on its grid, so that every setting predicts the same light.
        binnings = _binnings(problem)
        block = binnings[-1]
        self._together = block // factor
        spans = [_common_blocks(n, binnings) for n in shape]
        chosen = np.random.default_rng(seed).random([count for _, count in spans]) < HELD_SHARE
        held = np.zeros(shape, bool)
        held[tuple(slice(first, first + count * block) for first, count in spans)] = np.repeat(
            np.repeat(chosen, block, 0), block, 1
        )
        self.measurement = binned(problem.measurement, factor)
        self.calibration = reduced_calibration(problem.calibration, factor, None)
        self.held = binned((held & kept).astype(np.float32), factor) > 0.5
        self.kept = binned(kept.astype(np.float32), factor) > 1 - 1e-6
        self.erasures = self.held | ~self.kept
        data, valid, _ = data_of(problem.measurement, None, None if kept.all() else ~kept)
        pixel_noise = channel_noise(data[0], valid[0], problem.noise)
        self.noise = pixel_noise / factor
        self._block_noise = pixel_noise / block
        self._camera: ChannelProblem | None = None

    @property
    def central(self) -> Calibration:
        positions = self.calibration.source_positions_um
        nearest = int(np.argmin(np.nan_to_num(np.hypot(positions[:, 0], positions[:, 1]))))
        return replace(
            self.calibration,
            psfs=self.calibration.psfs[nearest : nearest + 1],
            source_positions_um=positions[nearest : nearest + 1],
        )

    def point(self, found: Array, iterations: int, seconds: float) -> Point:
        """Score a picture or volume of the full field."""
        planes = found[None] if found.ndim == 2 else found
        predicted = self._predict(planes)
        error = self.measurement - predicted
        used = error[~self.erasures] / self.noise
        scored = binned((self.held & self.kept).astype(np.float32), self._together) > 0.5
        held = binned(error, self._together)[scored] / self._block_noise
        point = Point(
            self.setting.name,
            iterations,
            seconds,
            float(np.sqrt(np.mean(used**2))),
            float(np.sqrt(np.mean(held**2))) if held.size else float("nan"),
            family=self.setting.family,
        )
        if self.problem.truth is None:
            return point
        seen = self._on_sensor(planes)
        shown = enlarged(seen, self.setting.binning, self.problem.measurement.shape)
        truth = self.problem.truth
        marks = score(shown if self.problem.volume else shown[0], truth, volume=self.problem.volume)
        return replace(point, psnr_db=marks.psnr_db, ssim=marks.ssim, nrmse=marks.nrmse)

    def _on_sensor(self, planes: Array) -> Array:
        height, width = self.measurement.shape
        (_, (row, column)) = field_of((height, width), self.calibration.psfs.shape[2:])
        top, left = row - height // 2, column - width // 2
        return planes[:, top : top + height, left : left + width]

    def _predict(self, planes: Array) -> Array:
        """Return the measurement that the setting's own model makes of what was found."""
        camera = self._problem()
        full = tuple(
            s + p - 1 for s, p in zip(self.measurement.shape, self.calibration.psfs.shape[2:], strict=True)
        )
        window = (slice(0, full[0]), slice(0, full[1]))
        placed = camera.start(planes, window)
        predicted: Array = camera.camera.forward(placed)[0]
        if self.setting.background:
            predicted = predicted + camera.background(placed)
        return predicted * np.float32(self.noise)

    def _problem(self) -> ChannelProblem:
        if self._camera is None:
            scaled = prepare_volume(
                self.measurement,
                self.central if self.setting.method != "volume" else self.calibration,
                None,
                self.erasures,
                self.noise,
            )
            self._camera = ChannelProblem(
                scaled,
                0,
                self.setting.model,
                smooth=self.setting.background,
                prior="nonnegative",
                weights=np.ones((len(scaled.depths.z_um), 3)),
            )
        return self._camera


def _common_blocks(n: int, binnings: Sequence[int]) -> tuple[int, int]:
    """First pixel and number of the coarsest binning's blocks that all binnings have when binned on."""
    block = binnings[-1]
    before, behind = n, n
    for factor in binnings:
        _, count = blocks(blocks(n, factor)[1], block // factor)
        before, behind = min(before, count // 2), min(behind, count - count // 2)
    return n // 2 - before * block, before + behind
