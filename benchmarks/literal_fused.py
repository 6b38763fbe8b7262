"""The dissertation's ADMM for volumes (Kuo 2020, Eq. 4.5, A.3), written as well as its splitting allows.

The same updates as ``tests/recon/solvers/literal_volume.py``, in four three-dimensional FFTs into
preallocated arrays and two compiled sweeps, with split variable and multiplier kept as one state: what a
fair comparison has to beat. l1 takes the identity for Psi (one split less).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from rocket_fft import c2c, c2r, r2c

from recon.base import fft
from recon.base.threads import get_threads, in_blocks
from recon.camera._kernels import FAST

AXES = np.array([0, 1, 2])


@njit(nogil=True, cache=True)
def _forward(x, X, threads):
    r2c(x, X, AXES, True, 1.0, threads)


@njit(nogil=True, cache=True)
def _inverse(X, x, threads):
    c2c(X, X, AXES[:2], False, 1.0, threads)
    c2r(X, x, AXES[2:], False, 1.0 / x.size, threads)


@njit(nogil=True, cache=True, fastmath=FAST)
def _shrink_row(s, d, v, t, mu):
    """``s <- s + d - shrink(s)``; ``v = mu (2 shrink(s) - s)``."""
    for i in range(s.shape[0]):
        a = d[i] + max(min(s[i], t), -t)
        s[i] = a
        c = max(min(a, t), -t)
        v[i] = mu * (a - c - c)


@njit(nogil=True, cache=True, fastmath=FAST)
def _positive_row(s, x, r, mu):
    for i in range(s.shape[0]):
        a = x[i] + min(s[i], 0)
        s[i] = a
        r[i] += mu * abs(a)


@njit(nogil=True, cache=True, fastmath=FAST)
def _difference_row(a, b, out):
    for i in range(out.shape[0]):
        out[i] = a[i] - b[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _tv_states(x, S, t, mu2, z0, z1):
    """Advance the difference states of planes ``z0 <= z < z1``."""
    nz, ny, nx = x.shape
    d = np.empty(nx, x.dtype)
    v = np.empty(nx, x.dtype)
    for z in range(z0, z1):
        for y in range(ny):
            _difference_row(x[(z + 1) % nz, y], x[z, y], d)
            _shrink_row(S[0, z, y], d, v, t, mu2)
            _difference_row(x[z, (y + 1) % ny], x[z, y], d)
            _shrink_row(S[1, z, y], d, v, t, mu2)
            d[:-1] = x[z, y, 1:] - x[z, y, :-1]
            d[-1] = x[z, y, 0] - x[z, y, -1]
            _shrink_row(S[2, z, y], d, v, t, mu2)


@njit(nogil=True, cache=True, fastmath=FAST)
def _reflect(s, t, mu, out):
    for i in range(s.shape[0]):
        c = max(min(s[i], t), -t)
        out[i] = mu * (s[i] - c - c)


@njit(nogil=True, cache=True, fastmath=FAST)
def _tv_right_side(x, S, t, mu2, mu3, z0, z1):
    """``x`` becomes ``mu3 (2 w - s) + Psi^T mu2 (2 u - s)`` on planes ``z0 <= z < z1``."""
    nx = x.shape[2]
    here = np.empty(nx, x.dtype)
    before = np.empty(nx, x.dtype)
    for z in range(z0, z1):
        for y in range(x.shape[1]):
            r = np.zeros(nx, x.dtype)
            _positive_row(S[3, z, y], x[z, y], r, mu3)
            _reflect(S[0, z, y], t, mu2, here)
            _reflect(S[0, z - 1, y], t, mu2, before)
            _add_difference(r, before, here)
            _reflect(S[1, z, y], t, mu2, here)
            _reflect(S[1, z, y - 1], t, mu2, before)
            _add_difference(r, before, here)
            _reflect(S[2, z, y], t, mu2, here)
            before[1:] = here[:-1]
            before[0] = here[-1]
            _add_difference(r, before, here)
            x[z, y] = r


@njit(nogil=True, cache=True, fastmath=FAST)
def _add_difference(r, a, b):
    for i in range(r.shape[0]):
        r[i] += a[i] - b[i]


@njit(nogil=True, cache=True, fastmath=FAST)
def _l1_right_side(x, S, t, mu2, mu3, z0, z1):
    nx = x.shape[2]
    v = np.empty(nx, x.dtype)
    for z in range(z0, z1):
        for y in range(x.shape[1]):
            _shrink_row(S[0, z, y], x[z, y], v, t, mu2)
            _positive_row(S[1, z, y], x[z, y], v, mu3)
            x[z, y] = v


@njit(nogil=True, cache=True, fastmath=FAST)
def _solve(X, V, M, dz2, dy2, dx2, mu1, mu2, mu3, z0, z1):  # noqa: PLR0913 - compiled
    """``X <- (X + conj(M) V) / (mu1 |M|^2 + mu2 |Psi|^2 + mu3)``; ``V <- M X``."""
    for z in range(z0, z1):
        for y in range(X.shape[1]):
            for i in range(X.shape[2]):
                m = M[z, y, i]
                power = m.real * m.real + m.imag * m.imag
                scale = 1 / (mu1 * power + mu2 * (dz2[z] + dy2[y] + dx2[i]) + mu3)
                value = (X[z, y, i] + np.conj(m) * V[z, y, i]) * scale
                X[z, y, i] = value
                V[z, y, i] = m * value


class FusedLiteralAdmm:
    """One channel, TV (circular, unit weights) or l1, with non-negativity; constant penalties."""

    def __init__(self, operator, data, weight, *, tv=True, penalties):
        self.operator, self.weight, self.tv = operator, weight, tv
        self.mu = [np.float32(m) for m in penalties]
        shape = operator.domain_shape[1:]
        nz, ny, nx = shape
        self.window = operator.sensor_window
        self.data = np.asarray(data, np.float32)[0]
        self.x = np.zeros(shape, np.float32)
        for z in range(nz):
            fft.irfft(operator.transfer_plane(z), nx, out=self.x[-z % nz])
        self.M = np.empty(fft.spectrum_shape(shape), np.complex64)
        _forward(self.x, self.M, get_threads())
        self.x[...] = 0
        self.mx = np.zeros(shape, np.float32)
        self.t_v = np.zeros(ny * nx, np.float32).reshape(ny, nx)
        self.S = np.zeros((4 if tv else 2, *shape), np.float32)
        self.X, self.V = np.empty_like(self.M), np.empty_like(self.M)
        if tv:
            self.d2 = [
                (4 * np.sin(np.pi * np.arange(m) / n) ** 2).astype(np.float32)
                for m, n in ((nz, nz), (ny, ny), (nx // 2 + 1, nx))
            ]
        else:
            self.d2 = [np.ones(nz, np.float32), np.zeros(ny, np.float32), np.zeros(nx // 2 + 1, np.float32)]

    def step(self):
        """Do one iteration."""
        mu1, mu2, mu3 = self.mu
        t = np.float32(self.weight) / mu2
        nz = len(self.x)
        if self.tv:
            in_blocks(lambda a, b: _tv_states(self.x, self.S, t, mu2, a, b), nz)
            in_blocks(lambda a, b: _tv_right_side(self.x, self.S, t, mu2, mu3, a, b), nz)
        else:
            in_blocks(lambda a, b: _l1_right_side(self.x, self.S, t, mu2, mu3, a, b), nz)
        # v: identity but on the sensor. There s = M x + xi / mu1, v = (b + mu1 s) / (1 + mu1).
        s = self.mx[0] + self.t_v
        v = s.copy()
        v[self.window] = (self.data + mu1 * s[self.window]) / (1 + mu1)
        self.t_v = s - v
        self.mx[0] = 2 * v - s
        self.mx *= mu1
        threads = get_threads()
        _forward(self.x, self.X, threads)
        _forward(self.mx, self.V, threads)
        in_blocks(lambda a, b: _solve(self.X, self.V, self.M, *self.d2, mu1, mu2, mu3, a, b), nz)
        _inverse(self.X, self.x, threads)
        _inverse(self.V, self.mx, threads)

    @property
    def solution(self):
        """The non-negative iterate."""
        return np.maximum(self.S[-1], 0)[None]
