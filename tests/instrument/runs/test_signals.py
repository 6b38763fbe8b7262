"""A program that is asked to end, or simply ends, leaves the bench safe: real processes, real signals."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from instrument.runs.run import Run, RunCondition

ROOT = Path(__file__).parents[3]
SETUP = """
import sys, time
from importlib.metadata import EntryPoint
from drivers.registry import registry
from tests.mocks.devices import MockCamera, MockDevice
MockCamera.snap_time_s = 0.02
mocks = {f"mock.{k}": f"tests.mocks.devices:Mock{n}" for k, n in
         dict(camera="Camera", stage="Stage", led_array="LedArray").items()}
registry._points = lambda: tuple(EntryPoint(n, v, registry.GROUP) for n, v in mocks.items())
original = MockDevice._call
def call(self, method):
    original(self, method)
    if method == "snap":
        time.sleep(0.02)
    print(f"{self.kind}.{method}", flush=True)
MockDevice._call = call
"""
RUN = SETUP + "from instrument.cli import main\nsys.exit(main(['run', 'plan.toml']))\n"
BENCH = "".join(f'[{kind}]\ndriver = "mock"\n' for kind in ("camera", "stage", "led_array"))
PLAN = 'label = "long"\n[[parts]]\nlabel = "a"\nlight = "source"\nrepeats = 5000\n'


@pytest.fixture
def here(tmp_path: Path) -> Path:
    (tmp_path / "bench.toml").write_text(BENCH + '[scene]\ncontrol = "simulated"\n')
    (tmp_path / "plan.toml").write_text(PLAN)
    return tmp_path


def program(code: str, folder: Path) -> subprocess.Popen[str]:
    """Start a program that minds SIGHUP, even where nohup runs the tests and its ignoring is inherited."""
    heeding = "import signal\nsignal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    return subprocess.Popen(
        [sys.executable, "-c", heeding + code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )


def until(process: subprocess.Popen[str], line: str, times: int) -> None:
    assert process.stdout is not None
    seen = 0
    for found in process.stdout:
        seen += found.strip() == line
        if seen == times:
            return
    raise AssertionError(f"{line} never came {times} times: {process.stderr and process.stderr.read()}")


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGTERM, 143), (signal.SIGHUP, 129), (signal.SIGINT, 130)]
)
def test_a_signal_ends_the_run_safely_and_says_where_it_is(here: Path, number: int, status: int) -> None:
    process = program(RUN, here)
    until(process, "camera.snap", 3)
    process.send_signal(number)
    try:
        rest, errors = process.communicate(timeout=250)
    finally:
        process.kill()
    assert process.returncode == status, errors
    calls = rest.split()
    assert "led_array.set_pattern" not in calls[calls.index("led_array.off") :]
    assert calls.index("led_array.off") < calls.index("stage.stop")
    assert calls[-3:] == ["led_array.close", "stage.close", "camera.close"]
    (path,) = (here / "runs").iterdir()
    assert str(path.name) in errors
    run = Run.open(path)
    assert run.condition is RunCondition.ABORTED
    assert len(run.records) >= 2
    assert "Traceback" not in errors


def test_killed_it_says_crashed_and_everything_logged_is_there(here: Path) -> None:
    process = program(RUN, here)
    until(process, "camera.snap", 10)
    (path,) = (here / "runs").iterdir()
    assert Run.open(path).condition is RunCondition.RUNNING
    process.kill()
    process.communicate()
    run = Run.open(path)
    assert run.condition is RunCondition.CRASHED
    assert len(run.records) >= 8
    assert all(run.verify(index) is None for index in run.records)


def test_a_program_that_forgets_to_close_its_bench_leaves_no_light_on(here: Path) -> None:
    code = (
        SETUP
        + "from instrument.bench.bench import open_bench\n"
        + "bench = open_bench('bench.toml')\nbench.source_on()\n"
    )
    process = program(code, here)
    out, _ = process.communicate(timeout=250)
    calls = out.split()
    assert "led_array.off" in calls[calls.index("led_array.set_pattern") :]
    assert process.returncode == 0


def test_stop_does_not_wait_for_the_exposure(here: Path) -> None:
    """An exposure that would outlast the test's limit; benchmarks/latency.py measures how soon STOP comes."""
    code = (
        SETUP
        + """
import threading
from instrument.runs.acquire import prepare
from instrument.bench.bench import open_bench
from instrument.plan.model import load_plan
from drivers.errors import StoppedError
ended = threading.Event()
started = threading.Event()
def snap(self):
    started.set()
    ended.wait(600)
    raise StoppedError(self.name, "stopped")
def stop_sequence(self):
    ended.set()
MockCamera.snap, MockCamera.stop_sequence = snap, stop_sequence
with open_bench("bench.toml") as bench:
    runner = prepare(bench, load_plan("plan.toml"))
    thread = threading.Thread(target=runner.execute)
    thread.start()
    started.wait()
    ended.clear()
    runner.stop()
    print("ENDED", bench.led_array.pattern.is_dark, runner.status.reason)
    thread.join()
"""
    )
    process = program(code, here)
    try:
        out, errors = process.communicate(timeout=250)  # of a machine that does much else, too
    finally:
        process.kill()
    assert process.returncode == 0, errors
    (line,) = [line for line in out.splitlines() if line.startswith("ENDED")]
    assert line.split()[1:] == ["True", "stopped"]


def test_an_object_half_made_when_interrupted_shows_no_traceback(here: Path) -> None:
    """As a library's, interrupted while it compiles: it fails once more when the interruption is let go."""
    code = """
import sys
import instrument.cli.capture as snap
from instrument.cli import main
class Handle:
    def __init__(self):
        raise KeyboardInterrupt
    def __del__(self):
        del self.never_set
snap.snap_app.registered_commands[0].callback = lambda: Handle()
sys.exit(main(["snap"]))
"""
    process = program(code, here)
    _, errors = process.communicate(timeout=250)
    assert process.returncode == 130
    assert "interrupted." in errors
    assert "Traceback" not in errors
