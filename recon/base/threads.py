"""The one place for threads: how many, and the pool that the element-wise kernels share.

FFTs and kernels both take their number of threads from here. Work is cut into blocks in a way that never
changes a result: every output element is computed whole by one thread, and sums are taken over fixed blocks
first. So results are equal to the last bit for any number of threads.

Linear algebra stays on one thread meanwhile (:func:`linear_algebra_on_one_thread`): its matrices are small,
and its library's own threads wait for each other by spinning on the cores that others need.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator, Sized
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import lru_cache
from typing import Any

_STEP_BACK = 10
"""In the system's units of niceness: a tenth of the share that the main thread has of a core."""
_lock = threading.Lock()
_inside = threading.local()
_stands_back = False
_threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)


def get_threads() -> int:
    """Return how many threads FFTs and kernels use; at first, the CPUs that this process may run on."""
    return _threads


def set_threads(threads: int) -> None:
    """Set the number of threads for FFTs and kernels, at least 1."""
    global _threads
    if threads < 1:
        raise ValueError(f"threads must be at least 1, not {threads}.")
    with _lock:
        _threads = int(threads)


def stand_back() -> None:
    """Have threads that compute in blocks let the main one go first from now on; on Linux, elsewhere nothing.

    For a window: its thread is to answer while they have every core. They compute for whoever asks, who waits
    and keeps its priority: what it begins, a camera's stream or a program, would inherit a lower one, which
    only an administrator may raise.
    """
    global _stands_back
    _stands_back = sys.platform == "linux"
    _pool.cache_clear()


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="recon", initializer=one_of_several)


def one_of_several() -> None:
    """Have this thread share nothing from now on, as several work already, and stand back where they do."""
    _inside.pool = True
    if _stands_back:
        with suppress(OSError):  # where a sandbox has no priorities, all stay equal
            least = os.getpriority(os.PRIO_PROCESS, os.getpid()) + _STEP_BACK
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), least)


def threads_here() -> int:
    """Return how many threads a transform may use that is asked for by this one."""
    return 1 if getattr(_inside, "pool", False) else _threads


if hasattr(os, "register_at_fork"):  # a forked child has the pool but not its threads
    os.register_at_fork(after_in_child=_pool.cache_clear)


def in_blocks(kernel: Callable[[int, int], object], length: int, *, grain: int = 1) -> None:
    """Call ``kernel(start, stop)`` on contiguous blocks that together cover ``range(length)``.

    Called from inside a block, it does all of it on the thread it is on (waiting for the pool from within the
    pool would never end).

    Parameters
    ----------
    kernel : callable
        Must release the interpreter lock to gain anything, and write only what belongs to its block.
    length : int
        Number of rows (or planes) to cover.
    grain : int
        Smallest block worth a thread.
    """
    blocks = min(_threads, max(length // max(grain, 1), 1))
    if blocks <= 1 or getattr(_inside, "pool", False):
        kernel(0, length)
        return
    edges = [length * i // blocks for i in range(blocks + 1)]
    with _lock:
        pool = _pool(_threads)
    own = 0 if _stands_back else 1
    others = [pool.submit(kernel, edges[i], edges[i + 1]) for i in range(own, blocks)]
    if own:
        kernel(edges[0], edges[1])
    for other in others:
        other.result()


def over_rows(kernel: Callable[..., object], first: Sized, *args: object) -> None:
    """Run ``kernel(start, stop, first, *args)`` over the rows of its first array, shared among threads."""
    in_blocks(lambda start, stop: kernel(start, stop, first, *args), len(first))


class _LinearAlgebra:
    """Who wants it on one thread, and what the libraries had before the first of them."""

    users = 0
    before: Any = None


@lru_cache(maxsize=1)
def _libraries() -> Any:
    import scipy.linalg  # noqa: F401 # brings its own library, which must be there to be found
    from threadpoolctl import ThreadpoolController

    return ThreadpoolController()


@contextmanager
def linear_algebra_on_one_thread() -> Iterator[None]:
    """Keep BLAS and LAPACK to one thread within a block or a decorated function, in the whole process.

    For 100 small factorisations on two cores that others use, two threads took 10 times the processor time.
    What was set before is back when the last of those who asked has ended.
    """
    libraries = _libraries()
    with _lock:
        if not _LinearAlgebra.users:
            _let_anyone_set(libraries)
            _LinearAlgebra.before = libraries.limit(limits=1, user_api="blas")
        _LinearAlgebra.users += 1
    try:
        yield
    finally:
        with _lock:
            _LinearAlgebra.users -= 1
            if not _LinearAlgebra.users:
                _let_anyone_set(libraries)
                _LinearAlgebra.before.restore_original_limits()
                _let_anyone_set(libraries)


def _let_anyone_set(libraries: Any) -> None:
    """Have libraries listen to this thread, which may be another than the one that they listened to last.

    They go on listening to whoever set anything, and to nobody else, as long as that thread lives.
    """
    for library in libraries.lib_controllers:
        if hasattr(library, "clear_controlling_thread"):
            library.clear_controlling_thread(force=True)
