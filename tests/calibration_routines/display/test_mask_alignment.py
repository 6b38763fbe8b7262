"""Mask alignment and captures on a small simulated display, which the procedure knows nothing about."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from calibration_routines.display.display_io import DisplayBench
from calibration_routines.display.mask_alignment import (
    AlignmentFailedError,
    AlignmentProcedure,
    AlignmentSettings,
    MaskAlignment,
)
from calibration_routines.display.mask_stage import PlacementCost
from calibration_routines.display.slm_calibration import SlmProcedure
from calibration_routines.display.slm_flatness import measure_flatness
from calibration_routines.display.slm_phases import MAX_PHASE_ERROR_RAD, steady_phases
from calibration_routines.display.slm_table import measure_look_up_table
from calibration_routines.options import Size
from calibration_routines.purpose import CalibrationError
from drivers.simulated.display import DisplayWorld
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template
from instrument.cli import main
from instrument.display.alignment import load_alignment
from instrument.display.bench_display import bench_display
from instrument.files.errors import BenchError
from instrument.files.images import write_image
from instrument.files.slm_image import SlmCorrection, load_slm_correction, phase_levels
from recon.errors import InputError
from recon.holography.pose import Pose
from recon.holography.slm_response import MODES, mode

SMALL = {
    "shape": "[200, 280]",
    "shift_um": "[31.0, -42.0]",
    "z_um": "150.0",
    "roll_mrad": "4.0",
    "pitch_mrad": "2.0",
    "yaw_mrad": "-1.5",
    "magnification": "0.002",
    "relay_distortion_um": "0.0",
}


def small(**changes: str) -> str:
    text = template("display")
    for key, value in (SMALL | changes).items():
        text, count = re.subn(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
        assert count == 1, key
    return text


SETTINGS = AlignmentSettings(reach=8.0, depth_um=100.0, spots=25, refinements=2, section_pictures=2)


def aligned(bench: Bench, settings: AlignmentSettings = SETTINGS):
    assert bench.stage is not None
    assert bench.slm is not None
    bench.stage.home()
    display = bench_display(bench.config, (bench.slm.shape, bench.slm.pixel_pitch_um))
    return MaskAlignment(DisplayBench(bench, 2), display, settings).run()


@pytest.mark.slow
def test_it_says_so_when_it_fails_and_puts_the_stage_back() -> None:
    text = small(shift_um="[400.0, -42.0]", shape="[120, 168]")  # far outside what is searched
    with Bench(parse_config(text, None)).open() as bench:
        assert bench.stage is not None
        with pytest.raises(AlignmentFailedError, match="failed: spots reach"):
            aligned(bench)
        assert bench.stage.commanded_position() == {axis.name: 0.0 for axis in bench.stage.axes}


@pytest.mark.parametrize(
    ("changes", "settings", "words"),
    [
        ({"expansion": "1"}, {}, "has no mask"),
        ({}, {"division": Size(60, 5)}, "cannot be divided into"),
        ({}, {"reach": 1e6, "max_frames": 80}, "may be taken. Search less"),
        ({}, {"depth_um": 1e9, "max_frames": 80}, "may be taken. Search less"),
        ({}, {"depth_um": 1e9}, "458 may be taken. Search less"),
    ],
)
def test_what_can_only_fail_is_refused_before_anything_moves(changes, settings, words) -> None:
    with Bench(parse_config(small(**changes), None)).open() as bench:
        with pytest.raises((BenchError, InputError), match=words):
            AlignmentProcedure(AlignmentSettings(**settings)).outlook(bench)
        if not changes:
            assert AlignmentProcedure().outlook(bench)


def test_another_mask_is_noticed_at_once() -> None:
    text = small().replace("mask_seed = 0", "mask_seed = 1", 1)
    with (
        Bench(parse_config(text, None)).open() as bench,
        pytest.raises(AlignmentFailedError, match="speckle"),
    ):
        aligned(bench)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"wavelength_nm": "653.4", "sensor_roll_mrad": "150.0"},
            "1.0 % smaller .*wavelength_nm is 653.[3-5]",
        ),
        ({"focal_mm": "35.6"}, "1.7 % larger .*focal_mm 35.6"),
    ],
)
def test_a_wrong_wavelength_or_focal_length_is_told_by_the_scale(changes: dict[str, str], words: str) -> None:
    head, tail = small().split("\n[simulated_display]")
    for key, value in changes.items():
        tail = re.sub(rf"(?m)^{key} = .*", "", tail) + f"\n{key} = {value}\n"
    with (
        Bench(parse_config(f"{head}\n[simulated_display]{tail}", None)).open() as bench,
        pytest.raises(AlignmentFailedError, match=words),
    ):
        aligned(bench)


def test_as_many_frames_may_be_taken_as_the_search_of_the_bench_at_hand_needs() -> None:
    config = parse_config(template("display"), None)
    assert config.display.slm_binning == 2
    for expansion, frames in ((16, 80), (4, 84 + 58)):
        display = bench_display(config, ((1080, 1920), 8.0), expansion=expansion)
        AlignmentSettings().require(display)
        assert AlignmentSettings().most_frames(display) == frames
        many = AlignmentSettings(refinements=80, section_pictures=6)  # 76 and 2 more than by default
        many.require(display)
        assert many.most_frames(display) == frames + 78
    with pytest.raises(BenchError, match=r"takes 84 pictures .* 90 may be taken"):
        AlignmentSettings(max_frames=90).require(display)


def test_frames_are_counted_and_limited() -> None:
    few = AlignmentSettings(reach=16.0, depth_um=300.0, spots=27, max_frames=4)
    with (
        Bench(parse_config(small(), None)).open() as bench,
        pytest.raises(AlignmentFailedError, match="gave up"),
    ):
        aligned(bench, few)


NEAR = {"shift_um": "[6.0, -4.0]", "z_um": "200.0", "roll_mrad": "0.5", "magnification": "0.0005"}
NEAR |= {"shape": "[120, 168]"}  # the same words and directions as from 200 x 280, in 0.57 of the time


def with_axes(bench: Bench, change) -> DisplayWorld:
    """Connect the stage's carriage to the mask in another way."""
    (world,) = bench.shared.values()
    assert isinstance(world, DisplayWorld)
    plain = world._stage
    world.mount_mask(lambda: change(dict(plain())))
    return world


@pytest.mark.slow
def test_axes_that_go_the_other_way_are_found_out_and_used(monkeypatch: pytest.MonkeyPatch) -> None:
    # Spots see so little that they never ask for a move: what all light tells is taken out.
    monkeypatch.setattr(PlacementCost, "of_difference_db", lambda *_: 99.0)
    with Bench(parse_config(small(**NEAR), None)).open() as bench:
        turn = {"x_um": -1, "z_um": -1}
        world = with_axes(bench, lambda at: {name: turn.get(name, 1) * value for name, value in at.items()})
        report = aligned(bench)
        assert report.directions == {"x_um": -1, "y_um": 1, "z_um": -1, "roll_mrad": 1}
        assert any("reversed: x_um, z_um" in words for words in report.log)
        assert any("um of depth are left and cost" in words for words in report.log)
        left = world.pose()
    assert np.hypot(left.shift_x_um, left.shift_y_um) < 4.0
    assert abs(left.z_um) < 3


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "axis"),
    [
        (lambda at: at | {"y_um": 0.0}, "y_um"),
        (lambda at: at | {"x_um": at["y_um"], "y_um": at["x_um"]}, "x_um"),
    ],
    ids=["stuck", "exchanged"],
)
def test_an_axis_that_does_something_else_ends_the_alignment_in_words(change, axis) -> None:
    with Bench(parse_config(small(**NEAR), None)).open() as bench:
        assert bench.stage is not None
        with_axes(bench, change)
        with pytest.raises(AlignmentFailedError, match=f"Axis {axis} of .* was moved by .* the spots say"):
            aligned(bench)
        assert bench.stage.commanded_position() == {axis.name: 0.0 for axis in bench.stage.axes}


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_from_the_command_line_to_a_photographed_hologram(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(small())
    y, x = np.mgrid[:128, :128]
    write_image("picture.png", np.where((y - 64) ** 2 + (x - 50) ** 2 < 900, 200, 90).astype(np.uint8))
    assert main(["hologram", "picture.png", "--out", "blind.png", "-n", "30"]) == 0
    assert main(["align", "mask", "--reach", "16", "--depth-um", "300", "--moves", "1"]) == 0
    assert "(SIMULATED)" in capsys.readouterr().out
    found = load_alignment(Path("alignment.json"))
    assert found.simulated
    first = json.loads(Path("alignment.json").read_text())["found_at"]
    assert first["shift_x"] == pytest.approx(31.0 / 4, abs=0.4)
    assert first["shift_y"] == pytest.approx(-42.0 / 4, abs=0.4)
    assert first["roll_mrad"] == pytest.approx(4.0, abs=1.0)
    assert first["scale"] == pytest.approx(0.002, abs=0.0012)
    assert first["z_um"] == pytest.approx(150.0, abs=90.0)
    assert found.stage_position["x_um"] == pytest.approx(-31.0, abs=3.0)
    assert abs(found.pose.shift_x) < 0.6
    assert 0.3 < found.efficiency < 1.1
    assert all(error > 0 for name, error in found.error.items() if name != "cubic")
    facts = json.loads(Path("alignment.json").read_text())
    assert facts["axis_directions"] == {"x_um": 1, "y_um": 1, "z_um": 1, "roll_mrad": 1}
    assert -1e-3 < facts["psnr_lost_db"] < 3  # next to nothing is left, of either sign
    assert 0 <= facts["repeatability_db"] < 3
    assert found.pose.cubic == 0
    assert np.abs(found.rest).max() < 1.5
    assert Path("alignment.png").exists()
    aligned_to = ["--alignment", "alignment.json"]
    assert main(["hologram", "picture.png", "--out", "sharp.png", "-n", "30", *aligned_to]) == 0
    figures = {}
    for name, options in (("blind", []), ("sharp", aligned_to)):
        capsys.readouterr()
        arguments = ["--capture", f"{name}-seen.png", "--target", "picture.png", "--average", "2"]
        assert main(["show", f"{name}.png", *arguments, *options]) == 0
        said = capsys.readouterr().out
        assert "(SIMULATED)" in said
        quality = re.search(r"photographed: ([\d.]+) dB", said)
        assert quality is not None
        figures[name] = float(quality[1])
    assert figures["sharp"] > figures["blind"] + 4
    # Nobody there to switch the laser off: the background is estimated, and that costs little.
    as_is = ["--capture", "as-is.png", "--target", "picture.png", "--average", "2", "--as-is"]
    assert main(["show", "sharp.png", *as_is, *aligned_to]) == 0
    quality = re.search(r"photographed: ([\d.]+) dB", capsys.readouterr().out)
    assert quality is not None
    assert float(quality[1]) == pytest.approx(figures["sharp"], abs=1.0)
    # The camera in the loop gains, and the refined pattern shows again what it gained.
    loop = ["--capture", "loop.png", "--target", "picture.png", "--average", "2", "--refine", "2"]
    assert main(["show", "sharp.png", *loop, *aligned_to]) == 0
    gained = re.search(r"loop: ([\d.]+) dB -> ([\d.]+) dB", capsys.readouterr().out)
    assert gained is not None
    assert float(gained[2]) > float(gained[1]) + 0.1
    assert Path("sharp-refined.png").exists()
    assert main(["show", "sharp.png", "--capture", "sharp-seen.png", "--target", "picture.png"]) == 2
    assert main(["show", "sharp.png", "--seconds", "0"]) == 0


def test_levels_go_through_the_look_up_table_once() -> None:
    gamma = 2 * np.pi * (np.arange(256) / 255) ** 1.5
    correction = SlmCorrection(gamma, np.full((4, 5), 0.5))
    wanted = np.random.default_rng(0).uniform(0, 2 * np.pi, (40, 50))
    shown = gamma[correction.apply(phase_levels(wanted))] + 0.5
    assert np.abs(np.angle(np.exp(1j * (shown - wanted)))).max() < 0.06
    ideal = phase_levels(wanted)
    np.testing.assert_array_equal(SlmCorrection.ideal().apply(ideal), ideal)


AT_ITS_PLACE = {"shift_um": "[0.0, 0.0]", "z_um": "0.0", "roll_mrad": "0.0", "magnification": "0.0"}
BENT = "settle_ms = 0.0\nlut_gamma = 1.4\nphase_at_full_level_rad = 7.2"


def test_the_look_up_table_is_measured_through_an_unknown_mask() -> None:
    """The mask is misplaced, and need not be known: interference of two halves of the SLM tells the phase."""
    text = small().replace("settle_ms = 30.0", BENT)
    with Bench(parse_config(text, None)).open() as bench:
        found = measure_look_up_table(DisplayBench(bench, 2), n_levels=17)
    true = 7.2 * (np.arange(256) / 255) ** 1.4
    assert np.abs(found.correction.phase_of_level_rad - true).max() < 0.05


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("flicker = 0.005", None),
        ("flicker = 0.2", "the light flickers by"),
        ("vibration_px = 0.3", "shakes by"),
    ],
)
def test_a_table_under_a_fault_of_the_bench_is_right_or_not_written(
    fault: str, said: str | None, tmp_path: Path
) -> None:
    text = small(shape="[120, 160]").replace("settle_ms = 30.0", BENT) + f"\n{fault}\n"
    with Bench(parse_config(text, None)).open() as bench:
        if said is not None:
            with pytest.raises(CalibrationError, match=said):
                SlmProcedure(levels=9, out=tmp_path / "slm.json").carry_out(bench, tmp_path)
            assert not list(tmp_path.glob("*.json"))  # the run with its frames is kept
            return
        found = measure_look_up_table(DisplayBench(bench, 2), n_levels=17)
    true = 7.2 * (np.arange(256) / 255) ** 1.4
    assert np.abs(found.correction.phase_of_level_rad - true).max() < 0.03
    assert found.steadiness.flicker == pytest.approx(0.005, rel=0.7)


@pytest.mark.parametrize(("flicker", "drift", "most"), [(0.003, 0.0, 1), (0.015, 0.0, 4), (0.0, 0.3, 1)])
def test_tables_of_flickering_pictures_are_within_0_02_rad(flicker: float, drift: float, most: int) -> None:
    """What flickers with the phase's cosine bends a table unseen: more pictures, or none."""
    rng = np.random.default_rng(7)
    truth = np.linspace(0, 6.2, 33)
    parts = rng.normal(size=(3, 24, 24))
    turn = np.stack([np.ones(33), 0.4 * np.cos(truth), 0.4 * np.sin(truth)], axis=1)
    pictures = np.tensordot(turn, parts + 2 * np.ones((3, 1, 1)) * (np.arange(3) == 0)[:, None, None], 1)
    before = np.array([-0.5, 7.5, 15.5, 23.5, 31.5, 32.5])

    def take() -> tuple[np.ndarray, np.ndarray]:
        shown = (1 + flicker * rng.standard_normal(33)) * (1 + drift * np.arange(33) / 33)
        again = (1 + flicker * rng.standard_normal(6)) * (1 + drift * before / 33)
        references = (again[:, None, None] * pictures[0]).astype(np.float32)
        return shown[:, None, None] * pictures, references

    series = []
    for _ in range(5):
        phases, error, scatter = steady_phases(take, before)
        assert error <= MAX_PHASE_ERROR_RAD
        assert np.abs(phases - truth).max() < 0.02
        series.append(scatter.frames)
    assert max(series) <= most
    assert (max(series) > 1) == (most > 1)


def test_too_little_phase_is_noticed() -> None:
    text = small().replace("settle_ms = 30.0", "settle_ms = 0.0\nphase_at_full_level_rad = 0.01")
    with (
        Bench(parse_config(text, None)).open() as bench,
        pytest.raises(InputError, match=r"interference|phase"),
    ):
        measure_look_up_table(DisplayBench(bench, 2), n_levels=9)


@pytest.mark.slow
def test_flatness_is_measured_and_taken_off(tmp_path: Path) -> None:
    text = small(**AT_ITS_PLACE, flatness_rad="5.0").replace("settle_ms = 30.0", BENT)
    with Bench(parse_config(text, None)).open() as bench:
        assert bench.slm is not None
        io = DisplayBench(bench, 2)
        display = bench_display(bench.config, (bench.slm.shape, bench.slm.pixel_pitch_um))
        table = measure_look_up_table(io, n_levels=17)
        found = measure_flatness(io, display, Pose(), table, pictures=6)
        (world,) = bench.shared.values()
        assert isinstance(world, DisplayWorld)
        true = world._flatness_map(bench.slm.shape)
    assert found.correction.flatness_rad is not None
    coefficients = [
        [float((m * error).mean()) for m in (mode(n, error.shape) for n in range(len(MODES)))]
        for error in (true, found.correction.flatness_rad)
    ]
    before = np.linalg.norm(coefficients[0])
    assert np.linalg.norm(np.subtract(*coefficients)) < 0.6 * before
    found.correction.save(tmp_path / "slm.json", {})
    again = load_slm_correction(tmp_path / "slm.json")
    levels = np.random.default_rng(0).integers(0, 256, bench.slm.shape, dtype=np.uint8)
    # The file rounds, and an SLM of more than a turn has two levels for some phases: compare the phases.
    phase = found.correction.phase_of_level_rad
    difference = phase[again.apply(levels)] - phase[found.correction.apply(levels)]
    assert np.abs(np.angle(np.exp(1j * difference))).max() < 0.07


def test_calibrate_slm_from_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("bench.toml").write_text(small().replace("settle_ms = 30.0", BENT))
    assert main(["calibrate", "slm", "--levels", "17"]) == 0
    said = re.search(r"\(SIMULATED\): ([0-9.]+) rad at level 255", capsys.readouterr().out)
    assert said is not None
    assert float(said[1]) == pytest.approx(7.2, abs=0.05)
    assert load_slm_correction(Path("slm-calibration.json")).flatness_rad is None
    assert main(["calibrate", "slm"]) == 2
    assert "exists already" in capsys.readouterr().err
