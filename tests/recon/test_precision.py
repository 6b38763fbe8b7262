"""Float64 is offered with every model: what float32 gives is held to it."""

from __future__ import annotations

import types
from dataclasses import replace

import numpy as np
import pytest

import recon
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.reconstruction import solvers as offered
from recon.reconstruction.options import Overrides
from recon.reconstruction.part import Part
from recon.reconstruction.solvers import SOLVERS
from recon.solvers.douglas_rachford import DouglasRachford
from recon.solvers.volume_admm import VolumeAdmm


@pytest.fixture(scope="module")
def scene():
    """Two depths, 3 x 3 points, erased pixels."""
    return make_scene("beads", size=20, depths=2, grid=3, erased=0.1, seed=3)


@pytest.mark.parametrize("prior", ["tv", "l1"])
@pytest.mark.parametrize("model", ["convolution", "lowrank", "local"])
def test_volumes_are_solved_in_float64(scene, model, prior, monkeypatch):
    dtypes = set()
    make = offered._admm

    def noted(part, start):
        solver = make(part, start)
        dtypes.add((part.camera.dtype, part.operator.dtype, solver.solution.dtype))
        return solver

    monkeypatch.setitem(SOLVERS._known_own(), "admm", replace(SOLVERS["admm"], make=noted))
    given = {"model": model, "prior": prior, "iterations": 10, "judged": False, "tolerance": 0.0}
    given |= {"erasures": scene.erasures, "noise": scene.noise, "estimate_background": True}
    exact = recon.reconstruct(scene.measurement, scene.calibration, precision="float64", **given)
    assert dtypes == {(np.dtype(np.float64),) * 3}
    assert exact.volume.dtype == np.float32
    usual = recon.reconstruct(scene.measurement, scene.calibration, **given)
    assert len(dtypes) == 2
    assert not np.array_equal(exact.volume, usual.volume)
    np.testing.assert_allclose(exact.volume, usual.volume, atol=1e-3 * float(usual.volume.max()))


def test_what_is_chosen_for_a_volume_may_be_solved_in_float64(scene):
    given = {"prior": "l1", "iterations": 5, "judged": False, "erasures": scene.erasures}
    wish = Overrides(precision="float64", planes="all")
    exact = recon.reconstruct(scene.measurement, scene.calibration, choose=wish, **given)
    assert exact.choice is not None
    assert exact.choice.precision == "float64"
    assert exact.provenance["precision"] == "float64"


def test_other_precisions_are_refused(scene):
    with pytest.raises(InputError, match="float32, float64"):
        recon.reconstruct(scene.measurement, scene.calibration, precision="float16")


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
def test_the_solvers_of_a_device_follow_the_precision(scene, kind, monkeypatch):
    """On a GPU the same lines run on CuPy's arrays."""
    problem = recon.Problem.of(
        recon.Measurement(scene.measurement, scene.noise, erasures=scene.erasures),
        scene.calibration,
        recon.Options(
            model="convolution", prior=kind, estimate_background=True,
            axis_weights=(1, 1, 1) if kind == "tv" else None,
            precision="float64",
        ),
    )  # fmt: skip
    part = Part(problem, slice(0, 1))
    part.weight = 1.0
    twin = types.ModuleType("twin")
    twin.__dict__.update({k: v for k, v in np.__dict__.items() if not k.startswith("__")})
    part.namespace = twin
    for module in ("volume_admm", "douglas_rachford"):
        monkeypatch.setattr(f"recon.solvers.{module}.require_memory", lambda *_: None)
    solver = offered._admm(part, None)
    assert type(solver) in (VolumeAdmm, DouglasRachford)
    solver.step()
    assert solver.data.dtype == np.float64
    assert solver.solution.dtype == np.float64
