"""The stage that carries the mask: which way its axes go, how well it comes back, taking out a pose.

What a move would gain and what an uncertainty costs is told in PSNR of a hologram where the mask is.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from calibration_routines.display.display_io import approach_from_below
from calibration_routines.display.mask_search import (
    AlignmentFailedError,
    AlignmentSession,
    Measured,
    measure_again,
    refine_pose,
)
from drivers.stage import Stage
from instrument.files.sample_images import load_sample
from recon.arrays import Float64Array
from recon.holography import Display, Target
from recon.holography.pose import NAMES, PlacedHologram, Pose
from recon.holography.target import make_band

ITERATIONS = 15
"""Enough to tell places apart: further ones raise all of them alike."""
DRAWS = 6


class PlacementCost:
    """Computes holograms of a busy sample picture for places of the mask, and looks at them."""

    def __init__(self, display: Display) -> None:
        self.display = display
        shape = make_band(display.slm_shape, display.factor, "alias-free").seen_shape
        ey, ex = (np.fft.fftshift(e) for e in display.envelope(shape))
        self._target = Target(load_sample("leaves", shape) * ey[:, None] * ex, white=1.0)
        self._in_place: PlacedHologram | None = None

    def psnr_db(self, pose: Pose) -> float:
        """Return the PSNR of a hologram that knows the pose's displacement, but not its depth and tilts."""
        return self._compute(pose).psnr_db(pose)

    def in_place(self, pose: Pose) -> float:
        """Return the PSNR of a hologram for what stays of a pose; computed once, as little changes there."""
        if self._in_place is None:
            self._in_place = self._compute(pose)
        return self._in_place.psnr_db(self._in_place.pose)

    def of_difference_db(self, place: Pose, difference: Pose) -> float:
        """Return what a hologram computed for :meth:`in_place` of a pose loses to a difference from there."""
        psnr_db = self.in_place(place)
        assert self._in_place is not None
        vector = self._in_place.pose.vector() + difference.vector()
        return psnr_db - self._in_place.psnr_db(Pose(*(float(v) for v in vector)))

    def of_depth_db(self, pose: Pose, rest: Float64Array) -> float:
        """Return what a hologram for a pose and the displacement beyond it loses to the pose's depth."""
        hologram = self._compute(pose, rest)
        return hologram.psnr_db(pose.with_(z_um=0.0)) - hologram.psnr_db(pose)

    def lost_db(
        self,
        pose: Pose,
        deep_error: Float64Array,
        rest: Float64Array,
        modes: Float64Array,
    ) -> float:
        """Return what a hologram computed with a result loses to what remains, on average.

        Depth and tilts are there and not modelled; they (by ``deep_error``, (3,): depth, pitch, yaw) and the
        displacement are off by their uncertainty. ``rest``, (rows, columns, 2), is the displacement beyond
        the pose's; ``modes``, (modes, rows, columns, 2), are its errors, one standard deviation each.
        """
        hologram = self._compute(pose, rest)
        flat = pose.with_(z_um=0.0, pitch_mrad=0.0, yaw_mrad=0.0)
        rng = np.random.default_rng(0)
        seen = []
        for _ in range(DRAWS):
            z, pitch, yaw = rng.normal(size=3) * deep_error
            off = pose.with_(
                z_um=pose.z_um + z, pitch_mrad=pose.pitch_mrad + pitch, yaw_mrad=pose.yaw_mrad + yaw
            )
            error: Float64Array = np.tensordot(rng.normal(size=len(modes)), modes, 1)
            seen.append(hologram.psnr_db(off, error))
        return hologram.psnr_db(flat) - float(np.mean(seen))

    def _compute(self, pose: Pose, rest: Float64Array | None = None) -> PlacedHologram:
        return PlacedHologram(self.display, self._target, pose, rest, iterations=ITERATIONS)


Values = dict[str, float]

PARAMETERS = {
    "x_um": "shift_x",
    "y_um": "shift_y",
    "z_um": "z_um",
    "roll_mrad": "roll_mrad",
    "pitch_mrad": "pitch_mrad",
    "yaw_mrad": "yaw_mrad",
}
"""Stage axes and the pose parameters that they change."""

TEST_STEPS = {"x_um": 1.1, "y_um": 0.6, "z_um": 0.5, "roll_mrad": 0.5}
"""Test moves, in the steps that cost a spot a third to a half of its light. They differ between x and y, so
that exchanged axes do not pass. Tilts of a few milliradians are not felt by spots and not tested."""


class MaskStage:
    """Moves the mask on an open, homed stage; every place is approached from below on every axis."""

    def __init__(self, session: AlignmentSession, stage: Stage) -> None:
        self.session = session
        self.stage = stage
        self.axes = [axis.name for axis in stage.axes if axis.name in PARAMETERS]
        self.direction: dict[str, int] = {}
        pitch = session.display.mask_pitch_um
        self._units = {name: pitch if name in ("x_um", "y_um") else 1.0 for name in PARAMETERS}

    @property
    def position(self) -> Values:
        """Commanded position of the axes that are used."""
        here = self.stage.commanded_position()
        return {name: here[name] for name in self.axes}

    def go(self, target: Mapping[str, float]) -> None:
        """Move there, from below."""
        approach_from_below(self.stage, target)

    def values(self, pose: Pose) -> Values:
        """Return the pose's parameters that the axes change, in the axes' units."""
        return {n: getattr(pose, PARAMETERS[n]) * self._units[n] for n in self.axes}

    def test(self, at: Measured) -> tuple[Measured, Pose]:
        """Find out which way the axes go by a small move of all of them, and how well the stage comes back.

        Returns where the mask is, back at its place, and by how much that differs from before: repeatability
        of stage and measurement together.

        Raises AlignmentFailedError when an axis did not do what it was asked for, by all light too.
        """
        session, here = self.session, self.position
        steps = self._test_move(at.pose)
        if not steps:
            return at, Pose()
        self.go({name: here[name] + step for name, step in steps.items()})
        session.register()
        # Where the axes go the way of their names the mask is found at once; else from where it was before,
        # which every step leaves within reach.
        moved = refine_pose(session, self._moved(at.pose, steps), 2, quick=1, floor=-1)
        if moved.efficiency < 0.6 * at.efficiency:
            moved = refine_pose(session, at.pose, 2, quick=3)
        if unlike := self._unlike(at, moved, steps):
            session.say(f"{', '.join(unlike)} moved otherwise than asked: measured again")
            moved = refine_pose(session, moved.pose, 4, quick=1)
            unlike = self._unlike(at, moved, steps)
        # What makes spots wrong is the light around them: that is asked before an axis is named.
        there = measure_again(session, moved.pose) if unlike else None
        self.go(here)
        session.register()
        back = refine_pose(session, at.pose, 3, quick=0)
        apart = Pose(*(float(v) for v in back.pose.vector() - at.pose.vector()))
        if unlike:
            again = None if there is None else measure_again(session, back.pose)
            back, moved = (back, moved) if again is None or there is None else (again, there)
            unlike = self._unlike(back, moved, steps)
        for name, (found, error) in unlike.items():
            raise AlignmentFailedError(
                f"Axis {name} of {self.stage.name} was moved by {steps[name]:+.3g}; the spots say "
                f"{found:+.3g} +- {error:.2g}, measured again. Check which axis it is, its unit, and whether "
                "the mask is fixed."
            )
        before, after = self.values(back.pose), self.values(moved.pose)
        self.direction |= {n: 1 if (after[n] - before[n]) * step > 0 else -1 for n, step in steps.items()}
        turned = [name for name, sign in self.direction.items() if sign < 0]
        session.say(
            f"axes tested: {', '.join(self.direction)}"
            + (f"; reversed: {', '.join(turned)}" if turned else "")
        )
        return back, apart

    def _unlike(self, a: Measured, b: Measured, steps: Values) -> dict[str, tuple[float, float]]:
        """Return what axes did that did not do what they were asked for, and how sure that is."""
        before, after = self.values(a.pose), self.values(b.pose)
        total: Float64Array = np.hypot(a.error, b.error)
        error = self.values(Pose(*(float(v) for v in total)))
        went = {name: (after[name] - before[name], error[name]) for name in steps}
        return {
            name: found
            for name, found in went.items()
            if abs(abs(found[0]) - abs(steps[name])) > max(0.35 * abs(steps[name]), 4 * found[1])
        }

    def take_out(self, at: Measured) -> Pose | None:
        """Move against a pose; returns the pose to be expected, or None where no axis can do anything.

        Axes that were not tested (tilts) are moved only for what clearly stands out of its uncertainty, and
        are taken to go the way of their names.
        """
        here, limits = self.position, self.stage.limits
        errors = self.values(Pose(*(float(v) for v in at.error)))
        target: Values = {}
        left = self.values(at.pose)
        for name, value in list(left.items()):
            tested = self.direction.get(name, 0)
            if not tested and abs(value) < 3 * errors[name]:
                continue
            sign = tested or 1
            low, high = limits[name]
            wanted = here[name] - sign * value
            target[name] = float(np.clip(wanted, low, high))
            left[name] = value + sign * (target[name] - here[name])
            if target[name] != wanted:
                self.session.say(f"{name} reaches its limit; {left[name]:+.3g} stay")
        if not target:
            return None
        self.go(target)
        self.session.say("stage: " + ", ".join(f"{n} {target[n] - here[n]:+.3g}" for n in target))
        return self._with(at.pose, left)

    def removable(self, pose: Pose) -> Pose:
        """Return the pose with everything that the axes change taken out."""
        return pose.with_(**{PARAMETERS[name]: 0.0 for name in self.axes})

    def _test_move(self, pose: Pose) -> Values:
        """Return a small step of each axis, towards the right place if it goes the way of its name."""
        session, here = self.session, self.position
        natural = dict(zip(NAMES, session.probe.steps, strict=True))
        values, steps = self.values(pose), {}
        for name in self.axes:
            if name not in TEST_STEPS:
                continue
            step = TEST_STEPS[name] * float(natural[PARAMETERS[name]]) * self._units[name]
            low, high = self.stage.limits[name]
            towards = -1 if values[name] > 0 else 1
            fitting = [s * step for s in (towards, -towards) if low <= here[name] + s * step <= high]
            if fitting:
                steps[name] = fitting[0]
        return steps

    def _moved(self, pose: Pose, steps: Values) -> Pose:
        """Return the pose after steps of axes that go the way of their names."""
        values = self.values(pose)
        return self._with(pose, {name: values[name] + step for name, step in steps.items()})

    def _with(self, pose: Pose, values: Values) -> Pose:
        return pose.with_(**{PARAMETERS[n]: v / self._units[n] for n, v in values.items()})
