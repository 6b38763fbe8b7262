"""Options declared once: mistakes, records, expressions, overrides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from recon.base.as_python import expression
from recon.base.declare import changed, mistakes, option, options_of, record, with_overrides
from recon.base.option_text import command_line, shown
from recon.camera.grid import FAR_UM
from recon.errors import InputError
from recon.reconstruction.options import ReconstructionOptions


@dataclass(frozen=True, kw_only=True)
class Some:
    count: int | None = option(None, help="How many.", least=1)
    kind: str = option("plain", help="Which.", choices=lambda: ("plain", "fancy"))
    z_um: float | None = option(None, help="Where.", unit="um", shown_unit="mm", shown_factor=1000.0, above=0)
    here: bool = option(True, help="Only here.", recorded=False)


def test_all_mistakes_are_named_at_once() -> None:
    found = mistakes(Some(count=0, kind="fancie", z_um=float("nan")))
    assert found == [
        "count must be a whole number, 1 or more, not 0.",
        "kind must be one of plain, fancy, not 'fancie'. Did you mean 'fancy'?",
        "z_um must be a number, above 0 (um), not nan.",
    ]
    assert mistakes(Some(count=2, kind="fancy", z_um=1)) == []
    assert mistakes(Some(count=True)) != []
    found = mistakes(Some(count=np.array([1, 2]), z_um=np.array([1.0, 2.0])))  # type: ignore[arg-type]
    assert [one.split(", not ")[0] for one in found] == [
        "count must be a whole number, 1 or more",
        "z_um must be a number, above 0 (um)",
    ]


def test_infinity_is_recorded_as_what_it_stands_for() -> None:
    assert record(ReconstructionOptions(z_um=float("inf")))["z_um"] == FAR_UM


def test_what_differs_from_the_defaults_is_recorded_and_said() -> None:
    given = Some(count=3, here=False)
    assert record(given) == {"count": 3, "kind": "plain", "z_um": None}
    assert expression(given) == "Some(count=3, here=False)"
    assert [o.name for o, _ in changed(given)] == ["count", "here"]
    assert eval(expression(given), {"Some": Some}) == given


def test_labels_have_the_unit_that_people_read() -> None:
    assert [o.label for o in options_of(Some)] == ["Count", "Kind", "Z (mm)", "Here"]


def test_whole_numbers_are_typed_whole() -> None:
    assert command_line("some", Some(count=123_456_789)).endswith("--count 123456789")  # was 1.23457e+08
    count = options_of(Some)[0]
    assert shown(count, (30_000, 1e6, 1e7, 0.25)) == "30000 1000000 10000000 0.25"
    assert shown(count, 1e15) == "1e+15"


def test_an_unknown_override_is_refused_with_the_nearest_name() -> None:
    with pytest.raises(InputError, match=r"no option .cuont.\. Did you mean .count."):
        with_overrides(Some(), {"cuont": 1})
    assert with_overrides(Some(), {"count": 1}) == Some(count=1)
