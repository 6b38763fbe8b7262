"""Methods of a user's own, as a package: found in recon, terminal, window, chart and maps, and not judged."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest

from recon.evaluation.scene import make_scene

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "own_methods"
PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy, and beside it what pip would write for its entry points; a photograph with its PSF."""
    folder = tmp_path_factory.mktemp("own") / "own_methods"
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns("__pycache__"))
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
    scene = make_scene("sparse-picture", size=48)
    np.save(folder / "photo.npy", scene.measurement)
    np.save(folder / "psf.npy", scene.calibration.psfs[0, 0])
    return folder


def run(package: Path, *arguments: str) -> str:
    """Run Python in a process of its own that has the package, and return what it says."""
    done = subprocess.run(
        [sys.executable, *arguments],
        capture_output=True,
        text=True,
        cwd=package,
        env=os.environ
        | {"PYTHONPATH": os.pathsep.join((str(package), str(ROOT))), "QT_QPA_PLATFORM": "offscreen"},
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("name", [path.name for path in EXAMPLE.glob("*.py")])
def test_a_method_is_one_short_file(name: str) -> None:
    assert len((EXAMPLE / name).read_text().splitlines()) < 60


def test_the_terminal_offers_and_runs_them_and_says_that_they_are_not_judged(package: Path) -> None:
    words = run(package, "-c", PROGRAM, "reconstruct", "--help")
    assert "colour-groups" in words
    assert "landweber" in words
    assert "vignetting" in words
    files = ["--psf", "psf.npy", "--image", "photo.npy", "--dark", "0", "--out", "own.tif"]
    asked = ["--solver", "landweber", "--prior", "colour-groups", "--iterations", "40"]
    said = run(package, "-c", PROGRAM, "reconstruct", *files, *asked)
    assert "not judged: there are no known cases of the solver landweber" in said.lower().replace("\n", " ")
    assert (package / "own.tif").exists()


def test_charts_and_maps_offer_them(package: Path) -> None:
    said = run(package, "-c", PROGRAM, "stability", "--list")
    assert "landweber tv" in said
    assert "colour-groups of volumes" in said
    assert "admm vignetting tv" in said
    made = run(package, "-c", PROGRAM, "stability", "light-points", "--method", "admm vignetting tv")
    assert "of 12 cells fail" in made
    lines = (
        "from recon.evaluation.chart_reconstruction import ChartProblem",
        "from recon.evaluation.scene import make_scene",
        "for family in ('sparse-picture', 'beads'):",
        "    scene = make_scene(family, size=32)",
        "    problem = ChartProblem(scene.measurement, scene.calibration, not scene.spec.is_picture)",
        "    setting = next(s for s in problem.settings()",
        "                   if (s.solver, s.prior, s.binning) == ('landweber', 'colour-groups', 1))",
        "    points = problem.run(setting, counts=(3, 40)).points",
        "    assert points[1].held_out < points[0].held_out, points",
        "    print(setting.name)",
        "    assert any(s.model == 'vignetting' for s in problem.settings())",
    )
    assert run(package, "-c", "\n".join(lines)).count("landweber convolution colour-groups") == 2


def test_the_window_offers_them(package: Path) -> None:
    pytest.importorskip("PySide6")
    lines = (
        "from PySide6.QtWidgets import QApplication, QComboBox",
        "app = QApplication([])",
        "from gui.forms.reconstruct import ReconstructForm",
        "form = ReconstructForm()",
        "boxes = form.findChildren(QComboBox)",
        "print({box.itemText(n) for box in boxes for n in range(box.count())})",
    )
    words = run(package, "-c", "\n".join(lines))
    assert "'landweber'" in words
    assert "'colour-groups'" in words
    assert "'vignetting'" in words


@pytest.mark.parametrize("solver", ["admm", "fista", "landweber"])
def test_a_camera_model_is_used_by_every_solver(package: Path, solver: str) -> None:
    """A photograph that fades towards the corners is explained by the camera that does."""
    lines = (
        "import numpy as np, recon",
        "from own_camera import CORNER",
        "from recon.evaluation.scene import make_scene",
        "scene = make_scene('sparse-picture', size=48)",
        "y, x = (np.linspace(-1, 1, n) for n in scene.measurement.shape)",
        "faded = scene.measurement * (1 - (1 - CORNER) * (y[:, None] ** 2 + x**2) / 2)",
        f"given = dict(solver={solver!r}, prior='tv', iterations=60)",
        "models = ('vignetting', 'convolution')",
        "found = [recon.reconstruct(faded, scene.calibration, model=m, **given) for m in models]",
        "rest = [f.history[-1].data_residual for f in found]",
        "assert rest[0] < rest[1], rest",
        "assert 'camera model vignetting' in ' '.join(found[0].warnings), found[0].warnings",
    )
    run(package, "-c", "\n".join(lines))


def test_the_prox_is_that_of_the_value() -> None:
    spec = importlib.util.spec_from_file_location("own_prior", EXAMPLE / "own_prior.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    prior = module.ColourGroups(0.7)
    rng = np.random.default_rng(0)
    x, step = rng.normal(size=(3, 4, 5)), 0.6
    found = prior.prox(x, step)
    least = step * prior.value(found) + 0.5 * np.sum((found - x) ** 2)
    for size in (1e-3, 1e-1):
        for _ in range(50):
            other = np.maximum(found + size * rng.normal(size=x.shape), 0)
            assert step * prior.value(other) + 0.5 * np.sum((other - x) ** 2) >= least - 1e-12
