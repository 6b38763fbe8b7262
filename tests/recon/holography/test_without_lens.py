"""A hologram without a Fourier lens makes its picture where light that is propagated by itself has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft
from scipy.ndimage import map_coordinates

from recon.errors import InputError
from recon.holography import DcTerm, Display, HologramModel, HologramOptions, Target, compute_hologram
from recon.holography.display import no_mask
from recon.holography.judge import intensity

NM, PITCH_UM, SIDE, FINE = 532.0, 16.0, 48, 4
DISPLAY = Display(
    (SIDE, SIDE), no_mask((SIDE, SIDE), design_wavelength_nm=NM), slm_pitch_um=PITCH_UM, wavelength_nm=NM,
    dc=DcTerm(0.1), mask_fill=1.0, distance_mm=160.0,
)  # fmt: skip


def propagated(slm: np.ndarray, z_mm: float, samples: int = 2048) -> np.ndarray:
    """Return the intensity ``z_mm`` behind an SLM of whole pixels, a quarter of a pixel apart: band-limited
    angular spectrum (Matsushima and Shimobaba, Opt. Express 17, 19662, 2009)."""
    fine_um, nm = PITCH_UM / FINE, NM * 1e-3
    field = np.zeros((samples, samples), complex)
    first = (samples - SIDE * FINE) // 2
    part = slice(first, first + SIDE * FINE)
    lit = DISPLAY.dc.modulated * slm + DISPLAY.dc.amplitude
    field[part, part] = np.repeat(np.repeat(lit, FINE, axis=0), FINE, axis=1)
    f = fft.fftfreq(samples, fine_um)
    limit = 1 / (nm * np.hypot(2 * z_mm * 1e3 / (samples * fine_um), 1))
    inside = (abs(f[:, None]) < limit) & (abs(f) < limit)
    kz = 2 * np.pi * np.sqrt(np.maximum(nm**-2 - f[:, None] ** 2 - f**2, 0))
    return np.abs(fft.ifft2(fft.fft2(field) * np.exp(1j * kz * z_mm * 1e3) * inside)) ** 2


def test_the_picture_is_where_and_as_large_as_is_said() -> None:
    y, x = np.mgrid[:96, :96]
    picture = ((y // 16 + x // 24) % 2 * 0.8 + 0.1) * (np.hypot(y - 48, x - 48) < 40)
    found = compute_hologram(HologramModel(DISPLAY, [Target(picture)], iterations=40))
    (slm,) = found.slm
    away_um = 160e3
    light = propagated(slm, 160.0)
    said = intensity(found.slm, DISPLAY)
    places = fft.fftfreq(len(said)) * NM * 1e-3 * away_um / PITCH_UM
    assert abs(places).max() * 2 == pytest.approx(DISPLAY.field_mm * 1e3)
    at = places / (PITCH_UM / FINE) + 1024 - 0.5
    seen = map_coordinates(light, np.meshgrid(at, at, indexing="ij"), order=1)
    assert np.corrcoef(seen.ravel(), said.ravel())[0, 1] > 0.99
    behind = map_coordinates(propagated(slm, 120.0), np.meshgrid(at, at, indexing="ij"), order=1)
    assert np.corrcoef(behind.ravel(), said.ravel())[0, 1] < 0.7


def test_planes_are_counted_from_there_and_what_is_too_near_is_refused() -> None:
    picture = np.eye(48)
    shown = HologramModel(DISPLAY, [Target(picture), Target(picture[::-1], 3.0)])
    assert shown.evaluate(np.ones((1, SIDE, SIDE), complex)).loss > 0
    assert DISPLAY.nearest_mm == pytest.approx(2 * 47 * 16e-3 * 16e-3 / 532e-6)
    with pytest.raises(InputError, match=r"30 mm away is too near .* from 45\.2\d mm on"):
        HologramModel(replace(DISPLAY, distance_mm=30.0), [Target(picture)])
    with pytest.raises(InputError, match="distance_mm"):
        HologramOptions(distance_mm=-1.0)


def test_behind_a_lens_and_without_one_larger_depths_lie_farther_from_an_slm_that_delays() -> None:
    side, pitch_mm, nm, f_mm = 256, 8e-3, 532.0, 35.0
    mask = no_mask((side, side), design_wavelength_nm=nm)
    lens = Display((side, side), mask, slm_pitch_um=8.0, wavelength_nm=nm, focal_mm=f_mm)
    bare = replace(lens, distance_mm=200.0)
    x = (np.arange(1 << 16) - (1 << 15)) * 5e-4
    column = np.floor(x / pitch_mm + side / 2).astype(int)
    lit = (column >= 0) & (column < side)
    f, wavelength_mm = fft.fftfreq(len(x), 5e-4), nm * 1e-6
    kz = 2 * np.pi * np.sqrt(np.maximum(wavelength_mm**-2 - f**2, 0))

    def further(field: np.ndarray, mm: float) -> np.ndarray:
        return fft.ifft(fft.fft(field) * np.exp(1j * kz * mm))

    def in_the_middle(display: Display, z_mm: float, mm: float) -> float:
        """Return the light on the axis, ``mm`` behind lens or SLM, of a focus in the model's plane."""
        field = np.zeros(len(x), complex)
        field[lit] = display.defocus(z_mm)[1].conj()[column[lit]]
        if display.distance_mm is None:
            field = further(field, f_mm) * np.exp(-1j * np.pi * x**2 / (wavelength_mm * f_mm))
        return float(abs(further(field, mm)[1 << 15]) ** 2)

    for z_mm in (-3.0, 3.0):
        assert in_the_middle(lens, z_mm, f_mm + z_mm) > 10 * in_the_middle(lens, z_mm, f_mm - z_mm)
    for z_mm in (-60.0, 60.0):
        assert in_the_middle(bare, z_mm, 200 + z_mm) > 5 * in_the_middle(bare, z_mm, 200 - z_mm)
