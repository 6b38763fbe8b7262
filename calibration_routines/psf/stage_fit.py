"""Is the source where the stage says, and does it stay what it was? Shifts and brightness of the pattern.

The pattern of a source at ``(x, y)`` is displaced by ``-(x, y) d / z`` (Kuo 2020, Eq. 3.1), measured by
registration to the central PSF of the depth. A linear map through all of a depth's points takes up what is
the same everywhere (a wrong d or z, a rotated stage, a lead screw's scale); what is left is the single
point's own error: slip, backlash, a source that moved.

A reference point that is visited again and again tells whether the source drifts: a change of brightness is
corrected, every PSF is divided by the brightness of its moment, a straight line between visits; a change of
place is only reported, as it may be the source's, the camera's or the stage's
(docs/decisions/0019-sweep-watch-and-drift.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from calibration_routines.psf.psf_quality import (
    MAX_STEP_PX,
    PsfQuality,
    judge_sweep,
    with_finding,
)
from calibration_routines.scatter import (
    NO_CHANGE,
    STEADY,
    TOLERATED,
    Change,
    Scatter,
    compare,
    growth,
    reduction,
)
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_mean
from recon.camera.registration import Registration, moved, register
from recon.types import Geometry

Float = Float32Array

MAX_BRIGHTNESS_DRIFT = 0.1
"""Change of the source's light between two visits beyond which a straight line is not to be relied on."""
_LEAST_VISITS = 3  # of a lamp that flickers: fewer do not tell a slope
_SURE = 3.0  # standard deviations of a visit's brightness: what is less is not called a drift
_CORRECTABLE = (0.2, 5.0)  # brightness over the first visit's: beyond, it is another light, not a drift
MAX_GROWTH = 1.5e-4
"""Change of the pattern's size between two visits that is called a motion along the axis: some five times
what visits without one differ by, shaking and creeping ones included."""
MAX_PLACE_DRIFT_PX = 0.5
"""Shift of the reference's pattern that is called a drift, pixels."""
CREEP_PX = 0.2
"""Shift from the first visit that is said: places are off by it."""


@dataclass(frozen=True, slots=True)
class Drift:
    """The reference point's visits, each against the first."""

    before_point: tuple[int, ...]
    """Points of the sweep that had been taken before each visit."""
    brightness: tuple[float, ...]
    """Light received, relative to the first visit."""
    shift_px: tuple[float, ...]
    """Distance of the pattern from its place at the first visit, pixels of the PSFs."""
    findings: tuple[str, ...]
    """Empty when the source stayed what it was."""
    seconds: tuple[float, ...]
    """When each visit was, from the first."""
    brightness_error: float = 0.0
    """Standard deviation of a visit's brightness, as its frames scatter."""
    ambient: tuple[float, ...] = ()
    """Even light that came in since the first visit, in units of its mean."""
    growth: tuple[float, ...] = ()
    """Share by which the pattern is larger than at the first visit: nearer, where it grew."""

    @property
    def is_correctable(self) -> bool:
        """Whether brightness was measured at every visit, one after the other, and is that of one source."""
        least, most = _CORRECTABLE
        in_order = bool((np.diff(self.seconds) > 0).all())  # a clock that was set meanwhile tells nothing
        return in_order and all(least <= brightness <= most for brightness in self.brightness)

    def brightness_at(self, seconds: float) -> float:
        """Return the source's brightness, relative to the first visit, so long after that.

        After the last visit it stays what it was then; 1 where the drift is not correctable. Where visits
        differ no more than a lamp that flickers makes them, one straight line through all of them is taken.
        """
        if not self.is_correctable:
            return 1.0
        brightness, times = np.array(self.brightness), np.array(self.seconds)
        if self.brightness_error > 0:
            line = np.polyfit(times, brightness, 1) if len(times) > _LEAST_VISITS else [brightness.mean()]
            smooth = np.polyval(line, times)
            if np.std(brightness - smooth) <= _SURE * self.brightness_error:
                brightness = smooth
        return float(np.interp(seconds, times, brightness))


def judge_drift(
    visits: Sequence[Float],
    before_point: Sequence[int],
    last_point: int,
    seconds: Sequence[float],
    scatter: Scatter = STEADY,
) -> Drift:
    """Compare each visit to the reference with the first.

    Parameters
    ----------
    visits : sequence of ndarray, float32, (height, width)
        Averaged, dark frame subtracted, in the order of time; the first is the reference.
    before_point : sequence of int
        How many of the sweep's points had been taken before each.
    last_point : int
        How many points the sweep has.
    seconds : sequence of float
        When each visit was, from the first.
    scatter : Scatter
        Of the visits' frames: what it explains is not called a drift.
    """
    compared = [NO_CHANGE, *(compare(visit, visits[0]) for visit in visits[1:])]
    grown = [_growth(visit, visits[0], change) for visit, change in zip(visits, compared, strict=True)]
    findings: list[str] = []
    for k in range(1, len(visits)):
        points = (before_point[k - 1], min(before_point[k], last_point))
        findings += judge_visit((compared[k - 1], compared[k]), points, scatter)
        larger = grown[k] - grown[k - 1]
        if abs(larger) > MAX_GROWTH:
            size, way = ("larger", "nearer") if larger > 0 else ("smaller", "farther")
            findings.append(
                f"between points {points[0] + 1} and {points[1]} the reference's pattern became "
                f"{abs(larger):.2%} {size}: the source came {way}. z lost steps, or something slipped along "
                "the axis: look at the coupling, and take the sweep again."
            )
    findings += _crept(compared, scatter, said=any("pattern moved" in words for words in findings))
    return Drift(
        tuple(before_point),
        tuple(change.brightness for change in compared),
        tuple(change.shift_px for change in compared),
        tuple(findings),
        tuple(seconds),
        scatter.brightness_error,
        tuple(change.ambient for change in compared),
        tuple(grown),
    )


def _crept(compared: Sequence[Change], scatter: Scatter, *, said: bool) -> tuple[str, ...]:
    """Return what small steps from visit to visit add up to, unless one of them was said."""
    far = max(change.shift_px for change in compared)
    if said or not np.isfinite(far) or far <= MAX_PLACE_DRIFT_PX + _SURE * scatter.place_error_px:
        return ()
    return (
        f"from visit to visit the reference's pattern moved on, {far:.1f} pixels off its first place in "
        f"all (up to {MAX_PLACE_DRIFT_PX:g} expected): the source, the camera or the table creeps. Let it "
        "settle, clamp what slackens, and sweep again.",
    )


def _growth(visit: Float, first: Float, change: Change) -> float:
    """Return by which share the pattern of a visit is larger than that of the first; 0 where unknown."""
    if not np.isfinite(change.shift_px) or visit is first:
        return 0.0
    factor = reduction(first)
    seen, other = block_mean(visit, factor), block_mean(first, factor)
    return growth(moved(seen, -change.rows / factor, -change.columns / factor), other)


def judge_visit(
    visits: tuple[Change, Change], points: tuple[int, int], scatter: Scatter = STEADY
) -> tuple[str, ...]:
    """Return what changed between two visits beyond what their frames' scatter explains, in words.

    Each visit is relative to the first of all; ``points`` are how many of the sweep's had been taken before.
    """
    findings = []
    before, after = visits
    where = f"between points {points[0] + 1} and {points[1]}"
    change = after.brightness / before.brightness - 1 if before.brightness else float("nan")
    if not abs(change) <= MAX_BRIGHTNESS_DRIFT + _SURE * scatter.brightness_error:
        findings.append(
            f"{where} the source became {abs(change):.1%} {'brighter' if change > 0 else 'dimmer'} "
            f"(up to {MAX_BRIGHTNESS_DRIFT:.0%} can be corrected for): let it warm up, keep other light out, "
            "and take the sweep again where PSFs must compare in brightness."
        )
    came = after.ambient - before.ambient
    if abs(came) > TOLERATED:
        findings.append(
            f"{where} other light {'came in' if came > 0 else 'went'}, {abs(came):.1%} of the reference's "
            "mean: keep daylight, lamps and screens out, and take the sweep again."
        )
    if not abs(after.shift_px - before.shift_px) <= MAX_PLACE_DRIFT_PX + _SURE * scatter.place_error_px:
        findings.append(
            f"{where} the reference's pattern moved from {before.shift_px:.1f} to {after.shift_px:.1f} "
            f"pixels off its first place (up to {MAX_PLACE_DRIFT_PX:g} expected): the source or the camera "
            "moved, or the stage slipped or has play (calibrate stage tells). Mend it, and sweep again."
        )
    return tuple(findings)


MAX_GAIN_ERROR = 0.03
"""Relative departure of the measured shift per micrometre from d/z that is called wrong."""
_LEAST_GAIN = 0.002
"""Less than that is not told as a distance that is off: registration and the law itself are not better."""
_LEAST_RESIDUAL_PX = 0.02  # of a registration, a coordinate
_LAW = 5e-4  # of a shift: what the simulated bench's light departs from d/z by
MAX_ROTATION_MRAD = 35.0
"""Rotation of the stage's axes against the sensor's that is called wrong (2 degrees)."""
_OUTLIER_PX = 0.3  # residuals beyond this count less and less in the fit
_LEAST_POINTS = 4  # fewer determine the map exactly: nothing is left to judge
_NEAR_PX, _NEAR_PART = 40.0, 0.2  # where a pattern is looked for: pixels, and part of its shift
_FAR_PROMINENCE = 3.0  # a pattern found elsewhere must stand out more: few spots resemble many places


@dataclass(frozen=True, slots=True)
class StageFit:
    """Measured shifts of one depth against what the stage said."""

    z_um: float
    points: int
    """Whose shift could be measured."""
    gain_error: float | None
    """Measured shift per micrometre over ``d / z / pitch``, minus one; None where d is not known."""
    rotation_mrad: float
    """Of the stage's axes against the sensor's."""
    anisotropy: float
    """Difference of the gains along x and y over their mean."""
    residual_median_px: float
    residual_95_px: float
    """Of the points about the linear map."""
    findings: tuple[str, ...] = ()
    gain_error_std: float = 0.0
    """Standard deviation of ``gain_error``, by the points' residuals."""

    def distance_words(self, d_mm: float | None) -> str:
        """Return what a measured shift that is surely not ``d / z`` means; nothing where it may be.

        One depth does not tell d from z, and no more than what is beyond :data:`MAX_GAIN_ERROR` is called
        wrong: rulers are not better.
        """
        error = self.gain_error
        if error is None or d_mm is None or abs(error) <= max(_SURE * self.gain_error_std, _LEAST_GAIN):
            return ""
        off_um = self.z_um * error / (1 + error)
        return (
            f"Distance: that is as if the mount held the source {abs(off_um) / 1e3:.2f} mm "
            f"{'nearer' if off_um > 0 else 'farther'} than recorded, or as if d were "
            f"{d_mm * (1 + error):.3f} mm, not {d_mm:.4g} (known to {self.gain_error_std:.2%}). The PSFs are "
            "right where they were taken; lengths across are off by this share."
        )


def judge_points(
    quality: Sequence[PsfQuality], psfs: Float32Array, geometry: Geometry
) -> tuple[tuple[PsfQuality, ...], tuple[StageFit, ...]]:
    """Judge the PSFs of a sweep against one another.

    Along the axis (the central PSF of each depth) by
    :func:`~calibration_routines.psf.psf_quality.judge_sweep`, across it by registration to the central PSF.

    Parameters
    ----------
    quality : sequence of PsfQuality
        Of each point, measured alone.
    psfs : ndarray, float32, (n_points, n_channels, height, width)
    geometry : Geometry
        Of the PSFs' pixels.
    """
    judged = list(quality)
    depths: dict[float, list[int]] = {}
    for index, point in enumerate(quality):
        depths.setdefault(point.z_um, []).append(index)
    central = [
        min(group, key=lambda i: float(np.hypot(quality[i].x_um, quality[i].y_um)))
        for group in depths.values()
    ]
    d_mm = geometry.diffuser_distance_mm
    along = judge_sweep([quality[i] for i in central], None if d_mm is None else 1e3 * d_mm)
    for index, plane in zip(central, along, strict=True):
        judged[index] = plane
    stages = []
    for centre, group in zip(central, depths.values(), strict=True):
        others = [i for i in group if i != centre]
        if others:
            stages.append(_judge_depth(judged, psfs, geometry, centre, others))
    return tuple(judged), tuple(stages)


def fit_stage(
    places_um: Float64Array, shifts_px: Float64Array, nominal_px_per_um: float | None
) -> tuple[Float64Array, float | None, float, float]:
    """Fit ``shift = -G (place)`` robustly, with the central point fixed at zero.

    Parameters
    ----------
    places_um : ndarray, (n, 2)
        ``(y, x)`` of each source from the central one.
    shifts_px : ndarray, (n, 2)
        ``(row, column)`` of its pattern from the central one.
    nominal_px_per_um : float, optional
        ``d / z / pitch``.

    Returns
    -------
    residuals_px : ndarray, (n,)
    gain_error : float or None
    rotation_mrad, anisotropy : float
    """
    offset = len(places_um) >= _LEAST_POINTS  # the central registration's own error, where it can be told

    def missed(p: Float64Array) -> Float64Array:
        model = -(places_um @ p[:4].reshape(2, 2).T) + (p[4:] if offset else 0.0)
        return np.asarray((shifts_px - model).ravel())

    start = np.zeros(6 if offset else 4)
    solution, *_ = np.linalg.lstsq(-places_um, shifts_px, rcond=None)
    start[:4] = solution.T.ravel()
    scale = float(np.abs(places_um).max())
    from scipy.optimize import least_squares  # late: commands that calibrate otherwise start sooner

    fitted = least_squares(
        missed, start, loss="soft_l1", f_scale=_OUTLIER_PX, x_scale=[1 / scale] * 4 + [1.0] * (len(start) - 4)
    )
    gain = fitted.x[:4].reshape(2, 2)
    residuals = np.hypot(*missed(fitted.x).reshape(-1, 2).T)
    mean = 0.5 * (gain[0, 0] + gain[1, 1])
    rotation = np.arctan2(gain[1, 0] - gain[0, 1], gain[0, 0] + gain[1, 1])
    error = None if nominal_px_per_um is None else float(mean / nominal_px_per_um - 1)
    return residuals, error, float(1e3 * rotation), float((gain[1, 1] - gain[0, 0]) / mean)


def _fit_line(
    places_um: Float64Array, shifts_px: Float64Array, nominal_px_per_um: float | None
) -> tuple[Float64Array, float | None, float]:
    """Fit one turn and one scale robustly: the median over the points; returned as by :func:`fit_stage`."""
    place, shift = (v[:, 1] + 1j * v[:, 0] for v in (places_um, shifts_px))
    ratios = -shift / place
    gain = complex(np.median(ratios.real), np.median(ratios.imag))
    error = None if nominal_px_per_um is None else abs(gain) / nominal_px_per_um - 1
    return np.abs(shift + gain * place), error, float(1e3 * np.angle(gain))


def _judge_depth(
    judged: list[PsfQuality],
    psfs: Float32Array,
    geometry: Geometry,
    centre: int,
    others: list[int],
) -> StageFit:
    """Register a depth's PSFs to the central one; puts steps, similarities and findings into ``judged``."""
    here = judged[centre]
    nominal = nominal_px_per_um(geometry, here.z_um)
    factor = reduction(psfs[0, 0])
    reference = block_mean(psfs[centre].mean(axis=0), factor)
    places, shifts, seen = [], [], []
    for index in others:
        point = judged[index]
        place = np.array([point.y_um - here.y_um, point.x_um - here.x_um])
        found = find_pattern(block_mean(psfs[index].mean(axis=0), factor), reference, place, nominal, factor)
        if found is None or not found.reliable:
            judged[index] = with_finding(
                point,
                "its pattern was not found where the stage says, nor does it resemble the central one: "
                "too little of it is on the sensor, or there is too little light. Bring the point nearer.",
                retake=False,
            )
            continue
        judged[index] = replace(point, similarity=found.similarity)
        places.append(place)
        shifts.append(factor * np.array([found.rows, found.columns]))
        seen.append(index)
    return _held_against_stage(judged, here.z_um, seen, np.array(places), np.array(shifts), nominal)


def _held_against_stage(
    judged: list[PsfQuality],
    z_um: float,
    seen: list[int],
    places: Float64Array,
    shifts: Float64Array,
    nominal: float | None,
) -> StageFit:
    spans = len(seen) >= 2 and np.linalg.matrix_rank(places, tol=1e-6 * np.abs(places).max()) == 2
    if spans:
        residuals, gain_error, rotation_mrad, anisotropy = fit_stage(places, shifts, nominal)
    elif seen:  # points on one line through the centre: a turn and a scale, no more, can be told
        residuals, gain_error, rotation_mrad = _fit_line(places, shifts, nominal)
        anisotropy = 0.0
    else:
        return StageFit(z_um, 0, None, 0.0, 0.0, 0.0, 0.0)
    for index, residual in zip(seen, residuals, strict=True):
        judged[index] = replace(judged[index], step_px=float(residual))
        if residual > MAX_STEP_PX:
            judged[index] = with_finding(
                judged[index],
                f"the pattern lies {residual:.1f} pixels beside where the stage says (up to {MAX_STEP_PX:g} "
                "expected): the stage or the source slipped. Take it again.",
                retake=True,
            )
    findings = []
    if gain_error is not None and abs(gain_error) > MAX_GAIN_ERROR:
        findings.append(
            f"z = {z_um / 1e3:.4g} mm: the pattern moves {abs(gain_error):.1%} too "
            f"{'far' if gain_error > 0 else 'little'} for d/z: check d, the source's distance, the pixel "
            "pitch, and the stage's steps per millimetre."
        )
    if abs(rotation_mrad) > MAX_ROTATION_MRAD:
        findings.append(
            f"z = {z_um / 1e3:.4g} mm: the stage's axes are turned by {rotation_mrad / 17.45:.1f} degrees "
            "against the sensor's: turn the camera, or check which axis is which."
        )
    return StageFit(
        z_um,
        len(seen),
        gain_error,
        rotation_mrad,
        anisotropy,
        float(np.median(residuals)),
        float(np.quantile(residuals, 0.95)),
        tuple(findings),
        _gain_error_std(residuals, places, nominal),
    )


def _gain_error_std(residuals_px: Float64Array, places_um: Float64Array, nominal: float | None) -> float:
    if nominal is None:
        return 0.0
    a_coordinate_px = max(float(np.sqrt(np.mean(residuals_px**2) / 2)), _LEAST_RESIDUAL_PX)
    return float(np.hypot(_LAW, a_coordinate_px / (nominal * np.sqrt((places_um**2).sum()))))


def find_pattern(
    psf: Float32Array,
    reference: Float32Array,
    place_um: Float64Array,
    nominal_px_per_um: float | None,
    factor: int,
) -> Registration | None:
    """Register a PSF near where the stage says; everywhere when it is not there.

    Parameters
    ----------
    psf, reference : ndarray, float32, (height, width)
        Both binned by ``factor``.
    place_um : ndarray, (2,)
        ``(y, x)`` of the PSF's source from the reference's.
    nominal_px_per_um : float, optional
        :func:`nominal_px_per_um`.

    Returns
    -------
    Registration or None
        In binned pixels; None when nothing is seen.
    """
    if not np.ptp(psf) > 0 or not np.ptp(reference) > 0:
        return None
    if nominal_px_per_um is not None:
        row, column = -place_um * nominal_px_per_um / factor
        reach = (_NEAR_PX + _NEAR_PART * float(np.hypot(row, column) * factor)) / factor
        found = register(psf, reference, near=(row, column), within_px=reach)
        if found.reliable:
            return found
    found = register(psf, reference)
    return found if nominal_px_per_um is None or found.prominence >= _FAR_PROMINENCE else None


def nominal_px_per_um(geometry: Geometry, z_um: float) -> float | None:
    """Return ``d / z / pitch``: the pattern's shift in pixels a micrometre; None where it is not known."""
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    return None if d_mm is None or pitch_um is None else 1e3 * d_mm / z_um / pitch_um
