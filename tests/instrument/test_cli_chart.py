from __future__ import annotations

import json

import pytest
from typer.testing import CliRunner

from instrument.cli import chart as module
from recon import chart as recon_chart


@pytest.fixture
def quick(monkeypatch):
    """Two settings, in this process."""
    import instrument.chart_job as job

    settings = (
        recon_chart.Setting("wiener", "convolution", "none"),
        recon_chart.Setting("admm", "convolution", "tv"),
    )
    ran = []

    def here(problem, setting, limit_s):
        assert limit_s > 0
        ran.append(setting.name)
        return recon_chart.run_setting(problem, setting, counts=(2, 5))

    monkeypatch.setattr(job, "settings_for", lambda problem: settings)
    monkeypatch.setattr(job, "_in_own_process", here)
    return ran


def run(*arguments):
    return CliRunner().invoke(module.app, [str(a) for a in arguments])


def test_a_chart_is_written_and_gone_on_with(quick, tmp_path):
    out = tmp_path / "chart"
    result = run("--scene", "sparse-picture", "--size", 32, "--out", out)
    assert result.exit_code == 0, result.output
    assert "SIMULATED" in result.output
    assert "Pareto front" in result.output
    record = json.loads((out / "chart.json").read_text())
    assert [p["iterations"] for p in record["points"]] == [0, 2, 5]
    assert record["pareto"]
    assert record["about"]["scene"] == "sparse-picture"
    table = (out / "chart.csv").read_text().splitlines()
    assert len(table) == 4
    assert table[0].endswith(",pareto")
    page = (out / "chart.html").read_text()
    assert "admm convolution tv" in page
    assert "http://" not in page.replace("http://www.w3.org/2000/svg", "")
    assert (out / "chart.png").stat().st_size > 5000
    # Nothing is computed twice.
    assert quick == ["wiener convolution none", "admm convolution tv"]
    assert run("--scene", "sparse-picture", "--size", 32, "--out", out).exit_code == 0
    assert len(quick) == 2


@pytest.mark.usefixtures("quick")
def test_another_scene_does_not_mix_with_a_chart(tmp_path):
    assert run("--scene", "sparse-picture", "--size", 32, "--out", tmp_path).exit_code == 0
    other = run("--scene", "sparse-picture", "--size", 32, "--seed", 5, "--out", tmp_path)
    assert other.exit_code != 0
    assert "another photograph or calibration" in str(other.exception)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [((), "Give --scene"), (("--scene", "bead"), "not known"), (("--image", "x.tif"), "both")],
)
def test_mistakes_are_named(arguments, said, tmp_path):
    result = run(*arguments, "--out", tmp_path / "c")
    assert result.exit_code != 0
    assert said in str(result.exception)


def test_a_setting_runs_in_a_process_of_its_own():
    from instrument.chart_job import _in_own_process, problem_of_scene

    problem, _ = problem_of_scene("sparse-picture", 32, 0)
    found = _in_own_process(problem, recon_chart.Setting("wiener", "convolution", "none"), 20.0)
    assert not isinstance(found, str)
    assert found[0].peak_mib < 500
    refused = _in_own_process(problem, recon_chart.Setting("admm", "convolution", "tv-haar"), 20.0)
    assert isinstance(refused, str)
