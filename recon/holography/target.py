"""What a hologram is asked to show, where it counts, and which of it an eye resolves (Kuo 2020, Eq. 7.18)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, pi, sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float64Array
from recon.base.fft import fast_length
from recon.errors import InputError
from recon.holography.display import Display

Grid = Literal["alias-free", "dissertation"]

CUT = 1.58
"""Radius, in units of the cut-off, beyond which the filter (then 0.010) counts as zero."""
ORDER = 5


def cutoff_radius(slm_shape: tuple[int, int]) -> float:
    """Return ``r0 = sqrt(Nx Ny / pi)`` mask pixels: as many lags inside as the SLM has pixels (Eq. 7.18)."""
    return sqrt(slm_shape[0] * slm_shape[1] / pi)


@dataclass(frozen=True, slots=True)
class Band:
    """The grid that an intensity needs so that the eye's low-pass can be taken without aliasing; kept lags.

    The intensity's spectrum is the auto-correlation of the field behind the mask: it reaches lags up to the
    whole aperture, twice what an FFT of the aperture's own size can tell apart. Zero-padding the aperture by
    the radius at which the filter is cut keeps every lag inside the filter clean (lag ``l`` is mixed with
    ``l - P``, and ``P - A`` is at least the radius), without paying for the full double size.

    Attributes
    ----------
    aperture : (int, int)
        Mask pixels ``(height, width)``.
    shape : (int, int)
        Grid of the field, the aperture zero-padded.
    radius : (int, int)
        Largest lag kept along y and x, in mask pixels. Lags beyond count as filtered out.
    cutoff : float
        ``r0`` in mask pixels.
    """

    aperture: tuple[int, int]
    shape: tuple[int, int]
    radius: tuple[int, int]
    cutoff: float

    @property
    def full(self) -> bool:
        """Whether every lag of the grid is kept."""
        return 2 * self.radius[1] == self.shape[1]

    @property
    def kept(self) -> tuple[int, int]:
        """Shape of the half spectrum that is kept."""
        return (min(2 * self.radius[0] + 1, self.shape[0]), self.radius[1] + 1)

    @property
    def seen_shape(self) -> tuple[int, int]:
        """Smallest fast grid that holds the filtered image without loss."""
        if self.full:
            return self.shape
        return (fast_length(self.kept[0]), fast_length(2 * self.kept[1] - 1, real=True))

    def lags(self) -> tuple[Float64Array, Float64Array]:
        """Return the lags of the kept rows (first the positive ones) and columns, mask pixels."""
        rows = self.kept[0]
        y = np.arange(rows, dtype=float)
        y[self.top :] -= rows
        return y, np.arange(self.kept[1], dtype=float)

    @property
    def top(self) -> int:
        """Number of kept rows at the start of the spectrum; the others are at its end."""
        return min(self.radius[0] + 1, self.kept[0])


def make_band(slm_shape: tuple[int, int], factor: int, grid: Grid, *, unfiltered: bool = False) -> Band:
    """Choose the grid for an SLM and a mask with ``factor`` pixels per SLM pixel along each axis.

    ``"alias-free"`` pads by the filter's radius; ``"dissertation"`` takes the aperture's own grid and keeps
    all of its (aliased) lags. ``unfiltered`` keeps every lag of the grid, for a loss without low-pass.
    """
    if factor < 1 or min(slm_shape) < 4:
        raise InputError(
            f"An SLM of {slm_shape} pixels with {factor} mask pixels per pixel cannot be modelled."
        )
    cutoff = cutoff_radius(slm_shape)
    aperture = (slm_shape[0] * factor, slm_shape[1] * factor)
    if grid == "dissertation":
        if aperture[1] % 2:
            raise InputError(f"The dissertation's grid needs an even width, not {aperture[1]} mask pixels.")
        return Band(aperture, aperture, (aperture[0] // 2, aperture[1] // 2), cutoff)
    reach = [min(ceil(CUT * cutoff), n - 1) for n in aperture]
    shape = (
        fast_length(aperture[0] + reach[0]),
        fast_length(aperture[1] + reach[1], real=True),
    )
    if unfiltered:
        return Band(aperture, shape, (shape[0] // 2, shape[1] // 2), cutoff)
    return Band(aperture, shape, (reach[0], reach[1]), cutoff)


def band_of(display: Display, grid: Grid = "alias-free", *, unfiltered: bool = False) -> Band:
    """Choose the grid for a display, as :func:`make_band` does.

    Of a near picture the field's spectrum is what is transformed: twice as wide as the mask pixels' own band,
    the mask pixels' first orders with it. The eye resolves an SLM pixel there.

    Raises InputError for the dissertation's grid and a near picture.
    """
    if not display.near:
        return make_band(display.slm_shape, display.factor, grid, unfiltered=unfiltered)
    if grid == "dissertation":
        raise InputError("The dissertation's grid is for displays with a Fourier lens.")
    side = display.period * (2 if display.mask_fill else 1)
    cutoff = display.period / display.factor / sqrt(pi)
    reach = min(ceil(CUT * cutoff), side - 1)
    whole = fast_length(side + reach, real=True)
    radius = whole // 2 if unfiltered else reach
    return Band((side, side), (whole, whole), (radius, radius), cutoff)


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of the field, in fractions of it from the top left."""

    top: float
    left: float
    bottom: float
    right: float

    def part(self, shape: tuple[int, ...]) -> tuple[slice, slice]:
        """Return the rows and columns inside it of an image over the field, the centre in the middle."""
        height, width = shape[:2]
        return _between(self.top, self.bottom, height), _between(self.left, self.right, width)

    def shrunk(self, share: float) -> Window:
        """Return it in a field of which this one is the middle, a ``share`` along each axis."""
        sides = (self.top, self.left, self.bottom, self.right)
        return Window(*(0.5 + share * (side - 0.5) for side in sides))


def _between(first: float, last: float, n: int) -> slice:
    return slice(ceil((first - 0.5) * n + n // 2), ceil((last - 0.5) * n + n // 2))


EVERYWHERE = Window(0.0, 0.0, 1.0, 1.0)


def near_window(display: Display) -> Window:
    """Return where in its field a near picture stands: over the mask, a square of its shorter side."""
    return EVERYWHERE.shrunk(display.picture_mm / display.field_mm)


FIRST_ORDER = Window(0.05, 0.55, 0.45, 0.95)
"""Where mirrors show a picture: away from the twin (opposite), and from the light that no mirror deflects, in
the middle and on the axes through it."""

BESIDE = Window(0.0, 0.52, 0.48, 1.0)
"""What is nearer to it than to these."""


@dataclass(frozen=True, slots=True)
class Target:
    """An intensity image over the whole field of view, in focus at ``z_mm``.

    Attributes
    ----------
    image : ndarray, real, (height, width)
        Linear intensity, non-negative, any size and scale; row 0 is the field's top.
    z_mm : float
        Distance of the plane from the Fourier lens' focal plane, away from the lens.
    white : float or None
        The value that PSNR counts as peak; the image's maximum by default.
    window : Window or None
        Where in the field it counts; everywhere by default.
    """

    image: Array
    z_mm: float = 0.0
    white: float | None = None
    window: Window | None = None

    def __post_init__(self) -> None:
        if self.image.ndim != 2 or min(self.image.shape) < 8:
            raise InputError(f"A target is (height, width) of at least 8 x 8 pixels, not {self.image.shape}.")
        if not np.isfinite(self.image).all() or self.image.min() < 0 or self.image.max() <= 0:
            raise InputError("A target must be finite, not negative, and not black everywhere.")

    def scaled(self, display: Display) -> tuple[Float64Array, float]:
        """Return the image and its peak, scaled to what the display can emit, in FFT order (axis first).

        A phase SLM cannot make the whole field darker: the mean of the intensity before the mask's envelope
        is 1. So the target is scaled until its mean, the envelope divided out, is 1.
        """
        image = np.fft.ifftshift(np.asarray(self.image, np.float64))
        ey, ex = display.transmitted((image.shape[0], image.shape[1]))
        scale = 1.0 / float((image / ey[:, None] / ex).mean())
        peak = float(self.image.max()) if self.white is None else self.white
        return image * scale, peak * scale

    def spectrum(self, display: Display, band: Band) -> tuple[npt.NDArray[np.complex128], float]:
        """Return Fourier coefficients at the band's kept lags, (rows, columns), and the scaled peak.

        Lags that the image's own sampling does not reach are zero.
        """
        image, peak = self.scaled(display)
        spectrum = np.fft.rfft2(image) / image.size
        y, x = (lag.astype(int) for lag in band.lags())
        known = (2 * np.abs(y)[:, None] < image.shape[0]) & (2 * x[None, :] < image.shape[1])
        if band.full and image.shape == band.shape:
            known[:] = True
        rows = np.where(2 * np.abs(y) <= image.shape[0], y, 0) % image.shape[0]
        columns = np.minimum(x, spectrum.shape[1] - 1)
        kept = spectrum[np.ix_(rows, columns)]
        kept[~known] = 0
        return kept, peak


def weights_on(weights: Array, shape: tuple[int, int]) -> Float64Array:
    """Return weights over the field on another grid over it, in FFT order, greatest value 1."""
    from scipy.ndimage import map_coordinates

    weights = np.asarray(weights, float)
    at = [(np.fft.fftfreq(n) * m + m // 2).clip(0, m - 1) for n, m in zip(shape, weights.shape, strict=True)]
    smooth = map_coordinates(weights, np.meshgrid(*at, indexing="ij"), order=1)
    return np.asarray(smooth / weights.max(), np.float64)


def _places(n: int) -> Float64Array:
    """Return where an image's pixels are in the field, in fractions of it: the middle one is on the axis."""
    return 0.5 + (np.arange(n) - n // 2) / n


def foveal_weights(
    shape: tuple[int, int],
    *,
    centre: tuple[float, float] = (0.5, 0.5),
    radius: float = 0.28,
    periphery: float = 0.1,
    edge: float = 0.1,
) -> Float64Array:
    """Return weights that are 1 around a point and fall smoothly to ``periphery`` (Sec. 7.4).

    Parameters
    ----------
    shape : (int, int)
    centre : (float, float)
        ``(y, x)`` in fractions of the field, (0, 0) the top left corner.
    radius : float
        Of the region that counts fully, in fractions of the field. The default circle covers a quarter of it.
    periphery : float
        Weight far outside.
    edge : float
        Width of the transition outside the radius, in fractions of the field.
    """
    if not (0 <= periphery <= 1 and radius > 0 and edge > 0):
        raise InputError(
            f"Foveal weights need radius and edge above 0 and periphery in 0 to 1, not {radius:g}, {edge:g}, "
            f"{periphery:g}."
        )
    y, x = (_places(n) for n in shape)
    distance = np.hypot(y[:, None] - centre[0], x[None, :] - centre[1])
    falling = np.clip((distance - radius) / edge, 0.0, 1.0)
    return periphery + (1 - periphery) * (0.5 + 0.5 * np.cos(np.pi * falling))


def painted_weights(
    shape: tuple[int, int],
    strokes: Sequence[tuple[float, float, float, float]],
    *,
    background: float = 0.1,
) -> Float64Array:
    """Return weights painted with a round brush: later strokes cover earlier ones.

    Parameters
    ----------
    shape : (int, int)
    strokes : sequence of (y, x, radius, weight)
        Centre and radius in fractions of the field, (0, 0) the top left corner; weight in 0 to 1. The rim,
        a quarter of the radius wide, is soft.
    background : float
        Weight where nothing was painted.
    """
    values = [background, *(weight for _, _, _, weight in strokes)]
    if not all(0 <= value <= 1 for value in values) or max(values) == 0:
        raise InputError("Painted weights lie in 0 to 1, and not all of them are 0.")
    weights = np.full(shape, background, np.float64)
    y, x = (_places(n) for n in shape)
    for row, column, radius, weight in strokes:
        if not radius > 0:
            raise InputError(f"A brush has a radius above 0, not {radius:g}.")
        distance = np.hypot(y[:, None] - row, x[None, :] - column) / radius
        cover = np.clip((1.0 - distance) / 0.25, 0.0, 1.0)
        weights += cover * (weight - weights)
    return weights
