"""The maps that come with the program are those of the catalogue, and explained."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from instrument.files.stability_file import read_stability
from recon.evaluation.maps import MAPS
from recon.verdict.cases import GROUPS
from recon.verdict.cases import SHIPPED as SHIPPED_FILE
from recon.verdict.chance import DERIVED, FEATURES, FEATURES_OF_VOLUMES, HIGHEST, shipped_chances
from recon.verdict.evidence import Evidence
from recon.verdict.judge import LOST, STRESSES

DOCS = Path(__file__).parents[3] / "docs"
SHIPPED = read_stability(SHIPPED_FILE)["maps"]


def test_every_map_of_the_catalogue_is_shipped() -> None:
    assert set(SHIPPED) == set(MAPS)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_shipped_map_is_whole_and_was_made_with_these_axes(name: str) -> None:
    shipped, stress = SHIPPED[name], MAPS[name]
    for key, axis in (("x", stress.x), ("y", stress.y)):
        assert tuple(shipped[key]["values"]) == axis.at(shipped["size"])
    assert list(shipped["methods"]) == list(stress.methods)
    needed = {*FEATURES} - {*DERIVED, "ambiguity"} | {"unsettled", "ix", "iy", "severity"}
    wanted = {f.name for f in fields(Evidence)} | needed
    for method in shipped["methods"].values():
        assert all(v is not None for row in method["severity"] for v in row)
        assert all(needed <= set(entry) <= wanted for entry in method["evidence"])


@pytest.mark.parametrize("name", MAPS)
def test_every_map_is_explained_with_its_picture(name: str) -> None:
    page = (DOCS / "stability.md").read_text("utf-8")
    assert f"(images/stability/{name}.png)" in page
    assert (DOCS / "images" / "stability" / f"{name}.png").is_file()


def test_every_group_of_methods_can_be_judged() -> None:
    assert set(shipped_chances()) == set(GROUPS)
    for group, chances in shipped_chances().items():
        assert chances.features == (FEATURES_OF_VOLUMES if group.startswith("volume") else FEATURES)
        assert chances.n_cases >= 150
        assert 0 < chances.reliable <= HIGHEST
        assert float(chances.chance(chances.typical)) < LOST, group
    assert {*STRESSES} - {"unsettled"} <= {*FEATURES_OF_VOLUMES}
