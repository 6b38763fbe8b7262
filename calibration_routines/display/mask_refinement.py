"""Measure the mask's pose finely by pairs of probe spots, and its displacement section by section."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from calibration_routines.display.alignment_session import AlignmentSession
from recon.holography.pose import NAMES, Pose
from recon.holography.sections import Sections, SectionShifts, SmoothField, fit_field, fit_shifts, hypotheses
from recon.holography.sections import response as spot_response


@dataclass(frozen=True, slots=True)
class Measured:
    """A pose as measured.

    Attributes
    ----------
    pose : Pose
    error : ndarray, float64, (8,)
        Standard uncertainty of each parameter.
    efficiency : float
        Brightness of spots at the pose that was probed last, over the model's ideal.
    """

    pose: Pose
    error: npt.NDArray[np.float64]
    efficiency: float


def refine_pose(
    session: AlignmentSession, pose: Pose, pictures: int, *, quick: int = 2, floor: float = 0.05
) -> Measured:
    """Step to the best pose: ``quick`` steps of one picture each, then one by all pictures together.

    Raises
    ------
    AlignmentFailedError
        When spots stay below ``floor`` of the ideal.
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
        session.tell(f"refinement, efficiency {efficiency:.2f}")
    session.check(efficiency, floor=floor)
    return Measured(pose, error, efficiency)


def measure_sections(session: AlignmentSession, pose: Pose) -> tuple[SmoothField, SectionShifts]:
    """Measure every section's shift beyond a pose, and fit a smooth field through them.

    One picture with widely spaced hypotheses, one closer, then several about what was found.

    Raises
    ------
    InputError
        When spots of too few sections are seen.
    """
    settings, k = session.settings, session.display.factor
    sections = Sections(session.display.slm_shape, settings.division)
    falling = spot_response(session.spots.maker)
    about = np.zeros((len(sections), 1, 2))
    amplitudes, tried, noises = [], [], []
    for step, pictures in ((0.75 * k, 1), (0.45 * k, 1), (0.45 * k, settings.section_pictures)):
        for _ in range(pictures):
            shifts = about + hypotheses(step)
            amplitude, noise = session.spots.measure_sections(pose, sections, shifts)
            amplitudes.append(amplitude)
            tried.append(shifts)
            noises.append(noise)
            session.tell("sections")
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
