"""The response over the field: fitted to what sources off the axis send, refused where it cannot be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from calibration_routines import CalibrationError, Listener, photograph
from calibration_routines.optics.field_response import (
    field_response_of,
    fit_field_response,
    measure_field_response,
)
from calibration_routines.plan_procedures import ResumeProcedure
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.plan import PlanError
from recon.errors import InputError

PLACES = [(0.0, 0.0, 1e5), (3e4, 0.0, 1e5), (-3e4, 0.0, 1e5), (0.0, 2e4, 1e5), (0.0, -2e4, 1e5)]
BENCH = """
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
preset = "tiny"
time_scale = 0
fall_off = "gaussian"
fall_off_sigma_deg = 13.0
"""


def test_a_gaussian_response_is_found_exactly() -> None:
    light = [1e8 * np.exp(-(4.0 * (x / z) ** 2 + 6.0 * (y / z) ** 2)) for x, y, z in PLACES]
    response = fit_field_response(PLACES, light)
    assert response.along_x == pytest.approx(4.0)
    assert response.along_y == pytest.approx(6.0)
    assert response.misfit < 1e-9
    assert response.largest_tangent == pytest.approx(0.3)


def test_a_response_that_is_no_gaussian_shows_in_the_misfit() -> None:
    light = [1e8, 0.7e8, 0.8e8, 0.9e8, 0.9e8]
    assert fit_field_response(PLACES, light).misfit == pytest.approx(0.067, abs=0.01)


def test_the_grid_has_the_axis_in_its_centre_pixel() -> None:
    response = fit_field_response(PLACES, [1.0, 0.7, 0.7, 0.8, 0.8])
    grid = response.on_grid((11, 20), 100.0, 1000.0)
    assert grid[5, 10] == 1.0
    assert grid[5, 13] == pytest.approx(0.7)  # 3 pixels of 100 um at d = 1 mm: the place at x / z = 0.3
    assert grid[3, 10] == pytest.approx(0.8)
    screen = response.on_grid((11, 20), 100.0, 1000.0, lambertian=True)
    assert screen[5, 13] / grid[5, 13] == pytest.approx(np.cos(np.arctan(0.3)))


@pytest.mark.parametrize(
    ("places", "light", "message"),
    [
        (PLACES[:3], [1.0, 0.7, 0.7], "off axis in x and in y"),
        (PLACES[:2], [1.0, 0.7], "at least three"),
        (PLACES, [1.0, 0.7, 0.7, 0.0, 0.8], "not seen at every place"),
    ],
)
def test_places_that_tell_too_little_are_refused(
    places: list[tuple[float, float, float]], light: list[float], message: str
) -> None:
    with pytest.raises(CalibrationError, match=message):
        fit_field_response(places, light)


def test_the_simulated_sensors_response_is_measured(tmp_path: Path) -> None:
    with open_bench(parse_config(BENCH, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        response = measure_field_response(bench, (7e3, 10e3), 100e3, 2.0, tmp_path)
        assert response.misfit < 0.01
        # Gaussian of 13 degrees, and the solid angle of the aperture, which falls with cos^3
        tan = 0.1
        expected = np.exp(-0.5 * (np.degrees(np.arctan(tan)) / 13.0) ** 2) * np.cos(np.arctan(tan)) ** 3
        measured = float(response(np.zeros(1), np.array([tan]))[0])
        assert measured == pytest.approx(expected, rel=0.02)
        with pytest.raises(PlanError):
            measure_field_response(bench, (7e3, 900e3), 100e3, 2.0, tmp_path)
        with pytest.raises(CalibrationError, match="choose a smaller field"):
            measure_field_response(bench, (10e3, 28e3), 100e3, 2.0, tmp_path)


def test_a_source_that_dims_evenly_is_taken_out_of_the_response(tmp_path: Path) -> None:
    found = []
    for name, drift in (("steady", 0.0), ("dims", -0.6)):
        with open_bench(parse_config(BENCH + f"drift_per_min = {drift}\n", None)) as bench:
            assert bench.stage is not None
            bench.stage.home()
            response = measure_field_response(bench, (7e3, 10e3), 100e3, 2.0, tmp_path / name)
            found.append(float(response(np.zeros(1), np.array([0.1]))[0]))
    assert found[1] == pytest.approx(found[0], rel=0.01)


def test_other_light_that_comes_in_meanwhile_is_refused(tmp_path: Path) -> None:
    text = BENCH + "ambient_e_per_s = 3e5\nambient_period_s = 120\n"
    with open_bench(parse_config(text, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        with pytest.raises(CalibrationError, match="other light"):
            measure_field_response(bench, (7e3, 10e3), 100e3, 2.0, tmp_path)


class _CtrlC(Listener):
    """Ends what it listens to at a frame, as a person does."""

    def __init__(self, at: int) -> None:
        self._left = at

    def frame(self, *_: object) -> None:
        self._left -= 1
        if self._left == 0:
            raise KeyboardInterrupt


def test_what_was_interrupted_is_gone_on_with_and_analysed(tmp_path: Path) -> None:
    asked = (7e3, 10e3), 100e3, 2.0
    with open_bench(parse_config(BENCH, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        usual = measure_field_response(bench, *asked, tmp_path / "whole")
        assert field_response_of(next((tmp_path / "whole").iterdir())) == usual
        with pytest.raises(KeyboardInterrupt) as ended:
            measure_field_response(bench, *asked, tmp_path, listener=_CtrlC(13))
        assert "field_response_of" in ended.value.__notes__[-1]
        run = next(tmp_path.glob("*_field-response-sweep"))
        with pytest.raises(CalibrationError, match=r"ended early.*diffuserbench resume"):
            field_response_of(run)
        ResumeProcedure(run).carry_out(bench)
    went_on = field_response_of(run)
    assert (went_on.along_x, went_on.along_y) == pytest.approx((usual.along_x, usual.along_y), rel=0.02)


def test_a_run_of_something_else_gives_no_response(tmp_path: Path) -> None:
    with open_bench(parse_config(BENCH, None)) as bench:
        assert bench.stage is not None
        bench.stage.home()
        with pytest.raises(InputError, match="dark_frames"):
            photograph(bench, 1.0, tmp_path, dark_frames=0)
        photograph(bench, 1.0, tmp_path, dark_frames=1)
    with pytest.raises(CalibrationError, match="'photograph'"):
        field_response_of(next(tmp_path.iterdir()))
