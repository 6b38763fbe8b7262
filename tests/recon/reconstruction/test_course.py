from __future__ import annotations

from itertools import pairwise

import pytest

from recon import reconstruct
from recon.evaluation.scene import make_scene
from recon.reconstruction import reconstruct as door
from recon.reconstruction.course import TOLD_AT, expected_iterations
from recon.reconstruction.options import ReconstructionOptions
from recon.solvers.base import IterationRecord


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
    usual = ["choosing", "iteration", "judging", "judged"]
    more = ["fitting", "choosing", "iteration", "uncertainty", "judging", "judged"]
    assert stages == (more if "refine_psf" in options else usual)


def test_an_error_in_the_check_of_the_calibration_leaves_the_verdict(monkeypatch):
    def broken(*_arguments, **_options):
        raise ZeroDivisionError("a decoy without light")

    monkeypatch.setattr(door, "check_calibration", broken)
    scene = make_scene("text", size=24)
    result = reconstruct(scene.measurement, scene.calibration, iterations=5)
    assert result.verdict is not None
    assert any("a decoy without light" in warning for warning in result.warnings)


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
