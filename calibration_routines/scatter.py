"""Frames of the same thing differ: by noise, and on a real bench by a flickering lamp, a shaking table.

Whatever averages frames looks at how they scatter first. Each frame is held against their mean by one linear
fit: ``frame = brightness * mean - (rows, columns) . grad(mean) + ambient``, so that light that changes, a
picture that moves and other light that comes in are told apart, each with its own uncertainty. What a fit to
the noise would give is taken off; what is left is the bench's.

* Brightness: frames of one place share it, so an average of ``n`` is known to ``flicker / sqrt(n)``. Nothing
  in the frames tells the rest; the result says so, or is refused.
* Place: frames are put onto one another before they are averaged, which takes out the blur.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from recon.arrays import Float32Array
from recon.base.blocks import block_mean
from recon.camera.registration import moved, register

Float = Float32Array

TOLERATED = 0.02
"""Part of a result that a fault of the bench may change without being named."""
LARGEST_PX = 500_000
"""Larger images are binned before they are compared: a twentieth of a pixel is told still."""
_LINEAR_PX = 0.4  # a picture moves so far as its gradient tells; beyond, it is registered
_STRAIGHT_PX = 0.1  # up to which the gradient tells brightness, too, to a fifth of a percent
_SLOPE = np.array([-1, 9, -45, 0, 45, -9, 1], np.float32) / 60
"""A derivative of sixth order: the usual one of second order takes fine structure for flatter than it is."""
_UNLIKE = 0.3  # part of an image's contrast that a fit leaves: beyond, it is looked for elsewhere
_STRANGE = 0.75  # part of the contrast left, of images that noise parts, beyond which chance gives places
_GRAINS = 1.5  # what is left is noise's where it is at most so many times the two images' grain
_SPLINE_PX = 3
_COARSE_PX = 64  # short side of images that are made coarser
_BORDER_PX = 8
_POOR = 0.1  # part of its contrast that is left of a moved image
_FLAT = 0.3  # contrast, relative to the mean, below which other light cannot be told from brightness
_SHAKEN_PX = 0.05  # frames that scatter less are averaged as they are
_SURE = 3.0  # standard deviations of its own uncertainty, beyond which a scatter is the bench's
_STEADY_LIGHT = "give the lamp a steady supply, lengthen the exposure over its flicker"
_STILL = "clamp source, stage and camera, wait after moves, take the table off what vibrates"
_SHARP_PX, _SHARPEST_PX = 2.0, 0.5
"""Width of a pattern's finest structure, where it is not seen to be finer, and the finest that pixels hold:
blurred by ``s`` pixels it changes by about ``(s / this)^2``, moved by ``s`` by about ``s / this``."""


@dataclass(frozen=True, slots=True)
class Change:
    """How an image differs from another one of the same thing."""

    brightness: float
    """Relative to the other's; nan where there is no light."""
    rows: float
    columns: float
    """Displacement, pixels; infinite where the pattern is not found again."""
    ambient: float
    """Light that came in evenly, in units of the other's mean."""
    brightness_noise: float = 0.0
    place_noise: float = 0.0
    """Standard deviations by the images' noise alone: of brightness, and of the displacement, pixels."""

    @property
    def shift_px(self) -> float:
        """Length of the displacement."""
        return float(np.hypot(self.rows, self.columns))


NO_CHANGE = Change(1.0, 0.0, 0.0, 0.0)
"""Of an image against itself."""


def reduction(image: npt.NDArray[np.floating]) -> int:
    """Return by how much an image (..., height, width) is binned before it is compared."""
    return max(1, int(np.ceil(np.sqrt(np.prod(image.shape[-2:]) / LARGEST_PX))))


def compare(image: Float, reference: Float) -> Change:
    """Return how an image differs from a reference, (height, width) each, dark frames taken off.

    Where grain hides what they have in common they are compared on larger pixels, too. A place at which less
    than half of their structure is alike is none.
    """
    factor = reduction(reference)
    seen, other = block_mean(image, factor), block_mean(reference, factor)
    if not other.mean() > 0 or not np.ptp(seen) > 0 or not np.ptp(other) > 0:
        return Change(float("nan"), float("nan"), float("nan"), float("nan"))
    found, left = _compared(seen, other)
    best = _in_pixels(found, factor)
    while left > _UNLIKE and min(other.shape) >= _COARSE_PX and left**2 < _GRAINS * _grain(seen, other):
        factor, seen, other = 2 * factor, block_mean(seen, 2), block_mean(other, 2)
        found, coarser = _compared(seen, other)
        if coarser < left:
            best, left = _in_pixels(found, factor), coarser
    return best if left <= _STRANGE else replace(best, rows=float("inf"), columns=float("inf"))


def _compared(seen: Float, other: Float) -> tuple[Change, float]:
    """Return how images differ, and the part of the contrast that is left where they lie on one another."""
    found, left = _fitted(seen, other)
    if left <= _UNLIKE and found.shift_px <= _LINEAR_PX:
        return found if found.shift_px <= _STRAIGHT_PX else _levelled(found, seen, other), left
    far = register(seen, other)
    ways = far.rows, far.columns
    if not far.reliable:
        if left <= _UNLIKE:
            return found, left
        brightness = float(seen.sum(dtype=np.float64) / other.sum(dtype=np.float64))
        return Change(brightness, float("inf"), float("inf"), 0.0), left
    inner = tuple(slice(_rim(way, n), n - _rim(way, n)) for way, n in zip(ways, other.shape, strict=True))
    back = moved(seen, -far.rows, -far.columns)
    found, left = _fitted(back, other)
    if left > _POOR:  # too fine to be moved by fractions of a pixel: all light together tells more
        found, left = _fitted(back[inner], other[inner])
        level = float(seen.sum(dtype=np.float64) / other.sum(dtype=np.float64))
        found = replace(found, brightness=level, ambient=0.0)
    there = replace(found, rows=found.rows + far.rows, columns=found.columns + far.columns)
    return there if left > _POOR else _levelled(there, seen, other), left


def _levelled(found: Change, seen: Float, other: Float) -> Change:
    """Return a change with brightness and other light of images that were both moved half the way.

    One that is moved is blurred, and a way that a fit takes for straight is bent: of one image alone either
    looks as if its light had gone and other light had come in.
    """
    ways = found.rows, found.columns
    inner = tuple(slice(_rim(way, n), n - _rim(way, n)) for way, n in zip(ways, other.shape, strict=True))
    back, there = (
        moved(image, *(by * way / 2 for way in ways))[inner] for image, by in ((seen, -1), (other, 1))
    )
    level, _ = _fitted(back, there)
    whole = float(there.mean(dtype=np.float64) / other.mean(dtype=np.float64))  # a rim may be dark
    return replace(found, brightness=level.brightness, ambient=level.ambient * whole)


def _rim(way: float, side: int) -> int:
    """Return the pixels at a border that nothing was moved into, with those that splines take from there."""
    return min(int(np.ceil(abs(way))) + _SPLINE_PX, side // 4) if way else 0


def _grain(*images: Float) -> float:
    """Return the parts of images' variation, added up, that no pixel has in common with the next: noise."""
    parts = 0.0
    for image in images:
        wide = image.astype(np.float64) - image.mean(dtype=np.float64)
        parts += 1 - float(np.mean(wide[:, 1:] * wide[:, :-1])) / max(float(np.mean(wide**2)), 1e-300)
    return parts


def _in_pixels(found: Change, factor: int) -> Change:
    """Return a change of pixels that were binned."""
    if factor == 1:
        return found
    place = factor * found.rows, factor * found.columns
    return replace(found, rows=place[0], columns=place[1], place_noise=factor * found.place_noise)


def _fitted(seen: Float, other: Float) -> tuple[Change, float]:
    """Fit brightness, place and other light; returns the part of the contrast that is left, too."""
    mean = float(other.mean(dtype=np.float64))
    down, right = (ndimage.correlate1d(other, _SLOPE, axis=axis) for axis in (0, 1))
    columns = [other, -down, -right]
    if float(other.std(dtype=np.float64)) > _FLAT * mean:
        columns.append(np.full_like(other, mean))
    design = np.stack([column.ravel() for column in columns]).astype(np.float64)
    target = seen.ravel().astype(np.float64)
    inverse = np.linalg.pinv(design @ design.T)
    solution = inverse @ (design @ target)
    rest = target - solution @ design
    spread = inverse @ ((design * rest**2) @ design.T) @ inverse  # White's estimate: noise grows with light
    noise = np.sqrt(np.maximum(np.diag(spread), 0.0))
    level = float(solution[0])
    safe = level if abs(level) > 1e-6 else 1e-6
    change = Change(
        level,
        float(solution[1] / safe),
        float(solution[2] / safe),
        float(solution[3]) if len(solution) > 3 else 0.0,
        float(noise[0]),
        float(np.hypot(noise[1], noise[2]) / abs(safe)),
    )
    return change, float(rest.std() / max(target.std(), 1e-12))


def growth(image: Float, reference: Float) -> float:
    """Return by which share an image, (height, width), is larger than the reference about its centre.

    A linear fit. Both lie on one another; what moved in at the border by that is left out.
    """
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in reference.shape)
    wide = reference.astype(np.float64)
    down, right = (ndimage.correlate1d(wide, _SLOPE, axis=axis) for axis in (0, 1))
    radial = -(rows[:, None] * down + columns * right)
    inner = tuple(slice(min(_BORDER_PX, n // 4), n - min(_BORDER_PX, n // 4)) for n in reference.shape)
    parts = (radial, -down, -right, wide, np.ones_like(radial))
    design = np.stack([part[inner].ravel() for part in parts], axis=1)
    target = image[inner].ravel().astype(np.float64)
    solution = np.linalg.lstsq(design.T @ design, design.T @ target, rcond=None)[0]
    return float(solution[0] / solution[3]) if solution[3] else 0.0


@dataclass(frozen=True, slots=True)
class Scatter:
    """How the frames of an average scatter, beyond what their noise explains; of several averages: pooled."""

    frames: int
    """Of one average."""
    flicker: float = 0.0
    """Standard deviation of the brightness, relative."""
    motion_px: float = 0.0
    """Standard deviation of the place, both axes together, pixels of the camera."""
    ambient: float = 0.0
    """Standard deviation of light that came in evenly, in units of the mean light."""
    averages: int = 1
    """Averages whose frames were looked at."""
    sharp_px: float = _SHARP_PX
    """Width of the finest structure of what shook, pixels of the camera, as far as it is finer than usual."""

    @property
    def brightness_error(self) -> float:
        """Of an average: standard deviation, relative."""
        return self.flicker / float(np.sqrt(self.frames))

    @property
    def place_error_px(self) -> float:
        """Of an average: standard deviation, pixels."""
        return self.motion_px / float(np.sqrt(self.frames))

    @property
    def blur(self) -> float:
        """About how much a plain average of many differs from one of steady frames, relative."""
        return self.moved**2 / 2

    @property
    def moved(self) -> float:
        """About how much single frames differ by their place, relative."""
        return self.motion_px / min(self.sharp_px, _SHARP_PX)

    def on_pixels(self, factor: int) -> Scatter:
        """Return it in pixels of the camera, where it was found on pixels ``factor`` times as large."""
        return replace(self, motion_px=factor * self.motion_px, sharp_px=factor * self.sharp_px)

    @property
    def frames_needed(self) -> int:
        """Frames of an average whose brightness is known well enough."""
        return int(np.ceil((self.flicker / TOLERATED) ** 2))

    def findings(self, what: str = "PSF", *, put_back: bool = True) -> tuple[str, ...]:
        """Return what is wrong with the light and the place of what was averaged, with the remedy.

        ``put_back`` says that frames were put onto one another before they were averaged.
        """
        found = []
        if self.brightness_error > TOLERATED:
            many = "one frame" if self.frames == 1 else f"{self.frames} frames"
            found.append(
                f"the light flickers by {self.flicker:.1%} from frame to frame, so that the brightness of a "
                f"{what} of {many} is known to {self.brightness_error:.1%} only (wanted: {TOLERATED:.0%}): "
                f"{_STEADY_LIGHT}, or average {self.frames_needed} frames."
            )
        if self.ambient > TOLERATED:
            found.append(self._other_light(what))
        if self.blur > TOLERATED:
            how = "frames were put" if put_back else "too smooth for its frames to be put"
            how = "one frame each" if self.frames == 1 else f"{how} onto one another"
            found.append(
                f"the picture shakes by {self.motion_px:.2f} pixels from frame to frame ({how}; the place of "
                f"a {what} is known to {self.place_error_px:.2f} pixels): {_STILL}."
            )
        return tuple(found)

    def causes(self, what: str = "picture") -> tuple[str, ...]:
        """Return why single frames disagree: what changes them most, however little it is."""
        changes = {
            f"the light flickers by {self.flicker:.1%} from {what} to {what}: {_STEADY_LIGHT}.": self.flicker,
            self._other_light(what): self.ambient,
            f"the picture shakes by {self.motion_px:.2f} pixels from {what} to {what}: {_STILL}.": self.moved,
        }
        most = max(changes.values())
        return tuple(words for words, change in changes.items() if change > 0 and change >= most / 2)

    def _other_light(self, what: str) -> str:
        return (
            f"other light came and went between frames, by {self.ambient:.1%} of the {what}'s mean: keep "
            "daylight, lamps and screens out."
        )


STEADY = Scatter(1, averages=0)
"""Nothing is known of a scatter: single frames."""


def scatter_of(frames: Float) -> tuple[Scatter, list[Change]]:
    """Return how frames of the same thing scatter, and how each differs from their mean.

    Parameters
    ----------
    frames : ndarray, float32, (n_frames, height, width)
        Dark frames taken off, hot pixels replaced.
    """
    if len(frames) < 2:
        return Scatter(len(frames), averages=0), []
    changes = _against(frames, frames.mean(axis=0, dtype=np.float32))
    if not max(change.shift_px for change in changes) <= _LINEAR_PX:  # their mean is blurred: once more
        changes = _against(frames, frames[0])
        if all(np.isfinite(change.shift_px) for change in changes):
            back = [_put_back(frame, change) for frame, change in zip(frames, changes, strict=True)]
            changes = _against(frames, np.mean(back, axis=0).astype(np.float32))
    if not all(np.isfinite(change.shift_px) for change in changes):
        return Scatter(len(frames), averages=0), []
    levels = np.array([change.brightness for change in changes])
    places = np.array([(change.rows, change.columns) for change in changes])
    ambient = np.array([change.ambient for change in changes])
    flicker = _beyond(levels.var(ddof=1), [c.brightness_noise for c in changes]) / abs(levels.mean())
    motion = _beyond(places.var(axis=0, ddof=1).sum(), [c.place_noise for c in changes])
    came = _beyond(ambient.var(ddof=1), [c.brightness_noise for c in changes])
    sharp_px = _finest_px(frames) if motion else _SHARP_PX
    return Scatter(len(frames), float(flicker), motion, came, sharp_px=sharp_px), changes


def _finest_px(frames: Float) -> float:
    """Return the width of the finest structure that frames share: the ratio of their light to its slopes.

    One half of the frames against the other: what noise adds to slopes is not in both.
    """
    one, other = (frames[start::2].mean(axis=0, dtype=np.float32) for start in (0, 1))
    one, other = one - np.median(one), other - np.median(other)
    slopes = sum(float(np.vdot(np.diff(one, axis=axis), np.diff(other, axis=axis))) for axis in (0, 1))
    light = float(np.vdot(one, other))
    if not (light > 0 and slopes > 0):
        return _SHARP_PX
    return float(np.clip(np.sqrt(light / slopes), _SHARPEST_PX, _SHARP_PX))


def _against(frames: Float, reference: Float) -> list[Change]:
    return [compare(frame, reference) for frame in frames]


def _beyond(variance: float, noises: Sequence[float]) -> float:
    """Return the standard deviation that is left when the noise's share is taken off; 0 for what is its."""
    expected = float(np.mean(np.square(noises)))
    return float(np.sqrt(variance - expected)) if variance > _SURE**2 * expected else 0.0


@dataclass(frozen=True, slots=True)
class Steadied:
    """Frames of the same thing with what flickered and shook taken out, as far as they tell."""

    frames: Float
    """(n_frames, height, width) or (n_frames, height, width, 3): as bright as their mean, and put onto one
    another."""
    scatter: Scatter
    levels: tuple[float, ...] = ()
    """How bright each frame was, where the light flickered."""

    @property
    def mean(self) -> Float:
        """Their mean; a frame counts by the light it had, as a dim one was brightened with its noise."""
        if not self.levels:
            mean: Float = self.frames.mean(axis=0, dtype=np.float32)
            return mean
        shares = np.maximum(self.levels, 0.0) / np.maximum(self.levels, 0.0).sum()
        return np.tensordot(shares.astype(np.float32), self.frames, axes=1).astype(np.float32)


def steadied(frames: Float) -> Steadied:
    """Look at how frames scatter, and take out what they tell.

    Parameters
    ----------
    frames : ndarray, float32, (n_frames, height, width) or (n_frames, height, width, 3)
        Of the same thing, dark frames taken off, hot pixels replaced.
    """
    scatter, changes = scatter_of(frames if frames.ndim == 3 else frames.mean(axis=-1))
    levels = np.empty(0, np.float32)
    if scatter.flicker > 0:
        levels = np.array([change.brightness for change in changes], np.float32)
        frames = frames * (levels.mean() / levels).reshape(-1, *(1,) * (frames.ndim - 1))
    if scatter.motion_px > _SHAKEN_PX:
        frames = np.stack([_put_back(frame, change) for frame, change in zip(frames, changes, strict=True)])
    return Steadied(frames, scatter, tuple(levels.tolist()))


def _put_back(frame: Float, change: Change) -> Float:
    """Return a frame, (height, width) or (height, width, 3), moved back onto the mean."""
    if frame.ndim == 2:
        return np.asarray(moved(frame, -change.rows, -change.columns), np.float32)
    first = np.moveaxis(frame, -1, 0)
    return np.asarray(np.moveaxis(moved(first, -change.rows, -change.columns), 0, -1), np.float32)


def pooled(scatters: Sequence[Scatter]) -> Scatter:
    """Return the scatter of several averages together: the root of the mean square."""
    known = [one for one in scatters if one.averages]
    if not known:
        return scatters[0] if scatters else STEADY
    means = {
        name: float(np.sqrt(np.mean([getattr(one, name) ** 2 for one in known])))
        for name in ("flicker", "motion_px", "ambient")
    }
    sharp_px = min(one.sharp_px for one in known)
    return Scatter(min(one.frames for one in known), averages=len(known), sharp_px=sharp_px, **means)
