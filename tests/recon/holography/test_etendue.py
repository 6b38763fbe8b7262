"""Étendue arithmetic against the dissertation's worked examples (Sec. 7.3 and 7.5)."""

from __future__ import annotations

import pytest

from recon.errors import InputError
from recon.holography import (
    Etendue,
    eyebox_for_field_of_view,
    field_of_view_for_eyebox,
    pixels_for,
    pixels_per_degree,
)
from recon.holography.target import cutoff_radius

GAEA = Etendue(pixels=4160, pitch_um=3.74, wavelength_nm=532)


def test_gaea_2_has_an_eyebox_of_a_millimetre_at_120_degrees():
    assert eyebox_for_field_of_view(GAEA, 120, paraxial=True) == pytest.approx(1.05, abs=0.01)
    assert eyebox_for_field_of_view(GAEA, 120) == pytest.approx(1.28, abs=0.01)


def test_gaea_2_has_12_7_degrees_at_10_mm():
    assert field_of_view_for_eyebox(GAEA, 10, paraxial=True) == pytest.approx(12.7, abs=0.05)
    assert field_of_view_for_eyebox(GAEA, 10) == pytest.approx(12.7, abs=0.05)


def test_wide_field_and_large_eyebox_need_32500_pixels_and_270_pixels_per_degree():
    pixels = pixels_for(532, 120, 10)
    assert pixels == pytest.approx(32500, rel=0.005)
    assert pixels / 120 == pytest.approx(270, rel=0.01)


def test_an_8k_slm_with_sixteenfold_expansion_serves_an_immersive_display():
    wide = Etendue(pixels=8192, pitch_um=4.0, wavelength_nm=532, expansion=16)
    assert eyebox_for_field_of_view(wide, 120) == pytest.approx(10, rel=0.02)


def test_the_resolution_is_a_circle_of_as_many_frequencies_as_the_slm_has_pixels():
    width, height = Etendue(960, 16, 660), Etendue(540, 16, 660)
    found = pixels_per_degree(width, height)
    assert found == pytest.approx(2 * cutoff_radius((540, 960)) / width.field_of_view_deg)
    assert found == pytest.approx(344, abs=0.5)


def test_lenses_trade_field_for_eyebox_and_the_product_stays():
    narrow, wide = Etendue(960, 16, 660, f1_mm=10, f2_mm=100), Etendue(960, 16, 660, f1_mm=50, f2_mm=100)
    assert wide.field_of_view_deg > narrow.field_of_view_deg
    assert wide.eyebox_mm < narrow.eyebox_mm
    products = [d.field_of_view_deg * d.eyebox_mm for d in (narrow, wide)]
    assert products[0] == pytest.approx(products[1], rel=1e-3)


def test_the_mask_widens_the_field_by_the_root_of_q_and_keeps_the_eyebox():
    plain, masked = Etendue(960, 16, 660), Etendue(960, 16, 660, expansion=16)
    assert masked.eyebox_mm == plain.eyebox_mm
    assert masked.field_of_view_deg == pytest.approx(4 * plain.field_of_view_deg, rel=0.01)
    assert masked.etendue_mm == pytest.approx(4 * plain.etendue_mm)


def test_nonsense_is_refused():
    with pytest.raises(InputError, match="pitch_um must be above 0"):
        Etendue(960, 0, 660)
    with pytest.raises(InputError, match="half the wavelength"):
        Etendue(960, 0.5, 660, expansion=36)
    with pytest.raises(InputError, match="between 0 and 180"):
        eyebox_for_field_of_view(GAEA, 190)
