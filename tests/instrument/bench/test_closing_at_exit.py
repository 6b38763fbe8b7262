"""A bench that is still open when the program ends: made safe, and the end comes even if a driver hangs."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from instrument.bench.safety import ClosingAtExit

BENCH = """
[bench]
name = "left open"
[camera]
driver = "simulated"
[led_array]
driver = "simulated"
leds = 5
[simulated]
preset = "tiny"
"""

PROGRAM = """
import time
from pathlib import Path
from instrument.bench import safety
from instrument.bench.bench import open_bench

bench = open_bench(Path("bench.toml"))
bench.source_on()
real = bench.led_array.off
def off():
    {before}
    real()
    print("dark", flush=True)
bench.led_array.off = off
safety.EXIT_WAIT_S = {wait_s}
"""


def _run(folder: Path, before: str, wait_s: float) -> subprocess.CompletedProcess[str]:
    (folder / "bench.toml").write_text(BENCH)
    return subprocess.run(
        [sys.executable, "-c", PROGRAM.format(before=before, wait_s=wait_s)],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,  # a hang, not a slow machine
        check=False,
    )


def test_what_was_left_open_is_closed(tmp_path: Path) -> None:
    run = _run(tmp_path, "pass", 60.0)
    assert run.returncode == 0, run.stderr
    assert "dark" in run.stdout
    assert "did not answer" not in run.stderr


def test_a_driver_that_hangs_does_not_keep_the_program_from_ending(tmp_path: Path) -> None:
    run = _run(tmp_path, "time.sleep(600)", 0.2)
    assert run.returncode == 0, run.stderr
    assert "dark" not in run.stdout
    assert "did not answer within 0.2 s" in run.stderr
    assert "See by eye that light and motion are off" in run.stderr


@pytest.mark.parametrize("count", [1, 2])
def test_a_bench_that_was_closed_is_not_touched_again(tmp_path: Path, count: int) -> None:
    (tmp_path / "bench.toml").write_text(BENCH)
    program = (
        "from pathlib import Path\nfrom instrument.bench.bench import open_bench\n"
        f"for _ in range({count}):\n    bench = open_bench(Path('bench.toml')); bench.close()\n"
        "bench.close = lambda: print('again', flush=True)\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    assert "again" not in run.stdout


@pytest.mark.parametrize("has_thread", [True, False], ids=["program", "forked child"])
def test_what_is_open_at_the_end_is_closed_and_nothing_is_said(
    caplog: pytest.LogCaptureFixture, *, has_thread: bool
) -> None:
    class Left:
        closed = False

        def close(self) -> None:
            self.closed = True

    closing, bench = ClosingAtExit(), Left()
    if has_thread:
        closing.watch(bench)
    else:
        closing._open.add(bench)
    closing._end()
    assert bench.closed
    assert not caplog.text


def test_the_end_is_asked_for_once_whatever_number_of_benches_is_watched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    class Left:
        def close(self) -> None:
            pass

    registered: list[object] = []
    monkeypatch.setattr("instrument.bench.safety.atexit.register", registered.append)
    closing, benches = ClosingAtExit(), [Left(), Left()]
    for bench in benches:
        closing.watch(bench)
    assert registered == [closing._end]
    assert closing._thread is not None
    assert closing._thread.daemon
    closing.forget(benches[0])
    assert list(closing._open) == benches[1:]
    closing._end()
    assert closing._done.is_set()
