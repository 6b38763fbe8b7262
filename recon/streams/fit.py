"""Whether calibration and model fit what a live camera sees, looked at beside the pictures."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from dataclasses import replace
from typing import NamedTuple

from recon.reconstruction.decoys import AMONG, check_calibration
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reduction import reduced_calibration
from recon.reconstruction.selection import with_background
from recon.streams.stillness import SceneState
from recon.types import Calibration

SHARE = 0.1
"""Part of the time that checks may take, at most."""
FIRST_S = 1.0
"""The first pictures have the machine to themselves."""
NOT_JUDGED = "The calibration is not judged yet"
"""Begins what is said of it until the first check of frames in a light has ended."""
TOLD = 0.05
"""Share of a check from which is said how long it takes."""
ROUNDED_S = (2, 5, 10, 20, 60)
"""Times that are told: others would change from picture to picture."""
AT = "it is held against turned and mirrored copies of itself"
MORE_FRAMES = 4
"""Factor in frames averaged from which a still scene may tell what it did not tell before."""


class CalibrationWatch:
    """Lets a calibration compete with its decoys on the newest picture's frames, in a thread of its own.

    A check takes about a second of one core. The next one comes when the scene has changed since, or is
    averaged over many more frames, and no sooner than a tenth of the time allows. What was found holds until
    then. Stray light that a photograph would have a background for is no fault of the calibration, and is
    said for itself: live pictures have none unless they are asked to, as it takes many times their time.

    Parameters
    ----------
    calibration : Calibration or None
        With all that it has of the pictures' depth; None for a PSF alone.

    Attributes
    ----------
    advice : str
        What pictures lack, in words; empty where nothing is known to.
    is_known : bool
        Whether a check of frames in this light has ended.
    """

    def __init__(self, calibration: Calibration | None = None) -> None:
        self._calibration = calibration
        self.advice = self._doubt = ""
        self.is_known = False
        self._running: Future[_Found] | None = None
        self._not_before = time.monotonic() + FIRST_S
        self._frames = 0
        """Averaged in the frames that were checked last; 0: they are another scene's."""
        self._stage = _Stage()

    def see(self, problem: Callable[[], Problem], binning: int, scene: SceneState, frames: int) -> None:
        """Take note of the newest picture; begin a check where one is due.

        Parameters
        ----------
        problem : callable
            Returns the picture's problem; only asked where a check begins.
        binning : int
            Of its pixels.
        scene : SceneState
        frames : int
            Averaged in it.
        """
        if scene is not SceneState.STILL:
            self._frames = 0
        self._look()
        if self._running is not None:
            return
        if time.monotonic() < self._not_before or (self._frames and frames < MORE_FRAMES * self._frames):
            return
        self._frames = frames
        posed = problem()
        pool = ThreadPoolExecutor(1, "calibration check")
        self._stage = _Stage()
        self._running = pool.submit(_found, posed, self._calibration, binning, self._stage)
        pool.shutdown(wait=False)

    def in_another_light(self) -> None:
        """Forget what was found: it is not of the frames to come, and they are looked at soon."""
        self._running, self._doubt, self.is_known = None, "", False
        self._frames, self._not_before = 0, time.monotonic() + FIRST_S

    def wait(self) -> None:
        """Wait until the check that runs is over."""
        if self._running is not None:
            wait((self._running,))

    @property
    def awaited(self) -> str:
        """That nothing is known of the calibration yet, what is looked at and for how long; else empty."""
        self._look()
        if self.is_known:
            return ""
        if self._running is None:
            return f"{NOT_JUDGED}: in a moment {AT}"
        return f"{NOT_JUDGED}: {self._stage.words}"

    @property
    def doubt(self) -> str:
        """Why the calibration may not be the pictures' own; empty where nothing speaks against it."""
        self._look()
        return self._doubt

    def _look(self) -> None:
        if self._running is not None and self._running.done():
            self._doubt, self.advice, seconds = self._running.result()
            self._running, self.is_known = None, True
            self._not_before = time.monotonic() + seconds * (1 / SHARE - 1)


class _Stage:
    """How far a check is."""

    def __init__(self) -> None:
        self._begun_s, self._reached = math.inf, (0.0, AMONG)

    def __call__(self, share: float, words: str) -> None:
        self._begun_s, self._reached = min(self._begun_s, time.monotonic()), (share, words)

    @property
    def words(self) -> str:
        """What is looked at, and about how long it takes, once that can be told."""
        share, words = self._reached
        at = AT if words == AMONG else f"{words.removeprefix('judging: ')} (looked at again)"
        if share < TOLD:
            return at
        left_s = (time.monotonic() - self._begun_s) * (1 - share) / share
        rounded = next((told for told in ROUNDED_S if left_s <= told), None)
        return f"{at}, " + ("over a minute more" if rounded is None else f"some {rounded} s more")


class _Found(NamedTuple):
    doubt: str
    advice: str
    seconds: float


def _found(problem: Problem, calibration: Calibration | None, binning: int, on_stage: Stage) -> _Found:
    """Look for stray light, then whether the calibration explains the rest."""
    began = time.monotonic()
    advice = ""
    try:
        if calibration is not None and not problem.smooth:
            # The quick solver of live pictures has no way for a background: that is no choice of anybody's.
            free = replace(problem, options=replace(problem.options, solver="auto"))
            calibration = reduced_calibration(calibration, binning, None)
            problem = with_background(free, calibration, restoring=False)
            if problem.smooth:
                advice = "There is smooth stray light: pictures would gain by a background (--background)."
        check = check_calibration(problem, on_stage=on_stage)
        doubt = "" if check is None else "".join(check.sentences[:1])
    except Exception as error:  # noqa: BLE001 - pictures are worth more than what is said of them
        doubt = f"whether the calibration fits could not be found out: {error}"
    return _Found(doubt[:1].upper() + doubt[1:], advice, time.monotonic() - began)
