"""How often is a reconstruction called reliable that failed? Verdicts on unseen simulated scenes.

    python benchmarks/verdicts.py --first 2000 --count 200 --out docs/benchmarks/verdicts.md
    python benchmarks/verdicts.py --count 0 --keep verdicts.jsonl        judge what was kept once more
    python benchmarks/verdicts.py --first 700 --count 200 --keep mixed.jsonl --cases recon/verdict/mixed.json

Scenes of all five families, with seeds, diffusers (random and regular lenslets, smooth) and combinations of
stresses that no stability map has: each scene draws its light, read noise and density, and every other
stress with a chance of one in five. Failure is that of ``recon.verdict.map``, from the truth; the
verdict sees the data alone. What is kept is evidence and severity, so that verdicts can be made again.

170 of scenes 100 to 503, scenes 700 to 899 and the volumes of 1200 to 1229 come with the program, as cases
that verdicts ask (``--cases``). They are judged here by the cases of the others; scenes from 2000 on by all:
no constant was set on those, and none of their verdicts had been seen when the last ones were.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
from collections import Counter
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from scipy.stats import beta

from recon.base.threads import set_threads
from recon.evaluation.scene import Family, SceneSpec, spec_of
from recon.evaluation.scene_trial import Options, run_scene
from recon.verdict.cases import cases_of, group_of, is_whole, mixed_scenes, weights_of
from recon.verdict.evidence import Evidence
from recon.verdict.judge import Region, verdict_on
from recon.verdict.map import worst

FIRST_SEED = 50_000
CASES = {*range(100, 504), *range(700, 900), *range(1200, 1230)}
"""Scenes that serve as cases: of the first 170 were made, of the last those of volumes."""
UNSEEN_FROM = 2000
CLEAR = 0.7
"""Severity up to which a reconstruction is good beyond doubt, and not merely better than trivial."""
FAMILIES: tuple[Family, ...] = ("dense-picture", "sparse-picture", "beads", "dense-volume", "microscope")
"""Of these scenes, in the order of their numbers."""
DIGITS = 4
"""Of the evidence that is shipped."""
AUTO = ", auto"
"""After a method's name: with the model that ``model="auto"`` chooses, as users reconstruct."""
PICTURE_METHODS = ("admm tv" + AUTO, "admm tv", "admm l1", "wiener")
VOLUME_METHODS = ("admm tv of volumes" + AUTO, "admm tv of volumes", "admm l1 of volumes")


def scene(index: int) -> tuple[SceneSpec, Options]:
    """Return an unseen scene and how its data is handled."""
    rng = np.random.default_rng([FIRST_SEED, index])
    family = FAMILIES[index % len(FAMILIES)]
    numbers: dict[str, object] = {
        "photons": float(10 ** rng.uniform(1.2, 4.6)),
        "read_noise_e": float(10 ** rng.uniform(0, 1.5)),
        "size": int(rng.choice([40, 48, 56])),
        "seed": FIRST_SEED + index,
        "density": float(10 ** rng.uniform(-0.5, 0.5)),
        # Casting a full picture through a smooth diffuser takes minutes.
        "optics": str(
            rng.choice(
                ["random", "regular"] if family == "dense-picture" else ["random", "regular", "smooth"]
            )
        ),
    }
    stresses = {
        "erased": rng.uniform(0.1, 0.95),
        "saturation": rng.uniform(0.3, 0.95),
        "background": 10 ** rng.uniform(-2, 0.3),
        "drift_scale": 10 ** rng.uniform(-3, -1),
        "drift_deg": 10 ** rng.uniform(-1, 0.8),
    }
    numbers.update({k: float(v) for k, v in stresses.items() if rng.random() < 0.2})
    if family not in ("dense-picture", "sparse-picture"):
        depths = int(rng.choice([1, 2, 4, 6]))
        numbers["depths"] = depths
        if depths == 1:
            numbers["layers"] = (0.5, 0.5)
        if family == "microscope":
            numbers["grid"] = int(rng.choice([1, 3]))
    handled = Options(
        subtract_background=bool(rng.random() < 0.5), leave_out_saturated=bool(rng.random() < 0.5)
    )
    return spec_of(family, **numbers), handled


def run(first: int, count: int, keep: Path, *, with_auto: bool) -> None:
    """Reconstruct scenes and append evidence and severity to a file, but for those that it has."""
    done = {(e["index"], e["method"]) for e in read(keep)}
    for index in range(first, first + count):
        spec, handled = scene(index)
        one_depth = spec.is_picture or spec.depths == 1
        for method in PICTURE_METHODS if one_depth else VOLUME_METHODS:
            if (index, method) in done or (AUTO in method and not with_auto):
                continue
            name, auto, _ = method.partition(AUTO)
            options = replace(handled, model="auto", estimate_background=None) if auto else handled
            trial = run_scene(spec, name, options, "quick")
            severity, failure = worst(trial.severities)
            entry = {
                "index": index,
                "family": spec.family,
                "method": method,
                "severity": severity,
                "failure": None if failure is None else failure.name.lower(),
                "evidence": dict(trial.evidence),
            }
            with keep.open("a", encoding="utf-8") as file:
                file.write(json.dumps(entry) + "\n")
        print(f"\r{index + 1 - first} of {count} scenes", end="", file=sys.stderr)
    print(file=sys.stderr)


def read(keep: Path) -> list[dict]:
    """Return what was kept; a last line that an interruption cut off is taken from the file.

    Entries from before something was measured that verdicts ask are left out, and so made again.
    """
    if not keep.exists():
        return []
    text = keep.read_text(encoding="utf-8")
    whole = text[: text.rfind("\n") + 1]
    if whole != text:
        keep.write_text(whole, encoding="utf-8")
    entries = [json.loads(line) for line in whole.splitlines()]
    return [
        e
        for e in entries
        if not e["evidence"]
        or is_whole(e["evidence"], weights_of(str(group_of(e["method"].partition(AUTO)[0]))))
    ]


def ship(entries: list[dict], path: Path) -> None:
    """Write the entries of scenes that serve as cases as the program reads them."""
    cases = [
        {
            "scene": e["index"],
            "method": e["method"],
            "severity": float(f"{e['severity']:.{DIGITS}g}"),
            "evidence": {k: float(f"{v:.{DIGITS}g}") for k, v in e["evidence"].items()},
        }
        for e in sorted(entries, key=lambda e: (e["index"], e["method"]))
        if e["index"] in CASES and e["evidence"] and AUTO not in e["method"]
    ]
    lines = ",\n".join(json.dumps(c, allow_nan=False, separators=(",", ":")) for c in cases)
    path.write_text(f'{{"cases":[\n{lines}\n]}}\n', encoding="utf-8")


def table(entries: list[dict]) -> tuple[list[str], dict[str, float]]:
    """Return the table's lines by group of methods, and the figures of all together.

    No scene is judged by its own cases.
    """
    counts: dict[str, Counter] = {}
    for entry in entries:
        if not entry["evidence"]:
            continue  # refused by the reconstruction itself, with a sentence
        evidence = Evidence(**{**entry["evidence"], "planes": int(entry["evidence"]["planes"])})
        method, auto, _ = entry["method"].partition(AUTO)
        cases = cases_of(str(group_of(method))).without(entry["index"])
        region = verdict_on(evidence, method, cases).region
        good = entry["severity"] < 1
        for name in (f"{group_of(method)}{auto}", "all"):
            seen = counts.setdefault(str(name), Counter())
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
    for name, seen in sorted(counts.items(), key=lambda c: (c[0] == "all", c[0])):
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


def ranges(numbers: set[int]) -> list[tuple[int, int]]:
    """Return numbers that follow one another as the first and how many."""
    found: list[tuple[int, int]] = []
    for number in sorted(numbers):
        if found and number == sum(found[-1]):
            found[-1] = (found[-1][0], found[-1][1] + 1)
        else:
            found.append((number, 1))
    return found


def main() -> None:
    """Run, judge, tabulate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--count", type=int, default=200, help="scenes to add")
    parser.add_argument("--first", type=int, default=UNSEEN_FROM, help="the first one's number")
    parser.add_argument("--keep", type=Path, default=Path("verdicts.jsonl"))
    parser.add_argument("--fixed-only", action="store_true", help="leave out chosen models (auto)")
    parser.add_argument("--cases", type=Path, help="write the scenes that serve as cases")
    parser.add_argument("--out", type=Path, help="write the report")
    a = parser.parse_args()
    set_threads(1)
    run(a.first, a.count, a.keep, with_auto=not a.fixed_only)
    entries = read(a.keep)
    if a.cases is not None:
        ship(entries, a.cases)
    shipped = [{**e, "index": e["scene"]} for e in mixed_scenes()]
    unseen = [e for e in entries if e["index"] >= UNSEEN_FROM]
    numbers = {e["index"] for e in unseen}
    chosen = {e["index"] for e in unseen if AUTO in e["method"]}
    report = [
        "# How often verdicts are wrong",
        "",
        *(
            f"    python benchmarks/verdicts.py --first {first} --count {count} --keep verdicts.jsonl"
            + ("" if first in chosen else " --fixed-only")
            for first, count in ranges(numbers)
        ),
        "    python benchmarks/verdicts.py --count 0 --keep verdicts.jsonl --out docs/benchmarks/verdicts.md",
        "",
        f"{datetime.now(UTC):%Y-%m-%d}, {platform.machine()}. Simulated scenes of five families that are in",
        "no stability map: other seeds, random and regular lenslets and smooth diffusers, several stresses",
        "at once, and besides fixed models the one that is chosen for users (`auto`). The truth says what",
        "failed; the verdict saw the data alone. Where none of a kind was called reliable (`-`), nothing",
        "is known of how far that is to be trusted.",
    ]
    if unseen:
        report += [
            "",
            f"## {len(numbers)} unseen scenes",
            "None of these is among the cases that verdicts ask, and no constant was set on them.",
            *([f"Models were chosen (`auto`) for {len(chosen)} of them."] if chosen < numbers else []),
            "",
            *said(unseen),
        ]
    scenes = len({e["index"] for e in shipped})
    report += [
        "",
        f"## {scenes} scenes that come with the program",
        "These serve as cases; each is judged here by the cases of the others. The numbers of cases that are",
        "asked, the share of failures allowed among them and the weights of what makes them alike were",
        "chosen on them.",
        "",
        *said(shipped),
    ]
    print("\n".join(report))
    if a.out is not None:
        a.out.write_text("\n".join(report) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
