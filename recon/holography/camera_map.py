"""Which camera pixel sees which direction: registration by the mask's own speckle.

With a blank SLM the camera sees the far field of the mask, which is known and, being an intensity, does not
depend on where the mask is (only its rotation turns it with the mask). Matching it block by block gives the
map from the field of view to the camera before anything is aligned, distortion included.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.fft import fast_length
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.target import Band


@dataclass(frozen=True, slots=True)
class CameraMap:
    """From places in the field of view to camera pixels.

    Attributes
    ----------
    shape : (int, int)
        Of the camera's frames.
    pixels_across : float
        Camera pixels across the field of view, nominally.
    coefficients : ndarray, float64, (10, 2)
        Third-order polynomial correction of (row, column), pixels.
    residual_px : float
        Rms residual of the fit.
    """

    shape: tuple[int, int]
    pixels_across: float
    coefficients: Float64Array
    residual_px: float = float("nan")

    def turned(self, rad: float) -> CameraMap:
        """Return the map of a camera that is nominally in its place, but turned."""
        coefficients = np.zeros((10, 2))
        across, along = self.pixels_across * np.sin(rad), self.pixels_across * (np.cos(rad) - 1)
        coefficients[_X], coefficients[_Y] = (-across, along), (along, across)
        return CameraMap(self.shape, self.pixels_across, coefficients)

    @property
    def turn_rad(self) -> float:
        """How the camera is turned."""
        gradient = self.gradient(0.0, 0.0)
        return float(np.arctan2(gradient[1, 0] - gradient[0, 1], gradient[0, 0] + gradient[1, 1]))

    @property
    def scale(self) -> float:
        """How large the field is around its middle, over what it is nominally."""
        return float(np.sqrt(abs(np.linalg.det(self.gradient(0.0, 0.0)))) / self.pixels_across)

    def gradient(self, y: float, x: float) -> Float64Array:
        """Return by how many (rows, columns) a place moves with y (first column) and x around it."""
        step = 0.01
        here = self.pixels(np.array(y), np.array(x))
        there = (np.array(y + step), np.array(x)), (np.array(y), np.array(x + step))
        return np.array([np.subtract(self.pixels(*place), here) for place in there]).T / step

    def pixels(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Return row and column (0 is the centre of the first pixel) of places in fractions of the field."""
        y, x = np.asarray(y, float), np.asarray(x, float)
        terms = _terms(y, x) @ self.coefficients
        row = (self.shape[0] - 1) / 2 + y * self.pixels_across + terms[..., 0]
        column = (self.shape[1] - 1) / 2 + x * self.pixels_across + terms[..., 1]
        return row, column

    def lags(self, image: Array, band: Band) -> npt.NDArray[np.complex128]:
        """Return Fourier coefficients of the light over the field of view at a band's kept lags.

        As ``HologramModel.lags``, in the image's unit. The camera is read by cubic splines, so finely that
        what it sees does not alias into the band, and the mean over its pixels is undone.

        Raises InputError where the camera's pixels are too coarse for the band.
        """
        from scipy.ndimage import map_coordinates, spline_filter

        if 2 * band.cutoff > self.pixels_across:
            raise InputError(
                f"The camera has {self.pixels_across:.0f} pixels across the field of view; to see all that "
                f"this display shows, {ceil(2 * band.cutoff)} are needed. Bin it less, or take a longer lens."
            )
        least = [max(2 * reach + 2, reach + self.pixels_across / 2) for reach in band.radius]
        shape = (fast_length(ceil(least[0])), fast_length(ceil(least[1]), real=True))
        y, x = ((np.arange(n) - n // 2) / n for n in shape)
        places = self.pixels(*np.meshgrid(y, x, indexing="ij"))
        smooth = spline_filter(np.asarray(image, np.float32), order=3, output=np.float32)
        seen = map_coordinates(smooth, places, order=3, prefilter=False, mode="constant")
        spectrum = np.fft.rfft2(np.fft.ifftshift(seen)) / seen.size
        down, across = (lag / self.pixels_across for lag in band.lags())
        kept = spectrum[np.ix_(band.lags()[0].astype(int) % shape[0], band.lags()[1].astype(int))]
        return np.asarray(kept / np.sinc(down)[:, None] / np.sinc(across), np.complex128)


_X, _Y = 1, 4
"""Where the terms of first order are."""


def _terms(y: Array, x: Array) -> Array:
    return np.stack([y**i * x**j for i in range(4) for j in range(4 - i)], axis=-1)


def polynomial_map(nominal: CameraMap, places: Array, shifts: Array) -> CameraMap:
    """Return a map with its third-order correction fitted to ``shifts`` (row, column) at places, pixels."""
    terms = _terms(places[:, 0], places[:, 1])
    solution = np.linalg.lstsq(terms, shifts, rcond=None)[0]
    left = shifts - terms @ solution
    residual = float(np.sqrt(np.sum(left**2) / max(2 * len(places) - solution.size, 1)))
    return CameraMap(nominal.shape, nominal.pixels_across, nominal.coefficients + solution, residual)


def mask_speckle(display: Display) -> Float32Array:
    """Return the far field of the mask alone over the field of view, at twice the mask's own sampling."""
    import scipy.fft

    height, width = display.mask.shape
    field = display.mask.field(display.wavelength_nm).astype(np.complex64)
    far = np.fft.fftshift(np.abs(scipy.fft.fft2(field, (2 * height, 2 * width))) ** 2) / field.size
    y, x = (np.sinc(np.arange(2 * n) / (2 * n) - 0.5) ** 2 for n in (height, width))
    return np.asarray(far * y[:, None] * x, np.float32)


TURNS_RAD = 0.02 * np.arange(-10, 11)
"""Rotations of the camera that are tried."""
_CLEAR = 6.0
"""Standard deviations by which the correlation of a block that is recognised stands out."""
_WIDE, _LOCAL = 60, 10
"""Largest shift of the middle, and of a block once the middle is known, pixels."""


def register_camera(
    frame: Array,
    display: Display,
    pixels_across: float,
    *,
    turned_rad: float | None = None,
) -> CameraMap:
    """Find the map from a frame taken with a blank SLM.

    Parameters
    ----------
    frame : ndarray, (height, width)
        Background subtracted.
    display : Display
    pixels_across : float
        Nominal number of camera pixels across the field of view, within about a per cent.
    turned_rad : float, optional
        How the camera was turned when it was registered last, where that is known; else it is looked for
        (:data:`TURNS_RAD`).

    Raises InputError when the speckle is not found: the frame is dark, another mask is in the beam, or the
    map is far off.
    """
    from scipy.ndimage import gaussian_filter

    speckle = mask_speckle(display)
    samples = (speckle.shape[0] / pixels_across, speckle.shape[1] / pixels_across)
    speckle = gaussian_filter(speckle, [0.4 * s for s in samples])
    image = gaussian_filter(np.asarray(frame, np.float32), 0.5)
    # A small mask's speckles are large: the middle needs as many of them.
    middle = int(np.clip(60 * pixels_across / min(display.mask.shape), 160, 400)) // 2 * 2
    found = CameraMap((frame.shape[0], frame.shape[1]), pixels_across, np.zeros((10, 2)))
    turn = _turn(image, speckle, found, middle) if turned_rad is None else turned_rad
    found = found.turned(turn)
    # The middle first, with a wide search; then outwards with the map found so far.
    for reach, count, wide, order in ((0.08, 1, _WIDE, 0), (0.25, 5, _LOCAL, 1), (0.45, 9, _LOCAL, 3)):
        places, shifts, weights = [], [], []
        side = middle if count == 1 else 96
        for y in np.linspace(-reach, reach, count) if count > 1 else (0.0,):
            for x in np.linspace(-reach, reach, count) if count > 1 else (0.0,):
                match = _match(image, speckle, found, float(y), float(x), side, wide)
                if match is not None:
                    places.append((y, x))
                    shifts.append(match[:2])
                    weights.append(match[2])
        found = _refit(found, np.array(places), np.array(shifts), np.array(weights), order, count)
    return found


def _turn(image: Array, speckle: Array, nominal: CameraMap, side: int) -> float:
    """Return the rotation at which the middle is recognised best; 0 where it clearly is without one."""

    def contrast(rad: float) -> float:
        match = _match(image, speckle, nominal.turned(rad), 0.0, 0.0, side, _WIDE)
        return 0.0 if match is None else match[2]

    if contrast(0.0) > 4 * _CLEAR:
        return 0.0
    found = np.array([contrast(float(rad)) for rad in TURNS_RAD])
    best = int(np.clip(np.argmax(found), 1, len(found) - 2))
    return float(TURNS_RAD[best] + _vertex(found[best - 1 : best + 2]) * (TURNS_RAD[1] - TURNS_RAD[0]))


def _match(
    image: Array, speckle: Array, found: CameraMap, y: float, x: float, side: int, search: int
) -> tuple[float, float, float] | None:
    """Correlate one block; returns the shift left over and how much the peak stands out."""
    from scipy.ndimage import map_coordinates

    row, column = (float(v) for v in found.pixels(np.array(y), np.array(x)))
    top, left = round(row) - side // 2, round(column) - side // 2
    if top < search or left < search or top + side + search > image.shape[0]:
        return None
    if left + side + search > image.shape[1]:
        return None
    # What the block should look like: places in the field of each of its pixels, by the map's linear part.
    inverse = np.linalg.inv(found.gradient(y, x))
    rows, columns = np.meshgrid(np.arange(side) + top - row, np.arange(side) + left - column, indexing="ij")
    fy, fx = (
        y + inverse[0, 0] * rows + inverse[0, 1] * columns,
        x + inverse[1, 0] * rows + inverse[1, 1] * columns,
    )
    height, width = speckle.shape
    wanted = map_coordinates(speckle, [(fy + 0.5) * height, (fx + 0.5) * width], order=1)
    around = image[top - search : top + side + search, left - search : left + side + search]
    wanted = wanted - wanted.mean()
    spectrum = np.fft.rfft2(around - around.mean()) * np.conj(np.fft.rfft2(wanted, around.shape))
    correlation = np.fft.irfft2(spectrum, around.shape)[: 2 * search + 1, : 2 * search + 1]
    i, j = np.unravel_index(int(np.argmax(correlation)), correlation.shape)
    contrast = float(correlation[i, j] / correlation.std())
    if not (0 < i < 2 * search and 0 < j < 2 * search):
        return None
    dy = _vertex(correlation[i - 1 : i + 2, j])
    dx = _vertex(correlation[i, j - 1 : j + 2])
    return float(i + dy - search), float(j + dx - search), contrast


def _vertex(three: Array) -> float:
    bend = three[0] - 2 * three[1] + three[2]
    return float(np.clip(0.5 * (three[0] - three[2]) / bend, -0.5, 0.5)) if bend < 0 else 0.0


def _refit(
    found: CameraMap, places: Array, shifts: Array, contrast: Array, order: int, count: int
) -> CameraMap:
    clear = contrast > _CLEAR if len(contrast) else np.zeros(0, bool)
    if clear.sum() < max(1, count * count // 3):
        raise InputError(
            f"The mask's speckle was recognised in {int(clear.sum())} of {count * count} places on the "
            "camera. Check that the laser shines, that the mask is the one described, and the focal length."
        )
    powers = [(i, j) for i in range(4) for j in range(4 - i)]
    used = [n for n, (i, j) in enumerate(powers) if i + j <= order]
    terms = _terms(places[:, 0], places[:, 1])[:, used]
    good = clear
    solution = np.zeros((len(used), 2))
    for _ in range(3):
        solution = np.linalg.lstsq(terms[good], shifts[good], rcond=None)[0]
        error = np.hypot(*(shifts - terms @ solution).T)
        good = clear & (error < max(1.0, 3 * float(np.median(error[clear]))))
    coefficients = found.coefficients.copy()
    coefficients[used] += solution
    residual = float(np.sqrt(np.mean(error[good] ** 2)))
    return CameraMap(found.shape, found.pixels_across, coefficients, residual)
