"""Charts of calibrations: what is made of the photographs, and how it is judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from recon.errors import InputError
from recon.evaluation.chart_calibration import (
    FINE,
    SCENES,
    CalibrationProblem,
    CalibrationSetting,
    Photographed,
    Photographs,
    coarse,
)
from recon.evaluation.scored import KINDS, fronts
from recon.types import Geometry

SIZE, PITCH_UM, DISTANCE_MM, Z_UM = 40, 20.0, 2.0, 2000.0
DEPTHS_UM = (1600.0, 2000.0, 1 / (2 / 2000 - 1 / 1600))
SPOTS = np.random.default_rng(3).uniform(-9, 9, (6, 2))


def pattern(row: float, column: float, z_um: float, light: float = 1.0) -> np.ndarray:
    """What lenslets in front of a sensor make of a point: spots between pixels, that bend over the field."""
    spread = (1 + 1e3 * DISTANCE_MM / z_um) / 2
    y, x = np.mgrid[:SIZE, :SIZE] - SIZE // 2
    image = np.zeros((SIZE, SIZE))
    for k, (r, c) in enumerate(SPOTS):
        bend = 0.12 * (k % 3 - 1)
        at = (row * (1 + bend) + spread * r, column * (1 - bend) + spread * c)
        image += np.exp(-((y - at[0]) ** 2 + (x - at[1]) ** 2) / (2 * 0.8**2))
    return light * image * (Z_UM / z_um) ** 2


def taken(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    image = sum(pattern(*point) for point in points)
    return (image / image.max() + rng.normal(0, 0.01, image.shape)).astype(np.float32)


def scene(name: str, points: np.ndarray, rng: np.random.Generator) -> Photographed:
    truth = np.zeros((FINE * SIZE, FINE * SIZE), np.float32)
    for row, column, _, light in points:
        at = [round(FINE * v) + FINE * SIZE // 2 for v in (row, column)]
        truth[at[0], at[1]] += light
    return Photographed(name, taken(points, rng), truth)


@pytest.fixture(scope="module")
def problem() -> CalibrationProblem:
    rng = np.random.default_rng(0)
    along = np.round(np.linspace(-8, 8, 5))
    places = np.array([(r, c, z) for z in DEPTHS_UM for r in along for c in along])
    places = np.concatenate([places, [(0.0, 0.0, Z_UM)] * 8])

    def bead(z_um: float) -> tuple[float, float, float, float]:
        return (*rng.uniform(-8, 8, 2), z_um, rng.uniform(0.5, 1))

    return CalibrationProblem(
        Photographs(
            np.stack([taken(np.array([p]), rng) for p in places]),
            places,
            np.stack([taken(np.array([bead(Z_UM) for _ in range(8)]), rng) for _ in range(3)]),
            (
                scene(SCENES[0], np.array([bead(Z_UM) for _ in range(12)]), rng),
                scene(SCENES[1], np.array([bead(DEPTHS_UM[n % 3]) for n in range(9)]), rng),
            ),
            Z_UM,
            Geometry(PITCH_UM, DISTANCE_MM),
            25,
            0.4,
        )
    )


def test_settings_are_what_the_photographs_allow(problem):
    named = {s.name: s.images for s in problem.settings()}
    assert named == {
        "one PSF": 1, "one PSF, mean of 9": 9, "axial, 3 depths": 3, "3 x 3": 9, "5 x 5": 25,
        "3 x 3, 3 depths": 27, "5 x 5, 3 depths": 75, "blind, 3 slides": 3,
    }  # fmt: skip
    with pytest.raises(InputError, match="does not apply"):
        problem.run(CalibrationSetting(grid=7))


def test_more_places_help_where_psfs_vary_and_more_depths_where_beads_are(problem, monkeypatch):
    monkeypatch.setattr("recon.evaluation.chart_calibration.ITERATIONS", 40)
    scores = {}
    points = []
    for setting in problem.settings():
        if (not setting.slides and setting.images in (1, 3, 27)) or setting.name == "3 x 3":
            curve = problem.run(setting)
            assert curve.finished
            points += curve.points
            scores |= {(setting.name, p.group): p.psnr_db for p in curve.points}
    flat, deep = SCENES
    assert scores["3 x 3", flat] > scores["one PSF", flat] + 1
    assert scores["axial, 3 depths", flat] == pytest.approx(scores["one PSF", flat], abs=0.5)
    assert scores["axial, 3 depths", deep] > scores["one PSF", deep] + 0.5
    assert scores["3 x 3, 3 depths", deep] > max(scores["3 x 3", deep], scores["axial, 3 depths", deep])
    # Photographs are the cost, and each scene has a front of its own.
    front = fronts(points, KINDS["calibration"])
    assert set(front) == set(SCENES)
    assert [p.images for p in front[deep]] == sorted({p.images for p in front[deep]})
    assert front[deep][-1].setting == "3 x 3, 3 depths"


def test_a_blind_calibration_that_has_no_time_is_not_finished(problem):
    curve = problem.run(CalibrationSetting(slides=3), limit_s=1e-6)
    assert not curve.finished
    assert curve.points == ()


def test_the_judge_forgives_gain_and_shift_and_nothing_else(problem):
    seen = problem.photographs.scenes[0]
    for rows, columns in ((0, 0), (5, -5), (2, 11)):
        found = 7.0 * coarse(seen.truth, rows, columns)
        psnr_db, likeness, nrmse = problem.judged(found, seen)
        assert psnr_db > 100
        assert likeness > 0.999
        assert nrmse < 1e-4
    noisy = coarse(seen.truth, 0, 0) + np.random.default_rng(0).normal(0, 0.1, (SIZE, SIZE))
    assert problem.judged(noisy, seen)[0] == pytest.approx(20, abs=1)
    assert problem.judged(np.zeros((SIZE, SIZE)), seen)[2] == pytest.approx(1)


@pytest.mark.parametrize("size", [20, 21])
def test_the_axis_stays_where_it_is_in_coarse_pixels(size):
    truth = np.zeros((FINE * size, FINE * size), np.float32)
    truth[FINE * size // 2, FINE * size // 2] = 1
    assert np.argmax(coarse(truth, 0, 0)) == (size // 2) * size + size // 2
    assert np.argmax(coarse(truth, FINE, 0)) == (size // 2 + 1) * size + size // 2
    assert coarse(truth, 2, -2)[size // 2, size // 2] == 1


def test_problems_are_told_apart_and_warm_up_runs(problem):
    other = CalibrationProblem(replace(problem.photographs, reach=0.5))
    assert other.fingerprint() != problem.fingerprint()
    for setting in (CalibrationSetting(grid=3, depths=3), CalibrationSetting(slides=3)):
        problem.warm_up(setting)
