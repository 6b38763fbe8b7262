"""Blind deconvolution of bead images: operators by brute force, then PSFs from rays traced to every bead."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.blind import BlindSettings, calibrate_from_beads
from recon.blind.polish import first_psf, offset_of
from recon.blind.psf_step import BeadMixer, limit_rank, solve_psfs
from recon.camera.convolution import field_of
from recon.camera.registration import displacement, shifted
from recon.camera.varying_psfs import FieldOfPsfs, interpolation_weights, local_convolution
from recon.errors import InputError
from recon.optics.diffuser import microlens_diffuser
from recon.optics.grid import PixelGrid, mixed_spectrum
from tests.recon.optics.rays import RayPropagator

SENSOR, PSF = (16, 18), (7, 5)
POINTS = np.array([(r, c) for r in (-4, 4) for c in (-5, 5)], float)


def masks() -> np.ndarray:
    shape, centre = field_of(SENSOR, PSF)
    rows, columns = (np.arange(n) - c for n, c in zip(shape, centre, strict=True))
    return interpolation_weights(POINTS, np.eye(4), rows, columns).astype(np.float32)


def beads(count: int = 2, seed: int = 0) -> np.ndarray:
    shape, _ = field_of(SENSOR, PSF)
    rng = np.random.default_rng(seed)
    return np.where(rng.random((count, *shape)) > 0.97, rng.random((count, *shape)), 0).astype(np.float32)


def test_the_mixer_is_the_local_convolution_model() -> None:
    rng = np.random.default_rng(1)
    psfs, y = rng.random((4, *PSF)).astype(np.float32), beads()
    seen = BeadMixer(masks(), y, PSF, SENSOR).forward(psfs)
    camera = local_convolution([FieldOfPsfs(psfs[:, None], POINTS)], SENSOR)
    for image, objects in zip(seen, y, strict=True):
        np.testing.assert_allclose(image, camera.forward(objects[None, None])[0], atol=1e-4)


def test_the_mixers_adjoint_and_the_bound_of_its_norm() -> None:
    mixer = BeadMixer(masks(), beads(3), PSF, SENSOR)
    rng = np.random.default_rng(2)
    psfs, images = rng.normal(size=(4, *PSF)), rng.normal(size=(3, *SENSOR))
    left = np.vdot(mixer.forward(psfs.astype(np.float32)), images)
    assert left == pytest.approx(np.vdot(psfs, mixer.adjoint(images.astype(np.float32))), rel=1e-4)
    dense = np.stack(
        [mixer.forward(unit.reshape(4, *PSF).astype(np.float32)).ravel() for unit in np.eye(4 * 35)], axis=1
    )
    largest = np.linalg.svd(dense.astype(float), compute_uv=False)[0] ** 2
    assert largest <= mixer.lipschitz * (1 + 1e-5)
    assert mixer.lipschitz < 20 * largest  # not so loose as to be useless


def test_the_projection_on_the_rank_is_that_of_the_svd() -> None:
    psfs = np.random.default_rng(3).random((4, *PSF))
    u, s, vt = np.linalg.svd(psfs.reshape(4, -1), full_matrices=False)
    np.testing.assert_allclose(limit_rank(psfs, 2).reshape(4, -1), (u[:, :2] * s[:2]) @ vt[:2], atol=1e-10)
    np.testing.assert_array_equal(limit_rank(psfs, 4), psfs)


def test_the_psf_step_descends_and_keeps_the_rank() -> None:
    rng = np.random.default_rng(4)
    y = beads(6, seed=5)
    mixer = BeadMixer(masks(), y, PSF, SENSOR)
    truth = limit_rank(rng.random((4, *PSF)).astype(np.float32), 2)
    data = mixer.forward(truth)
    start = np.full((4, *PSF), truth.mean(), np.float32)
    _, after_few = solve_psfs(mixer, data, start, 2, 5)
    many, after_many = solve_psfs(mixer, data, start, 2, 200)
    before = 0.5 * float(np.sum((mixer.forward(start) - data) ** 2))
    assert after_many < after_few < before
    assert after_many < 1e-2 * before
    assert np.linalg.matrix_rank(many.reshape(4, -1), tol=1e-3) == 2


WINDOW = (51, 51)


class Microscope:
    """Random lenslets over a flat sensor; every bead's light is traced by Snell's law to the pixels."""

    pitch_um, z_um, distance_um, size = 24.0, 2500.0, 3800.0, 110

    def __init__(self) -> None:
        lenses = microlens_diffuser((400.0, 400.0), 4.0, lenslet_um=100.0, focal_length_um=1500.0, seed=1)
        self.rays = RayPropagator(lenses, self.distance_um, rays_per_sample=2)
        self.grid = PixelGrid((self.size, self.size), self.pitch_um)
        self.object_um = self.pitch_um * self.z_um / self.distance_um

    def psf(self, row: float, column: float) -> np.ndarray:
        """Image of a bead that shifts the pattern by so many pixels, dimmer and changed off the axis."""
        place = (-column * self.object_um, -row * self.object_um, self.z_um)
        light = self.rays.psf(
            place, self.grid, mixed_spectrum((0.0, 1.0, 0.0), 1), diameter_um=30.0, emission="isotropic"
        )
        x, y = np.meshgrid(self.grid.x_um, self.grid.y_um)
        tangent = np.hypot(x - place[0], y - place[1]) / (self.z_um + self.distance_um)
        return light * np.exp(-0.5 * (np.arctan(tangent) / np.deg2rad(13.0)) ** 2)


def slides(camera: Microscope, count: int = 9, per_slide: int = 12) -> np.ndarray:
    rng = np.random.default_rng(7)
    images = []
    for _ in range(count):
        places = rng.uniform(-0.2, 0.2, (per_slide, 2)) * camera.size
        clean = np.sum([rng.uniform(0.5, 1) * camera.psf(r, c) for r, c in places], axis=0)
        images.append(clean / clean.max() + rng.normal(0, 0.01, clean.shape))
    return np.stack(images).astype(np.float32)


def alike(found: np.ndarray, truth: np.ndarray) -> float:
    moved = shifted(found, *(-v for v in displacement(found, truth)))
    return float(np.vdot(moved, truth) / np.linalg.norm(moved) / np.linalg.norm(truth))


@pytest.fixture(scope="module")
def camera() -> Microscope:
    return Microscope()


@pytest.fixture(scope="module")
def images(camera: Microscope) -> np.ndarray:
    return slides(camera)


def test_the_first_psf_is_that_of_the_centre_with_noise(camera: Microscope, images: np.ndarray) -> None:
    psf = first_psf(np.maximum(images, 0), WINDOW)
    assert psf.sum() == pytest.approx(1.0, rel=1e-5)
    assert max(abs(v) for v in offset_of(psf)) <= 1
    frame = np.zeros((camera.size, camera.size), np.float32)
    frame[30:81, 30:81] = psf
    assert alike(frame, camera.psf(0, 0)) > 0.75


def test_bead_images_give_psfs_over_the_field(camera: Microscope, images: np.ndarray) -> None:
    """Kuo 2020, Fig. 5.4c: good but imperfect correspondence; the first PSF alone is less alike."""
    settings = BlindSettings(grid=(3, 3), ranks=(1, 2), iterations=30, degree=1, reach=0.4, improvement=0.0)
    found = calibrate_from_beads(images, WINDOW, settings)
    assert list(found.misfits) == sorted(found.misfits, reverse=True)
    assert found.psfs.sum(axis=(1, 2)) == pytest.approx(np.ones(9), rel=1e-4)
    for psf, (row, column) in zip(found.on_sensor(), found.points, strict=True):
        assert alike(psf, camera.psf(row, column)) > 0.8
    # The same again is the same again, and a few iterations of a few images tell.
    few = replace(settings, iterations=3)
    first, again = (calibrate_from_beads(images[:3], WINDOW, few).psfs for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_unusable_images_are_refused_in_words() -> None:
    light = np.random.default_rng(0).random((3, 20, 20)).astype(np.float32)
    for images, window, settings, part in (
        (light[:1], (5, 5), BlindSettings(), "Two or more"),
        (light, (21, 5), BlindSettings(), "within the sensor"),
        (light, (5, 5), BlindSettings(ranks=(2, 1)), "Ranks"),
        (light * np.float32(np.nan), (5, 5), BlindSettings(), "finite"),
        (np.zeros_like(light), (5, 5), BlindSettings(), "no light"),
    ):
        with pytest.raises(InputError, match=part):
            calibrate_from_beads(images, window, settings)
