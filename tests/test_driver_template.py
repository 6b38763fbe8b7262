"""The driver to copy works as a package of its own: its tests pass, and the program finds and uses it."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[1]
PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A copy, and beside it what pip would write for its entry points."""
    folder = tmp_path / "my_stage"
    shutil.copytree(
        ROOT / "examples" / "driver_template", folder, ignore=shutil.ignore_patterns("__pycache__")
    )
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    info = folder / f"{project['name'].replace('-', '_')}-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = [
        line
        for group, points in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in points.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines))
    return folder


def run(package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        cwd=package,
        env=os.environ | {"PYTHONPATH": os.pathsep.join((str(package), str(ROOT)))},
        timeout=120,
        check=False,
    )


def test_its_own_tests_pass(package: Path) -> None:
    done = run(package, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", ".")
    assert done.returncode == 0, done.stdout
    assert "TestMyStage" not in done.stdout  # nothing failed
    assert int(done.stdout.split(" passed")[0].rsplit(maxsplit=1)[-1]) >= 15  # the contract ran


def test_a_broken_driver_fails_them(package: Path) -> None:
    """The contract would not notice nothing: a driver that clips its moves fails."""
    module = package / "my_stage.py"
    text = module.read_text()
    module.write_text(text.replace("round(position_um /", "round(0.9 * position_um /"))
    assert module.read_text() != text
    done = run(
        package, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "-k", "end_where", "."
    )
    assert done.returncode == 1
    assert "came to rest elsewhere: x_um" in done.stdout


@pytest.fixture
def emulator(package: Path) -> Iterator[Any]:
    spec = importlib.util.spec_from_file_location("my_stage_emulator", package / "my_stage_emulator.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    emulator = module.MyStageEmulator()
    yield emulator
    emulator.close()


def test_the_program_finds_and_uses_it(package: Path, emulator: Any) -> None:
    listed = run(package, "-c", PROGRAM, "drivers")
    assert "my_stage" in listed.stdout
    bench = package / "bench.toml"
    stage = f'[stage]\ndriver = "my_stage"\nport = "{emulator.port}"\n'
    bench.write_text(f'[camera]\ndriver = "simulated"\n[simulated]\npreset = "tiny"\n{stage}')
    checked = run(package, "-c", PROGRAM, "check", "--bench", "bench.toml")
    assert checked.returncode == 0, checked.stdout + checked.stderr
    assert "my stage" in checked.stdout
    assert "SN123" in checked.stdout
    bench.write_text(bench.read_text().replace("port =", "prot ="))
    refused = run(package, "-c", PROGRAM, "check", "--bench", "bench.toml")
    assert refused.returncode == 2
    assert "prot" in refused.stderr
    assert "Traceback" not in refused.stderr
