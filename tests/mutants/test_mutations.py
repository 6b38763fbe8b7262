"""Mutants are small, are the code that they say, and leave alone what only says something."""

from __future__ import annotations

import gc
import os
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.mutants.__main__ import known_equal
from tests.mutants.areas import AREAS
from tests.mutants.mutations import mutants_of
from tests.mutants.session import Trials, Watched, _digest, _functions, _Kept

TEXT = '''
class A:
    @property
    def large(self) -> bool:
        """Whether it is."""
        if not self.there:
            raise ValueError(f"{1 + 1} things")
        return self.size > 3 and self.open

    def __repr__(self):
        return 1 + 1


def least(values):
    assert values, 1 + 1
    if not values:
        raise AssertionError("unreachable")
    return min(values) - 1.0


def twice(values):
    print(min(values), min(values), end=True)
'''


def test_mutants_of_a_text_are_the_code_that_they_say(tmp_path: Path) -> None:
    (tmp_path / "a.py").write_text(TEXT)
    every = mutants_of(Path("a.py"), tmp_path)
    assert len({mutant.name for mutant in every}) == len(every)  # each can be listed as equal by itself
    found = {mutant.what: mutant for mutant in reversed(every)}
    assert set(found) == {
        "not self.there -> self.there",
        "raise ValueError(f'{1 + 1} things') -> pass",
        "self.size > 3 and self.open -> self.size > 3 or self.open",
        "self.size > 3 -> self.size >= 3",
        "self.size > 3 -> self.size <= 3",
        "self.size > 3 -> self.size > 4",
        "not values -> values",
        "min(values) - 1.0 -> min(values) + 1.0",
        "min(values) - 1.0 -> min(values) - 2.0",
        "min(values) -> max(values)",
        "print(min(values), min(values), end=True) -> pass",
        "min(values) -> max(values) (time 2)",
        "end=True -> end=False",
    }

    def least(values: list[int]) -> float:
        return float(values[0])

    least.__code__ = found["min(values) -> max(values)"].code(tmp_path / "a.py")
    assert least([1, 5]) == 4.0
    assert found["self.size > 3 -> self.size >= 3"].function == "A.large"


def test_what_is_said_to_be_equal_is_still_in_the_program() -> None:
    root = Path(__file__).parents[2]
    names = {m.name for paths, _ in AREAS.values() for path in paths for m in mutants_of(Path(path), root)}
    assert not set(known_equal()) - names


def test_a_function_is_found_though_it_is_kept_out_of_collections() -> None:
    code = mutants_of.__code__
    gc.freeze()
    assert _functions()[code.co_filename, "mutants_of", code.co_firstlineno] == [mutants_of]


def test_tests_are_watched_again_once_their_file_or_their_names_changed(tmp_path: Path) -> None:
    file = tmp_path / "test_a.py"
    file.write_text("1")
    kept = _Kept({str(file): _digest(str(file))}, {"a[1]": Watched(0.1, True, frozenset())})
    assert kept.holds(["a[1]"])
    assert not kept.holds(["a[1]", "a[2]"])  # a case that a folder or another module gave
    assert not kept.holds([])
    file.write_text("2")
    assert not kept.holds(["a[1]"])


def test_no_process_with_a_mutant_outlives_the_run(tmp_path: Path) -> None:
    trials = Trials(tmp_path, [], [], 1, 1.0, 1.0)
    trials.pytest_configure(SimpleNamespace(_tmp_path_factory=SimpleNamespace()))  # type: ignore[arg-type]
    child = trials._fork(lambda: time.sleep(60), 100.0)
    time.sleep(0.1)  # its process group is its own by then
    assert trials._done(child) == (False, None)
    late = trials._fork(lambda: time.sleep(60), 0.05)
    while not (told := trials._done(late))[0]:  # what it waits for a processor does not count
        time.sleep(0.01)
    assert told == (True, None)
    os.kill(child.process, 0)
    trials.end_processes()
    with pytest.raises(ProcessLookupError):
        os.kill(child.process, 0)
