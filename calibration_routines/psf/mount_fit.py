"""Where the source truly stands, told by an axial sweep itself: light and place of its pattern.

Light through the aperture falls off with the square of the distance, so that planes tell how far the source
is beyond where it is recorded, whatever d. The pattern's centroid runs as ``-x d / z`` (Kuo 2020, Eq. 3.1),
which tells how far beside the aperture's middle it stands. And it grows towards the diffuser as ``1 + d / z``
(Eq. 5.2): that tells ``d``. The pixel pitch, which shifts across tell, enters only by the share that the
diffuser bends (:func:`_bent`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import stdtrit

from calibration_routines.psf.psf_quality import MAX_CLIPPED, PsfQuality
from calibration_routines.psf.stage_fit import StageFit
from calibration_routines.scatter import compare, growth, reduction
from recon.arrays import Float64Array
from recon.base.blocks import block_mean
from recon.camera.depth_mixture import paraxial_scale
from recon.camera.registration import moved, rescaled
from recon.types import Geometry

_LEAST_PLANES = 4
_LEAST_FOR_D = 5  # of four noisy ones the three pairs agree by chance now and then
_LEAST_RANGE = 1.2  # of depths, farthest over nearest
_NEAR = 10.0  # apertures: nearer, light falls off otherwise than with the square
_LEAST_ERROR = 0.002  # of a plane's brightness: what dark frames and the sensor's edge leave
_SURE = 5.0  # standard deviations
_TOLERATED = 0.01  # of the nearest distance
_BESIDE_PX = 2.0  # of the centroid's way over the sweep
_OFF_MIDDLE = 0.03  # of a pattern's radius: its light need not be even
_UNEVEN = 0.02  # of a plane's brightness: a step away from the law
_GROWN = 7  # planes that are held against one another for d: of more, these, evenly among them
_ROUNDS, _FOUND = 12, 0.002  # at most, and the step, of d, at which it is found
_TELLS = 0.5  # of d: known less than that it is not said
_ONE_SIDED = 0.99865  # the share of cases below three standard deviations
_LAW = 0.015  # of d: what Eq. 5.2 leaves out (1.6 % under the smooth diffuser, 0.7 on a large sensor)
_WRONG_D, _SURE_OF_D = 0.05, 3.0


@dataclass(frozen=True, slots=True)
class MountFit:
    """The source against its record, um, each with a standard deviation."""

    farther_um: float
    farther_error_um: float
    """How much farther it is than recorded."""
    beside_um: tuple[float, float] | None
    """``(x, y)`` from the axis through the aperture's middle; None where d or the pitch is not known."""
    beside_error_um: float
    uneven: float
    """Largest relative departure of a plane's light from the square law."""
    distance: tuple[float, float] | None = None
    """``d`` by the pattern's growth over the configured one, and the standard deviation of that; None where d
    is not known, or the planes do not tell."""
    findings: tuple[str, ...] = ()
    pitch: tuple[float, float] | None = None
    """The pixel pitch by the shifts across, with that ``d``, over the configured one, and the standard
    deviation of that; None where they do not tell."""

    def line(self, geometry: Geometry) -> str:
        """Return what was fitted, each with its standard deviation; ``geometry`` is of the PSFs' pixels."""
        farther, error = self.farther_um / 1e3, self.farther_error_um / 1e3
        words = (
            f"{abs(farther):.2f} +- {error:.2f} mm {'farther' if farther >= 0 else 'nearer'} than recorded"
        )
        if self.beside_um is not None:
            x, y = (value / 1e3 for value in self.beside_um)
            words += (
                f", x = {x:+z.2f} and y = {y:+z.2f} mm (+- {self.beside_error_um / 1e3:.2f}) off the axis"
            )
        for told, configured, name, unit in (
            (self.distance, geometry.diffuser_distance_mm, "d", "mm"),
            (self.pitch, geometry.pixel_pitch_um, "pixels of", "um"),
        ):
            if told is not None and configured is not None:
                found, off = (configured * value for value in told)
                words += f"; {name} {found:.4g} +- {off:.2g} {unit}, {configured:.4g} configured"
        return f"Fitted: the source stands {words}."


def with_pitch(mount: MountFit | None, stages: Sequence[StageFit], geometry: Geometry) -> MountFit | None:
    """Let the shifts across tell the pixel pitch, once the pattern's growth has told ``d``.

    A pattern moves by ``d / z / pitch`` pixels a micrometre of the source.
    """
    gains = [(one.gain_error, one.gain_error_std, one.z_um) for one in stages if one.gain_error is not None]
    if mount is None or mount.distance is None or geometry.pixel_pitch_um is None or not gains:
        return mount
    of_d, of_d_error = mount.distance
    found = [of_d * z / (z + mount.farther_um) / (1 + gain) for gain, _, z in gains]
    ratio = float(np.median(found))
    near = min(z for _, _, z in gains)
    of_shifts = float(np.median([std for _, std, _ in gains]))
    shares = (of_d_error / of_d, mount.farther_error_um / near, of_shifts)
    error = ratio * float(np.sqrt(np.square(shares).sum()))
    findings = mount.findings
    if abs(ratio - 1) > max(_SURE_OF_D * error, _WRONG_D):
        pitch_um = geometry.pixel_pitch_um
        findings += (
            f"the shifts across, with d as the pattern grows, are those of pixels of {ratio * pitch_um:.3g} "
            f"+- {error * pitch_um:.2g} um, not {pitch_um:.4g}: check pixel_pitch_um of [geometry], the "
            "camera's binning, and the stage's steps per millimetre across.",
        )
    return replace(mount, pitch=(ratio, error), findings=findings)


def fit_mount(
    planes: Sequence[PsfQuality],
    light: npt.NDArray[np.floating],
    geometry: Geometry,
    brightness_error: float = 0.0,
    psfs: Sequence[npt.NDArray[np.floating]] = (),
) -> MountFit | None:
    """Fit where the source of an axial sweep stands; None where too little tells.

    Parameters
    ----------
    planes : sequence of PsfQuality
        The central PSFs, one a depth.
    light : ndarray, (n,)
        All light of each, at one exposure, the source's drift taken out.
    geometry : Geometry
        Of the PSFs' pixels.
    brightness_error : float
        Standard deviation of a PSF's brightness by what flickers, relative.
    psfs : sequence of ndarray, (n_channels, height, width)
        The planes' patterns, for d; without them it is not fitted.
    """
    kept = [i for i, p in enumerate(planes) if p.radius_px > 0 and p.clipped <= MAX_CLIPPED and light[i] > 0]
    z = np.array([planes[i].z_um for i in kept])
    if len(kept) < _LEAST_PLANES or z.max() < _LEAST_RANGE * z.min():
        return None
    if geometry.aperture_mm is None or z.min() < _NEAR * 1e3 * max(geometry.aperture_mm):
        return None
    logs = np.log(np.asarray(light, np.float64)[kept])
    scale = z.min()

    def off(p: Float64Array) -> Float64Array:
        return np.asarray(logs - p[0] + 2 * np.log(np.maximum(z + scale * p[1], 0.05 * z)))

    start = np.array([float(np.mean(logs + 2 * np.log(z))), 0.0])
    from scipy.optimize import least_squares  # late: commands that calibrate otherwise start sooner

    fitted = least_squares(off, start, loss="soft_l1", f_scale=0.01)
    rest = off(fitted.x)
    spread = max(float(np.sqrt((rest**2).sum() / (len(z) - 2))), brightness_error, _LEAST_ERROR)
    jacobian = np.stack([-np.ones_like(z), 2 * scale / (z + scale * fitted.x[1])], axis=1)
    errors = spread * np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian)))
    farther, error = scale * float(fitted.x[1]), scale * float(errors[1])
    beside, beside_error, way = _beside([planes[i] for i in kept], z + farther, geometry)
    found = []
    if abs(farther) > max(_SURE * error, _TOLERATED * scale):
        found.append(
            "the light falls off with the square of the distance as if the source stood "
            f"{abs(farther) / 1e3:.2f} +- {error / 1e3:.2f} mm {'farther' if farther > 0 else 'nearer'} than "
            "recorded: check the mount, and set the z of [source] offset_um, or the stage's zero."
        )
    uneven = float(np.abs(rest).max())
    unlike_law = uneven > max(_UNEVEN, _SURE * max(brightness_error, _LEAST_ERROR))
    if unlike_law:
        worst = z[int(np.argmax(np.abs(rest)))] / 1e3
        found.append(
            f"the light departs from the square law by {uneven:.1%} at z = {worst:.4g} mm: z lost steps "
            "there, the lamp changed, or something stands in the way. Take the sweep again."
        )
    if beside is not None and way > _BESIDE_PX and np.hypot(*beside) > _SURE * beside_error:
        found.append(
            f"the pattern moves with depth as if the source stood x = {beside[0] / 1e3:z.2f}, y = "
            f"{beside[1] / 1e3:z.2f} mm (+- {beside_error / 1e3:.2f}) beside the axis through the aperture's "
            "middle: centre it, set [source] offset_um, or see whether the rail leans."
        )
    d_mm, distance = geometry.diffuser_distance_mm, None
    # Where light does not tell the depths there is no d either.
    told = not unlike_law and bool(np.all(z + farther > 0)) and len(kept) >= _LEAST_FOR_D
    if psfs and told and d_mm is not None and geometry.pixel_pitch_um is not None:
        bent = _bent([planes[i] for i in kept], z + farther, geometry)
        unsure = float(np.hypot(2 * error / np.median(z), (1 - bent) / 2))
        distance = _distance([psfs[i] for i in kept], z + farther, 1e3 * d_mm, bent, unsure)
    if distance is not None and d_mm and abs(distance[0] - 1) > max(_SURE_OF_D * distance[1], _WRONG_D):
        found.append(
            f"the pattern grows towards the diffuser as if d were {d_mm * distance[0]:.2f} +- "
            f"{d_mm * distance[1]:.2f} mm, not {d_mm:.4g}: check diffuser_distance_mm and aperture_mm of "
            "[geometry], and the stage's steps per millimetre along z."
        )
    return MountFit(farther, error, beside, beside_error, uneven, distance, tuple(found))


def _bent(planes: Sequence[PsfQuality], z: Float64Array, geometry: Geometry) -> float:
    """Return by which share a pattern grows less than its rays move apart, because the diffuser bends them.

    A ray from ``xi`` moves with ``xi``, but lies where it was bent to: growth about the place where light
    lies is less by the aperture's square over the pattern's (as in any regression on a place with errors).
    """
    assert geometry.diffuser_distance_mm is not None
    assert geometry.pixel_pitch_um is not None
    assert geometry.aperture_mm is not None
    aperture_um = 1e3 * np.array(geometry.aperture_mm)
    radii_um = geometry.pixel_pitch_um * np.array([plane.radius_px for plane in planes])
    radius_um = float(np.median(radii_um / (1 + 1e3 * geometry.diffuser_distance_mm / z)))
    return min(float((aperture_um**2).sum()) / 12 / radius_um**2, 1.0)


def _distance(
    psfs: Sequence[npt.NDArray[np.floating]],
    z: Float64Array,
    d_um: float,
    bent: float,
    unsure: float,
) -> tuple[float, float] | None:
    """Return d over ``d_um`` by the growth from plane to plane, and its error; None where they do not tell.

    Parameters
    ----------
    psfs : sequence of ndarray, (n_channels, height, width)
    z : ndarray, (n,)
        Where their sources stand.
    bent : float
        :func:`_bent`: what is found is divided by it.
    unsure : float
        What else d is not known by, relative.
    """
    chosen = np.argsort(z)[np.unique(np.linspace(0, len(z) - 1, _GROWN).round().astype(int))]
    factor = reduction(psfs[0])
    planes = [block_mean(psfs[i].mean(axis=0), factor) for i in chosen]
    planes = [(plane / plane.mean()).astype(np.float32) for plane in planes]
    depths, found = z[chosen], d_um
    for _ in range(_ROUNDS):
        rest = []
        for near, far, z_near, z_far in zip(planes, planes[1:], depths, depths[1:], strict=False):
            enlarged = rescaled(far, 1 / paraxial_scale(z_far, z_near, found))
            change = compare(near, enlarged)
            if not np.isfinite(change.shift_px):
                return None
            laid = moved(near, -change.rows, -change.columns)
            # Noise in what an image is held against makes it seem larger, either way round.
            rest.append((growth(laid, enlarged) - growth(enlarged, laid)) / 2)
        slope = 1 / (depths[:-1] + found) - 1 / (depths[1:] + found)
        step = float(slope @ rest / (slope @ slope))
        found += float(np.clip(step, -0.3 * d_um, 0.3 * d_um))
        if not 0.2 * d_um < found < 5 * d_um:
            return None
        if abs(step) < _FOUND * d_um:
            break
    else:
        return None
    # What is left goes on from plane to plane under lenslets, so that more planes make it no surer.
    # Few pairs may agree by chance: Student's quantile says how often.
    pairs = len(rest)
    left = (
        float(np.sqrt(((np.array(rest) - slope * step) ** 2).sum() / (pairs - 1) / np.mean(slope**2))) / d_um
    )
    left *= max(1.0, float(stdtrit(pairs - 1, _ONE_SIDED)) / _SURE_OF_D / np.sqrt(pairs))
    error = float(np.sqrt(left**2 + _LAW**2 + unsure**2))
    ratio = found / d_um / bent
    return (ratio, error * ratio) if error < _TELLS else None


def _beside(
    planes: Sequence[PsfQuality], z: Float64Array, geometry: Geometry
) -> tuple[tuple[float, float] | None, float, float]:
    """Return the source's place across, its error, and how far that moves the centroid, pixels."""
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    if d_mm is None or pitch_um is None:
        return None, 0.0, 0.0
    px_per_um = 1e3 * d_mm / z / pitch_um
    places = np.array([plane.centroid_px for plane in planes])
    design = np.stack([np.ones_like(z), -px_per_um], axis=1)
    solution, *_ = np.linalg.lstsq(design, places, rcond=None)
    rest = places - design @ solution
    spread = max(float(np.sqrt((rest**2).sum() / (2 * len(z) - 4))), 0.05)
    error = spread * float(np.sqrt(np.linalg.inv(design.T @ design)[1, 1]))
    y_um, x_um = (float(v) for v in solution[1])
    return (x_um, y_um), error, float(np.hypot(x_um, y_um) * np.ptp(px_per_um))


def off_middle(planes: Sequence[PsfQuality], geometry: Geometry) -> str:
    """Return words where the central patterns lie beside the sensor's middle at every depth; else nothing.

    A rail that leans by an angle moves them as a diffuser does that stands ``d`` times the angle beside the
    sensor's middle: which of them it is no sweep tells.
    """
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    kept = [p for p in planes if p.radius_px > 0 and p.clipped <= MAX_CLIPPED]
    if d_mm is None or pitch_um is None or not kept:
        return ""
    z = np.array([p.z_um for p in kept])
    recorded = np.array([(p.y_um, p.x_um) for p in kept])
    off = np.array([p.centroid_px for p in kept]) + recorded * (1e3 * d_mm / z / pitch_um)[:, None]
    one_depth = len(np.unique(z)) < 2
    if not one_depth:  # what goes with 1/z is the source's place
        off = np.linalg.lstsq(np.stack([np.ones_like(z), 1 / z], axis=1), off, rcond=None)[0]
    row, column = (float(v) for v in off[0])
    if np.hypot(row, column) <= max(_BESIDE_PX, _OFF_MIDDLE * kept[0].radius_px):
        return ""
    off_um = float(np.hypot(row, column)) * pitch_um
    lean_mrad = off_um / d_mm
    who = "the diffuser or the source stands" if one_depth else "the diffuser stands"
    return (
        f"Middle: the pattern's light lies {column:+.1f}, {row:+.1f} pixels (x, y) beside the sensor's "
        f"middle: {who} beside it, by {off_um / 1e3:.2f} mm on the sensor, or the rail leans by "
        f"{lean_mrad:.1f} mrad; the sweep cannot tell which. PSFs are right where they were taken."
    )
