"""A reconstruction's place on a stability map: a cell's own evidence leads back to the cell."""

from __future__ import annotations

import pytest

from recon.verdict.cases import group_of, shipped_maps
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
