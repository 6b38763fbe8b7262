"""A hologram without a Fourier lens makes its picture where light that is propagated by itself has it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import fft
from scipy.ndimage import gaussian_filter, map_coordinates

from recon.errors import InputError
from recon.holography import (
    DcTerm,
    Display,
    HologramModel,
    HologramOptions,
    SpotList,
    Target,
    compute_hologram,
    compute_spots,
    hologram_limit,
)
from recon.holography.display import no_mask
from recon.holography.scores import intensity
from recon.holography.target import near_window

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


def near(distance_mm: float, shape: tuple[int, int] = (SIDE, SIDE)) -> Display:
    mask = no_mask(shape, design_wavelength_nm=NM)
    return replace(DISPLAY, slm_shape=shape, mask=mask, distance_mm=distance_mm)


def places_in(display: Display, n: int) -> np.ndarray:
    """Return where samples across a display's field are, the axis in the middle, micrometres."""
    return (np.arange(n) - n // 2) * (display.field_mm * 1e3 / n)


@pytest.mark.parametrize(("distance_mm", "likeness"), [(40.0, 0.99), (15.0, 0.98), (4.0, 0.97)])
def test_near_pictures_are_as_light_propagated_by_itself(distance_mm: float, likeness: float) -> None:
    display = near(distance_mm)
    assert display.near
    window = near_window(display)
    image = np.zeros((96, 96))
    rows, columns = window.part(image.shape)
    y, x = np.mgrid[: rows.stop - rows.start, : columns.stop - columns.start]
    image[rows, columns] = 0.3 + 0.7 * ((y // 8 + x // 12) % 2)
    target = Target(image, window=window)
    model = HologramModel(display, [target, replace(target, z_mm=5.0)])
    found = compute_hologram(model, iterations=10)
    samples = 1024 if distance_mm > 20 else 512
    for plane, away_mm in enumerate((distance_mm, distance_mm + 5)):
        said = model.intensity(found.slm, plane)
        at = places_in(display, len(said)) / (PITCH_UM / FINE) + samples / 2 - 0.5
        light = propagated(found.slm[0], away_mm, samples)
        seen = map_coordinates(light, np.meshgrid(at, at, indexing="ij"), order=1)
        part = window.part(said.shape)
        blurred = [gaussian_filter(one, len(said) / display.period / 2)[part] for one in (said, seen)]
        assert np.corrcoef(blurred[0].ravel(), blurred[1].ravel())[0, 1] > likeness
    whole = model.evaluate(found.slm).seen_psnr_db
    assert whole > model.evaluate(np.ones_like(found.slm)).seen_psnr_db + 2


def test_the_gradient_of_a_near_picture_is_that_of_its_loss() -> None:
    display = near(20.0, (12, 16))
    rng = np.random.default_rng(0)
    targets = [Target(rng.uniform(size=(16, 16)), z) for z in (0.0, 3.0)]
    model = HologramModel(display, targets, frames=2, dtype=np.complex128)
    slm = np.exp(1j * rng.uniform(0, 6, (2, 12, 16)))
    step = rng.normal(size=slm.shape) + 1j * rng.normal(size=slm.shape)
    rise = (model.evaluate(slm + 1e-6 * step).loss - model.evaluate(slm - 1e-6 * step).loss) / 2e-6
    assert 2 * np.vdot(model.evaluate(slm).gradient, step).real == pytest.approx(rise, rel=1e-6)


def test_near_spots_are_where_and_as_bright_as_asked_for() -> None:
    display = near(25.0)
    spots = SpotList(np.array([[0.3, 0.4], [0.6, 0.7], [0.5, 0.2]]), np.array([1.0, 1.0, 2.0]), np.zeros(3))
    found, scores = compute_spots(display, spots, HologramOptions(iterations=30))
    assert scores.deviation < 0.01
    light = propagated(found.slm[0], 25.0, 1024)
    at = (spots.places - 0.5) * display.picture_mm * 1e3 / (PITCH_UM / FINE) + 511.5
    bright = np.array([light[int(y) - 3 : int(y) + 5, int(x) - 3 : int(x) + 5].sum() for y, x in at])
    assert bright / bright.mean() == pytest.approx([0.75, 0.75, 1.5], rel=0.15)
    assert bright.sum() == pytest.approx(scores.efficiency * light.sum(), rel=0.2)
    with pytest.raises(InputError, match=r"0\.59 wavelengths wrong"):
        compute_spots(replace(near(4.0, (512, 512)), slm_pitch_um=2.0), spots)


def test_the_limit_of_a_near_picture_tells_that_light_stays_where_it_falls() -> None:
    display = near(2.0, (16, 16))
    window = near_window(display)
    image = np.zeros((64, 64))
    part = window.part(image.shape)
    image[part][:8] = 1.0
    target = Target(image, window=window)
    limit = hologram_limit(display, target, HologramOptions(iterations=30))
    frames = compute_hologram(HologramModel(display, [target], frames=2), iterations=30)
    assert frames.history[-1].psnr_db < limit.reached_db + 0.2
    assert limit.reached_db - 0.1 < limit.bound_db < 25


def test_planes_are_counted_from_there_and_what_is_wrong_is_refused() -> None:
    picture = np.eye(48)
    shown = HologramModel(DISPLAY, [Target(picture), Target(picture[::-1], 3.0)])
    assert shown.evaluate(np.ones((1, SIDE, SIDE), complex)).loss > 0
    assert DISPLAY.nearest_mm == pytest.approx(2 * 47 * 16e-3 * 16e-3 / 532e-6)
    with pytest.raises(
        InputError, match=r"30 mm away is too near for a picture 160 mm .* 45\.2\d mm, or none"
    ):
        HologramModel(DISPLAY, [Target(picture), Target(picture, -130.0)])
    with pytest.raises(InputError, match="-10 mm behind the mask is none"):
        HologramModel(near(30.0), [Target(picture, -40.0)])
    with pytest.raises(InputError, match=r"29 mm behind the mask is too far for a picture 4 mm away"):
        HologramModel(near(4.0), [Target(picture), Target(picture, 25.0)])
    HologramModel(near(29.0), [Target(picture), Target(picture, -25.0)])
    with pytest.raises(InputError, match="Mirrors show far pictures"):
        HologramModel(near(30.0), [Target(picture)], mirrors="optimised")
    with pytest.raises(InputError, match="dissertation's grid"):
        HologramModel(near(30.0), [Target(picture)], grid="dissertation")
    with pytest.raises(InputError, match="far fields only"):
        intensity(np.ones((1, SIDE, SIDE)), near(30.0))
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
