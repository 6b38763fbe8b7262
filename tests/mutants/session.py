"""Tests in processes that hold everything loaded, watched or with a mutant in them."""

from __future__ import annotations

import contextlib
import gc
import hashlib
import importlib
import os
import pickle
import resource
import shutil
import signal
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from types import FrameType, FunctionType
from typing import Any, Literal

import pytest

from tests.mutants.areas import AREAS
from tests.mutants.mutations import Mutant

MOST_WATCHED_S = 30.0
"""A test that took longer is not asked."""
_NO_MUTANT_EVERY = 25
_WATCH_LIMIT_S = 900.0
_KEPT = Path("build/mutants.pickle")

Line = tuple[str, int]
Fate = Literal["noticed", "lived", "no test"]


@dataclass
class Watched:
    """A test's time in seconds, and the lines that it came to, as it ran once."""

    seconds: float
    passed: bool
    lines: frozenset[Line]


@dataclass(frozen=True)
class _Kept:
    """What the tests of a file came to; the same again, as long as none of these files changes."""

    files: dict[str, str]
    """The tests' own and the modules that they reached, with their checksums; empty: not to be believed."""
    tests: dict[str, Watched]

    def holds(self, names: Collection[str]) -> bool:
        """Whether none of the files has changed, and these tests are those that were watched."""
        same = all(_digest(file) == digest for file, digest in self.files.items())
        return bool(self.files) and same and set(names) == set(self.tests)


def _digest(file: str) -> str:
    return hashlib.sha256(Path(file).read_bytes()).hexdigest() if Path(file).is_file() else ""


@dataclass
class _Child:
    process: int
    answer: Path
    began_s: float
    limit_s: float

    @property
    def is_late(self) -> bool:
        """Whether it has taken too long, less what it waited for a processor that others had."""
        return time.monotonic() - self.began_s - _waited_s(str(self.process)) > self.limit_s


class Trials:
    """A plugin that runs the collected tests for each mutant instead of once.

    Parameters
    ----------
    root : Path
        Of the repository.
    modules : sequence of str
        That are changed, relative to it.
    mutants : sequence of (str, Mutant)
        Each with its area.
    jobs : int
        Processes at a time.
    seconds : float
        After which no mutant is begun, counted from the first.
    most_tests_s : float
        Of the tests of one mutant together, as they took when they were watched.
    """

    def __init__(
        self,
        root: Path,
        modules: Sequence[str],
        mutants: Sequence[tuple[str, Mutant]],
        jobs: int,
        seconds: float,
        most_tests_s: float,
    ) -> None:
        self._root, self._modules, self._mutants = root, modules, mutants
        self._jobs, self._seconds, self._most_tests_s = jobs, seconds, most_tests_s
        self.fates: list[tuple[str, Mutant, Fate]] = []
        self.alone = self.failed_alone = self.not_possible = 0
        self._failed = False
        self._folder = Path(tempfile.mkdtemp(prefix="mutants-"))
        self._number = 0
        self._alive: set[int] = set()

    # What pytest calls -------------------------------------------------------------------------
    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Watch each test, then try each mutant."""
        try:
            return self._all(session)
        finally:
            self.end_processes()
            shutil.rmtree(self._folder, ignore_errors=True)

    def end_processes(self) -> None:
        """End whatever still runs: a Ctrl-C or SIGTERM of the terminal reaches this process alone."""
        for process in list(self._alive):
            self._end(process)
            os.kill(process, signal.SIGKILL)  # where it has no group of its own yet
            os.waitpid(process, 0)

    def _all(self, session: pytest.Session) -> bool:
        began_s = time.monotonic()
        for module in self._modules:  # what is imported when it is used, too
            importlib.import_module(module.removesuffix(".py").replace("/", "."))
        _load_kernels({Path("recon/base"), *(Path(module).parent for module in self._modules)})
        self._functions = _functions()
        assert threading.active_count() == 1, "a process with threads cannot be doubled"
        watched = self._watch(session)
        bad = [name for name, test in watched.items() if not test.passed]
        print(f"{len(watched)} tests watched in {time.monotonic() - began_s:.0f} s; not used: {bad}")
        self._try_all(session, watched, began_s + self._seconds)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember that a test failed."""
        self._failed |= report.failed

    # Watching ----------------------------------------------------------------------------------
    def _watch(self, session: pytest.Session) -> dict[str, Watched]:
        """Watch each test, but those whose file, and all that it reaches, is as when it was watched."""
        kept: dict[Path, _Kept] = pickle.loads(_KEPT.read_bytes()) if _KEPT.is_file() else {}
        children: list[tuple[_Child, Path]] = []
        groups = {path: list(items) for path, items in groupby(session.items, key=lambda item: item.path)}
        for path, items in groups.items():
            if path not in kept or not kept[path].holds([item.nodeid for item in items]):
                self._wait_for(children, self._jobs - 1, kept)
                children.append((self._fork(lambda items=items: self._watched(items), _WATCH_LIMIT_S), path))
        self._wait_for(children, 0, kept)
        return {name: test for path in groups for name, test in kept[path].tests.items()}

    def _wait_for(self, children: list[tuple[_Child, Path]], most: int, kept: dict[Path, _Kept]) -> None:
        while len(children) > most:
            for child, path in list(children):
                done, answer = self._done(child)
                if done:
                    children.remove((child, path))
                    tests: dict[str, Watched] = answer or {}
                    reached = {file for test in tests.values() for file, _ in test.lines}
                    files = {str(path), *reached} if tests else set()
                    kept[path] = _Kept({file: _digest(file) for file in files}, tests)
                    _KEPT.parent.mkdir(exist_ok=True)  # at once: who stops this loses none of it
                    _KEPT.write_bytes(pickle.dumps(kept))
            time.sleep(0.02)

    def _watched(self, items: list[pytest.Item]) -> dict[str, Watched]:
        """Run tests one after another, and note the lines of all areas' modules that each comes to."""
        files = {str(self._root / module) for modules, _ in AREAS.values() for module in modules}
        lines: set[Line] = set()

        def local(frame: FrameType, event: str, _: object) -> Any:
            if event == "line":
                lines.add((frame.f_code.co_filename, frame.f_lineno))
            return local

        def trace(frame: FrameType, _event: str, _arg: object) -> Any:
            return local if frame.f_code.co_filename in files else None

        found = {}
        for item, after in zip(items, [*items[1:], None], strict=True):
            lines.clear()
            self._failed = False
            began_s = time.process_time(), time.monotonic() - _waited_s()
            threading.settrace(trace)
            sys.settrace(trace)
            try:
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            finally:
                sys.settrace(None)
                threading.settrace(None)  # type: ignore[arg-type]
            alone_s = time.monotonic() - _waited_s() - began_s[1]
            seconds = max(time.process_time() - began_s[0], 0.2 * alone_s)
            found[item.nodeid] = Watched(seconds, not self._failed, frozenset(lines))
        return found

    # Trying ------------------------------------------------------------------------------------
    def _try_all(self, session: pytest.Session, watched: dict[str, Watched], until_s: float) -> None:
        items = {item.nodeid: item for item in session.items}
        usable = sorted(
            (test.seconds, name)
            for name, test in watched.items()
            if name in items and test.passed and test.seconds < MOST_WATCHED_S
        )
        children: list[tuple[_Child, str, Mutant | None]] = []
        for number, (area, mutant) in enumerate(self._mutants):
            if time.monotonic() > until_s:
                break
            chosen, total_s = [], 0.0
            reached = {(str(self._root / mutant.path), line) for line in range(*_span(mutant.lines))}
            coming = [test for test in usable if reached & watched[test[1]].lines]
            for seconds, name in _own_files_first(coming, mutant.path.stem):
                if chosen and total_s + seconds > self._most_tests_s:
                    continue
                chosen.append(items[name])
                total_s += seconds
            if not chosen:
                self.fates.append((area, mutant, "no test"))
                continue
            limit_s = 15.0 + 8.0 * total_s
            with_none = [None] if number % _NO_MUTANT_EVERY == 0 else []
            for what in (mutant, *with_none):
                self._gather(children, self._jobs - 1)
                child = self._fork(lambda what=what, chosen=chosen: self._tried(what, chosen), limit_s)
                children.append((child, area, what))
        self._gather(children, 0)

    def _gather(self, children: list[tuple[_Child, str, Mutant | None]], most: int) -> None:
        while len(children) > most:
            for one in list(children):
                child, area, mutant = one
                done, answer = self._done(child)
                if not done:
                    continue
                children.remove(one)
                if mutant is None:
                    self.alone += 1
                    self.failed_alone += answer is not True
                elif answer == "not possible":
                    self.not_possible += 1
                else:
                    self.fates.append((area, mutant, "lived" if answer is True else "noticed"))
                    if answer is True:
                        print(f"lived: {mutant.name}", flush=True)
            time.sleep(0.01)

    def _tried(self, mutant: Mutant | None, items: list[pytest.Item]) -> bool | str:
        """Run tests with a mutant until one fails; whether it lived."""
        if mutant is not None:
            file = str(self._root / mutant.path)
            functions = self._functions.get((file, mutant.function, mutant.first_line))
            if not functions:
                return "not possible"
            try:
                code = mutant.code(Path(file))
                for function in functions:
                    function.__code__ = code
            except (ValueError, SyntaxError):  # another closure, or a statement where it may not stand
                return "not possible"
        for item, after in zip(items, [*items[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=after)
            if self._failed:
                return False
        return True

    # Processes ---------------------------------------------------------------------------------
    def _fork(self, work: Callable[[], object], limit_s: float) -> _Child:
        """Do something in a process of its own, with its own temporary folder.

        It has ``limit_s`` of the processor, and of the clock without what it waits for others: what ends it
        counts as noticed.
        """
        self._number += 1
        answer = self._folder / str(self._number)
        sys.stdout.flush()
        process = os.fork()
        if process:
            self._alive.add(process)
            return _Child(process, answer, time.monotonic(), limit_s)
        try:
            os.setpgid(0, 0)
            signal.signal(signal.SIGTERM, signal.SIG_DFL)
            null = os.open(os.devnull, os.O_RDWR)
            for handle in (0, 1, 2):
                os.dup2(null, handle)
            resource.setrlimit(resource.RLIMIT_CPU, (int(limit_s), int(limit_s) + 5))
            own = self._folder / f"{self._number}.tmp"
            own.mkdir()
            tempfile.tempdir = os.environ["TMPDIR"] = str(own)
            self._config._tmp_path_factory._basetemp = own  # type: ignore[attr-defined]
            made = work()
            answer.with_suffix(".part").write_bytes(pickle.dumps(made))
            answer.with_suffix(".part").replace(answer)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)  # no thread that a mutant left keeps it
        raise AssertionError

    def _done(self, child: _Child) -> tuple[bool, Any]:
        """Return whether a process ended, and what it answered: None where it did not."""
        ended, _ = os.waitpid(child.process, os.WNOHANG)
        if not ended and not child.is_late:
            return False, None
        self._end(child.process)
        if not ended:
            os.waitpid(child.process, 0)
        return True, pickle.loads(child.answer.read_bytes()) if child.answer.is_file() else None

    def _end(self, process: int) -> None:
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process, signal.SIGKILL)
        self._alive.discard(process)

    def pytest_configure(self, config: pytest.Config) -> None:
        """Keep what knows the temporary folders."""
        self._config = config


def _functions() -> dict[tuple[str, str, int], list[FunctionType]]:
    """Return every function that is loaded, by file, qualified name and first line."""
    gc.unfreeze()  # what tests/conftest.py keeps out of collections is not among their objects
    gc.collect()
    found = defaultdict(list)
    for function in gc.get_objects():
        if type(function) is FunctionType:
            code = function.__code__
            found[code.co_filename, code.co_qualname, code.co_firstlineno].append(function)
    gc.freeze()
    return found


def _waited_s(process: str = "thread-self") -> float:
    """Return how long this thread, or a process' first, has waited for a processor that others had, seconds.

    0 where no kernel tells it.
    """
    told = Path("/proc", process, "schedstat")
    return int(told.read_text().split()[1]) / 1e9 if told.is_file() else 0.0


def _load_kernels(folders: Collection[Path]) -> None:
    """Load what is kept on disk of the compiled kernels in folders: else each process does so for itself.

    Most of a mutant's time was that: 0.95 s of the processor for one that its first test noticed, 0.2 s
    without (``sensor_admm.py``). What is not compiled yet, or for an older file, is left to who calls it.
    """
    for file in sorted(file for folder in folders for file in folder.glob("_*kernels.py")):
        module = importlib.import_module(file.with_suffix("").as_posix().replace("/", "."))
        for kernel in vars(module).values():
            cache = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
            for signature, *_ in cache._load_index() if cache else ():
                kernel.compile(signature)


def _own_files_first(tests: Sequence[tuple[float, str]], module: str) -> list[tuple[float, str]]:
    """Return tests in order: those of files named after the module, then the quickest of each other file."""
    turns: Counter[str] = Counter()
    placed = []
    for seconds, name in sorted(tests):
        file = name.partition("::")[0]
        own = Path(file).stem.startswith(f"test_{module}")
        placed.append((0 if own else 1 + turns[file], seconds, name))
        turns[file] += 1
    return [(seconds, name) for _, seconds, name in sorted(placed)]


def _span(lines: tuple[int, int]) -> tuple[int, int]:
    return min(lines), max(lines) + 1
