"""Evidence says what was put in."""

from __future__ import annotations

import sys
import tracemalloc

import numpy as np
import pytest

import recon
from recon import InputError, reconstruct
from recon.camera.camera_model import Depths, plane_gains
from recon.evaluation.scene import SceneSpec, make_scene
from recon.solvers.base import IterationRecord, StopReason
from recon.verdict.evidence import DIVERGED, Observation, _dimming, _similarity, measure, unsettled_by
from recon.verdict.judge import Region

RNG = np.random.default_rng(1)


def evidence(scale: float = 1.0, residual: float = 1.0, valid: float = 1.0):
    data = scale * RNG.normal(size=(40, 50))
    mask = RNG.random(data.shape) < valid
    volume = np.zeros((1, 40, 50))
    volume[0, 10:20, 10:20] = 1.0
    psf = np.zeros((1, 40, 50))
    psf[0, 20, 25] = 1.0
    norm = residual * np.sqrt(np.count_nonzero(mask))
    return measure(Observation(data, mask, 0.1), volume, psf, norm, unsettled=0.0), mask


def test_signal_and_misfit_are_what_exceeds_the_noise() -> None:
    found, _ = evidence(scale=np.sqrt(1 + 3.0**2), residual=np.sqrt(1 + 1.5**2))
    assert found.signal == pytest.approx(3.0, rel=0.1)
    assert found.unexplained == pytest.approx(0.5, rel=0.1)
    assert evidence(residual=0.9)[0].unexplained == 0


def test_unknowns_are_counted_against_the_pixels_that_are_used() -> None:
    found, mask = evidence(valid=0.5)
    assert found.erased == pytest.approx(1 - mask.mean())
    assert found.lit == pytest.approx(100 / 2000)
    # Steps along rows and columns about a square of 10 x 10: fewer than its pixels.
    assert found.edges < found.lit
    assert found.load == pytest.approx(found.edges * 2000 / mask.sum())


def test_details_count_in_units_of_the_noise() -> None:
    ring = np.zeros((1, 60, 60))
    x = np.mgrid[:60, :60][1]
    ring[0] = 1 + np.cos(2 * np.pi * x / 6)
    flat = np.ones((1, 60, 60))
    psf = np.zeros((1, 60, 60))
    psf[0, 30, 30] = 1
    data, valid = RNG.normal(size=(60, 60)), np.ones((60, 60), bool)

    def detail(volume: np.ndarray, noise: float) -> float:
        return measure(Observation(data, valid, noise), volume, psf, 60.0, unsettled=0).detail

    assert detail(ring, 0.1) == pytest.approx(10 * detail(ring, 1.0))
    assert detail(ring, 0.1) > 2 * detail(flat, 0.1)


def test_a_regular_array_is_ambiguous_and_random_lenslets_are_not() -> None:
    found = {}
    for optics in ("random", "regular"):
        scene = make_scene(SceneSpec("sparse-picture", size=40, optics=optics))
        result = reconstruct(scene.measurement, scene.calibration, iterations=3)
        assert result.verdict is not None
        found[optics] = result.verdict.evidence["ambiguity"]
    assert found["random"] < 0.5
    assert found["regular"] > 0.7


def test_evidence_is_the_same_on_finer_pixels() -> None:
    """Details and repeats are the optics', not the grid's: the same picture on pixels of half the size."""
    y, x = np.mgrid[:48, :48]
    psf = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 4) for a, b in RNG.uniform(8, 40, (12, 2)))
    picture = np.zeros((48, 48))
    picture[20:28, 22:26] = picture[12:15, 30:38] = 1
    data, valid = RNG.normal(size=(48, 48)), np.ones((48, 48), bool)
    coarse = measure(Observation(data, valid, 1.0), picture[None], psf[None], 48.0, unsettled=0)
    fine = [np.kron(a, np.ones((2, 2))) / 4 for a in (data * 4, valid * 4, picture, psf * 4)]
    found = measure(Observation(fine[0], fine[1] > 0, 1.0), fine[2][None], fine[3][None], 96.0, unsettled=0)
    assert found.ambiguity == pytest.approx(coarse.ambiguity, rel=0.1)
    assert found.detail == pytest.approx(2 * coarse.detail, rel=0.3)  # each of four pixels has its own noise


def test_what_no_case_knows_is_told_by_what_is_left_and_by_unseen_pixels() -> None:
    scene = make_scene(SceneSpec("text", size=40))
    judged = reconstruct(scene.measurement, scene.calibration, prior="nonnegative")
    assert judged.verdict is not None
    assert judged.verdict.region is Region.UNKNOWN
    assert judged.verdict.held_out is not None
    assert 0.8 < judged.verdict.held_out < 5
    assert "did not see are missed by" in judged.verdict.sentences[-1]
    assert judged.residual is not None
    assert judged.residual.shape == scene.measurement.shape
    assert np.linalg.norm(judged.residual) == pytest.approx(judged.residuals[0], rel=0.1)
    known = reconstruct(scene.measurement, scene.calibration)
    assert known.residual is None


def test_only_a_limit_leaves_a_run_unsettled() -> None:
    history = tuple(IterationRecord(k, 1.0, change=0.05) for k in (7, 8, 9))
    assert unsettled_by(history, StopReason.ITERATIONS, 1e-3, started=False) == pytest.approx(5)
    assert unsettled_by(history, StopReason.CONVERGED, 1e-3, started=False) == 0
    assert unsettled_by((), None, 1e-3, started=False) == 0
    assert unsettled_by(history, StopReason.NOT_FINITE, 1e-3, started=False) == DIVERGED


@pytest.mark.parametrize("iterations", [1, 2])
def test_a_run_of_one_iteration_is_named_unfinished(iterations: int) -> None:
    """ADMM does not move in its first iteration: that is no sign of having settled, nor of little light."""
    scene = make_scene(SceneSpec("sparse-picture", size=40))
    result = reconstruct(scene.measurement, scene.calibration, iterations=iterations)
    assert result.verdict is not None
    assert result.verdict.region is Region.OUTSIDE
    assert result.verdict.findings[0].stress == "unsettled"
    assert "More iterations" in result.verdict.sentences[1]


@pytest.mark.parametrize("method", ["admm", "fista"])
def test_a_start_from_a_settled_result_is_not_called_unfinished(method: str) -> None:
    scene = make_scene(SceneSpec("sparse-picture", size=40))
    settled = reconstruct(scene.measurement, scene.calibration, solver=method, iterations=300)
    warm = reconstruct(scene.measurement, scene.calibration, solver=method, iterations=2, warm=settled)
    assert settled.verdict is not None
    assert warm.verdict is not None
    assert settled.verdict.region is Region.INSIDE
    # ADMM's splits have to meet again, which moves the picture; FISTA stays where it was.
    assert warm.verdict.region is (Region.NEAR if method == "admm" else Region.INSIDE)


def test_a_start_from_what_had_not_settled_does_not_pass_for_settled() -> None:
    """ADMM's first iteration does not move, whatever it starts from."""
    scene = make_scene(SceneSpec("sparse-picture", size=40))
    early = reconstruct(scene.measurement, scene.calibration, iterations=2)
    warm = reconstruct(scene.measurement, scene.calibration, iterations=1, warm=early)
    assert warm.history[0].change < 1e-3
    assert warm.verdict is not None
    assert warm.verdict.evidence["unsettled"] > 1
    still = (IterationRecord(1, 1.0, primal_residual=0.0, change=0.0),)
    assert unsettled_by(still, StopReason.ITERATIONS, 1e-3, started=True) == pytest.approx(100)


def test_a_volume_that_was_started_is_judged_by_what_it_still_changed() -> None:
    scene = make_scene(SceneSpec("beads", size=32, depths=3))
    settled = reconstruct(scene.measurement, scene.calibration, model="convolution", prior="l1")
    warm = reconstruct(
        scene.measurement,
        scene.calibration,
        model="convolution",
        prior="l1",
        iterations=2,
        warm=settled,
    )
    assert warm.verdict is not None
    last = warm.histories[0][-1].change
    assert last < 0.5
    assert warm.verdict.evidence["unsettled"] == pytest.approx(last / 10 / 1e-3)


def test_every_reconstruction_carries_its_evidence() -> None:
    scene = make_scene(SceneSpec("sparse-picture", size=32, photons=1000, erased=0.3))
    for method, prior in (("admm", "tv"), ("wiener", "none")):
        result = reconstruct(
            scene.measurement,
            scene.calibration,
            erasures=scene.erasures,
            solver=method,
            prior=prior,
            iterations=30 if method == "admm" else None,
        )
        assert result.verdict is not None
        assert result.verdict.evidence["erased"] == pytest.approx(scene.erasures.mean())
        assert result.verdict.evidence["planes"] == 1
    unasked = reconstruct(scene.measurement, scene.calibration, iterations=5, judged=False)
    assert unasked.verdict is None
    volume = make_scene(SceneSpec("beads", size=32, depths=3))
    judged = reconstruct(volume.measurement, volume.calibration, prior="l1", iterations=20)
    assert judged.verdict is not None
    assert judged.verdict.evidence["planes"] == 3
    assert 0.5 < judged.verdict.evidence["similarity"] <= 1
    assert {"height", "peaks", "ends"} <= set(judged.verdict.evidence)
    assert "height" not in result.verdict.evidence


def test_colour_and_misfits_are_judged_by_the_worst_channel() -> None:
    scene = make_scene(SceneSpec("sparse-picture", size=32, channels=3, colourful=True))
    result = reconstruct(scene.measurement, scene.calibration, iterations=20)
    assert result.verdict is not None
    assert np.isfinite(list(result.verdict.evidence.values())).all()
    with pytest.raises(InputError):
        reconstruct(scene.measurement, scene.calibration, solver="nothing")


def test_judging_takes_planes_and_never_the_stack_anew() -> None:
    """A stack may be as large as the memory; float64 copies of it would be twice that, for one number."""
    psfs = RNG.random((64, 1, 64, 64)).astype(np.float32)
    depths = Depths(np.arange(64.0), psfs, [])
    tracemalloc.start()
    try:
        similar, dim, gains = _similarity(psfs[:, 0]), _dimming(psfs[:, 0]), plane_gains(depths)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < psfs.nbytes / 4
    flat = psfs.reshape(64, -1).astype(np.float64)
    norms = np.linalg.norm(flat, axis=1)
    assert similar == pytest.approx(np.max(np.sum(flat[1:] * flat[:-1], axis=1) / norms[1:] / norms[:-1]))
    assert dim == pytest.approx(norms.min() / norms.max())
    np.testing.assert_allclose(gains, norms / np.sqrt(np.mean(norms**2)), rtol=1e-6)


def test_a_result_is_not_lost_where_judging_it_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object, **__: object) -> None:
        raise MemoryError("no room")

    monkeypatch.setattr(sys.modules[recon.judged.__module__], "evidence_of", fail)
    volume = make_scene(SceneSpec("beads", size=32, depths=2))
    picture = make_scene(SceneSpec("sparse-picture", size=32))
    for result in (
        reconstruct(volume.measurement, volume.calibration, model="convolution", iterations=3),
        reconstruct(picture.measurement, picture.calibration, iterations=3),
    ):
        assert result.verdict is None
        assert any("No verdict" in text and "no room" in text for text in result.warnings)
