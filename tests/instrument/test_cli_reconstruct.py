"""``diffuserbench reconstruct``: files from anywhere to a picture; every unusable input in words."""

from __future__ import annotations

import ctypes
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from scipy.signal import convolve2d

from instrument.cli import main
from instrument.files.calibration_file import save_calibration
from instrument.files.images import read_image, write_image
from instrument.reconstruction.request import PictureRequest
from instrument.reconstruction.stored_result import open_result
from recon.arrays import Array, BoolArray, Float64Array
from recon.priors import PRIORS
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.solvers import SOLVERS
from recon.types import Calibration, Geometry

RNG = np.random.default_rng(3)
SHAPE = (48, 64)
OFFSET = 20
PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
SOURCES = ((20, 25), (30, 45))


def psf_image() -> Float64Array:
    psf = np.zeros(SHAPE)
    psf[16:32, 22:42] = RNG.random((16, 20)) ** 8
    return psf


PSF = psf_image()


def photograph() -> Float64Array:
    """Points of light seen by the camera, by plain summation in space."""
    scene = np.zeros(SHAPE)
    for row, column in SOURCES:
        scene[row, column] = 1
    full = convolve2d(scene, PSF)
    top, left = SHAPE[0] // 2, SHAPE[1] // 2
    return full[top : top + SHAPE[0], left : left + SHAPE[1]]


def counts(image: Array, scale: float, dtype: str) -> Array:
    return np.asarray(np.round(image / PSF.max() * scale) + OFFSET, dtype)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DIFFUSERBENCH_DEBUG", raising=False)
    write_image("psf.tif", counts(PSF, 30000, "uint16"))
    write_image("raw.tif", counts(photograph(), 20000, "uint16"))
    return tmp_path


SHARP = ("--iterations", "60", "--tau", "1e-5", "--out", "out.tif")
QUICK = ("--iterations", "30", "--out", "out.tif")


def brightest(image: Array) -> set[tuple[int, int]]:
    grey = image.mean(axis=-1) if image.ndim == 3 else image
    order = np.argsort(grey, axis=None)[-2:]
    return {(int(row), int(column)) for row, column in np.transpose(np.unravel_index(order, grey.shape))}


def test_files_to_a_picture_with_everything_said(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", *QUICK, "--figure", "fig.png"]) == 0
    picture = tifffile.imread(here / "out.tif")
    assert picture.dtype == np.float32
    assert picture.shape == SHAPE
    assert brightest(picture) == set(SOURCES)
    record = json.loads((here / "out.json").read_text())
    assert record["method"] == "admm"
    assert record["inputs"]["dark"]["image_counts"] == OFFSET
    assert len(record["history"]) == record["iterations"]
    preview = cv2.imread(str(here / "out.png"), cv2.IMREAD_UNCHANGED)
    assert preview.dtype == np.uint8
    assert (here / "fig.png").stat().st_size > 10_000
    shown = capsys.readouterr().out
    for chosen in (
        "48 x 64 grey uint16",
        "20.0 counts from both",
        "not binned",
        "admm, prior tv, tau",
        "Wrote",
    ):
        assert chosen in shown
    assert sorted(p.name for p in here.iterdir()) == [
        "fig.png", "out.json", "out.png", "out.tif", "psf.tif", "raw.tif",
    ]  # fmt: skip


@pytest.mark.parametrize(("suffix", "dtype"), [(".png", "uint16"), (".npy", "float32"), (".bmp", "uint8")])
@pytest.mark.parametrize("colour", [False, True], ids=["grey", "colour"])
def test_any_format_depth_and_colour(here: Path, suffix: str, dtype: str, colour: bool) -> None:
    scale = 200 if dtype == "uint8" else 20000
    psf, raw = counts(PSF, scale, dtype), counts(photograph(), scale, dtype)
    if colour:
        raw = np.stack([raw, OFFSET + (raw - OFFSET) // 2, OFFSET + (raw - OFFSET) // 4], axis=-1).astype(
            dtype
        )
    for name, image in (("p", psf), ("r", raw)):
        if suffix == ".npy":
            np.save(here / f"{name}.npy", image)
        else:
            cv2.imwrite(str(here / f"{name}{suffix}"), image[..., ::-1] if image.ndim == 3 else image)
    assert main(["reconstruct", "--psf", f"p{suffix}", "--image", f"r{suffix}", *QUICK]) == 0
    picture = read_image(here / "out.tif").pixels
    assert picture.shape == ((*SHAPE, 3) if colour else SHAPE)
    assert brightest(picture) == set(SOURCES)
    if colour:
        totals = picture.sum(axis=(0, 1))
        assert totals[0] > 1.5 * totals[1] > 2 * totals[2]


@pytest.mark.parametrize(
    "options",
    [
        ("--method", "fista", "--prior", "l1", "--time", "0.2"),
        ("--method", "wiener"),
        ("--method", "admm", "--prior", "nonnegative", "--tolerance", "1e-2"),
        ("--dark", "20", "--tau", "0.001", "--iterations", "10"),
        ("--dark", "dark.tif", "--bin", "2", "--iterations", "10"),
        ("--crop", "40x40", "--iterations", "10"),
    ],
    ids=" ".join,
)
def test_options(here: Path, options: tuple[str, ...]) -> None:
    write_image(here / "dark.tif", np.full(SHAPE, OFFSET, np.uint16))
    assert main(["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", *options, "--out", "out.tif"]) == 0
    assert np.isfinite(tifffile.imread(here / "out.tif")).all()


def test_saturated_pixels_do_not_spoil_the_picture(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_image(here / "burnt.tif", np.minimum(counts(photograph(), 20000, "uint16"), 4095))
    words = ["reconstruct", "--psf", "psf.tif", "--image", "burnt.tif", *SHARP]
    assert main(words) == 0
    output = capsys.readouterr()
    assert "saturated pixels" in output.out
    assert "saturated" not in output.err
    erased = tifffile.imread(here / "out.tif")
    assert main([*words, "--erasures", "none", "--force"]) == 0
    assert "are saturated and used" in capsys.readouterr().err
    used = tifffile.imread(here / "out.tif")
    truth = 20000 / 30000  # photograph and PSF are scaled to these counts
    for source in SOURCES:
        assert erased[source] == pytest.approx(truth, rel=0.1)
        assert used[source] < 0.5 * truth


def test_what_comes_from_the_simulated_bench_stays_labelled(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", "--psf", "psf.tif", "--iterations", "5", "--force"]
    assert main([*words, "--image", "raw.tif", "--out", "real.tif"]) == 0
    assert "SIMULATED" not in capsys.readouterr().out
    assert json.loads((here / "real.json").read_text())["simulated"] is False
    for name in ("sim.tif", "sim.png"):
        write_image(here / name, counts(photograph(), 20000, "uint16"), {"simulated": True})
        assert main([*words, "--image", name, "--out", "out.tif"]) == 0
        assert "SIMULATED" in capsys.readouterr().out
        assert json.loads((here / "out.json").read_text())["simulated"] is True
        assert read_image(here / "out.tif").is_simulated
        (here / "sim.json").unlink(missing_ok=True)


def test_the_written_picture_can_be_turned(here: Path) -> None:
    words = [
        "reconstruct",
        "--psf",
        "psf.tif",
        "--image",
        "raw.tif",
        "--iterations",
        "5",
        "--figure",
        "fig.png",
    ]
    assert main([*words, "--out", "a.tif"]) == 0
    assert main([*words, "--out", "b.tif", "--rotate", "90", "--force"]) == 0
    np.testing.assert_array_equal(tifffile.imread(here / "b.tif"), np.rot90(tifffile.imread(here / "a.tif")))
    assert json.loads((here / "b.json").read_text())["rotated_deg"] == 90
    assert cv2.imread(str(here / "b.png"), cv2.IMREAD_UNCHANGED).shape == SHAPE[::-1]


def test_a_random_share_of_the_pixels_is_enough(here: Path) -> None:
    words = ["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", *SHARP]
    assert main([*words, "--erasures", "0.5"]) == 0
    picture = tifffile.imread(here / "out.tif")
    assert brightest(picture) == set(SOURCES)
    assert picture[SOURCES[0]] == pytest.approx(20000 / 30000, rel=0.1)


def test_a_calibration_folder_in_place_of_a_psf(here: Path) -> None:
    psfs = np.stack([PSF, PSF[::-1]])[:, None].astype(np.float32)
    positions = np.array([[0, 0, 1e4], [0, 0, 3e4]], np.float64)
    save_calibration(Calibration(psfs, positions, None, Geometry(4.0, 2.0)), here / "run" / "calibration")
    calibrated = ["reconstruct", "--calibration", "run", "--image", "raw.tif", "--dark", "20", *QUICK]
    assert main([*calibrated, "--z-mm", "11"]) == 0
    assert brightest(tifffile.imread(here / "out.tif")) == set(SOURCES)
    assert main([*calibrated, "--force"]) == 2  # two PSFs, and no depth to choose by


def make_bad_files(folder: Path) -> None:
    (folder / "text.tif").write_text("no image")
    (folder / "folder").mkdir()
    write_image(folder / "small.tif", np.arange(100, dtype=np.uint16).reshape(10, 10))
    write_image(folder / "zero.tif", np.zeros(SHAPE, np.uint16))
    write_image(folder / "flat.tif", np.full(SHAPE, 500, np.uint16))
    write_image(folder / "colour.tif", np.dstack([counts(PSF, 30000, "uint16")] * 3))
    write_image(folder / "eight.png", counts(PSF, 200, "uint8"))
    write_image(folder / "burnt.tif", np.minimum(counts(PSF, 30000, "uint16"), 4095))
    broken = PSF.copy()
    broken[3, 4] = np.nan
    np.save(folder / "nan.npy", broken)
    (folder / "taken.tif").write_bytes(b"precious")


BAD = {
    "absent psf": (["--psf", "absent.tif"], "absent.tif: there is no such file"),
    "absent image": (["--image", "absent.tif"], "absent.tif: there is no such file"),
    "folder": (["--psf", "folder"], "folder: is a folder"),
    "no image": (["--psf", "text.tif"], "text.tif: is no image"),
    "shape": (["--psf", "small.tif"], "10 x 10 grey uint16, but the image raw.tif is 48 x 64"),
    "empty": (["--psf", "zero.tif"], "zero.tif: the PSF is empty"),
    "constant": (["--psf", "flat.tif"], "flat.tif: the PSF is constant"),
    "bit depth": (["--psf", "eight.png"], "8 bit, but the image raw.tif has 16 bit"),
    "saturated": (["--psf", "burnt.tif"], "are saturated (at 4095)"),
    "nan psf": (["--psf", "nan.npy"], "no finite number"),
    "black image": (["--image", "zero.tif"], "zero.tif: the image is constant"),
    "crop": (["--crop", "100x100"], "--crop asks for 100 x 100"),
    "crop text": (["--crop", "middle"], "TOP,LEFT,HEIGHT,WIDTH"),
    "bin": (["--bin", "0"], "--bin must be auto or a whole number, 1 or more, not 0"),
    "bin too large": (["--bin", "100"], "--bin 100"),
    "dark": (["--dark", "absent.tif"], "absent.tif: there is no such file"),
    "dark shape": (["--dark", "small.tif"], "the dark frame is 10 x 10"),
    "dark nan": (["--dark", "nan"], "finite"),
    "erasures": (["--erasures", "1.5"], "from 0 to below 1"),
    "erased all": (["--erasures", "0.99", "--bin", "4"], "no pixel is left"),
    "mask": (["--erasures", "absent.png"], "absent.png: there is no such file"),
    "method": (["--method", "magic"], "magic"),
    "prior": (["--prior", "magic"], "magic"),
    "tau": (["--tau", "-1"], "tau"),
    "wiener": (["--method", "wiener", "--iterations", "3"], "one shot"),
    "iterations": (["--iterations", "0"], "--iterations"),
    "time": (["--time", "-1"], "--time"),
    "out suffix": (["--out", "out.jpg"], "out.jpg: a picture is written as float32 TIFF"),
    "out folder": (["--out", "absent/out.tif"], "absent does not exist"),
    "out is folder": (["--out", "folder"], "folder"),
    "out taken": (["--out", "taken.tif"], "taken.tif: exists already"),
    "figure": (["--figure", "fig.doc"], "fig.doc: a figure is written as"),
    "both": (["--calibration", "folder"], "either --psf FILE or --calibration"),
}


@pytest.mark.parametrize("case", BAD)
def test_unusable_input_is_refused_in_one_sentence_and_nothing_is_written(
    case: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make_bad_files(here)
    before = sorted(p.name for p in here.rglob("*"))
    options, told = BAD[case]
    arguments = {"--psf": "psf.tif", "--image": "raw.tif", "--out": "out.tif", "--iterations": "5"}
    if "wiener" in options or "--iterations" in options:
        del arguments["--iterations"]
    arguments |= dict(zip(options[::2], options[1::2], strict=True))
    assert main(["reconstruct", *(word for pair in arguments.items() for word in pair)]) == 2
    error = capsys.readouterr().err
    assert told in error
    assert "Traceback" not in error
    assert sorted(p.name for p in here.rglob("*")) == before
    assert (here / "taken.tif").read_bytes() == b"precious"


def without_root_powers() -> None:
    """Make a process of root's obey file permissions like everybody's: no overriding after exec."""
    libc = ctypes.CDLL(None)
    for capability in (1, 2):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH
        libc.prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (("--out", "locked/out.tif"), "/locked. Choose another place."),
        (("--psf", "secret.tif"), "secret.tif"),
    ],
)
def test_files_and_folders_without_permission(here: Path, options: tuple[str, str], told: str) -> None:
    (here / "locked").mkdir(mode=0o500)
    write_image(here / "secret.tif", counts(PSF, 30000, "uint16"))
    (here / "secret.tif").chmod(0)
    arguments = {"--psf": "psf.tif", "--image": "raw.tif"} | {options[0]: options[1]}
    ended = subprocess.run(
        [
            sys.executable,
            "-c",
            PROGRAM,
            "reconstruct",
            *(word for pair in arguments.items() for word in pair),
        ],
        capture_output=True,
        text=True,
        check=False,
        cwd=here,
        env=ENVIRONMENT,
        preexec_fn=without_root_powers,
        timeout=60,
    )
    assert ended.returncode == 2
    assert told in ended.stderr
    assert "Traceback" not in ended.stderr
    assert sorted(p.name for p in here.rglob("*")) == ["locked", "psf.tif", "raw.tif", "secret.tif"]


def test_a_full_disk_is_told_before_the_work(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.statvfs

    def nearly_full(path: Any) -> os.statvfs_result:
        values = list(real(path))
        values[4] = 1  # f_bavail
        return os.statvfs_result(values)

    monkeypatch.setattr(os, "statvfs", nearly_full)
    assert main(["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", *QUICK]) == 2
    assert "are free on its disk" in capsys.readouterr().err
    assert not (here / "out.tif").exists()


def test_ctrl_c_keeps_the_picture_so_far(here: Path) -> None:
    words = ["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", "--out", "out.tif", "--tolerance", "0"]
    process = subprocess.Popen(
        [sys.executable, "-u", "-c", PROGRAM, *words, "--iterations", "100000000"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=here,
        env=ENVIRONMENT,
    )
    try:
        assert process.stdout is not None
        while not process.stdout.readline().startswith("Pixels"):
            pass
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        _, error = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == 130
    assert "the picture so far" in error
    record = json.loads((here / "out.json").read_text())
    assert record["stop_reason"] == "cancelled"
    assert tifffile.imread(here / "out.tif").shape == SHAPE


def hand_folder() -> Path:
    named = os.environ.get("DIFFUSERBENCH_DATA")
    return (Path(named) if named else Path(__file__).parents[3] / "shared" / "data") / "diffusercam_hand"


@pytest.mark.skipif(
    not hand_folder().is_dir(), reason=f"{hand_folder()} is absent; DIFFUSERBENCH_DATA may name its parent"
)
def test_the_hand_is_a_hand_with_five_fingers_on_black(here: Path) -> None:
    data = hand_folder()
    psf, raw = data / "psf_sample.tif", data / "rawdata_hand_sample.tif"
    words = ["reconstruct", "--psf", str(psf), "--image", str(raw), "--bin", "4", "--out", "hand.tif"]
    assert main([*words, "--iterations", "100"]) == 0
    hand = tifffile.imread(here / "hand.tif")
    assert hand.shape == (300, 400)
    white = np.percentile(hand, 99.9)
    assert 0.04 < np.mean(hand > 0.1 * white) < 0.15, "a hand covers part of the picture"
    assert hand[hand < 0.08 * white].mean() < 0.01 * white, "on black"
    # A strip through the picture's columns crosses four fingers, one through its rows the thumb.
    assert count_runs(hand[:, 282:292].mean(axis=1) > 0.08 * white) == 4
    assert count_runs(hand[78:88, :].mean(axis=0) > 0.08 * white) == 1


def count_runs(line: BoolArray) -> int:
    """Return how many runs of at least 3 lit pixels a line has."""
    edges = np.diff(np.concatenate([[0], line.astype(int), [0]]))
    lengths = np.flatnonzero(edges == -1) - np.flatnonzero(edges == 1)
    return int(np.count_nonzero(lengths >= 3))


def test_every_solver_and_prior_is_on_offer(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reconstruct", "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"[auto, {', '.join(SOLVERS)}; default: auto]" in shown
    assert f"[{', '.join(PRIORS)}; default" in shown


def test_the_help_fits_on_two_screens_with_what_is_rare_at_the_end(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("COLUMNS", "TERMINAL_WIDTH"):
        monkeypatch.setenv(name, "110")
    assert main(["reconstruct", "--help"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 80
    headings = [line for line in lines if line.endswith(":") and not line.startswith(" ")]
    assert headings[-1] == "Rarely needed:"
    assert len(headings) > 6


@pytest.mark.parametrize("words", [("--mixed-depth",), ("--allow-saturated",)])
def test_what_is_about_psf_images_is_refused_with_a_calibration(
    words: tuple[str, ...], here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--calibration", str(here), "--image", "raw.tif", "--out", "../out.tif"]
    assert main(["reconstruct", *arguments, *words]) == 2
    assert f"{words[0]}: for a PSF image" in capsys.readouterr().err


@pytest.mark.usefixtures("here")
def test_a_psf_image_has_no_distance(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", "--method", "wiener"]
    for z_mm in ("-4", "0", "nan"):
        assert main([*words, "--z-mm", z_mm]) == 2
        assert "--z-mm must be a number, above 0 (mm), or inf, not" in capsys.readouterr().err
    for z_mm in ("40", "inf"):
        assert main([*words, "--z-mm", z_mm]) == 2
        assert "Leave the distance (--z-mm) out" in capsys.readouterr().err


@pytest.mark.usefixtures("here")
def test_without_the_diffusers_distance_the_nearest_psf_is_said_to_be_taken(
    capsys: pytest.CaptureFixture[str],
) -> None:
    psfs = np.stack([PSF, np.roll(PSF, 1, axis=0)])[:, None].astype(np.float32)
    places = np.array([[0, 0, 20_000], [0, 0, 40_000]], float)
    save_calibration(Calibration(psfs, places), Path("measured"))
    words = ["reconstruct", "--calibration", "measured", "--image", "raw.tif", "--method", "wiener"]
    words += ["--force"]
    assert main([*words, "--out", "out.tif", "--z-mm", "30"]) == 0
    assert "not refocused to 30 mm" in capsys.readouterr().out
    assert main([*words, "--out", "out.tif", "--z-mm", "40"]) == 0
    assert "refocused" not in capsys.readouterr().out


@pytest.mark.usefixtures("here")
def test_for_a_fit_of_the_depth_the_calibrated_ones_stay_beside_what_is_brought_to_another() -> None:
    psfs = np.stack([PSF, np.roll(PSF, 1, axis=0)])[:, None].astype(np.float32)
    places = np.array([[0, 0, 20_000], [0, 0, 40_000]], float)
    save_calibration(Calibration(psfs, places, geometry=Geometry(10.0, 5.0)), Path("measured"))
    for fit, depths_um in ((False, [30_000]), (True, [20_000, 40_000, 30_000])):
        options = ReconstructionOptions(z_um=30_000, refine_psf=fit)
        job = PictureRequest(image=Path("raw.tif"), calibration=Path("measured"), options=options).prepare()
        assert job.calibration.source_positions_um[:, 2] == pytest.approx(depths_um)
        problem = Problem.of(job.as_measurement(None), job.calibration, options)
        assert problem.depths.z_um == pytest.approx([30_000])


@pytest.mark.usefixtures("here")
def test_uncertainty_is_written_beside_the_picture_and_read_back(capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["reconstruct", "--psf", "psf.tif", "--image", "raw.tif", "--uncertainty", "--rotate", "90"]
    assert main([*asked, *SHARP, "--prior", "l1"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "Uncertainty deviation from 6 pictures" in said
    assert "out-deviation.tif" in said
    assert "out-points.csv" in said
    rows = [line.split(",") for line in Path("out-points.csv").read_text("utf-8").splitlines()[1:]]
    # Turned by 90 degrees: the first column becomes the last row.
    found = sorted((round(float(row)), round(float(column))) for row, column, *_ in rows[:2])
    assert found == sorted((SHAPE[1] - 1 - column, row) for row, column in SOURCES)
    result = open_result(Path("out.tif"))
    assert result.deviation is not None
    assert result.deviation.shape == result.image.shape == (64, 48)
    assert "Uncertainty" in dict(result.facts())
    Path("out-deviation.tif").unlink()
    assert open_result(Path("out.tif")).deviation is None
    assert main([*asked, "--volume", "psf.tif"]) == 2


def test_no_output_replaces_an_input_however_it_is_called(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {path: path.read_bytes() for path in here.iterdir() if path.is_file()}
    photo = here / "raw.tif"
    (here / "link.tif").symlink_to(photo)
    os.link(photo, here / "hard.tif")
    (here / "psfs").mkdir()
    (here / "psfs" / "psf.tif").write_bytes(before[here / "psf.tif"])
    words = ["reconstruct", "--psf", "psfs/psf.tif", "--image", "raw.tif", "--force", "--out"]
    for out in ("raw.tif", "./psfs/../raw.tif", str(photo), "link.tif", "hard.tif", "psfs/psf.tif"):
        assert main([*words, out]) == 2
        assert "no output replaces an input" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in before} == before
