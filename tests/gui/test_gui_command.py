"""``diffuserbench gui`` as a program: it starts, ends safely on a signal, and says what it lacks."""

from __future__ import annotations

import builtins
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from PySide6.QtCore import QSettings, QTimer
from PySide6.QtWidgets import QApplication

from gui import app
from gui.main_window import MainWindow
from gui.widgets.dialogues import TextWindow
from instrument.cli import main


@pytest.fixture(autouse=True)
def standing_back(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[bool]]:
    """Whether threads were asked to stand back, which they do for good: not in the tests' process."""
    asked: list[bool] = []
    monkeypatch.setattr(app, "stand_back", lambda: asked.append(True))
    usual_s = sys.getswitchinterval()
    yield asked
    sys.setswitchinterval(usual_s)


def test_help_has_examples(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gui", "--help"]) == 0
    assert "diffuserbench gui bench.toml" in capsys.readouterr().out


def test_a_wrong_bench_is_told_before_a_window_opens(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bench.toml"
    file.write_text('[camera]\ndriver = "simulatd"\n')
    assert main(["gui", str(file)]) == 2
    assert "Did you mean" in capsys.readouterr().err


@pytest.mark.usefixtures("qapp")
def test_a_wrong_bench_is_told_in_a_window_too(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "bench.toml"
    file.write_text('[camera]\ndriver = "simulatd"\n')
    shown: list[str] = []

    def read_and_close() -> None:
        for window in QApplication.topLevelWidgets():
            if isinstance(window, TextWindow) and window.isVisible():
                shown.append(window.view.toPlainText())
                window.close()
                return
        QTimer.singleShot(50, read_and_close)

    monkeypatch.setattr("gui.app._has_viewer", lambda: True)  # the platform of tests has none
    QTimer.singleShot(0, read_and_close)
    assert main(["gui", str(file)]) == 2
    (text,) = shown
    assert "bench.toml:2" in text
    assert "Did you mean" in text
    assert "Did you mean" in capsys.readouterr().err


def test_without_the_extra_one_sentence_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real = builtins.__import__

    def without_qt(name: str, *rest: Any, **named: Any) -> Any:
        if name == "gui.app":
            raise ModuleNotFoundError("No module named 'PySide6'", name="PySide6.QtCore")
        return real(name, *rest, **named)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(builtins, "__import__", without_qt)
    assert main(["gui"]) == 2
    assert 'pip install "diffuserbench[gui]"' in capsys.readouterr().err


def test_ctrl_c_waits_while_the_window_s_library_is_read(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    real, read = builtins.__import__, []

    def interrupted(name: str, *rest: Any, **named: Any) -> Any:
        if name == "gui.app":
            signal.raise_signal(signal.SIGINT)  # Qt's bindings would abort the program
            signal.raise_signal(signal.SIGINT)
            read.append(name)
        return real(name, *rest, **named)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(builtins, "__import__", interrupted)
    assert main(["gui"]) == 130
    assert read == ["gui.app"]
    assert "interrupted." in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_without_a_screen_it_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    for variable in ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM"):
        monkeypatch.delenv(variable, raising=False)
    assert main(["gui"]) == 2
    assert "no screen" in capsys.readouterr().err


@pytest.mark.usefixtures("qapp")
def test_ctrl_c_while_the_window_is_made_ends_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, bench_text: str, standing_back: list[bool]
) -> None:
    for scope in (QSettings.Scope.UserScope, QSettings.Scope.SystemScope):
        QSettings.setPath(QSettings.Format.NativeFormat, scope, str(tmp_path / "settings"))
    (tmp_path / "bench.toml").write_text(bench_text)
    show, ends = app.show_and_open, QTimer(singleShot=True, interval=20_000)
    ends.timeout.connect(QApplication.quit)

    def interrupted(window: MainWindow) -> None:
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)
        show(window)
        while not window.session.is_closed:
            QApplication.processEvents()
        ends.start()
        window.deleteLater()

    monkeypatch.setattr(app, "show_and_open", interrupted)
    assert main(["gui", str(tmp_path / "bench.toml")]) == 0
    assert sys.getswitchinterval() == pytest.approx(0.001), "a click waits for no thread longer (0296)"
    assert standing_back, "nor for those that compute (0301)"
    assert ends.isActive()  # nothing had to end it


@pytest.mark.usefixtures("qapp")
def test_sigterm_ends_it_with_everything_closed(tmp_path: Path, bench_text: str) -> None:
    for scope in (QSettings.Scope.UserScope, QSettings.Scope.SystemScope):
        QSettings.setPath(QSettings.Format.NativeFormat, scope, str(tmp_path / "settings"))
    file = tmp_path / "bench.toml"
    file.write_text(bench_text)
    seen: list[MainWindow] = []
    timer = QTimer()

    def end_once_it_runs() -> None:
        for window in QApplication.topLevelWidgets():
            if isinstance(window, MainWindow) and window.session.live.newest() is not None and not seen:
                seen.append(window)
                os.kill(os.getpid(), signal.SIGTERM)

    timer.timeout.connect(end_once_it_runs)
    timer.start(50)
    before = signal.getsignal(signal.SIGTERM)
    try:
        assert main(["gui", str(file)]) == 0
    finally:
        timer.stop()
        signal.signal(signal.SIGTERM, before)
    (window,) = seen
    assert not any(device.is_open for device in window.session.bench.devices.values())
    assert (tmp_path / "settings").exists()
    window.deleteLater()


def test_first_frame_waits_for_no_import_that_it_does_not_need() -> None:
    late = (
        "scipy.fft",
        "scipy.spatial",
        "recon.reconstruction",
        "recon.solvers",
        "dask",
        "matplotlib",
        "zarr",
        "calibration_routines",
        "instrument.runs",
        "recon.holography",
    )
    code = "import sys, gui.app, gui.panels.live, drivers.simulated.world; "
    code += f"print([m for m in {late} if m in sys.modules])"
    code += "; from gui.panels.led_array import LedPanel; LedPanel.prepare(); sys.modules['scipy.spatial']"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
