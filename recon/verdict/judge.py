"""From evidence to a verdict: what happened to data like these where the truth was known.

The verdict looks up the most similar cases (:mod:`recon.verdict.cases`) and asks how many of them failed.
Which stress limits is asked the same way: were this one number as good as a good case's, how many would fail?
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from recon.verdict.cases import Cases, cases_of, group_of, place_of
from recon.verdict.collect import DIVERGED
from recon.verdict.evidence import Evidence
from recon.verdict.verdict import LOST, NOISELESS, UNFINISHED, Finding, Region, Verdict, reliable_share

Floats = npt.NDArray[np.float64]

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


def method_name(method: str, prior: str) -> str:
    """Return the name that a method with a prior has on the maps."""
    if method == "wiener":
        return "wiener"
    kind = "tv" if prior.startswith("tv") else prior
    solver = "admm" if method == "admm-gpu" else method
    return f"{solver} {kind}"


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
    mixed = len(set(cases.scenes.tolist()) - {-1})
    sources = [f"maps {', '.join(cases.maps)}"] if cases.maps else []
    sources += [f"{mixed} mixed scenes"] if mixed else []
    basis = f"{count} nearest of {len(cases.severities)} simulated cases ({'; '.join(sources)})"
    if region is Region.UNKNOWN:
        findings = _setting_apart(cases, place, numbers)
    else:
        findings = _findings(cases, place, numbers, share, count)
    findings = _unfinished_first(_clipped_first(findings, numbers), numbers, reliable)
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


def _findings(
    cases: Cases, place: Floats, numbers: Mapping[str, float], share: float, count: int
) -> tuple[Finding, ...]:
    """Return the stresses, those first whose removal would lower the share of failures most."""

    def gain(relieved: Floats) -> float:
        return share - failing_share(cases, relieved, count)[0]

    return _relieved(cases, place, numbers, gain)


def _setting_apart(cases: Cases, place: Floats, numbers: Mapping[str, float]) -> tuple[Finding, ...]:
    """Return the stresses, those first without which cases would be nearest."""

    def nearest(to: Floats) -> float:
        return float(np.sort(np.linalg.norm(cases.places - to, axis=1))[2])

    return _relieved(cases, place, numbers, lambda relieved: nearest(place) - nearest(relieved))


def _relieved(
    cases: Cases, place: Floats, numbers: Mapping[str, float], gain_of: Callable[[Floats], float]
) -> tuple[Finding, ...]:
    """Return the stresses that are worse than in good cases, by what is gained where one is as in those."""
    good = cases.places[cases.severities < 0.7]
    if len(good) < 5:
        return ()
    findings = []
    for index, name in enumerate(cases.weights):
        if name not in STRESSES:
            continue
        better, words, help_ = STRESSES[name]
        typical = float(np.median(good[:, index]))
        if (place[index] - typical) * better >= 0:
            continue  # as good as in a good case already
        relieved = place.copy()
        relieved[index] = typical
        gain = gain_of(relieved)
        if gain > 0:
            findings.append(Finding(name, numbers[name], gain, words.format(value=numbers[name]), help_))
    return tuple(sorted(findings, key=lambda f: -f.gain))


def _clipped_first(findings: tuple[Finding, ...], numbers: Mapping[str, float]) -> tuple[Finding, ...]:
    """Return the findings, first that pixels are at full scale where many are, and none that asks for light.

    Similar cases hardly fail of it alone, but more light would make it worse, and it is what can be mended.
    """
    if numbers["saturated"] < CLIPPED:
        return findings
    _, words, help_ = STRESSES["saturated"]
    value = numbers["saturated"]
    gain = next((f.gain for f in findings if f.stress == "saturated"), 0.0)
    first = Finding("saturated", value, gain, words.format(value=value), help_)
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
    _, words, help_ = STRESSES["unsettled"]
    if numbers["unsettled"] >= DIVERGED:
        help_ += ", or another method if they make it worse"
    gain = next((f.gain for f in findings if f.stress == "unsettled"), 0.0)
    first = Finding("unsettled", numbers["unsettled"], gain, words, help_)
    return (first, *(f for f in findings if f.stress != "unsettled"))
