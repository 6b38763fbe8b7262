"""The tutorials' code runs as it stands."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from recon.priors import PRIORS

TUTORIALS = sorted((Path(__file__).parents[1] / "docs" / "tutorials").glob("*.md"))


QUICK_BENCH = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
time_scale = 0
scene_rgb = [0, 1, 0]
scene_height_mm = 100
"""
"""The built-in bench without its waiting, in one colour, with a smaller picture: seconds, not a minute."""


def code_of(page: Path) -> str:
    """Return a page's Python blocks as one program, each on the lines where it stands."""
    program: list[str] = []
    inside = False
    for line in page.read_text(encoding="utf-8").splitlines():
        if re.match(r"```python$", line):
            inside, line = True, ""
        elif line.startswith("```"):
            inside = False
        program.append(line if inside else "")
    return "\n".join(program)


def test_there_are_tutorials() -> None:
    assert TUTORIALS


@pytest.mark.slow
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_code_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    assert "tv" in PRIORS  # what is installed is known now: what a page registers goes again
    monkeypatch.setattr(PRIORS, "_foreign", dict(PRIORS._foreign))
    (tmp_path / "bench.toml").write_text(QUICK_BENCH)
    namespace: dict[str, object] = {}
    exec(compile(code_of(page), str(page), "exec"), namespace)
    assert namespace, "the page has no code"
