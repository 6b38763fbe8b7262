"""The lines for bench.toml on the devices' pages are understood as they stand."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from instrument.bench.config_file import parse_config

PAGES = sorted((Path(__file__).parents[1] / "docs" / "how-to" / "devices").glob("*.md"))
CAMERA = '[camera]\ndriver = "simulated"\n'


def blocks(page: Path) -> list[str]:
    """The tables of bench.toml on a page; a block that begins with none goes on with the one before."""
    found: list[str] = []
    for block in re.findall(r"^ *```toml\n(.*?)^ *```", page.read_text("utf-8"), re.MULTILINE | re.DOTALL):
        if found and not re.match(r"\s*(#.*\n\s*)*\[", block):
            found[-1] += block
        else:
            found.append(block)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_lines_for_bench_toml_are_understood(page: Path) -> None:
    tables = blocks(page)
    assert tables, "a page about a device shows its lines for bench.toml"
    for table in tables:
        parse_config(table if "[camera]" in table else table + CAMERA, None)
