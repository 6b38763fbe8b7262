"""Where the mask is, from all of the light of photographs of known patterns.

Spots tell a section's shift to a quarter of an SLM pixel at best: around each lies the speckle of all others,
however little noise the camera has. But patterns are known, so that speckle is no noise: it is as sensitive
to the mask's place as the spots are, and there is far more of it. What spots found is the start; from there
displacement, depth, tilts and the light that the SLM does not modulate are fitted to what an eye resolves of
the photographs, by Gauss-Newton. Each photograph's brightness, and its place on the camera, are free.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Array, Float64Array
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.learn import Look
from recon.holography.learned import legendre, terms
from recon.holography.pose import Pose, nodes_of, on_mask, propagated
from recon.holography.sections import ORDER, POWERS, SmoothField, likelihood, split_field
from recon.holography.target import ORDER as STEEPNESS
from recon.holography.target import band_of

NEAR_STEPS, MOST_STEPS = 5, 8
AT_FIRST = 2
"""Photographs of the steps that bring it near, ``NEAR_STEPS`` at most."""
SETTLED = 0.5
"""Steps end when none moves a parameter by more than this share of its uncertainty. Three steps, whatever
they moved, left depth and tilt of one start in fifty 6 and 9 uncertainties off."""
_BENDS = 2 * len(POWERS)  # unknowns: displacement, then depth and two tilts, then these
_DEEP = 3
_DC = 2
_PHASES = [term for term in terms(4) if sum(term) > 1]  # a linear one is the picture's place on the camera
_SHADES = terms(2)
Shapes = Sequence[tuple[int, int]]
_ORDERS = 5
"""Of the polynomials of both, along each axis."""
_LIGHT = (1.0, 0.3)  # of the phase (rad) and of the logarithm of the amplitude of a term: taken for likely
_HALVES = 2  # parts of a mask pixel, along each axis, of what is shown; slopes do without
_NUDGE = 0.25  # mask pixels, of the differences that slopes are made of


@dataclass(frozen=True, slots=True)
class FittedPlace:
    """Where the mask is.

    Attributes
    ----------
    pose : Pose
        The one that was started from, with depth and tilts as fitted; its displacement is as it was.
    field : SmoothField
        Displacement beyond the pose's and beyond the rest that was started from. Its ``misfit`` is by how
        much photographs contradict each other, in uncertainties that all of their light alone would leave.
    deep_error : ndarray, float64, (3,)
        Standard uncertainty of depth (um) and tilts (mrad).
    dc : complex
        Light that is not modulated, over the amplitude of what is.
    before, after : float
        Part of the photographs' contrast that is not explained, rms.
    """

    pose: Pose
    field: SmoothField
    deep_error: Float64Array
    dc: complex
    before: float
    after: float


def fit_place(
    display: Display,
    looks: Sequence[Look],
    pose: Pose,
    rest: Float64Array,
    *,
    tilt_mrad: float = 5.0,
) -> FittedPlace:
    """Fit the mask's place to photographs of known patterns.

    Parameters
    ----------
    display : Display
        Its displacement and DC term are not used.
    looks : sequence of Look
        At least two.
    pose : Pose
    rest : ndarray, (rows, columns, 2)
        Displacement beyond the pose's. Together they are right within a quarter of an SLM pixel or so.
    tilt_mrad : float
        Of a mask put in by hand: taken for likely.

    Raises InputError for a single photograph.
    """
    if len(looks) < 2:
        raise InputError(f"The mask's place is told by at least 2 photographs, not {len(looks)}.")
    fit = _Fit(display, pose, rest)
    curvature = np.diag(likelihood())
    deep = [0.0, tilt_mrad**-2, tilt_mrad**-2]
    light = np.repeat(np.power(_LIGHT, -2.0), [len(_PHASES), len(_SHADES)])
    tight = np.concatenate([curvature, curvature, deep, np.zeros(_DC), light])
    vector = np.zeros(len(tight))
    about = vector.copy()
    about[_BENDS + 1 : _BENDS + _DEEP] = -pose.pitch_mrad, -pose.yaw_mrad
    first = 1.0
    near = False
    for step in range(MOST_STEPS):
        some = looks if near else looks[-AT_FIRST:]
        systems = [fit.system(vector, look) for look in some]
        unexplained = float(np.sqrt(np.mean([s.unexplained for s in systems])))
        first = unexplained if step == 0 else first
        # All light of a photograph counts as independent; how photographs differ tells what that is worth.
        noise = float(np.mean([s.unexplained for s in systems])) / fit.count
        matrix = np.sum([s.matrix for s in systems], axis=0) / noise + np.diag(tight)
        right = np.sum([s.right for s in systems], axis=0) / noise - tight * (vector - about)
        covariance = np.linalg.inv(matrix)
        moved = covariance @ right
        vector = vector + moved
        settled = bool(np.all(np.abs(moved) <= SETTLED * np.sqrt(np.diag(covariance))))
        if near and settled:
            break
        near = near or settled or step == NEAR_STEPS - 1
    misfit = _misfit(systems, covariance, noise)
    covariance *= max(misfit, 1.0) ** 2
    there = fit.place(vector)
    modes = [fit.bent(v) for v in _deviations(covariance[:_BENDS, :_BENDS])]
    change, left = split_field(fit.bent(vector), display.mask.shape)
    error = np.sqrt(np.sum([split_field(mode, display.mask.shape)[0] ** 2 for mode in modes], axis=0))
    return FittedPlace(
        there,
        SmoothField(change, left, np.array(modes), error, misfit),
        np.sqrt(np.diag(covariance)[_BENDS : _BENDS + _DEEP]),
        complex(*vector[_BENDS + _DEEP :][:_DC]),
        first,
        unexplained,
    )


def _deviations(covariance: Array) -> Iterator[Array]:
    """Return one standard deviation of each independent error."""
    values, vectors = np.linalg.eigh(covariance)
    for value, vector in zip(values, vectors.T, strict=True):
        yield np.sqrt(max(value, 0.0)) * vector


@dataclass(frozen=True, slots=True)
class _System:
    """Normal equations of a photograph, and the part of its contrast that is not explained, squared."""

    matrix: Array
    right: Array
    unexplained: float


def _misfit(systems: Sequence[_System], covariance: Array, noise: float) -> float:
    """Return how far single photographs pull from the common place, in uncertainties of their own."""
    n = len(systems)
    mean = np.mean([s.right for s in systems], axis=0)
    pulls = [(s.right - mean) / noise for s in systems]
    scatter = sum(float(p @ covariance @ p) for p in pulls) * n / (n - 1) / len(mean)
    return float(np.sqrt(scatter))


class _Fit:
    """What photographs show of a mask's place, and how that changes with it."""

    def __init__(self, display: Display, pose: Pose, rest: Float64Array) -> None:
        self.display, self.pose = display, pose
        self.displacement = pose.displacement(display.mask.shape) + rest
        self.band = band_of(display, "alias-free")
        self.mask = display.mask.field(display.wavelength_nm).astype(np.complex64)
        height, width = self.mask.shape
        at_node = [a / (width / 2) for a in nodes_of(display.mask.shape)]
        self.bends = np.array([at_node[0] ** i * at_node[1] ** j for i, j in POWERS])
        self.y, self.x = (
            (2 * (np.arange(n) + 0.5) / width - n / width).astype(np.float32) for n in (height, width)
        )
        self.down, self.across = (
            np.array([legendre(order, n) for order in range(_ORDERS)], np.float32) for n in (height, width)
        )
        ey, ex = (e.astype(np.float32) for e in display.envelope(self.band.shape))
        self.envelope = ey[:, None], ex
        # A displaced mask's pixels see borders of SLM pixels: their halves differ, which passes for depth.
        levels = np.repeat(np.repeat(display.mask.levels, _HALVES, axis=0), _HALVES, axis=1)
        self.fine = replace(display, mask=replace(display.mask, levels=levels), displacement=None)
        halves = [
            (np.sinc(f / _HALVES) / np.sinc(f)).astype(np.float32) ** 2
            for f in (np.fft.fftfreq(n) for n in self.band.shape)
        ]
        self.fine_envelope = (ey * halves[0])[:, None], ex * halves[1]
        self.lags = self.band.lags()
        y, x = self.lags
        radius = np.hypot(y[:, None], x) / self.band.cutoff
        weights = np.where(x == 0, 1.0, np.sqrt(2.0)) / (1 + radius ** (2 * STEEPNESS))
        weights[0, 0] = 0  # the mean is brightness
        self.used = weights > 1e-3
        self.weights = weights[self.used].astype(np.float32)
        self.count = float((weights**2).sum())

    def bent(self, coefficients: Array) -> Float64Array:
        """Return the displacement of coefficients along rows, then columns, on the nodes."""
        rows = coefficients[:_BENDS].reshape(2, -1)
        return np.stack([np.tensordot(row, self.bends, 1) for row in rows], axis=-1)

    def place(self, vector: Array) -> Pose:
        """Return the pose with depth and tilts of a vector of unknowns."""
        z_um, pitch_mrad, yaw_mrad = vector[_BENDS : _BENDS + _DEEP]
        old = self.pose
        return old.with_(
            z_um=old.z_um + z_um,
            pitch_mrad=old.pitch_mrad + pitch_mrad,
            yaw_mrad=old.yaw_mrad + yaw_mrad,
        )

    def system(self, vector: Array, look: Look) -> _System:
        """Form a photograph's normal equations about a vector of unknowns."""
        parts = self._parts(vector, look.slm)
        shown = self._shown(vector, *parts)
        far, slopes = self._slopes(vector, *parts)
        wanted = look.lags[self.used] * self.weights
        wanted = wanted / np.sqrt(_power(wanted))
        scale = 1 / np.sqrt(_power(shown))
        rows = [
            self._lags_of(2 * (far.real * f.real + far.imag * f.imag), self.envelope) * scale for f in slopes
        ]
        shown = shown * scale
        # Free: its brightness, and where it is on the camera.
        y, x = (np.broadcast_to(a, self.used.shape)[self.used] for a in (self.lags[0][:, None], self.lags[1]))
        free = np.linalg.qr(
            np.stack([_flat(shown), *(_flat(np.complex64(1j) * a * shown) for a in (y, x))], axis=1)
        )[0]
        jacobian = np.stack([_flat(row) for row in rows])
        left = _flat(wanted)
        gain = float(left @ _flat(shown))
        jacobian = gain * (jacobian - (jacobian @ free) @ free.T)
        left = left - free @ (free.T @ left)
        return _System(jacobian @ jacobian.T, jacobian @ left, float(left @ left))

    def _parts(self, vector: Array, slm: Array) -> tuple[Array, Float64Array, Array]:
        """Return the light at the SLM, the displacement, and what is uneven in light and wavefront."""
        pattern = (slm + complex(*vector[_BENDS + _DEEP :][:_DC])).astype(np.complex64)
        light = vector[_BENDS + _DEEP + _DC :]
        uneven = np.zeros((_ORDERS, _ORDERS), complex)
        for n, (i, j) in enumerate((*_PHASES, *_SHADES)):
            uneven[i, j] += light[n] * (1j if n < len(_PHASES) else 1)
        whole = np.exp(self.down.T @ uneven.astype(np.complex64) @ self.across)
        return pattern, self.displacement + self.bent(vector), np.asarray(whole, np.complex64)

    def _shown(self, vector: Array, pattern: Array, nodes: Float64Array, uneven: Array) -> Array:
        """Return the lags of what a pattern shows, from halves of the mask's pixels."""
        import scipy.fft

        field = propagated(on_mask(pattern, self.fine, _HALVES * nodes), self.fine, self.place(vector))
        field = field * np.repeat(np.repeat(self.mask * uneven, _HALVES, axis=0), _HALVES, axis=1)
        for axis, n in enumerate(self.band.shape):
            whole = scipy.fft.fft(field, _HALVES * n, axis=axis)
            at = np.rint(np.fft.fftfreq(n, 1 / n)).astype(int)
            field = whole.take(at % (_HALVES * n), axis=axis) / np.float32(_HALVES)
        return self._lags_of(field.real**2 + field.imag**2, self.fine_envelope)

    def _slopes(
        self, vector: Array, pattern: Array, nodes: Float64Array, uneven: Array
    ) -> tuple[Array, Iterator[Array]]:
        """Return the far field of a pattern, and how it changes with each unknown."""
        import scipy.fft

        place = self.place(vector)
        mask = self.mask * uneven

        def there(field: Array, place: Pose = place) -> Array:
            return propagated(field, self.display, place)

        even = there(on_mask(np.ones_like(pattern), self.display, nodes))
        moved = [
            there(on_mask(pattern, self.display, nodes + e) - on_mask(pattern, self.display, nodes - e))
            / np.float32(2 * _NUDGE)
            for e in _NUDGE * np.eye(2)
        ]
        at_slm = on_mask(pattern, self.display, nodes)
        at_mask = there(at_slm)
        nearer = there(at_slm, place.with_(z_um=place.z_um + 1)) - at_mask
        half_um = 0.5 * self.mask.shape[1] * self.display.mask_pitch_um

        def fars(field: Array, shapes: Shapes, down: Array, across: Array) -> Iterator[Array]:
            """Of the field times ``down[i] across[j]``: a transform of the rows serves all of one ``j``."""
            rows: dict[int, Array] = {}
            lit = field * mask
            for i, j in shapes:
                if j not in rows:
                    rows[j] = scipy.fft.fft(lit * across[j], self.band.shape[1], axis=1)
                yield np.asarray(scipy.fft.fft(rows[j] * down[i][:, None], self.band.shape[0], axis=0))

        def slopes() -> Iterator[Array]:
            powers = [np.array([at**n for n in range(ORDER + 1)]) for at in (self.y, self.x)]
            for field in moved:
                yield from fars(field, POWERS, *powers)
            tilts = [p[:2] * np.array([[1], [1e-3 * half_um]], np.float32) for p in powers]
            yield from fars(nearer, ((0, 0), (1, 0), (0, 1)), *tilts)
            (one,) = fars(even, ((0, 0),), *powers)
            yield one
            yield np.complex64(1j) * one
            bent = fars(at_mask, (*_PHASES, *_SHADES), self.down, self.across)
            for n, field in enumerate(bent):
                yield np.complex64(1j) * field if n < len(_PHASES) else field

        (far,) = fars(at_mask, ((0, 0),), self.down, self.across)
        return far, slopes()

    def _lags_of(self, light: Array, envelope: tuple[Array, Array]) -> Array:
        """Return weighted lags of an intensity in FFT order."""
        import scipy.fft

        light *= envelope[0]
        light *= envelope[1]
        rows, columns = self.band.kept
        top = self.band.top
        spectrum = scipy.fft.fft(scipy.fft.rfft(light, axis=1)[:, :columns], axis=0)
        kept = np.concatenate([spectrum[:top], spectrum[len(spectrum) - rows + top :]])
        return np.asarray(kept[self.used] * self.weights)


def _flat(values: Array) -> Array:
    return np.ascontiguousarray(values, np.complex64).view(np.float32).astype(np.float64)


def _power(values: Array) -> float:
    return float(np.vdot(values, values).real)
