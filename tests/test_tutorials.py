"""The tutorials run as they stand, and their notebooks hold what they say and show now."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from recon.priors import PRIORS
from tests.tutorials import PAGES, carried_out, cells_of, differences, notebook_of


def code_of(page: Path) -> str:
    """Return a page's Python blocks as one program."""
    return "\n".join(text for kind, text in cells_of(page) if kind == "code")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_notebook_says_what_the_page_does(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("IPython", reason="carries notebooks out; in the extra dev")
    monkeypatch.setenv("IPYTHONDIR", str(tmp_path / "ipython"))
    (tmp_path / "work").mkdir()
    assert "tv" in PRIORS  # what is installed is known now: what a page registers goes again
    monkeypatch.setattr(PRIORS, "_foreign", dict(PRIORS._foreign))
    kept = json.loads(page.with_suffix(".ipynb").read_text("utf-8"))
    cells = cells_of(page)
    renew = f"python -m tests.tutorials {page.stem}  makes it anew"
    outputs = [cell["outputs"] for cell in kept["cells"] if cell["cell_type"] == "code"]
    assert notebook_of(cells, outputs) == kept, renew
    codes = [text for kind, text in cells if kind == "code"]
    wrong = [
        said
        for code, before, now in zip(codes, outputs, carried_out(cells, tmp_path / "work"), strict=True)
        for said in differences(code, before, now)
    ]
    assert not wrong, "\n".join([*wrong, renew])


def test_what_differs_is_noticed() -> None:
    def told(text: str) -> list[dict[str, str]]:
        return [{"output_type": "stream", "name": "stdout", "text": text}]

    assert not differences("", told("32.1 dB in 3.1 s"), told("32.2 dB in 7.5 s"))
    assert differences("", told("32.1 dB"), told("27.1 dB"))
    assert differences("", told("reliable"), told("doubtful"))
    assert differences("", told("reliable"), [])
    assert not differences("# differs from run to run", told("reliable"), told("doubtful"))


def test_every_page_is_linked_with_its_notebook() -> None:
    begin = (PAGES[0].parents[1] / "README.md").read_text("utf-8")
    for page in PAGES:
        assert re.search(rf"\({page.stem}\.ipynb\)", page.read_text("utf-8")), page
        assert f"tutorials/{page.name}" in begin, f"{page.name} is not in docs/README.md"
