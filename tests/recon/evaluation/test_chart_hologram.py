"""Charts of holograms: what runs, what is scored, what competes."""

from __future__ import annotations

import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.evaluation.chart_hologram import LIGHTS, HologramProblem, HologramSetting
from recon.evaluation.scored import KINDS, fronts
from recon.holography import Display, HologramModel, Target, compute_hologram, judge, random_mask

SLM = (24, 32)


def display(q: int) -> Display:
    k = round(q**0.5)
    return Display(SLM, random_mask((SLM[0] * k, SLM[1] * k), seed=q))


def picture(shape: tuple[int, int]) -> np.ndarray:
    y, x = (np.linspace(-1, 1, n) for n in shape)
    return 0.6 + 0.4 * np.cos(5 * x)[None] * np.cos(3 * y)[:, None]


@pytest.fixture
def problem() -> HologramProblem:
    displays = (display(4), display(16))
    targets = tuple((Target(picture(d.mask.shape), white=1.0),) for d in displays)
    return HologramProblem(displays, targets, frames=(1, 2))


def test_every_loss_method_expansion_and_number_of_frames_takes_part(problem):
    settings = problem.settings()
    assert len({s.name for s in settings}) == len(settings) == 2 * (2 * 4 + 3 + len(LIGHTS))
    assert {s.expansion for s in settings} == {4, 16}
    assert {s.loss for s in settings if s.method == "lbfgs"} == {"none", "frequency", "spatial"}
    assert settings[0].method == "one-step"
    for outside in (
        HologramSetting(36),
        HologramSetting(4, frames=3),
        HologramSetting(4, "one-step", "none"),
    ):
        with pytest.raises(InputError, match="does not apply"):
            problem.run(outside)


def test_a_complex_slm_trades_light_for_quality_and_competes_with_itself(problem):
    bright, dim = (problem.run(HologramSetting(16, light=light), counts=(40,)) for light in (LIGHTS[0], 0.1))
    assert dim.points[-1].psnr_db > bright.points[-1].psnr_db + 1
    assert bright.points[-1].group == "16x, complex SLM"


def test_a_score_is_that_of_the_plain_judge(problem):
    """The judge shares no code with the optimiser's model."""
    points = problem.run(HologramSetting(16, frames=2), counts=(1, 6)).points
    assert [p.iterations for p in points] == [1, 6]
    model = HologramModel(problem.displays[1], problem.targets[1], frames=2)
    found = compute_hologram(model, iterations=6, tolerance=0.0)
    scores = judge(found.slm, problem.displays[1], problem.targets[1][0])
    assert points[-1].psnr_db == pytest.approx(scores.psnr_db, abs=0.3)
    assert points[-1].middle_psnr_db == pytest.approx(scores.crop_psnr_db, abs=0.5)
    assert points[0].psnr_db < points[1].psnr_db
    assert points[1].group == "16x"


def test_scoring_takes_no_time_of_the_optimiser_and_happens_aside(problem):
    told = []

    @contextmanager
    def slow():
        told.append("in")
        time.sleep(0.3)
        yield
        told.append("out")

    problem.run(HologramSetting(4), counts=(1,))  # compiles, which may take many seconds
    began = time.perf_counter()
    points = problem.run(HologramSetting(4), aside=slow, counts=(1, 2)).points
    assert told == ["in", "out"] * 2
    # However slow the machine: what the optimiser took and both waits make no more than all.
    assert points[-1].seconds < time.perf_counter() - began - 0.6
    (one,) = problem.run(HologramSetting(4, "one-step")).points
    assert one.iterations == 0
    assert one.seconds > 0


def test_a_run_says_whether_time_cut_it_off(problem):
    assert not problem.run(HologramSetting(4), limit_s=1e-9, counts=(1, 50)).finished
    assert problem.run(HologramSetting(4, "nesterov", "none"), limit_s=100.0, counts=(1, 2)).finished


def test_expansions_do_not_compete(problem):
    points = [p for q in (4, 16) for p in problem.run(HologramSetting(q, "one-step"), counts=(1,)).points]
    assert {g: len(f) for g, f in fronts(points, KINDS["hologram"]).items()} == {"4x": 1, "16x": 1}


def test_problems_are_told_apart(problem):
    moved = replace(problem.targets[0][0], z_mm=3.0)
    others = [
        replace(problem, frames=(1,)),
        replace(problem, seed=1),
        replace(problem, targets=((moved,), problem.targets[1])),
        replace(problem, displays=(replace(problem.displays[0], mask_fill=0.9), problem.displays[1])),
        replace(problem, weights=np.ones((8, 8))),
    ]
    assert len({p.fingerprint() for p in (problem, *others)}) == 6
    assert replace(problem).fingerprint() == problem.fingerprint()
    with pytest.raises(InputError, match="different expansions"):
        replace(problem, displays=(problem.displays[0],) * 2)
