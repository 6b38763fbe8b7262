"""A reconstruction's forecast is of what it then does: iterations of all channels, limits, memory."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numba.core import event

from instrument.files import kept_times
from instrument.reconstruction import forecast as module
from instrument.reconstruction.forecast import TRIED, Forecast, Foretold, Like, _settling, _stretch, forecast
from instrument.reconstruction.job import Job
from recon import Calibration, reconstruct
from recon.errors import InputError
from recon.evaluation.scene import make_scene
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.solvers.base import IterationRecord, StopReason


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
    assert str(short) == "at most 6.0 s, 100 ms an iteration (16 were tried); 1.00 GiB of memory"


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No copy is given up, however busy the machine."""
    monkeypatch.setattr(module, "COPY_S", 1e6)


@pytest.mark.usefixtures("patient")
def test_it_is_told_by_how_a_copy_on_blocks_settles() -> None:
    made = make_scene("sparse-picture", size=64)
    asked = ReconstructionOptions(judged=False)
    told = forecast(Measurement(made.measurement), made.calibration, asked)
    took = len(reconstruct(made.measurement, made.calibration, asked).history)
    assert told.settles == pytest.approx(took, rel=0.4)
    assert told.seconds == pytest.approx(told.beside_s + told.settles * told.iteration_s)
    assert f", {told.settles} of them (by how a copy on blocks" in str(told)
    limited = forecast(Measurement(made.measurement), made.calibration, replace(asked, tolerance=0.0))
    assert limited.settles is None, "it takes as many as were asked for"


@pytest.mark.usefixtures("patient")
def test_volumes_are_told_so_too() -> None:
    made = make_scene("beads", size=64, depths=2)
    asked = ReconstructionOptions(model="convolution", prior="tv", judged=False)
    told = forecast(Measurement(made.measurement), made.calibration, asked)
    took = len(reconstruct(made.measurement, made.calibration, asked).history)
    assert told.settles == pytest.approx(took, rel=0.25)


def test_so_are_erased_pixels_and_varying_psfs() -> None:
    made = make_scene("sparse-picture", size=64, grid=2, aberration=1.0)
    photograph = Measurement(made.measurement, erasures=np.arange(64)[:, None] % 16 == np.arange(64))
    asked = ReconstructionOptions(model="lowrank", tolerance=1e-2)
    first = _records([1 / n for n in range(1, TRIED + 1)])
    assert _settling(photograph, made.calibration, asked, first, 1e6) is not None


def _records(unrest: list[float]) -> list[IterationRecord]:
    return [IterationRecord(n, float(n), change=u) for n, u in enumerate(unrest, 1)]


def test_a_copy_that_settles_twice_as_fast_is_stretched() -> None:
    copy = _records([1 / n for n in range(1, 100)])
    assert _stretch(_records([2 / n for n in range(1, TRIED + 1)]), copy) == pytest.approx(2, rel=0.02)
    assert _stretch(copy[:TRIED], copy) == pytest.approx(1, rel=0.02)
    from_nothing = [0.0, *(2 / n for n in range(2, TRIED + 1))]  # as volumes and varying PSFs begin
    begun = _records([0.0, *(1 / n for n in range(2, 201))])
    assert _stretch(_records(from_nothing), begun) == pytest.approx(2, rel=0.02)
    assert _stretch(_records([0.0] * TRIED), begun) == 1
    assert _stretch(_records([0.0] * TRIED), copy) == 1, "nothing can be told of an empty picture"


def test_a_copy_is_given_up_after_its_time(scene: tuple[Measurement, Calibration]) -> None:
    made = make_scene("sparse-picture", size=64)
    photograph, asked = Measurement(made.measurement), ReconstructionOptions(model="convolution")
    first = _records([1 / n for n in range(1, TRIED + 1)])
    assert _settling(photograph, made.calibration, asked, first, 1e-6) is None
    assert _settling(*scene, asked, first, 1e6) is None, "too small for blocks"


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


def test_the_next_like_it_is_told_before_it_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    like, said = Like("reconstruction of a hand", 1000), list[str]()
    first = Foretold(said.append, like)
    assert not said
    time.sleep(0.05)
    first.ended(["settled"])
    second = Foretold(said.append, like)
    assert said[0].endswith(", by the last like it")
    assert second.before is not None
    assert second.before[0] >= 0.05
    like.keep(2.0, 3e6)
    assert Like(like.key, 4000).took() == (8.0, 12e6), "it grows with the pixels"
    assert Like(like.key, 10_000).took() is None, "too far from what was seen"
    assert Like("another", 1000).took() is None
    said.clear()
    Foretold(said.append, like).ended([StopReason.CANCELLED])
    assert said == ["about 2.0 s in all; 2.9 MiB of memory, by the last like it"]
    assert like.took() == (2.0, 3e6), "what was cancelled is not kept"
    compiling = Foretold(said.append, like)
    compiling._compiled(1.0)
    compiling.ended(["settled"])
    assert like.took() == (2.0, 3e6), "nor what compilers took"
    for damaged in ("[1]", "[NaN, 2, 1]", "[-5, 2, 1]", "[1000, Infinity, 1]", f"[1000, 2, 1{400 * '0'}]"):
        kept_times.place().write_text(f'{{"reconstruction of a hand": [{damaged}]}}')
        assert like.took() is None
    kept_times.place().write_text('{"reconstruction of a hand": [[-5, 2, 1], [1000, 2]]}')
    like.keep(2.0, 3e6)
    assert like.took() == (2.0, 3e6)


def test_one_that_fails_watches_compilers_no_longer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    before = len(event._registered["numba:compile"])
    foretold = Foretold(lambda _: None, Like("reconstruction of nothing", 1000))
    assert len(event._registered["numba:compile"]) == before + 1
    with pytest.raises(InputError), foretold:
        raise InputError("There is nothing.")
    assert len(event._registered["numba:compile"]) == before


def test_like_ones_have_the_same_options_and_psfs(scene: tuple[Measurement, Calibration]) -> None:
    measurement, calibration = scene

    def key(psfs: Calibration = calibration, **options: object) -> str:
        job = Job(np.asarray(measurement.image, np.float32), psfs, {})
        return Like.of(job, ReconstructionOptions(**options)).key  # type: ignore[arg-type]

    two = Calibration(np.repeat(calibration.psfs, 2, 0), np.zeros((2, 3)))
    assert key() == key(z_um=100.0)
    assert len({key(), key(prior="l1"), key(iterations=30), key(two)}) == 4
