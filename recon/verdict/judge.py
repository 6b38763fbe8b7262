"""Verdicts on reconstructions: the rules by which evidence is judged, and what is said.

A verdict looks up the most similar cases (:mod:`recon.verdict.cases`), where the truth was known, and asks
how many of them failed. Which stress limits is asked the same way: were this one number as good as a good
case's, how many would fail?
"""

from __future__ import annotations

import enum
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.verdict.calibration_check import CalibrationCheck, Fit
from recon.verdict.cases import OF_VOLUMES, Cases, cases_of, group_of, place_of
from recon.verdict.evidence import DIVERGED, Evidence

Floats = npt.NDArray[np.float64]


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
    Region.UNKNOWN: "not judged: the stability maps hold no case of {method} that is much like this one",
}

UNFINISHED = 10.0
"""``unsettled`` from which no similar case is asked any more: the picture had hardly begun to settle."""
FIRST_ITERATIONS = "not reliable: the iterations were ended when the picture had hardly begun to settle"
STILL_CHANGING = "doubtful: the iterations were ended while the picture still changed; similar ones are good"
NOISELESS = 1e3
"""``signal`` from which the data are no photograph's: a full well of 100,000 electrons gives some 300."""
COMPUTED = (
    "not judged: the measurement has next to no noise, as computed images have, and verdicts are made from "
    "photographs"
)
LOST = 0.5
"""Share of failures among similar cases from which a reconstruction is outside."""
MOST = 2
"""Stresses that are named."""
NEIGHBOURS = 16
"""Cases that are asked. With twelve, 1 of 150 that were called reliable had failed, with sixteen none of 134,
and with a tenth of failures allowed 2 of 165 (the mixed scenes, each judged by the cases of the others)."""
NEIGHBOURS_OF_VOLUMES = 12
"""There are fewer cases of volumes: sixteen reach too far."""
FAR = 2.0
FAR_OF_VOLUMES = 3.0
"""Distance beyond which the third nearest case is no witness: a factor of about seven in one number. Volumes
are compared by more numbers. One case in twenty of those known is as far from the others."""
UNSETTLED = 0.2
"""``unsettled`` from which a reconstruction is not inside: its last change was twice the tolerance."""
CLIPPED = 0.02
"""Share of the used pixels at full scale from which that is named first."""
OF_LIGHT = ("detail", "signal", "height")
"""Stresses that more light relieves, and hardly anything else."""
WITHOUT_LIGHT: Mapping[str, str] = {
    "peaks": "A stronger prior (--tau) would help; a scene of so many points is too dense",
}
"""What else helps where more light would relieve as well, by stress."""
FEWEST = 40
"""Cases that a group needs to be judged by."""

STRESSES: Mapping[str, tuple[int, str, str]] = {
    "detail": (
        1,
        "Little light: the picture's details stand {value:.2g} times above the noise",
        "More light would help (exposure, brighter scene, several frames averaged), or larger pixels (--bin)",
    ),
    "signal": (
        1,
        "Little contrast: the measurement varies by {value:.2g} times its noise",
        "More light would help, or less background light",
    ),
    "unexplained": (
        -1,
        "{value:.0%} of the measurement's contrast is not explained by the model beyond noise",
        "Check that depth and colour are those of the calibration, that nothing moved since (diffuserbench "
        "compare), and that background is subtracted; more PSFs over the field may help (--model local)",
    ),
    "load": (
        -1,
        "{value:.2g} unknowns for each measured pixel",
        "A sparser scene, fewer depths, more pixels, or a prior that fits the scene better would help",
    ),
    "similarity": (
        -1,
        "PSFs of neighbouring depths are {value:.0%} alike",
        "Fewer depths would help, or a longer range of depths",
    ),
    "dimming": (
        1,
        "The farthest points are {value:.0%} as bright on the sensor as the nearest",
        "A shorter range of depths would help, or one reconstruction for the far part by itself",
    ),
    "erased": (
        -1,
        "{value:.0%} of the pixels are not used",
        "Use more pixels: expose shorter if they are saturated",
    ),
    "saturated": (
        -1,
        "{value:.0%} of the pixels used are at full scale",
        "Leave them out (--erasures saturated), or better, expose shorter",
    ),
    "ambiguity": (
        -1,
        "The PSF repeats itself: moved by some pixels it is {value:.0%} alike",
        "A diffuser with elements at random places would help",
    ),
    "height": (
        1,
        "The points found stand {value:.2g} times above the noise",
        "More light would help (exposure, brighter scene, several frames averaged)",
    ),
    "peaks": (
        -1,
        "The result is grainy: {value:.2g} bright points for each thousand pixels",
        "More light or a stronger prior (--tau) would help; a scene of so many points is too dense",
    ),
    "ends": (
        -1,
        "The outermost depths hold {value:.2g} times their share of the light",
        "Calibrating beyond the scene on both sides, or subtracting the background, would help: light that "
        "fits nowhere gathers there",
    ),
    "unsettled": (
        -1,
        "The iterations were ended while the picture still changed",
        "More iterations or more time would help",
    ),
}
"""By evidence: whether more of it is better, what is said, what would help."""


def reliable_share(method: str) -> float:
    """Return the share of failures among similar cases up to which a reconstruction is inside.

    Failures of volumes lie among the good ones, most of them little worse than trivial: with 5 % few volumes
    would ever be inside, and with total variation no more of those that 10 % lets in fail. With l1 they do.
    """
    return 0.1 if group_of(method) == "volume tv" else 0.05


@dataclass(frozen=True, slots=True)
class Finding:
    """One stress that makes a reconstruction less reliable."""

    stress: str
    """Name of the evidence, see :class:`~recon.verdict.evidence.Evidence`."""
    value: float
    """What was measured."""
    gain: float
    """By how much the share of failing cases would fall, were this one as in a good case; where no case is
    much like it, by how much nearer the nearest would be."""
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
    """Share of the most similar cases of the maps that failed; None where there are none."""
    findings: tuple[Finding, ...]
    """What limits, the most limiting first."""
    evidence: Mapping[str, float] = field(default_factory=dict)
    """What was measured, see :class:`~recon.verdict.evidence.Evidence`."""
    basis: str = ""
    """By which cases it was judged."""
    calibration: CalibrationCheck | None = None
    """Whether the calibration is the photograph's own; None where that was not looked at."""

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in plain words: what, which stress limits it, what would help."""
        if self.calibration is not None and self.calibration.wrong:  # whatever else: that is why
            first, *rest = self.calibration.sentences
            return tuple(f"{s}." for s in (f"not reliable: {first}", *rest))
        said = [WORDS[self.region].format(method=self.method)]
        unfinished = self.evidence.get("unsettled", 0.0) >= UNFINISHED
        if unfinished and self.failing is not None and self.failing < LOST:
            said = [FIRST_ITERATIONS]  # that is why; the share of similar cases would contradict it
        elif self._alike_are_good and self.calibration is not None and self.calibration.fit is Fit.UNTOLD:
            said = [f"doubtful: {s}" for s in self.calibration.sentences]
        elif self._alike_are_good:
            said = [STILL_CHANGING]
        elif self.region is Region.UNKNOWN and self.evidence.get("signal", 0.0) >= NOISELESS:
            said = [COMPUTED]
        elif self.region is Region.UNKNOWN and not self.basis:
            said = [f"not judged: there are no known cases of {self.method}"]
        elif self.failing is not None and self.region is not Region.UNKNOWN:
            said[0] += f" (of the most similar simulated cases {self.failing:.0%} failed)"
        if self.region in (Region.NEAR, Region.OUTSIDE):
            said += [f"{f.words}. {f.help}" for f in self.findings[:MOST]]
        elif self.region is Region.UNKNOWN and said[0] != COMPUTED:
            said += [f"What sets it apart: {f.words}. {f.help}" for f in self.findings[:1]]
        return tuple(f"{s}." for s in said)

    @property
    def _alike_are_good(self) -> bool:
        """Whether something else than similar cases keeps it from being inside."""
        if self.region is not Region.NEAR or self.failing is None:
            return False
        return self.failing <= reliable_share(self.method)

    def with_calibration(self, check: CalibrationCheck) -> Verdict:
        """Return the verdict with what is known of the calibration: with a wrong one it is never inside."""
        region = self.region
        if check.wrong:
            region = Region.OUTSIDE
        elif check.fit is Fit.UNTOLD and region is Region.INSIDE:
            region = Region.NEAR
        return replace(self, region=region, calibration=check)

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
            "calibration": None if self.calibration is None else self.calibration.as_json(),
        }


def method_name(solver: str, prior: str, *, volume: bool = False) -> str:
    """Return the name that a solver with a prior has on the maps, of pictures or of volumes."""
    if solver == "wiener":
        return "wiener"
    return f"{solver} {'tv' if prior.startswith('tv') else prior}{OF_VOLUMES if volume else ''}"


def verdict_on(evidence: Evidence, method: str, cases: Cases | None = None) -> Verdict:
    """Judge a reconstruction by its evidence and cases; default are those of its method that are shipped."""
    numbers = evidence.as_json()
    group = group_of(method)
    if cases is None and group is not None:
        cases = cases_of(group)
    if cases is None or len(cases.severities) < FEWEST:
        return Verdict(Region.UNKNOWN, method, None, (), numbers)
    place = _no_better_than_any(cases, place_of(numbers, cases.weights))
    of_volumes = str(group).startswith("volume")
    count, far = (NEIGHBOURS_OF_VOLUMES, FAR_OF_VOLUMES) if of_volumes else (NEIGHBOURS, FAR)
    share, nearest = failing_share(cases, place, count)
    reliable = share <= reliable_share(method)
    if numbers["unsettled"] >= UNFINISHED or not np.isfinite(place).all():
        region = Region.OUTSIDE
    elif numbers["signal"] >= NOISELESS:  # before similar cases are asked: numbers in its noise mean nothing
        region = Region.UNKNOWN
    elif share >= LOST:
        region = Region.OUTSIDE
    elif nearest > far:
        region = Region.UNKNOWN
    else:
        settled = numbers["unsettled"] < UNSETTLED
        region = Region.INSIDE if reliable and settled else Region.NEAR
    sources = [f"maps {', '.join(cases.maps)}"] if cases.maps else []
    sources += [f"{cases.n_scenes} mixed scenes"] if cases.n_scenes else []
    basis = f"{count} nearest of {len(cases.severities)} simulated cases ({'; '.join(sources)})"

    def gain(relieved: Floats) -> float:
        other, third = failing_share(cases, relieved, count)
        # Those stresses first without which cases would be nearest, or the share of failures lowest.
        return nearest - third if region is Region.UNKNOWN else share - other

    findings = _clipped_first(_relieved(cases, place, numbers, gain), numbers)
    findings = _unfinished_first(findings, numbers, reliable)
    return Verdict(region, method, share, findings, numbers, basis)


def _no_better_than_any(cases: Cases, place: Floats) -> Floats:
    """Return a place moved to the best case's where it is better: more light than the most is as good."""
    moved = place.copy()
    for index, name in enumerate(cases.weights):
        if name in STRESSES:
            column = cases.places[:, index]
            better = STRESSES[name][0]
            moved[index] = min(moved[index], column.max()) if better > 0 else max(moved[index], column.min())
    return moved


def failing_share(cases: Cases, place: Floats, count: int) -> tuple[float, float]:
    """Return the share of failures among the ``count`` nearest cases, and the distance of the third nearest.

    Nearer cases count more.
    """
    distance = np.linalg.norm(cases.places - place, axis=1)
    order = np.argsort(distance)[:count]
    weight = 1 / (0.2 + distance[order])
    failed = cases.severities[order] >= 1
    return float(np.sum(weight * failed) / np.sum(weight)), float(distance[order[2]])


def _relieved(
    cases: Cases, place: Floats, numbers: Mapping[str, float], gain_of: Callable[[Floats], float]
) -> tuple[Finding, ...]:
    """Return the stresses that are worse than in good cases, by what is gained where one is as in those."""
    if cases.typical is None:
        return ()
    findings = []
    for index, name in enumerate(cases.weights):
        if name not in STRESSES:
            continue
        better, words, help_ = STRESSES[name]
        typical = float(cases.typical[index])
        if (place[index] - typical) * better >= 0:
            continue  # as good as in a good case already
        relieved = place.copy()
        relieved[index] = typical
        gain = gain_of(relieved)
        if gain > 0:
            findings.append(Finding(name, numbers[name], gain, words.format(value=numbers[name]), help_))
    return tuple(sorted(findings, key=lambda f: -f.gain))


def _named(stress: str, findings: tuple[Finding, ...], numbers: Mapping[str, float]) -> Finding:
    """Return the finding of a stress; one that is not among the findings gains nothing."""
    _, words, help_ = STRESSES[stress]
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


def _unfinished_first(
    findings: tuple[Finding, ...], numbers: Mapping[str, float], reliable: bool
) -> tuple[Finding, ...]:
    """Return the findings, first that a limit ended the run too early where that alone decides.

    A picture that had hardly begun to settle is outside, whatever similar cases say; and what else was
    measured of it, first of all what the model leaves unexplained, may well come of it. One that was still
    changing is not inside, even where similar cases did not fail.
    """
    still_changing = numbers["unsettled"] >= UNSETTLED and reliable
    if numbers["unsettled"] < UNFINISHED and not still_changing:
        return findings
    first = _named("unsettled", findings, numbers)
    if numbers["unsettled"] >= DIVERGED:
        first = replace(first, help=f"{first.help}, or another method if they make it worse")
    return (first, *(f for f in findings if f.stress != "unsettled"))
