"""The sensor's angular response on the simulated bench, against the response that it was given."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from calibration_routines.optics import angular
from calibration_routines.optics.angular import (
    AngularProcedure,
    AngularSweep,
    check_angular,
    farthest_um,
)
from calibration_routines.optics.angular_response import AngularResponse, Curve, load_response
from calibration_routines.plan_procedures import lacks_result, unfinished, why_no_result
from drivers.simulated.world import SimulatedWorld
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.cli import main
from instrument.files.errors import BenchError, FileError
from instrument.runs.runner import RunStatus
from recon.optics.fall_off import gaussian_fall_off
from tests.mocks.listeners import Following

TINY = """
[camera]
driver = "simulated"
binning = 2
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[source]
rgb = [0, 255, 0]
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
fall_off = "gaussian"
fall_off_sigma_deg = 6
"""


@pytest.fixture
def bench() -> Iterator[Bench]:
    with open_bench(parse_config(TINY, None)) as opened:
        assert opened.stage is not None
        opened.stage.home()
        yield opened


@pytest.mark.parametrize("size_um", [100.0, 3000.0])
def test_a_source_that_is_wide_in_angle_is_said(tmp_path: Path, size_um: float) -> None:
    text = TINY.replace("[source]", f"[source]\nsize_um = {size_um}") + f"source_diameter_um = {size_um}\n"
    with open_bench(parse_config(text, None)) as bench:
        done = AngularProcedure(AngularSweep(80e3, 6.0, 3.0, average=1)).carry_out(bench, tmp_path)
    assert any("pinhole is 2.1 degrees wide" in line for line in done.verdict) == (size_um > 1000)


def test_the_response_and_its_cut_offs_are_the_sensors(bench: Bench, tmp_path: Path) -> None:
    done = AngularProcedure(AngularSweep(150e3, 14.0, 2.0, average=2)).carry_out(bench, tmp_path)
    response, file = done.result, done.files[0]
    assert isinstance(response, AngularResponse)
    world = bench.shared["simulated"]
    assert isinstance(world, SimulatedWorld)
    assert response.findings == ()
    assert response.simulated
    for curve, axis in ((response.along_x, 1), (response.along_y, 0)):
        tangents = np.tan(np.deg2rad(curve.angles_deg))
        zero = np.zeros_like(tangents)
        truth = world.fall_off(zero, tangents) if axis else world.fall_off(tangents, zero)
        assert np.abs(np.array(curve.response) - truth).max() < 0.02
        assert curve.cut_off_deg == pytest.approx(6 * np.sqrt(2 * np.log(5)), abs=0.1)
        assert min(curve.seen) < 0.5  # the sensor's edge cut patterns, and it made no difference
    loaded = load_response(file)
    assert loaded == response
    assert loaded.scatter.frames == 2
    tan_y, tan_x = (np.tan(np.deg2rad(v)) for v in np.meshgrid([-6.0, 0, 4], [-5.0, 0, 7], indexing="ij"))
    np.testing.assert_allclose(loaded.fall_off()(tan_y, tan_x), world.fall_off(tan_y, tan_x), atol=0.03)


def test_a_run_that_was_cut_off_is_resumed_to_its_response(
    bench: Bench, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    class Cut(BaseException):
        pass

    def cut(status: RunStatus) -> None:
        if status.done == 20:
            raise Cut

    with pytest.raises(Cut):
        AngularProcedure(AngularSweep(150e3, 12.0, 3.0, average=1)).carry_out(
            bench, tmp_path, listener=Following(cut)
        )
    (run,) = tmp_path.iterdir()
    bench.close()
    assert main(["resume", str(run)]) == 0
    assert "Cut-off along x" in capsys.readouterr().out
    assert load_response(run / "angular_response.json").along_x.cut_off_deg == pytest.approx(10.8, abs=0.5)
    assert (run / "angular_response.png").is_file()


def test_angles_from_which_no_light_meets_the_sensor_are_left_out(bench: Bench, tmp_path: Path) -> None:
    """The sweep as it is without options: far more angles than the sensor sees."""
    sweep = AngularSweep(farthest_um(bench, 45.0), 45.0, 5.0, average=1, dark_frames=1)
    response = AngularProcedure(sweep).carry_out(bench, tmp_path).result
    assert isinstance(response, AngularResponse)
    for curve in (response.along_x, response.along_y):
        assert len(curve.angles_deg) >= 4
        assert max(np.abs(curve.angles_deg)) < 30
        truth = np.exp(-(np.square(curve.angles_deg)) / 2 / 6**2)
        np.testing.assert_allclose(curve.response, truth, atol=0.05)


def test_a_run_whose_frames_give_no_response_is_not_offered_to_go_on_with(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(angular, "pattern_ends_deg", lambda _: None)  # of an aperture that is not known
    with pytest.raises(BenchError, match="Only 2 angles along x could be measured"):
        AngularProcedure(AngularSweep(80e3, 34.0, 17.0, average=1)).carry_out(bench, tmp_path)
    (run,) = tmp_path.iterdir()
    assert lacks_result(run)
    assert unfinished(run) is None
    assert "Only 2 angles" in why_no_result(run)


def test_an_angle_out_of_reach_is_refused_before_anything_moves(bench: Bench) -> None:
    assert farthest_um(bench, 45.0) == pytest.approx(0.98 * 60e3)
    assert farthest_um(bench, 5.0) == pytest.approx(300e3)
    with pytest.raises(BenchError, match="out of its reach"):
        farthest_um(bench, 83.0)
    with pytest.raises(BenchError, match="step <= largest"):
        AngularSweep(1e5, 10.0, 20.0)
    with pytest.raises(BenchError, match=r"\+-250 mm, outside .* choose --largest 13 at most"):
        check_angular(bench, AngularSweep(250e3))
    with pytest.raises(BenchError, match="outside the stage's limits 8 to 300 mm"):
        check_angular(bench, AngularSweep(400e3, 5.0))
    with pytest.raises(BenchError, match=r"up to 12 along x are fewer than 2: .* of 6 degrees at most"):
        check_angular(bench, AngularSweep(150e3, 12.0, 10.0))


def test_curves_between_the_axes_follow_a_gaussian_of_two_widths() -> None:
    angles = tuple(range(-40, 41, 4))
    truth = gaussian_fall_off(10.0, 20.0)

    def curve(sigma: float) -> Curve:
        values = tuple(float(np.exp(-0.5 * (a / sigma) ** 2)) for a in angles)
        return Curve(tuple(map(float, angles)), values, (1.0,) * len(angles))

    fitted = AngularResponse(curve(20.0), curve(10.0)).fall_off()
    y, x = np.meshgrid(*2 * [np.tan(np.deg2rad(np.arange(-20, 21, 5.0)))], indexing="ij")
    np.testing.assert_allclose(fitted(y, x), truth(y, x), atol=0.02)


def test_a_cut_off_that_was_not_reached_is_none() -> None:
    curve = Curve((-10.0, -5.0, 0.0, 5.0, 10.0), (0.1, 0.5, 1.0, 0.6, 0.4), (1.0,) * 5)
    assert curve.cut_offs_deg() == (pytest.approx(np.sqrt(25 + 75 * np.log(2.5) / np.log(5))), None)
    assert curve.cut_off_deg == curve.cut_offs_deg()[0]


def test_a_file_that_is_no_response_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text('{"format": "else"}')
    for name in ("a.json", "missing.json"):
        with pytest.raises(FileError, match=name):
            load_response(tmp_path / name)
