"""Rendered scenes against point spread functions computed at every place; the truth's convention."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import uniform_filter

from recon.optics.diffuser import smooth_diffuser
from recon.optics.fall_off import gaussian_fall_off, no_fall_off, response_on
from recon.optics.grid import PixelGrid, mixed_spectrum
from recon.optics.render import RenderSettings, render
from recon.optics.scene import Beads, Layer, Scene, TruthGrid
from recon.optics.wave import WavePropagator

DISTANCE_UM = 8900.0
Z_UM = 100e3
GRID = PixelGrid((120, 160), 26.0)
GREEN_ONLY = (0.0, 1.0, 0.0)


@pytest.fixture(scope="module")
def propagator() -> WavePropagator:
    return WavePropagator(smooth_diffuser((1000.0, 1500.0), 6.0, seed=5), DISTANCE_UM)


@pytest.mark.parametrize("fall_off", [no_fall_off, gaussian_fall_off(13.0)])
def test_picture_equals_the_sum_of_its_points(propagator: WavePropagator, fall_off: object) -> None:
    # Dots on the centres of the renderer's cells all over a wide field: interpolation between nodes has to be
    # right everywhere.
    cell_um = GRID.pitch_um / 2 * Z_UM / DISTANCE_UM
    count = 121
    rng = np.random.default_rng(1)
    radiance = np.zeros((count, count, 3), np.float32)
    dots = rng.integers(0, count, (40, 2))
    radiance[dots[:, 0], dots[:, 1]] = 1.0
    layer = Layer(radiance, Z_UM, (count * cell_um, count * cell_um))
    rendered = render(
        Scene("dots", layers=(layer,)),
        GREEN_ONLY,
        GRID,
        propagator,
        fall_off,  # type: ignore[arg-type]
        layer_photons=1.0,
        bead_photons=1.0,
    )
    exact = np.zeros(GRID.shape)
    for row, column in np.argwhere(radiance[:, :, 0]):
        source = ((column - count // 2) * cell_um, (row - count // 2) * cell_um, Z_UM)
        psf = propagator.psf(source, GRID, mixed_spectrum(GREEN_ONLY, 1))
        exact += psf * response_on(GRID, source, DISTANCE_UM, fall_off) * (cell_um * 1e-3) ** 2  # type: ignore[arg-type]
    error = np.linalg.norm(rendered - exact) / np.linalg.norm(exact)
    assert error < 0.02
    assert rendered.sum() == pytest.approx(exact.sum(), rel=5e-3)


def test_a_picture_of_pixels_no_finer_than_the_sensors_is_as_exact_in_whole_cells(
    propagator: WavePropagator,
) -> None:
    cell_um = 3.4 * GRID.pitch_um * Z_UM / DISTANCE_UM
    radiance = np.random.default_rng(3).random((30, 35, 1)).astype(np.float32)
    layer = Layer(np.repeat(radiance, 3, 2), Z_UM, (30 * cell_um, 35 * cell_um))

    def seen(oversampling: int | None) -> np.ndarray:
        return render(
            Scene("noise", layers=(layer,)),
            GREEN_ONLY,
            GRID,
            propagator,
            no_fall_off,
            layer_photons=1.0,
            bead_photons=1.0,
            settings=RenderSettings(oversampling=oversampling),
        )

    fine, chosen = seen(3), seen(None)
    assert np.array_equal(chosen, seen(1))  # to the last bit, whichever thread was done first
    structure = fine - uniform_filter(fine, 9)
    assert np.linalg.norm(chosen - fine) < 0.2 * np.linalg.norm(structure)
    assert np.linalg.norm(chosen - fine) < 5e-3 * np.linalg.norm(fine)


def test_bead_and_tiny_picture_shine_in_the_same_place(propagator: WavePropagator) -> None:
    place = (4321.0, -2987.0)
    radiance = np.ones((1, 1, 3), np.float32)
    picture = Scene("dot", layers=(Layer(radiance, Z_UM, (10.0, 10.0), place),))
    bead = Scene("bead", beads=(Beads(np.array([[*place, Z_UM]]), np.ones((1, 3))),))
    images = [
        render(scene, GREEN_ONLY, GRID, propagator, no_fall_off, layer_photons=1.0, bead_photons=1.0)
        for scene in (picture, bead)
    ]
    centres = [
        (
            (image.sum(axis=1) @ GRID.y_um) / image.sum(dtype=np.float64),
            (image.sum(axis=0) @ GRID.x_um) / image.sum(dtype=np.float64),
        )
        for image in images
    ]
    # A cell of the renderer is half a pixel; its content sits at its centre.
    np.testing.assert_allclose(centres[0], centres[1], atol=0.3 * GRID.pitch_um)


def test_truth_stands_upside_down_on_the_sensors_grid() -> None:
    shape = (100, 140)
    place = np.array([[3000.0, -1500.0, Z_UM]])
    scene = Scene("bead", beads=(Beads(place, np.ones((1, 3))),))
    image = scene.true_image(TruthGrid(shape, 26.0, DISTANCE_UM), GREEN_ONLY)
    row, column = np.argwhere(image)[0]
    assert (row, column) == (
        50 + round(1500 * DISTANCE_UM / Z_UM / 26.0),
        70 - round(3000 * DISTANCE_UM / Z_UM / 26.0),
    )
    assert image.sum() == pytest.approx(1.0)


def test_truth_keeps_a_pictures_light() -> None:
    rng = np.random.default_rng(0)
    layer = Layer(rng.random((30, 40, 3), dtype=np.float32), Z_UM, (9000.0, 12000.0), (500.0, 300.0))
    image = Scene("noise", layers=(layer,)).true_image(TruthGrid((300, 300), 7.3, DISTANCE_UM), GREEN_ONLY)
    assert image.sum() == pytest.approx(layer.radiance[:, :, 1].mean() * 9.0 * 12.0, rel=1e-5)
    # Upside down: a mark in the picture's upper left corner is seen at the lower right.
    radiance = np.zeros((8, 8, 3), np.float32)
    radiance[0, 0] = 1
    image = Scene("mark", layers=(Layer(radiance, Z_UM, (8000.0, 8000.0)),)).true_image(
        TruthGrid((101, 101), 10.0, DISTANCE_UM), GREEN_ONLY
    )
    row, column = np.argwhere(image).mean(axis=0)
    assert row > 60
    assert column > 60


def test_a_sensor_off_the_axis_sees_its_part_of_the_picture(propagator: WavePropagator) -> None:
    """Half of a sensor sees what the whole one sees there, although its centre is elsewhere."""
    cell_um = GRID.pitch_um * Z_UM / DISTANCE_UM
    radiance = np.random.default_rng(2).random((60, 60, 3)).astype(np.float32).mean(axis=2, keepdims=True)
    size_um = (60 * cell_um, 60 * cell_um)
    scene = Scene("middle", layers=(Layer(np.repeat(radiance, 3, 2), Z_UM, size_um),))

    def seen(grid: PixelGrid) -> np.ndarray:
        return render(scene, GREEN_ONLY, grid, propagator, no_fall_off, layer_photons=1.0, bead_photons=1.0)

    right = PixelGrid((120, 80), GRID.pitch_um, (40 * GRID.pitch_um, 0.0))
    whole, half = seen(GRID)[:, 80:], seen(right)
    assert np.linalg.norm(half - whole) < 0.02 * np.linalg.norm(whole)


def test_another_picture_at_the_same_distance_needs_no_more_propagation(
    propagator: WavePropagator, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shone(width_um: float) -> None:
        layer = Layer(np.ones((20, 30, 3), np.float32), Z_UM, (7e3, width_um))
        scene = Scene("even", layers=(layer,))
        render(scene, GREEN_ONLY, GRID, propagator, no_fall_off, layer_photons=1.0, bead_photons=1.0)

    shone(11e3)
    monkeypatch.setattr(propagator, "caustic", None)
    shone(9e3)
