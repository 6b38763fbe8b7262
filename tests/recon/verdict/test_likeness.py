"""A reconstruction's place on a stability map: a cell's own evidence leads back to the cell."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from recon.verdict import likeness
from recon.verdict.cases import group_of, shipped_maps
from recon.verdict.chance import place_of
from recon.verdict.likeness import most_like


@pytest.mark.parametrize("name", ["light", "erasures", "light-volume"])
def test_a_cells_own_evidence_is_most_like_that_cell(name: str) -> None:
    record = shipped_maps()[name]
    method, cells = next((m, r) for m, r in record["methods"].items() if group_of(m) and r["evidence"])
    for cell in cells["evidence"][:: max(len(cells["evidence"]) // 5, 1)]:
        like = most_like(cell, method, record)
        assert like is not None
        assert (like.ix, like.iy) == (cell["ix"], cell["iy"]) or like.distance < 1e-6
        assert like.severity == pytest.approx(cell["severity"], rel=0.5) or like.distance < 1e-6


def test_less_light_is_found_where_there_is_less_and_other_methods_have_no_place() -> None:
    record = shipped_maps()["light"]
    cells = {(c["ix"], c["iy"]): c for c in record["methods"]["admm tv"]["evidence"]}
    bright = cells[6, 0]
    dim = {**bright, "signal": bright["signal"] / 30, "detail": bright["detail"] / 30}
    there, here = (most_like(one, "admm tv", record) for one in (dim, bright))
    assert there is not None
    assert here is not None
    assert (there.ix < here.ix) or (there.iy > here.iy)
    assert most_like(bright, "something of one's own", record) is None
    assert most_like({"signal": 1.0}, "admm tv", record) is None


FEATURES = ("detail", "grain", "load", "signal")
PRECISION = np.array([[2.0, 0.3, 0.5, 0.1], [0.3, 1.5, 0.2, 0.0], [0.5, 0.2, 3.0, 0.4], [0.1, 0.0, 0.4, 1.0]])
SPREAD = np.array([0.5, 2.0, 4.0, 0.25])


def told(detail: float, **changes: float) -> dict[str, float]:
    numbers = {"detail": detail, "signal": 8.0, "unexplained": 0.1, "edges": 0.06, "lit": 0.03, "load": 0.05}
    return {**numbers, **changes}


def a_map(**methods: list[dict[str, Any]]) -> dict[str, Any]:
    named = {name.replace("_", " "): {"evidence": cells} for name, cells in methods.items()}
    return {"methods": {**named, "admm l1": {}}}


def cell(ix: int, numbers: dict[str, float], severity: float = 0.5) -> dict[str, Any]:
    return {**numbers, "ix": ix, "iy": 10 + ix, "severity": severity}


@pytest.fixture(name="planted")
def _planted(monkeypatch: pytest.MonkeyPatch) -> None:
    chances: Any = type("Planted", (), {"features": FEATURES, "precision": PRECISION, "spread": SPREAD})
    monkeypatch.setattr(likeness, "shipped_chances", lambda: {"picture tv": chances})


@pytest.mark.usefixtures("planted")
def test_the_distance_is_in_the_scatter_of_all_cases() -> None:
    mine, other = told(10.0), told(14.0, load=0.2, signal=5.0, edges=0.05)
    found = most_like(mine, "admm tv", a_map(admm_tv=[cell(3, other, 1.5), cell(4, told(99.0))]))
    assert found is not None
    assert (found.method, found.ix, found.iy, found.severity) == ("admm tv", 3, 13, 1.5)
    step = (place_of(other, FEATURES) - place_of(mine, FEATURES)) / SPREAD
    assert found.distance == pytest.approx(np.sqrt(step @ PRECISION @ step))


@pytest.mark.usefixtures("planted")
def test_cells_that_tell_less_are_compared_in_what_both_tell_and_in_its_own_scatter() -> None:
    """The scatter of some features is that of all, but for the rows of the others: not their precision's."""
    less = {name: value for name, value in told(14.0).items() if name != "load"}
    mine = told(10.0, load=77.0)
    kept = [0, 1, 3]
    precision = np.linalg.inv(np.linalg.inv(PRECISION)[np.ix_(kept, kept)])
    names = tuple(FEATURES[k] for k in kept)
    step = (place_of(less, names) - place_of(mine, names)) / SPREAD[kept]
    for cells in ([cell(1, less)], [cell(1, less), cell(2, told(50.0))]):  # one that lacks it is enough
        found = most_like(mine, "admm tv", a_map(admm_tv=cells))
        assert found is not None
        assert found.ix == 1
        assert found.distance == pytest.approx(np.sqrt(step @ precision @ step))


@pytest.mark.usefixtures("planted")
def test_a_method_is_looked_for_in_its_own_cells_and_without_any_in_those_that_fail_alike() -> None:
    near, far = [cell(1, told(10.0))], [cell(2, told(20.0))]
    own = most_like(told(10.0), "admm tv", a_map(admm_tv=far, fista_tv=near))
    assert own is not None
    assert (own.method, own.ix) == ("admm tv", 2)
    for cells in (a_map(fista_tv=near), a_map(admm_tv=[], fista_tv=near)):
        others = most_like(told(11.0), "admm tv", cells)
        assert others is not None
        assert (others.method, others.ix) == ("fista tv", 1)
    assert most_like(told(10.0), "admm tv", a_map(admm_tv=[])) is None
    assert most_like(told(10.0), "admm tv", a_map(admm_l1=near)) is None, "it fails in another way"
    bare = {"signal": 8.0, "unexplained": 0.1, "edges": 0.06, "lit": 0.03}
    exact = most_like(bare, "admm tv", a_map(admm_tv=[cell(5, bare)]))
    assert exact is not None, "as much as is asked for"
    assert (exact.ix, exact.distance) == (5, 0)
    for name in bare:
        assert most_like({k: v for k, v in bare.items() if k != name}, "admm tv", a_map(admm_tv=near)) is None
