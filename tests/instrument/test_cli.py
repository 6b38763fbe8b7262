"""The command line: what it prints, its exit statuses, no traceback for a user's mistake."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile

from instrument.bench.bench import open_bench
from instrument.cli import COMMANDS, completion, main
from instrument.files.slm_image import write_slm_image

MOCK_BENCH = """\
[camera]
driver = "mock"
[stage]
driver = "mock"
[led_array]
driver = "mock"
[slm]
driver = "mock"
[scene]
control = "simulated"
"""


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DIFFUSERBENCH_DEBUG", raising=False)
    return tmp_path


PROGRAM = "import sys; from instrument.cli import main; sys.exit(main())"


def program(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", PROGRAM, *arguments],
        capture_output=True,
        text=True,
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
        timeout=120,
        check=False,
    )


# What one can do --------------------------------------------------------------------------------------
def test_alone_it_says_what_one_can_do(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    shown = capsys.readouterr().out
    assert all(f"  {name} " in shown for name in COMMANDS)
    assert "Examples:" in shown
    assert main(["--help"]) == 0
    assert capsys.readouterr().out == shown
    assert main(["help"]) == 0
    assert capsys.readouterr().out == shown
    assert main(["help", "check"]) == 0
    assert "Usage: diffuserbench check" in capsys.readouterr().out
    for words in (["help", "plan", "show"], ["plan", "help", "show"], ["plan", "show", "help"]):
        assert main(words) == 0
        assert "diffuserbench plan show" in capsys.readouterr().out


def test_help_imports_nothing_but_the_standard_library() -> None:
    code = (
        "import sys; from instrument.cli import main; main(['--help']); "
        "print(sorted(m for m in ('numpy', 'pydantic', 'typer', 'rich', 'cv2') if m in sys.modules))"
    )
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert shown.stdout.endswith("[]\n")


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_each_command_explains_itself_with_examples(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([name, "--help"]) == 0
    shown = capsys.readouterr().out
    assert f"Usage: diffuserbench {name}" in shown
    if "Commands:" not in shown:
        assert f"diffuserbench {name}" in shown.split("Examples:")[1]


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("diffuserbench ")


@pytest.mark.parametrize("asked", ["--help", "drivers"])
def test_whoever_has_read_enough_sees_no_traceback(asked: str) -> None:
    reads, writes = os.pipe()
    os.close(reads)
    with os.fdopen(writes) as unread:
        shown = subprocess.run(
            [sys.executable, "-m", "diffuserbench", asked],
            stdout=unread,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
            timeout=60,
        )
    assert (shown.returncode, shown.stderr) == (141, "")


def test_the_module_is_the_program() -> None:
    shown = subprocess.run(
        [sys.executable, "-m", "diffuserbench", "snpa"], capture_output=True, text=True, timeout=60
    )
    assert shown.returncode == 2
    assert "no command 'snpa'" in shown.stderr


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["snpa"], "no command 'snpa'. Did you mean 'snap'?"),
        (["recon"], "Did you mean 'reconstruct'?"),
        (["d"], "no command 'd'.\nUsage"),  # demo, drivers, devices
        ([""], "no command ''.\nUsage"),
        (["im"], "Did you mean 'import'?"),
        (["--colour"], "no option '--colour'"),
        (["help", "snpa"], "no command 'snpa'"),
        (["snap", "--averge", "3"], "--average"),
        (["snap", "--average", "many"], "--average"),
        (["snap", "--average", "0"], "--average"),
        (["snap", "--dark", "--source"], "choose one of"),
        (["check", "--bench", "absent.toml"], "absent.toml: there is no such file"),
        (["snap", "--out", "photo.jpg"], "'.jpg' is no format"),
        (["snap", "--out", "absent/photo.tif"], "absent does not exist"),
        (["snap", "--out", "a.png", "--average", "2"], "PNG cannot hold"),
    ],
)
def test_mistakes_are_told_in_words_with_status_2(
    arguments: list[str], told: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 2
    output = capsys.readouterr()
    assert told in output.err
    assert "Traceback" not in output.err
    assert list(here.iterdir()) == []


# new ----------------------------------------------------------------------------------------------------
def test_new_writes_a_file_that_is_understood_and_spares_an_existing_one(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["new"]) == 0
    assert "SIMULATED" in capsys.readouterr().out
    assert "[camera]" in (here / "bench.toml").read_text()
    (here / "bench.toml").write_text("mine")
    assert main(["new"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert (here / "bench.toml").read_text() == "mine"
    assert main(["new", "--force"]) == 0
    assert (here / "bench.toml").read_text() != "mine"


def test_a_device_or_pipe_is_never_replaced_by_a_file(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(here / "pipe.toml")
    assert main(["new", "pipe.toml", "--force"]) == 2
    assert "device or pipe" in capsys.readouterr().err
    assert (here / "pipe.toml").is_fifo()


def test_drivers_are_listed_by_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["drivers"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["camera", "stage", "led_array", "slm"]
    assert all("simulated" in line for line in lines)


# check --------------------------------------------------------------------------------------------------
@pytest.mark.usefixtures("mock_drivers")
def test_check_reports_every_device_and_ends_dark(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH)
    assert main(["check"]) == 0
    shown = capsys.readouterr().out
    for expected in (
        "camera: Mock M1",
        "stage:",
        "led_array:",
        "slm:",
        "SIMULATED",
        "axis x_um",
        "Light off",
    ):
        assert expected in shown


@pytest.mark.usefixtures("mock_drivers")
def test_check_reports_all_failing_devices_with_status_1(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    broken = MOCK_BENCH.replace('[stage]\ndriver = "mock"', '[stage]\ndriver = "mock"\nfail = ["open"]')
    broken = broken.replace('[slm]\ndriver = "mock"', '[slm]\ndriver = "mock"\nfail = ["open", "close"]')
    (here / "bench.toml").write_text(broken)
    assert main(["check"]) == 1
    output = capsys.readouterr()
    assert "stage (mock): open failed. Check the cable." in output.err
    assert "slm (mock): open failed." in output.err
    assert "close slm (mock)" in output.err
    assert "camera: Mock M1" in output.out


@pytest.mark.usefixtures("mock_drivers")
def test_check_refuses_a_source_lit_by_an_led_that_the_array_does_not_have(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH + "[source]\nleds = [0, 9999]\n")
    assert main(["check"]) == 1
    assert "[source] leds in bench.toml names 9999" in capsys.readouterr().err


def test_every_mistake_of_a_bench_file_reaches_the_terminal(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text('[camera]\ndriver = "simulatd"\n[benhc]\n[scene]\ncontrol = 3\n')
    assert main(["check"]) == 2
    told = capsys.readouterr().err
    assert "bench.toml:2: [camera] driver" in told
    assert "bench.toml:3: [benhc]" in told
    assert "bench.toml:5: [scene] control" in told


# snap ---------------------------------------------------------------------------------------------------
@pytest.mark.usefixtures("mock_drivers")
def test_snap_keeps_counts_and_metadata(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH)
    assert main(["snap", "--out", "photo.tif", "--exposure-ms", "7.5"]) == 0
    with tifffile.TiffFile(here / "photo.tif") as tiff:
        assert tiff.asarray().dtype == np.uint16
        metadata = json.loads(tiff.pages[0].description)
    assert metadata["exposure_ms"] == 7.5
    assert metadata["light"] == "scene"
    assert "SIMULATED" in metadata["bench"]
    assert "SIMULATED" in capsys.readouterr().err
    assert main(["snap", "--out", "photo.tif"]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["snap", "--out", "mean.npy", "--average", "4", "--source"]) == 0
    assert np.load(here / "mean.npy").dtype == np.float32
    assert json.loads((here / "mean.json").read_text())["led_pattern"].startswith("point source")


@pytest.mark.parametrize("flicker", [0.0, 0.2])
def test_a_mean_of_frames_whose_light_flickers_says_so(
    here: Path, capsys: pytest.CaptureFixture[str], flicker: float
) -> None:
    (here / "bench.toml").write_text(TINY + f"flicker = {flicker}\n")
    assert main(["snap", "--out", "mean.npy", "--average", "4", "--exposure-ms", "20", "--source"]) == 0
    assert ("the frames' mean counts scatter by" in capsys.readouterr().err) == (flicker > 0)
    assert len(json.loads((here / "mean.json").read_text())["frame_means"]) == 4


TINY = """
[camera]
driver = "simulated"
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "tiny"
time_scale = 0
"""


def test_snap_exposes_by_itself_unless_it_is_told_how(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "bench.toml").write_text(TINY)
    assert main(["snap", "--out", "found.tif", "--figure", "found.png"]) == 0
    assert "Auto-exposure" in capsys.readouterr().out
    assert cv2.imread(str(here / "found.png")).std() > 10
    assert main(["snap", "--out", "other.tif", "--figure", "found.png"]) == 2
    assert "found.png: exists already" in capsys.readouterr().err
    assert not (here / "other.tif").exists()
    assert main(["snap", "--dark", "--out", "dark.tif"]) == 0
    assert "no exposure is given" in capsys.readouterr().err
    (here / "bench.toml").write_text(TINY.replace("[stage]", "exposure_ms = 2\n[stage]", 1))
    assert main(["snap", "--out", "told.tif"]) == 0
    said = capsys.readouterr().out
    assert "Auto-exposure" not in said
    assert ", 2 ms," in said
    assert main(["snap", "--dark", "--out", "dark-told.tif"]) == 0
    assert "no exposure is given" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "bench"),
    [
        (["calibrate", "slm"], "display"),
        (["align", "mask"], "display"),
        (["calibrate", "dpc", "--na", "0.1", "--magnification", "4"], "microscope"),
        (["calibrate", "dpc"], "microscope"),  # before what is missing
        (["calibrate", "screen"], "screen"),
    ],
)
def test_a_command_that_takes_another_bench_says_which(
    words: list[str], bench: str, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    written = capsys.readouterr().err.replace("\n", " ").partition("Write one with diffuserbench ")[2]
    assert f"--{bench}," in written
    new, file, flag = written.split(",")[0].split()
    assert main([new, file, flag, "--no-look"]) == 0
    assert (here / file).exists()


def test_snap_says_when_a_lit_photograph_is_dim(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (here / "bench.toml").write_text(TINY)
    assert main(["snap", "--out", "dim.tif", "--exposure-ms", "1"]) == 0
    assert "below 10% of full scale" in capsys.readouterr().err
    assert main(["snap", "--dark", "--out", "dark.tif", "--exposure-ms", "1"]) == 0
    assert "full scale" not in capsys.readouterr().err


@pytest.mark.usefixtures("mock_drivers")
def test_a_value_outside_a_devices_limits_is_a_mistake_to_put_right(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH)
    assert main(["snap", "--exposure-ms", "5000", "--out", "photo.tif"]) == 2
    assert "5000 ms is outside 0.1 to 1000 ms" in capsys.readouterr().err
    (here / "bench.toml").write_text(MOCK_BENCH.replace("[stage]", "exposure_ms = 6000\n[stage]", 1))
    assert main(["snap", "--out", "photo.tif"]) == 2
    assert "from [camera] in bench.toml" in capsys.readouterr().err
    assert not (here / "photo.tif").exists()


@pytest.mark.usefixtures("mock_drivers")
@pytest.mark.parametrize(
    ("fault", "status"),
    [('fail = ["snap"]', 1), ('interrupt = ["snap"]', 130), ('fail = ["stop_sequence"]', 1)],
)
def test_a_failing_camera_leaves_no_file_and_a_dark_bench(
    fault: str, status: int, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH.replace("[stage]", f"{fault}\n[stage]", 1))
    assert main(["snap", "--out", "photo.tif"]) == status
    output = capsys.readouterr()
    assert "Traceback" not in output.err
    if status == 1:
        assert "camera (mock)" in output.err
    assert (here / "photo.tif").exists() == ("stop_sequence" in fault)


@pytest.mark.parametrize(
    ("number", "status", "told"),
    [(signal.SIGINT, 130, "interrupted."), (signal.SIGTERM, 143, "stopped by a signal.")],
    ids=["SIGINT", "SIGTERM"],
)
def test_a_signal_during_an_exposure_ends_it_at_once_and_says_what_is_left(
    number: signal.Signals, status: int, told: str, tmp_path: Path
) -> None:
    (tmp_path / "bench.toml").write_text(
        '[camera]\ndriver = "simulated"\nexposure_ms = 20000\n[simulated]\npreset = "tiny"\ntime_scale = 20\n'
    )
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, "snap", "--as-is", "--out", "photo.tif"],
        stderr=subprocess.PIPE,
        text=True,
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])},
    )
    try:
        assert process.stderr is not None
        assert process.stderr.readline().startswith("Bench:")
        process.send_signal(number)
        _, error = process.communicate(timeout=250)
    finally:
        process.kill()
    assert process.returncode == status
    assert error == f"{told}\nNothing was written.\n"
    assert not (tmp_path / "photo.tif").exists()


def test_the_program_itself_ends_with_the_status_and_without_a_traceback(tmp_path: Path) -> None:
    ended = program("check", "--bench", "absent.toml", cwd=tmp_path)
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert "Traceback" in program("--debug", "check", "--bench", "absent.toml", cwd=tmp_path).stderr


# Without an operator -----------------------------------------------------------------------------------
@pytest.mark.usefixtures("mock_drivers")
def test_a_psf_without_a_terminal_needs_as_is_and_the_error_says_so(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH.replace('"simulated"', '"operator"'))
    assert main(["snap", "--source", "--out", "psf.tif"]) == 2
    told = capsys.readouterr().err
    assert "Please darken the scene." in told
    assert "--as-is" in told
    assert main(["snap", "--source", "--as-is", "--out", "psf.tif"]) == 0
    assert "taken for done: Please darken the scene." in capsys.readouterr().err
    with tifffile.TiffFile(here / "psf.tif") as file:
        metadata = json.loads(file.pages[0].description)  # type: ignore[union-attr]
    assert metadata["light"] == "source"
    assert metadata["operator_asked"] is False
    assert main(["record", "--source", "--frames", "1"]) == 2
    assert "--as-is" in capsys.readouterr().err


@pytest.mark.usefixtures("mock_drivers")
def test_a_pattern_is_shown_without_anybody_asked_for_light(
    here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (here / "bench.toml").write_text(MOCK_BENCH.replace('"simulated"', '"operator"'))
    with open_bench(here / "bench.toml") as bench:
        assert bench.slm is not None
        levels = np.zeros(bench.slm.shape, np.uint8)
    write_slm_image(here / "slm.png", levels, {})
    assert main(["show", "slm.png", "--seconds", "0"]) == 0
    assert "Please" not in capsys.readouterr().err


HEAVY = ("numba", "matplotlib", "zarr", "scipy", "dask", "PySide6")


@pytest.mark.parametrize(
    "name",
    ["new", "check", "devices", "snap", "run", "list", "export", "reconstruct", "chart", "hologram", "show"],
)
def test_a_commands_help_imports_no_heavy_library(name: str) -> None:
    code = (
        f"import sys; from instrument.cli import main; main(['{name}', '--help']); "
        f"print([m for m in {HEAVY} if m in sys.modules])"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    shown = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60, env=environment
    )
    assert shown.stdout.endswith("[]\n")


def test_bash_completes_commands_options_and_their_words(tmp_path: Path) -> None:
    (tmp_path / "completion.sh").write_text(completion.script())
    asked = {
        "reconstruct --prior tv-": "tv-isotropic tv-haar",
        "calibrate sl": "slm",
        "snap --av": "--average",
    }
    lines = ["lazily() { source completion.sh; }", "lazily"]  # as bash-completion does
    for words in asked:
        lines += [
            f"COMP_WORDS=(diffuserbench {words})",
            "COMP_CWORD=$((${#COMP_WORDS[@]}-1))",
            "_diffuserbench",
        ]
        lines += ['echo "${COMPREPLY[*]}"']
    said = subprocess.run(
        ["bash", "-c", "\n".join(lines)], capture_output=True, text=True, cwd=tmp_path, check=True
    )
    assert said.stdout.splitlines() == list(asked.values())


def test_fish_completes_the_same(tmp_path: Path) -> None:
    lines = completion.script("fish").splitlines()
    at = "complete -c diffuserbench -n '__diffuserbench_at"
    assert f"{at} reconstruct' -l image -r" in lines
    assert f"{at} reconstruct' -l solver -x -a 'auto admm admm-sensor fista wiener'" in lines
    assert f"{at} new' -l camera" in lines, "a switch takes nothing"
    assert any(line.startswith(f"{at} calibrate' -f -a 'axial lateral") for line in lines)
    if (fish := shutil.which("fish")) is None:
        return  # what it makes of them was tried where it is
    (tmp_path / "lines.fish").write_text("\n".join(lines))
    asked = "source lines.fish; complete -C 'diffuserbench reconstruct --prior tv-'"
    home = {**os.environ, "HOME": str(tmp_path)}
    said = subprocess.run(
        [fish, "-c", asked], capture_output=True, text=True, cwd=tmp_path, check=True, env=home
    )
    assert said.stdout.split() == ["tv-haar", "tv-isotropic"]


def test_a_thread_that_still_computes_does_not_abort_the_end_of_the_program() -> None:
    """What a C++ library does with an interpreter that ends under it: exit status 134, and no word."""
    program = (
        "import atexit, sys, threading\n"
        "from concurrent.futures import ThreadPoolExecutor\n"
        "import numpy as np, scipy.fft\n"
        "from instrument import cli\n"
        "def compute():\n"
        "    picture = np.ones((1500, 1500))\n"
        "    while True:\n"
        "        scipy.fft.fft2(picture)\n"
        "        begun.set()\n"
        "begun = threading.Event()\n"
        "def main():\n"
        "    threading.Thread(target=compute, daemon=True).start()\n"
        "    begun.wait()\n"
        "    ThreadPoolExecutor(1).submit(int).result()\n"
        "    atexit.register(print, 'closed')\n"
        "    return 3\n"
        "cli.main = main\n"
        "sys.exit(cli.console())\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60
    )
    assert (ended.returncode, ended.stdout, ended.stderr) == (3, "closed\n", "")
