"""Time against quality of holograms: every expansion, loss, method and number of frames for one picture.

A run is scored at several counts of iterations on the way, with the time that the optimiser had spent by
then. The score is of what an eye would see (low-passed, on the alias-free grid, all frames together),
whatever was optimised; expansions do not compete with each other, for each shows another field of view.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from recon.arrays import Array
from recon.errors import InputError
from recon.evaluation.scored import Aside, Curve, Point
from recon.evaluation.trial import Subject
from recon.holography.display import Display, random_mask
from recon.holography.losses import LOSSES
from recon.holography.model import HologramModel
from recon.holography.optimise import HologramRecord, HologramStop, compute_hologram
from recon.holography.options import HologramOptions, Method
from recon.holography.scores import compare
from recon.holography.target import Target, foveal_weights

LIGHTS = (0.7, 0.4, 0.2, 0.1, 0.03, 0.01)
"""What a complex SLM is charted at."""

COUNTS = (1, 3, 5, 10, 20, 40, 80, 160)
"""Iterations at which a run is scored."""


@dataclass(frozen=True, slots=True)
class HologramSetting:
    """One way to compute a hologram."""

    expansion: int
    """Étendue expansion q."""
    method: Method = "lbfgs"
    """As :func:`recon.holography.compute_hologram`."""
    loss: str = "frequency"
    """Of :data:`recon.holography.losses.LOSSES`; the one-step method has none: ``"frequency"`` stands for
    that."""
    frames: int = 1
    """Shown one after the other."""
    light: float | None = None
    """Part of the light that a complex SLM sends into the field; None for a phase SLM."""

    @property
    def family(self) -> str:
        """Loss and method."""
        if self.method == "one-step":
            return "one-step"
        loss = LOSSES.named(self.loss).title
        if self.light is not None:
            return f"{loss}, complex SLM"
        return f"{loss}, Nesterov" if self.method == "nesterov" else loss

    @property
    def name(self) -> str:
        """Say it briefly."""
        frames = "" if self.frames == 1 else f", {self.frames} frames"
        light = "" if self.light is None else f", {self.light:.0%} of the light"
        return f"{self.expansion}x {self.family}{frames}{light}"

    @property
    def group(self) -> str:
        """Settings of one expansion and kind of SLM compete; a complex one's trade light for quality."""
        return f"{self.expansion}x" if self.light is None else f"{self.expansion}x, complex SLM"


@dataclass(frozen=True)
class HologramProblem(Subject[HologramSetting]):
    """A picture and the displays that shall show it."""

    kind = "hologram"

    displays: tuple[Display, ...]
    """One an expansion."""
    targets: tuple[tuple[Target, ...], ...]
    """For each display, one a plane."""
    frames: tuple[int, ...] = (1, 2, 3)
    weights: Array = field(default_factory=lambda: foveal_weights((256, 256)))
    """Of the losses that take them."""
    seed: int = 0
    """Of the random start."""

    def __post_init__(self) -> None:
        factors = [d.expansion for d in self.displays]
        if len(set(factors)) != len(factors) or len(self.targets) != len(factors) or not factors:
            raise InputError("A chart of holograms needs displays of different expansions, with targets.")

    @property
    def pixels(self) -> tuple[int, ...]:
        """Of the SLM."""
        return self.displays[0].slm_shape

    def settings(self) -> tuple[HologramSetting, ...]:
        """Return every setting, the quick ones first."""
        found: list[HologramSetting] = []
        for display in self.displays:
            q = display.expansion
            for frames in self.frames:
                found.append(HologramSetting(q, "one-step", "frequency", frames))
                found += [HologramSetting(q, "lbfgs", loss, frames) for loss in LOSSES]
            found += [HologramSetting(q, "nesterov", loss) for loss in LOSSES]
            found += [HologramSetting(q, light=light) for light in LIGHTS]
        return tuple(sorted(found, key=_cost))

    def _curve(
        self, setting: HologramSetting, limit_s: float | None, aside: Aside, *, counts: Sequence[int] = COUNTS
    ) -> Curve:
        """Compute one hologram and score it on the way."""
        place = [d.expansion for d in self.displays].index(setting.expansion)
        display, targets = self.displays[place], self.targets[place]
        options = HologramOptions(
            loss=setting.loss,
            weights=self.weights if LOSSES.named(setting.loss).takes_weights else None,
            frames=setting.frames,
            method=setting.method,
            iterations=counts[-1],
            time_s=limit_s,
            tolerance=0.0,
            seed=self.seed,
            complex_slm=setting.light is not None,
            light=setting.light,
        )
        model = HologramModel(display, targets, options)
        points: list[Point] = []
        # The optimiser's clock starts after its first evaluation; here all of its time counts.
        first_s = 0.0
        if setting.method != "one-step":
            slm = np.ones((setting.frames, *display.slm_shape), model.dtype)
            began = time.perf_counter()
            model.evaluate(slm)
            first_s = time.perf_counter() - began

        def score(record: HologramRecord, slm: Array) -> None:
            with aside():
                points.append(_point(setting, model, replace(record, seconds=first_s + record.seconds), slm))

        def note(record: HologramRecord, slm: Array) -> None:
            if record.iteration in counts:
                score(record, slm)

        found = compute_hologram(model, callback=note)
        last = found.history[-1]
        stuck = found.stop_reason is HologramStop.CONVERGED and last.iteration not in counts
        if found.stop_reason is HologramStop.ONE_STEP or stuck:
            score(last, found.slm)
        return Curve(tuple(points), found.stop_reason is not HologramStop.TIME)

    def warm_up(self, setting: HologramSetting) -> None:
        """Compute a small hologram in two iterations."""
        k = round(setting.expansion**0.5)
        display = Display((16, 16), random_mask((16 * k, 16 * k)))
        image = np.random.default_rng(0).random((64, 64))
        HologramProblem((display,), ((Target(image),),), self.frames).run(setting, counts=(2,))

    def _identity(self) -> Iterator[str | Array]:
        yield f"{self.frames} {self.seed}"
        for display, targets in zip(self.displays, self.targets, strict=True):
            fixed = (display.slm_pitch_um, display.wavelength_nm, display.focal_mm, display.mask_fill)
            yield f"{display.slm_shape} {fixed} {display.dc}"
            yield from (display.mask.response(display.wavelength_nm), display.mask.levels)
            if display.displacement is not None:
                yield display.displacement
            for target in targets:
                yield from (f"{target.z_mm} {target.white}", target.image)
        yield self.weights


def _cost(setting: HologramSetting) -> float:
    """Rough order of time."""
    method = {"one-step": 0.01, "lbfgs": 1.0, "nesterov": 1.2}[setting.method]
    return method * LOSSES.named(setting.loss).cost * setting.frames * setting.expansion


def _point(setting: HologramSetting, model: HologramModel, record: HologramRecord, slm: Array) -> Point:
    """Score what is seen, the mean of all planes."""
    scores = [
        compare(
            np.asarray(model.seen(slm, p), float) / model.peaks[p],
            np.asarray(model.wanted(p), float) / model.peaks[p],
            1.0,
        )
        for p in range(len(model.targets))
    ]
    names = ("psnr_db", "ssim", "crop_psnr_db", "crop_ssim")
    psnr_db, ssim, middle_psnr_db, middle_ssim = (
        float(np.mean([getattr(s, name) for s in scores])) for name in names
    )
    return Point(
        setting.name,
        record.iteration,
        record.seconds,
        family=setting.family,
        group=setting.group,
        psnr_db=psnr_db,
        ssim=ssim,
        middle_psnr_db=middle_psnr_db,
        middle_ssim=middle_ssim,
    )
