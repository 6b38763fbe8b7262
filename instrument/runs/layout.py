"""What a run folder consists of, and the words for what became of a run."""

from __future__ import annotations

from enum import StrEnum

PLAN, BENCH, PROVENANCE, STATE = "plan.json", "bench.json", "provenance.json", "state.json"
BENCH_TOML, LOG, FRAMES, LOCK = "bench.toml", "log.jsonl", "frames.ome.zarr", "lock"
SLM_IMAGES = "slm"


class FinishReason(StrEnum):
    """Why a run ended."""

    COMPLETED = "completed"
    """Every step was done."""
    ABORTED = "aborted"
    """Somebody ended it between two steps, or with Ctrl-C or SIGTERM."""
    STOPPED = "stopped"
    """STOP was pressed."""
    FAILED = "failed"
    """A device, the disk or the program failed."""


class RunCondition(StrEnum):
    """What a run folder is, seen from outside."""

    RUNNING = "running"
    """A program is writing to it now."""
    CRASHED = "crashed"
    """The program that wrote to it ended without finishing it (kill, power cut)."""
    COMPLETED = "completed"
    ABORTED = "aborted"
    STOPPED = "stopped"
    FAILED = "failed"
