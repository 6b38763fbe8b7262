"""Who solves a video's blocks: threads of this process, processes on this machine, or a Dask cluster.

Blocks do not depend on one another, so that all three give the same pictures (see
:mod:`recon.streams.video`).
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any

from instrument.files.errors import BenchError
from instrument.reconstruction.video_block import BlockReport, CancelledError, solve_block
from instrument.reconstruction.video_job import VideoJob
from recon.base.threads import get_threads, set_threads

Told = Callable[[BlockReport], object]
"""Called in the caller's thread after each block."""

_POLL_S = 0.2
CONNECT_S = 10
"""Seconds that a scheduler has to answer."""

_RETRIES = 3
"""Workers that may be lost over one block before the block is taken for the reason."""


def in_process(job: Path, output: Path, blocks: Sequence[int], told: Told, cancel: threading.Event) -> None:
    """Solve blocks in this process, on all cores: one block a thread, or all threads to the only block.

    With a prior over time, whose blocks take much memory, one after the other with all threads.

    Raises
    ------
    CancelledError
        When ``cancel`` was set; blocks in progress end after their frame.
    Exception
        What went wrong in a block; the others are ended.
    """
    cores = get_threads()
    together = VideoJob(job).plan.over_time is not None
    workers = 1 if together else max(1, min(cores, len(blocks)))
    failed = threading.Event()

    def ended() -> bool:
        return cancel.is_set() or failed.is_set()

    work = partial(solve_block, str(job), str(output), ended=ended)
    set_threads(cores // workers)
    try:
        with ThreadPoolExecutor(workers, thread_name_prefix="video") as pool:
            waiting = {pool.submit(work, block) for block in blocks}
            try:
                while waiting:
                    done, waiting = wait(waiting, _POLL_S, FIRST_COMPLETED)
                    for future in done:
                        told(future.result())
            finally:
                failed.set()
                for future in waiting:
                    future.cancel()
    finally:
        set_threads(cores)


def on_cluster(
    client: Any, job: Path, output: Path, blocks: Sequence[int], told: Told, cancel: threading.Event
) -> None:
    """Solve blocks on a Dask cluster whose workers see the same files; raises as :func:`in_process`.

    A block whose worker is lost is solved by another.
    """
    work = partial(solve_block, str(job), str(output), threads=1)
    # Not pure: a block is worked on again whatever the cluster has seen before.
    futures = [client.submit(work, block, pure=False, retries=_RETRIES) for block in blocks]
    left = set(futures)
    try:
        while left:
            finished = {future for future in left if future.done()}
            for future in finished:
                told(future.result())
            left -= finished
            if cancel.wait(_POLL_S):
                raise CancelledError
    finally:
        client.cancel(list(left))


@contextlib.contextmanager
def cluster(*, workers: int | None = None, scheduler: str | None = None) -> Iterator[Any]:
    """Give a client of a cluster: a new one of ``workers`` processes here, or that of a scheduler's address.

    Raises
    ------
    BenchError
        When Dask is not installed, or there is no scheduler at the address.
    """
    distributed = _dask()
    if scheduler is not None:
        with _client_of(distributed, scheduler) as client:
            yield client
        return
    with (
        distributed.LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
        ) as local,
        distributed.Client(local) as client,
    ):
        yield client


def require_crew(*, workers: int | None = None, scheduler: str | None = None) -> None:
    """Raise what :func:`cluster` would, before any work is begun; does nothing without a cluster."""
    if workers is None and scheduler is None:
        return
    distributed = _dask()
    if scheduler is not None:
        _client_of(distributed, scheduler).close()


def _dask() -> Any:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise BenchError(
            "Workers need Dask, which is not installed: pip install 'diffuserbench[cluster]'."
        ) from error
    # Its own configuration says INFO; silence_logs of a local cluster is taken back too early.
    logging.getLogger("distributed").setLevel(logging.WARNING)
    return distributed


def _client_of(distributed: Any, scheduler: str) -> Any:
    try:
        return distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError) as error:
        raise BenchError(
            f"No Dask scheduler answers at {scheduler}: {error}. Start one with 'dask scheduler', and "
            "workers that see the same files with 'dask worker ADDRESS'."
        ) from error
