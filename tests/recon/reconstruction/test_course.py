from __future__ import annotations

import tracemalloc
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from recon import Calibration, Geometry, reconstruct
from recon.camera.spatially_varying import PlacedStrip
from recon.errors import NoMemoryError
from recon.evaluation.scene import make_scene
from recon.priors.base import L1
from recon.reconstruction import reconstruct as door
from recon.reconstruction.course import TOLD_AT, expected_bytes, expected_iterations
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import volume_plan
from recon.reconstruction.problem import Problem
from recon.reconstruction.solve import solve
from recon.solvers.base import IterationRecord
from recon.solvers.memory import GIB


@pytest.mark.parametrize(
    ("channels", "options"), [(1, {"uncertainty": True, "refine_psf": True}), (3, {"prior": "l1"})]
)
def test_one_measure_of_all_stages_that_never_goes_back(channels, options):
    scene = make_scene("text", size=24, channels=channels)
    told = []
    reconstruct(
        scene.measurement,
        scene.calibration,
        iterations=10,
        on_stage=lambda share, what: told.append((share, what.split()[0].rstrip(":"))),
        **options,
    )
    assert all(a <= b for (a, _), (b, _) in pairwise(told))
    assert told[0][0] == 0
    assert told[-1] == (pytest.approx(1.0), "judged")
    stages = list(dict.fromkeys(word for _, word in told))
    usual = ["choosing", "solving", "iteration", "judging", "judged"]
    more = ["fitting", "choosing", "solving", "iteration", "uncertainty", "judging", "judged"]
    assert stages == (more if "refine_psf" in options else usual)


@pytest.mark.parametrize("prior", ["tv", "l1"])
def test_memory_is_said_before_the_first_iteration(prior):
    scene = make_scene("beads", size=24, depths=3)
    asked = {"model": "convolution", "prior": prior, "iterations": 2, "judged": False}
    said = []
    reconstruct(scene.measurement, scene.calibration, on_stage=lambda _, what: said.append(what), **asked)
    first = next(i for i, what in enumerate(said) if what.startswith("iteration 1,"))
    assert said[first - 1].startswith("solving: takes about ")
    assert said[first].endswith(said[first - 1].removeprefix("solving").removeprefix(": "))
    said.clear()
    one = replace(scene.calibration, psfs=scene.calibration.psfs[:1], source_positions_um=np.zeros((1, 3)))
    reconstruct(scene.measurement, one, on_stage=lambda _, what: said.append(what), **asked)
    assert any(what.startswith("solving: takes about ") for what in said), "of pictures as well"
    own = {**asked, "prior": L1(0.1)}
    said.clear()
    reconstruct(scene.measurement, one, on_stage=lambda _, what: said.append(what), **own)
    assert not any("memory" in what for what in said), "of others' priors it is not foreseen"


@pytest.mark.parametrize("channels", [1, 3])
def test_the_memory_of_pictures_is_foreseen(channels):
    """Within 10 % of what NumPy says it took at the peak."""
    rng = np.random.default_rng(0)
    psf = (rng.random((1, 1, 160, 160)) ** 30).astype(np.float32)
    light = np.stack([np.roll(psf[0, 0], 9 * c) for c in range(channels)], -1)
    asked = ReconstructionOptions(model="convolution", iterations=2, tolerance=0.0, judged=False)
    measurement = Measurement(rng.poisson(200 * light + 5).astype(np.float32))
    problem = Problem.of(measurement, Calibration(psf, np.zeros((1, 3))), asked)
    assert expected_bytes(problem) == pytest.approx(_peak(problem), rel=0.1)


@pytest.mark.parametrize(("prior", "planes"), [("tv", 1), ("l1", 1), ("tv", 3)])
def test_the_memory_of_varying_cameras_is_foreseen_and_refused_before_they_are_made(
    prior, planes, monkeypatch
):
    rng = np.random.default_rng(0)
    places = [(x, y, z) for z in 1e4 + 1e3 * np.arange(planes) for y in (-500, 500) for x in (-500, 500)]
    psfs = (rng.random((len(places), 1, 96, 96)) ** 30).astype(np.float32)
    asked = ReconstructionOptions(
        model="local", prior=prior, iterations=2, tolerance=0.0, judged=False, tau=0.01
    )
    photograph = rng.poisson(200 * psfs[0, 0] + 5).astype(np.float32)
    calibration = Calibration(psfs, np.array(places), geometry=Geometry(10.0, 5.0, None))
    problem = Problem.of(Measurement(photograph), calibration, asked)
    problem.levelled  # noqa: B018 - it is made once
    told = expected_bytes(problem)
    assert told == pytest.approx(_peak(problem), rel=0.1)
    little = replace(problem, options=replace(asked, memory_gib=0.5 * told / GIB))
    monkeypatch.setattr(PlacedStrip, "spectra", property(lambda _: pytest.fail("they were made")))
    with pytest.raises(NoMemoryError, match="The local model needs"):
        expected_bytes(little)


def _peak(problem):
    solve(problem)  # what is made once is there
    tracemalloc.start()
    solve(problem)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def test_the_plan_counts_what_solvers_of_volumes_take():
    """Within 10 % of what NumPy says it took at the peak, for two volumes of each prior."""
    rng = np.random.default_rng(0)
    for prior, planes in (("tv", 3), ("tv", 12), ("l1", 3), ("l1", 12)):
        psfs = (rng.random((planes, 1, 48, 48)) ** 30).astype(np.float32)
        places = np.stack([np.zeros(planes), np.zeros(planes), 1e4 + 1e3 * np.arange(planes)], 1)
        asked = ReconstructionOptions(
            model="convolution", prior=prior, iterations=3, tolerance=0.0, judged=False
        )
        photograph = rng.poisson(200 * psfs[1, 0] + 5).astype(np.float32)
        problem = Problem.of(Measurement(photograph), Calibration(psfs, places), asked)
        plan = volume_plan(problem)
        assert plan.total == pytest.approx(_peak(problem), rel=0.1), (prior, planes)


@pytest.mark.parametrize(
    ("part", "what"),
    [
        ("check_calibration", "The calibration was not checked"),
        ("lacking", "Whether the PSF lacks light that the picture needs was not looked at"),
    ],
)
def test_an_error_in_a_part_of_judging_leaves_the_verdict_and_says_which(monkeypatch, part, what):
    def broken(*_arguments, **_options):
        raise ZeroDivisionError("a decoy without light")

    monkeypatch.setattr(door, part, broken)
    scene = make_scene("text", size=24)
    result = reconstruct(scene.measurement, scene.calibration, iterations=5)
    assert result.verdict is not None
    assert f"{what}: a decoy without light" in result.warnings


def test_nor_does_it_keep_another_part_from_telling(monkeypatch):
    """A PSF over a broad hill was called reliable where its decoys could not be tried."""

    def broken(*_arguments, **_options):
        raise ZeroDivisionError("a decoy without light")

    asked = []
    monkeypatch.setattr(door, "check_calibration", broken)
    for part in ("lacking", "is_below_zero"):
        monkeypatch.setattr(door, part, lambda *_, part=part: asked.append(part))
    scene = make_scene("text", size=24)
    assert reconstruct(scene.measurement, scene.calibration, iterations=5).verdict is not None
    assert asked == ["lacking", "is_below_zero"]


def history(unrest, each_s=0.1, n=TOLD_AT):
    return [IterationRecord(k, each_s * k, change=unrest(k)) for k in range(1, n + 1)]


def test_iterations_are_foretold_by_how_fast_they_settle():
    options = ReconstructionOptions()
    slow, fast = history(lambda k: k**-1.5), history(lambda k: 0.6**k)
    assert 60 < expected_iterations(slow, options, 1e-3) <= 100  # a power: 100
    assert 13 <= expected_iterations(fast, options, 1e-3) < 30  # an exponential: 14
    assert expected_iterations(history(lambda k: 1.0 + k), options, 1e-3) == 200
    late = history(lambda k: k**-1.5, n=199), ReconstructionOptions(iterations=900)
    assert 350 < expected_iterations(*late, 1e-4) <= 464  # a power: 464
    assert expected_iterations(slow, options, 0.0) == 200
    assert expected_iterations(slow, ReconstructionOptions(iterations=20), 1e-9) == 20
    assert expected_iterations(slow, ReconstructionOptions(time_s=4.0), 0.0) == 40
    assert expected_iterations(slow, ReconstructionOptions(time_s=4.0), 0.0, runs=2) == 20
    assert expected_iterations(history(lambda k: 1e-9), options, 1e-3) == TOLD_AT
