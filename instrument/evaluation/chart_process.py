"""One setting of a chart in a process of its own: its memory is its own, and it may fail alone."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import forkserver, resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import ForkServerContext, SpawnContext
from pathlib import Path

from recon.errors import InputError
from recon.evaluation.scored import Curve, Named, Problem

_PRELOADED = [
    "instrument.evaluation.chart_process",
    "recon.evaluation.chart_reconstruction",
    "recon.evaluation.chart_hologram",
]
"""Imported once, in the process from which those of the settings are forked: seconds for each of them."""


def in_own_process(problem: Problem, setting: Named, limit_s: float) -> Curve | str:
    """Run one setting by itself; the reason where it cannot be run.

    The process ends when this one is interrupted or killed.
    """
    context = _context()
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, problem, setting, limit_s), daemon=True)
    process.start()
    theirs.close()
    try:
        found: Curve | str = ours.recv()
        process.join(5)
        return found
    except EOFError:
        process.join()
        return f"the process ended with status {process.exitcode} (out of memory?)"
    finally:
        if process.is_alive():
            process.terminate()
            process.join()
        ours.close()


def _context() -> ForkServerContext | SpawnContext:
    if sys.platform == "win32":
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(_PRELOADED)
    # The server inherits a blocked Ctrl-C: that is for this process, which gets it when it is unblocked.
    resource_tracker.ensure_running()  # the server's start would start it, and unblock too early
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        forkserver.ensure_running()
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    return context


def _work(pipe: Connection, problem: Problem, setting: Named, limit_s: float) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's: it ends this process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        # First in small: libraries and compiled kernels are loaded, and no memory is left lying about that
        # the run would take without its showing.
        problem.warm_up(setting)
        meter = MemoryMeter()
        curve = problem.run(setting, limit_s=limit_s, aside=meter.aside)
        peak = meter.peak_mib()
        pipe.send(replace(curve, points=tuple(replace(p, peak_mib=peak) for p in curve.points)))
    except InputError as error:
        pipe.send(str(error))
    except MemoryError:
        pipe.send("there is not enough memory")
    except Exception as error:  # noqa: BLE001 (whatever it is concerns this setting alone, and is told in its row)
        pipe.send(f"{type(error).__name__}: {error}")
    finally:
        pipe.close()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


class MemoryMeter:
    """Measures the most memory that this process took at a time since the meter was made, in MiB.

    NaN where the system does not say (it is Linux that does).
    """

    def __init__(self) -> None:
        self._before = _reset_peak_mib()
        self._most = 0.0

    def peak_mib(self) -> float:
        """Return the most so far beyond what was taken at the start, without what was taken aside."""
        return max(self._most, _status_mib("VmHWM") - self._before)

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Do something whose memory does not count, nor what it leaves behind."""
        self._most = self.peak_mib()
        present = _status_mib("VmRSS")
        try:
            yield
        finally:
            self._before += _reset_peak_mib() - present


def _reset_peak_mib() -> float:
    """Forget the highest memory so far; return what is taken now, MiB (NaN where the system does not say)."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return float("nan")
    return _status_mib("VmHWM")


def _status_mib(name: str) -> float:
    status = Path("/proc/self/status")
    if not status.exists():
        return float("nan")
    for line in status.read_text().splitlines():
        if line.startswith(name + ":"):
            return int(line.split()[1]) / 1024
    return float("nan")
