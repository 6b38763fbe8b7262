"""The SLM as second display on a real X server with two outputs: exact by screenshot, unplugged while open.

A Wayland desktop (weston) with two outputs runs as a client of the same server. Needs Xorg with its dummy
driver (Debian: xserver-xorg-core xserver-xorg-video-dummy x11-xserver-utils libxcb-cursor0 libxcb-icccm4
libxcb-keysyms1, weston); skipped where that is not installed.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers.errors import DeviceError
from drivers.second_display import slm as slm_module
from drivers.second_display.outputs import SecondDisplayOptions
from drivers.second_display.slm import SecondDisplaySlm
from tests.mocks.waiting import until

pytest.importorskip("PySide6.QtGui", reason="Qt cannot be loaded here", exc_type=ImportError)
XORG = shutil.which("Xorg") or "/usr/lib/xorg/Xorg"
DUMMY = Path("/usr/lib/xorg/modules/drivers/dummy_drv.so")
pytestmark = pytest.mark.skipif(
    not (Path(XORG).exists() and DUMMY.exists() and shutil.which("xrandr")),
    reason="Xorg with the dummy driver and xrandr are not installed: no test on a real X server",
)

CONFIGURATION = """\
Section "ServerFlags"
  Option "AutoAddDevices" "false"
EndSection
Section "Device"
  Identifier "device"
  Driver "dummy"
  VideoRam 64000
EndSection
Section "Monitor"
  Identifier "monitor"
  HorizSync 5-1000
  VertRefresh 5-200
EndSection
Section "Screen"
  Identifier "screen"
  Monitor "monitor"
  Device "device"
  DefaultDepth 24
  SubSection "Display"
    Depth 24
    Virtual 2080 1024
  EndSubSection
EndSection
"""

SHOT = """\
import sys
from PySide6.QtGui import QGuiApplication, QImage
app = QGuiApplication([])
screen = QGuiApplication.primaryScreen()
shot = screen.grabWindow(0, *map(int, sys.argv[1:])).toImage().convertToFormat(QImage.Format.Format_RGB888)
for row in range(shot.height()):
    sys.stdout.buffer.write(bytes(shot.constScanLine(row))[: 3 * shot.width()])
"""


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """A fresh X server; returns its display."""
    folder = tmp_path_factory.mktemp("xorg")
    (folder / "xorg.conf").write_text(CONFIGURATION)
    # -displayfd: the server takes a free number and tells it. -noreset: it stays when its last client goes.
    reading, writing = os.pipe()
    log = (folder / "output").open("wb")
    files = ("-config", str(folder / "xorg.conf"), "-logfile", str(folder / "log"))
    alone = ("-nolisten", "tcp", "-noreset", "-novtswitch", "-sharevts")
    process = subprocess.Popen(
        [XORG, "-displayfd", str(writing), *files, *alone],
        pass_fds=(writing,),
        stdout=log,
        stderr=log,
    )
    os.close(writing)
    with os.fdopen(reading) as number:
        display = number.readline().strip()
    try:
        if not display:
            pytest.skip(f"Xorg does not start here: {(folder / 'output').read_text()[-500:]}")
        yield f":{display}"
    finally:
        process.terminate()
        process.wait()
        log.close()


@pytest.fixture
def outputs(server: str, monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """The desk's output and the SLM's beside it; returns xrandr."""
    monkeypatch.setenv("DISPLAY", server)
    monkeypatch.setenv("QT_QPA_PLATFORM", "xcb")
    monkeypatch.delenv("DBUS_SESSION_BUS_ADDRESS", raising=False)
    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(slm_module, "_qt_program_runs", lambda: False)

    def xrandr(*arguments: str) -> None:
        done = subprocess.run(["xrandr", *arguments], capture_output=True, timeout=20, check=False)
        assert done.returncode == 0, done.stderr

    xrandr("--addmode", "DUMMY1", "800x600")
    xrandr("--addmode", "DUMMY1", "640x480")
    desk = ("--output", "DUMMY0", "--mode", "1280x1024", "--pos", "0x0", "--primary")
    xrandr(*desk, "--output", "DUMMY1", "--mode", "800x600", "--pos", "1280x0")
    return xrandr


def options(**changes: Any) -> SecondDisplayOptions:
    row = {"output": "DUMMY1", "pixel_pitch_um": 8.0, "settle_ms": 0, "refreshes_to_wait": 0}
    return SecondDisplayOptions(**row | changes)


def shot(left: int, top: int, width: int, height: int) -> np.ndarray:
    """Red, green and blue of a part of the X server's screen, taken by another program."""
    done = subprocess.run(
        [sys.executable, "-c", SHOT, *map(str, (left, top, width, height))],
        capture_output=True,
        check=True,
        timeout=30,
        env=os.environ | {"QT_ENABLE_HIGHDPI_SCALING": "0", "QT_SCALE_FACTOR": "1"},
    )
    return np.frombuffer(done.stdout, np.uint8).reshape(height, width, 3)


def ramp(shape: tuple[int, int]) -> np.ndarray:
    return (np.arange(np.prod(shape)) % 251).astype(np.uint8).reshape(shape)


@pytest.mark.usefixtures("outputs")
def test_the_output_shows_the_levels_and_the_desk_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("QT_SCALE_FACTOR", "1.5")
    with SecondDisplaySlm(options(shape=(600, 800), check_by_screenshot=True)) as slm:
        assert slm.shape == (600, 800)
        assert not shot(1280, 0, 800, 600).any()
        slm.display(ramp(slm.shape))
        np.testing.assert_array_equal(shot(1280, 0, 800, 600), np.repeat(ramp(slm.shape)[..., None], 3, 2))
        assert not shot(0, 0, 1280, 1024).any()


@pytest.mark.usefixtures("outputs")
@pytest.mark.parametrize("factor", ["1", "1.5"])
def test_a_qt_program_shows_the_levels_whatever_the_desktops_scale(factor: str) -> None:
    found = subprocess.run(
        [sys.executable, "-m", "tests.drivers.qt_program", "exact", "clicks_and_keys"],
        capture_output=True,
        text=True,
        cwd=Path(__file__).parents[2],
        env=os.environ | {"SLM_OUTPUT": "DUMMY1", "QT_SCALE_FACTOR": factor},
        timeout=60,
        check=False,
    )
    assert found.stderr == ""
    assert json.loads(found.stdout) == {
        "exact": {"here": True, "same": True},
        "clicks_and_keys": {"visible": True, "same": True, "goes_on": True},
    }


@pytest.mark.usefixtures("outputs")
def test_a_window_over_the_slm_is_noticed_and_ours_comes_back() -> None:
    code = (
        "import sys, time\n"
        "from PySide6.QtCore import Qt\n"
        "from PySide6.QtGui import QGuiApplication, QRasterWindow\n"
        "app = QGuiApplication([])\n"
        "window = QRasterWindow()\n"
        "window.setFlags(Qt.WindowType.X11BypassWindowManagerHint)\n"
        "window.setGeometry(1300, 20, 200, 200)\n"
        "window.show()\n"
        "for _ in range(20):\n"
        "    app.processEvents(); time.sleep(0.01)\n"
        "print('shown', flush=True)\n"
        "for _ in range(300):\n"
        "    if len(sys.argv) > 1: window.raise_()\n"
        "    app.processEvents(); time.sleep(0.001)\n"
        "time.sleep(30)\n"
    )
    with SecondDisplaySlm(options(check_by_screenshot=True)) as slm:
        over = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        try:
            assert over.stdout is not None
            assert over.stdout.readline() == "shown\n"
            slm.display(ramp(slm.shape))  # raised over it, and compared
            np.testing.assert_array_equal(shot(1280, 0, 800, 600)[..., 0], ramp(slm.shape))
        finally:
            over.kill()
            over.communicate()


def test_an_output_switched_off_is_an_error_by_name_and_the_desk_stays_free(
    outputs: Callable[..., None],
) -> None:
    with SecondDisplaySlm(options()) as slm:
        slm.display(ramp(slm.shape))
        outputs("--output", "DUMMY1", "--off")
        assert until(lambda: not slm.is_open)
        with pytest.raises(DeviceError, match=r"output DUMMY1 was unplugged or switched off\."):
            slm.blank()
        assert not shot(0, 0, 1280, 1024).any()
        with pytest.raises(DeviceError, match="no output with output = 'DUMMY1'"):
            slm.open()
        outputs("--output", "DUMMY1", "--mode", "800x600", "--pos", "1280x0")
        slm.open()
        slm.display(ramp(slm.shape))
        np.testing.assert_array_equal(shot(1280, 0, 800, 600)[..., 0], ramp(slm.shape))


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("--mode", "640x480", "--pos", "1280x0"), "to 640 x 480 pixels at 1280, 0"),
        (("--pos", "1280x100"), "to 800 x 600 pixels at 1280, 100"),
    ],
)
def test_another_mode_or_place_is_an_error_by_name(
    outputs: Callable[..., None], change: tuple[str, ...], text: str
) -> None:
    """Qt does not notice; without asking the X server the pattern would lie beside the output."""
    with SecondDisplaySlm(options()) as slm:
        outputs("--output", "DUMMY1", *change)
        with pytest.raises(
            DeviceError, match=f"output DUMMY1 changed from 800 x 600 pixels at 1280, 0 {text}"
        ):
            slm.blank()
        assert not slm.is_open
        slm.open()
        slm.display(ramp(slm.shape))


@pytest.mark.usefixtures("outputs")
@pytest.mark.skipif(ctypes.util.find_library("Xtst") is None, reason="libXtst is not installed")
def test_real_clicks_and_keys_change_nothing(server: str) -> None:
    xlib, extension = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXtst.so.6")
    xlib.XOpenDisplay.restype = ctypes.c_void_p
    xlib.XKeysymToKeycode.restype = ctypes.c_ubyte
    display = ctypes.c_void_p(xlib.XOpenDisplay(server.encode()))
    with SecondDisplaySlm(options()) as slm:
        slm.display(ramp(slm.shape))
        for x in (1300, 1700, 2079):
            extension.XTestFakeMotionEvent(display, 0, x, x - 1290, 0)
            for button in (1, 2, 3):
                extension.XTestFakeButtonEvent(display, button, 1, 0)
                extension.XTestFakeButtonEvent(display, button, 0, 0)
        alt, *keys = (
            xlib.XKeysymToKeycode(display, ctypes.c_ulong(xlib.XStringToKeysym(name)))
            for name in (b"Alt_L", b"F4", b"Escape", b"q")
        )
        extension.XTestFakeKeyEvent(display, alt, 1, 0)
        for key in keys:
            extension.XTestFakeKeyEvent(display, key, 1, 0)
            extension.XTestFakeKeyEvent(display, key, 0, 0)
        extension.XTestFakeKeyEvent(display, alt, 0, 0)
        xlib.XSync(display, 0)
        time.sleep(0.3)
        np.testing.assert_array_equal(shot(1280, 0, 800, 600), np.repeat(ramp(slm.shape)[..., None], 3, 2))
        assert slm.is_open
        slm.blank()
    xlib.XCloseDisplay(display)


class ScreenSaverInfo(ctypes.Structure):
    _fields_ = (
        ("window", ctypes.c_ulong),
        ("state", ctypes.c_int),
        ("kind", ctypes.c_int),
        ("til_or_since", ctypes.c_ulong),
        ("idle", ctypes.c_ulong),
        ("event_mask", ctypes.c_ulong),
    )


def screen_saver_is_on(server: str) -> bool:
    xlib, extension = ctypes.CDLL("libX11.so.6"), ctypes.CDLL("libXss.so.1")
    xlib.XOpenDisplay.restype = ctypes.c_void_p
    xlib.XDefaultRootWindow.restype = ctypes.c_ulong
    display = ctypes.c_void_p(xlib.XOpenDisplay(server.encode()))
    info = ScreenSaverInfo()
    root = ctypes.c_ulong(xlib.XDefaultRootWindow(display))
    assert extension.XScreenSaverQueryInfo(display, root, ctypes.byref(info))
    xlib.XCloseDisplay(display)
    return info.state == 1


@pytest.mark.usefixtures("outputs")
@pytest.mark.skipif(ctypes.util.find_library("Xss") is None, reason="libXss is not installed")
def test_the_x_server_keeps_its_screen_saver_off(server: str) -> None:
    subprocess.run(["xset", "s", "1", "1"], check=True)
    try:
        assert until(lambda: screen_saver_is_on(server), every_s=0.05)
        with SecondDisplaySlm(options()) as slm:
            assert slm.settings()["screen_saver_kept_off_by"] == "the X server"
            subprocess.run(["xset", "s", "reset"], check=True)
            time.sleep(2.5)
            assert not screen_saver_is_on(server)
        assert until(lambda: screen_saver_is_on(server), every_s=0.05)
    finally:
        subprocess.run(["xset", "s", "off"], check=True)


@pytest.fixture
def wayland(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, int]]:
    """A Wayland desktop whose two outputs are windows of the X server, the second on top; its shape."""
    tmp_path.chmod(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    two = ("--output-count=2", "--width=640", "--height=480")
    process = subprocess.Popen(
        ["weston", "--backend=x11-backend.so", *two, "--use-pixman", "--no-config", "--socket=wayland-slm"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        assert until((tmp_path / "wayland-slm").exists)
        monkeypatch.setenv("WAYLAND_DISPLAY", "wayland-slm")
        monkeypatch.setenv("QT_QPA_PLATFORM", "wayland")
        yield 480, 640
    finally:
        process.terminate()
        process.wait()


@pytest.mark.usefixtures("outputs")
@pytest.mark.skipif(shutil.which("weston") is None, reason="weston is not installed: no test on Wayland")
def test_a_wayland_desktop_shows_the_levels_on_the_output_asked_for(
    wayland: tuple[int, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    height, width = wayland
    found = [device for device in SecondDisplaySlm.discover() if device.driver == "second_display"]
    assert len(found) == 1
    with SecondDisplaySlm(options(output=found[0].address, shape=wayland)) as slm:
        slm.display(ramp(slm.shape))

        def shown() -> bool:
            with monkeypatch.context() as on_x11:
                on_x11.setenv("QT_QPA_PLATFORM", "xcb")
                return bool((shot(0, 0, width, height) == ramp(slm.shape)[..., None]).all())

        assert until(shown, every_s=0.05)
    checked = SecondDisplaySlm(options(output=found[0].address, check_by_screenshot=True))
    with checked, pytest.raises(DeviceError, match="allows no screenshot"):
        checked.blank()
