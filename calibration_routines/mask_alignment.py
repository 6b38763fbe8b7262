"""Find the scattering mask's pose by spots on the camera, and move the stage to take out what it can.

Kuo 2020, Sec. 7.4, hill-climbs the brightness of one spot, which is felt only within one SLM pixel. Here
nothing moves at first: each picture holds many spots, each computed for another hypothesis about the pose.

1. The mask's own speckle (blank SLM) registers the camera.
2. Search: shift in steps of one SLM pixel, at a few depths; the spots that stand out are candidates.
3. The candidates are tried with rotations and scales, then the best one on finer grids.
4. Refinement: pairs of spots on either side of the pose, a pair a parameter; all eight parameters in one
   step.
5. The stage takes out shift, depth, rotation and tilts, approaching from one side; 4 again, until what is
   left is below the tolerance. What the stage cannot take out stays in the model as a displacement field.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from calibration_routines.display_io import DisplayBench, approach_from_below
from calibration_routines.spot_camera import SpotCamera
from instrument.errors import BenchError
from recon.errors import InputError
from recon.holography import Display
from recon.holography.camera_map import CameraMap
from recon.holography.pose import NAMES, Pose
from recon.holography.pose_fit import PoseProbe
from recon.holography.spots import depth_um

Array = npt.NDArray[Any]
Progress = Callable[[str, int], object]


class AlignmentFailedError(BenchError):
    """The mask's pose was not found; the text says at which step and what was seen."""

    exit_code = 1


@dataclass(frozen=True, slots=True)
class AlignmentSettings:
    """How far and how carefully to search.

    Attributes
    ----------
    reach : float
        Largest shift to look for, mask pixels.
    depth_um : float
        Largest distance to look for.
    roll_mrad, scale : float
        Largest rotation and scale error to look for.
    tilt_mrad : float
        Typical tilt of a mask put in by hand: spots hardly feel it, so that it is also taken for likely.
    spots : int
        In a search picture.
    max_frames : int
        Give up rather than take more.
    moves : int
        Stage moves at most; 0 keeps the stage where it is.
    refinements : int
        Pictures of probe spots in the last measurement.
    """

    reach: float = 72.0
    depth_um: float = 1000.0
    roll_mrad: float = 7.0
    scale: float = 0.003
    tilt_mrad: float = 5.0
    spots: int = 128
    max_frames: int = 100
    moves: int = 2
    refinements: int = 12


@dataclass(slots=True)
class AlignmentReport:
    """What was found.

    Attributes
    ----------
    pose : Pose
        What is left, with the stage where it ended; holograms are to be computed with it.
    error : ndarray, float64, (8,)
        Standard uncertainty of each parameter.
    efficiency : float
        Brightness of spots at the pose over the model's ideal (the display's DC term taken off).
    found_at : Pose
        What was found before the stage moved.
    frames : int
    camera : CameraMap
    brightness_per_ms : float
        Camera counts a millisecond for the mean intensity.
    log : list of str
    efficiencies : list of (int, float)
        Frames taken and efficiency after each step.
    """

    pose: Pose
    error: npt.NDArray[np.float64]
    efficiency: float
    found_at: Pose
    frames: int
    camera: CameraMap
    brightness_per_ms: float
    log: list[str] = field(default_factory=list)
    efficiencies: list[tuple[int, float]] = field(default_factory=list)


class MaskAlignment:
    """Runs the procedure on an open bench.

    Parameters
    ----------
    io : DisplayBench
    display : Display
        What is known of the display; its displacement is not used.
    settings : AlignmentSettings
    progress : callable, optional
        ``progress(words, frames_taken)``.
    """

    def __init__(
        self,
        io: DisplayBench,
        display: Display,
        settings: AlignmentSettings | None = None,
        *,
        progress: Progress | None = None,
    ) -> None:
        self.io = io
        self.display = replace(display, displacement=None)
        self.settings = settings or AlignmentSettings()
        self.spots = SpotCamera(io, self.display, before_frame=self._enough)
        self.probe = PoseProbe(self.spots.maker)
        self._progress = progress
        tilt = self.settings.tilt_mrad
        self._prior = np.array([np.inf] * 6 + [tilt, tilt])
        self.log: list[str] = []
        self.efficiencies: list[tuple[int, float]] = []

    def run(self) -> AlignmentReport:
        """Align; returns what was found and leaves the stage at the best pose.

        Raises
        ------
        AlignmentFailedError
            When the pose was not found or too many frames would be needed. The stage is back where it was.
        DeviceError
            When a device fails or a move is refused; the stage stays where it is.
        """
        stage = self.io.bench.stage
        start = stage.commanded_position() if stage is not None else {}
        try:
            return self._run()
        except (AlignmentFailedError, InputError) as error:
            if stage is not None and stage.commanded_position() != start:
                stage.move_to(start)
            if isinstance(error, InputError):
                raise AlignmentFailedError(str(error)) from error
            raise

    def _run(self) -> AlignmentReport:
        self._register()
        pose = self._search()
        pose, error, efficiency = self._refine(pose, 3)
        found_at = pose
        for move in range(self.settings.moves):
            if not self._worth_moving(pose, error):
                break
            before = self.io.bench.stage.commanded_position() if self.io.bench.stage else {}
            expected = self._move(pose)
            if expected is None:
                break
            self._register()
            moved, moved_error, moved_efficiency = self._refine(expected, 4)
            self._say(f"stage move {move + 1}: efficiency {efficiency:.2f} -> {moved_efficiency:.2f}")
            if moved_efficiency < 0.8 * efficiency:
                assert self.io.bench.stage is not None
                self.io.bench.stage.move_to(before)
                self._register()
                break
            pose, error, efficiency = moved, moved_error, moved_efficiency
        pose, error, efficiency = self._refine(pose, self.settings.refinements, small=True)
        self._check(efficiency)
        return AlignmentReport(
            pose, error, efficiency, found_at, self.io.frames, self.spots.camera, self.spots.mean_per_ms,
            self.log, self.efficiencies,
        )  # fmt: skip

    # Steps -------------------------------------------------------------------------------------
    def _register(self) -> None:
        """Blank SLM: register the camera, and learn how bright the mean intensity is."""
        self.spots.register()
        self._say(f"camera registered to {self.spots.camera.residual_px:.2f} px")

    def _search(self) -> Pose:
        settings, k = self.settings, self.display.factor
        steps = int(np.ceil(settings.reach / k))
        depth = depth_um(self.display)
        layers = max(1, int(np.ceil(settings.depth_um / depth)))
        depths = np.linspace(-1, 1, 2 * layers + 1)[1::2] * settings.depth_um if layers > 1 else np.zeros(1)
        grid = [(i, j) for i in range(-steps, steps + 1) for j in range(-steps, steps + 1)]
        hypotheses = [Pose(shift_x=k * j, shift_y=k * i, z_um=z) for z in depths for i, j in grid]
        brightness = np.empty(len(hypotheses))
        order = np.random.default_rng(1).permutation(len(hypotheses))
        for first in range(0, len(order), settings.spots):
            chosen = order[first : first + settings.spots]
            brightness[chosen], _ = self.spots.measure([hypotheses[n] for n in chosen], shifts_only=True)
            self._tell("search for the shift")
        maps = brightness.reshape(len(depths), 2 * steps + 1, 2 * steps + 1)
        score = _smooth(maps).ravel()
        best = np.argsort(score)[::-1][:24]
        self._say(
            f"search: {len(hypotheses)} hypotheses, best {score[best[0]]:.1f}, "
            f"25th {np.sort(score)[-25]:.1f}, median {np.median(score):.2f}"
        )
        candidates = [hypotheses[n] for n in best]
        roll, scale = settings.roll_mrad, settings.scale
        candidates = self._best(
            [c.with_(roll_mrad=r) for c in candidates for r in (-0.6 * roll, 0.0, 0.6 * roll)], 6, "rotation"
        )
        candidates = self._best(
            [
                c.with_(roll_mrad=c.roll_mrad + r, scale=s)
                for c in candidates
                for r in (-0.25 * roll, 0.0, 0.25 * roll)
                for s in (-0.6 * scale, 0.0, 0.6 * scale)
            ],
            3,
            "rotation and scale",
        )
        grid_px = np.array([-0.75, -0.375, 0, 0.375, 0.75]) * k
        candidates = self._best(
            [
                c.with_(shift_x=c.shift_x + x, shift_y=c.shift_y + y)
                for c in candidates
                for x in grid_px
                for y in grid_px
            ],
            2,
            "shift",
        )
        candidates = self._best(
            [
                c.with_(z_um=c.z_um + z, roll_mrad=c.roll_mrad + r)
                for c in candidates
                for z in np.linspace(-1, 1, 9) * depth
                for r in (-0.15 * roll, 0.0, 0.15 * roll)
            ],
            1,
            "depth",
        )
        return candidates[0]

    def _best(self, poses: Sequence[Pose], count: int, words: str) -> list[Pose]:
        """Measure poses twice with other places for the spots and return the brightest ones."""
        total = sum(self.spots.measure(poses)[0] for _ in range(2))
        self._tell(words)
        order = np.argsort(total)[::-1]
        return [poses[n] for n in order[:count]]

    def _refine(
        self, pose: Pose, pictures: int, *, small: bool = False
    ) -> tuple[Pose, npt.NDArray[np.float64], float]:
        """Step to the best pose: two quick steps (unless ``small``), then one by all pictures together."""
        error = np.full(len(NAMES), np.nan)
        efficiency = 0.0
        for count in (pictures,) if small else (1, 1, pictures):
            frames = [self.spots.measure(self.probe.poses(pose)) for _ in range(count)]
            brightness = np.array([b for b, _ in frames])
            noise = float(np.mean([n for _, n in frames]))
            step = self.probe.step(brightness, noise, pose, self._prior)
            efficiency = float(brightness[:, -1].mean()) / self.spots.ideal(len(NAMES) * 2 + 1)
            pose, error = pose.plus(step.change), step.error
            self.efficiencies.append((self.io.frames, efficiency))
            self._tell(f"refinement, efficiency {efficiency:.2f}")
        self._check(efficiency, floor=0.05)
        return pose, error, efficiency

    def _worth_moving(self, pose: Pose, error: npt.NDArray[np.float64]) -> bool:
        """Whether the stage can take out more than its measurement's uncertainty or the tolerance."""
        stage = self.io.bench.stage
        if stage is None:
            return False
        tolerance = {
            "x_um": 0.5 * self.display.mask_pitch_um,
            "y_um": 0.5 * self.display.mask_pitch_um,
            "z_um": 12.0,
            "roll_mrad": 0.2,
            "pitch_mrad": 4.0,
            "yaw_mrad": 4.0,
        }
        values = self._stage_values(pose)
        spread = self._stage_values(Pose(*error))
        axes = {axis.name for axis in stage.axes}
        return any(abs(values[a]) > max(tolerance[a], 1.5 * spread[a]) for a in values if a in axes)

    def _stage_values(self, pose: Pose) -> dict[str, float]:
        pitch = self.display.mask_pitch_um
        return {
            "x_um": pose.shift_x * pitch,
            "y_um": pose.shift_y * pitch,
            "z_um": pose.z_um,
            "roll_mrad": pose.roll_mrad,
            "pitch_mrad": pose.pitch_mrad,
            "yaw_mrad": pose.yaw_mrad,
        }

    def _move(self, pose: Pose) -> Pose | None:
        """Move the stage against the pose, from below on every axis; returns the pose to be expected."""
        stage = self.io.bench.stage
        assert stage is not None
        here, limits = stage.commanded_position(), stage.limits
        axes = {axis.name: axis for axis in stage.axes}
        target, left = {}, {}
        for name, value in self._stage_values(pose).items():
            if name not in axes:
                continue
            low, high = limits[name]
            target[name] = float(np.clip(here[name] - value, low, high))
            left[name] = value + target[name] - here[name]
        if not target:
            return None
        approach_from_below(stage, target)
        pitch = self.display.mask_pitch_um
        moved = ", ".join(f"{name} {target[name] - here[name]:+.2f}" for name in target)
        self._say(f"stage: {moved}")
        return pose.with_(
            shift_x=left.get("x_um", pose.shift_x * pitch) / pitch,
            shift_y=left.get("y_um", pose.shift_y * pitch) / pitch,
            z_um=left.get("z_um", pose.z_um),
            roll_mrad=left.get("roll_mrad", pose.roll_mrad),
            pitch_mrad=left.get("pitch_mrad", pose.pitch_mrad),
            yaw_mrad=left.get("yaw_mrad", pose.yaw_mrad),
        )

    # Saying ------------------------------------------------------------------------------------
    def _enough(self) -> None:
        if self.io.frames >= self.settings.max_frames:
            raise AlignmentFailedError(
                f"Alignment gave up after {self.io.frames} frames. {self.log[-1] if self.log else ''}"
            )

    def _check(self, efficiency: float, floor: float = 0.3) -> None:
        if not efficiency > floor:
            raise AlignmentFailedError(
                f"Alignment failed: spots reach {100 * efficiency:.0f} % of the model's brightness "
                f"({100 * floor:.0f} % needed). Check mask, wavelength and focal length in [display], bring "
                "the mask closer by its coarse marks, or widen the search."
            )

    def _say(self, words: str) -> None:
        self.log.append(words)
        self._tell(words)

    def _tell(self, words: str) -> None:
        if self._progress is not None:
            self._progress(words, self.io.frames)


def _smooth(maps: Array) -> Array:
    """Add neighbours in shift, weighted: a mask between two hypotheses lights both."""
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)))
    height, width = maps.shape[1:]
    total = np.zeros_like(maps)
    for i, wy in enumerate((0.4, 1.0, 0.4)):
        for j, wx in enumerate((0.4, 1.0, 0.4)):
            total += wy * wx * padded[:, i : i + height, j : j + width]
    return total
