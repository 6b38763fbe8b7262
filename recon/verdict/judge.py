"""Verdicts on reconstructions: the rules by which evidence is judged, and what is said.

A verdict asks for the chance that such a reconstruction has failed, as learned where the truth was known
(:mod:`recon.verdict.chance`). Which stress limits is asked the same way: were this one number as good as a
good case's, what would the chance be? Limits that no case overrules: what the model leaves unexplained, and
iterations that had not settled.
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from recon.arrays import Float64Array
from recon.verdict.calibration_check import CalibrationCheck, Fit
from recon.verdict.cases import OF_VOLUMES, group_of
from recon.verdict.chance import BETTER, Chances, place_of, shipped_chances, value_of
from recon.verdict.evidence import DIVERGED, Evidence


class Region(enum.StrEnum):
    """Where a reconstruction lies."""

    INSIDE = "inside"
    NEAR = "near"
    OUTSIDE = "outside"
    UNKNOWN = "unknown"


WORDS: Mapping[Region, str] = {
    Region.INSIDE: "reliable: inside the region where {method} works",
    Region.NEAR: "doubtful: near the boundary where {method} fails",
    Region.OUTSIDE: "not reliable: outside the region where {method} works",
    Region.UNKNOWN: "not judged: this measurement is unlike every known case of {method}",
}

UNFINISHED = 10.0
"""``unsettled`` from which no similar case is asked any more: the picture had hardly begun to settle."""
FIRST_ITERATIONS = "not reliable: the iterations were ended when the picture had hardly begun to settle"
STILL_CHANGING = "doubtful: the iterations were ended while the picture still changed; similar ones are good"
UNEXPLAINED = "doubtful: the model leaves {residual} unexplained, whatever similar cases say"
CUT_PSF = (
    "doubtful: the PSF seems to go on beyond the sensor's edges, and what was found lies so far from the "
    "middle that up to {share:.0%} of its light comes from there, which the PSF does not hold. If the files "
    "were cropped, give them whole; else a smaller scene in the middle would help, or a smaller pattern (a "
    "farther scene, a diffuser nearer to the sensor)"
)
BELOW_ZERO = (
    "doubtful: the smooth background came out below zero, at {share:.0%} of the light, which no light is. "
    "The PSF may stand on light of the room, and the picture has as much more: take the PSF in the dark and "
    "with its dark frame"
)
NO_CASES = "not judged: there are no known cases of {method}"
NOISELESS = 1e3
"""``signal`` from which the data are no photograph's: a full well of 100,000 electrons gives some 300."""
COMPUTED = (
    "not judged: the measurement has next to no noise, as computed images have, and verdicts are made from "
    "photographs"
)
LOST = 0.5
"""Chance of failing from which a reconstruction is outside."""
MOST = 2
"""Stresses that are named."""
MOST_RESIDUAL = 5.0
MOST_UNEXPLAINED = 0.15
"""Residual in units of the noise, and ``unexplained``, from which nothing is called reliable."""
NAMED = 0.1
"""Share of the chance of failing that has to go with a stress for it to be named: more light that changes
next to nothing is not asked for."""
MOST_LIGHT = 10.0
"""By how much more light is supposed to lift what it relieves, at most: a hundred times the light."""
ABOVE_NOISE = 2.0
"""Residual in units of the noise from which noise is not what limits."""
UNSETTLED = 0.7
"""``unsettled`` from which a reconstruction is not inside: its last change was seven times the tolerance, of
which ten times are a failure."""
CLIPPED = 0.02
"""Share of the used pixels at full scale from which that is named first."""
OF_LIGHT = ("detail", "signal", "height")
"""Stresses that more light relieves, and hardly anything else."""
WITHOUT_LIGHT: Mapping[str, str] = {
    "peaks": "A stronger prior (--tau) would help; a scene of so many points is too dense",
}
"""What else helps where more light would relieve as well, by stress."""
STRESSES: Mapping[str, tuple[str, str]] = {
    "detail": (
        "Little light: the picture's details stand {value:.2g} times above the noise",
        "More light would help (exposure, brighter scene, several frames averaged), or larger pixels (--bin)",
    ),
    "signal": (
        "Little contrast: the measurement varies by {value:.2g} times its noise",
        "More light would help, or less background light",
    ),
    "unexplained": (
        "{value:.0%} of the measurement's contrast is not explained by the model beyond noise",
        "Check that depth and colour are those of the calibration, that nothing moved since (diffuserbench "
        "compare), and that background is subtracted; more PSFs over the field may help (--model local)",
    ),
    "load": (
        "{value:.2g} unknowns for each measured pixel",
        "A sparser scene, fewer depths, more pixels, or a prior that fits the scene better would help",
    ),
    "similarity": (
        "PSFs of neighbouring depths are {value:.0%} alike",
        "Fewer depths would help, or a longer range of depths",
    ),
    "dimming": (
        "The farthest points are {value:.0%} as bright on the sensor as the nearest",
        "A shorter range of depths would help, or one reconstruction for the far part by itself",
    ),
    "erased": (
        "{value:.0%} of the pixels are not used",
        "Use more pixels: expose shorter if they are saturated",
    ),
    "saturated": (
        "{value:.0%} of the pixels used are at full scale",
        "Leave them out (--erasures saturated), or better, expose shorter",
    ),
    "ambiguity": (
        "The PSF repeats itself: moved by some pixels it is {value:.0%} alike",
        "A diffuser with elements at random places would help",
    ),
    "height": (
        "The points found stand {value:.2g} times above the noise",
        "More light would help (exposure, brighter scene, several frames averaged)",
    ),
    "peaks": (
        "The result is grainy: {value:.2g} bright points for each thousand pixels",
        "More light or a stronger prior (--tau) would help; a scene of so many points is too dense",
    ),
    "ends": (
        "The outermost depths hold {value:.2g} times their share of the light",
        "Calibrating beyond the scene on both sides, or subtracting the background, would help: light that "
        "fits nowhere gathers there",
    ),
    "unsettled": (
        "The iterations were ended while the picture still changed",
        "More iterations or more time would help",
    ),
}
"""By evidence: what is said, what would help."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One stress that makes a reconstruction less reliable."""

    stress: str
    """Name of the evidence, see :class:`~recon.verdict.evidence.Evidence`."""
    value: float
    """What was measured."""
    gain: float
    """By how much the chance of failing would fall, were this one as in a good case; where no case is like
    it, by how much nearer it would be to them."""
    words: str
    help: str
    """``words`` and ``help``: what it is, and what would help."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether to trust a reconstruction."""

    region: Region
    method: str
    """The maps' name of the method."""
    failing: float | None
    """The chance that it has failed, by cases with a truth; None where there are none."""
    findings: tuple[Finding, ...]
    """What limits, the most limiting first."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What was measured, see :class:`~recon.verdict.evidence.Evidence`."""
    basis: str = ""
    """By which cases it was judged."""
    decided: str = ""
    """What decided instead of those cases, in words."""
    held_out: float | None = None
    """Where nothing else is known: by how much pixels that a shorter run did not see are missed, in units of
    their noise."""
    calibration: CalibrationCheck | None = None
    """Whether the calibration is the photograph's own; None where that was not looked at."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in plain words: what, which stress limits it, what would help."""
        if self.calibration is not None and self.calibration.wrong:  # whatever else: that is why
            first, *rest = self.calibration.sentences
            return tuple(f"{s}." for s in (f"not reliable: {first}", *rest))
        said = [self.decided or WORDS[self.region].format(method=self.method)]
        if self.failing is not None and self.region is not Region.UNKNOWN and not self.decided:
            said[0] += f" (chance of failing {self.failing:.0%}, by simulated cases)"
        if self.region in (Region.NEAR, Region.OUTSIDE):
            said += [f"{f.words}. {f.help}" for f in self.findings[:MOST]]
        elif self.region is Region.UNKNOWN and self.basis and not self.decided:
            said += [f"What sets it apart: {f.words}. {f.help}" for f in self.findings[:1]]
        if unlike_any(self):
            said += [left_unexplained(self.evidence, self.held_out)]
        return tuple(f"{s}." for s in said)

    def with_calibration(self, check: CalibrationCheck) -> Verdict:
        """Return the verdict with what is known of the calibration: with a wrong one it is never inside."""
        if check.wrong:
            return replace(self, region=Region.OUTSIDE, calibration=check)
        if check.fit is Fit.UNTOLD and self.region is Region.INSIDE:
            decided = f"doubtful: {'. '.join(check.sentences)}"
            return replace(self, region=Region.NEAR, calibration=check, decided=decided)
        return replace(self, calibration=check)

    def with_cut_psf(self, share: float) -> Verdict:
        """Return the verdict with the share of the light that the PSF lacks, at most: it is not inside."""
        if self.region is not Region.INSIDE:
            return self
        return replace(self, region=Region.NEAR, findings=(), decided=CUT_PSF.format(share=share))

    def with_background_below_zero(self, share: float) -> Verdict:
        """Return the verdict with a background's share of the light, below zero: it is not inside."""
        if self.region is not Region.INSIDE:
            return self
        return replace(self, region=Region.NEAR, findings=(), decided=BELOW_ZERO.format(share=share))

    def as_json(self) -> dict[str, Any]:
        """Return the verdict for a file."""
        return {
            "region": str(self.region),
            "method": self.method,
            "failing": self.failing,
            "sentences": list(self.sentences),
            "findings": [asdict(f) for f in self.findings],
            "evidence": dict(self.evidence),
            "basis": self.basis,
            "held_out": self.held_out,
            "calibration": None if self.calibration is None else self.calibration.as_json(),
        }


def method_name(solver: str, prior: str, *, volume: bool = False) -> str:
    """Return the name that a solver with a prior has on the maps, of pictures or of volumes."""
    if solver == "wiener":
        return "wiener"
    return f"{solver} {'tv' if prior.startswith('tv') else prior}{OF_VOLUMES if volume else ''}"


def verdict_on(evidence: Evidence, method: str, chances: Chances | None = None) -> Verdict:
    """Judge a reconstruction by its evidence and what is known of its method; default is what is shipped."""
    numbers = evidence.as_json()
    chances = chances or shipped_chances().get(group_of(method) or "")
    if chances is None:
        return Verdict(Region.UNKNOWN, method, None, (), numbers, decided=NO_CASES.format(method=method))
    place = _place(chances, numbers)
    chance, distance = float(chances.chance(place)), chances.distance(place)
    region, decided = _region(numbers, chance, chances, far=not distance <= chances.far)

    blamed = float(chances.blame(place))

    def gain(relieved: Mapping[str, float]) -> float:
        # Those stresses first without which it would be nearest to the cases, or the chance lowest.
        lifted = _place(chances, relieved)
        if region is Region.UNKNOWN:
            return distance - chances.distance(lifted)
        return blamed - float(chances.blame(lifted))

    least = 0.0 if region is Region.UNKNOWN else NAMED * blamed
    findings = tuple(f for f in _relieved(chances, numbers, gain) if f.gain > least)
    findings = _clipped_first(findings, numbers)
    if decided in (STILL_CHANGING, FIRST_ITERATIONS) or numbers["unsettled"] >= UNFINISHED:
        findings = _unfinished_first(findings, numbers)
    elif decided and region is Region.NEAR:
        first = _named("unexplained", findings, numbers)
        findings = (first, *(f for f in findings if f.stress != "unexplained"))
    basis = f"a regression on {chances.n_cases} simulated cases of {chances.n_scenes} scenes"
    return Verdict(region, method, chance, findings, numbers, basis, decided)


def _place(chances: Chances, numbers: Mapping[str, float]) -> Float64Array:
    """Return where numbers lie among the cases."""
    return chances.no_better_than_any(place_of(numbers, chances.features))


def _region(
    numbers: Mapping[str, float], chance: float, chances: Chances, *, far: bool
) -> tuple[Region, str]:
    """Return where a reconstruction lies, and what decided that where similar cases did not."""
    if numbers["unsettled"] >= UNFINISHED:
        # That is why; a low chance would contradict it.
        return Region.OUTSIDE, FIRST_ITERATIONS if chance < LOST else ""
    if not np.isfinite([*numbers.values()]).all():
        return Region.OUTSIDE, ""
    if numbers["signal"] >= NOISELESS:  # before cases are asked: numbers in its noise mean nothing
        return Region.UNKNOWN, COMPUTED
    if far:
        return Region.UNKNOWN, ""
    if chance > chances.reliable:
        return Region.OUTSIDE if chance >= LOST else Region.NEAR, ""
    decided = withheld(numbers)
    return (Region.NEAR if decided else Region.INSIDE), decided


def withheld(numbers: Mapping[str, float]) -> str:
    """Say why a reconstruction is not called reliable, whatever similar cases are; "" where nothing is."""
    if numbers["unsettled"] >= UNSETTLED:
        return STILL_CHANGING
    if numbers["unexplained"] >= MOST_UNEXPLAINED or residual_of(numbers) >= MOST_RESIDUAL:
        return UNEXPLAINED.format(residual=_residual(numbers))
    return ""


def unlike_any(verdict: Verdict) -> bool:
    """Tell whether a photograph's verdict is that no known case is like it."""
    return verdict.region is Region.UNKNOWN and verdict.decided != COMPUTED


def left_unexplained(numbers: Mapping[str, float], held_out: float | None) -> str:
    """Say how far the data are explained, where no known case tells what that is worth."""
    said = f"The model leaves {_residual(numbers)} unexplained"
    if held_out is None:
        return said
    return f"{said}; pixels that a shorter run did not see are missed by {held_out:.1f} times the noise"


def residual_of(numbers: Mapping[str, float]) -> float:
    """Return what is left of the data, in units of their noise."""
    return float((1 + (numbers["signal"] * numbers["unexplained"]) ** 2) ** 0.5)


def _residual(numbers: Mapping[str, float]) -> str:
    share = numbers["unexplained"]
    return f"{residual_of(numbers):.1f} times the noise, {share:.1%} of the measurement's contrast,"


def _relieved(
    chances: Chances, numbers: Mapping[str, float], gain_of: Callable[[Mapping[str, float]], float]
) -> tuple[Finding, ...]:
    """Return the stresses that are worse than in good cases, by what is gained where one is as in those.

    More light relieves all that it relieves at once, and the one that lacks most is named for it; what is not
    explained stays the same share, and so stands out of the noise: where it does already, none is asked for.
    """
    place = place_of(numbers, chances.features)
    lacking = {
        name: float(typical - here) * BETTER[name]
        for name, typical, here in zip(chances.features, chances.typical, place, strict=True)
        if name in STRESSES
    }
    lit = {name: numbers[name] for name in OF_LIGHT if name in lacking}
    dimmest = None if residual_of(numbers) >= ABOVE_NOISE else max(lit, key=lambda name: lacking[name])
    brighter = 1.0 if dimmest is None else min(float(np.exp(max(lacking[dimmest], 0.0))), MOST_LIGHT)
    findings = []
    for name, lack in lacking.items():
        if lack <= 0 or (name in lit and name != dimmest):
            continue  # as good as in a good case already
        as_good = (
            {k: v * brighter for k, v in lit.items()}
            if name == dimmest
            else {name: value_of(name, float(chances.typical[chances.features.index(name)]))}
        )
        findings.append(replace(_named(name, (), numbers), gain=gain_of({**numbers, **as_good})))
    return tuple(sorted(findings, key=lambda f: -f.gain))


def _named(stress: str, findings: tuple[Finding, ...], numbers: Mapping[str, float]) -> Finding:
    """Return the finding of a stress; one that is not among the findings gains nothing."""
    words, help_ = STRESSES[stress]
    gain = next((f.gain for f in findings if f.stress == stress), 0.0)
    return Finding(stress, numbers[stress], gain, words.format(value=numbers[stress]), help_)


def _clipped_first(findings: tuple[Finding, ...], numbers: Mapping[str, float]) -> tuple[Finding, ...]:
    """Return the findings, first that pixels are at full scale where many are, and none that asks for light.

    Similar cases hardly fail of it alone, but more light would make it worse, and it is what can be mended.
    """
    if numbers["saturated"] < CLIPPED:
        return findings
    first = _named("saturated", findings, numbers)
    others = (f for f in findings if f.stress not in ("saturated", *OF_LIGHT))
    return (first, *(replace(f, help=WITHOUT_LIGHT.get(f.stress, f.help)) for f in others))


def _unfinished_first(findings: tuple[Finding, ...], numbers: Mapping[str, float]) -> tuple[Finding, ...]:
    """Return the findings, first that a limit ended the run too early where that alone decides.

    What else was measured of it, first of all what the model leaves unexplained, may well come of it.
    """
    first = _named("unsettled", findings, numbers)
    if numbers["unsettled"] >= DIVERGED:
        first = replace(first, help=f"{first.help}, or another method if they make it worse")
    return (first, *(f for f in findings if f.stress != "unsettled"))
