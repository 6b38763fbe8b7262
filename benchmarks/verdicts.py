"""How often is a reconstruction called reliable that failed? Verdicts on unseen scenes.

    python benchmarks/verdicts.py --first 6001 --count 200 --out docs/benchmarks/verdicts.md
    python benchmarks/verdicts.py --count 0 --keep verdicts.jsonl        judge what was kept once more
    python benchmarks/verdicts.py --first 3000 --count 200 --fit         add cases, and learn from all
    python benchmarks/verdicts.py --count 0 --left-out                   the cases by what the others teach

Scenes of all families, with seeds, optics (random and regular lenslets, smooth diffusers, for odd numbers the
PSFs of the measured sets) and combinations of stresses that no stability map has: each scene draws its light,
read noise, density and size, and every other stress with a chance of one in five. Failure is that of
``recon.verdict.map``, from the truth; the verdict sees the data alone. What is kept is evidence and severity,
so that verdicts can be made again.

Scenes 3000 to 5999 serve as cases in ``benchmarks/verdict_cases.json``, with older volumes (numbers below
2000, made with fixed weights and no measured PSFs); 4000 to 4999 are bright volumes; from 6000 on nothing was
learned or set.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.stats import beta

from recon.base.threads import set_threads
from recon.errors import InputError
from recon.evaluation.content import PICTURES
from recon.evaluation.measured_sets import MEASURED
from recon.evaluation.scene import Family, SceneSpec, spec_of
from recon.evaluation.scene_trial import Options, judge, scene_of, solve
from recon.verdict.calibration_check import CalibrationCheck, Fit
from recon.verdict.cases import GROUPS, group_of
from recon.verdict.chance import FEATURES, FEATURES_OF_VOLUMES, SHIPPED, fitted, is_whole, place_of
from recon.verdict.evidence import Evidence
from recon.verdict.judge import Region, verdict_on, withheld
from recon.verdict.map import worst

FIRST_SEED = 60_000
CASES = range(3000, 6000)
UNSEEN_FROM = 6000
CASES_FILE = Path(__file__).with_name("verdict_cases.json")
CLEAR = 0.7
"""Severity up to which a reconstruction is good beyond doubt, and not merely better than trivial."""
FAMILIES: tuple[Family, ...] = (
    *("dense-picture", "beads", "text", "dense-volume", "filaments", "sparse-picture", "beads", "texture"),
    *("microscope", "gradient", "lights", "dense-volume", "sparse-picture"),
)
"""Of these scenes, in the order of their numbers, two of each."""
BRIGHT = range(4000, 5000)
BRIGHT_FAMILIES: tuple[Family, ...] = ("beads", "microscope", "beads", "dense-volume")
"""Numbers of bright volumes alone, as among the others few are good, and of what."""
MOST = 10**9
"""Voxels up to which every scene is taken."""
DIGITS = 4
"""Of the evidence that is shipped."""
AUTO = ", auto"
"""After a method's name: with the model that ``model="auto"`` chooses, as users reconstruct."""
PICTURE_METHODS = ("admm tv" + AUTO, "admm l1" + AUTO, "wiener")
VOLUME_METHODS = ("admm tv of volumes" + AUTO, "admm l1 of volumes" + AUTO)


def scene(index: int) -> tuple[SceneSpec, Options]:
    """Return an unseen scene and how its data is handled; odd ones are seen through measured PSFs."""
    rng = np.random.default_rng([FIRST_SEED, index])
    measured = index % 2 == 1
    families = BRIGHT_FAMILIES if index in BRIGHT else FAMILIES
    family = families[index // 2 % len(families)]
    is_picture = family in PICTURES
    larger = float(rng.choice([1.0, 1.0, 1.5, 2.0]))
    numbers: dict[str, object] = {
        "photons": float(10 ** rng.uniform(1.5, 4.6)),
        "read_noise_e": float(10 ** rng.uniform(0, 1.5)),
        "seed": FIRST_SEED + index,
        "density": float(10 ** rng.uniform(-0.5, 0.5)),
    }
    if index in BRIGHT:
        numbers["photons"] = float(10 ** rng.uniform(3, 5))
    if measured:
        optics = "usaf" if not is_picture else str(rng.choice(["hand", "usaf"]))
        height, width = (45, 60) if optics == "hand" else (45, 53)
        numbers |= {"optics": optics, "field": 0.65}
        numbers["calibration_photons"] = float(10 ** rng.uniform(3, 4.5))
        if index % 4 == 3 and index not in BRIGHT:  # as bright, and some as large, as those that were taken
            numbers["photons"] = float(numbers["photons"]) * 20  # type: ignore[arg-type]
            larger = 5.0 if index % 8 == 7 else larger
        if rng.random() < 0.3:
            numbers["aberration"] = float(10 ** rng.uniform(-2, -1))
    else:
        height = width = int(rng.choice([40, 48, 56]))
        # Casting a full picture through a smooth diffuser takes minutes.
        kinds = ["random", "regular", "smooth"] if not is_picture or family == "sparse-picture" else None
        numbers["optics"] = str(rng.choice(kinds or ["random", "regular"]))
    if is_picture and (measured or numbers["optics"] != "smooth"):
        height, width = round(height * larger), round(width * larger)
    numbers["size"] = (height, width)
    stresses = {
        "erased": rng.uniform(0.1, 0.95),
        "saturation": rng.uniform(0.3, 0.95),
        "background": 10 ** rng.uniform(-2, 0.3),
        "drift_scale": 10 ** rng.uniform(-3, -1),
        "drift_deg": 10 ** rng.uniform(-1, 0.8),
    }
    numbers.update({k: float(v) for k, v in stresses.items() if rng.random() < 0.2})
    if not is_picture:
        depths = int(rng.choice([4, 12, 30] if measured else [2, 4, 6]))
        numbers["depths"] = depths
        if family == "microscope":
            numbers["grid"] = int(rng.choice([1, 3]))
    handled = Options(
        subtract_background=bool(rng.random() < 0.5), leave_out_saturated=bool(rng.random() < 0.5)
    )
    return spec_of(family, **numbers), handled


def run(first: int, count: int, keep: Path, most: int) -> None:
    """Reconstruct scenes and append evidence and severity to a file, but for those that it has.

    Those of more than ``most`` voxels are left out.
    """
    done = {(e["index"], e["method"]) for e in read(keep)}
    for index in range(first, first + count):
        spec, handled = scene(index)
        if spec.depths * int(np.prod(spec.shape)) > most:
            continue
        for method in PICTURE_METHODS if spec.is_picture else VOLUME_METHODS:
            if (index, method) in done:
                continue
            name, auto, _ = method.partition(AUTO)
            options = replace(handled, model="auto", estimate_background=None) if auto else handled
            try:
                result = solve(scene_of(spec), name, options, None)
            except InputError:
                continue  # refused with a sentence: an image without light
            trial = judge(scene_of(spec), result)
            check = None if result.verdict is None else result.verdict.calibration
            severity, failure = worst(trial.severities)
            entry = {
                "index": index,
                "family": spec.family,
                "method": method,
                "severity": severity,
                "failure": None if failure is None else failure.name.lower(),
                "optics": spec.optics,
                "fit": None if check is None else str(check.fit),
                "evidence": dict(trial.evidence),
            }
            with keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        print(f"\r{index + 1 - first} of {count} scenes", end="", file=sys.stderr)
    print(file=sys.stderr)


def read(keep: Path) -> list[dict]:
    """Return what was kept; a last line that an interruption cut off is taken from the file."""
    if not keep.exists():
        return []
    text = keep.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        keep.write_text(whole, encoding="utf-8")
    return [json.loads(line) for line in whole.splitlines()]


def known_cases(entries: list[dict]) -> list[dict]:
    """Return the cases of the file with those among the entries added, and write them there."""
    known = {(c["scene"], c["method"]): c for c in json.loads(CASES_FILE.read_text("utf-8"))["cases"]}
    for e in entries:
        method = e["method"].partition(AUTO)[0]
        if e["index"] in CASES and e["evidence"]:
            known[e["index"], method] = {
                "scene": e["index"],
                "method": method,
                "severity": float(f"{e['severity']:.{DIGITS}g}"),
                "evidence": {k: float(f"{v:.{DIGITS}g}") for k, v in e["evidence"].items()},
            }
    cases = [known[key] for key in sorted(known)]
    lines = ",\n".join(json.dumps(c, allow_nan=False, separators=(",", ":")) for c in cases)
    CASES_FILE.write_text(f'{{"cases":[\n{lines}\n]}}\n', encoding="utf-8")
    return cases


def of_group(group: str, cases: list[dict]) -> tuple[Sequence[str], dict[str, np.ndarray]]:
    """Return what is asked of a group, and its cases as :func:`fitted` takes them."""
    features = FEATURES_OF_VOLUMES if group.startswith("volume") else FEATURES
    mine = [c for c in cases if c["method"] in GROUPS[group] and is_whole(c["evidence"], features)]
    return features, {
        "places": np.array([place_of(c["evidence"], features) for c in mine]),
        "severities": np.array([c["severity"] for c in mine]),
        "scenes": np.array([c["scene"] for c in mine]),
        "decides": np.array([not withheld(c["evidence"]) for c in mine]),
    }


def learn(cases: list[dict]) -> None:
    """Fit the regressions that the program asks, and write them to where it reads them."""
    found = {}
    for group in GROUPS:
        features, known = of_group(group, cases)
        found[group] = fitted(features, **known).as_json()
    lines = ",\n".join(f"{json.dumps(g)}: {json.dumps(v, separators=(',', ':'))}" for g, v in found.items())
    SHIPPED.write_text(f"{{\n{lines}\n}}\n", encoding="utf-8")


def left_out(cases: list[dict]) -> Iterator[str]:
    """Yield lines of a table: a fifth of the scenes judged by what the others teach, the threshold too.

    The check of the calibration, which takes some more away, is not among it.
    """
    yield "| methods | cases | called reliable | of these failed | clearly good ones called reliable |"
    yield "|---|---|---|---|---|"
    for group in GROUPS:
        features, known = of_group(group, cases)
        places, scenes = known["places"], known["scenes"]
        severities, called = known["severities"], np.zeros(len(places), bool)
        groups, number = np.unique(scenes, return_inverse=True)
        fold = np.random.default_rng(11).permutation(len(groups))[number] % 5
        for k in range(5):
            others = {name: values[fold != k] for name, values in known.items()}
            chances = fitted(features, **others)
            near = np.array([chances.distance(place) <= chances.far for place in places[fold == k]])
            called[fold == k] = near & (chances.chance(places[fold == k]) <= chances.reliable)
        called &= known["decides"]
        bright = np.isin(scenes, BRIGHT)
        for name, among in ((group, np.ones(len(called), bool)), (f"{group}, bright", bright)):
            if not among.any():
                continue
            reliable, clear = called & among, among & (severities <= CLEAR)
            failed, kept = np.sum(reliable & (severities >= 1)), np.sum(reliable & clear)
            yield (
                f"| {name} | {among.sum()} | {reliable.sum()} | {failed} ({_share(failed, reliable.sum())}) "
                f"| {kept} of {clear.sum()} ({_share(kept, clear.sum())}) |"
            )


def table(entries: list[dict]) -> tuple[list[str], dict[str, float]]:
    """Return the table's lines by group of methods and by optics, and the figures of all together."""
    counts: dict[str, Counter] = {}
    for entry in entries:
        if not entry["evidence"]:
            continue  # refused by the reconstruction itself, with a sentence
        evidence = Evidence(**{**entry["evidence"], "planes": int(entry["evidence"]["planes"])})
        method = entry["method"].partition(AUTO)[0]
        verdict = verdict_on(evidence, method)
        if entry["fit"] is not None:
            verdict = verdict.with_calibration(CalibrationCheck(Fit(entry["fit"]), {}, 0))
        region = verdict.region
        good = entry["severity"] < 1
        where = "all through measured PSFs" if entry["optics"] in MEASURED else "all simulated"
        for name in (str(group_of(method)), where, "all"):
            seen = counts.setdefault(name, Counter())
            seen[region, good] += 1
            clear = entry["severity"] <= CLEAR
            seen["clear"] += clear
            seen["clear and reliable"] += clear and region is Region.INSIDE
    lines = [
        "| methods | reconstructions | good ones | called reliable | of these failed "
        "| good ones called reliable | clearly good ones called reliable | failed ones called not reliable |",
        "|---|---|---|---|---|---|---|---|",
    ]
    figures: dict[str, float] = {}
    for name, seen in sorted(counts.items(), key=lambda c: (c[0].startswith("all"), c[0] == "all", c[0])):
        good, bad = (sum(seen[region, kind] for region in Region) for kind in (True, False))
        reliable = seen[Region.INSIDE, True] + seen[Region.INSIDE, False]
        wrong = seen[Region.INSIDE, False]
        outside = seen[Region.OUTSIDE, False]
        lines.append(
            f"| {name} | {good + bad} | {good} | {reliable} | {wrong} ({_share(wrong, reliable)}) "
            f"| {seen[Region.INSIDE, True]} ({_share(seen[Region.INSIDE, True], good)}) "
            f"| {seen['clear and reliable']} of {seen['clear']} "
            f"({_share(seen['clear and reliable'], seen['clear'])}) "
            f"| {outside} ({_share(outside, bad)}) |"
        )
        if name == "all":
            figures = {
                "reliable": reliable,
                "failed": wrong,
                "wrong": wrong / max(reliable, 1),
                "kept": seen[Region.INSIDE, True] / max(good, 1),
                "clear": seen["clear and reliable"] / max(seen["clear"], 1),
            }
    return lines, figures


def _share(part: int, whole: int) -> str:
    return f"{part / whole:.0%}" if whole else "-"


def upper_bound(failed: int, of: int) -> float:
    """Return the share that ``failed`` of so many leave possible, 95 % one-sided (Clopper and Pearson)."""
    return float(beta.ppf(0.95, failed + 1, of - failed)) if failed < of else 1.0


def said(entries: list[dict]) -> list[str]:
    """Return a table with what it says in words."""
    lines, figures = table(entries)
    reliable, failed, kept = int(figures["reliable"]), int(figures["failed"]), figures["kept"]
    words = (
        f"Of {reliable} called reliable {failed} failed: up to {upper_bound(failed, reliable):.1%} are "
        "possible (95 % upper bound, each\ncounted as independent, though several are of one scene). "
        f"{kept:.0%} of the good ones were called reliable, and\n{figures['clear']:.0%} of the clearly good "
        f"ones, whose severity is {CLEAR} at most."
    )
    return [words, "", *lines]


def main() -> None:
    """Run, learn, judge, tabulate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="scenes to add")
    parser.add_argument("--first", type=int, default=UNSEEN_FROM, help="the first one's number")
    parser.add_argument("--voxels", type=int, default=MOST, help="leave out scenes of more than so many")
    parser.add_argument("--keep", type=Path, default=Path("verdicts.jsonl"))
    parser.add_argument("--fit", action="store_true", help="learn from the cases and those that were kept")
    parser.add_argument("--left-out", action="store_true", help="judge the cases by what the others teach")
    parser.add_argument("--out", type=Path, help="write the report")
    a = parser.parse_args()
    set_threads(1)
    run(a.first, a.count, a.keep, a.voxels)
    entries = read(a.keep)
    if a.fit:
        learn(known_cases(entries))
    if a.left_out:
        print("\n".join(left_out(known_cases([]))))
    unseen = [e for e in entries if e["index"] >= UNSEEN_FROM]
    numbers = {e["index"] for e in unseen}
    if not unseen:
        return
    count = max(numbers) - min(numbers) + 1
    limit = "" if a.voxels == MOST else f" --voxels {a.voxels}"
    report = [
        "# How often verdicts are wrong",
        "",
        f"    python benchmarks/verdicts.py --first {min(numbers)} --count {count}{limit} "
        "--keep verdicts.jsonl --out docs/benchmarks/verdicts.md",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}. {len(numbers)} scenes that nothing was",
        "learned from or set on, reconstructed by the model that is chosen for users (`auto`): other seeds,",
        "random and regular lenslets and smooth diffusers, every second one through the PSFs of the measured",
        "sets, several stresses at once. The truth says what failed; the verdict, the calibration's check",
        "included, saw the data alone. Where none of a kind was called reliable (`-`), nothing is known of",
        "how far that is to be trusted.",
        "",
        *said(unseen),
    ]
    print("\n".join(report))
    if a.out is not None:
        a.out.write_text("\n".join(report) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
