"""The parts of one's own calibrations that compete on one photograph."""

from __future__ import annotations

import numpy as np
import pytest

from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.own_calibrations import OwnCalibration, OwnCalibrationsProblem
from recon.types import Calibration


def own(label: str, grid: int, depths_um: list[float]) -> OwnCalibration:
    along = np.linspace(-500.0, 500.0, grid) if grid > 1 else [0.0]
    places = np.array([(x, y, z) for z in depths_um for y in along for x in along])
    psfs = np.ones((len(places), 1, 8, 8), np.float32)
    measurement = np.ones((8, 8), np.float32)
    return OwnCalibration(label, ChartProblem(measurement, Calibration(psfs, places), volume=True))


@pytest.mark.parametrize("depths", [1, 2, 3, 4])
@pytest.mark.parametrize(("grid", "known"), [(1, True), (3, True), (5, True), (1, False)])
def test_every_part_has_a_name_of_its_own(grid: int, known: bool, depths: int) -> None:
    depths_um = [2e4 + 1e4 * n if known else np.nan for n in range(depths)]
    problem = OwnCalibrationsProblem((own("a", grid, depths_um), own("b", 1, [3e4])))
    settings = problem.settings()
    assert len({s.members for s in settings if s.label == "a"}) == sum(s.label == "a" for s in settings)
    names = [s.name for s in settings]
    assert len(set(names)) == len(names)


def test_a_single_depth_is_said() -> None:
    problem = OwnCalibrationsProblem((own("a", 1, [2e4, 3e4]),))
    assert {s.name: s.members for s in problem.settings()} == {
        "a, 1 PSF at depth 1 of 2 (z 20 mm)": (0,),
        "a, 1 PSF at depth 2 of 2 (z 30 mm)": (1,),
        "a, 2 PSFs at 2 of 2 depths": (0, 1),
    }
