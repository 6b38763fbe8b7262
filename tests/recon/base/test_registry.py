"""What is registered under a name, by the project, a program and an installed package."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from recon.base.registry import Registry
from recon.errors import InputError


@dataclass(frozen=True)
class Thing:
    """Something with a name."""

    name: str
    help: str = "A thing."


def _things() -> Registry[Thing]:
    return Registry("thing", "tests.things", lambda: [Thing("cup"), Thing("spoon")])


def test_own_things_come_first_and_others_can_be_told_from_them() -> None:
    things = _things()
    fork = things.register(Thing("fork"))
    assert things.names() == ("cup", "spoon", "fork")
    assert things.named("fork") is fork
    assert things.is_own("cup")
    assert not things.is_own("fork")


def test_a_name_that_nobody_has_is_answered_with_those_that_there_are() -> None:
    with pytest.raises(InputError, match=r"thing 'spon' is not known.*cup, spoon.*mean 'spoon'"):
        _things().named("spon")
    with pytest.raises(InputError, match="'cup' already"):
        _things().register(Thing("cup"))


def test_an_installed_package_adds_things_and_a_broken_one_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "drawer.py").write_text(
        "from types import SimpleNamespace as N\nknife = N(name='knife', help='Cuts.')\n"
        "cup = N(name='cup', help='Another.')\n"
    )
    info = tmp_path / "drawer-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: drawer\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[tests.things]\nknife = drawer:knife\nwhisk = drawer:whisk\ncup = drawer:cup\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    things = _things()
    assert things.names() == ("cup", "spoon", "knife")
    assert not things.is_own("knife")
    assert things.named("cup").help == "A thing."
    with pytest.raises(InputError, match=r"'whisk' of the installed package 'drawer' cannot be loaded"):
        things.named("whisk")
    monkeypatch.delitem(sys.modules, "drawer")
