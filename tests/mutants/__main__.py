"""Change the program a little, again and again, and see whether a test notices: ``make mutants``.

    python -m tests.mutants                       a sample of every area, within 30 minutes
    python -m tests.mutants solvers --sample 50   so many of each area that is named
    python -m tests.mutants --list                what can be changed, and do nothing
    python -m tests.mutants solvers --by-module   so many of each module, counted by module
    python -m tests.mutants safety --sample 999 --only checked.py --tests tests/drivers/test_checked.py
                                                  every mutant of one module, soon: what those tests notice

A mutant is one small mistake in one function: ``<`` for ``<=``, ``+`` for ``-``, a call or a ``raise`` left
out, a number changed, a condition negated. First each test runs once and is watched: which lines it comes
to. Then each mutant is put into a process of its own in which everything is loaded already, and tests that
come to its line, first those of files named after the module, run until one fails (*noticed*), or all pass
(*lived*). What hangs is noticed. Compiled kernels, module constants and words are not changed; a test that
runs the program in a process of its own does not see a mutant. Some processes have no mutant in them: tests
that fail there are failing by themselves, and the figures are worth less.

Those that cannot be noticed, since they are equal to what was there, stand in tests/mutants/equal.toml with
the reason. Exit status 1 when less than 95 % of the others were noticed.
"""

from __future__ import annotations

import argparse
import os
import random
import signal
import sys
import tomllib
from collections import Counter
from pathlib import Path
from typing import get_args

import pytest

from tests.mutants.areas import AREAS
from tests.mutants.mutations import Mutant, mutants_of
from tests.mutants.session import Fate, Trials

ROOT = Path(__file__).parents[2]
ENOUGH = 0.95


def known_equal() -> dict[str, str]:
    """Return the mutants that no test can notice, each with the reason."""
    listed = tomllib.loads(Path(__file__).with_name("equal.toml").read_text())["equal"]
    return {mutant["name"]: mutant["why"] for mutant in listed}


def drawn(
    groups: dict[str, tuple[str, ...]], sample: int, seed: int, only: list[str]
) -> list[tuple[str, Mutant]]:
    """Return a sample of each group of modules, of those mutants in whose name one of ``only`` stands."""
    found: list[tuple[float, str, Mutant]] = []
    equal = known_equal()
    for group, paths in groups.items():
        rng = random.Random(f"{seed} {group}")
        every = [mutant for path in paths for mutant in mutants_of(Path(path), ROOT)]
        those = [one for one in every if one.name not in equal and any(part in one.name for part in only)]
        some = rng.sample(those, min(sample, len(those)))
        found += [(number / len(some), group, mutant) for number, mutant in enumerate(some)]
    return [(group, mutant) for _, group, mutant in sorted(found, key=lambda one: one[0])]


def grouped(areas: list[str], *, by_module: bool) -> dict[str, tuple[str, ...]]:
    """Return the modules of areas by area, or each by itself."""
    if by_module:
        return {path: (path,) for area in areas for path in AREAS[area][0]}
    return {area: AREAS[area][0] for area in areas}


def table(fates: list[tuple[str, Mutant, Fate]]) -> float:
    """Print what became of the mutants, and those that lived; return the share that was noticed."""
    for _, mutant, fate in fates:
        if fate != "noticed":
            print(f"{fate}: {mutant.path}:{mutant.lines[1]} {mutant.function}: {mutant.what}")
    counts = Counter((group, fate) for group, _, fate in fates)
    groups = list(dict.fromkeys(group for group, _, _ in fates))
    wide = max(map(len, groups), default=0) + 2
    print(f"{'':<{wide}}{'tried':>7}{'noticed':>9}{'lived':>7}{'no test':>9}{'share':>8}")
    sums: Counter[str] = Counter()
    for group in [*groups, "all"]:
        n = sums if group == "all" else Counter({fate: counts[group, fate] for fate in get_args(Fate)})
        sums += n if group != "all" else Counter()
        tried = sum(n.values())
        share = n["noticed"] / max(tried, 1)
        print(f"{group:<{wide}}{tried:>7}{n['noticed']:>9}{n['lived']:>7}{n['no test']:>9}{share:>8.0%}")
    return share


def main() -> int:
    """Try mutants as the command line says; 1 when too few were noticed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("area", nargs="*", choices=[*AREAS, []], help="what is changed [default: all]")
    parser.add_argument("--sample", type=int, default=40, help="mutants of each area (--by-module: module)")
    parser.add_argument("--by-module", action="store_true", help="draw from each module, and count by module")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--minutes", type=float, default=25.0, help="no mutant is begun after so long")
    parser.add_argument("--most", type=float, default=30.0, help="seconds of tests of a mutant, as watched")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument(
        "--only", nargs="+", default=[""], help="only mutants in whose name one of these stands"
    )
    parser.add_argument("--tests", nargs="+", default=[], help="only these [default: those of the areas]")
    parser.add_argument("--list", action="store_true", help="print the sample and end")
    options = parser.parse_args()
    areas = options.area or list(AREAS)
    chosen = drawn(grouped(areas, by_module=options.by_module), options.sample, options.seed, options.only)
    if options.list:
        for _, mutant in chosen:
            print(mutant.name)
        return 0
    tests = options.tests or sorted({test for area in areas for test in AREAS[area][1]})
    modules = sorted({path for area in areas for path in AREAS[area][0]})
    trials = Trials(ROOT, modules, chosen, options.jobs, 60 * options.minutes, options.most)
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    os.environ["CI"] = "1"  # property tests try the same examples every time
    os.chdir(ROOT)
    failed = pytest.main(["-q", "-s", "-m", "not slow", "-p", "no:cacheprovider", *tests], plugins=[trials])
    if failed and not trials.fates:  # those tried before Ctrl-C count
        return int(failed)
    share = table(trials.fates)
    n = len(trials.fates)
    print(f"{share:.1%} of {n} noticed (seed {options.seed}); {len(known_equal())} are known to be equal.")
    print(f"Without a mutant: {trials.alone} processes, {trials.failed_alone} failed.")
    if trials.not_possible:
        print(f"{trials.not_possible} could not be put into the program.")
    if left := len(chosen) - n - trials.not_possible:
        print(f"{left} were not tried for want of time.")
    return int(share < ENOUGH)


if __name__ == "__main__":
    sys.exit(main())
