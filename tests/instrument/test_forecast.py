"""A reconstruction's forecast is of what it then does: iterations of all channels, limits, memory."""

from __future__ import annotations

import numpy as np
import pytest

from instrument.reconstruction.forecast import TRIED, Forecast, Foretold, forecast
from recon import Calibration, reconstruct
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions


@pytest.fixture(scope="module")
def scene() -> tuple[Measurement, Calibration]:
    rng = np.random.default_rng(0)
    psf = (rng.random((1, 1, 32, 32)) ** 30).astype(np.float32)
    light = np.stack([np.roll(psf[0, 0], 3, axis=1) * n for n in (1, 4, 2)], axis=-1)
    light[..., 1] += np.roll(psf[0, 0], 7, axis=0)
    photograph = rng.poisson(200 * light + 5).astype(np.float32)
    return Measurement(photograph), Calibration(psf, np.full((1, 3), np.nan))


def test_a_forecast_counts_iterations_of_all_channels_and_stops_at_a_time(
    scene: tuple[Measurement, Calibration],
) -> None:
    asked = ReconstructionOptions(model="convolution", iterations=50, judged=False)
    told = forecast(*scene, asked)
    assert told.iterations == 50
    assert told.iteration_s > 0
    assert told.seconds == pytest.approx(told.beside_s + 50 * told.iteration_s)
    assert f"({TRIED} were tried)" in str(told)
    short = Forecast(1.0, 0.1, 1000, 2.0**30, time_s=5.0)
    assert short.seconds == 6.0
    assert str(short) == "at most 6.0 s, 100 ms an iteration (6 were tried); 1.00 GiB of memory"


def test_solvers_in_one_step_are_forecast_too(scene: tuple[Measurement, Calibration]) -> None:
    told = forecast(*scene, ReconstructionOptions(model="convolution", solver="wiener", judged=False))
    assert told.iterations == 0
    assert told.seconds > 0


def test_a_reconstruction_says_once_what_it_will_take(scene: tuple[Measurement, Calibration]) -> None:
    said: list[str] = []
    foretold = Foretold(said.append)
    reconstruct(*scene, iterations=40, on_progress=foretold.watch, on_stage=foretold.stage)
    assert len(said) == 1
    assert said[0].startswith("about ")
    assert foretold.seconds > 0
