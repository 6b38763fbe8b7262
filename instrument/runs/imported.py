"""A film that another program recorded becomes a recording, a run like the recorder's."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from drivers.frame import FrameMetadata
from instrument.bench.photograph import Progress
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile
from instrument.runs.run import FinishReason, Run
from instrument.runs.writer import BenchRecord, FrameToStore, RunWriter

_BATCH = 32
"""Frames that are synced to the disk together."""


@dataclass(frozen=True, kw_only=True)
class FilmFacts:
    """What has to be known of a film's frames; None: not said."""

    frames_per_s: float | None = None
    pixel_um: float | None = None
    """Of the sensor, as its frames are binned."""
    exposure_ms: float | None = None

    def of(self, film: ImageFile) -> FilmFacts:
        """Return the facts with what the film's file tells of those that are not said."""
        told = {name: _number(film.metadata.get(key)) for name, key in _KEYS.items()}
        if told["frames_per_s"] is not None:  # a period, as it is told
            told["frames_per_s"] = 1 / told["frames_per_s"]
        said = {name: value for name, value in vars_of(self).items() if value is not None}
        return FilmFacts(**{**told, **said})


_KEYS = {"frames_per_s": "frame_period_s", "pixel_um": "pixel_pitch_um", "exposure_ms": "exposure_ms"}


def vars_of(facts: FilmFacts) -> dict[str, float | None]:
    """Return the facts by their names."""
    return {each.name: getattr(facts, each.name) for each in dataclasses.fields(facts)}


def _number(value: Any) -> float | None:
    known = (
        isinstance(value, int | float) and not isinstance(value, bool) and np.isfinite(value) and value > 0
    )
    return float(value) if known else None


def import_film(
    film: ImageFile, folder: Path, label: str, facts: FilmFacts, on_progress: Progress | None = None
) -> Run:
    """Write a film's frames as a recording in a new folder within ``folder``.

    Raises BenchError when it is one image, or the time between frames or the pixels' size is not known;
    RunError when the folder cannot be written to.

    Parameters
    ----------
    film : ImageFile
        A stack; frames in their order.
    facts : FilmFacts
        What is said of it; what is not, its file tells. Where nothing tells the exposure it is taken to be
        as long as frames are apart.
    """
    if not film.is_stack or len(film.pixels) < 2:
        raise BenchError(f"{film.path} holds one image; a film has several.")
    known = facts.of(film)
    if known.frames_per_s is None:
        raise BenchError(f"{film.path} does not tell how fast its frames followed each other: give --fps.")
    if known.pixel_um is None:
        raise BenchError(f"{film.path} does not tell how large the camera's pixels are: give --pixel-um.")
    period_s = 1 / known.frames_per_s
    exposure_ms = 1e3 * period_s if known.exposure_ms is None else known.exposure_ms
    first = _metadata(film, exposure_ms)
    record = BenchRecord(
        config={"bench": {"name": f"imported from {film.path.name}"}},
        toml="",
        devices={"camera": f"imported from {film.path}"},
        simulated=film.is_simulated,
        pixel_pitch_um=known.pixel_um,
        camera={"exposure_ms": exposure_ms, "gain": first.gain},
        stage={},
    )
    with RunWriter.create(folder, label=label, bench=record) as writer:
        for start in range(0, len(film.pixels), _BATCH):
            indices = range(start, min(start + _BATCH, len(film.pixels)))
            writer.write([FrameToStore(i, film.pixels[i], _at(first, i, period_s)) for i in indices])
            if on_progress is not None:
                on_progress(indices.stop, len(film.pixels))
        return writer.finish(FinishReason.COMPLETED)


def _metadata(film: ImageFile, exposure_ms: float) -> FrameMetadata:
    """Return what is known of the first frame; of what its file does not tell, the least that is true."""
    told: Mapping[str, Any] = film.metadata
    bits = 8 if film.pixels.dtype == np.uint8 else 16
    said = told.get("significant_bits")
    bits = said if isinstance(said, int) and 0 < said <= bits else bits
    kind = "RGB" if film.pixels.ndim == 4 else "Mono"
    return FrameMetadata(
        frame_id=0,
        device_time_ns=None,
        host_time_ns=0,
        utc=datetime.fromtimestamp(film.path.stat().st_mtime, UTC),
        exposure_ms=exposure_ms,
        gain=_number(told.get("gain")) or 1.0,
        pixel_format=str(told.get("pixel_format") or f"{kind}{bits}"),
        significant_bits=bits,
        black_level=_number(told.get("black_level")) or 0.0,
        roi=(0, 0, *film.pixels.shape[1:3]),
        binning=1,
        led_pattern="unknown: imported",
    )


def _at(first: FrameMetadata, index: int, period_s: float) -> FrameMetadata:
    after_s = index * period_s
    return dataclasses.replace(
        first,
        frame_id=index,
        host_time_ns=round(after_s * 1e9),
        utc=first.utc + timedelta(seconds=after_s),
    )
