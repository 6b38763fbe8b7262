"""A phase SLM as photographs taught of it: from the phases asked for to the field, and a gradient back.

Symbols as in :mod:`recon.holography.learned`.
"""

from __future__ import annotations

from math import ceil, pi

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float64Array
from recon.holography.display import Display

LEAST_CROSSTALK = 0.03
"""SLM pixels: less moves no light that a hologram feels, and would be computed for every mask pixel."""
_FINE = 4
"""Phases in an SLM pixel, along each axis, where they change within it; at least."""
_LAST = 2 * pi * 255 / 256
"""The phase of an SLM's last level."""


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


def _shares(sigma: float, parts: int) -> Float64Array:
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
