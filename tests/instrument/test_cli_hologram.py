"""``diffuserbench hologram``, ``table7.1`` and ``etendue``: files, figures, and mistakes in words."""

from __future__ import annotations

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from calibration_routines.display.hologram_photograph import (
    display_of_pattern,
    options_of_pattern,
    photograph_hologram,
    require_focus,
    target_of_pattern,
)
from calibration_routines.display.spot_photograph import photograph_spots
from instrument.bench.config_file import parse_config, template
from instrument.cli import main
from instrument.display import hologram_forecast
from instrument.display.alignment import Alignment
from instrument.display.bench_display import bench_display
from instrument.display.hologram import CaptureOptions, field_picture, field_words, prepare_target
from instrument.display.limit import SharedTime, at_most, coarser_mask, limit_lines
from instrument.display.spots import middle_line
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image, write_image
from instrument.files.sample_images import SAMPLES, load_sample
from instrument.files.slm_image import levels_phase, phase_levels, read_slm_image
from recon.errors import InputError
from recon.holography import (
    Display,
    HologramModel,
    HologramOptions,
    HologramStop,
    Limit,
    SpotList,
    compute_hologram,
    compute_spots,
    spot_array,
)
from recon.holography.display import DcTerm, no_mask
from recon.holography.learn import nothing_learned
from recon.holography.pose import Pose
from recon.holography.scores import compare
from recon.holography.spot_list import SpotField
from recon.holography.target import EVERYWHERE


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DIFFUSERBENCH_DEBUG", raising=False)
    small = template().replace("shape = [1080, 1920]", "shape = [96, 128]")
    assert small != template()
    Path("bench.toml").write_text(small.replace("expansion = 16 ", "expansion = 4 "))
    y, x = np.mgrid[:80, :120]
    picture = np.where((y - 40) ** 2 + (x - 60) ** 2 < 500, 220, 60 + x // 2)
    write_image("picture.png", picture.astype(np.uint8))
    return tmp_path


def bench():
    config = parse_config(Path("bench.toml").read_text(), Path("bench.toml"))
    return bench_display(config, ((96, 128), 8.0))


@pytest.mark.usefixtures("here")
def test_the_pattern_file_shows_the_picture(capsys):
    assert main(["hologram", "picture.png", "--iterations", "40"]) == 0
    said = capsys.readouterr().out
    assert "alias-free grid, envelope shade, 1 frame(s)" in said
    assert "limited by frames: many would reach about" in said
    assert "limited by alignment: none is given" in said
    levels, facts = read_slm_image("slm.png")
    assert levels.shape == (96, 128)
    assert (levels[::2, ::2] == levels[1::2, 1::2]).all()
    assert facts["metrics_computed_for"] == {
        "grid": "alias-free", "envelope": "shade", "frames": 1, "phase_levels": "continuous",
    }  # fmt: skip
    display = bench()
    target = prepare_target(read_image("picture.png").pixels, display)
    slm = np.exp(1j * levels_phase(levels, facts["binning"]))[None]
    model = HologramModel(display, [target])
    found = compare(model.seen(slm), model.wanted(), model.peaks[0]).psnr_db
    assert found == pytest.approx(facts["metrics"][0]["psnr_db"], abs=0.3)
    assert found > 20
    assert read_image("slm-preview.png").is_colour


@pytest.mark.usefixtures("here")
def test_a_dark_picture_is_judged_by_its_own_white_and_alpha_is_told(capsys):
    grey = read_image("picture.png").pixels
    files = {"bright.png": grey, "dark.png": (grey.astype(np.uint16) << 4)}
    found = []
    for name, pixels in files.items():
        write_image(name, pixels)
        assert main(["hologram", name, "-n", "5", "--out", f"of-{name}"]) == 0
        found.append(json.loads(Path(f"of-{name}").with_suffix(".json").read_text())["metrics"][0]["psnr_db"])
    assert found[0] == pytest.approx(found[1], abs=0.05)  # 12 bits of 16: 27 dB more by the type's white
    ground = np.stack([grey] * 3 + [np.zeros_like(grey)], axis=-1)
    assert cv2.imwrite("clear.png", ground)
    capsys.readouterr()
    assert main(["hologram", "clear.png", "-n", "1", "--out", "clear-slm.png"]) == 0
    assert "clear.png: alpha channel left out." in capsys.readouterr().err


@pytest.mark.usefixtures("here")
def test_colours_that_are_averaged_are_told_and_light_below_zero_is_refused(capsys):
    grey = read_image("picture.png").pixels[:, :80]
    colour = np.stack([grey, 255 - grey, grey], axis=-1)
    assert field_words(grey, "cover") == field_words(colour, "cover", in_colour=True) == ""
    assert field_words(np.stack([grey] * 3, axis=-1), "cover") == ""
    assert "the mean of its channels is shown" in field_words(colour, "cover")
    for side in (40, 1200):  # enlarged, and finer than the field
        np.save("below.npy", np.linspace(-1, 1, side * side, dtype=np.float32).reshape(side, side))
        assert main(["hologram", "below.npy"]) == 2
        assert "values below 0 (the least is -1)" in capsys.readouterr().err
    holes = np.where(grey > grey.mean(), np.nan, grey.astype(float))
    with pytest.raises(BenchError, match=f"no finite numbers .*: {np.count_nonzero(np.isnan(holes))}"):
        field_picture(holes, fit="cover")


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("colour", [False, True])
def test_lift_and_srgb_are_parts_of_the_pictures_own_white(colour):
    grey = np.tile(np.linspace(0, 4095, 96).astype(np.uint16), (96, 1))  # 12 bits of 16
    pixels = np.stack([grey, 0 * grey, 0 * grey], axis=-1) if colour else grey
    options = HologramOptions(lift=0.2, srgb=True, envelope="ignore")
    dark, bright = (prepare_target(p, bench(), options) for p in (pixels, pixels / pixels.max()))
    np.testing.assert_allclose(dark.image, bright.image, atol=1e-12)
    assert dark.image.min() / dark.image.max() == pytest.approx(0.2, abs=0.01)
    dim = np.array([[64, 128], [0, 32]], np.uint8)  # decoded as what its file says, then brightened
    assert field_picture(dim, srgb=True)[0, 0] == pytest.approx(0.05127 / 0.21586, abs=1e-4)


@pytest.mark.usefixtures("here")
def test_without_a_lens_the_fields_size_is_said_and_photographs_are_refused(capsys):
    assert main(["hologram", "picture.png", "--iterations", "3", "--distance-mm", "80"]) == 0
    display = replace(bench(), distance_mm=80.0)
    assert (
        f"the picture's field is {display.field_mm:.4g} mm wide, 80 mm behind the mask"
        in capsys.readouterr().err
    )
    _, facts = read_slm_image("slm.png")
    assert facts["options"]["distance_mm"] == 80.0
    config = parse_config(Path("bench.toml").read_text(), Path("bench.toml"))
    with pytest.raises(BenchError, match="80 mm away without a lens"):
        display_of_pattern(config, ((96, 128), 8.0), facts)
    with pytest.raises(BenchError, match="80 mm away without a lens"):  # as the window asks for it
        photograph_hologram(None, [], display, None)
    taught, still = nothing_learned(display), np.zeros((1, 1, 2))
    learned = Alignment(Pose(), {}, still, 1.0, {}, display.mask.shape, simulated=True, learned=taught)
    assert learned.of(replace(display, distance_mm=None)).learned is not None
    with pytest.raises(FileError, match="learned behind the display's Fourier lens"):
        learned.of(display)
    assert HologramOptions().display_of(display).distance_mm == 80.0


@pytest.mark.usefixtures("here")
def test_only_what_is_in_focus_on_the_camera_is_photographed():
    planes = ["picture.png", "picture.png", "--z-mm", "3", "--z-mm", "-3"]
    assert main(["hologram", *planes, "--iterations", "1"]) == 0
    picture, (_, facts) = read_image("picture.png").pixels, read_slm_image("slm.png")
    assert facts["z_mm"] == [3.0, -3.0]
    elsewhere = r"in focus 3, -3 mm behind the focal plane, where the camera does not look"
    with pytest.raises(BenchError, match=elsewhere):
        target_of_pattern(picture, bench(), facts)
    with pytest.raises(BenchError, match="in focus 3 mm"):  # as the window asks for it
        photograph_hologram(None, [], bench(), prepare_target(picture, bench(), z_mm=3.0))
    some = facts | {"z_mm": [0.0, 3.0]}
    assert target_of_pattern(picture, bench(), some).z_mm == 0
    with pytest.raises(BenchError, match="and lose the others"):
        require_focus(some["z_mm"], refined=True)
    deep = spot_array(2, 2, z_mm=3.0)
    with pytest.raises(InputError, match="4 of 4 spots are in focus before or behind"):
        photograph_spots(None, np.ones((1, 96, 128)), bench(), deep, CaptureOptions(), HologramOptions())


def test_eight_bits_and_binning_survive_the_file():
    phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (5, 6))
    levels = phase_levels(phase, 3)
    assert levels.shape == (15, 18)
    back = levels_phase(levels, 3)
    assert np.abs(np.angle(np.exp(1j * (back - phase)))).max() <= np.pi / 256 + 1e-9


@pytest.mark.usefixtures("here")
def test_frames_colours_planes_and_video_have_files_of_their_own(capsys):
    short = ["--iterations", "3"]
    assert main(["hologram", "picture.png", "--frames", "2", *short]) == 0
    assert Path("slm-frame1.png").exists()
    assert Path("slm-frame2.png").exists()
    grey = read_image("picture.png").pixels
    write_image("colour.png", np.stack([grey, grey // 2, 255 - grey], axis=-1))
    assert main(["hologram", "colour.png", "--color", "--out", "c.png", *short]) == 0
    nm = [json.loads(Path(f"c-{c}.json").read_text())["wavelength_nm"] for c in ("red", "green", "blue")]
    assert nm == [638.0, 520.0, 450.0]
    planes = ["picture.png", "picture.png", "--z-mm", "0", "--z-mm", "60", "--out", "p.png"]
    assert main(["hologram", *planes, *short]) == 0
    assert len(json.loads(Path("p.json").read_text())["metrics"]) == 2
    Path("film").mkdir()
    for number in range(2):
        write_image(f"film/{number}.png", np.roll(grey, number, axis=1))
    capsys.readouterr()
    assert main(["hologram", "film", "--video", "--out", "v.png", *short]) == 0
    first, second = (json.loads(Path(f"v-000{n}.json").read_text())["metrics"][0]["psnr_db"] for n in (1, 2))
    assert second > first + 1  # six iterations in all, the second frame started warm


def seen_db(slm, display, picture, share=1.0):
    """PSNR of SLM fields as another run of the model sees them."""
    target = prepare_target(picture, display, share=share)
    model = HologramModel(display, [target])
    part = EVERYWHERE.shrunk(share).part(model.wanted().shape)
    return compare(model.seen(slm)[part], model.wanted()[part], model.peaks[0]).psnr_db


@pytest.mark.usefixtures("here")
def test_a_complex_pattern_shows_more_than_its_phase_alone():
    assert main(["hologram", "picture.png", "--complex", "--out", "slm.npy", "--iterations", "40"]) == 0
    field = np.load("slm.npy")
    assert np.iscomplexobj(field)
    assert 0.5 < np.abs(field).max() <= 1.0 + 1e-6
    facts = json.loads(Path("slm.json").read_text())
    assert facts["options"]["complex_slm"] is True
    assert 0.03 < facts["efficiency"] < 0.15
    grey = read_image("picture.png").pixels
    found = seen_db(field[None], bench(), grey)
    assert found == pytest.approx(facts["metrics"][0]["psnr_db"], abs=0.2)
    assert found > seen_db(np.exp(1j * np.angle(field))[None], bench(), grey) + 2


@pytest.mark.usefixtures("here")
def test_each_colour_is_computed_for_its_own_wavelength():
    grey = read_image("picture.png").pixels
    colour = np.stack([grey, np.roll(grey, 20, axis=1), 255 - grey], axis=-1)
    write_image("colour.png", colour)
    lasers = ["--wavelengths", "660", "532", "473"]
    assert main(["hologram", "colour.png", "--color", *lasers, "--out", "c.png", "--iterations", "30"]) == 0
    config = parse_config(Path("bench.toml").read_text(), Path("bench.toml"))
    for channel, (name, nm) in enumerate((("red", 660.0), ("green", 532.0), ("blue", 473.0))):
        levels, facts = read_slm_image(f"c-{name}.png")
        slm = np.exp(1j * levels_phase(levels, facts["binning"]))[None]
        own = bench_display(config, ((96, 128), 8.0), wavelength_nm=nm)
        assert facts["field_share"] == pytest.approx(473 / nm, abs=1e-6)  # all of the blue one's size
        found = seen_db(slm, own, colour[..., channel], 473 / nm)
        assert found == pytest.approx(facts["metrics"][0]["psnr_db"], abs=0.3)
        other = bench_display(config, ((96, 128), 8.0), wavelength_nm=nm - 80)
        assert seen_db(slm, other, colour[..., channel], 473 / nm) < found - 2.5  # red 2.9: half black


@pytest.mark.usefixtures("here")
def test_an_slm_of_few_levels_gets_a_pattern_on_them(capsys):
    assert main(["hologram", "picture.png", "--levels", "4", "--iterations", "40"]) == 0
    levels, facts = read_slm_image("slm.png")
    assert set(np.unique(levels)) == {0, 64, 128, 192}
    assert facts["metrics_computed_for"]["phase_levels"] == 4
    slm = np.exp(1j * levels_phase(levels, facts["binning"]))[None]
    found = seen_db(slm, bench(), read_image("picture.png").pixels)
    assert found == pytest.approx(facts["metrics"][0]["psnr_db"], abs=0.05)
    again = HologramModel(bench(), [target_of_pattern(read_image("picture.png").pixels, bench(), facts)])
    refined = compute_hologram(
        again, initial=slm, iterations=5, phase_levels=options_of_pattern(facts).phase_levels
    )
    assert set(np.unique(phase_levels(refined.phase_rad))) <= {
        0,
        64,
        128,
        192,
    }  # by the camera in the loop too
    assert main(["hologram", "picture.png", "--levels", "5", "--out", "five.png"]) == 2
    assert "5 phase levels" in capsys.readouterr().err


@pytest.mark.usefixtures("here")
def test_spots_without_a_mask_come_from_an_array_or_a_list(capsys):
    assert main(["hologram", "--spots", "4x6", "--expansion", "1"]) == 0
    assert "24 spots: " in capsys.readouterr().out
    levels, facts = read_slm_image("slm.png")
    assert facts["spot_scores"]["deviation"] < 0.005
    assert facts["expansion"] == 1
    assert len(facts["spots"]["places"]) == 24
    config = parse_config(Path("bench.toml").read_text(), Path("bench.toml"))
    display = bench_display(config, ((96, 128), 8.0), expansion=1)
    assert len(np.unique(display.mask.field())) == 1
    assert display.mask.design_wavelength_nm == config.display.wavelength_nm
    shown = SpotField(display, spot_array(4, 6)).score(
        np.exp(1j * levels_phase(levels, facts["binning"]))[None]
    )
    assert shown.efficiency == pytest.approx(facts["spot_scores"]["efficiency"], rel=1e-3)
    assert Path("slm-preview.png").is_file()
    Path("list.csv").write_text("y,x,intensity\n0.3,0.4,1\n0.6,0.7,two\n")
    assert main(["hologram", "--spots", "list.csv", "--out", "list.png"]) == 2
    assert "line 3: intensity is 'two'" in capsys.readouterr().err
    Path("list.csv").write_text("y,x,intensity\n0.3,0.4,1\n0.6,0.7,2\n")
    assert main(["hologram", "--spots", "list.csv", "--out", "list.png"]) == 0
    for wrong, words in (
        (["picture.png", "--spots", "2x2"], "picture.png and --spots exclude each other"),
        (["--spots", "2x2", "--video"], "--spots these do not apply: --video (for a picture)"),
        (["--spots", "2x2", "--limit", "--srgb"], "--limit (for a limit); --srgb (for a picture or a limit)"),
        (["picture.png", "--limit", "--frames", "2"], "--limit these do not apply: --frames"),
        (["--spots", "nowhere.csv"], "ROWSxCOLUMNS or a CSV file"),
    ):
        assert main(["hologram", *wrong, "--out", "other.png"]) == 2
        assert words in capsys.readouterr().err


def test_light_that_no_slm_modulates_is_a_spot_in_the_middle_and_told():
    flat = no_mask((96, 128), design_wavelength_nm=532.0)
    display = Display((96, 128), flat, slm_pitch_um=8.0, wavelength_nm=532.0, dc=DcTerm(0.1))
    wanted = spot_array(4, 4)
    found, scores = compute_spots(display, wanted, HologramOptions(iterations=20))
    middle = SpotList(np.array([[0.5, 0.5], *wanted.places]), np.ones(17), np.zeros(17))
    relative = SpotField(display, middle).score(found.slm).relative
    times = f"{relative[0] / relative[1:].mean():.2g}"
    assert f"a spot {times} times as bright" in middle_line(display, wanted, scores)
    assert middle_line(display, spot_array(5, 5), scores) == "", "there one was asked for"
    assert middle_line(replace(display, dc=DcTerm(0.0)), wanted, scores) == ""


@pytest.mark.usefixtures("here")
def test_the_limit_is_said_before_anything_is_computed(capsys):
    assert main(["hologram", "picture.png", "--limit", "--iterations", "10", "--lift", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "limit: none is in sight through this mask" in said
    assert "black at 0.3 of white" in said
    assert "black at 0.1 of white" not in said
    assert "more frames (--frames): up to about" in said
    assert "half of the field, along each axis (--expansion 1): " in said
    assert not Path("slm.png").exists()
    assert main(["hologram", "picture.png", "--limit", "--color"]) == 2
    lifted = HologramOptions(lift=0.2, envelope="correct")
    assert prepare_target(read_image("picture.png").pixels, bench(), lifted).image.min() >= 0.2


def test_the_time_of_a_limit_is_that_of_all_its_searches() -> None:
    asked = HologramOptions(time_s=10.0)
    shared, given = SharedTime(asked, 4), []
    for took_s in (1.0, 8.0, 3.0, 0.0):
        given.append(shared.next(asked).time_s)
        shared.took(took_s)
    assert given == pytest.approx([2.5, 3.0, 0.5, 1e-3])
    assert SharedTime(HologramOptions(), 4).next(HologramOptions()).time_s is None


def test_a_search_without_time_is_no_advice() -> None:
    told = Limit(
        np.inf, 20.0, np.ones(4), np.ones(4), HologramStop.TIME, 0.1, np.ones((1, 4, 4), np.complex64)
    )
    for stop in (HologramStop.TIME, HologramStop.CANCELLED, HologramStop.ITERATIONS):
        assert at_most(replace(told, stop_reason=stop)) == "not known after so short a search"
    assert at_most(replace(told, stop_reason=HologramStop.QUALITY)) == "no limit in sight"
    mask = no_mask((4, 4), design_wavelength_nm=532.0)
    early = replace(told, wanted=np.ones(4), reached=np.full(4, 0.5))
    lines = limit_lines(
        [early], Display((4, 4), mask, slm_pitch_um=8.0, wavelength_nm=532.0), HologramOptions()
    )
    assert "limit: not known with these phases after so short a search" in lines[0]
    assert all(line.endswith("50% reached so far") for line in lines[1:])
    assert at_most(replace(told, bound_db=21.0)) == "at most 21.00 dB"


def test_the_limit_says_why_coarse_contrast_is_not_reached_behind_a_lens_and_near():
    mask = no_mask((96, 96), design_wavelength_nm=532.0)
    lens = Display((96, 96), mask, slm_pitch_um=16.0, wavelength_nm=532.0)
    reached, columns = np.array([0.3, 0.3, 0.9, 0.3]), np.ones((1, 96, 96), np.complex64)
    found = Limit(20.0, 19.0, np.full(4, 0.5), reached, HologramStop.CONVERGED, 1.0, columns)
    near = limit_lines([found], replace(lens, distance_mm=4.0), HologramOptions())
    assert "light does not go so far aside" in near[1]
    assert "more contrast than so many SLM pixels can make" in near[4]
    assert "within an SLM pixel" in limit_lines([found], lens, HologramOptions())[1]
    far = replace(found, bound_db=np.inf, reached_db=45.1)
    assert "none is in sight with these phases; 45.10 dB" in limit_lines([far], lens, HologramOptions())[0]
    assert coarser_mask(replace(lens, distance_mm=4.0)) is None


@pytest.mark.usefixtures("here")
def test_a_fovea_has_its_own_figure_where_it_is(capsys):
    asked = ["--loss", "spatial", "--centre", "0.3,0.7", "--radius", "0.15", "--iterations", "40"]
    assert main(["hologram", "picture.png", "-q", "16", *asked]) == 0
    said = re.search(r"seen: ([\d.]+) dB.*fovea ([\d.]+) dB", capsys.readouterr().out)
    assert said is not None
    whole_db, fovea_db = (float(value) for value in said.groups())
    assert fovea_db > whole_db + 5
    facts = json.loads(Path("slm.json").read_text())
    assert facts["metrics"][0]["fovea_psnr_db"] == pytest.approx(fovea_db, abs=0.01)
    kept = options_of_pattern(facts)
    assert (kept.loss, kept.centre, kept.radius) == ("spatial", (0.3, 0.7), 0.15)
    assert options_of_pattern({**facts, "own_weights": True}).loss == "frequency"
    y, x = np.mgrid[0.5:64, 0.5:64] / 64
    wanted = np.full((64, 64), 0.5)
    seen = wanted + 0.1 * (np.hypot(y - 0.3, x - 0.7) > 0.2)
    seen *= wanted.mean() / seen.mean()
    scores = compare(seen, wanted, 1.0, kept.field_weights())
    inside = np.hypot(y - 0.3, x - 0.7) < 0.14
    expected = 10 * np.log10(1 / np.mean((seen - wanted)[inside] ** 2))
    assert scores.fovea_psnr_db == pytest.approx(expected, abs=0.01)
    assert scores.asked_psnr_db == scores.fovea_psnr_db
    assert compare(seen, wanted, 1.0).fovea_psnr_db is None


@pytest.mark.usefixtures("here")
def test_an_existing_file_is_spared_and_quality_ends_the_work(capsys):
    assert main(["hologram", "picture.png", "--psnr", "15"]) == 0
    assert "the requested PSNR is reached" in capsys.readouterr().out
    assert main(["hologram", "picture.png"]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["nowhere.png"], "no such file"),
        (["picture.png", "pattern.png"], "no such picture. Did you mean --out pattern.png?"),
        (["picture.png", "--expansion", "5"], "must be a square"),
        (["picture.png", "--out", "slm.tif"], "written as .png"),
        (["picture.png", "--complex"], "written as .npy"),
        (["picture.png", "--weights", "picture.png"], "loss that takes them: 'spatial'"),
        (["picture.png", "--loss", "spatial", "--centre", "2"], "must be Y,X"),
        (["picture.png", "picture.png"], "Give --z-mm once for each"),
        (["picture.png", "--color"], "needs a colour picture"),
        (["picture.png", "--z-mm", "100000"], "too far"),
        (["picture.png", "--distance-mm", "2", "--z-mm", "20"], "the farthest plane's distance"),
        (["picture.png", "--distance-mm", "-2"], "distance"),
        (["black.png"], "black.png: is black everywhere"),
        (["picture.png", "black.png", "--z-mm", "0", "--z-mm", "9"], "black.png: is black everywhere"),
        (["black.png", "--limit"], "black.png: is black everywhere"),
        (["beside.png"], "beside.png: is black in the square that is shown"),
        (["red.png", "--color"], "red.png: its green is black everywhere"),
        (["video.npy", "--video"], "video.npy: frame 2 is black everywhere"),
    ],
)
def test_mistakes_end_in_a_sentence(capsys, arguments, words):
    picture = np.zeros((8, 20, 3), np.uint8)
    write_image("black.png", picture)
    picture[:, 0] = 9
    write_image("beside.png", picture)
    picture[:] = (9, 0, 0)
    write_image("red.png", picture)
    np.save("video.npy", np.stack([picture[..., 0], picture[..., 1] * 0]))
    assert main(["hologram", *arguments]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert "Traceback" not in error


@pytest.mark.usefixtures("here")
def test_a_mask_file_must_fit():
    config = parse_config(
        Path("bench.toml").read_text().replace('# mask_file = "mask.png"', 'mask_file = "m.png"'),
        Path("bench.toml"),
    )
    bits = np.random.default_rng(1).integers(0, 2, (96, 128)).astype(np.uint8)
    write_image("m.png", bits * 255)
    display = bench_display(config, ((96, 128), 8.0))
    np.testing.assert_array_equal(display.mask.levels, bits)
    write_image("m.png", bits[:50])
    with pytest.raises(FileError, match="SLM and expansion need"):
        bench_display(config, ((96, 128), 8.0))
    with pytest.raises(BenchError, match="cannot be binned"):
        bench_display(config, ((95, 128), 8.0))


@pytest.mark.usefixtures("here")
@pytest.mark.parametrize("fit", ["cover", "contain", "stretch"])
def test_a_wide_picture_keeps_its_shape_unless_stretched(fit):
    image = np.zeros((100, 200), np.uint8)
    image[25:75, 75:125] = 255  # a square
    target = prepare_target(image, bench(), HologramOptions(fit=fit, envelope="ignore")).image > 0.5
    rows, columns = target.any(axis=1).mean(), target.any(axis=0).mean()
    expected = {"cover": (0.5, 0.5), "contain": (0.25, 0.25), "stretch": (0.5, 0.25)}[fit]
    assert (rows, columns) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize("name", list(SAMPLES))
def test_samples_are_pictures(name):
    image = load_sample(name, (64, 100))
    assert image.shape == (64, 100)
    assert image.min() >= 0
    assert image.max() <= 1
    assert image.std() > 0.05


@pytest.mark.usefixtures("here")
def test_table_7_1_keeps_the_dissertations_order_on_both_grids(capsys):
    small = ["--slm", "48x64", "--iterations", "40", "--pictures", "leaves", "-q", "4", "-q", "16"]
    assert main(["table7.1", *small, "--out", "t"]) == 0
    assert "leaves: drawn here" in capsys.readouterr().out
    with Path("t.csv").open() as file:
        lines = [line for line in csv.DictReader(file) if line["picture"] == "leaves"]
    assert len(lines) == 2 * 4 * 3
    for q in ("4", "16"):
        for optimised, judged in (("dissertation", "dissertation"), ("alias-free", "alias-free")):
            whole, crop = (
                {
                    line["method"]: float(line[column])
                    for line in lines
                    if (line["expansion"], line["optimised_on"], line["judged_on"]) == (q, optimised, judged)
                }
                for column in ("psnr_db", "crop_psnr_db")
            )
            assert whole["one-step"] < whole["none"] < whole["frequency"]
            assert whole["spatial"] < whole["frequency"]
            assert crop["one-step"] < crop["none"] < crop["frequency"] < crop["spatial"]
    picture = read_image("t.png")
    assert picture.is_colour
    assert (picture.pixels[:, [0, -1]] == 255).all(), "words are cut off"
    assert main(["table7.1", "--pictures", "cat"]) == 2
    assert "no sample picture 'cat'" in capsys.readouterr().err


def test_etendue_prints_the_dissertations_example(capsys):
    gaea = ["--slm", "2464x4160", "--pitch-um", "3.74", "--wavelength-nm", "532", "-q", "1"]
    assert main(["etendue", *gaea, "--fov", "120", "--eyebox-mm", "10"]) == 0
    said = capsys.readouterr().out
    assert "paraxial 1.06 mm" in said
    assert "leaves 12.7 degrees" in said
    assert main(["etendue", "--slm", "big"]) == 2


def test_etendue_draws_what_it_says(tmp_path, capsys):
    page = tmp_path / "page.png"
    asked = ["etendue", "--fov", "60", "--figure", str(page)]
    assert main(asked) == 0
    assert f"Wrote       {page}" in capsys.readouterr().out
    assert cv2.imread(str(page)).std() > 10
    assert main(asked) == 2
    assert "exists already" in capsys.readouterr().err
    assert main([*asked, "--force"]) == 0
    assert main(["etendue", "--figure", "page.txt"]) == 2


@pytest.mark.usefixtures("here")
def test_what_it_takes_is_told_before_and_nothing_is_written(capsys, monkeypatch):
    assert main(["hologram", "picture.png", "--iterations", "8", "--explain"]) == 0
    assert ", 8 of them; " in capsys.readouterr().out
    assert main(["hologram", "picture.png", "--iterations", "3", "--explain"]) == 0
    assert re.search(r"[1-9]\d* ms an iteration, 3 of them", capsys.readouterr().out)
    monkeypatch.setattr(hologram_forecast, "SOLVED_S", 1e-9)  # one iteration, and then the first ones
    write_image("colour.png", np.stack([read_image("picture.png").pixels] * 3, axis=-1))
    given = ["hologram", "colour.png", "--iterations", "90", "--color", "--explain"]
    assert main(given) == 0
    assert re.search(r"ms a pattern, 3 of them; \d", capsys.readouterr().out)
    assert main([*given, "--psnr", "90"]) == 0
    assert "at most " in capsys.readouterr().out
    assert not list(Path().glob("slm*"))
