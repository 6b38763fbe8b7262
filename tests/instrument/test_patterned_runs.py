"""Active illumination from runs to a picture: light cast by plain sums, patterns told by a plain sheet."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile

import diffuserbench as db
from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image
from instrument.plan.illumination import illumination_plan
from instrument.plan.model import load_plan
from instrument.plan.patterns import group_lights, groups_from_text
from instrument.reconstruction.options import InputOptions
from instrument.reconstruction.patterned import PatternedRequest, forecast_patterned, prepare_patterned
from recon import Calibration, Options
from recon.base.metrics import psnr
from tests.mocks.plain_camera import cast
from tests.mocks.recordings import write_recording

SHAPE = (24, 30)
GROUPS = [[0, 1], [2], [3]]
DARK_COUNTS = 40


def psf() -> np.ndarray:
    response = np.random.default_rng(0).random(SHAPE) ** 10
    return (response / response.sum()).astype(np.float32)


def lights() -> np.ndarray:
    """Broad bands of light, unevenly bright."""
    x = np.arange(SHAPE[1]) / SHAPE[1] * 3 - np.arange(3)[:, None] - 0.5
    bands = np.exp(-(x**2) / 0.4) * np.array([1.0, 0.6, 0.9])[:, None]
    return np.repeat(bands[:, None], SHAPE[0], axis=1)


def scene() -> np.ndarray:
    light = np.full(SHAPE, 0.1)
    light[6:12, 5:9], light[14:18, 13:24] = 1.0, 0.7
    return light


def write_run(
    folder: Path,
    reflects: np.ndarray,
    groups: list[list[int]] = GROUPS,
    tint: tuple[float, ...] = (),
    **settings: object,
) -> Path:
    """``tint``: of red, green and blue, as a mosaic sensor's raw frames (RGGB) have them."""
    rng = np.random.default_rng(3)
    frames = {0: rng.normal(DARK_COUNTS, 1, SHAPE)}
    row, column = np.indices(SHAPE)
    sees = np.array(tint)[(row % 2) + (column % 2)] if tint else 1.0
    for number, light in enumerate(lights(), start=1):
        clean = 20000 * sees * cast(reflects * light, psf()) + DARK_COUNTS
        frames[number] = clean + rng.normal(0, 1, SHAPE)
    frames = {index: np.clip(np.round(frame), 0, 65535) for index, frame in frames.items()}
    plan = illumination_plan(group_lights(groups), exposure_ms=10)
    return write_recording(folder, frames, plan=plan, **settings)  # type: ignore[arg-type]


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path, Path]:
    calibration = Calibration(psf()[None, None], np.array([[0.0, 0.0, 30e3]]))
    return (
        write_run(tmp_path / "scene", scene()),
        write_run(tmp_path / "sheet", np.ones(SHAPE)),
        save_calibration(calibration, tmp_path / "calibration"),
    )


def test_one_picture_of_all_patterns(
    files: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, sheet, calibration = files
    out = tmp_path / "picture.tif"
    status = main(
        [
            *("reconstruct", str(run), "--patterned", str(sheet), "--calibration", str(calibration)),
            *("--out", str(out), "--iterations", "200", "--checkpoint", str(tmp_path / "kept")),
            *("--figure", str(tmp_path / "page.png")),
        ]
    )
    assert status == 0
    assert (tmp_path / "page.png").is_file()
    image = tifffile.imread(out)
    truth = scene() * lights().sum(axis=0)  # as bright as all groups together make it
    gain = float(np.vdot(image, truth) / np.vdot(image, image))
    assert psnr(gain * image, truth) > 22
    record = json.loads(out.with_suffix(".json").read_text())
    said = " ".join("".join(capsys.readouterr()).split())
    assert record["warnings"]
    assert all(" ".join(warning.split()) in said for warning in record["warnings"])
    assert record["simulated"]
    assert record["inputs"]["sheet"] == str(sheet)
    assert record["provenance"]["patterns"] == 3
    assert record["inputs"]["dark"]["from"].startswith("the frames")
    assert "image" not in record["inputs"]


def test_what_it_takes_is_told_with_its_patterns_in_terminal_and_python(
    files: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, sheet, calibration = files
    lying = set(tmp_path.rglob("*"))
    where = ["--patterned", str(sheet), "--calibration", str(calibration)]
    assert main(["reconstruct", str(run), *where, "--explain", "--iterations", "4", "--tolerance", "0"]) == 0
    assert "an iteration, 4 of them" in capsys.readouterr().out
    assert set(tmp_path.rglob("*")) == lying
    request = PatternedRequest(
        run=run, sheet=sheet, calibration=calibration, options=Options(iterations=4, tolerance=0.0)
    )
    prepared = replace(prepare_patterned(request), seconds=1000.0)
    told = forecast_patterned(prepared)
    assert (told.settles, told.counted) == (4, True)
    assert 1000 < told.seconds < 1600, "what the patterns took is in it"
    shares: list[float] = []
    told = db.forecast(
        run,
        calibration,
        patterned=sheet,
        on_stage=lambda share, _: shares.append(share),
        iterations=4,
        tolerance=0.0,
    )
    assert told.settles == 4
    assert shares == sorted(shares)
    assert 0.5 < shares[-1] <= 1


def test_a_colour_camera_in_patterned_light(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    """Its raw frames, each colour where it was measured; of a pixel size and window of one's own."""
    calibration, tint = files[2], (1.0, 0.6, 0.3)
    run = write_run(tmp_path / "red", scene(), tint=tint, pixel_format="BayerRG12")
    sheet = write_run(tmp_path / "white", np.ones(SHAPE), tint=tint, pixel_format="BayerRG12")
    out = tmp_path / "colour.tif"
    command = ["reconstruct", str(run), "--patterned", str(sheet), "--calibration", str(calibration)]
    assert main([*command, "--out", str(out), "--iterations", "100", "--bin", "2", "--crop", "24x28"]) == 0
    image = read_image(out).pixels
    assert image.shape == (12, 14, 3)
    light = image.reshape(-1, 3).sum(axis=0)
    # Too much green: 19 % in a window (7 with a background below zero), 13 % in whole frames either way.
    np.testing.assert_allclose(light / light[0], tint, rtol=0.2)
    truth = (scene() * lights().sum(axis=0))[:, 1:29].reshape(12, 2, 14, 2).mean(axis=(1, 3))
    for channel, least in enumerate((15, 15, 13)):  # red and blue of a quarter of the pixels
        assert psnr(image[..., channel], truth, fit_scale=True) > least
    by_itself = PatternedRequest(run=run, sheet=sheet, calibration=calibration)
    prepared = prepare_patterned(by_itself)
    assert np.shape(prepared.measurement.image) == (3, 12, 15, 3), "each pixel has all colours"
    assert not np.any(prepared.measurement.erasures)
    assert "binned 2 x 2" in prepared.job.notes["Pixels"]
    assert "--bin 1" in prepared.job.notes["Pixels"]
    own = replace(by_itself, inputs=InputOptions(binning=1))
    assert np.shape(prepare_patterned(own).measurement.image) == (3, *SHAPE, 3)
    half = psf().reshape(12, 2, 15, 2).sum(axis=(1, 3))
    coarse = save_calibration(Calibration(half[None, None], np.array([[0.0, 0.0, 30e3]])), tmp_path / "half")
    brought = prepare_patterned(replace(by_itself, calibration=coarse))
    assert np.shape(brought.measurement.image) == (3, 12, 15, 3), "all colours by the calibration's pixels"
    assert "--bin 1" not in brought.job.notes["Pixels"]
    asked = PatternedRequest(run=run, sheet=tmp_path / "patterns.npy", calibration=calibration)
    np.save(tmp_path / "patterns.npy", lights())
    whole = prepare_patterned(asked).measurement
    erased = np.asarray(whole.erasures)
    assert np.shape(whole.image) == erased.shape == (3, *SHAPE, 3)
    np.testing.assert_allclose(1 - erased.mean(axis=(0, 1, 2)), (0.25, 0.5, 0.25))


def test_patterns_are_the_shares_of_the_light(files: tuple[Path, Path, Path]) -> None:
    run, sheet, calibration = files
    told: list[tuple[int, int]] = []
    request = PatternedRequest(run=run, sheet=sheet, calibration=calibration, options=Options(z_um=30e3))
    prepared = prepare_patterned(request, lambda done, total: told.append((done, total)))
    assert told == [(n, 3) for n in range(4)]
    truth = lights() / lights().sum(axis=0)
    middle = np.s_[:, 5:-5, 5:-5]
    assert np.abs(np.asarray(prepared.measurement.patterns) - truth)[middle].mean() < 0.06
    assert np.asarray(prepared.measurement.patterns).sum(axis=0)[5:-5, 5:-5] == pytest.approx(1, abs=1e-5)
    first = float(np.asarray(prepared.measurement.image)[0].mean())
    assert abs(first - 20000 * float(cast(scene() * lights()[0], psf()).mean())) < 5
    binned = prepare_patterned(replace(request, inputs=InputOptions(binning=2))).measurement
    assert np.shape(binned.image) == np.shape(binned.patterns) == (3, 12, 15)


def test_patterns_may_come_from_a_file(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    run, _, calibration = files
    np.save(tmp_path / "patterns.npy", lights())
    request = PatternedRequest(run=run, sheet=tmp_path / "patterns.npy", calibration=calibration)
    truth = lights() / lights().sum(axis=0)
    np.testing.assert_allclose(prepare_patterned(request).measurement.patterns, truth, atol=1e-5)
    np.save(tmp_path / "patterns.npy", lights()[:2])
    with pytest.raises(FileError, match=r"\(3, 24, 30\)"):
        prepare_patterned(request)
    np.save(tmp_path / "patterns.npy", -lights())
    with pytest.raises(FileError, match="negative"):
        prepare_patterned(request)
    for content in (b"", b"PK\x03\x04 cut off"):
        (tmp_path / "patterns.npy").write_bytes(content)
        with pytest.raises(FileError, match=r"no plain \.npy"):
            prepare_patterned(request)
    np.savez(tmp_path / "several.npz", lights())
    (tmp_path / "several.npz").replace(tmp_path / "patterns.npy")
    with pytest.raises(FileError, match=r"no plain \.npy"):
        prepare_patterned(request)


def test_what_does_not_belong_together_is_refused(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    run, sheet, calibration = files

    def refused(sheet: Path, run: Path = run) -> str:
        with pytest.raises((BenchError, FileError)) as caught:
            prepare_patterned(PatternedRequest(run=run, sheet=sheet, calibration=calibration))
        return str(caught.value)

    other = write_run(tmp_path / "other", np.ones(SHAPE), groups=[[0], [2], [3]])
    assert "same groups" in refused(other)
    assert "scene's own run" in refused(run)
    recording = write_recording(tmp_path / "recording", {0: np.ones(SHAPE)})
    assert "no run of active illumination" in refused(sheet, recording)
    dark = write_run(tmp_path / "dark", np.zeros(SHAPE))
    assert refused(dark)
    short = illumination_plan(group_lights(GROUPS), exposure_ms=10)
    missing = write_recording(tmp_path / "short", {0: np.ones(SHAPE)}, plan=short)
    assert "lacks 3 frames" in refused(sheet, missing)
    small = write_recording(
        tmp_path / "small",
        {n: np.arange(100.0).reshape(10, 10) for n in range(4)},
        plan=illumination_plan(group_lights(GROUPS), exposure_ms=1),
    )
    assert "24 x 30" in refused(sheet, small)


def test_scene_and_sheet_swapped_are_told(files: tuple[Path, Path, Path]) -> None:
    run, sheet, calibration = files

    def said(run: Path, sheet: Path) -> bool:
        prepared = prepare_patterned(PatternedRequest(run=run, sheet=sheet, calibration=calibration))
        return any("swapped" in warning for warning in prepared.job.warnings)

    assert not said(run, sheet)
    assert said(sheet, run)


def test_saturated_frames_are_told(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    _, sheet, calibration = files
    run = write_run(tmp_path / "bright", scene(), saturated=0.1)
    prepared = prepare_patterned(PatternedRequest(run=run, sheet=sheet, calibration=calibration))
    assert any("saturated" in warning for warning in prepared.job.warnings)


@pytest.mark.parametrize(
    "options",
    [
        ["--video"],
        ["--psf", "x.tif"],
        ["--workers", "2"],
        ["--dark", "3"],
    ],
)
def test_options_that_do_not_apply_are_named(options: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "run", "--patterned", "sheet", "--calibration", "c", *options]) == 2
    assert options[0] in capsys.readouterr().err


def test_a_run_and_a_calibration_are_needed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--patterned", "sheet"]) == 2
    assert "--patterned needs a run and a calibration" in capsys.readouterr().err


# The plan -------------------------------------------------------------------------------------------
def test_the_work_is_kept_and_gone_on_with(
    files: tuple[Path, Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, sheet, calibration = files
    command = ["reconstruct", str(run), "--patterned", str(sheet), "--calibration", str(calibration)]
    command += ["--tolerance", "0", "--force", "--out"]
    kept = [str(tmp_path / "parts.tif"), "--checkpoint", str(tmp_path / "kept")]
    for iterations in ("5", "12"):
        assert main([*command, *kept, "-n", iterations]) == 0
    assert "from iteration 5 in" in capsys.readouterr().out
    assert main([*command, str(tmp_path / "whole.tif"), "-n", "12"]) == 0
    parts, whole = (tifffile.imread(tmp_path / f"{name}.tif") for name in ("parts", "whole"))
    np.testing.assert_allclose(parts, whole, rtol=1e-4, atol=1e-5 * whole.max())
    # The same frames under other patterns are another picture.
    np.save(tmp_path / "even.npy", np.ones((3, *SHAPE)))
    command[3] = str(tmp_path / "even.npy")
    assert main([*command, *kept]) == 2
    assert "patterns" in capsys.readouterr().err


def test_the_plan_command_writes_what_runs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "lit.toml"
    command = ["plan", "illumination", str(file), "--groups", "0-2; 4,6 ;8", "--exposure-ms", "20"]
    assert main(command) == 0
    plan = load_plan(file)
    assert [len(step.light.leds) for step in plan.steps()] == [0, 3, 2, 1]
    assert main(command) == 2
    assert "exists already" in capsys.readouterr().err
    both = ["plan", "illumination", "--exposure-ms", "1", "--groups", "1", "--lattice", "2"]
    assert main(both) == 2
    assert "as one of --groups, --lattice and --pattern" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("text", "says"),
    [("1;;2", "empty"), ("a", "'a'"), ("5-3", "ends before"), ("1,1", "twice"), ("-1", "'-1'")],
)
def test_groups_that_are_none_are_refused(text: str, says: str) -> None:
    with pytest.raises(BenchError, match=says):
        groups_from_text(text)
