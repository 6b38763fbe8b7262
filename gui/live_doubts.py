"""What is doubtful about a live picture: its frame's light and exposure, its calibration, its age."""

from __future__ import annotations

import time

from drivers.frame import FrameMetadata
from gui.session import BenchSession
from gui.words import with_signs
from instrument.bench.photograph import SPOILT
from instrument.files.errors import duration, percent
from instrument.live.light_log import NOTHING_LIT
from instrument.live.live import LiveResult

_PATIENCE_S = 1.5


class LiveDoubts:
    """Says what stands over a live picture; empty words where nothing is doubtful."""

    def __init__(self, session: BenchSession) -> None:
        self._session = session

    def of(self, result: LiveResult, depth_words: str) -> str:
        """Return what is doubtful, or not known yet, by a picture's pixels, its depth, and its frame."""
        of_pixels = result.picture.said
        if result.picture.doubt and self._session.lights.during(result.metadata) == NOTHING_LIT:
            return of_pixels  # which says it
        said = ". ".join(filter(None, (self.of_frame(result.metadata), depth_words or of_pixels)))
        return with_signs(said)

    def of_frame(self, frame: FrameMetadata) -> str:
        """Return what is doubtful about a frame: its light, its exposure."""
        if self._session.lights.during(frame) == NOTHING_LIT:
            return "Its frame was taken with nothing lit"
        if frame.saturated_fraction > SPOILT:
            return f"{percent(frame.saturated_fraction)} of its frame's pixels are saturated: expose shorter"
        return ""

    def of_silence(self, shown: LiveResult | None) -> str:
        """Say for how long no frame has come, where one should have; of the picture's own with no stream."""
        stream = self._session.live.stream
        if shown is None:
            return ""
        newest = None if stream is None else stream.newest()
        metadata = shown.metadata if newest is None else newest.metadata
        age_s = (time.monotonic_ns() - metadata.host_time_ns) / 1e9
        if stream is not None and age_s < _PATIENCE_S + 3e-3 * metadata.exposure_ms:
            return ""
        return f"no frame has come for {duration(age_s)}"
