"""Points of light at continuous places: what they look like through a camera, and the points of an image.

On a grid of pixels a point between them is a blob; a point with a continuous place has none of that error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.base import fft

_MARGIN = 4  # pixels around a PSF for the tails of a shift between pixels
_LARGEST_MOVE_PX = 0.5
_HALVINGS = 3
_SAME_PX = 0.7  # points nearer to one another are one
WEAKEST = 0.15
"""Of the median light: what is dimmer is no bead of a slide."""
_SURE = 5.0  # times its own noise, for a bead to be believed
BLOB_PX = 2
"""How far around its brightest pixel a bead's light may lie on the grid."""
MOST = 150
"""Points of an image: more are hardly separate ones, and would take for ever."""


class FieldFunctions:
    """What PSFs vary with: polynomials of the field's coordinates, orthonormal over the places of the beads.

    PSFs that are combinations of ``k`` images weighted with ``k`` functions have rank ``k`` at most (Kuo
    2020, Eq. 5.13), and vary over the field no faster than the functions do: 1, 3, 6 for degrees 0, 1, 2.
    Beyond the rectangle of the beads, where nothing was measured, they stay what they are at its border.

    Parameters
    ----------
    degree : int
    places : ndarray, (n, 2)
        ``(row, column)`` of the beads; at least as many as functions, not all on a line.
    """

    def __init__(self, degree: int, places: Float64Array) -> None:
        self.degree = degree
        self._low, self._high = places.min(axis=0), places.max(axis=0)
        _, upper = np.linalg.qr(self._monomials(places) / np.sqrt(len(places)))
        # QR leaves the signs open; like this the first function is 1, and its image the mean PSF.
        self._to_orthonormal = upper * np.sign(np.diag(upper))[:, None]
        self.count = len(upper)

    def at(self, places: Float64Array) -> Float64Array:
        """Return the functions' values at places (n, 2): (n, count)."""
        return np.asarray(np.linalg.solve(self._to_orthonormal.T, self._monomials(places).T).T)

    def _monomials(self, places: Float64Array) -> Float64Array:
        middle, half = (self._low + self._high) / 2, np.maximum((self._high - self._low) / 2, 1e-9)
        row, column = np.clip((places - middle) / half, -1, 1).T
        powers = [(n - m, m) for n in range(self.degree + 1) for m in range(n + 1)]
        return np.stack([row**i * column**j for i, j in powers], axis=1)


@dataclass(frozen=True, slots=True)
class Points:
    """The beads of one image.

    Attributes
    ----------
    places : ndarray, float64, (n, 2) or (n, 3)
        ``(row, column)`` from the axis, object pixels; of points in depth after ``plane``.
    light : ndarray, float64, (n,)
    """

    places: Float64Array
    light: Float64Array

    def __len__(self) -> int:
        return len(self.light)


class PointImages:
    """What points look like through PSFs that vary over the field.

    Parameters
    ----------
    psfs : ndarray, float32, (n_functions, height, width)
        One image a field function.
    functions : FieldFunctions
    sensor_shape : (int, int)
    """

    def __init__(self, psfs: Float32Array, functions: FieldFunctions, sensor_shape: tuple[int, int]) -> None:
        self._functions, self._sensor = functions, sensor_shape
        self.psfs = psfs
        self._shape = psfs.shape[1] + 2 * _MARGIN, psfs.shape[2] + 2 * _MARGIN
        self._f_y = np.fft.fftfreq(self._shape[0])[:, None]
        self._f_x = np.fft.rfftfreq(self._shape[1])[None, :]

    def patch(self, place: Float64Array, *, slopes: bool = False) -> tuple[Float32Array, tuple[slice, slice]]:
        """Return the image of a point of unit light and where on the sensor it lies.

        Parameters
        ----------
        place : ndarray, (2,)
            Row and column; of a camera in depth (:class:`recon.camera.points_in_depth.ImagesInDepth`) after
            the plane.
        slopes : bool
            Also its derivatives along all of these.

        Returns
        -------
        ndarray, float32, (1 or 1 + the place's coordinates, rows, columns)
            Cut to the sensor.
        (slice, slice)
        """
        whole = np.round(place[-2:]).astype(int)
        part = place[-2:] - whole
        turn = np.exp(-2j * np.pi * (self._f_y * part[0] + self._f_x * part[1]))
        psf, changes = self._seen(place, slopes)
        spectra = [np.fft.rfft2(self._padded(image)) * turn for image in (psf, *changes)]
        if slopes:
            spectra += [-2j * np.pi * self._f_y * spectra[0], -2j * np.pi * self._f_x * spectra[0]]
        images = np.fft.irfft2(np.stack(spectra), s=self._shape, axes=(1, 2)).astype(np.float32)
        inside, on_sensor = [], []
        for axis in (0, 1):
            p, s = self.psfs.shape[1 + axis], self._sensor[axis]
            first = s // 2 - p // 2 + int(whole[axis]) - _MARGIN
            low, high = min(max(first, 0), s), min(max(first + self._shape[axis], 0), s)
            inside.append(slice(low - first, high - first))
            on_sensor.append(slice(low, high))
        return images[:, inside[0], inside[1]], (on_sensor[0], on_sensor[1])

    def within(self, places: Float64Array) -> Float64Array:
        """Return places, (n, 2), as far as this camera tells of them: as they are."""
        return places

    def _seen(self, place: Float64Array, slopes: bool) -> tuple[Float32Array, tuple[Float32Array, ...]]:
        """Return a PSF, and with ``slopes`` how it changes with what a place has before row and column."""
        del slopes
        weights = self._functions.at(place[None])[0].astype(np.float32)
        return np.tensordot(weights, self.psfs, 1), ()

    def _padded(self, psf: Float32Array) -> Float32Array:
        padded = np.zeros(self._shape, np.float32)
        padded[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN] = psf
        return padded

    def image(self, points: Points) -> Float32Array:
        """Return the image (height, width) of all points."""
        seen = np.zeros(self._sensor, np.float32)
        for place, light in zip(points.places, points.light, strict=True):
            patch, where = self.patch(place)
            seen[where] += np.float32(light) * patch[0]
        return seen


def refine(
    camera: PointImages, image: Float32Array, points: Points, sweeps: int = 2
) -> tuple[Points, Float32Array]:
    """Fit place and light of each point in turn, the others fixed: Gauss-Newton steps that only descend.

    Returns
    -------
    Points
    ndarray, float32, (height, width)
        What is left of the image.
    """
    places, light = points.places.copy(), points.light.copy()
    left = image - camera.image(points)
    for _ in range(sweeps):
        for k in range(len(light)):
            places[k], light[k] = _refined(camera, left, places[k], float(light[k]))
    return Points(places, light), left


def _refined(
    camera: PointImages, left: Float32Array, place: Float64Array, light: float
) -> tuple[Float64Array, float]:
    """Improve one point; ``left`` is kept up to date."""
    patch, where = camera.patch(place, slopes=True)
    if not patch.any():
        return place, light
    left[where] += np.float32(light) * patch[0]  # the data for this point alone
    columns = patch.reshape(3, -1).astype(np.float64)
    columns[1:] *= light
    normal = columns @ columns.T + 1e-9 * np.eye(3) * float(columns[0] @ columns[0])
    step = np.linalg.lstsq(normal, columns @ left[where].ravel() - normal[:, 0] * light, rcond=None)[0]
    move = step[1:] * min(1.0, _LARGEST_MOVE_PX / max(float(np.abs(step[1:]).max()), 1e-12))
    best_place, best_light, best_gain = place, *_fitted(patch[0], left[where])
    best = patch[0], where
    for _ in range(_HALVINGS):
        new_patch, new_where = camera.patch(place + move)
        new_light, gain = _fitted(new_patch[0], left[new_where])
        if gain > best_gain:
            best_place, best_light, best = place + move, new_light, (new_patch[0], new_where)
            break
        move = move / 2
    left[best[1]] -= np.float32(best_light) * best[0]
    return best_place, best_light


def _fitted(patch: Float32Array, data: Float32Array) -> tuple[float, float]:
    """Return the best light, not negative, and by how much it lessens the squared misfit."""
    energy = float(np.vdot(patch, patch))
    inner = max(float(np.vdot(patch, data)), 0.0)
    return (inner / energy, inner**2 / energy) if energy > 0 else (0.0, 0.0)


def cleaned(camera: PointImages, points: Points, noise: float, weakest: float = WEAKEST) -> Points:
    """Merge points that are one, and drop those dimmer than noise allows or a share of the median light."""
    order = np.argsort(-points.light)
    places: list[Float64Array] = []
    light: list[float] = []
    for k in order:
        near = [i for i, place in enumerate(places) if np.linalg.norm(place - points.places[k]) < _SAME_PX]
        if near:
            light[near[0]] += float(points.light[k])
        else:
            places.append(points.places[k])
            light.append(float(points.light[k]))
    if not light:
        return points
    sure = 0.0
    if noise > 0:
        sure = _SURE * noise / float(np.linalg.norm(camera.patch(np.zeros(2))[0]) + 1e-30)
    least = max(weakest * float(np.median(light)), sure)
    kept = np.array(light) >= least
    return Points(np.array(places)[kept].reshape(-1, points.places.shape[1]), np.array(light)[kept])


def overlooked(camera: PointImages, left: Float32Array, points: Points, noise: float) -> Points:
    """Return the points with those added that still stand out of what is left of the image."""
    from scipy import ndimage

    patch, where = camera.patch(np.zeros(2))
    energy = float(np.vdot(patch[0], patch[0]))
    if energy == 0 or not len(points):
        return points
    kernel = np.zeros_like(left)
    kernel[where] = patch[0]
    grid = fft.fast_shape([2 * n for n in left.shape])
    spectra = [np.fft.rfft2(a, s=grid) for a in (left, kernel)]
    correlation = np.fft.irfft2(spectra[0] * np.conj(spectra[1]), s=grid) / energy
    reach = [min(n, m // 2) for n, m in zip(left.shape, grid, strict=True)]
    rolled = np.roll(correlation, reach, axis=(0, 1))[: 2 * reach[0], : 2 * reach[1]]
    least = max(_SURE * noise / np.sqrt(energy), 2 * WEAKEST * float(np.median(points.light)))
    peaks = (rolled == ndimage.maximum_filter(rolled, 5)) & (rolled > least)
    found = np.argwhere(peaks).astype(np.float64) - reach
    distant = [f for f in found if np.hypot(*(points.places - f).T).min() > 2 * _SAME_PX]
    if not distant:
        return points
    added = np.array(distant)
    lights = np.array([rolled[int(r) + reach[0], int(c) + reach[1]] for r, c in added])
    return Points(np.concatenate([points.places, added]), np.concatenate([points.light, lights]))


def points_on_grid(beads: Float64Array, centre: tuple[int, int], least: float = 0.1) -> Points:
    """Return the blobs of a bead image (height, width) on the field's grid as points: centroid and light.

    Those whose peak is ``least`` of the brightest or more.
    """
    from scipy import ndimage

    peaks = (beads == ndimage.maximum_filter(beads, 2 * BLOB_PX + 1)) & (beads > least * beads.max())
    peaks[:BLOB_PX] = peaks[-BLOB_PX:] = False
    peaks[:, :BLOB_PX] = peaks[:, -BLOB_PX:] = False
    offsets = np.arange(-BLOB_PX, BLOB_PX + 1)
    places, light = [], []
    for row, column in np.argwhere(peaks):
        blob = beads[row - BLOB_PX : row + BLOB_PX + 1, column - BLOB_PX : column + BLOB_PX + 1]
        total = float(blob.sum(dtype=np.float64))
        middle = [float(blob.sum(axis=1 - axis) @ offsets) / total for axis in (0, 1)]
        places.append((row - centre[0] + middle[0], column - centre[1] + middle[1]))
        light.append(total)
    brightest = np.argsort(light)[::-1][:MOST]
    return Points(
        np.array(places, np.float64).reshape(-1, 2)[brightest], np.array(light, np.float64)[brightest]
    )
