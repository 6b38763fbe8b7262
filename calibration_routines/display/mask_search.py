"""Find the mask roughly without moving anything: every spot is another hypothesis about its pose.

Then measure the pose finely by pairs of probe spots, and the displacement section by section. What all steps
share (bench, spots, how many frames are left, what was said) is the alignment's session.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from pathlib import Path

import numpy as np

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.kept_frames import SeenAgain
from calibration_routines.display.spot_camera import SpotCamera
from calibration_routines.options import Checked, Size
from calibration_routines.procedure import Listener
from calibration_routines.scatter import Scatter, scatter_of
from instrument.files.errors import BenchError
from recon.arrays import Array, Float64Array
from recon.base.declare import RARE, option
from recon.holography import Display
from recon.holography.place import FittedPlace, fit_place
from recon.holography.pose import NAMES, NODES, Pose
from recon.holography.sections import Sections, SectionShifts, SmoothField, fit_field, fit_shifts, hypotheses
from recon.holography.sections import response as spot_response
from recon.holography.spots import PoseProbe, depth_um

ALIGNMENT_FILE = "alignment.json"
"""Where the command line writes it."""


FRAMES, AFTER_SEARCH = 80, 58
"""Frames at most where no number is given: at 16x, 22 of them search as far as the defaults go. At 4x it is
84 behind SLM pixels of 16 um."""

MOST_SEARCHED = 400
"""Pictures of a search that is carried out without being asked for by a number of frames: some minutes."""

STEADY_FRAMES = 5
"""Pictures of the blank SLM at the end, by which flicker and motion are told."""

POOR = 0.6
"""Part of the contrast of photographs that is not explained, beyond which their light tells no place."""

SCALE_WITHIN = 0.005
"""Of the field on the camera; it is known ten times better, lens distortion included."""


class AlignmentFailedError(BenchError):
    """The mask's pose was not found; the text says at which step and what was seen."""

    exit_code = 1


@dataclass(frozen=True, kw_only=True)
class AlignmentSettings(SeenAgain, Checked):
    """How far and how carefully to search."""

    reach: float = option(72.0, unit="mask px", above=0, help="Largest shift to look for, mask pixels.")
    depth_um: float = option(1000.0, unit="um", above=0, help="Largest distance to look for.")
    moves: int = option(4, least=0, label="Stage moves", help="Stage moves at most; 0: nothing moves.")
    max_frames: int | None = option(
        None,
        least=1,
        label="Frames",
        metavar="N",
        help="Frames at most: gives up rather than take more. By itself, more where its last pictures are, "
        f"and at most {MOST_SEARCHED} for the search.",
        default_words=f"{FRAMES}, or {AFTER_SEARCH} after the search",
    )
    division: Size = option(
        Size(3, 5),
        flags=("--sections",),
        metavar="ROWSxCOLUMNS",
        parse=Size.of,
        label="Sections",
        help="Sections of the SLM, whose displacement is measured one by one.",
    )
    slm_calibration: Path | None = option(
        None,
        metavar="FILE",
        label="SLM calibration",
        help="Look-up table and flatness, from calibrate slm.",
        default_words="none: an ideal SLM",
    )
    roll_mrad: float = option(
        7.0, unit="mrad", above=0, label="Rotation", help="Largest rotation to look for.", group=RARE
    )
    scale: float = option(
        0.003, above=0, label="Scale error", help="Largest scale error to look for.", group=RARE
    )
    tilt_mrad: float = option(
        5.0,
        unit="mrad",
        above=0,
        label="Tilt",
        help="Typical tilt of a mask put in by hand: spots hardly feel it, so it is taken for likely.",
        group=RARE,
    )
    spots: int = option(128, least=1, help="Spots in a search picture.", group=RARE)
    section_pictures: int = option(
        4, least=1, help="Pictures of section spots in their last measurement.", group=RARE
    )
    refinements: int = option(
        4, least=1, help="Pictures in the last measurement of depth, tilts and brightness.", group=RARE
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FILE",
        label="File",
        help="Where the alignment goes (.json); a picture goes beside it.",
        default_words=f"{ALIGNMENT_FILE}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Overwrite files that exist.")

    @property
    def last_frames(self) -> int:
        """Frames of the last measurements, sections and pose; kept in reserve by what comes before."""
        return self.section_pictures + self.refinements + 2 + STEADY_FRAMES

    def search_grid(self, display: Display) -> tuple[int, int]:
        """Return how many depths the search for the shift has, and steps of an SLM pixel to each side."""
        return max(1, ceil(self.depth_um / depth_um(display))), ceil(self.reach / display.factor)

    def search_pictures(self, display: Display) -> int:
        """Return how many pictures the search for the shift takes."""
        layers, steps = self.search_grid(display)
        return ceil(layers * (2 * steps + 1) ** 2 / self.spots)

    def most_frames(self, display: Display) -> int:
        """Return how many frames may be taken."""
        if self.max_frames is not None:
            return self.max_frames
        more = max(0, self.last_frames - AlignmentSettings().last_frames)
        return max(FRAMES, min(self.search_pictures(display), MOST_SEARCHED) + AFTER_SEARCH) + more

    def require(self, display: Display) -> None:
        """Refuse before anything moves what could only fail: no mask, sections, a search without end.

        Raises BenchError or InputError.
        """
        if len(np.unique(display.mask.levels)) == 1:
            raise BenchError("The bench's [display] has no mask (its expansion is 1): none can be aligned.")
        Sections(display.slm_shape, self.division.shape)
        pictures, most = self.search_pictures(display), self.most_frames(display)
        if pictures + self.last_frames > most:
            raise BenchError(
                f"To search ±{self.reach:g} mask pixels and ±{self.depth_um:g} um takes {pictures} pictures "
                f"of {self.spots} spots, and what follows {self.last_frames} or more; {most} may "
                "be taken. Search less (--reach, --depth-um), or allow more (--max-frames)."
            )


class AlignmentSession:
    """One alignment in progress; what is known of the display's displacement is not used.

    What is found is said to the listener, and every picture of spots shown to it.
    """

    def __init__(
        self,
        io: DisplayBench,
        display: Display,
        settings: AlignmentSettings,
        listener: Listener,
    ) -> None:
        self.io = io
        self.display = replace(display, displacement=None)
        self.settings = settings
        self.spots = SpotCamera(io, self.display, before_frame=self._enough, on_look=listener.look)
        self.probe = PoseProbe(self.spots.maker)
        self.log: list[str] = []
        self.efficiencies: list[tuple[int, float]] = []
        self.listener = listener

    @property
    def frames_left(self) -> int:
        """Frames that may still be taken."""
        return self.settings.most_frames(self.display) - self.io.frames

    def register(self) -> None:
        """Blank SLM: register the camera, and learn how bright the mean intensity is."""
        self.spots.register()
        camera, display = self.spots.camera, self.display
        self.say(f"camera registered to {camera.residual_px:.2f} px")
        if abs((scale := camera.scale) - 1) > SCALE_WITHIN:
            raise AlignmentFailedError(
                f"The field is {100 * abs(scale - 1):.1f} % {'larger' if scale > 1 else 'smaller'} on the "
                f"camera than [display] says: one of its figures is wrong. Either wavelength_nm is "
                f"{scale * display.wavelength_nm:.1f}, or focal_mm {scale * display.focal_mm:.2f}, or the "
                f"mask's pixels are {display.mask_pitch_um / scale:.3f} um wide, or the camera's are not "
                f"{self.io.bench.camera.pixel_pitch_um:g} um."
            )

    def scatter(self) -> Scatter:
        """Photograph the blank SLM some times in a row; return how light and place change meanwhile."""
        self.io.show(np.ones(self.display.slm_shape, complex))
        frames = []
        for _ in range(STEADY_FRAMES):
            self._enough()
            frames.append(self.io.photograph(self.io.exposure_ms(self.spots.mean_per_ms)))
        scatter, _ = scatter_of(np.asarray(frames, np.float32))
        return replace(scatter, frames=1)  # a hypothesis has one picture

    def check(self, efficiency: float, floor: float = 0.3) -> None:
        """Fail where spots are too dim to be believed."""
        if not efficiency > floor:
            raise AlignmentFailedError(
                f"Alignment failed: spots reach {100 * efficiency:.0f} % of the model's brightness "
                f"({100 * floor:.0f} % needed). Check mask, wavelength and focal length in [display], bring "
                "the mask closer by its coarse marks, or widen the search."
            )

    def say(self, words: str) -> None:
        """Say words, and keep them for the record."""
        self.log.append(words)
        self.listener.said(words)

    def _enough(self) -> None:
        if self.frames_left <= 0:
            raise AlignmentFailedError(
                f"Alignment gave up after {self.io.frames} frames. {self.log[-1] if self.log else ''}"
            )


@dataclass(frozen=True, slots=True)
class Measured:
    """A pose as measured."""

    pose: Pose
    error: Float64Array
    """(8,): standard uncertainty of each parameter."""
    efficiency: float
    """Brightness of spots at the pose that was probed last, over the model's ideal."""


def refine_pose(
    session: AlignmentSession, pose: Pose, pictures: int, *, quick: int = 2, floor: float = 0.05
) -> Measured:
    """Step to the best pose: ``quick`` steps of one picture each, then one by all pictures together.

    Raises AlignmentFailedError when spots stay below ``floor`` of the ideal.
    """
    tilt = session.settings.tilt_mrad
    prior = np.array([np.inf] * 6 + [tilt, tilt])
    error = np.full(len(NAMES), np.nan)
    efficiency = 0.0
    for count in (*[1] * quick, pictures):
        frames = [session.spots.measure(session.probe.poses(pose)) for _ in range(count)]
        brightness = np.array([b for b, _ in frames])
        noise = float(np.mean([n for _, n in frames]))
        step = session.probe.step(brightness, noise, pose, prior)
        efficiency = float(brightness[:, -1].mean()) / session.spots.ideal(len(NAMES) * 2 + 1)
        pose, error = pose.plus(step.change), step.error
        session.efficiencies.append((session.io.frames, efficiency))
        session.listener.said(f"refinement, efficiency {efficiency:.2f}")
    session.check(efficiency, floor=floor)
    return Measured(pose, error, efficiency)


def measure_sections(session: AlignmentSession, pose: Pose) -> tuple[SmoothField, SectionShifts]:
    """Measure every section's shift beyond a pose, and fit a smooth field through them.

    One picture with widely spaced hypotheses, one closer, then several about what was found.

    Raises InputError when spots of too few sections are seen.
    """
    settings, k = session.settings, session.display.factor
    sections = Sections(session.display.slm_shape, settings.division.shape)
    falling = spot_response(session.spots.maker)
    about = np.zeros((len(sections), 1, 2))
    amplitudes, tried, noises = [], [], []
    session.spots.looks.clear()
    for step, pictures in ((0.75 * k, 1), (0.45 * k, 1), (0.45 * k, settings.section_pictures)):
        for _ in range(pictures):
            shifts = about + hypotheses(step)
            amplitude, noise = session.spots.measure_sections(pose, sections, shifts)
            amplitudes.append(amplitude)
            tried.append(shifts)
            noises.append(noise)
            session.listener.said("sections")
        found = fit_shifts(
            np.array(amplitudes), np.array(tried), float(np.mean(noises)), falling, limit=1.5 * k
        )
        about = np.where(np.isfinite(found.error), found.shift, 0.0)[:, None]
    field = fit_field(found, sections, session.display.mask.shape)
    left = float(np.sqrt(np.mean(np.sum(field.rest**2, axis=-1))))
    session.say(
        f"sections: {int(np.isfinite(found.error[:, 0]).sum())} of {len(sections)} seen, smooth rest "
        f"{left:.2f} mask pixels rms, misfit {field.misfit:.1f} sigma"
    )
    return field, found


def photograph_sections(session: AlignmentSession, pose: Pose, rest: Float64Array, pictures: int) -> None:
    """Take pictures of sections' spots about a place that is known well, for :func:`fit_photographs`."""
    sections = Sections(session.display.slm_shape, session.settings.division.shape)
    shifts = np.broadcast_to(hypotheses(0.45 * session.display.factor), (len(sections), 5, 2))
    session.spots.looks.clear()
    session.spots.maker.rest = rest
    for _ in range(pictures):
        session.spots.measure_sections(pose, sections, shifts)
        session.listener.said("sections")


def fit_photographs(session: AlignmentSession, pose: Pose, rest: Float64Array) -> FittedPlace | None:
    """Fit the place to all light of the pictures of sections' spots; None where they do not tell it.

    ``pose`` and ``rest`` are what the spots themselves tell.
    """
    spots = session.spots
    if not spots.sees_all:
        session.say("the camera's pixels are too coarse for more than spots")
        return None
    session.listener.said("fitting all light")
    found = fit_place(session.display, spots.looks, pose, rest, tilt_mrad=session.settings.tilt_mrad)
    field = found.field
    moved = Pose().plus(field.change).displacement(session.display.mask.shape) + field.rest
    apart = float(np.sqrt(np.mean(np.sum(moved**2, axis=-1))))
    session.say(
        f"all light of {len(spots.looks)} pictures: {1 - found.after**2:.0%} of their contrast is explained "
        f"({1 - found.before**2:.0%} by spots alone), {apart:.2f} mask pixels rms from what spots say"
    )
    if found.after > POOR or apart > session.display.factor / 2:
        session.say("that is too little, or too far: what spots say is kept")
        return None
    return found


def measure_again(session: AlignmentSession, pose: Pose) -> Measured | None:
    """Measure a pose that spots found by all light around them; None where that does not tell it."""
    rest = np.zeros((*NODES, 2))
    photograph_sections(session, pose, rest, 3)
    fitted = fit_photographs(session, pose, rest)
    if fitted is None:
        return None
    error = fitted.field.error.copy()
    error[[NAMES.index(name) for name in ("z_um", "pitch_mrad", "yaw_mrad")]] = fitted.deep_error
    return Measured(fitted.pose.plus(fitted.field.change), error, 1.0)


SHORT_LIST = 24
"""Shifts that are tried with rotations: a mask at the largest rotation is seldom the brightest, but among
these."""


def search_pose(session: AlignmentSession) -> Pose:
    """Search shift and depth on a grid, then the best ones with rotations and scales, then on finer grids."""
    candidates = _shifts(session)
    settings, k, depth = session.settings, session.display.factor, depth_um(session.display)
    roll, scale = settings.roll_mrad, settings.scale
    turned = [c.with_(roll_mrad=r) for c in candidates for r in (-0.6 * roll, 0.0, 0.6 * roll)]
    candidates = _best(session, turned, 6, "rotation")
    scaled = [
        c.with_(roll_mrad=c.roll_mrad + r, scale=s)
        for c in candidates
        for r in (-0.25 * roll, 0.0, 0.25 * roll)
        for s in (-0.6 * scale, 0.0, 0.6 * scale)
    ]
    candidates = _best(session, scaled, 3, "rotation and scale")
    steps = np.array([-0.75, -0.375, 0, 0.375, 0.75]) * k
    moved = [
        c.with_(shift_x=c.shift_x + x, shift_y=c.shift_y + y)
        for c in candidates
        for x in steps
        for y in steps
    ]
    candidates = _best(session, moved, 2, "shift")
    deep = [
        c.with_(z_um=c.z_um + z, roll_mrad=c.roll_mrad + r)
        for c in candidates
        for z in np.linspace(-1, 1, 9) * depth
        for r in (-0.15 * roll, 0.0, 0.15 * roll)
    ]
    return _best(session, deep, 1, "depth")[0]


def _shifts(session: AlignmentSession) -> list[Pose]:
    """Search the whole reach in steps of one SLM pixel, at as many depths as spots need."""
    settings, k = session.settings, session.display.factor
    layers, steps = settings.search_grid(session.display)
    depths = np.linspace(-1, 1, 2 * layers + 1)[1::2] * settings.depth_um if layers > 1 else np.zeros(1)
    grid = [(i, j) for i in range(-steps, steps + 1) for j in range(-steps, steps + 1)]
    hypotheses = [Pose(shift_x=k * j, shift_y=k * i, z_um=z) for z in depths for i, j in grid]
    brightness = np.empty(len(hypotheses))
    order = np.random.default_rng(1).permutation(len(hypotheses))
    for first in range(0, len(order), settings.spots):
        chosen = order[first : first + settings.spots]
        brightness[chosen], _ = session.spots.measure([hypotheses[n] for n in chosen], shifts_only=True)
        session.listener.said("search for the shift")
    score = _smooth(brightness.reshape(len(depths), 2 * steps + 1, 2 * steps + 1)).ravel()
    ranked = np.argsort(score)[::-1]
    beyond = score[ranked[min(SHORT_LIST, len(ranked) - 1)]]
    session.say(
        f"search: {len(hypotheses)} hypotheses, best {score[ranked[0]]:.1f}, first left out {beyond:.1f}, "
        f"median {np.median(score):.2f}"
    )
    return [hypotheses[n] for n in ranked[:SHORT_LIST]]


def _best(session: AlignmentSession, poses: Sequence[Pose], count: int, words: str) -> list[Pose]:
    """Measure poses twice with other places for the spots and return the brightest ones."""
    total = sum(session.spots.measure(poses)[0] for _ in range(2))
    session.listener.said(words)
    order = np.argsort(total)[::-1]
    return [poses[n] for n in order[:count]]


def _smooth(maps: Array) -> Array:
    """Add neighbours in shift, weighted: a mask between two hypotheses lights both."""
    padded = np.pad(maps, ((0, 0), (1, 1), (1, 1)))
    height, width = maps.shape[1:]
    total = np.zeros_like(maps)
    for i, wy in enumerate((0.4, 1.0, 0.4)):
        for j, wx in enumerate((0.4, 1.0, 0.4)):
            total += wy * wx * padded[:, i : i + height, j : j + width]
    return total
