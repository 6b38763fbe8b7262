"""The live reconstruction of an open bench: the camera's newest frame in, a picture out."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from drivers.common.stream import FrameStream
from drivers.frame import Frame, FrameMetadata
from instrument.bench.bench import Bench
from instrument.files.calibration_file import find_calibration, load_calibration
from recon.reconstruction.options import ReconstructionOptions
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import LiveOptions, LivePicture
from recon.types import Calibration

_POLL_S = 0.25
_KEPT = 300
"""Pictures that the statistics reach back."""


@dataclass(frozen=True, slots=True)
class LiveResult:
    """A picture of the live view."""

    picture: LivePicture
    """With its quality in figures and words."""
    metadata: FrameMetadata
    """Of the frame it was made of (the newest one, where several were averaged)."""
    latency_ms: float
    """From the frame's arrival at the host to the picture. Of a picture refined while no newer frame came:
    how old the frame is."""
    passed_over: int
    """Frames that came and were not reconstructed since the result before."""
    refined: bool
    """Whether the same frame had a picture before this one."""


@dataclass(frozen=True, slots=True)
class LiveStatus:
    """How the live view does, over its last few hundred pictures; NaN before there are any.

    The first picture, during which the machine is timed, does not count.
    """

    pictures_per_s: float
    """Pictures of new frames."""
    latency_median_ms: float
    latency_p99_ms: float
    """``latency_median_ms`` and ``latency_p99_ms``: from a frame's arrival at the host to its picture."""
    pictures: int
    passed_over: int
    """``pictures`` and ``passed_over``: frames with a picture, and those without, since the start."""
    quality: str
    """Of the newest picture, in words; empty before the first."""
    warnings: tuple[str, ...]
    """What is doubtful about the calibration, and what pictures had to do without since."""


class LiveView:
    """Reconstructs a stream's newest frame, again and again, in a thread of its own.

    Nothing is queued: when a picture is done, the newest frame is next, and those in between are passed over
    and counted. A picture is therefore at most two budgets old: the one during which its frame came, and its
    own. Use as a context manager; ``newest``, ``wait_newer`` and ``status`` may be called from any thread.

    Parameters
    ----------
    stream : FrameStream
        Running, or not yet started: then the view starts it, and closes it at its own end.
    reconstructor : LiveReconstructor
        Belongs to the view while that runs.
    lit : callable, optional
        Tells from a frame's metadata whether something was lit, as of :meth:`LiveReconstructor.feed`.
    """

    def __init__(
        self,
        stream: FrameStream,
        reconstructor: LiveReconstructor,
        lit: Callable[[FrameMetadata], bool] = lambda _: True,
    ) -> None:
        self._lit = lit
        self.stream = stream
        self.reconstructor = reconstructor
        self._changed = threading.Condition()
        self._newest: LiveResult | None = None
        self._error: Exception | None = None
        self._ending = False
        self._finished = False
        self._owns_stream = False
        self._thread: threading.Thread | None = None
        self._done: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        """(moment in seconds, latency in ms) of the last pictures of new frames."""
        self._pictures = self._passed_over = 0

    # Starting and ending ---------------------------------------------------------------------------
    def start(self) -> Self:
        """Begin; the first picture takes longer, see :meth:`LiveReconstructor.feed`."""
        self._reader = self.stream.reader()
        if not self.stream.is_running:
            self.stream.start()
            self._owns_stream = True
        self._thread = threading.Thread(target=self._work, name="live reconstruction", daemon=True)
        self._thread.start()
        return self

    def end(self) -> None:
        """Ask the view to end after the picture in progress; returns at once."""
        with self._changed:
            self._ending = True

    def close(self) -> None:
        """End the view; the stream too, if the view started it. Closing twice does nothing.

        Raises DeviceError or InputError: what ended the view before.
        """
        self.end()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
            if self._owns_stream:
                self.stream.close()
            if self._error is not None:
                raise self._error

    def __enter__(self) -> Self:
        return self if self._thread is not None else self.start()

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc is None:
            self.close()
            return
        try:
            self.close()
        except Exception as error:  # noqa: BLE001 - the error on its way out is the one to be told
            exc.add_note(f"The live view had failed as well: {error}")

    # Pictures --------------------------------------------------------------------------------------
    @property
    def is_running(self) -> bool:
        """Whether more pictures may come."""
        return self._thread is not None and not self._finished

    def newest(self) -> LiveResult | None:
        """Return the newest picture, at once; None before the first."""
        with self._changed:
            return self._newest

    def wait_newer(self, than: LiveResult | None, timeout_s: float) -> LiveResult | None:
        """Return the newest picture as soon as it is another than ``than``; None when none came in time.

        Raises DeviceError or InputError when the camera failed, or its frames do not fit the calibration.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._newest is not than or not self.is_running, timeout_s)
            if self._newest is not than:
                return self._newest
        if self._error is not None:
            raise self._error
        return None

    def __iter__(self) -> Iterator[LiveResult]:
        """Yield pictures, always the newest, until the view ends; starts the view if need be."""
        with self:
            seen: LiveResult | None = None
            while True:
                newer = self.wait_newer(seen, _POLL_S)
                if newer is not None:
                    seen = newer
                    yield newer
                elif not self.is_running:
                    return

    @property
    def status(self) -> LiveStatus:
        """How the view does."""
        with self._changed:
            done, newest = list(self._done), self._newest
            pictures, passed_over = self._pictures, self._passed_over
        latencies = np.array([latency for _, latency in done])
        span_s = done[-1][0] - done[0][0] if len(done) > 1 else np.nan
        return LiveStatus(
            pictures_per_s=(len(done) - 1) / span_s if span_s > 0 else float("nan"),
            latency_median_ms=float(np.median(latencies)) if done else float("nan"),
            latency_p99_ms=float(np.percentile(latencies, 99)) if done else float("nan"),
            pictures=pictures,
            passed_over=passed_over,
            quality="" if newest is None else newest.picture.quality,
            warnings=self.reconstructor.warnings,
        )

    # The worker ------------------------------------------------------------------------------------
    def _work(self) -> None:
        frame: Frame | None = None
        refinable = False
        try:
            while not self._ending:
                self._reader.skip_to_newest()
                newer = self._reader.next_frame(0.0 if refinable else _POLL_S)
                if newer is not None:
                    frame = newer
                    picture = self.reconstructor.feed(frame.image, lit=self._lit(frame.metadata))
                    self._publish(picture, frame, newer.metadata.dropped_before)
                    refinable = True
                elif refinable and frame is not None:
                    refined = self.reconstructor.refine(self._is_wanted_elsewhere)
                    refinable = refined is not None
                    if refined is not None:
                        self._publish(refined, frame, None)
                elif not self._reader.is_running:
                    return
        except Exception as error:  # noqa: BLE001 - raised to whoever waits for pictures, and by close
            self._error = error
        finally:
            with self._changed:
                self._finished = True
                self._changed.notify_all()

    def _is_wanted_elsewhere(self) -> bool:
        """Whether a frame waits, or the end."""
        return self._ending or self._reader.status.waiting > 0

    def _publish(self, picture: LivePicture, frame: Frame, passed_over: int | None) -> None:
        """Hand out a picture; ``passed_over`` is None for a refined one."""
        now_ns = time.monotonic_ns()
        latency_ms = (now_ns - frame.metadata.host_time_ns) / 1e6
        with self._changed:
            if passed_over is not None:
                self._pictures += 1
                self._passed_over += passed_over
                if self._pictures > 1:
                    self._done.append((now_ns / 1e9, latency_ms))
            self._newest = LiveResult(
                picture, frame.metadata, latency_ms, passed_over or 0, refined=passed_over is None
            )
            self._changed.notify_all()


def live_view(
    bench: Bench,
    calibration: Calibration | Path | str,
    options: ReconstructionOptions | None = None,
    live: LiveOptions | None = None,
    *,
    n_buffers: int = 4,
    **overrides: Any,
) -> LiveView:
    """Return a live reconstruction of a bench's camera, to be used as a context manager.

    ::

        with live_view(bench, "calibration", prior="l1", budget_ms=33) as live:
            for result in live:
                show(result.picture.image, result.picture.quality)

    Raises FileError or InputError when the calibration or an option cannot be used.

    Parameters
    ----------
    bench : Bench
        Open.
    calibration : Calibration or path
        A calibration, its folder, or the run that it was made of.
    options, live, **overrides
        As of :class:`recon.streams.live.LiveReconstructor`.
    n_buffers : int
        Frames that the camera's ring holds.
    """
    if not isinstance(calibration, Calibration):
        calibration = load_calibration(find_calibration(Path(calibration)))
    return LiveView(
        bench.camera.stream(n_buffers), LiveReconstructor(calibration, options, live, **overrides)
    )
