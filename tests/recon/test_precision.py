"""Float64 is offered with every model: what float32 gives is held to it."""

from __future__ import annotations

import numpy as np
import pytest

import recon
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.reconstruction.channel import ChannelProblem
from recon.reconstruction.overrides import Wishes
from recon.reconstruction.volume import prepare_volume


@pytest.fixture(scope="module")
def scene():
    """Two depths, 3 x 3 points, erased pixels."""
    return make_scene("beads", size=20, depths=2, grid=3, erased=0.1, seed=3)


@pytest.mark.parametrize("prior", ["tv", "l1"])
@pytest.mark.parametrize("model", ["convolution", "lowrank", "local"])
def test_volumes_are_solved_in_float64(scene, model, prior, monkeypatch):
    dtypes = set()
    solver = ChannelProblem.solver

    def noted(run, *arguments):
        found = solver(run, *arguments)
        dtypes.add((run.camera.dtype, run.operator.dtype, found[0].solution.dtype))
        return found

    monkeypatch.setattr(ChannelProblem, "solver", noted)
    given = {"model": model, "prior": prior, "iterations": 10, "judged": False, "tolerance": 0.0}
    given |= {"erasures": scene.erasures, "noise": scene.noise, "estimate_background": True}
    exact = recon.reconstruct_volume(scene.measurement, scene.calibration, precision="float64", **given)
    assert dtypes == {(np.dtype(np.float64),) * 3}
    assert exact.volume.dtype == np.float32
    usual = recon.reconstruct_volume(scene.measurement, scene.calibration, **given)
    assert len(dtypes) == 2
    assert not np.array_equal(exact.volume, usual.volume)
    np.testing.assert_allclose(exact.volume, usual.volume, atol=1e-3 * float(usual.volume.max()))


def test_what_is_chosen_for_a_volume_may_be_solved_in_float64(scene):
    given = {"prior": "l1", "iterations": 5, "judged": False, "erasures": scene.erasures}
    wish = Wishes(precision="float64", planes="all")
    exact = recon.reconstruct_volume(scene.measurement, scene.calibration, wishes=wish, **given)
    assert exact.choice is not None
    assert exact.choice.precision == "float64"
    assert exact.provenance["precision"] == "float64"


@pytest.mark.parametrize("reconstruct", [recon.reconstruct, recon.reconstruct_volume])
def test_other_precisions_are_refused(scene, reconstruct):
    with pytest.raises(InputError, match="float32 or float64"):
        reconstruct(scene.measurement, scene.calibration, precision="float16")


def test_a_picture_with_varying_psfs_is_solved_in_float64():
    scene = make_scene("sparse-picture", size=20, grid=3)
    given = {"model": "local", "prior": "tv", "iterations": 5, "judged": False, "tolerance": 0.0}
    exact, usual = (
        recon.reconstruct(scene.measurement, scene.calibration, precision=p, **given)
        for p in ("float64", "float32")
    )
    assert exact.provenance["precision"] == "float64"
    assert not np.array_equal(exact.image, usual.image)
    np.testing.assert_allclose(exact.image, usual.image, atol=1e-3 * float(usual.image.max()))


@pytest.mark.parametrize("kind", ["tv", "l1"])
def test_the_plain_solvers_of_a_device_follow_the_precision(scene, kind):
    """On a GPU the same lines run on CuPy's arrays."""
    scaled = prepare_volume(scene.measurement, scene.calibration, None, scene.erasures, scene.noise)
    run = ChannelProblem(
        scaled, 0, "convolution", smooth=True, prior=kind, weights=np.ones((2, 3)), precision="float64"
    )
    solver = run._plain(run.camera, 1.0, None)
    assert solver.camera.dtype == np.float64
    solver.step()
    assert solver.solution.dtype == np.float64
