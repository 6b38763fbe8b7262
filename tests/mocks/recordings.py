"""Recordings made of given frames, as the recorder would have left them."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from drivers.frame import FrameMetadata
from instrument.plan import Plan
from instrument.runs.log import Gap
from instrument.runs.run import FinishReason
from instrument.runs.writer import BenchRecord, FrameToStore, RunWriter

BENCH = BenchRecord(
    {"bench": {"name": "b"}},
    '[bench]\nname = "b"\n',
    {"camera": "mock"},
    True,
    6.5,
    {"exposure_ms": 1.0, "gain": 1.0},
    {},
)


def write_recording(
    parent: Path,
    frames: Mapping[int, np.ndarray],
    *,
    period_s: float = 0.04,
    led: str | Mapping[int, str] = "off",
    plan: Plan | None = None,
    saturated: float = 0.0,
    stage: Mapping[int, Mapping[str, float]] | None = None,
    pixel_format: str = "Mono12",
) -> Path:
    """Write frames, uint16, by their number; numbers left out are gaps. Returns the run's folder.

    With a plan they are the frames of its steps, and those left out are missing. ``led`` is the light of all,
    or of each; ``stage`` the position of each.
    """
    with RunWriter.create(parent, label="recording", bench=BENCH, plan=plan) as writer:
        expected = 0
        for index, image in frames.items():
            if index > expected and plan is None:
                writer.gap(Gap(expected, index - expected, 0))
            expected = index + 1
            now_ns = 10**9 + int(index * period_s * 1e9)
            metadata = FrameMetadata(
                frame_id=index,
                device_time_ns=now_ns,
                host_time_ns=now_ns,
                utc=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC),
                exposure_ms=10.0,
                gain=1.0,
                pixel_format=pixel_format,
                significant_bits=12,
                black_level=0.0,
                roi=(0, 0, *image.shape[:2]),
                binning=1,
                led_pattern=led if isinstance(led, str) else led[index],
                saturated_fraction=saturated,
                stage_position={} if stage is None else stage[index],
            )
            writer.write([FrameToStore(index, image.astype(np.uint16), metadata)])
        return writer.finish(FinishReason.COMPLETED).path
