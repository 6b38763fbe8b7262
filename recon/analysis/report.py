"""Everything that the analysis tells about a calibration, in one call."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from recon.analysis.correlation import (
    INNER_PRODUCT,
    RESOLUTION_LEVEL,
    FieldOfView,
    FieldPoint,
    across_field,
    autocorrelation_cut,
    convolution_holds_deg,
    field_of_view,
    half_light_deg,
    lit_extent,
)
from recon.analysis.gram import ConditionCurve, Direction, condition_curve
from recon.analysis.middle import RIM_PX, Middle
from recon.analysis.point_images import PLANES, planes_about
from recon.analysis.point_noise import Noise
from recon.analysis.point_tests import PointTests, point_tests
from recon.analysis.resolution import (
    AxialResolution,
    DepthSimilarity,
    LateralResolution,
    VoxelGrid,
    across_depth,
    axial_resolutions,
    support_extent_px,
    voxel_grid,
)
from recon.analysis.settings import AnalysisSettings, axial_spacing, lateral_spacing, response_of
from recon.analysis.stated_distance import AT_NEARER, InVolumes, Reached
from recon.arrays import Array, Float64Array
from recon.base.arguments import require_argument
from recon.base.brief import brief
from recon.base.checks import require_calibration
from recon.base.declare import require
from recon.base.threads import linear_algebra_on_one_thread
from recon.camera.camera_model import choose_model, sort_by_depth
from recon.camera.depth_mixture import central_psfs
from recon.errors import InputError
from recon.types import Calibration

Progress = Callable[[str, float], object]
"""Called with what is being done and the share that is done."""

Reach = Callable[..., Reached]
ReachInVolumes = Callable[..., InVolumes]

CONDITION_COUNTS: Mapping[Direction, tuple[int, ...]] = {"x": (2, 4, 9, 16), "z": (2, 3, 4), "xz": (4, 9, 16)}
SEPARATIONS = (1, 2, 3, 4, 5, 6, 8)
CONDITION_PLANES = 13
"""Planes for groups in depth: four sources four planes apart."""


@dataclass(frozen=True)
class Analysis:
    """What the optics of a calibration can do.

    Lengths in micrometres, angles in degrees; ``None`` where the calibration cannot tell, with the reason in
    ``notes``.
    """

    z_um: float
    pitch_um: float
    distance_um: float
    sensor_shape: tuple[int, int]
    psf: Array
    """(height, width): the central PSF at ``z_um``, as it was analysed (cut to its light, channels
    averaged)."""
    autocorrelation: Float64Array
    """Its cut along the columns, from the peak."""
    support_px: tuple[float, float]
    lateral: LateralResolution
    lateral_inner: LateralResolution
    axial: AxialResolution
    axial_inner: AxialResolution
    view_y: FieldOfView
    view_x: FieldOfView
    field: tuple[FieldPoint, ...]
    convolution_holds_deg: float | None
    depth: DepthSimilarity | None
    condition: tuple[ConditionCurve, ...]
    condition_voxel: tuple[float, float]
    """Voxel of the condition numbers: pixels across, ``1 / um`` along."""
    points: PointTests | None
    """Points alone, solved without a prior: what the optics allow."""
    reached: Reached | None
    """What the default reconstruction makes of two points; None where it was not asked."""
    in_volumes: InVolumes | None
    """The same of default volumes; None where it was not asked."""
    half_light_deg: tuple[float, float]
    """Angle along y and x at which half of the axis' light reaches the sensor, by its edge, the aperture's
    obliquity and the pixels' response where that is known."""
    lateral_spacing_um: float | None
    axial_spacing_per_um: float | None
    grid: VoxelGrid
    model: str
    model_reason: str
    noise: Noise
    """Of the tests' images."""
    settings: AnalysisSettings
    notes: tuple[str, ...]

    __repr__ = brief

    def figures(self) -> dict[str, Any]:
        """Return every figure by name; images are left out."""
        figures = asdict(self)
        del figures["psf"], figures["autocorrelation"], figures["settings"]["fall_off"]
        figures["resolution"] = {
            "angle_deg": self.lateral.angle_deg(self.pitch_um, self.distance_um),
            "object_um": self.lateral.object_um(self.pitch_um, self.distance_um, self.z_um),
            "depth_of_field_um": self.axial.depth_of_field_um(self.z_um),
            "hyperfocal_um": self.axial.hyperfocal_um,
        }
        return figures


@linear_algebra_on_one_thread()
def analyse(
    calibration: Calibration,
    settings: AnalysisSettings | None = None,
    *,
    reach: Reach | None = None,
    reach_in_volumes: ReachInVolumes | None = None,
    on_progress: Progress | None = None,
) -> Analysis:
    """Analyse a calibration.

    Raises InputError when the geometry or the depths are unknown.

    Parameters
    ----------
    calibration : Calibration
        With depths and geometry (``pixel_pitch_um``, ``diffuser_distance_mm``). One PSF is enough for most.
    settings : AnalysisSettings, optional
    reach : callable, optional
        :func:`recon.evaluation.two_points.reached`: what the default reconstruction reaches is found, too.
    reach_in_volumes : callable, optional
        :func:`recon.evaluation.points_in_volumes.in_volumes`, for ``settings.volumes``.
    on_progress : callable, optional
        Called with what is being done and the share done.

    Returns
    -------
    Analysis
        Lengths in micrometres, angles in degrees; None where the calibration cannot tell.
    """
    require_calibration(calibration)
    require_argument("settings", settings, AnalysisSettings | None)
    settings = settings or AnalysisSettings()
    require(settings)
    on_progress = on_progress or (lambda _what, _share: None)
    pitch_um, distance_um = _geometry(calibration)
    notes: list[str] = []
    noise, noise_source = settings.noise.of(calibration.quality)
    small, sensor_shape = _cut_to_light(calibration)
    depths, stack = central_psfs(small)
    planes = stack.mean(axis=1)
    on_progress("resolution", 0.0)

    @cache
    def axial_at(k: int) -> tuple[AxialResolution, ...]:
        return axial_resolutions(planes[k], float(depths[k]), distance_um, RESOLUTION_LEVEL, INNER_PRODUCT)

    z_um = settings.z_um or _depth_to_analyse(depths, lambda k: axial_at(k)[1].step_per_um, notes)
    # Resolution is a matter of measured pixels: of the calibrated PSF nearest to the depth, not of a blend.
    nearest = int(np.argmin(np.abs(1 / depths - 1 / z_um)))
    psf = planes[nearest]
    cuts = [autocorrelation_cut(psf, axis) for axis in (0, 1)]
    lateral, lateral_inner = (
        LateralResolution.of(cuts, level) for level in (RESOLUTION_LEVEL, INNER_PRODUCT)
    )
    axial, axial_inner = axial_at(nearest)

    support = support_extent_px(psf)
    cutoff = settings.cutoff_deg or (None, None)
    if unknown := [name for name, angle in zip("yx", cutoff, strict=True) if angle is None]:
        notes.append(
            f"The sensor's angular cut-off along {' and '.join(unknown)} is not known: there the field of "
            "view is the geometric one."
        )
    # The support at infinity is the aperture's, which is what Eq. 3.12 wants; a near source's is enlarged.
    far_support = [s / (1 + distance_um / depths[nearest]) for s in support]
    view_y, view_x = (
        field_of_view(
            n * pitch_um, s * pitch_um, distance_um, deflection_deg=settings.deflection_deg, cutoff_deg=angle
        )
        for n, s, angle in zip(sensor_shape, far_support, cutoff, strict=True)
    )
    on_progress("field", 0.1)
    field_points = across_field(small)
    if len(field_points) < 2:
        notes.append(
            "One place of the field was calibrated: how PSFs vary across it, and how far the convolution "
            "model holds, is not known."
        )
    on_progress("depths", 0.2)
    similarity = across_depth(depths, planes) if len(depths) > 1 else None
    on_progress("condition numbers", 0.3)
    step = axial_inner.step_per_um
    farthest = planes_about(z_um, step)[-1]
    middle = Middle.of(small, z_um, step, reach=1 / z_um - farthest if farthest > 0 else 0.0, dark_rim=True)
    at = cache(middle.psf_at)
    inverse = planes_about(z_um, step * middle.spread, CONDITION_PLANES)
    fine = np.stack([at(float(1 / v)) for v in inverse]) if np.isfinite(step) and inverse[-1] > 0 else None
    if fine is None:
        notes.append("The pattern does not change enough along the axis for condition numbers in depth.")
    condition = _condition(at(z_um)[None] if fine is None else fine, with_depth=fine is not None)
    on_progress("point tests", 0.5)
    tests = None
    if settings.points:
        tests = point_tests(
            at,
            z_um,
            lateral_px=lateral_inner.mean_px,
            step_per_um=step * middle.spread,
            noise=middle.noise(noise),
            on_progress=lambda share: on_progress("point tests", 0.5 + 0.2 * share),
        )
        if tests.axial_per_um is not None:
            tests = replace(tests, axial_per_um=tests.axial_per_um / middle.spread)
        notes.extend(tests.notes)
    found = None
    if settings.points and reach is not None:
        found = reach(
            calibration,
            z_um,
            lateral_inner.mean_px,
            step,
            noise,
            on_progress=lambda share: on_progress("two points by default", 0.7 + 0.2 * share),
        )
        notes.extend(_conditions(z_um, noise, noise_source, found))
    volumes = None
    if tests is not None and settings.volumes and reach_in_volumes is not None:
        on_progress("points in default volumes", 0.9)
        volumes = _in_volumes(reach_in_volumes, calibration, z_um, tests, step, noise, notes)
    resolution_px = lateral.mean_px
    if tests is not None:
        resolution_px = tests.lateral_px or resolution_px
        step = tests.axial_per_um or step
    if found is not None:
        largest = max(pair.px for pair in found.pairs)
        resolution_px = max(largest if px is None else px for px in found.across_px)
    model, reason = choose_model(sort_by_depth(small), "auto")
    on_progress("done", 1.0)
    return Analysis(
        z_um=z_um,
        pitch_um=pitch_um,
        distance_um=distance_um,
        sensor_shape=sensor_shape,
        psf=psf,
        autocorrelation=cuts[1][len(cuts[1]) // 2 :],
        support_px=support,
        lateral=lateral,
        lateral_inner=lateral_inner,
        axial=axial,
        axial_inner=axial_inner,
        view_y=view_y,
        view_x=view_x,
        field=field_points,
        convolution_holds_deg=convolution_holds_deg(field_points),
        depth=similarity,
        condition=condition,
        condition_voxel=(1.0, axial_inner.step_per_um / 2),
        points=tests,
        reached=found,
        in_volumes=volumes,
        half_light_deg=half_light_deg(psf, sensor_shape, pitch_um / distance_um, response_of(settings)),
        lateral_spacing_um=lateral_spacing(settings, float(depths[0]), notes),
        axial_spacing_per_um=axial_spacing(settings, calibration, notes),
        grid=voxel_grid(
            resolution_px=resolution_px,
            step_per_um=step,
            z_range_um=(float(depths[0]), float(depths[-1])),
            pitch_um=pitch_um,
            distance_um=distance_um,
        ),
        model=model,
        model_reason=reason,
        noise=noise,
        settings=settings,
        notes=tuple(notes),
    )


def _depth_to_analyse(depths: Float64Array, step_per_um: Callable[[int], float], notes: list[str]) -> float:
    """Return the calibrated depth nearest to the middle in 1/z, or a nearer one where depth can be tested.

    What lies between two depths is a blend of their PSFs, which is a little blurred. Far away the planes of
    the tests along the axis, evenly spaced in 1/z, would reach beyond infinity: ``step_per_um(k)`` apart at
    the ``k``-th depth.
    """
    middle = (1 / depths[0] + 1 / depths[-1]) / 2
    away = np.abs(1 / depths - middle)
    first = int(np.flatnonzero(away <= away.min() + 1e-9 * middle)[0])  # of two as near the nearer
    reach = max(CONDITION_PLANES, PLANES) // 2
    for k in range(first, -1, -1):
        if 1 / depths[k] > reach * step_per_um(k) / 2:
            if k != first:
                notes.append(
                    f"Analysed at {depths[k] / 1e3:.3g} mm, not at {depths[first] / 1e3:.3g} mm, nearest to "
                    "the middle of the range in 1/z: from there tests along the axis would reach beyond "
                    "infinity. --z-mm chooses another depth."
                )
            return float(depths[k])
    return float(depths[first])


def _geometry(calibration: Calibration) -> tuple[float, float]:
    geometry = calibration.geometry
    pitch_um, distance_mm = geometry.pixel_pitch_um, geometry.diffuser_distance_mm
    if pitch_um is None or distance_mm is None:
        missing = [n for n in ("pixel_pitch_um", "diffuser_distance_mm") if getattr(geometry, n) is None]
        raise InputError(
            f"The calibration does not say its {' and '.join(missing)}, which the analysis needs: "
            "give them in [geometry] of bench.toml and calibrate again."
        )
    return pitch_um, 1e3 * distance_mm


def _cut_to_light(calibration: Calibration) -> tuple[Calibration, tuple[int, int]]:
    """Cut every PSF to the part, symmetric about the axis, that any of them lights; and the whole shape."""
    height, width = calibration.psfs.shape[-2:]
    cuts = []
    for size, (first, last) in zip(
        (height, width), lit_extent(calibration.psfs.max(axis=(0, 1))), strict=True
    ):
        # From both ends alike, so that the axis stays where it is.
        trim = max(min(first, size - 1 - last) - RIM_PX, 0)
        cuts.append(slice(trim, size - trim))
    psfs = np.ascontiguousarray(calibration.psfs[..., cuts[0], cuts[1]])
    return replace(calibration, psfs=psfs, background=None), (height, width)


def _condition(planes: Array, *, with_depth: bool) -> tuple[ConditionCurve, ...]:
    planes = planes.astype(np.float64)  # once, not for every product
    middle = planes[len(planes) // 2][None]
    curves = (
        condition_curve(middle if direction == "x" else planes, direction, count, SEPARATIONS)
        for direction, counts in CONDITION_COUNTS.items()
        if direction == "x" or with_depth
        for count in counts
    )
    return tuple(curve for curve in curves if curve.separations)


def _conditions(z_um: float, noise: Noise, source: str, found: Reached) -> list[str]:
    """Return under which conditions the default reconstruction tells two points apart."""
    words = [
        "Two points and depth of field, picture: as the default reconstruction has them, alone in the dark, "
        f"equally bright, at {z_um / 1e3:.3g} mm, the brightest pixel at {noise.electrons:.5g} electrons, "
        f"read noise {noise.read_e:.3g} ({source}); a dip of 20 % at nine in ten places between pixels, and "
        "at 0.8 of the distance at three in ten at most by these pairs. More in a scene costs resolution."
    ]
    for axis, shares in zip("yx", found.shares, strict=True):
        if shares is not None and shares[1] > AT_NEARER:
            words.append(
                f"Along {axis} still {shares[1]:.0%} are told apart at 0.8 of the distance stated: points of "
                "the picture are about as narrow as its pixels, so that where they lie between them decides."
            )
    if found.part < 1:
        words.append(
            f"For that the middle of the pattern was taken, {found.part:.0%} of its pixels, with as much "
            "less noise as the rest would make up for."
        )
    return words


def _in_volumes(
    reach: ReachInVolumes,
    calibration: Calibration,
    z_um: float,
    tests: PointTests,
    step_per_um: float,
    noise: Noise,
    notes: list[str],
) -> InVolumes | None:
    if tests.lateral_px is None or tests.axial_per_um is None:
        notes.append("Volumes were not tried: no distance is known to begin with.")
        return None
    found = reach(calibration, z_um, tests.lateral_px, tests.axial_per_um, step_per_um, noise)
    notes.append(
        "Two points along and 16 points, volume: as default volumes of planes half an axial step apart have "
        f"them ({found.planes} planes for 16 points), each group alone in the dark, with the noise above."
    )
    return found
