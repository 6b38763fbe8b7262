from __future__ import annotations

import json
import multiprocessing
import subprocess
import sys
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from typer.testing import CliRunner

from instrument.bench.config_file import parse_config, template
from instrument.cli import COMMANDS
from instrument.evaluation.chart_problems import problem_of_pictures
from instrument.files.images import write_image
from instrument.reconstruction.job import Job
from instrument.tasks import chart as module
from recon import Calibration, NoiseModel
from recon.evaluation.chart_reconstruction import ChartProblem
from recon.evaluation.scored import Curve, Point
from recon.evaluation.trial import Setting


@pytest.fixture
def quick(monkeypatch):
    """Two settings, in this process."""
    import instrument.evaluation.chart as job

    settings = (
        Setting("wiener", "convolution", "none"),
        Setting("admm", "convolution", "tv"),
    )
    ran = []

    def here(problem, setting, limit_s, *_):
        assert limit_s > 0
        ran.append(setting.name)
        return problem.run(setting, counts=(2, 5))

    monkeypatch.setattr(ChartProblem, "settings", lambda problem: settings)
    monkeypatch.setattr(job, "in_own_process", here)
    return ran


def run(*arguments):
    return CliRunner().invoke(COMMANDS["chart"].load(), [str(a) for a in arguments])


def test_a_chart_is_written_and_gone_on_with(quick, tmp_path):
    out = tmp_path / "chart"
    result = run("scene", "sparse-picture", "--size", 32, "--out", out)
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
    assert run("scene", "sparse-picture", "--size", 32, "--out", out).exit_code == 0
    assert len(quick) == 2


def test_a_curve_that_the_budget_cut_off_is_drawn_again(quick, monkeypatch, tmp_path):
    import instrument.evaluation.chart as job
    from instrument.evaluation.chart_problems import problem_of_scene

    whole = job.in_own_process

    def cut(problem, setting, limit_s, *_):
        curve = whole(problem, setting, limit_s)
        shorter = setting.solver != "wiener"
        return Curve(curve.points[:1], False) if shorter else curve

    out = tmp_path / "chart"
    problem, about = problem_of_scene("sparse-picture", 32, 0)
    path = tmp_path / "chart.json"
    arguments = {"budget_s": 100.0, "on_progress": lambda *_: None}
    monkeypatch.setattr(job, "in_own_process", cut)
    assert run("scene", "sparse-picture", "--size", 32, "--out", out).exit_code == 0
    data = job.make_chart(problem, about, path, **arguments)
    assert [p.iterations for p in data.points] == [0, 2]
    assert data.missing == ("admm convolution tv",)
    quick.clear()
    monkeypatch.setattr(job, "in_own_process", whole)
    data = job.make_chart(problem, about, path, **arguments)
    assert quick == ["admm convolution tv"]
    assert [p.iterations for p in data.points] == [0, 2, 5]
    assert data.missing == ()
    quick.clear()
    job.make_chart(problem, about, path, **arguments)
    assert not quick


def test_a_chart_tells_noise_erasures_and_truth_apart():
    from instrument.evaluation.chart_problems import problem_of_scene

    problem, _ = problem_of_scene("sparse-picture", 32, 0)
    others = [
        replace(problem, noise=7.0),
        replace(problem, erasures=np.eye(32, dtype=bool)),
        replace(problem, truth=None),
    ]
    assert len({p.fingerprint() for p in (problem, *others)}) == 4
    assert replace(problem).fingerprint() == problem.fingerprint()


def test_the_noise_that_the_photograph_tells_is_used():
    from instrument.evaluation.chart_problems import problem_of_job

    calibration = Calibration(np.eye(8, dtype=np.float32)[None, None], np.array([[0, 0, 1e4]]))
    grey = Job(np.ones((8, 8), np.float32), calibration, {}, known_noise=NoiseModel(3.0, 0.3))
    assert problem_of_job(grey, None, volume=False)[0].noise == NoiseModel(3.0, 0.3)
    colour = replace(grey, measurement=np.ones((8, 8, 3), np.float32))
    noise = problem_of_job(colour, None, volume=False)[0].noise
    assert (noise.read_noise, noise.counts_per_electron) == pytest.approx((3**0.5, 0.1))


@pytest.mark.usefixtures("quick")
def test_another_scene_does_not_mix_with_a_chart(tmp_path):
    assert run("scene", "sparse-picture", "--size", 32, "--out", tmp_path).exit_code == 0
    other = run("scene", "sparse-picture", "--size", 32, "--seed", 5, "--out", tmp_path)
    assert other.exit_code != 0
    assert "chart of something else" in str(other.exception)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--scene", "beads"), "Did you mean root scene ...?"),
        (("--size", 40, "--hologram", "leaves"), "Did you mean root hologram ...?"),
        (("--calibrations", "-c", "a", "-c", "b"), "Did you mean root calibrations ...?"),
        (("-c", "a", "--image", "i"), "Did you mean root photograph ...?"),
        (("scene", "bead"), "Did you mean 'beads'?"),
        (("photograph", "--image", "x.tif"), "either --psf FILE or --calibration FOLDER"),
        (("photograph", "--psf", "p"), "--image FILE"),
        (("photograph", "--psf", "p", "--image", "i", "--volume", "v"), "do not apply: --psf"),
        (("calibrations", "--volume"), "do not apply: --volume"),
        (("hologram", "levaes"), "no such file, and no such sample picture"),
        (("hologram", "leaves", "clouds"), "--z-mm once for each"),
        (("hologram", "leaves", "clouds", "--z-mm", 1, "--z-mm", 1), "a depth of its own"),
        (("hologram", "leaves", "-q", 5), "must be a square"),
    ],
)
def test_mistakes_are_named(arguments, said, tmp_path):
    result = run(*arguments, "--out", tmp_path / "c")
    assert result.exit_code != 0
    assert said in str(result.exception)


def test_a_setting_runs_in_a_process_of_its_own_that_can_be_ended(monkeypatch):
    """In one test: the first process takes seconds to import what all others share."""
    import instrument.evaluation.chart as job
    from instrument.evaluation.chart_problems import problem_of_scene

    problem, _ = problem_of_scene("sparse-picture", 32, 0)
    found = job.in_own_process(problem, Setting("wiener", "convolution", "none"), 20.0)
    assert not isinstance(found, str)
    assert found.points[0].peak_mib < 500
    assert found.finished
    refused = job.in_own_process(problem, Setting("admm", "convolution", "tv-haar"), 20.0)
    assert isinstance(refused, str)

    def ended(left_s):
        assert 0 < left_s <= 3600
        raise KeyboardInterrupt

    monkeypatch.setattr(job, "_TELL_S", 0.0)
    before = set(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        job.in_own_process(problem, Setting("admm", "convolution", "tv"), 3600.0, ended)
    assert set(multiprocessing.active_children()) <= before


def test_memory_taken_aside_does_not_count():
    # In a process of its own: what this one has freed before would be taken again, and not count as taken.
    program = """
import numpy as np
from recon.solvers.memory import MemoryMeter
meter = MemoryMeter()
own = np.ones(6 << 20)  # 48 MiB
with meter.aside():
    scored = np.ones(16 << 20)  # 128 MiB, kept
print(meter.peak_mib())
"""
    told = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    peak = float(told.stdout)
    if peak != peak:
        pytest.skip("this system does not say how much memory was taken")
    assert 40 < peak < 80


@pytest.mark.usefixtures("quick")
def test_holograms_are_charted(monkeypatch, tmp_path):
    import instrument.evaluation.chart as job

    def here(problem, setting, limit_s, *_):
        if setting.frames == 2:
            return "no second frame"
        return problem.run(setting, limit_s=limit_s, counts=(1, 2))

    monkeypatch.setattr(job, "in_own_process", here)
    arguments = ("hologram", "leaves", "--slm", "16x24", "-q", 4, "-q", 9, "--frames", 1, "--frames", 2)
    result = run(*arguments, "--out", tmp_path)
    assert result.exit_code == 0, result.output
    limits = [f"Any number of phase frames, {q}x: no limit in sight" for q in (4, 9)]
    for told in ("Pareto front 4x", "Pareto front 9x", "SIMULATED", "no second frame", *limits):
        assert told in result.output
    record = json.loads((tmp_path / "chart.json").read_text())
    assert record["kind"] == "hologram"
    groups = {"4x", "9x", "4x, complex SLM", "9x, complex SLM"}
    assert {p["group"] for p in record["pareto"]} == groups
    assert (
        (tmp_path / "chart.csv")
        .read_text()
        .startswith("setting,iterations,seconds,psnr_db,ssim,middle_psnr_db")
    )
    assert (tmp_path / "chart.png").stat().st_size > 5000
    assert "middle_psnr_db" in (tmp_path / "chart.html").read_text()


def test_what_a_chart_of_holograms_leaves_out_of_a_picture_is_told(tmp_path):
    write_image(tmp_path / "wide.png", np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8))
    config = parse_config(template("display"), None)
    asked = {"z_mm": (), "expansions": (1,), "frames": (1,), "slm": (16, 24)}
    _, about = problem_of_pictures(config, [str(tmp_path / "wide.png")], *asked.values())
    assert "the middle 40 x 40 of the picture's 40 x 60 pixels are shown" in about["cropped"]
    assert problem_of_pictures(config, ["leaves"], *asked.values())[1]["cropped"] is None


def test_a_setting_ends_when_the_program_was_killed(monkeypatch):
    import multiprocessing

    from instrument.evaluation import chart as process

    ended = []
    waited = SimpleNamespace(join=lambda: ended.append("parent is gone"))
    monkeypatch.setattr(multiprocessing, "parent_process", lambda: waited)
    monkeypatch.setattr(process.os, "_exit", ended.append)
    process._end_with_parent()
    assert ended == ["parent is gone", 1]


def test_ctrl_c_is_not_the_servers_and_not_lost(monkeypatch):
    import signal

    from instrument.evaluation import chart as process

    masks = []
    blocked = lambda: masks.append(signal.pthread_sigmask(signal.SIG_BLOCK, ()))  # noqa: E731
    monkeypatch.setattr(process.forkserver, "ensure_running", blocked)
    process._context()
    assert signal.SIGINT in masks[0]
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.mark.parametrize(
    "content", [b"", b"PK\x03\x04 cut off", b"no archive"], ids=["empty", "cut", "other"]
)
def test_damaged_photographs_are_refused_by_name(tmp_path, content):
    from instrument.evaluation.bench_photographs import photographs
    from instrument.files.errors import FileError

    damaged = tmp_path / "photographs.npz"
    damaged.write_bytes(content)
    with pytest.raises(FileError, match=r"photographs\.npz.*no photographs"):
        photographs(96, damaged, lambda done, total: None)


@pytest.fixture
def few(monkeypatch):
    """Four photographs and two scenes that cost nothing; how often each was taken."""
    from instrument.evaluation import bench_photographs as module

    taken = []

    def light(number):
        taken.append(number)
        return np.full((30, 30), 1.0) + np.eye(30) * number

    bench = SimpleNamespace(
        size=30, key="few", geometry=None, window_px=9, truth=lambda: np.full((150, 150), 1.0 + len(taken))
    )
    shots = [module._Shot(partial(light, n), (0.0, 0.0, n + 1.0)) for n in range(3)]
    shots += [module._Shot(partial(light, 3))]
    shots += [module._Shot(partial(light, n), is_scene=True) for n in (4, 5)]
    monkeypatch.setattr(module, "_Bench", lambda size: bench)
    monkeypatch.setattr(module, "_shots", lambda bench: shots)
    return taken


def test_photographs_count_in_the_budget_and_go_on_where_they_stopped(few, tmp_path):
    from instrument.evaluation.bench_photographs import OutOfTimeError, photographs

    whole = photographs(30, tmp_path / "whole.npz", lambda *_: None)
    assert few == [0, 1, 2, 3, 4, 5]
    few.clear()
    path = tmp_path / "parts.npz"
    told = []
    for done in range(1, 6):  # one at a time, each budget spent at once
        with pytest.raises(OutOfTimeError, match=f"{done} of 6"):
            photographs(30, path, lambda *counts: told.append(counts), budget_s=0.0)
    parts = photographs(30, path, lambda *counts: told.append(counts), budget_s=0.0)
    assert few == [0, 1, 2, 3, 4, 5]
    assert told == [(n, 6) for n in range(1, 7)]
    for name in ("psfs", "places", "slides"):
        np.testing.assert_array_equal(getattr(parts, name), getattr(whole, name))
    assert [s.name for s in parts.scenes] == [s.name for s in whole.scenes]
    for one, other in zip(parts.scenes, whole.scenes, strict=True):
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.truth, other.truth)
    again = photographs(30, path, lambda *_: pytest.fail("nothing is left to take"))
    np.testing.assert_array_equal(again.psfs, whole.psfs)


def test_photographs_taken_before_an_interruption_are_kept(few, tmp_path):
    from instrument.evaluation.bench_photographs import photographs

    def interrupted(done, _total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        photographs(30, tmp_path / "p.npz", interrupted)
    photographs(30, tmp_path / "p.npz", lambda *_: None)
    assert few == [0, 1, 2, 3, 4, 5]


def test_photographs_that_do_not_fit_together_are_refused(few, tmp_path):
    from instrument.evaluation.bench_photographs import photographs
    from instrument.files.errors import FileError

    path = tmp_path / "p.npz"
    for images, truths in (((6, 30, 30), (0,)), ((2, 31, 30), (0,)), ((7, 30, 30), (2, 150, 150))):
        np.savez(path, key="few", images=np.zeros(images), truths=np.zeros(truths))
        with pytest.raises(FileError, match="do not fit together"):
            photographs(30, path, lambda *_: None)
    np.savez(path, key="other", images=np.zeros((1, 30, 30)), truths=np.zeros(0))
    with pytest.raises(FileError, match="another size or version"):
        photographs(30, path, lambda *_: None)
    assert not few


def test_what_ends_a_setting_is_told_in_its_row():
    from instrument.evaluation.chart import in_own_process
    from instrument.evaluation.chart_problems import problem_of_scene

    problem, _ = problem_of_scene("sparse-picture", 32, 0)
    broken = replace(problem, calibration=None)
    found = in_own_process(broken, Setting("wiener", "convolution", "none"), 20.0)
    assert isinstance(found, str)
    assert "Error" in found
    assert "status" not in found


@pytest.fixture
def own(tmp_path):
    """Two calibrations and a photograph."""
    import tifffile

    from instrument.files.calibration_file import save_calibration
    from recon.evaluation.scene import make_scene

    for grid, name in ((5, "fine"), (1, "one")):
        scene = make_scene("sparse-picture", size=24, grid=grid, fall_off_deg=20.0, seed=3)
        save_calibration(scene.calibration, tmp_path / name)
    tifffile.imwrite(tmp_path / "photo.tif", np.clip(scene.measurement + 20, 0, 65535).astype(np.uint16))
    tifffile.imwrite(tmp_path / "small.tif", np.arange(400, dtype=np.uint16).reshape(20, 20))
    return tmp_path


GROUPS = ("as an extended scene (tv)", "as a sparse scene (l1)")


@pytest.mark.parametrize(
    ("names", "said"), [("ab", "even with it, as far as"), ("a", "no other setting is even")]
)
def test_whether_a_setting_is_even_with_the_best_is_said(names, said):
    even = [Point(n, 40, 1.0, held_out=1.0, held_out_parts=(1.0,) * 4, images=3.0) for n in names]
    lines = []
    module._tell_even(SimpleNamespace(say=lines.append), GROUPS[0], even, on_the_way=False)
    first, second = lines
    assert first.startswith(f"Held out    best {GROUPS[0]}: a")
    assert second.strip().startswith(said)
    assert ("scatter: 1; the one with the fewest photographs: a" in second) == (len(names) > 1)


def test_own_calibrations_are_compared(own, monkeypatch, tmp_path):
    import instrument.evaluation.chart as job
    import recon.evaluation.own_calibrations as module

    monkeypatch.setattr(module, "ITERATIONS", 3)
    monkeypatch.setattr(job, "in_own_process", lambda problem, setting, *_: problem.run(setting))
    out = tmp_path / "chart"
    result = run("calibrations", own / "fine", own / "one", "--image", own / "photo.tif", "--out", out)
    assert result.exit_code == 0, result.output
    record = json.loads((out / "chart.json").read_text())
    _, *told = result.output.split("Held out    best ")  # one for each group
    assert len(told) == 2
    for words in told:
        group = next(g for g in GROUPS if words.startswith(g))
        even = {p["setting"] for p in record["even_with_best"] if p["group"] == group}
        line = words.splitlines()[1].strip()
        if len(even) > 1:
            assert line.startswith("even with it, as far as")
            assert f"scatter: {len(even) - 1}; the one with the fewest photographs" in line
        else:
            assert line == "no other setting is even with it"
    assert record["kind"] == "calibration"
    names = {(p["setting"], p["images"]) for p in record["points"]}
    assert names == {("one, 1 PSF", 1), ("fine, 1 PSF", 1), ("fine, 9 PSFs", 9), ("fine, 25 PSFs", 25)}
    assert len(record["points"]) == 8  # of an extended and a sparse scene
    assert all(p["held_out"] > 0 and p["psnr_db"] is None for p in record["points"])
    assert record["even_with_best"]
    assert (out / "chart.png").stat().st_size > 5000


def test_an_own_photograph_is_charted_by_pixels_held_out(own, quick):
    result = run("photograph", "-c", own / "one", "-i", own / "photo.tif", "--out", own / "c")
    assert result.exit_code == 0, result.output
    assert "Held out" in result.output
    assert quick == ["wiener convolution none", "admm convolution tv"]
    points = json.loads((own / "c" / "chart.json").read_text())["points"]
    assert all(p["held_out"] > 0 and p["psnr_db"] is None for p in points)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("calibrations", "-i", "photo.tif"), "With no FOLDER these do not apply: --image"),
        (("calibrations", "fine", "fine", "-i", "photo.tif"), "given twice"),
        (("calibrations", "fine"), "--image FILE"),
        (("calibrations", "fine", "-i", "photo.tif", "--size", 40), "do not apply: --size"),
        (("calibrations", "fine", "-i", "photo.tif", "--volume", "--z-mm", 3), "do not apply: --z-mm"),
        (("photograph", "-c", "nothing", "-i", "photo.tif"), "nothing"),
        (("photograph", "-c", "fine", "-i", "nothing.tif"), "nothing.tif"),
        (("photograph", "-c", "fine", "-i", "small.tif"), "20 x 20"),
    ],
)
def test_mistakes_with_own_files_are_named(own, monkeypatch, arguments, said):
    monkeypatch.chdir(own)
    result = run(*arguments, "--out", own / "c")
    assert result.exit_code != 0
    assert said in str(result.exception)


@pytest.mark.parametrize(
    "content", ["", "{}", '{"about": 3}', '{"about": {"fingerprint": "x"}, "points": [{"nonsense": 1}]}']
)
def test_a_damaged_chart_is_refused_by_name(quick, tmp_path, content):
    (tmp_path / "chart.json").write_text(content)
    result = run("scene", "sparse-picture", "--size", 32, "--out", tmp_path)
    assert result.exit_code != 0
    assert "chart.json" in str(result.exception)
    assert not quick
    assert (tmp_path / "chart.json").read_text() == content


def test_settings_of_older_charts_have_their_names_of_now():
    from instrument.evaluation.chart import _renamed

    assert _renamed("volume local tv background") == "admm local tv background"
    assert _renamed("admm-gpu convolution l1") == "admm convolution l1 gpu"
    assert _renamed("admm-sensor convolution tv") == "admm-sensor convolution tv"
