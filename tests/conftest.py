"""For all tests: property tests are not judged by the clock of a machine that does other things, too.

With ``CI`` in the environment they try the same examples every time: what continuous integration says of a
change is about that change. Everywhere else they look for new ones.
"""

from __future__ import annotations

import fcntl
import gc
import os
import signal
import threading
import time
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# A window that matplotlib opens beside the program's own would wait for somebody to close it.
os.environ["MPLBACKEND"] = "agg"
# Several test processes share the cores. It is read when NumPy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# A process that a script starts in the background (`make test &`) ignores Ctrl-C, as does all that it starts.
# What is tested here is the program as a terminal starts it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

import numpy as np
import pytest
from hypothesis import HealthCheck, settings

from recon.base import threads

settings.register_profile(
    "diffuserbench",
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
    derandomize=bool(os.environ.get("CI")),
)
settings.load_profile("diffuserbench")

# Each worker of a parallel run has its share of the cores: results are the same to the last bit for any
# number of threads (tested where threads are), and two on one core cost a quarter more than one.
threads.set_threads(max(1, threads.get_threads() // int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))))

try:
    import PySide6.QtWidgets  # noqa: F401 # needs libraries of the system, too
    import pytestqt  # noqa: F401
except ImportError:
    pass  # tests/gui says so, test by test
else:
    pytest_plugins = ["pytestqt.plugin"]


def _compile_once_for_all_workers() -> None:
    """Let one worker compile a kernel while others that want it wait, and take it from numba's cache.

    Else each compiles it, and one of two that write into an index at a time loses its part. Threads
    wait before processes, and kernels do not call each other in circles: nobody waits for ever.
    """
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compiled = Dispatcher.compile

    def compiled_once(self: Any, signature: Any) -> Any:
        if (folder := self._cache.cache_path) is None:
            return compiled(self, signature)
        Path(folder).mkdir(parents=True, exist_ok=True)
        with global_compiler_lock, Path(folder, f"{self.py_func.__qualname__}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            return compiled(self, signature)

    Dispatcher.compile = compiled_once  # type: ignore[assignment, method-assign]


if "PYTEST_XDIST_WORKER" in os.environ:
    _compile_once_for_all_workers()


def _begin_random_numbers(module: object, name: str) -> None:
    """Start every generator that a module of tests shares anew, for ``name``."""
    for number, shared in enumerate(vars(module).values()):
        if isinstance(shared, np.random.Generator):
            seed = zlib.crc32(f"{name} {number}".encode())
            shared.bit_generator.state = type(shared.bit_generator)(seed).state


def pytest_collection_finish() -> None:
    """Keep Python from looking for garbage among all tests and all that is imported, again and again."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(tryfirst=True)
def pytest_fixture_setup(fixturedef: pytest.FixtureDef[Any], request: pytest.FixtureRequest) -> None:
    """Random numbers of a fixture are its own, whichever tests ran before in this process."""
    if (module := getattr(request, "module", None)) is not None:
        _begin_random_numbers(module, f"{fixturedef.argname} {getattr(request, 'param_index', 0)}")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> None:
    """Random numbers of a test are its own, whichever tests ran before in this process."""
    if (module := getattr(item, "module", None)) is not None:
        _begin_random_numbers(module, item.nodeid)


@pytest.fixture(autouse=True)
def _no_live_view_is_left() -> Iterator[None]:
    """A live view that a test left on would take the cores, and memory that is counted, from all after it."""
    before = set(threading.enumerate())
    yield
    end = time.monotonic() + 20
    while left := [t for t in threading.enumerate() if t not in before and t.name == "live reconstruction"]:
        assert time.monotonic() < end, f"left running: {left}"
        left[0].join(0.1)
