"""What photographs taught of one display: how its SLM, light, lens and mask differ from the plain.

In the symbols of :mod:`recon.holography.model`, with ``phi`` the phase that a pixel is asked for::

    phi' = K phi                        cross-talk: smoothed across pixel borders
    s    = A (r(phi') exp(j phi') + d)  response, light not modulated, illumination and wavefront
    e    = sinc^2 exp(v_y + v_x)        mask pixels' envelope and vignetting

``r`` is linear between levels, ``log A``, ``v`` are Legendre polynomials.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import ceil, pi
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import legvander

from recon.errors import InputError

if TYPE_CHECKING:
    from recon.holography.display import Display

Array = npt.NDArray[Any]

LEAST_CROSSTALK = 0.03
"""SLM pixels: less moves no light that a hologram feels, and would be computed for every mask pixel."""
_FINE = 4
"""Phases in an SLM pixel, along each axis, where they change within it; at least."""
_LAST = 2 * pi * 255 / 256
"""The phase of an SLM's last level."""
_SHADE_ORDERS = (1, 2, 3, 4)


@dataclass(frozen=True, slots=True)
class Learned:
    """How a display differs from a plain one.

    Attributes
    ----------
    response : ndarray, float64, (n_levels + 1, 2)
        Real and imaginary part of ``r``, from phase 0 to a whole turn; 1 where the SLM does as it is told.
    dc : ndarray, float64, (2,)
        Light that is not modulated, in the same unit.
    crosstalk_px : ndarray, float64, (2,)
        Width of what smooths the phase, down and across, standard deviation in SLM pixels.
    amplitude, phase : ndarray, float64, (n,)
        Of ``log A``, coefficients of :func:`terms`: the illumination, and the SLM's flatness error together
        with the lens' wavefront.
    shade : ndarray, float64, (2, 4)
        Of the logarithm of the light that reaches the camera from a place in the field, over y and over x.
    mask_depth : float
        Phase of the mask's steps over what they should be.
    """

    response: npt.NDArray[np.float64]
    dc: npt.NDArray[np.float64]
    crosstalk_px: npt.NDArray[np.float64]
    amplitude: npt.NDArray[np.float64]
    phase: npt.NDArray[np.float64]
    shade: npt.NDArray[np.float64]
    mask_depth: float

    def __post_init__(self) -> None:
        arrays = (self.response, self.dc, self.crosstalk_px, self.amplitude, self.phase, self.shade)
        if not all(np.isfinite(array).all() for array in arrays) or not np.isfinite(self.mask_depth):
            raise InputError("What was learned of a display has values that are not finite.")
        if self.response.ndim != 2 or self.response.shape[1:] != (2,) or len(self.response) < 2:
            raise InputError(f"A learned response is (levels, 2), not {self.response.shape}.")
        if self.dc.shape != (2,) or self.crosstalk_px.shape != (2,) or self.shade.shape != (2, 4):
            raise InputError("Of a learned display dc and crosstalk_px are 2 numbers, shade is 2 x 4.")
        order_of(len(self.amplitude))
        order_of(len(self.phase))

    @classmethod
    def nothing(cls, display: Display, *, levels: int = 5, orders: tuple[int, int] = (4, 6)) -> Learned:
        """Return what is to be learned of a display before anything is: the display as it is described."""
        amplitude, phase = (np.zeros(len(terms(order))) for order in orders)
        light = display.dc.amplitude
        response = np.zeros((levels + 1, 2))
        response[:, 0] = display.dc.modulated
        dc = np.array([light.real, light.imag])
        return cls(response, dc, np.zeros(2), amplitude, phase, np.zeros((2, 4)), 1.0)

    def at(self, turns: float) -> Learned:
        """Return what this says of the display in light in which phases are ``turns`` times as large.

        Errors are optical paths and amplitudes: those of a pixel belong to its height, those of the light
        that reaches the camera to its angle. Light that is not modulated keeps its phase; glass and liquid
        crystal have no dispersion.
        """
        if turns == 1:
            return self
        count = len(self.response)
        known = self.response[:, 0] + 1j * self.response[:, 1]
        turn = np.arange(count) / (count - 1)
        # What a phase needs of the pixel: less than a turn of before at a shorter wavelength.
        at = np.mod(turn / turns, 1)
        error = np.interp(at, turn, np.unwrap(np.angle(known))) * turns
        response = np.interp(at, turn, np.abs(known)) * np.exp(1j * error)
        places = np.linspace(-1, 1, 1 + max(_SHADE_ORDERS))
        here, there = (legvander(x, max(_SHADE_ORDERS))[:, 1:] for x in (places, places / turns))
        whole = np.column_stack([np.ones_like(places), here])  # what is constant over the field is left out
        shade = [np.linalg.solve(whole, there @ row)[1:] for row in self.shade]
        return replace(
            self,
            response=np.stack([response.real, response.imag], axis=-1),
            phase=self.phase * turns,
            shade=np.array(shade),
        )

    def illumination(self, shape: tuple[int, int]) -> npt.NDArray[np.complex64]:
        """Return ``A`` over the SLM on a grid of any size, mean power 1."""
        log: Array = np.zeros(shape, complex)
        for coefficients, unit in ((self.amplitude, 1), (self.phase, 1j)):
            for value, (i, j) in zip(coefficients, terms(order_of(len(coefficients))), strict=True):
                if value:
                    log += unit * value * np.multiply.outer(legendre(i, shape[0]), legendre(j, shape[1]))
        field = np.exp(log)
        return np.asarray(field / np.sqrt(np.mean(np.abs(field) ** 2)), np.complex64)

    def shading(self, shape: tuple[int, int]) -> tuple[Array, Array]:
        """Return what reaches the camera over the field, in FFT order, as a column and a row."""
        return self.shading_at(*(np.fft.fftfreq(n) for n in shape))

    def shading_at(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Return what reaches the camera from places in fractions of the field, 0 its middle: by y, by x."""
        from scipy.special import eval_legendre

        down, across = (
            np.exp(sum(c * eval_legendre(n, 2 * at) for n, c in zip(_SHADE_ORDERS, row, strict=True)))
            for row, at in zip(self.shade, (y, x), strict=True)
        )
        return down, across


def terms(order: int) -> list[tuple[int, int]]:
    """Return powers ``(y, x)`` of the polynomials up to an order, without the constant."""
    return [(n - j, j) for n in range(1, order + 1) for j in range(n + 1)]


def order_of(count: int) -> int:
    """Return the order whose :func:`terms` are so many; InputError where there is none."""
    for order in range(41):
        if len(terms(order)) == count:
            return order
    raise InputError(f"{count} coefficients are those of no order of polynomials.")


def legendre(order: int, n: int) -> npt.NDArray[np.float64]:
    """Return a Legendre polynomial over ``n`` pixels, rms about 1."""
    from scipy.special import eval_legendre

    places = (np.arange(n) + 0.5) / n * 2 - 1
    return np.asarray(np.sqrt(2 * order + 1) * eval_legendre(order, places), np.float64)


class Panel:
    """Takes the phases asked for to the field that leaves the SLM, and a gradient back.

    Parameters
    ----------
    display : Display
        With ``learned``.
    dtype : complex dtype
    """

    def __init__(self, display: Display, dtype: npt.DTypeLike) -> None:
        from recon.holography import _kernels  # late: numba takes half a second to import

        assert display.learned is not None
        self._kernels = _kernels
        learned = self.learned = display.learned
        self._dtype = np.dtype(dtype)
        real = np.empty(0, self._dtype).real.dtype
        mixes = float(np.abs(learned.crosstalk_px).max()) >= LEAST_CROSSTALK
        self.parts = display.factor if mixes else 1
        """Samples of the field in an SLM pixel, along each axis."""
        self.factor = display.factor // self.parts
        """Mask pixels a sample, along each axis."""
        self._fine = -(-_FINE // self.parts) if mixes else 1
        """Phases that a sample is the mean of, along each axis."""
        height, width = display.slm_shape
        self.shape = (height * self.parts, width * self.parts)
        self._mix = (
            [_shares(abs(s), self.parts * self._fine).astype(real) for s in learned.crosstalk_px]
            if mixes
            else []
        )
        self._response = (learned.response[:, 0] + 1j * learned.response[:, 1]).astype(self._dtype)
        self._anchors: Array | None = None
        self._within = False
        self._dc = complex(*learned.dc)
        self.light: Array = learned.illumination(self.shape).astype(self._dtype)
        """``A``, complex, of :attr:`shape`."""

    def hold(self, slm: Array | None, *, within: bool = False) -> None:
        """Let phases run on beyond a turn from those of these patterns; None: they wrap again.

        Where a phase wraps, all around it changes at once: no search goes well across that. ``within``: they
        stop at the ends of the turn instead.
        """
        self._anchors = None if slm is None else np.mod(np.angle(slm), 2 * pi)
        self._within = within

    def stopped(self, slm: Array) -> Array:
        """Return the patterns that are shown of these where phases stop at the ends of a turn."""
        if self._anchors is None or not self._within:
            return slm
        phases = np.clip(_near(slm, self._anchors), 0, _LAST)
        return np.asarray(np.exp(1j * phases), slm.dtype)

    def bare(self, pattern: Array, anchor: Array | None = None) -> Array:
        """Return the field of one pattern, complex, of :attr:`shape`, in even light without aberrations."""
        out = np.empty(self.shape, self._dtype)
        self._kernels.respond(self._phases(pattern, anchor), self._response, self._dc, out)
        return out

    def field(self, slm: Array) -> Array:
        """Return the field of SLM patterns, (n_frames, height, width), by their phases alone."""
        anchors = [None] * len(slm) if self._anchors is None else self._anchors
        return np.stack([self.light * self.bare(s, anchor) for s, anchor in zip(slm, anchors, strict=True)])

    def back(self, slm: Array, gradient: Array) -> Array:
        """Return the gradient by the SLM patterns, of the one by their :meth:`field`."""
        out = np.empty(slm.shape, self._dtype)
        fine = self._fine
        slope = np.empty((self.shape[0] * fine, self.shape[1] * fine), out.real.dtype)
        anchors = [None] * len(slm) if self._anchors is None else self._anchors
        for frame, pattern, anchor, by_field in zip(out, slm, anchors, gradient, strict=True):
            self._kernels.respond_back(
                self._phases(pattern, anchor), self._response, self.light, by_field, slope
            )
            by_phase = slope
            for axis, shares in enumerate(self._mix):
                by_phase = _gathered(by_phase, shares, axis)
            # A gradient g means a change of 2 Im(g conj(s)) a radian.
            if anchor is not None and self._within:
                free = _near(pattern, anchor)
                by_phase = by_phase * ((free > 0) & (free < _LAST))
            frame[:] = 0.5j * pattern * by_phase
        return out

    def mean_power(self) -> float:
        """Return the mean light of random phases, in units of an amplitude of 1."""
        rows, columns = (n // self.parts for n in self.shape)
        phases = np.random.default_rng(0).uniform(0, 2 * pi, (rows, columns))
        return float(np.mean(np.abs(self.light * self.bare(np.exp(1j * phases))) ** 2))

    def collected(self, field: Array) -> Array:
        """Return what the illumination's conjugate leaves of a field, summed over each SLM pixel."""
        n = self.parts
        field = field * np.conj(self.light)
        return np.asarray(field.reshape(field.shape[0] // n, n, -1, n).sum(axis=(1, 3)), self._dtype)

    def _phases(self, pattern: Array, anchor: Array | None = None) -> Array:
        phases = np.mod(np.angle(pattern), 2 * pi) if anchor is None else _near(pattern, anchor)
        if anchor is not None and self._within:
            phases = np.clip(phases, 0, _LAST)
        phases = phases.astype(self.light.real.dtype)
        for axis, shares in enumerate(self._mix):
            phases = _spread(phases, shares, axis)
        return np.ascontiguousarray(phases)


def _near(pattern: Array, anchor: Array) -> Array:
    """Return the phases of a pattern within half a turn of others."""
    return np.asarray(anchor + np.angle(pattern * np.exp(-1j * anchor)))


def _shares(sigma: float, parts: int) -> npt.NDArray[np.float64]:
    """Return what samples of a pixel have of its neighbours and, in the middle, of itself, (2 n + 1, parts).

    A phase that is constant over pixels, smoothed by a Gaussian of ``sigma`` pixels; of each sample the sum
    is 1, what lies beyond the last neighbour is given to it.
    """
    from scipy.special import ndtr

    reach = max(1, ceil(3 * sigma - 0.5))
    borders = np.arange(-reach + 1, reach + 1)[:, None] - (np.arange(parts) + 0.5) / parts
    below = ndtr(borders / max(sigma, 1e-6))
    return np.diff(below, axis=0, prepend=0, append=1)


def _spread(values: Array, shares: Array, axis: int) -> Array:
    """Sample pixels' values finer along an axis, each sample a mean of its pixel and those beside it."""
    values = np.moveaxis(values, axis, 0)
    reach, n = len(shares) // 2, len(values)
    padded = np.concatenate([values[:1]] * reach + [values] + [values[-1:]] * reach)
    mixed = sum(share[None, :, None] * padded[k : k + n, None] for k, share in enumerate(shares))
    return np.asarray(np.moveaxis(np.asarray(mixed).reshape(n * shares.shape[1], -1), 0, axis))


def _gathered(values: Array, shares: Array, axis: int) -> Array:
    """Apply the adjoint of :func:`_spread`."""
    values = np.moveaxis(values, axis, 0)
    reach, n = len(shares) // 2, len(values) // shares.shape[1]
    blocks = values.reshape(n, shares.shape[1], -1)
    padded = np.zeros((n + 2 * reach, blocks.shape[2]), values.dtype)
    for k, share in enumerate(shares):
        padded[k : k + n] += np.tensordot(share, blocks, (0, 1))
    padded[reach] += padded[:reach].sum(axis=0)
    padded[-reach - 1] += padded[-reach:].sum(axis=0)
    return np.asarray(np.moveaxis(padded[reach:-reach], 0, axis))
