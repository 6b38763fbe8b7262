"""At which of a calibration's depths the scene lies: found by the frames, unless somebody chose one."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from gui.jobs import Job
from gui.session import BenchSession
from instrument.live.light_log import NOTHING_LIT
from instrument.live.live import LiveResult
from recon.streams.live import LiveReconstructor
from recon.streams.live_picture import NOISE_ONLY


class DepthSeeker:
    """Looks for the depth that explains the newest frame best: with the first light, and at each new doubt.

    A scene at another depth than the one in use is no fault of the calibration, and nobody's mistake who has
    chosen none.

    Parameters
    ----------
    session : BenchSession
    found : callable
        Called with another depth than the one in use, um.
    """

    def __init__(self, session: BenchSession, found: Callable[[float], object]) -> None:
        self._session, self._found = session, found
        self._by_hand = False
        self._sought: set[str] = set()
        """By which doubts at this depth, their numbers left out; empty: not yet with this calibration."""
        self._at_um: float | None = None
        self._seen = ""
        """The newest picture's doubt, without its numbers."""
        self._words = ""
        self._job: Job | None = None

    def begin(self) -> None:
        """Look anew: another calibration is in use."""
        self._by_hand, self._sought, self._seen, self._job = False, set(), "", None

    def leave(self) -> None:
        """Leave it at what was chosen by hand."""
        self._by_hand, self._job = True, None

    @property
    def words(self) -> str:
        """What is said instead of the doubt while it is looked for, where that was not shown yet."""
        return "" if self._job is None else self._words

    def see(self, result: LiveResult, reconstructor: LiveReconstructor) -> None:
        """Take note of the newest picture; begin to look where that is due."""
        now_um, doubt, frame = reconstructor.options.z_um, result.picture.doubt, self._session.live.newest()
        idle = not self._by_hand and self._job is None and self._session.jobs.exclusive_job is None
        dark = doubt == NOISE_ONLY or self._session.lights.during(result.metadata) == NOTHING_LIT
        if now_um != self._at_um:
            self._at_um, self._sought = now_um, {""} if self._sought else set()
        kind = re.sub(r"[0-9.]+", "", doubt)  # numbers scatter from frame to frame
        shown, self._seen = bool(kind) and kind == self._seen, kind
        known = bool(self._sought) and kind in self._sought | {""}
        if now_um is None or frame is None or dark or known or not idle:
            return
        image = np.array(frame.image)  # a copy: the ring's buffer is wanted back
        self._sought.add(kind)
        self._words = "" if shown else "Which depth fits is being looked for"
        job = self._session.jobs.watch(
            "Looking for the depth that fits", lambda _: reconstructor.fitting_depth_um(image)
        )
        self._job = job
        job.succeeded.connect(lambda z_um: self._take(job, now_um, z_um))
        job.ended.connect(lambda: self._ended(job))

    def _take(self, job: Job, before_um: float, z_um: float | None) -> None:
        if job is self._job and z_um is not None and z_um != before_um:
            self._job = None
            self._session.log(
                "info",
                f"Live reconstruction: of the calibrated depths {z_um / 1e3:.4g} mm explains the scene best.",
            )
            self._found(z_um)

    def _ended(self, job: Job) -> None:
        if job is self._job:
            self._job = None
