"""The FFT layer against scipy.fft, and independence of the number of threads."""

from __future__ import annotations

import subprocess
import sys
import threading

import numpy as np
import pytest
import scipy.fft

from recon.base import fft
from recon.base.namespace import namespace_of
from recon.base.threads import get_threads, in_blocks, set_threads


@pytest.fixture
def threads():
    before = get_threads()
    yield set_threads
    set_threads(before)


SHAPES = [((6, 7), 2), ((2, 5, 8), 2), ((2, 3, 4, 6), 3), ((9,), 1), ((1, 1), 2)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("shape", "axes"), SHAPES)
def test_agrees_with_scipy(shape, axes, dtype):
    x = np.random.default_rng(0).standard_normal(shape).astype(dtype)
    X = fft.rfft(x, axes=axes)
    tolerance = 1e-5 if dtype == np.float32 else 1e-13
    assert pytest.approx(scipy.fft.rfftn(x, axes=range(-axes, 0)), abs=tolerance) == X
    assert X.dtype == fft.complex_dtype(dtype)
    back = fft.irfft(X, shape[-1], axes=axes)
    assert back == pytest.approx(x, abs=tolerance)
    assert back.dtype == dtype


def test_writes_into_the_arrays_it_is_given():
    x = np.random.default_rng(0).random((2, 6, 8))
    out, back = np.empty((2, 6, 5), complex), np.empty_like(x)
    assert fft.rfft(x, out=out) is out
    assert fft.irfft(out, 8, out=back) is back
    assert back == pytest.approx(x)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize(("start", "rows"), [(0, 9), (2, 4), (0, 1), (5, 4)])
def test_strips_of_images(start, rows, dtype):
    rng = np.random.default_rng(0)
    tolerance = 1e-5 if dtype == np.float32 else 1e-13
    image = np.zeros((2, 9, 8), dtype)
    image[:, start : start + rows] = rng.standard_normal((2, rows, 8))
    spectrum = np.full((2, 9, 5), np.nan, fft.complex_dtype(dtype))
    fft.rfft_strip(image[:, start : start + rows], start, spectrum)
    assert spectrum == pytest.approx(scipy.fft.rfft2(image), abs=tolerance)
    whole = rng.standard_normal((2, 9, 8)).astype(dtype)
    strip = fft.irfft_strip(fft.rfft(whole), start, np.empty((2, rows, 8), dtype))
    assert strip == pytest.approx(whole[:, start : start + rows], abs=tolerance)


def test_multiplies_in_place():
    rng = np.random.default_rng(0)
    X, H = (rng.standard_normal((n, 4, 3)) + 1j * rng.standard_normal((n, 4, 3)) for n in (2, 1))
    y = X.copy()
    fft.multiply(y, H)
    assert y == pytest.approx(X * H)
    fft.multiply(y, H, conjugate=True)
    assert y == pytest.approx(X * abs(H) ** 2)


def test_refuses_arrays_that_do_not_fit():
    x = np.zeros((4, 6))
    with pytest.raises(ValueError, match="complex128"):
        fft.rfft(x, out=np.empty((4, 4), np.complex64))
    with pytest.raises(ValueError, match="C-contiguous"):
        fft.irfft(np.zeros((4, 8), complex)[:, ::2], 6)


def test_fast_lengths():
    for n in range(1, 200):
        assert fft.fast_length(n) >= n
        assert fft.fast_length(n, real=True) % 2 == 0
    assert fft.fast_shape((599, 799)) == (600, 800)


def test_result_does_not_depend_on_threads(threads):
    x = np.random.default_rng(0).standard_normal((2, 300, 400)).astype(np.float32)
    threads(1)
    one = fft.rfft(x)
    threads(3)
    assert np.array_equal(one, fft.rfft(x))
    with pytest.raises(ValueError, match="at least 1"):
        threads(0)


def test_blocks_cover_every_row_once(threads):
    for n in (1, 2, 5):
        threads(n)
        for length in (1, 4, 17):
            hits = np.zeros(length, int)
            in_blocks(lambda a, b, hits=hits: hits[a:b].__iadd__(1), length)
            assert (hits == 1).all()


def test_blocks_pass_errors_on(threads):
    threads(2)

    def fail(start, _stop):
        if start > 0:
            raise RuntimeError("from a worker")

    with pytest.raises(RuntimeError, match="from a worker"):
        in_blocks(fail, 10)


def test_blocks_serve_several_callers_at_once(threads):
    threads(2)
    totals = np.zeros((4, 100))

    def caller(row):
        for _ in range(20):
            in_blocks(lambda a, b: totals[row, a:b].__iadd__(1), 100)

    callers = [threading.Thread(target=caller, args=(i,)) for i in range(4)]
    for c in callers:
        c.start()
    for c in callers:
        c.join()
    assert (totals == 20).all()


def test_blocks_within_blocks_end(threads):
    threads(2)
    hits = np.zeros((6, 10))

    def outer(start, stop):
        for row in range(start, stop):
            in_blocks(lambda a, b, row=row: hits[row, a:b].__iadd__(1), 10)

    in_blocks(outer, 6)
    assert (hits == 1).all()


def test_import_is_light():
    code = (
        "import sys, recon, recon.camera.convolution, recon.solvers, recon.priors, recon.base.metrics;"
        "sys.exit('numba' in sys.modules or 'scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("shape", [(5, 6), (1, 5, 6), (3, 4, 5), (1, 1, 1)])
def test_cosine_transforms_over_all_axes(shape):
    image = np.random.default_rng(0).random(shape)
    spectrum = fft.dct(image, np.empty_like(image))
    np.testing.assert_allclose(spectrum, scipy.fft.dctn(image, norm="ortho"), atol=1e-12)
    np.testing.assert_allclose(fft.idct(spectrum, np.empty_like(image)), image, atol=1e-12)


def test_images_that_are_numpys_arrays_in_another_packages_class_are_numpys() -> None:
    class Array(np.ndarray):
        """As ImageIO's, which say so of their own module."""

    Array.__module__ = "json"
    assert namespace_of(np.zeros(2).view(Array)) is np
