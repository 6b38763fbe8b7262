"""Pictures of a running camera: each frame's within a budget of time, at the quality that fits into it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.checks import as_channels, check_psf, require_finite, select_psf
from recon.errors import InputError
from recon.live.level import Array, Floats, Level, binned
from recon.live.pace import Cost, Pace
from recon.live.stillness import SceneState, SceneWatch
from recon.noise import NoiseModel
from recon.types import Calibration

LEAST_SIDE = 16
"""Pixels of a picture's short side below which no binning goes."""

SETTLED = 1e-3
"""Change an iteration below which a frame's picture is done: 55 dB from where it would end."""


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
    one before (:class:`instrument.live.LiveView` does). Where the machine is too slow, pictures get coarser
    (binning) and then rougher (fewer iterations, at last a Wiener filter), and say so; they do not get late.

    While the scene is still, frames are averaged and iterations go on from frame to frame, so that the
    picture converges. While it moves, they go on from the picture before. After a cut, they begin anew.

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
        self.warnings = check_psf(self._psfs)
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
        self._pace = Pace(fine_enough or [finest])
        self._level: Level | None = None
        self._watch = SceneWatch(average)
        self._shape: tuple[int, ...] = ()
        self._scene = SceneState.NEW
        self._follows = False
        """Whether the solver knows the scene as it was a frame ago."""
        self._settled = False

    # Pictures --------------------------------------------------------------------------------------
    def feed(self, image: Array) -> LivePicture:
        """Return a picture of a frame.

        The first takes longer, as the machine is timed at one binning after the other; so does a change of
        binning (tenths of a second on a megapixel), and, a little, the first of a new scene.

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
        began_s = time.perf_counter()
        frame = self._on_calibration_pixels(image)
        level = self._level_for(frame)
        cost = self._pace.cost(level.binning)
        small = binned(frame, level.binning)
        self._scene = self._watch.see(small)
        affordable = self._pace.affordable(level.binning, self.budget_ms)
        if affordable < 1 and self._scene is not SceneState.STILL:
            self._follows = self._settled = False
            picture = self._told(level, "wiener", level.filtered(small), 0, 0, began_s)
            self._pace.learn(picture.work_ms, cost.fixed_ms + cost.filter_ms)
            return picture
        anew = self._scene is SceneState.NEW or not self._follows
        data = level.data(self._watch.mean)
        if anew:
            level.solver.restart(data)
        else:
            level.solver.set_data(data)
        self._follows = True
        done = self._iterate(level, began_s, max(affordable, 1), lambda: False)
        picture = self._told(level, "admm", level.solved(), done, level.solver.iteration, began_s)
        if not anew:
            self._pace.learn(picture.work_ms, cost.fixed_ms + done * cost.step_ms)
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
        level = self._level
        if level is None or self._settled or not self._follows:
            return None
        began_s = time.perf_counter()
        done = self._iterate(level, began_s, None, newer)
        return self._told(level, "admm", level.solved(), done, level.solver.iteration, began_s)

    def restart(self) -> None:
        """Forget the scene, the machine's timing and the noise: the next frame is the first."""
        self._level = None
        self._pace = Pace(self._pace.levels)
        self._shape = ()

    # Pieces ----------------------------------------------------------------------------------------
    def _iterate(self, level: Level, began_s: float, at_most: int | None, newer: Callable[[], bool]) -> int:
        """Do one iteration, and more while they fit into the budget; return how many."""
        cost = self._pace.cost(level.binning)
        done = 0
        while True:
            change = level.solver.advance().change
            done += 1
            self._settled = change < SETTLED
            ahead_ms = self._pace.busy * (cost.step_ms + 0.5 * cost.fixed_ms)
            spent_ms = 1e3 * (time.perf_counter() - began_s)
            if self._settled or done == at_most or spent_ms + ahead_ms > self.budget_ms or newer():
                return done

    def _level_for(self, frame: Floats) -> Level:
        """Return the level for the next frame; a new one knows nothing of the scene."""
        if self._level is None:
            for binning in self._pace.levels:
                level = self._enter(binning, frame)
                if self._pace.fits(binning, self.budget_ms):
                    break
            return level
        wanted = self._pace.next_level(self._level.binning, self.budget_ms)
        return self._level if wanted == self._level.binning else self._enter(wanted, frame)

    def _enter(self, binning: int, frame: Floats) -> Level:
        """Make a level, and time it when it is the first time."""
        self._level = None  # its memory is needed
        small = binned(frame, binning)
        level = self._level = Level(self._psfs, binning, small, self._noise)
        if binning not in self._pace.costs:
            self._pace.costs[binning] = self._timed(level, frame)
        self._watch.forget()
        self._follows = False
        return level

    def _timed(self, level: Level, frame: Floats) -> Cost:
        """Time a picture's parts; of each the fastest of three, as other work on the machine only adds."""

        def fastest_ms(part: Callable[[], object]) -> float:
            times = []
            for _ in range(3):
                began_s = time.perf_counter()
                part()
                times.append(1e3 * (time.perf_counter() - began_s))
            return min(times)

        def all_but_iterations() -> None:
            watch = SceneWatch(2)
            small = binned(frame, level.binning)
            watch.see(small)
            watch.see(small)
            level.solver.set_data(level.data(watch.mean))
            level.solved()

        level.solver.advance()  # the first does more
        small = binned(frame, level.binning)
        return Cost(
            fixed_ms=fastest_ms(all_but_iterations),
            step_ms=fastest_ms(level.solver.advance),
            filter_ms=fastest_ms(lambda: level.filtered(small)),
        )

    def _on_calibration_pixels(self, image: Array) -> Floats:
        """Return a frame (n_channels, height, width) less background on the PSF's pixels."""
        image = np.asarray(image)
        if image.dtype.kind == "f":
            require_finite(image, "frame")
        if image.shape != self._shape:
            self._refuse_other_shape(image)
        factor = image.shape[0] // self._psfs.shape[1]
        frame = binned(_channels(image), factor)
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
        level: Level,
        method: Literal["admm", "wiener"],
        channels: Floats,
        done: int,
        total: int,
        began_s: float,
    ) -> LivePicture:
        image = channels[0] if len(self._shape) == 2 else np.ascontiguousarray(np.moveaxis(channels, 0, 2))
        return LivePicture(
            image=image,
            binning=level.binning,
            method=method,
            iterations=done,
            total_iterations=total,
            scene=self._scene,
            frames=self._watch.count if method == "admm" else 1,
            settled=self._settled,
            work_ms=1e3 * (time.perf_counter() - began_s),
            budget_ms=self.budget_ms,
        )


def _channels(image: Array) -> Array:
    """View an image (height, width[, n_channels]) with its channels first."""
    return image[None] if image.ndim == 2 else np.moveaxis(image, 2, 0)
