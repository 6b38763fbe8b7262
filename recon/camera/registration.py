"""Registration of PSFs to one another by cross-correlation (Kuo 2020, Sec. 5.2).

A source off the axis casts the pattern of the one on the axis, shifted and scaled, and then changed a little:
aberrations of oblique light, the sensor's angular response, the sensor's edge that cuts it. To be robust
against these, the cross-correlation sees only fine structure: each image minus its own local mean, taken over
the pixels that there are (a plain high-pass would turn the sensor's edge into the strongest feature of all).
The correlation is a band-limited function, so its peak between pixels is found on the spectrum itself,
without interpolation and its bias towards whole pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Array
from recon.base import fft
from recon.base.blocks import block_mean
from recon.camera.transformed import geometric_centre, resampled
from recon.errors import InputError

LOCAL_MEAN_PX = 8.0
"""Standard deviation of the Gaussian whose mean is taken off: structure much coarser does not count."""
LEAST_PROMINENCE = 1.5
"""Correlation peak over the next one elsewhere, below which a registration is not to be relied on."""
_ELSEWHERE_PX = 8  # as far from the peak as its own flanks reach
_LARGEST_SCALE = 1.7  # searched on both sides of 1
_COARSEST_PX = 60  # short side of the images that the search for scale begins with


@dataclass(frozen=True, slots=True)
class Registration:
    """How the pattern of one PSF lies on that of another.

    Attributes
    ----------
    rows, columns : float
        Displacement in pixels; :func:`aligned` takes it back.
    scale : float
        Size relative to the reference's, about the image's centre; the displacement comes on top.
    similarity : float
        Inner product of the two patterns once aligned, of unit norm each, over the pixels that show both
        (Kuo 2020, Fig. 5.1d).
    prominence : float
        Correlation peak over the next highest more than a few pixels away.
    """

    rows: float
    columns: float
    scale: float
    similarity: float
    prominence: float

    @property
    def reliable(self) -> bool:
        """Whether the correlation has one peak that stands out."""
        return self.prominence >= LEAST_PROMINENCE


def register(
    psf: Array,
    reference: Array,
    *,
    scale: float | None = 1.0,
    near: tuple[float, float] | None = None,
    within_px: float = 32.0,
) -> Registration:
    """Find by how much the pattern of ``psf`` is displaced and scaled relative to that of ``reference``.

    Parameters
    ----------
    psf, reference : ndarray, (height, width)
        Background removed.
    scale : float, optional
        Size of the pattern relative to the reference's where it is known: 1 at equal depths,
        ``refocus.paraxial_scale`` at others. None: found between 0.6 and 1.7, by coarse to fine search.
    near : (rows, columns), optional
        Where the displacement is expected, e.g. by :func:`expected_shift`: only ``within_px`` of it is
        searched. Needed where a pattern resembles its own shift (a regular lenslet array). None: everywhere.

    Raises InputError when the images differ in shape or one of them is constant.
    """
    first, second = (np.asarray(image, np.float32) for image in (psf, reference))
    if first.ndim != 2 or first.shape != second.shape:
        raise InputError(f"Registration needs two images of one shape, not {first.shape} and {second.shape}.")
    for image, name in ((first, "PSF"), (second, "reference")):
        if not np.ptp(image) > 0:
            raise InputError(f"The {name} to register is constant: there is no pattern in it.")
    if scale is None:
        scale = _find_scale(first, second)
    resized = first if scale == 1 else rescaled(first, scale) * np.float32(scale**2)
    window = None if near is None else (near[0] / scale, near[1] / scale, within_px / scale)
    peak = _Correlation(_fine(resized), _fine(second)).peak(window)
    # In the shrunken (or enlarged) image one pixel is ``scale`` pixels of the PSF.
    rows, columns = scale * peak.row, scale * peak.column
    back = moved(resized, -peak.row, -peak.column)
    return Registration(rows, columns, scale, _similarity(back, second, peak), peak.prominence)


def aligned(psf: Array, registration: Registration) -> Array:
    """Return ``psf`` (..., height, width) moved and scaled onto the reference; non-negative where it was.

    Cubic splines; what lies beyond the image's edge is zero. This is ``h_i(s u + shift)`` of Kuo 2020,
    Eq. 5.2 with the measured scale and shift.
    """
    values = np.asarray(psf, np.float32)
    if registration.scale != 1:
        values = rescaled(values, registration.scale) * np.float32(registration.scale**2)
    by = -registration.rows / registration.scale, -registration.columns / registration.scale
    return moved(values, *by)


def expected_shift(
    source_um: tuple[float, float, float], distance_um: float, pitch_um: float
) -> tuple[float, float]:
    """Return (rows, columns) by which a source's place displaces its pattern: ``-(y, x) d / z / pitch``.

    Kuo 2020, Eq. 5.2 writes the shift of source ``i`` with the depth registered to; rays through the
    aperture's centre ask for the source's own depth, ``d / z_i`` (equal where depths are).
    """
    x, y, z = source_um
    return -y * distance_um / z / pitch_um, -x * distance_um / z / pitch_um


def rescaled(image: Array, s: float, *, centre: tuple[float, float] | None = None) -> Array:
    """Return ``image(c + s (v - c))``: shrunk ``s`` times about a point.

    Cubic splines; where the image shrinks, a Gaussian first takes out what the new pixels cannot hold. Zero
    beyond the border, and no negative value that the image did not have. Light falls as ``1 / s^2``.

    Parameters
    ----------
    image : ndarray, (..., height, width)
    s : float
        Above 1 shrinks the pattern, below 1 enlarges it.
    centre : (float, float), optional
        ``(row, column)`` that stays; default the geometric centre.
    """
    if not 0 < s < np.inf:
        raise InputError(f"A scale is a positive number, not {s}.")
    middle = geometric_centre(image) if centre is None else np.asarray(centre, float)
    return resampled(image, [s, s], middle - s * middle)


def displacement(psf: Array, reference: Array) -> tuple[int, int]:
    """Return by how many whole (rows, columns) the pattern of ``psf`` lies off that of ``reference``.

    Parameters
    ----------
    psf, reference : ndarray, (height, width)
    """
    return _Correlation(_fine(psf), _fine(reference)).whole_peak()


def likeness(psf: Array, reference: Array) -> float:
    """Return how alike the fine structure of two images (height, width) is where they match best, up to 1."""
    return _Correlation(_fine(psf), _fine(reference)).height


def shifted(image: Array, rows: int, columns: int) -> Array:
    """Return ``image`` (..., height, width) moved by whole pixels; zeros move in."""
    result = np.zeros_like(image)
    height, width = image.shape[-2:]
    source, target = [], []
    for n, by in ((height, rows), (width, columns)):
        source.append(slice(max(-by, 0), max(min(n - by, n), 0)))
        target.append(slice(max(by, 0), max(min(n + by, n), 0)))
    result[..., target[0], target[1]] = image[..., source[0], source[1]]
    return result


@dataclass(frozen=True, slots=True)
class _Peak:
    row: float
    column: float
    height: float
    prominence: float


class _Correlation:
    """Cross-correlation of two images, padded so that nothing wraps around."""

    def __init__(self, first: Array, second: Array) -> None:
        self._shape = fft.fast_shape([2 * n for n in first.shape])
        self._spectrum = self._transformed(first) * np.conj(self._transformed(second))
        self._values = fft.irfft(self._spectrum.copy(), self._shape[1])
        self._norm = float(np.linalg.norm(first)) * float(np.linalg.norm(second))

    def _transformed(self, image: Array) -> Array:
        padded = np.zeros(self._shape, np.float32)
        padded[: image.shape[0], : image.shape[1]] = image
        return fft.rfft(padded)

    def whole_peak(self) -> tuple[int, int]:
        """Return the shift in whole pixels with the highest correlation."""
        place = np.unravel_index(int(np.argmax(self._values)), self._shape)
        row, column = (int(p) - n if p > n // 2 else int(p) for p, n in zip(place, self._shape, strict=True))
        return row, column

    @property
    def height(self) -> float:
        """The peak in whole pixels, relative to the images' norms."""
        return float(self._values.max()) / self._norm

    def peak(self, window: tuple[float, float, float] | None = None) -> _Peak:
        """Return the maximum between pixels, by Newton's method on the spectrum.

        ``window`` = (row, column, reach) limits where it is looked for.
        """
        if window is not None:
            self._mask(*window)
        whole = self.whole_peak()
        row, column = (float(p) for p in whole)
        value, gradient, hessian = self._derivatives(row, column)
        for _ in range(4):
            if not (hessian[0, 0] < 0 and np.linalg.det(hessian) > 0):
                break
            step = -np.linalg.solve(hessian, gradient)
            step *= min(1.0, 0.5 / float(np.abs(step).max() + 1e-12))
            # Of a maximum among whole pixels the true one is less than a pixel away.
            row = float(np.clip(row + step[0], whole[0] - 1, whole[0] + 1))
            column = float(np.clip(column + step[1], whole[1] - 1, whole[1] + 1))
            value, gradient, hessian = self._derivatives(row, column)
            if np.abs(step).max() < 1e-4:
                break
        return _Peak(row, column, value / self._norm, value / max(self._elsewhere(whole), 1e-30))

    def _derivatives(self, row: float, column: float) -> tuple[float, Array, Array]:
        """Value, gradient and Hessian of the correlation at a shift, from its Fourier series."""
        height, width = self._shape
        ky = 2j * np.pi * np.fft.fftfreq(height)
        kx = 2j * np.pi * np.fft.rfftfreq(width)
        twice = np.full(len(kx), 2.0)  # the other half of the real transform
        twice[0] = twice[-1] = 1.0
        ey, ex = np.exp(ky * row), np.exp(kx * column) * twice
        across = self._spectrum @ np.stack([ex, kx * ex, kx**2 * ex], axis=1).astype(np.complex64)
        along = np.stack([ey, ky * ey, ky**2 * ey])
        terms = (along @ across).real / (height * width)
        gradient = np.array([terms[1, 0], terms[0, 1]])
        hessian = np.array([[terms[2, 0], terms[1, 1]], [terms[1, 1], terms[0, 2]]])
        return float(terms[0, 0]), gradient, hessian

    def _mask(self, row: float, column: float, reach: float) -> None:
        """Forget the correlation farther than ``reach`` from a shift."""
        near = []
        for centre, n in zip((row, column), self._shape, strict=True):
            lags = np.arange(n)
            lags[lags > n // 2] -= n
            near.append(np.abs(lags - centre) <= reach)
        self._values[~(near[0][:, None] & near[1])] = 0

    def _elsewhere(self, peak: tuple[int, int]) -> float:
        """Highest correlation outside the peak's neighbourhood."""
        rest = self._values.copy()
        reach = np.arange(-_ELSEWHERE_PX, _ELSEWHERE_PX + 1)
        rest[np.ix_((peak[0] + reach) % self._shape[0], (peak[1] + reach) % self._shape[1])] = 0
        return float(rest.max())


def _fine(image: Array) -> Array:
    """Return an image minus its local mean over the pixels that there are."""
    from scipy import ndimage

    values = np.asarray(image, np.float32)
    mean = ndimage.gaussian_filter(values, LOCAL_MEAN_PX, mode="reflect")
    fine: Array = values - mean
    return fine


def moved(image: Array, rows: float, columns: float) -> Array:
    """Return ``image`` (..., height, width) moved by fractions of a pixel; zeros move in."""
    if rows == round(rows) and columns == round(columns):
        return shifted(image, round(rows), round(columns))
    from scipy import ndimage

    by = (0.0,) * (image.ndim - 2) + (rows, columns)
    result: Array = ndimage.shift(np.asarray(image, np.float32), by, order=3, mode="constant")
    return np.maximum(result, 0) if image.min() >= 0 else result


def _similarity(back: Array, reference: Array, peak: _Peak) -> float:
    """Inner product of two aligned patterns over the pixels that show both."""
    both = shifted(np.ones(back.shape, bool), -round(peak.row), -round(peak.column))
    a, b = back[both].astype(np.float64), reference[both].astype(np.float64)
    norm = float(np.linalg.norm(a) * np.linalg.norm(b))
    return float(np.vdot(a, b)) / norm if norm > 0 else 0.0


def _find_scale(first: Array, second: Array) -> float:
    """Search the relative size of two patterns, coarse to fine.

    Correlation falls once the edges of the pattern part by a feature, so the coarsest images need the fewest
    scales; each finer level looks between those of the level before. A parabola tells the rest.
    """
    factor = 1
    while min(first.shape) // (2 * factor) >= _COARSEST_PX:
        factor *= 2
    step = 2.0 / (min(first.shape) // factor // 2)
    reach = int(np.ceil(np.log(_LARGEST_SCALE) / step))
    tried = step * np.arange(-reach, reach + 1)
    while True:
        a, b = (_blocks(image, factor) for image in (first, second))
        fine = _fine(b)
        heights = [_Correlation(_fine(rescaled(a, float(np.exp(s)))), fine).height for s in tried]
        best = int(np.argmax(heights))
        if factor == 1:
            break
        factor //= 2
        step /= 2
        tried = tried[best] + step * np.arange(-2, 3)
    if 0 < best < len(tried) - 1:
        low, top, high = heights[best - 1 : best + 2]
        curvature = low - 2 * top + high
        offset = 0.5 * (low - high) / curvature if curvature < 0 else 0.0
        return float(np.exp(tried[best] + offset * step))
    return float(np.exp(tried[best]))


def _blocks(image: Array, factor: int) -> Array:
    """Average blocks of ``factor x factor`` pixels, cut symmetrically so that the centre stays."""
    height, width = (n // factor * factor for n in image.shape)
    top, left = (image.shape[0] - height) // 2, (image.shape[1] - width) // 2
    cut = image[top : top + height, left : left + width]
    return block_mean(cut, factor, dtype=image.dtype)
