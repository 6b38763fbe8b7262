from __future__ import annotations

from itertools import pairwise

import pytest

from recon import reconstruct
from recon.evaluation.scene import make_scene
from recon.reconstruction import reconstruct as door


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
