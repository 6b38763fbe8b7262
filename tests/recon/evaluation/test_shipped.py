"""The maps that come with the program are those of the catalogue, and explained."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from instrument.files.stability_file import read_stability
from recon.evaluation.maps import MAPS
from recon.verdict.cases import ALIKE, ALIKE_VOLUMES, DERIVED, GROUPS, OF_VOLUMES, cases_of, mixed_scenes
from recon.verdict.cases import SHIPPED as SHIPPED_FILE
from recon.verdict.evidence import Evidence
from recon.verdict.judge import FEWEST, STRESSES

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
    needed = {*ALIKE} - {*DERIVED, "ambiguity"} | {"lit", "edges", "ix", "iy", "severity"}
    wanted = {f.name for f in fields(Evidence)} | needed
    for method in shipped["methods"].values():
        assert all(v is not None for row in method["severity"] for v in row)
        assert all(needed <= set(entry) <= wanted for entry in method["evidence"])


@pytest.mark.parametrize("name", MAPS)
def test_every_map_is_explained_with_its_picture(name: str) -> None:
    page = (DOCS / "stability.md").read_text("utf-8")
    assert f"(images/stability/{name}.png)" in page
    assert (DOCS / "images" / "stability" / f"{name}.png").is_file()


def test_every_group_of_methods_has_cases_to_judge_by() -> None:
    for group in GROUPS:
        cases = cases_of(group)
        assert len(cases.severities) >= FEWEST
        assert 0.1 < (cases.severities >= 1).mean() < 0.9, group
    assert {*STRESSES} <= {*ALIKE_VOLUMES}


def test_mixed_scenes_hold_all_that_makes_cases_alike() -> None:
    scenes = mixed_scenes()
    assert {e["method"] for e in scenes} <= {m for methods in GROUPS.values() for m in methods}
    every = {f.name for f in fields(Evidence)}
    for entry in scenes:
        points = {*ALIKE_VOLUMES} - {*ALIKE, *DERIVED}
        assert set(entry["evidence"]) == (every if entry["method"].endswith(OF_VOLUMES) else every - points)
    # Regular lenslets, which no map has, and others.
    assert 0.2 < sum(e["evidence"]["ambiguity"] > 0.7 for e in scenes) / len(scenes) < 0.6
