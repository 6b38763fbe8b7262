"""``diffuserbench analyze`` from the command line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from calibration_routines.optics.angular_response import AngularResponse, Curve, save_response
from drivers.simulated.options import WorldOptions
from drivers.simulated.world import SimulatedWorld
from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from recon.analysis.resolution import gaussian_response, lateral_spacing_um
from recon.types import Calibration, Geometry


@pytest.fixture(scope="module")
def calibration(tmp_path_factory: pytest.TempPathFactory) -> Path:
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    z_um = [25e3, 32e3, 45e3]
    psfs = np.stack([world.psf((0.0, 0.0, z), (0.0, 1.0, 0.0)) for z in z_um])[:, None]
    return save_calibration(
        Calibration(
            psfs,
            np.array([(0.0, 0.0, z) for z in z_um]),
            geometry=world.geometry,
            provenance={"simulated": True},
        ),
        tmp_path_factory.mktemp("analyze") / "calibration",
    )


def test_a_page_and_its_figures(
    calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "page.png"
    words = ["analyze", str(calibration), "--out", str(out), "--no-points", "--cutoff-deg", "41.5,30"]
    assert main(words) == 0
    assert out.stat().st_size > 50_000
    record = json.loads((tmp_path / "page.json").read_text())
    assert record["simulated"] is True
    found = record["analysis"]
    # The small sensor, not its pixels, limits the view: (240 x 13 um + 1.5 mm) / 2 over 8.9 mm.
    assert found["view_y"]["half_deg"] == pytest.approx(0.5 + np.rad2deg(np.arctan(2.31 / 8.9)), abs=0.6)
    assert found["view_x"]["cutoff_deg"] == 41.5
    assert found["lateral_spacing_um"] > 0
    assert found["points"] is None
    said = capsys.readouterr()
    assert "SIMULATED" in said.out
    assert "hyperfocal distance" in said.out
    assert "One place of the field" in said.err


def test_the_depth_is_one_about_which_depth_can_be_tested(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """At the middle in 1/z, 92 mm, planes along the axis would reach beyond infinity: not so at 60 mm."""
    world = SimulatedWorld(WorldOptions(preset="tiny", time_scale=0.0))
    z_um = [60e3, 92e3, 200e3]
    psfs = np.stack([world.psf((0.0, 0.0, z), (0.0, 1.0, 0.0), 2) for z in z_um])[:, None]
    geometry = replace(world.geometry, pixel_pitch_um=26.0)
    places = np.array([(0.0, 0.0, z) for z in z_um])
    made = save_calibration(Calibration(psfs, places, geometry=geometry), tmp_path / "far")
    out = tmp_path / "page.png"
    assert main(["analyze", str(made), "--out", str(out), "--no-points"]) == 0
    said = capsys.readouterr()
    assert "Analysed at 60 mm, not at 92 mm, nearest to the middle of the range" in said.err
    found = json.loads((tmp_path / "page.json").read_text())["analysis"]
    assert found["z_um"] == 60e3
    assert {curve["direction"] for curve in found["condition"]} == {"x", "z", "xz"}
    assert main(["analyze", str(made), "--out", str(out), "--no-points", "--z-mm", "92", "--force"]) == 0
    assert "Analysed at" not in capsys.readouterr().err


def test_a_measured_angular_response_limits_the_view(calibration: Path, tmp_path: Path) -> None:
    angles = tuple(float(a) for a in range(-20, 21, 2))
    narrow, wide = (
        Curve(angles, tuple(float(np.exp(-0.5 * (a / sigma) ** 2)) for a in angles), (1.0,) * len(angles))
        for sigma in (6.0, 9.0)
    )
    file = save_response(AngularResponse(narrow, wide), tmp_path / "response.json")
    out = tmp_path / "page.pdf"
    words = ["analyze", str(calibration), "--no-points", "--response", str(file), "--out", str(out)]
    assert main(words) == 0
    found = json.loads((tmp_path / "page.json").read_text())["analysis"]
    assert found["view_x"]["half_deg"] == pytest.approx(0.5 + 6 * np.sqrt(2 * np.log(5)), abs=0.2)
    assert found["lateral_spacing_um"] == pytest.approx(
        lateral_spacing_um(gaussian_response(6.0), 25e3), rel=0.1
    )
    assert main([*words, "--force", "--cutoff-deg", "30"]) == 2


@pytest.mark.parametrize(
    ("words", "part"),
    [
        (["--out", "page.txt"], ".pdf"),
        (["--cutoff-deg", "95"], "between 0 and 90"),
        (["--cutoff-deg", "a,b"], "41.5,30"),
        (["--z-mm", "-3"], "above 0"),
    ],
)
def test_mistakes_are_named_before_any_work(
    words: list[str], part: str, calibration: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["analyze", str(calibration), *words]) == 2
    assert part in capsys.readouterr().err


def test_a_calibration_without_geometry_says_what_is_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    psf = np.random.default_rng(0).random((1, 1, 20, 20)).astype(np.float32)
    folder = save_calibration(
        Calibration(psf, np.array([(0.0, 0.0, 1e4)]), geometry=Geometry()), tmp_path / "c"
    )
    assert main(["analyze", str(folder), "--out", str(tmp_path / "a.png")]) == 2
    assert "diffuser_distance_mm" in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()
    assert main(["analyze", str(tmp_path / "nothing")]) == 2
