"""What Python on the pages imports exists: modules that are split or renamed take their pages with them."""

from __future__ import annotations

import ast
import importlib
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_house import PACKAGES

ROOT = Path(__file__).parents[1]
BLOCK = re.compile(r"^ *```python\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
PAGES = [
    page
    for page in (*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").rglob("*.md")))
    if "decisions" not in page.parts and BLOCK.search(page.read_text("utf-8"))
]


def imports(text: str) -> Iterator[tuple[str, str]]:
    """Yield module and name of each import from one of the packages; no name where all of it is meant."""
    for block in BLOCK.findall(text):
        for node in ast.walk(ast.parse(textwrap.dedent(block))):
            if isinstance(node, ast.ImportFrom) and node.module:
                asked = [(node.module, alias.name) for alias in node.names]
            elif isinstance(node, ast.Import):
                asked = [(alias.name, "") for alias in node.names]
            else:
                continue
            yield from (one for one in asked if one[0].split(".")[0] in PACKAGES)


def missing(module: str, name: str) -> str | None:
    """Return what cannot be imported, or None."""
    try:
        found = importlib.import_module(module)
        if name and not hasattr(found, name):
            importlib.import_module(f"{module}.{name}")
    except ModuleNotFoundError as error:
        return f"{module} {name}: {error}"
    return None


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_what_a_page_imports_exists(page: Path) -> None:
    asked = imports(page.read_text("utf-8"))
    assert [wrong for module, name in asked if (wrong := missing(module, name))] == []


def test_a_name_that_moved_is_noticed() -> None:
    page = "```python\nfrom calibration_routines.procedure import Routine, Listener\n```\n"
    assert [name for module, name in imports(page) if missing(module, name)] == ["Routine"]
