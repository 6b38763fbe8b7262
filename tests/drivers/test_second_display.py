"""The SLM as second display: exact, undisturbed, and honest about an output that is gone."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from drivers.device import Device
from drivers.errors import DeviceError
from drivers.second_display import slm as slm_module
from drivers.second_display.outputs import Output, SecondDisplayOptions, choose
from drivers.second_display.process import WindowProcess
from drivers.second_display.slm import SecondDisplaySlm
from drivers.testing.slm import SlmContract
from tests.mocks.waiting import until

ROOT = Path(__file__).parents[2]
pytest.importorskip("PySide6.QtGui", reason="Qt cannot be loaded here", exc_type=ImportError)


def screens(tmp_path: Path) -> str:
    """Return the platform of two screens, as Qt's environment variable takes it."""
    desk = {"name": "DESK-1", "x": 0, "y": 0, "width": 400, "height": 300}
    slm = {"name": "SLM-1", "x": 400, "y": 0, "width": 320, "height": 200}
    dpi = {"logicalDpi": 96, "logicalBaseDpi": 96, "dpr": 1}
    path = tmp_path / "screens.json"
    path.write_text(json.dumps({"screens": [desk | dpi, slm | dpi]}))
    return f"offscreen:configfile={path}"


@pytest.fixture(autouse=True)
def two_screens(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("QT_QPA_PLATFORM", screens(tmp_path))
    monkeypatch.delenv("DBUS_SESSION_BUS_ADDRESS", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    # Other tests of this process may have made a QGuiApplication.
    monkeypatch.setattr(slm_module, "_qt_program_runs", lambda: False)


def options(**changes: Any) -> SecondDisplayOptions:
    row = {"output": "SLM-1", "pixel_pitch_um": 8.0, "settle_ms": 0, "refreshes_to_wait": 0}
    return SecondDisplayOptions(**row | {"check_by_screenshot": True} | changes)


class TestSecondDisplay(SlmContract):
    def make(self) -> Device:
        return SecondDisplaySlm(options())


@pytest.fixture
def slm() -> Iterator[SecondDisplaySlm]:
    with SecondDisplaySlm(options()) as device:
        yield device


# Which output ------------------------------------------------------------------------------------------
def output(index: int, **changes: Any) -> Output:
    row = {"name": f"DP-{index}", "manufacturer": "HOL", "model": "PLUTO", "serial_number": f"{index}"}
    row |= {"width": 1920, "height": 1080, "refresh_hz": 60.0, "depth": 24, "primary": index == 0}
    return Output(index=index, **row | changes)


THREE = (output(0), output(1), output(2))


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        ({"output": "DP-2"}, 2),
        ({"serial_number": "1"}, 1),
        ({"index": 1}, 1),
        ({"model": "PLUTO", "index": 2}, 2),
    ],
)
def test_an_output_is_chosen_by_what_is_given(given: dict[str, Any], expected: int) -> None:
    assert choose(THREE, SecondDisplayOptions(pixel_pitch_um=8, **given), "slm").index == expected


@pytest.mark.parametrize(
    ("given", "outputs", "text"),
    [
        ({"output": "HDMI-1"}, THREE, r"no output with output = 'HDMI-1'.*DP-0 .*DP-1 .*DP-2"),
        (
            {"output": "DP-1", "serial_number": "2"},
            THREE,
            "no output with output = 'DP-1', serial_number = '2'",
        ),
        ({"model": "PLUTO"}, THREE, "several outputs have model = 'PLUTO'"),
        ({"output": "DP-0"}, THREE, "primary output.*allow_primary"),
        ({"output": "DP-1", "shape": (1080, 1980)}, THREE, r"\(width x height\), not 1980 x 1080"),
        ({"output": "DP-1", "shape": (1920, 1080)}, THREE, r"Write shape = \[1080, 1920\]"),
        ({"output": "DP-1"}, (output(1, depth=16),), "16 bits a pixel"),
        ({"output": "DP-1"}, (), "Outputs there are: none"),
    ],
)
def test_a_wrong_output_is_refused_by_name(
    given: dict[str, Any], outputs: tuple[Output, ...], text: str
) -> None:
    with pytest.raises(DeviceError, match=text):
        choose(outputs, SecondDisplayOptions(pixel_pitch_um=8, **given), "slm")


def test_the_primary_output_is_covered_only_when_allowed() -> None:
    allowed = SecondDisplayOptions(pixel_pitch_um=8, output="DP-0", allow_primary=True)
    assert choose(THREE, allowed, "slm").index == 0


def test_an_output_must_be_named() -> None:
    with pytest.raises(ValidationError, match="name the output by"):
        SecondDisplayOptions(pixel_pitch_um=8)


# In a process of its own -------------------------------------------------------------------------------
def test_the_outputs_are_discovered_and_the_second_one_offered() -> None:
    found = SecondDisplaySlm.discover()
    assert [device.address for device in found] == ["DESK-1", "SLM-1"]
    assert [device.driver for device in found] == [None, "second_display"]
    lines = found[1].bench_lines()
    assert 'output = "SLM-1"\nshape = [200, 320]' in lines
    assert "primary" in found[0].description


def test_no_such_output_is_an_error_that_lists_them() -> None:
    slm = SecondDisplaySlm(options(output="HDMI-3"))
    with pytest.raises(DeviceError, match=r"no output with output = 'HDMI-3'.*DESK-1.*SLM-1"):
        slm.open()
    assert not slm.is_open
    slm.close()


def test_without_a_desktop_the_error_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QT_QPA_PLATFORM", "xcb")
    monkeypatch.setenv("DISPLAY", ":4711")
    with pytest.raises(DeviceError, match=r"Qt cannot open a window here.*DISPLAY"):
        SecondDisplaySlm(options()).open()


def test_without_qt_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slm_module.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(DeviceError, match=r'pip install "diffuserbench\[gui\]"'):
        SecondDisplaySlm(options()).open()


def test_the_driver_can_be_configured_without_qt() -> None:
    code = (
        "import sys; from drivers.registry.registry import load_driver; "
        "load_driver('slm', 'second_display'); "
        "print([name for name in sys.modules if name.startswith('PySide6')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, check=True)
    assert done.stdout == "[]\n"


def test_without_qts_libraries_the_error_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "PySide6").mkdir()
    (tmp_path / "PySide6" / "__init__.py").write_text("")
    text = "libEGL.so.1: cannot open shared object file: No such file or directory"
    (tmp_path / "PySide6" / "QtCore.py").write_text(f"raise ImportError({text!r})")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(DeviceError, match=r"Qt cannot be loaded: .*libEGL.*apt install libegl1"):
        SecondDisplaySlm(options()).open()


def test_waits_for_the_output_then_for_the_liquid_crystal() -> None:
    with SecondDisplaySlm(options(settle_ms=30.0, refreshes_to_wait=3)) as slm:
        assert slm.settle_ms == pytest.approx(3e3 / slm.settings()["refresh_hz"] + 30.0)
        began_s = time.monotonic()
        slm.blank()
        assert time.monotonic() - began_s >= slm.settle_ms * 1e-3


def process_of(slm: SecondDisplaySlm) -> subprocess.Popen[bytes]:
    assert isinstance(slm._window, WindowProcess)
    return slm._window._process


def test_a_window_that_dies_is_an_error_and_opening_again_helps(slm: SecondDisplaySlm) -> None:
    process_of(slm).kill()
    with pytest.raises(DeviceError, match=r"slm \(second_display\): its window's process ended"):
        slm.display(np.ones(slm.shape, np.uint8))
    assert until(lambda: not slm.is_open)
    slm.open()
    assert slm.is_open
    slm.display(np.ones(slm.shape, np.uint8))


def test_a_window_that_hangs_is_an_error_and_closing_ends_it(
    slm: SecondDisplaySlm, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.second_display.process._ANSWER_S", 0.2)
    monkeypatch.setattr("drivers.second_display.process._END_S", 0.2)
    process = process_of(slm)
    process.send_signal(signal.SIGSTOP)
    with pytest.raises(DeviceError, match="did not answer within"):
        slm.display(np.ones(slm.shape, np.uint8))
    slm.close()
    assert process.poll() is not None


def test_a_late_answer_is_not_taken_for_the_next_one(
    slm: SecondDisplaySlm, monkeypatch: pytest.MonkeyPatch
) -> None:
    window = slm._window
    assert isinstance(window, WindowProcess)
    process = process_of(slm)
    monkeypatch.setattr("drivers.second_display.process._ANSWER_S", 0.2)
    process.send_signal(signal.SIGSTOP)
    with pytest.raises(DeviceError, match="did not answer within"):
        slm.display(np.ones(slm.shape, np.uint8))
    with pytest.raises(DeviceError, match="unknown after a failure"):
        _ = slm.displayed
    process.send_signal(signal.SIGCONT)
    monkeypatch.setattr("drivers.second_display.process._ANSWER_S", 20.0)
    assert [output.name for output in window.outputs()] == ["DESK-1", "SLM-1"]
    slm.display(np.ones(slm.shape, np.uint8))
    assert (slm.displayed == 1).all()


def test_ctrl_c_does_not_reach_the_window(slm: SecondDisplaySlm) -> None:
    process = process_of(slm)
    assert os.getpgid(process.pid) != os.getpgrp()
    process.send_signal(signal.SIGINT)
    slm.display(np.ones(slm.shape, np.uint8))


def test_the_window_ends_with_a_program_that_is_killed() -> None:
    """Even while a process forked from that program holds its end of the socket."""
    code = (
        "import os, sys, time\n"
        "from tests.drivers.test_second_display import SecondDisplaySlm, options, process_of\n"
        "slm = SecondDisplaySlm(options()); slm.open()\n"
        "forked = os.fork()\n"
        "if forked: print(process_of(slm).pid, forked, flush=True)\n"
        "time.sleep(60)\n"
    )
    program = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=ROOT)
    assert program.stdout is not None
    window, forked = map(int, program.stdout.readline().split())
    try:
        assert Path(f"/proc/{window}").exists()
        program.kill()
        program.wait()
        assert until(lambda: not running(window))
    finally:
        os.kill(forked, signal.SIGKILL)
        program.stdout.close()


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


def test_closing_ends_the_wait_for_settling() -> None:
    slm = SecondDisplaySlm(options(settle_ms=60_000.0))
    slm.open()
    levels = np.ones(slm.shape, np.uint8)
    waiting = threading.Thread(target=lambda: slm.display(levels))
    waiting.start()
    assert until(lambda: slm._displayed is not None and bool(slm._displayed.any()))
    slm.close()
    waiting.join(20)
    assert not waiting.is_alive()


def open_files() -> int:
    return sum(1 for _ in Path("/proc/self/fd").iterdir())


def test_two_programs_do_not_share_an_output() -> None:
    assert SecondDisplaySlm.claims(options()) == ("display output SLM-1",)
    assert SecondDisplaySlm.claims(options(output=None, model="PLUTO", index=2)) == (
        "display model PLUTO, index 2",
    )


def test_nothing_is_left_behind(slm: SecondDisplaySlm) -> None:
    process = process_of(slm)
    before = open_files()
    for _ in range(2):
        slm.close()
        slm.open()
    assert process.poll() is not None
    assert open_files() == before


DESKTOP = """\
import sys
from PySide6.QtCore import ClassInfo, QCoreApplication, QObject, Slot
from PySide6.QtDBus import QDBusConnection, QDBusServiceWatcher
@ClassInfo({"D-Bus Interface": "org.freedesktop.ScreenSaver"})
class Desktop(QObject):
    @Slot(str, str, result="uint")
    def Inhibit(self, program, reason):
        print(f"{program}: {reason}", flush=True)
        return 1
app, desktop, bus = QCoreApplication([]), Desktop(), QDBusConnection.sessionBus()
bus.registerObject("/org/freedesktop/ScreenSaver", desktop, QDBusConnection.RegisterOption.ExportAllSlots)
assert bus.registerService("org.freedesktop.ScreenSaver")
print("ready", flush=True)
app.exec()
"""


@pytest.mark.skipif(shutil.which("dbus-run-session") is None, reason="dbus-run-session is not installed")
def test_the_desktop_is_asked_to_keep_its_screen_saver_off() -> None:
    code = (
        "import subprocess, sys\n"
        f"program = [sys.executable, '-c', {DESKTOP!r}]\n"
        "desktop = subprocess.Popen(program, stdout=subprocess.PIPE, text=True)\n"
        "assert desktop.stdout.readline() == 'ready\\n'\n"
        "from tests.drivers.test_second_display import SecondDisplaySlm, options\n"
        "with SecondDisplaySlm(options()) as slm:\n"
        "    assert slm.settings()['screen_saver_kept_off_by'] == 'the desktop'\n"
        "    print(desktop.stdout.readline())\n"
        "desktop.kill(); desktop.communicate()\n"
    )
    done = subprocess.run(
        ["dbus-run-session", "--", sys.executable, "-c", code],
        capture_output=True, text=True, cwd=ROOT, timeout=60, check=False,
    )  # fmt: skip
    assert done.stdout.strip() == "diffuserbench: a pattern is shown on the SLM", done.stderr


# In a Qt program ---------------------------------------------------------------------------------------
def in_qt_program(*tests: str, **environment: str) -> dict[str, Any]:
    """Run functions of ``qt_program`` and return what each found."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.drivers.qt_program", *tests],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=os.environ | environment,
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What a Qt program found; one for all tests, for the sake of time."""
    tests = ("exact", "clicks_and_keys", "drawn_wrongly", "from_the_gui_thread", "unplugged")
    tests += ("blocked", "closed_while_blocked")
    return in_qt_program(*tests, QT_QPA_PLATFORM=screens(tmp_path_factory.mktemp("qt")))


def test_in_a_qt_program_its_gui_thread_draws_exactly(program: dict[str, Any]) -> None:
    assert program["exact"] == {"here": True, "same": True}


@pytest.mark.parametrize("factor", [1.25, 1.75, 2.0])
def test_a_scaled_desktop_does_not_scale_the_pattern(factor: float) -> None:
    found = in_qt_program("scaled", QT_SCALE_FACTOR=str(factor))["scaled"]
    assert found == {"ratio": factor, "shape": [200, 320], "same": True}


def test_its_own_process_is_not_scaled_either(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QT_SCALE_FACTOR", "1.75")
    with SecondDisplaySlm(options()) as slm:
        assert slm.shape == (200, 320)
        slm.display(np.full(slm.shape, 3, np.uint8))


def test_keys_and_requests_to_close_do_nothing(program: dict[str, Any]) -> None:
    assert program["clicks_and_keys"] == {"visible": True, "same": True, "goes_on": True}


def test_a_pattern_drawn_wrongly_by_one_pixel_is_noticed_by_screenshot(program: dict[str, Any]) -> None:
    assert "a screenshot of SLM-1 differs from the pattern" in program["drawn_wrongly"]["said"]


def test_it_can_be_used_from_the_gui_thread_itself(program: dict[str, Any]) -> None:
    assert program["from_the_gui_thread"] == {"same": True}


def test_an_output_that_is_unplugged_is_an_error_by_name_and_can_be_opened_again(
    program: dict[str, Any],
) -> None:
    found = program["unplugged"]
    assert not found["was_open"]
    assert "slm (second_display): output SLM-1 was unplugged" in found["said"]
    assert found["reopened_blank"]


def test_a_blocked_gui_thread_is_an_error_and_draws_nothing_later(program: dict[str, Any]) -> None:
    found = program["blocked"]
    assert "GUI thread did not draw within 0.2 s" in found["said"]
    assert found["old"]


def test_closing_while_the_gui_thread_is_blocked_leaves_no_window(program: dict[str, Any]) -> None:
    found = program["closed_while_blocked"]
    assert "GUI thread did not draw within 0.2 s" in found["said"]
    assert found["left"] == 0
