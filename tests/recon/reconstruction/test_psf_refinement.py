"""PSFs that were turned and enlarged since the calibration are brought back from the photograph itself."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from recon import reconstruct
from recon.camera.transformed import Transformation, transformed
from recon.errors import InputError
from recon.evaluation.scene import TestScene, make_scene
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.psf_refinement import Refinement, as_refined, refine_psf
from recon.types import Calibration


@pytest.fixture(scope="module")
def scene() -> TestScene:
    """Strokes on black through a lenslet diffuser."""
    return make_scene("sparse-picture", size=64, seed=3)


def _misplaced(scene: TestScene, how: Transformation) -> Calibration:
    return replace(scene.calibration, psfs=transformed(scene.calibration.psfs, how))


def _likeness(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def test_what_was_planted_is_found_and_taken_back(scene: TestScene) -> None:
    wrong = _misplaced(scene, Transformation(scale=1.02, rotation_deg=-2.0))
    spoilt = reconstruct(scene.measurement, wrong, iterations=60)
    mended = reconstruct(scene.measurement, wrong, iterations=60, refine_psf=True)
    found = mended.refinement
    assert found is not None
    assert found.helps
    assert found.transformation.scale == pytest.approx(1 / 1.02, abs=0.003)
    assert found.transformation.rotation_deg == pytest.approx(2.0, abs=0.15)
    assert found.found < 0.5 * found.given
    assert mended.provenance["psf_refinement"]["used"] is True
    assert "turned by +" in str(found)
    right = reconstruct(scene.measurement, scene.calibration, iterations=60)
    assert spoilt.refinement is None
    assert _likeness(spoilt.image, right.image) < 0.97
    assert _likeness(mended.image, right.image) > 0.995


@pytest.fixture(scope="module")
def right(scene: TestScene) -> tuple[Refinement, list[float]]:
    """What is found of the right PSF, and the shares of the work that were told."""
    shares: list[float] = []
    problem = Problem.of(scene.measurement, scene.calibration)
    return refine_psf(problem, on_stage=lambda share, _: shares.append(share)), shares


def test_right_psfs_stay_as_they_are(scene: TestScene, right: tuple[Refinement, list[float]]) -> None:
    found, shares = right
    assert not found.helps
    assert found.of(scene.calibration) is scene.calibration
    assert "taken as it is" in str(found)
    assert found.scale_error is not None
    assert found.scale_error < 0.003
    assert found.rotation_error_deg < 0.2
    assert shares[-1] == 1.0
    assert shares == sorted(shares)


def test_sources_move_with_their_patterns(scene: TestScene) -> None:
    found = refine_psf(Problem.of(scene.measurement, scene.calibration))
    turned = replace(found, transformation=Transformation(rotation_deg=90.0), certainty=9.0, significance=9.0)
    east = replace(scene.calibration, source_positions_um=np.array([[100.0, 0.0, 5000.0]]))
    # From the image's right towards its bottom: x becomes y.
    assert turned.of(east).source_positions_um == pytest.approx(np.array([[0.0, 100.0, 5000.0]]), abs=1e-9)


def test_cancelled_work_takes_the_psfs_as_they_are(scene: TestScene) -> None:
    cancel = threading.Event()
    cancel.set()
    result = reconstruct(scene.measurement, scene.calibration, refine_psf=True, cancel=cancel)
    assert result.refinement is None


def test_frames_under_patterns_are_refused(scene: TestScene) -> None:
    frames = np.stack([scene.measurement] * 2)
    with pytest.raises(InputError, match="one light"):
        reconstruct(frames, scene.calibration, patterns=np.ones_like(frames), refine_psf=True)


def test_of_volumes_the_rotation_alone_is_fitted() -> None:
    scene = make_scene("beads", size=48, seed=5, depths=2, drift_deg=3.0)
    found = refine_psf(Problem.of(scene.measurement, scene.calibration))
    assert found.scale_error is None
    assert found.transformation.scale == 1
    assert abs(found.transformation.rotation_deg) == pytest.approx(3.0, abs=0.3)
    assert "larger" not in str(found)


def test_of_one_depth_of_several_that_which_fits_is_taken() -> None:
    scene = make_scene("sparse-picture", size=48, seed=3, depths=3, optics="smooth", z_near=5, drift_deg=2.0)
    _, true_um, far_um = scene.z_um
    wrong = ReconstructionOptions(z_um=far_um)
    result = reconstruct(
        scene.measurement, scene.calibration, wrong, iterations=2, judged=False, refine_psf=True
    )
    found = result.refinement
    assert found is not None
    assert found.helps
    assert (found.of_z_um, result.provenance["psf_z_um"]) == (true_um, true_um)
    assert found.z_um == pytest.approx(true_um, rel=0.03)
    assert found.transformation.scale == pytest.approx(1, abs=0.005)
    assert found.transformation.rotation_deg == pytest.approx(-2.0, abs=0.3)
    assert f"of the depth of {true_um / 1e3:.4g} mm, turned by" in str(found)
    kept = as_refined(scene.calibration, found.to_json())
    assert kept.source_positions_um[:, 2] == pytest.approx([true_um])


@pytest.mark.parametrize("photograph", [np.zeros((16, 20)), np.full((16, 20), 7.0)])
def test_a_photograph_that_tells_nothing_says_so(photograph: np.ndarray) -> None:
    psf = np.random.default_rng(1).random(photograph.shape).astype(np.float32)
    found = refine_psf(Problem.of(photograph, psf))
    assert not found.helps
    assert "does not tell" in str(found)


def test_a_fit_whose_numbers_nobody_knows_is_not_taken(right: tuple[Refinement, list[float]]) -> None:
    better = replace(right[0], certainty=9.0, significance=9.0)
    assert better.helps
    for unknown in ({"rotation_error_deg": 40.0}, {"scale_error": 4.0}):
        lost = replace(better, **unknown)
        assert not lost.helps
        assert "does not tell" in str(lost)
