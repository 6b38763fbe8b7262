"""Pictures of a running camera: each frame's within a budget of time, at the quality that fits into it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.base.blocks import block_mean
from recon.base.checks import as_channels, check_psf, require_finite, select_psf
from recon.base.noise import NoiseModel
from recon.errors import InputError
from recon.streams.live_level import Array, ComingLevel, FilterLevel, Floats, Level
from recon.streams.pace import Pace, Spent
from recon.streams.stillness import SceneState, SceneWatch
from recon.types import Calibration

LEAST_SIDE = 16
"""Pixels of a picture's short side below which no binning goes."""

SETTLED = 1e-3
"""Change an iteration below which a frame's picture is done: 55 dB from where it would end."""

AT_ONCE = 150_000
"""Pixels of the first picture, at most: its filter is made and applied in about a tenth of a second."""

_POLL_S = 0.005

_Stamp = tuple[float, float]
"""Seconds on the clock, and of this thread's processor time."""


@dataclass(frozen=True, slots=True)
class LivePicture:
    """A picture, and what it is worth.

    Attributes
    ----------
    image : ndarray, float32, (height, width) or (height, width, n_channels)
        The part of the scene opposite to the sensor, on pixels binned ``binning x binning``; brightness does
        not depend on the binning.
    binning : int
    method : "admm" or "wiener"
    iterations : int
        Done for this picture; 0 for ``"wiener"``.
    total_iterations : int
        Since the solver last began anew; what it knew of the scene before a movement stays with it.
    scene : SceneState
        Whether the scene is new, moving or still.
    frames : int
        Frames averaged; 1 unless the scene is still.
    settled : bool
        Whether further iterations on these frames would change nothing that can be seen.
    work_ms : float
        Time that the picture took.
    budget_ms : float
        Time that it was allowed.
    """

    image: Floats
    binning: int
    method: Literal["admm", "wiener"]
    iterations: int
    total_iterations: int
    scene: SceneState
    frames: int
    settled: bool
    work_ms: float
    budget_ms: float

    @property
    def quality(self) -> str:
        """What the picture is worth, in words: ``"binned 2 x 2, 3 iterations (41 in all), moving"``."""
        pixels = "all pixels" if self.binning == 1 else f"binned {self.binning} x {self.binning}"
        steps = f"{self.iterations} iterations ({self.total_iterations} in all)"
        how = "Wiener filter" if self.method == "wiener" else steps
        scene = f"still, {self.frames} frames averaged" if self.frames > 1 else str(self.scene)
        return ", ".join((pixels, how, scene, *(("settled",) if self.settled else ())))


class LiveReconstructor:
    """Makes a picture of each frame that it is fed, in about ``budget_ms``.

    For one thread. It never waits and keeps no queue: feed it the newest frame whenever it is done with the
    one before (:class:`instrument.live.live.LiveView` does). Where the machine is too slow, pictures get
    coarser (binning) and then rougher (fewer iterations, at last a Wiener filter), and say so; they do not
    get late.

    The first picture of a scene is a Wiener filter's, at once; from the next on, or by :meth:`refine`, it is
    iterated. While the scene is still, frames are averaged and iterations go on from frame to frame, so that
    the picture converges. While it moves, they go on from the picture before. After a cut, they begin anew.
    Another binning is prepared in a thread of its own while pictures go on. One that finds no memory is told
    in ``warnings`` and not tried again until :meth:`restart`; pictures go on as they are.

    Parameters
    ----------
    calibration : Calibration or ndarray
        As of :func:`recon.reconstruct`. One PSF is used for the whole field.
    z_um : float, optional
        Depth of the scene, where there are several PSFs.
    background : array or number, optional
        Counts, subtracted from each frame; default: the calibration's background.
    noise : NoiseModel or float, optional
        The camera's noise, of one pixel, counts; default: estimated from the first frame.
    budget_ms : float
        Time for one picture. 33 keeps up with 30 frames a second. May be changed at any time.
    finest, coarsest : int
        Bounds of the binning.
    average : int
        Frames averaged at most while the scene is still.

    Attributes
    ----------
    warnings : tuple of str
        What is doubtful about the calibration, and what became of the pictures since.

    Raises
    ------
    InputError
        When the calibration or a setting is unusable.
    """

    def __init__(
        self,
        calibration: Calibration | npt.ArrayLike,
        *,
        z_um: float | None = None,
        background: npt.ArrayLike | None = None,
        noise: NoiseModel | float | None = None,
        budget_ms: float = 33.0,
        finest: int = 1,
        coarsest: int = 8,
        average: int = 8,
    ) -> None:
        if isinstance(calibration, Calibration):
            self._psfs, self.psf_z_um = select_psf(calibration, z_um)
            if background is None and calibration.background is not None:
                background = np.moveaxis(calibration.background, 0, -1)
        else:
            self._psfs, self.psf_z_um = as_channels(calibration, "PSF"), None
        self.warnings = self._doubts = check_psf(self._psfs)
        if not budget_ms > 0:
            raise InputError(f"budget_ms must be above 0, not {budget_ms}.")
        if not 1 <= finest <= coarsest:
            raise InputError(
                f"1 <= finest <= coarsest is expected; got finest {finest}, coarsest {coarsest}."
            )
        if average < 1:
            raise InputError(f"average must be 1 or more, not {average}.")
        self.budget_ms = budget_ms
        self._noise = noise
        self._background = None if background is None else self._like_psf(background)
        fine_enough = [b for b in range(finest, coarsest + 1) if min(self._psfs.shape[1:]) >= LEAST_SIDE * b]
        self._binnings = fine_enough or [finest]
        self._pace = Pace(self._binnings)
        self._level: FilterLevel | None = None
        self._coming: ComingLevel | None = None
        self._watch = SceneWatch(average)
        self._shape: tuple[int, ...] = ()
        self._scene = SceneState.NEW
        self._follows = False
        """Whether the solver knows the scene as it was a frame ago."""
        self._greeted = False
        """Whether the newest scene was shown by a Wiener filter already."""
        self._settled = False

    # Pictures --------------------------------------------------------------------------------------
    def feed(self, image: Array) -> LivePicture:
        """Return a picture of a frame.

        The first makes its filter, which takes about a tenth of a second; the first of another scene takes a
        little longer than others.

        Parameters
        ----------
        image : ndarray, (height, width) or (height, width, n_channels)
            Counts. Of the PSF's pixels, or of a whole multiple of them, which is then binned to them.

        Raises
        ------
        InputError
            When the image does not fit the PSF or the frames before, or is not finite; such a frame is left
            out, and the next goes on as if it had not been.
        """
        began = _now()
        frame = self._on_calibration_pixels(image)
        level = self._level_for(frame)
        small = block_mean(frame, level.binning)
        self._scene = self._watch.see(small)
        affordable = self._pace.affordable(level.binning, self.budget_ms)
        cut = self._scene is SceneState.NEW and not self._greeted
        too_slow = affordable < 1 and self._scene is not SceneState.STILL
        self._greeted = self._scene is SceneState.NEW
        if not isinstance(level, Level) or cut or too_slow:
            self._follows = self._settled = False
            filtered = level.filtered(self._watch.mean)
            if too_slow:
                self._pace.note_filter(_since(began))
            return self._told(level, "wiener", filtered, 0, 0, began)
        data = level.data(self._watch.mean)
        anew = self._scene is SceneState.NEW or not self._follows
        if anew:
            level.solver.restart(data)
        else:
            level.solver.set_data(data)
        self._follows = True
        done, steps = self._iterate(level, began, max(affordable, 1), lambda: False)
        picture = self._told(level, "admm", level.solved(), done, level.solver.iteration, began)
        after = _since(began)
        if not anew and self._coming is None:  # otherwise it tells nothing of the pictures to come
            fixed = Spent(after.wall_ms - steps.wall_ms, after.work_ms - steps.work_ms)
            self._pace.note(fixed, steps, done)
        return picture

    def refine(self, newer: Callable[[], bool] = lambda: False) -> LivePicture | None:
        """Go on with the frame fed last for another budget, while no newer one is there.

        Parameters
        ----------
        newer : callable
            Asked after each iteration; True ends the refinement.

        Returns
        -------
        LivePicture or None
            None when there is nothing to refine, or nothing more to gain.
        """
        if self._level is None or self._settled:
            return None
        level = self._solving_level(newer)
        if level is None:
            return None
        began = _now()
        if not self._follows:
            level.solver.restart(level.data(self._watch.mean))
            self._follows = True
        done, _ = self._iterate(level, began, None, newer)
        self._greeted = False
        return self._told(level, "admm", level.solved(), done, level.solver.iteration, began)

    def restart(self) -> None:
        """Forget the scene, the machine's timing and the noise: the next frame is the first."""
        self._level = self._coming = None
        self._pace = Pace(self._binnings)
        self.warnings = self._doubts
        self._shape = ()
        self._watch.forget()
        self._follows = self._greeted = self._settled = False

    # Pieces ----------------------------------------------------------------------------------------
    def _iterate(
        self, level: Level, began: _Stamp, at_most: int | None, newer: Callable[[], bool]
    ) -> tuple[int, Spent]:
        """Do one iteration, and more while they fit into the budget; return how many, and what they took."""
        cost = self._pace.cost(level.binning)
        ahead_ms = 0.0 if cost is None else cost.step.wall_ms + 0.5 * cost.fixed.wall_ms
        first = _now()
        done = 0
        while True:
            change = level.solver.advance().change
            done += 1
            self._settled = change < SETTLED
            spent_ms = _since(began).wall_ms
            if self._settled or done == at_most or spent_ms + ahead_ms > self.budget_ms or newer():
                return done, _since(first)

    def _level_for(self, frame: Floats) -> FilterLevel:
        """Return the level for the next frame: the one there is, until another is made."""
        if self._level is None:
            binning = self._first_binning()
            small = block_mean(frame, binning).copy()
            self._level = FilterLevel(self._psfs, binning, small, self._noise)
            self._pace.enter(binning)
            self._make(binning, small)
        elif self._coming is not None:
            if self._coming.wait(0):
                self._take_up(self._coming)
        elif not isinstance(self._level, Level):  # there was no memory for its solver
            coarser = next((b for b in self._pace.levels if b > self._level.binning), None)
            if coarser is not None:
                self._make(coarser, block_mean(frame, coarser).copy())
        elif (wanted := self._pace.next_level(self.budget_ms)) != self._level.binning:
            self._make(wanted, block_mean(frame, wanted).copy())
        return self._level

    def _first_binning(self) -> int:
        """Return the finest binning at which a first picture takes no time to speak of."""
        n_pixels = int(np.prod(self._psfs.shape[1:]))
        levels = self._pace.levels
        return next((b for b in levels if n_pixels <= AT_ONCE * b**2), levels[-1])

    def _make(self, binning: int, small: Floats) -> None:
        """Begin to make a level for a frame on its pixels."""
        self._coming = ComingLevel(binning, lambda: Level(self._psfs, binning, small, self._noise))

    def _solving_level(self, newer: Callable[[], bool]) -> Level | None:
        """Return the level in use once it has a solver; None when a newer frame comes first."""
        while not isinstance(self._level, Level):
            if self._coming is None:
                return None
            if self._coming.wait(_POLL_S):
                self._take_up(self._coming)
            elif newer():
                return None
        return self._level

    def _take_up(self, coming: ComingLevel) -> None:
        """Go on at the level that was made; without memory for it, at the one in use."""
        try:
            level = coming.result()
        except MemoryError:
            self._coming = None
            self._do_without(coming.binning)
        else:
            self._enter(level)

    def _do_without(self, binning: int) -> None:
        """Say that there is no memory for a binning, and give it up."""
        assert self._level is not None
        self._pace.give_up(binning)
        present = self._level.binning
        how = "go on" if isinstance(self._level, Level) else "are a Wiener filter's,"
        self.warnings = (
            *self.warnings,
            f"There was no memory to iterate pictures binned {binning} x {binning}: they {how} binned "
            f"{present} x {present}. End what else needs memory, then begin anew.",
        )

    def _enter(self, level: Level) -> None:
        """Go on at another level; one of other pixels knows nothing of the scene."""
        assert self._level is not None
        if level.binning != self._level.binning:
            self._watch.forget()
            self._greeted = True  # a scene already shown is iterated at once
            self._pace.enter(level.binning)
        self._level, self._coming = level, None
        self._follows = self._settled = False

    def _on_calibration_pixels(self, image: Array) -> Floats:
        """Return a frame (n_channels, height, width) less background on the PSF's pixels."""
        image = np.asarray(image)
        if image.dtype.kind == "f":
            require_finite(image, "frame")
        if image.shape != self._shape:
            self._refuse_other_shape(image)
        factor = image.shape[0] // self._psfs.shape[1]
        frame = block_mean(_channels(image), factor)
        if self._background is not None:
            frame = frame - self._background
        return frame

    def _like_psf(self, background: npt.ArrayLike) -> Floats:
        """Return a background, a number or an image, as (n_channels, height, width) or (1, 1, 1)."""
        if np.ndim(background) == 0:
            return np.full((1, 1, 1), background, np.float32)
        channels = as_channels(background, "background")
        if channels.shape[1:] != self._psfs.shape[1:]:
            raise InputError(
                f"The background has {channels.shape[1]} x {channels.shape[2]} pixels and the PSF "
                f"{self._psfs.shape[1]} x {self._psfs.shape[2]}: it must be on the PSF's pixels."
            )
        return channels

    def _refuse_other_shape(self, image: Array) -> None:
        if self._shape:
            raise InputError(
                f"A frame of {image.shape} came after frames of {self._shape}: call restart() after a change "
                "of the camera's region, binning or format."
            )
        if image.ndim not in (2, 3) or image.dtype.kind not in "uif":
            raise InputError(
                f"A frame must be (height, width[, n_channels]) of numbers, not {image.dtype} {image.shape}."
            )
        height, width = self._psfs.shape[1:]
        factor = image.shape[0] // height
        if factor < 1 or image.shape[:2] != (factor * height, factor * width):
            raise InputError(
                f"The frame has {image.shape[0]} x {image.shape[1]} pixels and the PSF {height} x {width}. "
                "Both must come from the same sensor area; the frame's pixels may be finer by a whole factor."
            )
        n_channels = image.shape[2] if image.ndim == 3 else 1
        for name, channels in (("PSF", self._psfs), ("background", self._background)):
            if channels is not None and len(channels) not in (1, n_channels):
                raise InputError(f"The frame has {n_channels} channels and the {name} {len(channels)}.")
        self._shape = image.shape

    def _told(
        self,
        level: FilterLevel,
        method: Literal["admm", "wiener"],
        channels: Floats,
        done: int,
        total: int,
        began: _Stamp,
    ) -> LivePicture:
        image = channels[0] if len(self._shape) == 2 else np.ascontiguousarray(np.moveaxis(channels, 0, 2))
        return LivePicture(
            image=image,
            binning=level.binning,
            method=method,
            iterations=done,
            total_iterations=total,
            scene=self._scene,
            frames=self._watch.count,
            settled=self._settled,
            work_ms=_since(began).wall_ms,
            budget_ms=self.budget_ms,
        )


def _now() -> _Stamp:
    return time.perf_counter(), time.thread_time()


def _since(began: _Stamp) -> Spent:
    wall_s, work_s = _now()
    return Spent(1e3 * (wall_s - began[0]), 1e3 * (work_s - began[1]))


def _channels(image: Array) -> Array:
    """View an image (height, width[, n_channels]) with its channels first."""
    return image[None] if image.ndim == 2 else np.moveaxis(image, 2, 0)
