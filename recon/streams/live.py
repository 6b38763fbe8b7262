"""Pictures of a running camera: each frame's within a budget of time, at the quality that fits into it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.base.checks import as_channels, require_finite
from recon.base.declare import inapplicable, with_overrides
from recon.camera.camera_model import members_of_depths
from recon.errors import InputError
from recon.reconstruction.decoys import fitting_depth
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import given, reconstruct
from recon.reconstruction.reduction import on_blocks, reduced_calibration
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.solve import Progress
from recon.streams.detail import Detail, ladder
from recon.streams.fit import CalibrationWatch
from recon.streams.live_picture import (
    DARK,
    NOISE_ONLY,
    UNLIT,
    UNLIT_SO_FAR,
    ComingLevel,
    Level,
    LiveOptions,
    LivePicture,
)
from recon.streams.pace import Pace, Spent
from recon.streams.stillness import SceneState, SceneWatch
from recon.streams.video import require_steps, stream_problem
from recon.types import Calibration, real_array

LEAST_SIDE = 16
"""Pixels of a picture's short side below which no binning goes."""
AT_ONCE = 150_000
"""Pixels of the first picture times PSFs that iterations go through, at most: its filter is made and applied
in a tenth of a second, and its solver is soon there."""

_POLL_S = 0.005


class LiveReconstructor:
    """Makes a picture of each frame that it is fed, in about ``budget_ms``.

    For one thread. It never waits and keeps no queue: feed it the newest frame whenever it is done with the
    one before (:class:`instrument.live.live.LiveView` does). Where the machine is too slow, pictures get
    coarser (binning, or half of the depths or fewer, see :func:`recon.streams.detail.ladder`) and then
    rougher (fewer iterations, at last a Wiener filter), and say so; they do not get late.

    The first picture of a scene is a Wiener filter's, at once; from the next on, or by :meth:`refine`, it is
    iterated. While the scene is still, frames are averaged and iterations go on from frame to frame, so that
    the picture converges. While it moves, they go on from the picture before. After a cut, they begin anew.
    Other pixels or depths are prepared in a thread of its own while pictures go on. Those that find no memory
    are said in ``warnings`` and not tried again until :meth:`restart`; pictures go on as they are.

    Raises InputError when the calibration or an option is unusable, or no solver has a way for them.

    Parameters
    ----------
    calibration : Calibration or ndarray
        As of :func:`recon.reconstruct`.
    options : ReconstructionOptions, optional
        Any camera model, prior, solver, background and depths, as of
        :func:`~recon.streams.video.stream_problem`; when to stop is the budget's matter.
    live : LiveOptions, optional
    **overrides
        Single options of both by their names, and what is known of the frames, as of
        :class:`~recon.reconstruction.measurement.Measurement`: ``noise``, ``background`` (default: the
        calibration's), ``erasures``.

    Attributes
    ----------
    budget_ms : float
        May be changed at any time.
    warnings : tuple of str
        What is doubtful about the calibration, and what became of the pictures since.
    """

    def __init__(
        self,
        calibration: Calibration | npt.ArrayLike,
        options: ReconstructionOptions | None = None,
        live: LiveOptions | None = None,
        **overrides: Any,
    ) -> None:
        of_live = {f.name: overrides.pop(f.name) for f in fields(LiveOptions) if f.name in overrides}
        self.live = live = with_overrides(live or LiveOptions(), of_live)
        self._known, self.options = given(overrides, options)
        if wrong := inapplicable(self.options, "live picture"):
            names = ", ".join(o.name for o in wrong)
            raise InputError(f"{names}: not for live pictures, which take what fits into budget_ms.")
        if self._known.get("patterns") is not None:
            raise InputError("Live pictures are of one scene in one light: leave the patterns out.")
        if self._known.get("vignetting") is not None:
            raise InputError("Live pictures know no vignetting: divide the frames by it, and leave it out.")
        self._given = calibration
        places = calibration.source_positions_um if isinstance(calibration, Calibration) else None
        self._one_of_many = places is not None and len(places) > len(members_of_depths(places))
        background = calibration.background if isinstance(calibration, Calibration) else None
        if background is not None and self._known.get("background") is None:
            self._known["background"] = np.moveaxis(background, 0, -1)
        checked = self._checked()
        self.calibration, self._options = checked.calibration, checked.options
        self.warnings = self._doubts = checked.warnings
        self._n_planes, self._z_um = checked.n_planes, checked.depths.z_um
        if live.plane is not None and live.plane >= self._n_planes:
            raise InputError(f"plane {live.plane} is none of the {self._n_planes} depths, counted from 0.")
        self.budget_ms = live.budget_ms
        self._sensor = checked.sensor_shape
        n_psfs = len(checked.calibration.psfs) if checked.varies else self._n_planes
        self._first_work = n_psfs * int(np.prod(self._sensor))
        binnings = range(live.finest, live.coarsest + 1)
        fine_enough = [b for b in binnings if min(self._sensor) >= LEAST_SIDE * b]
        self._details = ladder(checked.depths.central, fine_enough or [live.finest], live.plane)
        self._pace = Pace(list(self._details))
        self._level: Level | None = None
        self._coming: ComingLevel | None = None
        self._watch = SceneWatch(live.average)
        self._shape: tuple[int, ...] = ()
        self._background: Array | None = None
        self._valid: BoolArray | None = None
        self._scene = SceneState.NEW
        self._follows = False
        """Whether the solver knows the scene as it was a frame ago."""
        self._greeted = False
        """Whether the newest scene was shown by a Wiener filter already."""
        self._settled = False
        self._dark = False
        self._lit = True
        self._fit = CalibrationWatch(self._given if isinstance(self._given, Calibration) else None)

    def _checked(self) -> Problem:
        """Return the problem of a frame that holds nothing: what has no way is refused before the stream."""
        psfs = self._given.psfs if isinstance(self._given, Calibration) else as_channels(self._given, "PSF")
        sides = psfs.shape[-2:]
        known = {"noise": 1.0} | {name: fact for name, fact in self._known.items() if fact is not None}
        shapes = [np.shape(fact) for fact in known.values()]
        colours = max(psfs.shape[-3], *(shape[2] if len(shape) == 3 else 1 for shape in shapes))
        blank = np.arange(colours * int(np.prod(sides)), dtype=np.float32).reshape(*sides, colours)
        options = self.options
        if options.estimate_background is None and "background" in known:
            options = replace(options, estimate_background=False)
        problem = stream_problem(Measurement(blank, **known), self._given, options, choosing=False)
        require_steps(problem)
        return problem

    # Pictures --------------------------------------------------------------------------------------
    def feed(self, image: Array, *, lit: bool = True) -> LivePicture:
        """Return a picture of a frame.

        The first makes its filter, which takes about a tenth of a second; the first of another scene takes a
        little longer than others.

        Raises InputError when the image does not fit the PSF or the frames before, or is not finite; such a
        frame is left out, and the next goes on as if it had not been.

        Parameters
        ----------
        image : ndarray, (height, width) or (height, width, n_channels)
            Counts. Of the PSF's pixels, or of a whole multiple of them, which is then binned to them.
        lit : bool
            Whether something was lit, as far as is known. Where nothing was and the frame holds noise only,
            or nothing that the calibration is known to explain, its picture is black and costs nothing; what
            is lit and looks like noise may be a dim point. What was found of frames in the other state is
            forgotten.
        """
        began = _now()
        frame = self._measured(np.asarray(image))
        level = self._level_for(frame)
        small = block_mean(frame, level.binning, about_axis=True)
        self._scene = self._watch.see(small)
        if lit is not self._lit:
            self._lit = lit
            self._fit.in_another_light()
        self._dark = not self._sees_light(level, frame)
        affordable = self._pace.affordable(level.detail.coarseness, self.budget_ms)
        cut = self._scene is SceneState.NEW and not self._greeted
        too_slow = affordable < 1 and self._scene is not SceneState.STILL
        self._greeted = self._scene is SceneState.NEW
        if not lit and (self._dark or self._fit.doubt or not self._fit.is_known):
            self._follows, self._settled = False, True
            return self._picture(level, np.zeros_like(self._as_given(small))[None], None, began)
        solver = level.solver
        if solver is None or cut or too_slow:
            self._follows = self._settled = False
            filtered = level.filtered(self._as_given(self._watch.mean))
            if too_slow:
                self._pace.note_filter(_now() - began)
            return self._picture(level, filtered, 0, began)
        anew = self._scene is SceneState.NEW or not self._follows
        if anew:
            solver.begin()
        solver.take(self._as_given(self._watch.mean))
        self._follows = True
        done, steps = self._iterate(level, began, max(affordable, 1), lambda: False)
        picture = self._picture(level, level.solved(), done, began)
        after = _now() - began
        if not anew and self._coming is None:  # otherwise it says nothing of the pictures to come
            self._pace.note(after - steps, steps, done)
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
        if level is None or level.solver is None:
            return None
        began = _now()
        if not self._follows:
            level.solver.begin()
            level.solver.take(self._as_given(self._watch.mean))
            self._follows = True
        done, _ = self._iterate(level, began, None, newer)
        self._greeted = False
        return self._picture(level, level.solved(), done, began)

    def full(
        self, image: Array, *, on_progress: Progress | None = None, cancel: threading.Event | None = None
    ) -> Reconstruction:
        """Reconstruct a frame as a single picture, to the end, with the same options; from any thread.

        Raises InputError when the image does not fit the calibration.

        Parameters
        ----------
        image : ndarray
            As of :meth:`feed`.
        on_progress, cancel
            As of :func:`recon.reconstruct`.
        """
        pixels = np.moveaxis(self._on_calibration_pixels(image), 0, -1)
        pixels = pixels[..., 0] if image.ndim == 2 else pixels
        measurement = Measurement(pixels, **self._known)
        return reconstruct(measurement, self._given, self.options, on_progress=on_progress, cancel=cancel)

    def fitting_depth_um(self, image: Array) -> float | None:
        """Return the depth of the calibration that explains a frame best, from any thread; um.

        The one in use unless another explains it certainly better; None: of all depths, or of one alone.
        """
        now_um = self.options.z_um
        if now_um is None or not isinstance(self._given, Calibration):
            return now_um
        pixels = np.moveaxis(self._on_calibration_pixels(image), 0, -1)
        measurement = Measurement(pixels[..., 0] if image.ndim == 2 else pixels, **self._known)
        z_um = self._given.source_positions_um[:, 2]
        depths = [float(z_um[group[0]]) for group in members_of_depths(self._given.source_positions_um)]
        now = int(np.argmin(np.abs(np.array(depths) - now_um)))
        options = ReconstructionOptions(prior="tv", model="convolution", drop_empty=False)
        return depths[fitting_depth(Problem.of(measurement, self._given, options), now)]

    def shown(self, volume: Float32Array, planes: tuple[int, ...] | None = None) -> Float32Array:
        """Return the picture of depths (n_z, ...): of the one chosen, else each pixel's brightest.

        Parameters
        ----------
        planes : tuple of int, optional
            Which depths of the calibration the volume has; default all.
        """
        if len(volume) == 1:  # one depth, or the filter's picture of one
            return np.ascontiguousarray(volume[0])
        plane = self.live.plane
        if plane is None:
            return np.ascontiguousarray(volume.max(axis=0))
        return np.ascontiguousarray(volume[plane if planes is None else planes.index(plane)])

    def restart(self) -> None:
        """Forget the scene, the machine's timing and the noise, and give up what solvers hold.

        The next frame is the first.
        """
        if self._level is not None and self._level.solver is not None:
            self._level.solver.close()
        self._level = self._coming = None
        self._pace = Pace(list(self._details))
        self.warnings = self._doubts
        self._shape = ()
        self._watch.forget()
        self._follows = self._greeted = self._settled = False
        self._fit = CalibrationWatch(self._given if isinstance(self._given, Calibration) else None)

    # Pieces ----------------------------------------------------------------------------------------
    def _sees_light(self, level: Level, frame: Float32Array) -> bool:
        """Tell whether there is a scene to see; what was settled on noise is then made anew."""
        mean = self._as_given(self._watch.mean)
        if not level.sees_light(mean, self._watch.count):
            return False
        if not level.lit and self._coming is None:
            self._level = replace(level, lit=True)  # once, also where there is no memory for another
            self._make(level.detail, frame)
        self._fit.see(
            lambda: level.whole.with_data(mean.copy()), level.binning, self._scene, self._watch.count
        )
        if self._fit.advice and self._fit.advice not in self.warnings:
            self.warnings = (*self.warnings, self._fit.advice)
        return True

    def _iterate(
        self, level: Level, began: Spent, at_most: int | None, newer: Callable[[], bool]
    ) -> tuple[int, Spent]:
        """Do one iteration, and more while they fit into the budget; return how many, and what they took."""
        cost = self._pace.cost(level.detail.coarseness)
        assert level.solver is not None
        ahead_ms = 0.0 if cost is None else cost.step.wall_ms + 0.5 * cost.fixed.wall_ms
        first = _now()
        done = 0
        while True:
            self._settled = level.solver.advance(level.tolerance)
            done += 1
            spent_ms = (_now() - began).wall_ms
            if self._settled or done == at_most or spent_ms + ahead_ms > self.budget_ms or newer():
                self._settled &= level.solver.confirm()
                return done, _now() - first

    def _level_for(self, frame: Float32Array) -> Level:
        """Return the level for the next frame: the one there is, until another is made."""
        if self._level is None:
            try:
                self._level = self._level_of(self._first_detail(), frame.copy())
            except InputError:
                self._shape = ()  # a frame that is refused settles nothing
                raise
            self._pace.enter(self._level.detail.coarseness)
            self._coming = ComingLevel(self._level.detail, self._level.solving)
        elif self._coming is not None:
            if self._coming.wait(0):
                self._take_up(self._coming)
        elif self._level.solver is None:  # there was no memory for it
            coarser = next((c for c in self._pace.levels if c > self._level.detail.coarseness), None)
            if coarser is not None:
                self._make(self._details[coarser], frame)
        elif (wanted := self._pace.next_level(self.budget_ms)) != self._level.detail.coarseness:
            self._make(self._details[wanted], frame)
        return self._level

    def _level_of(self, detail: Detail, frame: Float32Array) -> Level:
        """Return the level of some detail, without a solver, for a frame on the calibration's pixels."""
        binning, planes = detail.binning, detail.planes
        valid = np.broadcast_to(True if self._valid is None else self._valid, frame.shape)
        measurement = on_blocks(frame, valid, self._known.get("noise"), binning, flat=len(self._shape) == 2)
        calibration = reduced_calibration(self.calibration, binning, None)
        problem = whole = stream_problem(measurement, calibration, self._options, choosing=False)
        if len(planes) < self._n_planes:
            fewer = reduced_calibration(calibration, 1, planes)
            problem = stream_problem(measurement, fewer, self._options, choosing=False)
        return Level.of(problem, detail, whole, planes.index(self._filtered_plane(detail)))

    def _filtered_plane(self, detail: Detail) -> int:
        """Return the depth that a Wiener filter shows: the one chosen, else the middle one there is."""
        return detail.planes[len(detail.planes) // 2] if self.live.plane is None else self.live.plane

    def _first_detail(self) -> Detail:
        """Return the most at which a first picture takes no time to speak of."""
        details = [self._details[c] for c in self._pace.levels]
        return next((d for d in details if self._first_work <= AT_ONCE * d.coarseness**2), details[-1])

    def _make(self, detail: Detail, frame: Float32Array) -> None:
        """Begin to make a level for a frame on the calibration's pixels."""
        kept = frame.copy()
        self._coming = ComingLevel(detail, lambda: self._level_of(detail, kept).solving())

    def _solving_level(self, newer: Callable[[], bool]) -> Level | None:
        """Return the level in use once it has a solver; None when a newer frame comes first."""
        while self._level is not None and self._level.solver is None:
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
            self._do_without(coming.detail)
        else:
            self._enter(level)

    def _do_without(self, detail: Detail) -> None:
        """Say that there is no memory for these pixels and depths, and give them up."""
        assert self._level is not None
        self._pace.give_up(detail.coarseness)
        how = "are a Wiener filter's," if self._level.solver is None else "go on"
        self.warnings = (
            *self.warnings,
            f"There was no memory to iterate pictures {detail.words(self._z_um)}: they {how} "
            f"{self._level.detail.words(self._z_um)}. End what else needs memory, then begin anew.",
        )

    def _enter(self, level: Level) -> None:
        """Go on at another level; one of other pixels knows nothing of the scene."""
        assert self._level is not None
        if level.binning != self._level.binning:
            self._watch.forget()
            self._greeted = True  # a scene already shown is iterated at once
        if level.detail != self._level.detail:
            self._pace.enter(level.detail.coarseness)
        if self._level.solver is not None:
            self._level.solver.close()
        self._level, self._coming = level, None
        self._follows = self._settled = False

    def _as_given(self, channels: Float32Array) -> Float32Array:
        """Return a frame (n_channels, height, width) with the axes that frames came with."""
        return channels[0] if len(self._shape) == 2 else np.moveaxis(channels, 0, -1)

    def _measured(self, image: Array) -> Float32Array:
        """Return a frame on the calibration's pixels, less background, 0 where erased, channels first."""
        frame = self._on_calibration_pixels(image)
        if image.shape != self._shape:
            if self._shape:
                raise InputError(
                    f"A frame of {image.shape} came after frames of {self._shape}: call restart() after a "
                    "change of the camera's region, binning or format."
                )
            background, flat = self._known.get("background"), image.ndim == 2
            known = Measurement(frame[0] if flat else np.moveaxis(frame, 0, -1), **self._known)
            valid = known.counts().valid
            self._background = None if background is None else known.like(background, frame, "background")
            self._valid = None if valid.all() else valid
            self._shape = image.shape
        if self._background is not None:
            frame = frame - self._background
        return frame if self._valid is None else np.where(self._valid, frame, np.float32(0))

    def _on_calibration_pixels(self, image: Array) -> Float32Array:
        if image.ndim not in (2, 3) or image.dtype.kind not in "uif":
            raise InputError(
                f"A frame must be (height, width[, n_channels]) of numbers, not {image.dtype} {image.shape}."
            )
        if image.dtype.kind == "f":
            image = real_array(image, "The frame")
            require_finite(image, "frame")
        height, width = self._sensor
        factor = image.shape[0] // height
        if factor < 1 or image.shape[:2] != (factor * height, factor * width):
            raise InputError(
                f"The frame has {image.shape[0]} x {image.shape[1]} pixels and the PSF {height} x {width}. "
                "Both must come from the same sensor area; the frame's pixels may be finer by a whole factor."
            )
        return block_mean(image[None] if image.ndim == 2 else np.moveaxis(image, 2, 0), factor)

    def _picture(self, level: Level, volume: Float32Array, done: int | None, began: Spent) -> LivePicture:
        """Return a picture: of ``done`` iterations, of the filter (0), or of a dark frame (None)."""
        filtered, detail = not done, level.detail
        plane = self._filtered_plane(detail) if filtered else self.live.plane
        doubt = self._unlit() if done is None else NOISE_ONLY if self._dark else self._fit.doubt
        of = f"{self._n_planes} depths" if filtered else detail.depths(self._z_um)
        return LivePicture(
            image=self.shown(volume, detail.planes),
            binning=level.binning,
            method="" if done is None else "wiener" if filtered else level.method,
            iterations=done or 0,
            total_iterations=0 if filtered or level.solver is None else level.solver.iterations,
            scene=self._scene,
            frames=self._watch.count,
            settled=self._settled,
            work_ms=(_now() - began).wall_ms,
            budget_ms=self.budget_ms,
            volume=volume if len(volume) > 1 else None,
            planes=(plane,) if filtered and plane is not None else detail.planes,
            shown=""
            if self._n_planes == 1
            else f"brightest of {of}"
            if plane is None
            else f"depth {plane} of {of}",
            camera=level.camera(filtered=filtered, varies=self._one_of_many),
            doubt=doubt,
            awaited="" if doubt else self._fit.awaited,
        )

    def _unlit(self) -> str:
        return DARK if self._dark else UNLIT if self._fit.doubt else UNLIT_SO_FAR


def _now() -> Spent:
    """Return the clock's time, and this thread's processor time."""
    return Spent(1e3 * time.perf_counter(), 1e3 * time.thread_time())
