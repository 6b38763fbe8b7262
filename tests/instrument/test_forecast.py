"""A reconstruction's forecast is of what it then does: iterations of all channels, limits, memory."""

from __future__ import annotations

import sys
import time
from dataclasses import replace
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.core import event

from instrument.files import kept_times
from instrument.reconstruction import forecast as module
from instrument.reconstruction.forecast import TRIED, Carried, Forecast, Trial, carried_out, forecast
from instrument.reconstruction.foretold import Foretold, Like
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


def test_what_is_soon_over_is_carried_out_and_told_as_it_was(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SOLVED_S", 600.0)  # however busy the machine
    made = make_scene("sparse-picture", size=64)
    asked = ReconstructionOptions(judged=False)
    took = len(reconstruct(made.measurement, made.calibration, asked).history)
    told = forecast(Measurement(made.measurement), made.calibration, asked)
    assert (told.settles, told.iterations, told.counted) == (took, took, True)
    assert told.seconds == pytest.approx(told.beside_s + took * told.iteration_s)
    assert told.between_s == (told.seconds, told.seconds)
    assert f" ms an iteration, {took} of them; " in f"{told}; "


def test_what_is_not_is_told_by_the_course_of_its_first_iterations(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "SOLVED_S", 1e-6)
    made = make_scene("beads", size=64, depths=2)
    photograph, asked = Measurement(made.measurement), ReconstructionOptions(prior="tv", judged=False)
    took = len(reconstruct(made.measurement, made.calibration, asked).history)
    assert took > TRIED
    told = forecast(photograph, made.calibration, asked)
    assert told.settles == pytest.approx(took, rel=0.5)
    assert not told.counted
    least_s, most_s = told.between_s
    assert max(told.beside_s, least_s) < told.seconds <= most_s  # choosing may take most of it
    all_of_them = forecast(photograph, made.calibration, replace(asked, tolerance=0.0, iterations=90))
    assert (all_of_them.settles, all_of_them.counted) == (90, True)
    until_noise = forecast(photograph, made.calibration, replace(asked, stop_at_noise=True, iterations=90))
    assert until_noise.settles is None
    assert str(until_noise).startswith("at most ")


def test_a_forecast_counts_iterations_of_all_channels_and_stops_at_a_time(
    scene: tuple[Measurement, Calibration],
) -> None:
    asked = ReconstructionOptions(model="convolution", iterations=50, tolerance=0.0, judged=False)
    told = forecast(*scene, asked)
    assert (told.iterations, told.settles) == (50, 50)
    assert told.iteration_s > 0
    short = forecast(*scene, replace(asked, iterations=None, time_s=1e-4))
    assert short.counted, "its own time ended it"
    assert short.settles == 1
    words = "about 16.0 s (9.2 s to 25.2 s), 100 ms an iteration, about 150 of them by the course of"
    assert str(Forecast(1.0, 0.1, 200, 2.0**30, 150)) == f"{words} the first; 1.00 GiB of memory"
    at_the_limit = Forecast(1.0, 0.1, 200, 2.0**30, 200)
    assert at_the_limit.between_s[1] > 1.05 * at_the_limit.seconds, "iterations are not all alike"
    assert repr(at_the_limit).startswith("<Forecast: about 21.0 s (")
    assert str(Forecast(1.0, 0.1, 50, float("nan"))) == "at most 6.0 s, 100 ms an iteration"


def test_a_few_iterations_tell_what_one_takes() -> None:
    def each_s(*ends_s: float) -> float:
        history = [IterationRecord(number + 1, end_s, 0.0) for number, end_s in enumerate(ends_s)]
        return Carried(9.0, 0.0, [history, []], cut=False).iteration_s

    assert each_s(0.5) == 0.5
    assert each_s(0.5, 0.7, 0.9) == pytest.approx(0.2), "the first ones are slower"
    assert each_s(5.0, 6.0, 7.0, 8.0, 8.1, 8.2) == pytest.approx(0.1)


def test_what_a_program_reads_once_is_no_part_of_it(monkeypatch: pytest.MonkeyPatch) -> None:
    tried = list[float]()

    def begin(_iterations: int | None, _time_s: float, done: float) -> Carried:
        tried.append(done)
        monkeypatch.setitem(sys.modules, "read_by_the_first", sys)
        return Carried(9.0 / len(tried), 1e8 / len(tried), [[]], cut=False)

    assert carried_out(begin, 5.0).seconds == 4.5
    assert tried == [0.0, 0.5]
    assert carried_out(begin, 5.0).memory_bytes == pytest.approx(1e8 / 3)
    assert len(tried) == 3
    monkeypatch.delitem(sys.modules, "read_by_the_first")
    told = carried_out(lambda n, s, done: replace(begin(n, s, done), cut=n is None), 5.0)
    assert (len(tried), told.seconds) == (5, 1.8), "its first iterations are carried out anew as ever"
    assert told.memory_bytes == pytest.approx(1e8 / 5)


def test_a_kernel_that_is_compiled_is_no_part_of_it_though_its_module_was_read_before() -> None:
    kernel = numba.njit(lambda x: 2 * x)
    tried = list[float]()

    def begin(_iterations: int | None, _time_s: float, done: float) -> Carried:
        tried.append(done)
        assert kernel(len(tried)) == 2 * len(tried)
        return Carried(9.0 / len(tried), 0.0, [[]], cut=False)

    assert carried_out(begin, 5.0).seconds == 4.5
    assert carried_out(begin, 5.0).seconds == 3.0
    assert tried == [0.0, 0.5, 0.0], "it is there by now"


def test_held_out_pixels_take_a_third_of_the_iterations_more(scene: tuple[Measurement, Calibration]) -> None:
    asked = ReconstructionOptions(model="convolution", iterations=60, tolerance=0.0)
    trial = Trial.of(*scene, asked, lambda *_: None)
    assert trial.found.verdict is not None
    held_out = replace(trial, found=replace(trial.found, verdict=replace(trial.found.verdict, held_out=1.0)))
    runs = len(trial.found.histories)
    more_s = held_out.beside_s(120) - held_out.beside_s(60)
    assert more_s == pytest.approx((40 - 20) / runs * trial.iteration_s)


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
