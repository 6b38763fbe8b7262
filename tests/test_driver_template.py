"""The drivers to copy work as packages of their own: tests pass, and the program finds and uses them."""

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
import tifffile

ROOT = Path(__file__).parents[1]
PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"


@pytest.fixture
def kind(request: pytest.FixtureRequest) -> str:
    """What is copied: the stage, but where a test asks for another."""
    return str(getattr(request, "param", "stage"))


@pytest.fixture
def package(tmp_path: Path, kind: str) -> Path:
    """A copy, and beside it what pip would write for its entry points."""
    folder = tmp_path / f"my_{kind}"
    shutil.copytree(
        ROOT / "examples" / f"{kind}_template", folder, ignore=shutil.ignore_patterns("__pycache__")
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
        env=os.environ
        | {
            "PYTHONPATH": os.pathsep.join((str(package), str(ROOT))),
            "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",  # napari's takes seconds
        },
        timeout=120,
        check=False,
    )


def own_tests(package: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return run(
        package, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "pytest_timeout", *arguments, "."
    )


@pytest.mark.parametrize("kind", ["stage", "camera"], indirect=True)
def test_its_own_tests_pass(package: Path) -> None:
    done = own_tests(package)
    assert done.returncode == 0, done.stdout
    assert int(done.stdout.split(" passed")[0].rsplit(maxsplit=1)[-1]) >= 15  # the contract ran


@pytest.mark.parametrize(
    ("kind", "right", "wrong", "name", "says"),
    [
        ("stage", "round(position_um /", "round(0.9 * position_um /", "end_where", "came to rest elsewhere"),
        ("camera", "round(200 * np", "round(100 * np", "gain", "gain"),
    ],
    indirect=["kind"],
)
def test_a_broken_driver_fails_them(package: Path, right: str, wrong: str, name: str, says: str) -> None:
    """The contract notices: a stage that ends short of its place, a camera with half its gain."""
    module = package / f"{package.name}.py"
    text = module.read_text()
    assert right in text
    module.write_text(text.replace(right, wrong))
    done = own_tests(package, "-k", name)
    assert done.returncode == 1
    assert says in done.stdout


@pytest.mark.parametrize("kind", ["camera"], indirect=True)
def test_the_program_finds_the_camera_and_photographs(package: Path) -> None:
    found = run(package, "-c", PROGRAM, "devices")
    lines = '[camera]\ndriver = "my_camera"\nserial_number = "MC100-0042"\n'
    assert all(line in found.stdout for line in lines.splitlines()), found.stdout + found.stderr
    (package / "bench.toml").write_text(lines)
    taken = run(package, "-c", PROGRAM, "snap", "--out", "photo.tif", "--as-is", "--bench", "bench.toml")
    assert taken.returncode == 0, taken.stdout + taken.stderr
    assert tifffile.imread(package / "photo.tif").shape == (120, 160)


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
