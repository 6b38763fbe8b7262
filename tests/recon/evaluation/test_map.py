"""Maps, their cells and boundaries, with a trial that costs nothing."""

from __future__ import annotations

import numpy as np
import pytest

from recon.camera.convolution import Convolution
from recon.errors import InputError
from recon.evaluation.map_trials import _OffBalance
from recon.evaluation.maps import MAPS, map_named, run_map
from recon.priors import NonNegativity, TotalVariation
from recon.solvers.sensor_admm import SensorAdmm
from recon.verdict.map import Cell, Failure, Stress, StressMap, Trial, boundary

X = Stress("light", "light", "electrons", (1, 10, 100, 1000), (1, 100), logarithmic=True)
Y = Stress("noise", "noise", "electrons", (1, 2, 4), (1, 4))


def fake(_method: str, x: float, y: float, _seed: int, _size: str) -> Trial:
    severity = 30 * y / x
    return Trial(severity / 10, {Failure.TRIVIAL: severity}, {"snr": x / y})


MAP = StressMap("fake", "Fake", "None.", X, Y, ("one", "two"), fake)


def test_every_cell_is_made_once_and_known_ones_are_left_out() -> None:
    cells = list(run_map(MAP, "full"))
    assert len({(c.method, c.ix, c.iy) for c in cells}) == len(cells) == 24
    assert list(run_map(MAP, "full", known=cells)) == []
    assert len(list(run_map(MAP, "full", methods=["two"], known=cells[:3]))) in (11, 10)
    assert len(list(run_map(MAP, "quick"))) == 8


def test_a_cell_survives_its_file() -> None:
    for cell in run_map(MAP, "quick"):
        assert Cell.from_json(cell.as_json()) == cell


def test_the_boundary_is_interpolated_where_the_severity_crosses_one() -> None:
    grid = np.empty((3, 4))
    for cell in run_map(MAP, "full", methods=["one"]):
        grid[cell.iy, cell.ix] = cell.severity
    # Severity 30 y / x is 1 at x = 30 y, exactly so on logarithmic axes.
    assert boundary(X.values, Y.values, grid, logarithmic=True) == [
        (pytest.approx(30 * y), y) for y in Y.values
    ]


def test_a_row_that_never_crosses_has_no_boundary_and_an_odd_cell_does_not_move_it() -> None:
    all_well = np.full((1, 4), 0.1)
    assert boundary(X.values, (1.0,), all_well, logarithmic=True) == []
    odd = np.array([[9.0, 0.9, 9.0, 9.0, 9.0, 0.5, 0.5, 0.5]])
    [(at, _)] = boundary(tuple(range(8)), (1.0,), odd, logarithmic=False)
    assert 4 < at < 5


def test_the_catalogue_is_in_order() -> None:
    for name, stress in MAPS.items():
        assert name == stress.name
        for axis in (stress.x, stress.y):
            for values in (axis.values, axis.quick):
                assert list(values) == sorted(set(values)), (name, axis.key)
                assert not axis.logarithmic or values[0] > 0
    with pytest.raises(InputError, match="no map"):
        map_named("nothing")


def test_penalties_off_balance_are_those_of_the_solver_times_a_factor() -> None:
    operator = Convolution(np.eye(8, dtype=np.float32)[None] / 3, (8, 8))
    data = np.random.default_rng(1).random((1, 8, 8)).astype(np.float32)
    prior = TotalVariation(0.1) + NonNegativity()
    own = SensorAdmm(operator, data, prior)._mu
    off = _OffBalance(operator, data, prior, 10.0)._mu
    np.testing.assert_allclose(off, 10 * own, rtol=1e-5)
