"""The run store: one folder a run, readable by others' tools, safe against crashes and power cuts."""

from instrument.store.frame_record import FrameRecord, Gap
from instrument.store.layout import FinishReason, RunCondition
from instrument.store.run import DamagedFrame, Run, RunError
from instrument.store.writer import BenchRecord, FrameToStore, RunWriter

__all__ = [
    "BenchRecord",
    "DamagedFrame",
    "FinishReason",
    "FrameRecord",
    "FrameToStore",
    "Gap",
    "Run",
    "RunCondition",
    "RunError",
    "RunWriter",
]
