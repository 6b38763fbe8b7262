"""A long day in short: live view, live reconstruction, jogging, and runs that start and stop.

The whole window on the simulated bench, offscreen. Every few seconds something is done as an operator does:
the stage is jogged, an LED lit, a photograph taken, a recording started and ended, a sweep run, STOP pressed.
Written: a figure of memory, frame rates and latency over time, and all samples as JSON. Fails (status 1) when
memory at rest grows by more than 20 MB after the first ten minutes, a turn of the window's thread takes more
than 250 ms of its own processor time, an LED shines after a run or STOP, a file, thread or piece of shared
memory is left, a warning or an error is logged, or the frame rate does not hold.

Memory at rest is what stays when the C library's allocator has handed back the pages that nobody uses. It
keeps 50 to 150 MB of them, by where pieces happen to lie: that comes and goes, and no leak is in it.

    python benchmarks/gui_soak.py --minutes 120
    python benchmarks/gui_soak.py --minutes 2 --figure /tmp/soak.png
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import json
import os
import shutil
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections import Counter
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
from PySide6.QtCore import QSettings, Qt
from PySide6.QtTest import QTest

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from benchmarks.gui_stalls import Turns
from drivers.simulated.led_array import SimulatedLedArray
from gui.app import application, go_first
from gui.main_window import MainWindow
from gui.panels.led_array import LedPanel
from gui.panels.live import LivePanel
from gui.panels.live_reconstruction import LiveReconstructionPanel
from gui.panels.slm import SlmPanel
from gui.panels.stage import StagePanel
from gui.session import BenchSession
from gui.theme import apply_theme
from instrument.bench.config_file import parse_config
from instrument.files.calibration_file import save_calibration
from instrument.plan.model import load_plan
from instrument.runs.acquire import prepare
from recon.types import Calibration
from tests.gui.event_loop import let_work, wait_until

BENCH = """
[bench]
name = "soak"
data_folder = "runs"
[camera]
driver = "simulated"
exposure_ms = 10.0
frames_per_s = 30.0
replay_frames = 16
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
leds = 89
[slm]
driver = "simulated"
shape = [360, 640]
settle_ms = 5.0
[scene]
control = "simulated"
[simulated]
preset = "tiny"
scene_rgb = [30.0, 30.0, 30.0]
"""
PLAN = """
label = "soak plan"
[[parts]]
label = "scene"
scene_lit = true
repeats = 6
[[parts]]
label = "sweep"
light = "source"
positions = { kind = "points", points_um = [[0, 0, 20e3], [0, 0, 30e3], [5e3, 0, 25e3]] }
"""
SAMPLE_S = 10.0
RESTS = 24
"""How often in all memory is looked at at rest."""
SETTLING, SETTLING_S = 0.3, 600.0
"""The beginning, when caches fill and the solver is timed: this share, at most so long; not judged."""
MOST_GROWTH_MB = 20.0
"""Over the judged time."""
LASTING = Counter(
    {f"{pool}_{n}": 1 for pool in ("asyncio", "recon") for n in range(8)}
    | {"zarr_io": 1, "closing at exit": 1, "anon_inode": 3, "socket": 2}
)
"""What a process has once for all its time: zarr's loop and threads, recon's threads, the end's own."""
MOST_STALL_MS = 100.0
"""Of the window's thread's own processor time, in one turn of its event loop."""
LEAST_RATE = 0.8
"""Of the first half's frames on the screen, which the second half has to show."""


def main() -> int:
    """Run, judge, write; returns the exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--figure", type=Path, default=Path("docs/images/gui-soak.png"))
    parser.add_argument("--out", type=Path, help="samples as JSON; default: beside the figure")
    parser.add_argument("--seed", type=int, default=0, help="of what is done when")
    arguments = parser.parse_args()
    app = application()
    go_first()
    apply_theme(app, "dark")
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), np.random.default_rng(arguments.seed))
        try:
            soak.run(60 * arguments.minutes)
        finally:
            soak.close()
        findings = soak.judge() + soak.left()
    out = arguments.out or arguments.figure.with_suffix(".json")
    facts = {"date": datetime.now(UTC).isoformat(), "minutes": arguments.minutes, "findings": findings}
    facts |= {"done": soak.done, "stalls_ms": soak.stalls_ms, "samples": soak.samples}
    out.write_text(json.dumps(facts) + "\n")
    draw(soak.samples, soak.done, arguments.minutes, arguments.figure)
    print(f"Done: {', '.join(f'{n} {what}' for what, n in sorted(soak.done.items()))}")
    print(f"Wrote {arguments.figure} and {out}")
    for finding in findings or ["Memory flat, no stall or warning, nothing left on, frame rate held."]:
        print(finding)
    return 1 if findings else 0


class Soak:
    """The window, what is done with it, and the samples."""

    def __init__(self, folder: Path, rng: np.random.Generator) -> None:
        self.folder, self.rng = folder, rng
        self.samples: list[dict[str, Any]] = []
        self.done: Counter[str] = Counter()
        self.complaints: list[str] = []
        self.stalls_ms: list[float] = []
        self._before = held()
        warnings.simplefilter("always")
        warnings.showwarning = self._warned
        threading.excepthook = lambda what: self.complaints.append(f"thread: {what.exc_value!r}")
        sys.excepthook = self._raised
        (folder / "plan.toml").write_text(PLAN)
        self.session = BenchSession(parse_config(BENCH, folder / "bench.toml"))
        self.session.logged.connect(self._logged)
        self.window = MainWindow(
            self.session, QSettings(str(folder / "window.ini"), QSettings.Format.IniFormat)
        )
        self.window.show()
        self.window.resize(1600, 980)
        self.session.open()
        self.live = self._panel("live", LivePanel)
        wait_until(lambda: self.live.picture.frame is not None)
        self.preview = self._panel("live_reconstruction", LiveReconstructionPanel)
        self.stage = self._panel("stage", StagePanel)
        self.leds = self._panel("led_array", LedPanel)
        self.slm = self._panel("slm", SlmPanel)
        wait_until(lambda: not self.session.jobs.device_jobs)
        self.preview.file.setText(str(self._calibrate()))
        self.preview.load()
        wait_until(lambda: self.preview._shown is not None)
        self.window.show_panel("stage")
        stage, self.array = self.session.bench.stage, self.session.bench.led_array
        assert stage is not None
        assert isinstance(self.array, SimulatedLedArray)
        homing = self.session.jobs.device("home", lambda _: stage.home(), {"stage"})
        wait_until(lambda: homing.is_over)
        self.turns = Turns()
        self._n_shown = 0
        show = self.live.picture.view.show_image

        def counted(*what: Any) -> None:
            self._n_shown += 1
            show(*what)

        self.live.picture.view.show_image = counted  # type: ignore[method-assign]

    def run(self, seconds: float) -> None:
        """Do things and take samples until the time is over."""
        actions = [
            self.jog,
            self.jog,
            self.light,
            self.photograph,
            self.record,
            self.plan,
            self.panels,
            self.stop,
        ]
        began_s = time.monotonic()
        next_sample_s, next_action_s = began_s + SAMPLE_S, began_s + 3.0
        next_rest_s = began_s + seconds / RESTS
        self._mark()
        self.turns.forget()
        while (now_s := time.monotonic()) - began_s < seconds:
            let_work(20)
            if now_s >= next_sample_s:
                rests = now_s >= next_rest_s
                self.sample(now_s - began_s, rests=rests)
                next_sample_s += SAMPLE_S
                next_rest_s += rests * seconds / RESTS
            if now_s >= next_action_s and self.session.jobs.exclusive_job is None:
                action = actions[int(self.rng.integers(len(actions)))]
                action()
                self.done[action.__name__] += 1
                next_action_s = now_s + float(self.rng.uniform(2.0, 6.0))

    # What an operator does -----------------------------------------------------------------------
    def jog(self) -> None:
        """Jog by a key."""
        keys = (Qt.Key.Key_Left, Qt.Key.Key_Right, Qt.Key.Key_Up, Qt.Key.Key_Down, Qt.Key.Key_PageUp)
        QTest.keyClick(self.stage.pad, keys[int(self.rng.integers(len(keys)))])

    def light(self) -> None:
        """Another LED pattern, then the scene again."""
        names = list(self.leds.pattern_buttons)
        self.leds.show_pattern(names[int(self.rng.integers(len(names)))])
        let_work(500)
        QTest.mouseClick(self.live.light_buttons.buttons()[0], Qt.MouseButton.LeftButton)

    def photograph(self) -> None:
        """Take a photograph by its key; kept files are removed, as they would fill the disk."""
        QTest.keyClick(self.window, Qt.Key.Key_K, Qt.KeyboardModifier.ControlModifier)
        wait_until(lambda: not self.session.jobs.device_jobs)
        shutil.rmtree(self.session.runs_folder / "photographs", ignore_errors=True)

    def record(self) -> None:
        """Record for about two seconds, by its key."""
        QTest.keyClick(self.window, Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
        let_work(2000)
        if self.live.record_bar.job is not None:
            QTest.keyClick(self.window, Qt.Key.Key_R, Qt.KeyboardModifier.ControlModifier)
        wait_until(lambda: self.session.jobs.exclusive_job is None)
        self._clear_runs()

    def plan(self) -> None:
        """Carry a plan out to its end; then the scene is lit again, as a run ends in the dark."""
        plan = load_plan(self.folder / "plan.toml")
        session = self.session

        def work(context: Any) -> None:
            prepare(session.bench, plan, session.runs_folder, on_progress=context.report).execute()

        job = session.exclusive_job("A plan", work)
        wait_until(lambda: job.is_over)
        self._dark("a run")
        QTest.mouseClick(self.live.light_buttons.buttons()[0], Qt.MouseButton.LeftButton)
        self._clear_runs()

    def panels(self) -> None:
        """Look at the other panels and come back."""
        for name in ("slm", "led_array", "stage"):
            self.window.show_panel(name)
            let_work(150)

    def stop(self) -> None:
        """STOP, then light again."""
        QTest.keyClick(self.window, Qt.Key.Key_Escape)
        wait_until(lambda: not self.session._stopping)
        self._dark("STOP")
        QTest.mouseClick(self.live.light_buttons.buttons()[0], Qt.MouseButton.LeftButton)

    # Samples -------------------------------------------------------------------------------------
    def sample(self, at_s: float, *, rests: bool) -> None:
        """Take a sample: memory, rates, latency, threads, blocks of memory that Python has."""
        now = time.perf_counter()
        live, preview = self.session.live.status(), self.preview.follower.status
        picture = self.preview.follower.newest()
        seconds = now - self._marked_s
        turns = self.turns.fetch()
        self.stalls_ms += [round(ms) for ms in turns if ms > MOST_STALL_MS]
        self.samples.append(
            {
                "s": round(at_s, 1),
                "memory_mb": resident_mb(),
                "at_rest_mb": at_rest_mb() if rests else None,
                "screen_per_s": self._n_shown / seconds,
                "camera_per_s": live.frames_per_s,
                "running": live.running,
                "dropped": live.dropped,
                "latency_ms": None if preview is None else preview.latency_median_ms,
                "pictures_per_s": None if preview is None else preview.pictures_per_s,
                "binning": None if picture is None else picture.picture.binning,
                "longest_turn_ms": turns[0] if turns else 0.0,
                "threads": threading.active_count(),
                "files": len(held()["file"]),
                "blocks": sys.getallocatedblocks(),  # gc.get_objects breaks other threads' unfinished tuples
                "cpu_share": (time.process_time() - self._marked_cpu_s) / seconds,
                "complaints": len(self.complaints),
            }
        )
        self._mark()
        self.turns.forget()  # the sample itself, a collection of all garbage, is not the window's doing

    def judge(self) -> list[str]:
        """Return what is not as it should be."""
        findings = [f"Logged: {text}" for text in self.complaints[:20]]
        settled_s = min(SETTLING_S, SETTLING * self.samples[-1]["s"])
        judged = [s for s in self.samples if s["s"] >= settled_s]
        resident = [s["memory_mb"] for s in judged]
        rests = [s for s in judged if s["at_rest_mb"] is not None]
        t, memory = (np.array([s[name] for s in rests]) for name in ("s", "at_rest_mb"))
        growth = float(np.polyfit(t, memory, 1)[0] * (t[-1] - t[0])) if len(rests) > 2 else 0.0
        print(f"Memory at rest {', '.join(f'{mb:.0f}' for mb in memory)} MB, trend {growth:+.1f} MB")
        print(f"Memory resident {min(resident):.0f} to {max(resident):.0f} MB over the judged time")
        if growth > MOST_GROWTH_MB:
            findings.append(f"Memory grew by {growth:.0f} MB.")
        longest = sorted((s["longest_turn_ms"] for s in self.samples), reverse=True)[:3]
        print(f"Longest turns of the window's thread, ms of its CPU: {[round(ms) for ms in longest]}")
        if self.stalls_ms:
            findings.append(f"{len(self.stalls_ms)} turns over {MOST_STALL_MS:.0f} ms: {self.stalls_ms[:10]}")
        third = max(len(judged) // 3, 1)
        for what in ("threads", "files"):
            begin, end = (min(s[what] for s in part) for part in (judged[:third], judged[-third:]))
            print(f"{what.capitalize()}: {begin} in the first third, {end} in the last (the least of each)")
            if end > begin:
                findings.append(f"{what.capitalize()} grew from {begin} to {end}.")
        half = len(judged) // 2
        first, second = (
            float(np.median([s["screen_per_s"] for s in part])) for part in (judged[:half], judged[half:])
        )
        print(f"On the screen: median {first:.1f} frames/s in the first half, {second:.1f} in the second")
        if second < LEAST_RATE * first:
            findings.append(f"The rate on the screen fell from {first:.1f} to {second:.1f} frames/s.")
        return findings

    def close(self) -> None:
        """Close the session and wait for its threads."""
        for panel in self.window._panels.values():
            panel.shutdown()
        self.session.close()
        wait_until(lambda: self.session.is_closed)
        self.session.join()

    def left(self) -> list[str]:
        """Return what the closed session has left open, running or on."""
        gc.collect()
        after = held()
        lit = [] if self.leds_are_dark() else ["The LED array shines after the end."]
        new = {what: after[what] - names - LASTING for what, names in self._before.items()}
        print(f"Left after the end: { {what: sum(names.values()) for what, names in new.items()} }")
        return lit + [f"Left: {what} {name}" for what, names in new.items() for name in names.elements()]

    def leds_are_dark(self) -> bool:
        """Whether the simulated LED array is dark, whatever it says."""
        return bool(self.array._pattern.is_dark)

    # Pieces --------------------------------------------------------------------------------------
    def _panel(self, name: str, kind: Any) -> Any:
        panel = self.window.show_panel(name)
        assert isinstance(panel, kind)
        return panel

    def _dark(self, after: str) -> None:
        if not self.leds_are_dark():
            self.complaints.append(f"an LED shines after {after}")

    def _mark(self) -> None:
        self._marked_s, self._marked_cpu_s, self._n_shown = time.perf_counter(), time.process_time(), 0

    def _calibrate(self) -> Path:
        """Photograph the point source: the calibration that the preview uses."""
        bench = self.session.bench
        with self.session.live.paused():
            bench.scene_off()
            dark = bench.snap(4).image.astype(np.float32)
            bench.source_on()
            bench.camera.set_exposure_ms(4.0)  # at 10 ms the brightest pixels are full
            psf = np.clip(bench.snap(4).image - dark.mean() - 3, 0, None)
            bench.camera.set_exposure_ms(10.0)
            bench.source_off()
            bench.scene_on()
        place = np.array([[0.0, 0.0, 1e5]])
        return save_calibration(
            Calibration(psf[None, None].astype(np.float32), place, dark[None]), self.folder / "calibration"
        )

    def _clear_runs(self) -> None:
        for run in self.session.runs_folder.glob("*_*"):
            shutil.rmtree(run, ignore_errors=True)

    def _logged(self, level: str, text: str) -> None:
        if level in ("warning", "error") and text != "STOP":
            self.complaints.append(f"{level}: {text}")

    def _raised(self, kind: type[BaseException], error: BaseException, trace: Any) -> None:
        self.complaints.append(f"window: {error!r}")
        traceback.print_exception(kind, error, trace)

    def _warned(self, message: Warning | str, category: type[Warning], *_rest: Any, **_named: Any) -> None:
        self.complaints.append(f"{category.__name__}: {message}")


def held() -> dict[str, Counter[str]]:
    """Return what the process has open and running: files, threads, shared memory, by name."""
    files: Counter[str] = Counter()
    for entry in Path("/proc/self/fd").iterdir():
        with contextlib.suppress(OSError):  # the one that lists them is closed by now
            files[str(entry.readlink()).partition(":[")[0]] += 1
    maps = Path("/proc/self/maps").read_text().splitlines()
    shared = {line.partition("/dev/shm/")[2] for line in maps if "/dev/shm/" in line}
    return {
        "file": files,
        "thread": Counter(thread.name for thread in threading.enumerate()),
        "shared memory": Counter(shared),
    }


def resident_mb() -> float:
    """Return the process's memory that is in use, megabytes."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def at_rest_mb() -> float:
    """Return the memory that is in use once the allocator has handed back what nobody uses, megabytes.

    Where the C library cannot be told to (it is not glibc), all that is resident.
    """
    gc.collect()
    if hand_back := getattr(ctypes.CDLL(None), "malloc_trim", None):
        hand_back(ctypes.c_size_t(0))
    return resident_mb()


def draw(samples: list[dict[str, Any]], done: dict[str, int], minutes: float, path: Path) -> None:
    """Draw memory, rates and latency over time."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    t = [s["s"] / 60 for s in samples]
    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True, constrained_layout=True)
    axes[0].plot(t, [s["memory_mb"] for s in samples], color="#2b6cb0", label="resident")
    axes[0].plot(t, [s["at_rest_mb"] or np.nan for s in samples], "o", color="#1a365d", ms=4, label="at rest")
    settled = min(SETTLING_S / 60, SETTLING * t[-1])
    axes[0].axvspan(0, settled, color="#000000", alpha=0.05, lw=0, label="not judged")
    most_mb = max(s["memory_mb"] for s in samples)
    axes[0].set(ylabel="memory (MB)", ylim=(0, 1.15 * most_mb))
    axes[0].legend(loc="lower left")
    # A camera that begins again after a run is measured from there: low values are new streams.
    axes[1].plot(t, [s["camera_per_s"] for s in samples], ".", label="of the camera", color="#b7791f", ms=4)
    axes[1].plot(t, [s["screen_per_s"] for s in samples], label="on the screen", color="#2f855a", lw=1.2)
    axes[1].set(ylabel="frames a second", ylim=(0, 40))
    axes[1].legend(loc="upper right", ncols=2)
    axes[2].plot(t, [s["latency_ms"] or np.nan for s in samples], ".", color="#9b2c2c", ms=4)
    axes[2].set(ylabel="median latency of the\nreconstruction (ms)", xlabel="minutes", ylim=(0, None))
    what = ", ".join(f"{n} {action}" for action, n in sorted(done.items()))
    figure.suptitle(f"Desktop program for {minutes:g} minutes, SIMULATED bench\n{what}", fontsize=10)
    for axis in axes:
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


if __name__ == "__main__":
    raise SystemExit(main())
