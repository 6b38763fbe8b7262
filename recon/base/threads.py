"""The one place for threads: how many, and the pool that the element-wise kernels share.

FFTs and kernels both take their number of threads from here. Work is cut into blocks in a way that never
changes a result: every output element is computed whole by one thread, and sums are taken over fixed blocks
first. So results are equal to the last bit for any number of threads.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sized
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache

_lock = threading.Lock()
_inside = threading.local()
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


@lru_cache(maxsize=1)
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="recon", initializer=_mark_worker)


def _mark_worker() -> None:
    _inside.pool = True


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
    others = [pool.submit(kernel, edges[i], edges[i + 1]) for i in range(1, blocks)]
    kernel(edges[0], edges[1])
    for other in others:
        other.result()


def over_rows(kernel: Callable[..., object], first: Sized, *args: object) -> None:
    """Run ``kernel(start, stop, first, *args)`` over the rows of its first array, shared among threads."""
    in_blocks(lambda start, stop: kernel(start, stop, first, *args), len(first))
