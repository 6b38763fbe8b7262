"""Solving a video's blocks: in threads of this process, processes on this machine, or a Dask cluster.

Blocks do not depend on one another, so that all three give the same pictures (see
:mod:`recon.streams.video`).
"""

from __future__ import annotations

import contextlib
import importlib
import ipaddress
import logging
import os
import pwd
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from instrument.files.errors import BenchError, count
from instrument.reconstruction.options import VideoOptions
from instrument.reconstruction.video_files import VideoPictures
from instrument.reconstruction.video_job import VideoJob
from instrument.runs.run import Run
from instrument.runs.run_files import log_size
from recon.arrays import Float32Array
from recon.base.threads import get_threads, linear_algebra_on_one_thread, set_threads
from recon.solvers.memory import peak_resident_bytes
from recon.streams.joint import solve_together
from recon.streams.stillness import has_light
from recon.streams.video import VideoSolver

_log = logging.getLogger(__name__)
_kept = threading.local()
"""A thread's last job with its solver, whose arrays are dear to make."""


@dataclass(frozen=True, slots=True)
class BlockReport:
    """What a worker did: a block's number, how many frames it solved and wrote, and in how long.

    ``unlit`` is how many of its frames hold nothing but noise; ``frame_s`` when each was on the disk, since
    the block began; ``worker`` tells apart who solved; ``peak_bytes`` is the most memory of their program so
    far.
    """

    block: int
    solved: int
    written: int
    seconds: float
    unlit: int = 0
    frame_s: tuple[float, ...] = ()
    worker: str = ""
    peak_bytes: float = float("nan")


@lru_cache(maxsize=1)
def _opened(path: Path, _log_bytes: int) -> Run:
    """Return a run, read once as long as its log does not grow."""
    return Run.open(path)


class CancelledError(Exception):
    """The block was left unfinished because somebody wanted the end."""


@linear_algebra_on_one_thread()
def solve_block(
    job_folder: str,
    output: str,
    number: int,
    *,
    threads: int | None = None,
    ended: Callable[[], bool] = lambda: False,
) -> BlockReport:
    """Solve a block, write those of its pictures that are not there, and note that it is done.

    Runs anywhere where the recording and the output are under the same paths. Done already, it does nothing.

    Raises FileError or OSError when a file cannot be read or written; CancelledError.

    Parameters
    ----------
    job_folder, output : str
        The job's folder, and the OME-Zarr folder.
    number : int
        The block.
    threads : int, optional
        FFT and kernel threads of this process.
    ended : callable
        Asked before each frame; True ends the work.
    """
    began_s = time.perf_counter()
    if threads is not None:
        set_threads(threads)
    job = VideoJob(Path(job_folder))
    plan = job.plan
    if job.is_done(number):
        return BlockReport(number, 0, 0, time.perf_counter() - began_s)
    pictures = VideoPictures(Path(output), write=True)
    run = _opened(Path(plan.run), log_size(plan.run))
    block = job.blocks[number]
    together_in = None if len(block) == 1 else plan.over_time
    written = 0
    unlit = 0
    frame_s: list[float] = []

    def measured() -> Iterator[Float32Array]:
        nonlocal unlit
        reduction, deviation = job.reduction, job.problem.noise
        for index in block:
            frame = reduction.apply(run.frame(index))
            unlit += not has_light(frame, deviation)
            yield frame

    if together_in is None:
        job, solver = _solver_for(job)
        solver.begin()
        solved: Iterator[Float32Array] = map(solver.next, measured())
    else:
        stack = np.stack(list(measured()))
        together = solve_together(
            job.problem, stack, together_in, iterations=plan.cold_iterations, ended=ended
        )
        solved = iter([] if together is None else together)
    for index in block:
        picture = None if ended() else next(solved, None)
        if picture is None:
            raise CancelledError
        if not pictures.is_written(index):
            rows = int(job.problem.n_planes > 1)
            turned = np.rot90(picture, plan.rotate_deg // 90, (rows, rows + 1))
            pictures.write(index, np.ascontiguousarray(turned))
            written += 1
        frame_s.append(time.perf_counter() - began_s)
    job.mark_done(number, unlit)
    worker = f"{socket.gethostname()} {os.getpid()} {threading.get_ident()}"
    return BlockReport(
        number,
        len(block),
        written,
        time.perf_counter() - began_s,
        unlit,
        tuple(frame_s),
        worker,
        peak_resident_bytes(),
    )


def _solver_for(job: VideoJob) -> tuple[VideoJob, VideoSolver]:
    kept: tuple[VideoJob, VideoSolver] | None = getattr(_kept, "value", None)
    if kept is not None:
        if (kept[0].folder, kept[0].plan) == (job.folder, job.plan):
            return kept
        kept[1].close()
    kept = _kept.value = None  # its memory is needed
    plan = job.plan
    solver = VideoSolver(
        job.problem,
        cold_iterations=plan.cold_iterations,
        warm_iterations=plan.warm_iterations,
        times_noise=job.times_noise,
    )
    _kept.value = job, solver
    return job, solver


OnBlock = Callable[[BlockReport], object]
"""Called in the caller's thread after each block."""

_POLL_S = 0.2
CONNECT_S = 10
"""Seconds that a scheduler has to answer."""

_RETRIES = 3
"""Workers that may be lost over one block before the block is taken for the reason."""


def in_process(
    job: Path, output: Path, blocks: Sequence[int], on_progress: OnBlock, cancel: threading.Event
) -> None:
    """Solve blocks in this process, on all cores: one block a thread, or all threads to the only block.

    With a prior over time, whose blocks take much memory, one after the other with all threads.

    Raises CancelledError when ``cancel`` was set; blocks in progress end after their frame. Raises Exception:
    what went wrong in a block; the others are ended.
    """
    cores = get_threads()
    together = VideoJob(job).plan.over_time is not None
    workers = at_once(len(blocks), VideoOptions(), together=together)
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
                        on_progress(future.result())
            finally:
                failed.set()
                for future in waiting:
                    future.cancel()
    finally:
        set_threads(cores)


def at_once(blocks: int, video: VideoOptions, *, together: bool) -> int:
    """Return how many blocks are solved at a time; errors as of :func:`cluster`.

    ``together``: frames of a block are, with a prior over time.
    """
    if video.workers is not None:
        return video.workers
    if video.scheduler is not None:
        with _client_of(_dask(), video.scheduler, video.scheduler_owner) as client:
            return max(sum(_crew(client).values()), 1)
    return 1 if together else max(1, min(get_threads(), blocks))


def on_cluster(
    client: Any,
    job: Path,
    output: Path,
    blocks: Sequence[int],
    on_progress: OnBlock,
    cancel: threading.Event,
    on_lost: Callable[[int], object] = lambda _: None,
) -> None:
    """Solve blocks on a Dask cluster whose workers see the same files; raises as :func:`in_process`.

    A block whose worker is lost is solved by another; the loss is logged, and ``on_lost`` told how many were.
    Raises BenchError where every worker that took a block was lost, or the scheduler, or other programs are
    installed there.
    """
    work = partial(solve_block, str(job), str(output), threads=1)
    # Not pure: a block is worked on again whatever the cluster has seen before.
    futures = [client.submit(work, block, pure=False, retries=_RETRIES) for block in blocks]
    left = set(futures)
    crew: set[str] = set()
    try:
        while left:
            here = set(_crew(client))
            if lost := len(crew - here):
                _log.warning(
                    "%s ended or cannot be reached: blocks begun there begin anew on another. Where it "
                    "happens again, memory may be short: take fewer.",
                    count(lost, "worker"),
                )
                on_lost(lost)
            crew = here
            finished = {future for future in left if future.done()}
            for future in finished:
                try:
                    on_progress(future.result())
                except importlib.import_module("distributed").KilledWorker:
                    raise BenchError(
                        "Every worker that took one of the blocks was lost, as when memory is short. Take "
                        "fewer workers or shorter blocks (--workers, --block); the same command goes on."
                    ) from None
                except (ImportError, RuntimeError) as error:
                    if not isinstance(error, ImportError) and "deserialization" not in str(error):
                        raise
                    reason = error if error.__cause__ is None else error.__cause__
                    raise BenchError(
                        f"The scheduler or a worker cannot read what it is given: {reason}. Start both with "
                        "the Python that diffuserbench is installed in, of the same version as here."
                    ) from error
            left -= finished
            if cancel.wait(_POLL_S):
                raise CancelledError
    finally:
        client.cancel(list(left))


def _crew(client: Any) -> dict[str, int]:
    """Return the threads of each worker that a cluster has now, by its address.

    The client's ``scheduler_info`` also keeps the answer to a question of its own, every two seconds and
    without the workers: on a busy machine it gave that one, as if all of them had been lost.

    Raises BenchError where the scheduler is gone.
    """
    try:
        crew: dict[str, int] = client.nthreads()
    except OSError as error:
        raise BenchError(
            "The cluster's scheduler ended or can no longer be reached. Blocks that are done are kept: start "
            "it again, and the same command goes on."
        ) from error
    return crew


@contextlib.contextmanager
def cluster(
    *, workers: int | None = None, scheduler: str | None = None, owner: str | None = None
) -> Iterator[Any]:
    """Give a client of a cluster: a new one of ``workers`` processes here, or that of a scheduler's address.

    The new one listens on this machine's loopback only, and speaks with nobody who does not hold the keys
    that are made for it and kept in memory (TLS, both sides). A scheduler is spoken with when it is known
    whose it is (:func:`_require_owner`).

    Raises BenchError when Dask is not installed, there is no scheduler at the address, or it is another's.
    """
    distributed = _dask()
    if scheduler is not None:
        with _client_of(distributed, scheduler, owner) as client:
            yield client
        return
    try:
        security = distributed.Security.temporary()
    except ImportError as error:
        raise BenchError(
            "Workers need keys that keep others out, and the package cryptography, which makes them, is not "
            "installed: pip install 'diffuserbench[cluster]'."
        ) from error
    # Their HTTP servers ask nobody who they are: they show nothing.
    no_pages: dict[str, list[str]] = {f"distributed.{who}.http.routes": [] for who in ("scheduler", "worker")}
    with (
        importlib.import_module("dask.config").set(no_pages),
        distributed.LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            protocol="tls://",
            security=security,
            dashboard_address=None,
            scheduler_kwargs={
                "dashboard_address": "127.0.0.1:0"
            },  # else 8787, which another cluster may have
            silence_logs=50,
        ) as local,
        distributed.Client(local) as client,
    ):
        yield client


def require_crew(
    *, workers: int | None = None, scheduler: str | None = None, owner: str | None = None
) -> None:
    """Raise what :func:`cluster` would, before any work is begun; does nothing without a cluster."""
    if workers is None and scheduler is None:
        return
    distributed = _dask()
    if scheduler is not None:
        _client_of(distributed, scheduler, owner).close()


def _dask() -> Any:
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise BenchError(
            "Workers need Dask, which is not installed: pip install 'diffuserbench[cluster]'."
        ) from error
    # Its own configuration says INFO; silence_logs of a local cluster is taken back too early. What becomes
    # of workers is told in our own words.
    logging.getLogger("distributed").setLevel(logging.WARNING)
    logging.getLogger("distributed.nanny").setLevel(logging.ERROR)
    # A result that was lost with its worker before it was fetched is an error there, and is made again.
    for quiet in ("client", "scheduler"):
        logging.getLogger(f"distributed.{quiet}").setLevel(logging.CRITICAL)
    return distributed


def _client_of(distributed: Any, scheduler: str, owner: str | None) -> Any:
    _require_owner(scheduler, owner)
    try:
        return distributed.Client(scheduler, timeout=CONNECT_S)
    except (OSError, ValueError, TypeError, RuntimeError) as error:
        raise _no_scheduler(scheduler, str(error)) from error


def _no_scheduler(scheduler: str, found: str) -> BenchError:
    return BenchError(
        f"No Dask scheduler answers at {scheduler}: {found}. Start one with "
        "'dask scheduler --host 127.0.0.1', and workers that see the same files with 'dask worker ADDRESS'."
    )


def _require_owner(scheduler: str, owner: str | None) -> None:
    """Refuse a scheduler that is another's or may be, unless ``owner`` names whose it is.

    Who has a scheduler can run anything in the programs that speak with it. With ``tls://`` Dask's own
    configuration says which certificates both sides need. Of a port of this machine the kernel says whose it
    is (``/proc/net/tcp``). Of any other address nothing does.

    Raises BenchError.
    """
    url = urlsplit(scheduler if "://" in scheduler else f"tcp://{scheduler}")
    try:
        host, port = url.hostname, url.port
    except ValueError as error:
        raise _no_scheduler(scheduler, str(error)) from error
    if host is None or port is None:
        raise _no_scheduler(scheduler, "an address has the form tcp://HOST:PORT")
    if url.scheme == "tls":
        return
    users: set[str] = set()
    if host == "localhost" or _is_loopback(host):
        users = _listening(port)
        if not users:
            raise _no_scheduler(scheduler, f"nothing of this machine listens at port {port}")
        if users == {_user(os.getuid())} and owner is None:
            return
    if owner is None or (users and users != {owner}):
        of = f"{' and '.join(sorted(users))}'s" if users else "one that nothing says the owner of"
        named = f", not {owner}'s" if owner is not None else ""
        raise BenchError(
            f"The scheduler at {scheduler} is {of}{named}, and who has it can run programs in your name. "
            "Use one of your own, or tls:// with certificates in Dask's configuration, or name whom you "
            "trust with --scheduler-owner NAME."
        )


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def _listening(port: int) -> set[str]:
    """Return the users whose programs listen at a TCP port of this machine."""
    users = set()
    for table in ("tcp", "tcp6"):
        with contextlib.suppress(FileNotFoundError):  # not Linux, or without IPv6
            for line in Path("/proc/net", table).read_text().splitlines()[1:]:
                _, local, _, state, _, _, _, uid, *_ = line.split()
                if state == _LISTEN and int(local.rsplit(":", 1)[1], 16) == port:
                    users.add(_user(int(uid)))
    return users


_LISTEN = "0A"
"""``TCP_LISTEN`` of the kernel's tables."""


def _user(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)
