"""From the frames of a sweep to PSFs: average, dark, hot pixels, stray light, binning, quality."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import numpy.typing as npt
from scipy import fft, ndimage

from calibration_routines.psf.exposure import hot_pixels
from calibration_routines.psf.frame_noise import FrameNoise, PhotonTransfer
from calibration_routines.psf.mount_fit import MountFit, fit_mount, with_pitch
from calibration_routines.psf.psf_quality import (
    PsfQuality,
    measure_psf,
    remove_low_frequencies,
    temporal_noise,
)
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.stage_fit import Drift, StageFit, judge_drift, judge_points
from calibration_routines.psf.structure import Structure, fit_structure
from calibration_routines.psf.sweep_options import PointSweep
from calibration_routines.psf.sweep_plan import DARK, FEATURE_PX, PSF, REFERENCE
from calibration_routines.scatter import STEADY, TOLERATED, Scatter, Steadied, pooled, steadied
from instrument.files.errors import count
from instrument.runs.run import Run
from recon.arrays import BoolArray, Float32Array
from recon.base.blocks import block_mean
from recon.types import Geometry

Counts = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
Float = Float32Array

_NOISE_PX = 250_000
_LONE = 6.0  # times the median around it: a Gaussian spot of 1.1 pixels in the middle of one is six times
_FAR = 10.0  # deviations of the noise


@dataclass(frozen=True, slots=True)
class PlaneFrames:
    """The raw frames of one point of a sweep."""

    source_um: tuple[float, float, float]
    """(x, y, z): where the stage said the source was."""
    exposure_ms: float
    frames: Counts
    """Uint8 or uint16, (n_frames, height, width) or (n_frames, height, width, 3): all of the same light."""
    full_scale: int
    """The largest count the camera can report."""
    off_axis: bool = False
    """Whether another point of the same depth is nearer to the axis: the sensor's edge may cut the
    pattern."""
    brightness: float = 1.0
    """The source's, relative to its brightness at the sweep's first visit to the reference: taken out of the
    PSF."""


class DarkModel:
    """What the camera shows without light, at any exposure.

    Dark current adds counts in proportion to time, so two exposures tell each pixel's offset and rate; one
    exposure tells only itself, and is used for all.

    Parameters
    ----------
    exposures_ms : sequence of float
        One or two different exposures.
    frames : sequence of ndarray
        For each exposure its dark frames, (n_frames, height, width) or (n_frames, height, width, 3).
    early : sequence of int, optional
        For each exposure how many of them were taken before the others, at the sweep's beginning; all by
        default.
    """

    def __init__(
        self,
        exposures_ms: Sequence[float],
        frames: Sequence[Counts],
        full_scale: int,
        early: Sequence[int] = (),
    ) -> None:
        if len(exposures_ms) not in (1, 2) or len(frames) != len(exposures_ms):
            raise ValueError("Dark frames are needed at one or two exposures.")
        self._exposures_ms, self._full_scale = tuple(exposures_ms), full_scale
        self._means: list[Float] = [_mean(stack) for stack in frames]
        longest = int(np.argmax(self._exposures_ms))
        stack = frames[longest]
        first = early[longest] if early else len(stack)
        before = np.max(stack[:first], axis=0)
        self.hot = hot_pixels(before, full_scale)
        """Pixels that are bright without light at the longer exposure, in any frame: some blink, some turn
        hot meanwhile."""
        self.late_hot = 0
        """Pixels among them that stand above the others twice as far as in the first dark frames: warm ones,
        which noise takes beyond what is hot now and then, did not turn."""
        self.variance = float("nan")
        """Of a pixel from frame to frame in the dark, counts squared; nan of a single frame."""
        if len(some := stack[:first, :: max(1, stack[0].size // _NOISE_PX)]) > 1:
            steady = ~self.hot[:: max(1, stack[0].size // _NOISE_PX)]
            self.variance = float(some[:, steady].astype(np.float32).var(axis=0, ddof=1).mean())
        self.brightening_per_ms = 0.0
        """Counts a millisecond by which the last dark frames are brighter than the first, in the median."""
        if first < len(stack):
            after = np.max(stack[first:], axis=0)
            late = hot_pixels(after, full_scale)
            twice = after - float(np.median(after)) > 2 * (before - float(np.median(before)))
            self.late_hot = int(np.count_nonzero(late & twice))
            self.hot |= late
            more = float(np.median(_mean(stack[first:]) - _mean(stack[:first])))
            self.brightening_per_ms = more / self._exposures_ms[longest]

    def lone(self, image: Float) -> BoolArray:
        """Return which pixels of an image of light, (height, width[, 3]), counts, stand alone.

        Brighter by far than noise, than a hundredth of full scale, and :data:`_LONE` times as bright as the
        median of the 3 x 3 pixels around. A pixel that turned hot does; a spot as narrow as a pixel and a
        tenth does not, sharper light does: of one image alone nobody can tell. Noise is that of the image, a
        median over its pixels, and no less than a count's own, as most pixels of a dim image have none.
        """
        median = np.maximum(cv2.medianBlur(np.ascontiguousarray(image), 3), 0.0)
        beyond = image - median
        noise = 1.4826 * float(np.median(np.abs(beyond - np.median(beyond))))
        least = np.maximum(_FAR * np.maximum(noise, np.sqrt(median + 1.0)), 0.01 * self._full_scale)
        found: BoolArray = (beyond > least) & (image > _LONE * median)
        return found

    def at(self, exposure_ms: float) -> Float:
        """Return the expected dark frame, float32 counts."""
        if len(self._means) == 1:
            return self._means[0]
        (short, long), (first, second) = self._exposures_ms, self._means
        weight = np.float32((exposure_ms - short) / (long - short))
        return first + weight * (second - first)


@dataclass(frozen=True, slots=True)
class SweepAnalysis:
    """PSFs with what was found out about them, sorted as the planes came."""

    psfs: Float
    """(n_planes, n_channels, height, width): non-negative, in counts at ``reference_exposure_ms``,
    so that planes compare in brightness."""
    background: Float
    """(n_channels, height, width): what was subtracted at the reference exposure, mean over the
    planes: dark frame and stray light."""
    quality: tuple[PsfQuality, ...]
    reference_exposure_ms: float
    stages: tuple[StageFit, ...] = ()
    """For each depth with several points: the measured shifts against the stage's."""
    scatter: Scatter = STEADY
    """Of the frames of all points."""
    findings: tuple[str, ...] = ()
    """What is wrong with light, place or dark frames, whatever the point."""
    mount: MountFit | None = None
    """Where the source stands by the central PSFs; None where they do not tell."""
    structure: Structure | None = None
    """How wide the central PSFs' finest structure is; None where they do not tell."""
    noise: FrameNoise | None = None
    """Of one frame; None where the frames do not tell."""


def analyse_sweep(
    planes: Iterable[PlaneFrames],
    dark: DarkModel,
    geometry: Geometry,
    *,
    dct_order: int = 0,
    binning: int = 1,
) -> SweepAnalysis:
    """Turn the raw frames of a sweep into PSFs and judge them.

    Parameters
    ----------
    planes : iterable of PlaneFrames
        Read one after the other, so that a lazily loaded sweep needs the memory of one plane.
    geometry : Geometry
        Its ``diffuser_distance_mm``, where known, is held against the support's scaling and the shifts.
    dct_order : int
        Lowest DCT coefficients set to zero along each axis (Kuo 2020, Sec. 6.4: 10); 0 keeps them.
    binning : int
        Blocks of ``binning x binning`` pixels are averaged, after hot pixels were replaced.

    Raises ValueError when there is no plane, or the frames' shapes differ.
    """
    psfs: list[Float] = []
    quality: list[PsfQuality] = []
    scatters: list[Scatter] = []
    ambient: list[float] = []
    off_axis: list[bool] = []
    structure: dict[float, float] = {}
    transfer = PhotonTransfer(dark.variance, binning)
    removed_in_all: Float | None = None
    reference_ms = 0.0
    for plane in planes:
        reference_ms = reference_ms or plane.exposure_ms
        scale = np.float32(reference_ms / plane.exposure_ms / plane.brightness)
        steady = plane_light(plane, dark)
        mean = steady.mean
        scatters.append(steady.scatter)
        off_axis.append(plane.off_axis)
        ambient.append(dark.brightening_per_ms * plane.exposure_ms / max(float(mean.mean()), 1e-9))
        light = block_mean(channels_first(mean), binning)
        cleaned, stray = remove_low_frequencies(light, dct_order)
        quality.append(measure_point(plane, light - stray, steady, dark, binning))
        psfs.append(cleaned * scale)
        still = steady.scatter.motion_px == 0
        transfer.look(steady.frames, cleaned, still=still, off_axis=plane.off_axis)
        if not plane.off_axis and len(steady.frames) > 1:
            structure.setdefault(plane.source_um[2], _structure_px(steady, binning))
        removed = channels_first(replace_hot(dark.at(reference_ms), dark.hot))
        background = block_mean(removed, binning) + stray * scale
        removed_in_all = background if removed_in_all is None else removed_in_all + background
    if removed_in_all is None:
        raise ValueError("A sweep needs at least one point.")
    stacked = np.stack(psfs)
    judged, stages = judge_points(quality, stacked, binned(geometry, binning))
    scatter = pooled(scatters)
    central = [i for i, q in enumerate(judged) if q.similarity is None and not off_axis[i]]
    mount = fit_mount(
        [judged[i] for i in central],
        stacked[central].sum(axis=(1, 2, 3), dtype=np.float64),
        binned(geometry, binning),
        scatter.brightness_error,
        [stacked[i] for i in central],
    )
    mount = with_pitch(mount, stages, binned(geometry, binning))
    return SweepAnalysis(
        psfs=stacked,
        background=removed_in_all / np.float32(len(psfs)),
        quality=judged,
        reference_exposure_ms=reference_ms,
        stages=stages,
        scatter=scatter,
        findings=(
            *scatter.findings(),
            *ambient_findings(max(ambient, key=abs)),
            *(() if mount is None else mount.findings),
        ),
        mount=mount,
        structure=fit_structure(list(structure), list(structure.values()), binned(geometry, binning)),
        noise=transfer.found(),
    )


def ambient_findings(share: float) -> tuple[str, ...]:
    """Return what is to be said of other light, by which the last dark frames are brighter than the first.

    ``share`` is of the mean light of what was measured.
    """
    if abs(share) <= TOLERATED:
        return ()
    return (
        f"the dark frames after the last point are {'brighter' if share > 0 else 'darker'} than those before "
        f"the first, by {abs(share):.1%} of the mean light: other light came or went meanwhile. Keep it out, "
        "and take it again.",
    )


def measure_point(
    plane: PlaneFrames, light: Float, steady: Steadied, dark: DarkModel, binning: int
) -> PsfQuality:
    """Measure a point's PSF alone, from its light (n_channels, height, width) and its frames."""
    x_um, y_um, z_um = plane.source_um
    ever = (plane.frames >= plane.full_scale).any(axis=0)
    measured = measure_psf(
        light,
        z_um=z_um,
        noise=noise_of_mean(steady.frames) / binning,
        saturated_pixels=int(np.count_nonzero(ever & ~dark.hot)),
        may_be_clipped=plane.off_axis,
    )
    scatter = steady.scatter
    return replace(measured, x_um=x_um, y_um=y_um, flicker=scatter.flicker, motion_px=scatter.motion_px)


def plane_light(plane: PlaneFrames, dark: DarkModel) -> Steadied:
    """Return a point's frames without dark frame, hot pixels, flicker and motion, float32 counts.

    Raises ValueError when the dark frames have another shape.
    """
    dark_frame = dark.at(plane.exposure_ms)
    if dark_frame.shape != plane.frames.shape[1:]:
        raise ValueError(
            f"The frames at z = {plane.source_um[2] / 1e3:g} mm are {plane.frames.shape[1:]}, "
            f"the dark frames {dark_frame.shape}."
        )
    return light_frames(plane.frames, dark_frame, dark.hot)


def light_frames(frames: Counts, dark_frame: Float, hot: BoolArray) -> Steadied:
    """Return frames of the same thing, (n_frames, height, width[, 3]) without dark frame and hot pixels."""
    return steadied(np.stack([replace_hot(frame - dark_frame, hot) for frame in frames]))


def replace_hot(image: Float, hot: BoolArray) -> Float:
    """Replace hot pixels by the median of the 3 x 3 pixels around them.

    Image and mask are (height, width) or (height, width, 3).
    """
    if not hot.any():
        return image
    median = cv2.medianBlur(np.ascontiguousarray(image), 3)
    return np.where(hot, median, image)


def channels_first(image: Float) -> Float:
    """Return (height, width) or (height, width, n_channels) as (n_channels, height, width)."""
    return np.ascontiguousarray(np.moveaxis(image, -1, 0)) if image.ndim == 3 else image[np.newaxis]


def binned(geometry: Geometry, binning: int) -> Geometry:
    """Return the geometry with the pixel pitch after binning by ``binning``."""
    pitch = geometry.pixel_pitch_um
    return geometry if pitch is None else replace(geometry, pixel_pitch_um=pitch * binning)


def _mean(frames: Counts) -> Float:
    """Return the mean over the first axis, float32; sums of up to 65,536 frames of 16 bit stay exact."""
    mean: Float = (frames.sum(axis=0, dtype=np.uint32) / np.float32(len(frames))).astype(np.float32)
    return mean


def noise_of_mean(frames: Counts | Float) -> float:
    """Return the noise of one pixel of the frames' mean; a dark average adds little and is left out."""
    frames = frames[:, :: max(1, frames[0].size // _NOISE_PX)]  # rows enough to tell a noise by
    if len(frames) > 1:
        return temporal_noise(frames)
    # one frame: the photon noise is unknown, so differences between neighbouring pixels stand in for it; they
    # contain the pattern itself, which makes this an upper bound
    step = np.diff(frames[0].astype(np.float32), axis=1)
    return 1.4826 / 2**0.5 * float(np.median(np.abs(step - np.median(step))))


def _structure_px(steady: Steadied, binning: int) -> float:
    """Return the width of the finest structure of a point's pattern, by two frames about its middle."""
    frames = [channels_first(steady.frames[k]).mean(axis=0) for k in (0, -1)]
    row, column = ndimage.center_of_mass(np.maximum(frames[0], 0))
    size = _STRUCTURE_PX * binning
    top, left = (
        int(np.clip(at - size / 2, 0, max(n - size, 0)))
        for at, n in zip((row, column), frames[0].shape, strict=True)
    )
    first, last = (
        block_mean(np.ascontiguousarray(one[top : top + size, left : left + size]), binning) for one in frames
    )
    return feature_size_px(first, last)


_STRUCTURE_PX = 768  # of the binned pattern's middle: that many tell its structure
_LOCAL_MEAN_PX = 16.0  # structure coarser than this does not count
_REACH_PX = 24


def feature_size_px(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> float:
    """Full width at half maximum of a PSF's finest structure, pixels.

    The half width of the correlation of two frames of the same light (their noise does not correlate), less
    their local mean; a Gaussian's auto-correlation is wider than itself by the square root of two.

    Parameters
    ----------
    first, second : ndarray, (height, width)
        Two frames of the same light, dark frame subtracted. The same frame twice overrates noise as
        structure.
    """
    spectra = []
    for image in (first, second):
        fine = image - ndimage.gaussian_filter(image, _LOCAL_MEAN_PX)
        spectra.append(fft.rfft2(fine.astype(np.float32)))
    correlation = fft.irfft2(spectra[0] * np.conj(spectra[1]), s=first.shape)
    lags = np.arange(-_REACH_PX, _REACH_PX + 1)
    near = correlation[np.ix_(lags, lags)]
    radius = np.hypot(lags[:, None], lags)
    rings = [float(near[(radius > r - 0.5) & (radius <= r + 0.5)].mean()) for r in range(_REACH_PX)]
    profile = np.array(rings) / rings[0]
    below = int(np.argmax(profile < 0.5))
    if not profile[below] < 0.5:
        return float(2 * _REACH_PX)
    inner = below - 1
    half = inner + (profile[inner] - 0.5) / (profile[inner] - profile[below])
    return float(2 * half / np.sqrt(2))


def optical_binning(first: npt.NDArray[np.floating], second: npt.NDArray[np.floating]) -> int:
    """Return the largest binning that leaves the finest structure two pixels wide; arguments as above."""
    return max(1, int(feature_size_px(first, second) / FEATURE_PX))


# Runs --------------------------------------------------------------------------------------------------
def full_scale(run: Run) -> int:
    """Return the largest count of a run's camera."""
    return (1 << run.metadata(0).significant_bits) - 1


def dark_model(run: Run) -> DarkModel:
    """Return what a sweep's run shows without light."""
    steps = run.steps(DARK)
    first = min(step.part for step in steps)
    taken: dict[float, list[list[int]]] = {}
    for step in steps:
        early_and_late = taken.setdefault(run.metadata(step).exposure_ms, [[], []])
        early_and_late[step.part != first].append(step.index)
    stacks = [np.stack([run.frame(index) for index in early + late]) for early, late in taken.values()]
    return DarkModel(list(taken), stacks, full_scale(run), [len(early) for early, _ in taken.values()])


def late_hot_lines(pixels: int, during: str) -> list[str]:
    """Return the line that says how many pixels turned hot, where any did."""
    return [
        f"Sensor: {count(pixels, 'pixel')} turned hot during the {during} (replaced by the "
        "neighbours' median, like the others): let the camera warm up."
    ][: pixels > 0]


def light_of(run: Run, indices: Sequence[int], dark: DarkModel) -> Steadied:
    """Return the light of some frames of one exposure and place, colours averaged."""
    frames = np.stack([run.frame(index) for index in indices])
    steady = light_frames(frames, dark.at(run.metadata(indices[0]).exposure_ms), dark.hot)
    return replace(steady, frames=steady.frames.mean(axis=-1)) if steady.frames.ndim == 4 else steady


def drift_of(run: Run, sweep: PointSweep, dark: DarkModel) -> Drift | None:
    """Return how the source changed between its visits to the reference; None for a sweep without any."""
    visits: dict[int, list[int]] = {}
    for step in run.steps(REFERENCE):
        visits.setdefault(step.part, []).append(step.index)
    if not visits:
        return None
    steady = [light_of(run, indices, dark) for indices in visits.values()]
    total = len(sweep.points_um)
    before = [min(k * sweep.reference_every, total) for k in range(len(steady))]
    times = [run.metadata(indices[0]).utc for indices in visits.values()]
    return judge_drift(
        [one.mean for one in steady],
        before,
        total,
        [(time - times[0]).total_seconds() for time in times],
        pooled([one.scatter for one in steady]),
    )


def images_of(
    run: Run, sweep: PointSweep, dark: DarkModel, drift: Drift | None
) -> tuple[list[Float], Scatter]:
    """Return the light of every point at the first one's exposure, without drift, and frames' scatter."""
    began = run.metadata(run.steps(REFERENCE)[0]).utc if drift is not None else None
    taken: dict[Position, list[int]] = {}
    for step in run.steps(PSF):
        if step.source_um is not None:
            taken.setdefault(step.source_um, []).append(step.index)
    reference_ms = run.metadata(taken[sweep.points_um[0]][0]).exposure_ms
    images, scatters = [], []
    for point in sweep.points_um:
        first = run.metadata(taken[point][0])
        brightness = 1.0
        if drift is not None and began is not None:
            brightness = drift.brightness_at((first.utc - began).total_seconds())
        steady = light_of(run, taken[point], dark)
        images.append(steady.mean * np.float32(reference_ms / first.exposure_ms / brightness))
        scatters.append(steady.scatter)
    return images, pooled(scatters)
