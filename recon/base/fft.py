"""The one place for FFTs: real transforms over the last axes into preallocated arrays.

Transforms keep the precision of their input (float32 to complex64, float64 to complex128) and use the number
of threads set in :mod:`recon.base.threads`. Backend: rocket-fft, ducc0's BSD-licensed FFT inside numba, which
unlike ``scipy.fft`` writes into arrays that the caller owns (twice as fast on large arrays, where fresh
memory costs as much as the transform). :func:`rfft` and :func:`irfft` take a GPU's arrays too, and leave
those to their own library.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.namespace import namespace_of
from recon.base.threads import in_blocks, threads_here

RealArray = Array


@cache
def fast_length(length: int, *, real: bool = False) -> int:
    """Return the smallest length of at least ``length`` that transforms fast.

    ``real``: for the last axis of a real transform. It is even then as well, so that the half spectrum has a
    Nyquist element of its own.
    """
    from scipy.fft import next_fast_len

    n = int(next_fast_len(length, real))
    while real and n % 2:
        n = int(next_fast_len(n + 1, real))
    return n


def fast_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the smallest fast shape of at least ``shape`` for a real transform over all its axes."""
    return (*(fast_length(n) for n in shape[:-1]), fast_length(shape[-1], real=True))


def spectrum_shape(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the shape of the half spectrum of a real array of ``shape``."""
    return (*shape[:-1], shape[-1] // 2 + 1)


def complex_dtype(dtype: npt.DTypeLike) -> np.dtype[Any]:
    """Return the complex dtype of the same precision."""
    return np.result_type(dtype, np.complex64)


def rfft(x: RealArray, *, axes: int = 2, out: Array | None = None) -> Array:
    """Forward real transform over the last ``axes`` axes.

    Parameters
    ----------
    x : ndarray, float32 or float64
    axes : int
        Number of trailing axes to transform.
    out : ndarray, optional
        C-contiguous complex array of ``spectrum_shape(x.shape)`` and equal precision to write into.

    Returns
    -------
    ndarray
        Half spectrum, not scaled (as ``scipy.fft.rfftn``).
    """
    if (xp := namespace_of(x)) is not np:
        return _onto(xp.fft.rfftn(x, axes=tuple(range(-axes, 0))), out)
    x = np.ascontiguousarray(x)
    if out is None:
        out = np.empty(spectrum_shape(x.shape), complex_dtype(x.dtype))
    _check(out, spectrum_shape(x.shape), complex_dtype(x.dtype))
    _kernels().forward(_batched(x, axes), _batched(out, axes), _axes(axes), threads_here())
    return out


def irfft(X: Array, last: int, *, axes: int = 2, out: RealArray | None = None) -> RealArray:
    """Inverse of :func:`rfft`, scaled by the reciprocal number of elements.

    Parameters
    ----------
    X : ndarray, complex64 or complex128
        Half spectrum. Its contents are overwritten.
    last : int
        Length of the result's last axis.
    axes : int
        Number of trailing axes to transform.
    out : ndarray, optional
        C-contiguous real array of equal precision to write into.
    """
    if (xp := namespace_of(X)) is not np:
        size = (*X.shape[X.ndim - axes : -1], last)
        return _onto(xp.fft.irfftn(X, s=size, axes=tuple(range(-axes, 0))), out)
    if not X.flags.c_contiguous:
        raise ValueError("The spectrum must be C-contiguous: it is transformed in place.")
    shape = (*X.shape[:-1], last)
    dtype = X.real.dtype
    if out is None:
        out = np.empty(shape, dtype)
    _check(out, shape, dtype)
    scale = 1.0 / float(np.prod(shape[-axes:], dtype=float))
    _kernels().inverse(_batched(X, axes), _batched(out, axes), _axes(axes), scale, threads_here())
    return out


def rfft_strip(x: RealArray, start: int, out: Array) -> Array:
    """Forward transform of images that are zero but for a strip of rows, a quarter cheaper when half are.

    Parameters
    ----------
    x : ndarray, (n, rows, width)
        The rows that are not zero.
    start : int
        Place of the first of them.
    out : ndarray, complex, (n, height, width // 2 + 1)
    """
    if (xp := namespace_of(x)) is not np:
        whole = xp.zeros((len(x), out.shape[1], x.shape[2]), x.dtype)
        whole[:, start : start + x.shape[1]] = x
        return rfft(whole, out=out)
    _kernels().forward_strip(np.ascontiguousarray(x), out, start, threads_here())
    return out


def irfft_strip(X: Array, start: int, out: RealArray) -> RealArray:
    """Rows ``start`` to ``start + rows`` of the inverse transform, into ``out`` (n, rows, width).

    ``X`` (n, height, width // 2 + 1) is overwritten.
    """
    if namespace_of(X) is not np:
        return _onto(irfft(X, out.shape[2])[:, start : start + out.shape[1]], out)
    scale = 1.0 / (float(X.shape[1]) * out.shape[2])
    _kernels().inverse_strip(X, out, start, scale, threads_here())
    return out


def multiply(X: Array, H: Array, *, conjugate: bool = False) -> None:
    """Multiply ``X`` (n, height, width) in place by ``H`` (n or 1, height, width) or its conjugate.

    ``H`` may be real.
    """
    if namespace_of(X) is not np:
        X *= H.conj() if conjugate else H
        return
    kernel = _kernels().multiply
    in_blocks(lambda a, b: kernel(X, H, conjugate, a, b), X.shape[0] * X.shape[1], grain=64)


@cache
def ensure_compiled(dtype: np.dtype[Any]) -> None:
    """Transform a few numbers of a precision in every way, so that no later call waits for the compiler."""
    x = np.ones((1, 2, 2), dtype)
    X = rfft(x)
    multiply(X, X)
    irfft(X, 2)
    irfft_strip(rfft_strip(x, 0, X), 0, x)


def dct(x: RealArray, out: RealArray) -> RealArray:
    """Orthonormal cosine transform (type 2) of an image or volume over all its axes, written into ``out``."""
    return _cosine(x, out, 2)


def idct(X: RealArray, out: RealArray) -> RealArray:
    """Inverse of :func:`dct`."""
    return _cosine(X, out, 3)


def _cosine(x: RealArray, out: RealArray, kind: int) -> RealArray:
    if namespace_of(x) is not np:
        return _onto(_cosine_by_halves(x, inverse=kind == 3), out)
    _check(out, x.shape, x.dtype)
    shape = [n for n in x.shape if n > 1] or [1]  # an axis of one element is copied element by element
    scale = float(np.prod(2.0 * np.array(shape))) ** -0.5
    kernel = _kernels().cosine
    kernel(x.reshape(shape), out.reshape(shape), np.arange(len(shape)), kind, scale, threads_here())
    return out


def _cosine_by_halves(x: RealArray, *, inverse: bool) -> RealArray:
    """Orthonormal cosine transform over all axes by complex ones of the same length (Makhoul 1980)."""
    xp, result = namespace_of(x), x
    for axis, n in enumerate(x.shape):
        if n == 1:
            continue
        at = np.arange(n)
        turn = xp.asarray(np.exp(-0.5j * np.pi * at / n).astype(complex_dtype(x.dtype)))
        scale = xp.asarray(np.sqrt(np.where(at, 2.0, 1.0) / n).astype(x.dtype))
        order = np.concatenate([at[::2], at[1::2][::-1]])
        lines = xp.moveaxis(result, axis, -1)
        if inverse:
            lines = lines / scale
            backward = xp.zeros_like(lines)
            backward[..., 1:] = lines[..., :0:-1]
            mixed = xp.fft.ifft((lines - 1j * backward) / turn)
            result = mixed.real[..., xp.asarray(np.argsort(order))]
        else:
            result = (xp.fft.fft(lines[..., xp.asarray(order)]) * turn).real * scale
        result = xp.moveaxis(result, -1, axis).astype(x.dtype, copy=False)
    return result


def _onto(result: RealArray, out: RealArray | None) -> RealArray:
    """Return a device's array, in ``out`` where there is one."""
    if out is None:
        return result
    out[...] = result
    return out


def _check(out: Array, shape: tuple[int, ...], dtype: np.dtype[Any]) -> None:
    if out.shape != shape or out.dtype != dtype or not out.flags.c_contiguous:
        raise ValueError(f"out must be C-contiguous {dtype} {shape}, not {out.dtype} {out.shape}.")


def _batched(x: Array, axes: int) -> Array:
    """View as (batch, *transformed axes), so that few numba specialisations serve all shapes."""
    return x.reshape(-1, *x.shape[x.ndim - axes :])


@cache
def _axes(axes: int) -> npt.NDArray[np.int64]:
    return np.arange(1, axes + 1)


@cache
def _kernels() -> Any:
    """Import numba on first use: it costs half a second that most commands need not pay."""
    from recon.base import _fft_kernels

    return _fft_kernels
