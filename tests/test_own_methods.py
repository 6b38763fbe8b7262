"""Methods of a user's own, as a package: found in recon, terminal, window, chart and maps, and not judged."""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import setuptools

from recon.evaluation.scene import make_scene

ROOT = Path(__file__).parents[1]
EXAMPLE = ROOT / "examples" / "own_methods"
PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"


@dataclass(frozen=True)
class Fresh:
    """An environment of its own into which the package was installed, and a folder with a photograph."""

    python: Path
    folder: Path

    def run(self, *arguments: str) -> str:
        """Run Python there and return what it says."""
        env = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        done = subprocess.run(
            [self.python, *arguments],
            capture_output=True,
            text=True,
            cwd=self.folder,
            env=env | {"QT_QPA_PLATFORM": "offscreen"},
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr


def wheel_of(source: Path) -> Path:
    """Return what the package's build backend would make of it."""
    project = tomllib.loads((source / "pyproject.toml").read_text())["project"]
    stem = f"{project['name'].replace('-', '_')}-{project['version']}"
    points = project["entry-points"].items()
    about = {
        "METADATA": f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n",
        "WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        "entry_points.txt": "".join(
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in named.items())
            for group, named in points
        ),
    }
    wheel = source.parent / f"{stem}-py3-none-any.whl"
    with zipfile.ZipFile(wheel, "w") as archive:
        for module in source.glob("*.py"):
            archive.write(module, module.name)
        for name, text in about.items():
            archive.writestr(f"{stem}.dist-info/{name}", text)
        archive.writestr(f"{stem}.dist-info/RECORD", "".join(f"{n},,\n" for n in archive.namelist()))
    return wheel


@pytest.fixture(scope="module")
def fresh(tmp_path_factory: pytest.TempPathFactory) -> Fresh:
    """A new environment that borrows the libraries of this one, and pip installs the package: no network."""
    pytest.importorskip("pip", reason="pip installs the package")
    folder = tmp_path_factory.mktemp("fresh")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    asked = [python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    site = Path(subprocess.run(asked, capture_output=True, text=True, check=True).stdout.strip())
    libraries = dict.fromkeys(sysconfig.get_path(name) for name in ("purelib", "platlib"))
    (site / "borrowed.pth").write_text("\n".join([*libraries, str(ROOT)]) + "\n")
    source = folder / "source"
    shutil.copytree(EXAMPLE, source, ignore=shutil.ignore_patterns("__pycache__"))
    if tuple(map(int, setuptools.__version__.split(".")[:2])) < (70, 1):  # makes no wheels by itself
        source = wheel_of(source)
    install = ["install", "--no-deps", "--no-build-isolation", "--no-index", "--quiet", source]
    done = subprocess.run(
        [sys.executable, "-m", "pip", "--python", python, *install],
        capture_output=True,
        text=True,
        env={name: value for name, value in os.environ.items() if name != "PYTHONPATH"},
        timeout=300,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert (site / "own_prior.py").is_file()
    work = folder / "work"
    work.mkdir()
    scene = make_scene("sparse-picture", size=48)
    np.save(work / "photo.npy", scene.measurement)
    np.save(work / "psf.npy", scene.calibration.psfs[0, 0])
    return Fresh(python, work)


@pytest.mark.parametrize("name", [path.name for path in EXAMPLE.glob("*.py")])
def test_a_method_is_one_short_file(name: str) -> None:
    assert len((EXAMPLE / name).read_text().splitlines()) < 60


def test_the_terminal_offers_and_runs_them_and_says_that_they_are_not_judged(fresh: Fresh) -> None:
    words = fresh.run("-c", PROGRAM, "reconstruct", "--help")
    assert "colour-groups" in words
    assert "landweber" in words
    assert "vignetting" in words
    files = ["--psf", "psf.npy", "--image", "photo.npy", "--dark", "0", "--out", "own.tif"]
    asked = ["--solver", "landweber", "--prior", "colour-groups", "--iterations", "40"]
    said = fresh.run("-c", PROGRAM, "reconstruct", *files, *asked)
    assert "not judged: there are no known cases of the solver landweber" in said.lower().replace("\n", " ")
    assert (fresh.folder / "own.tif").exists()


def test_charts_and_maps_offer_them(fresh: Fresh) -> None:
    said = fresh.run("-c", PROGRAM, "stability", "--list")
    assert "landweber tv" in said
    assert "admm vignetting tv" in said
    assert "colour-groups of volumes" in said
    assert "admm vignetting tv" in said
    made = fresh.run("-c", PROGRAM, "stability", "light-points", "--method", "admm vignetting tv")
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
    assert fresh.run("-c", "\n".join(lines)).count("landweber convolution colour-groups") == 2


def test_the_window_offers_them(fresh: Fresh) -> None:
    pytest.importorskip("PySide6")
    lines = (
        "from PySide6.QtWidgets import QApplication, QComboBox",
        "app = QApplication([])",
        "from gui.forms.reconstruct import ReconstructForm",
        "from gui.panel import whole",
        "form = whole(ReconstructForm())",
        "boxes = form.findChildren(QComboBox)",
        "print({box.itemText(n) for box in boxes for n in range(box.count())})",
    )
    words = fresh.run("-c", "\n".join(lines))
    assert "'landweber'" in words
    assert "'colour-groups'" in words
    assert "'vignetting'" in words


def test_a_camera_model_is_used_by_every_solver(fresh: Fresh) -> None:
    """A photograph that fades towards the corners is explained by the camera that does."""
    lines = (
        "import numpy as np, recon",
        "from own_camera import CORNER",
        "from recon.evaluation.scene import make_scene",
        "scene = make_scene('sparse-picture', size=48)",
        "y, x = (np.linspace(-1, 1, n) for n in scene.measurement.shape)",
        "faded = scene.measurement * (1 - (1 - CORNER) * (y[:, None] ** 2 + x**2) / 2)",
        "models = ('vignetting', 'convolution')",
        "for solver in ('admm', 'fista', 'landweber'):",
        "    given = dict(estimate_background=False, solver=solver, prior='tv', iterations=60)",
        "    found = [recon.reconstruct(faded, scene.calibration, model=m, **given) for m in models]",
        "    rest = [f.history[-1].data_residual for f in found]",
        "    assert rest[0] < rest[1], (solver, rest)",
        "    assert 'camera model vignetting' in ' '.join(found[0].warnings), (solver, found[0].warnings)",
    )
    fresh.run("-c", "\n".join(lines))


def test_videos_take_them(fresh: Fresh) -> None:
    lines = (
        "import numpy as np",
        "from recon.evaluation.scene import make_scene",
        "from recon.streams.video import VideoSolver, stream_problem",
        "scene = make_scene('sparse-picture', size=48)",
        "for own in ({'solver': 'landweber'}, {'prior': 'colour-groups'}, {'model': 'vignetting'}):",
        "    video = VideoSolver(stream_problem(scene.measurement, scene.calibration, **own))",
        "    first, second = (video.next(scene.measurement) for _ in range(2))",
        "    assert np.isfinite(second).all() and second.max() > 0, own",
        "    print(video.problem.solver.name, video.problem.prior_name, video.problem.model)",
    )
    said = fresh.run("-c", "\n".join(lines)).splitlines()
    assert said[0].startswith("landweber tv")
    assert said[1].endswith("colour-groups convolution")
    assert said[2].endswith("vignetting")


def test_live_pictures_take_them(fresh: Fresh) -> None:
    lines = (
        "import time",
        "import numpy as np",
        "from recon.evaluation.scene import make_scene",
        "from recon.streams.live import LiveReconstructor",
        "scene = make_scene('sparse-picture', size=48)",
        "for own in ({'solver': 'landweber'}, {'prior': 'colour-groups'}, {'model': 'vignetting'}):",
        "    live = LiveReconstructor(scene.calibration, budget_ms=1000.0, **own)",
        "    until_s = time.monotonic() + 60",
        "    picture = live.feed(scene.measurement)",
        "    while not picture.total_iterations and time.monotonic() < until_s:",
        "        time.sleep(0.05)  # the solver is made in a thread beside the first pictures",
        "        picture = live.feed(scene.measurement)",
        "    assert picture.total_iterations > 0 and not live.warnings, (own, live.warnings)",
        "    assert np.isfinite(picture.image).all() and picture.image.max() > 0, own",
        "    print(picture.method)",
    )
    assert fresh.run("-c", "\n".join(lines)).split()[0] == "landweber"


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
