"""What the live view costs: CPU share and rate on the screen at 0.3, 1.3 and 5.5 megapixels.

The whole window, offscreen, on a simulated camera that replays frames rendered beforehand (uint16), so that
what is measured is the camera's thread, the ring and the window, not the rendering. Run:

    python benchmarks/gui_live.py
    python benchmarks/gui_live.py --seconds 20 --rate 30 --out live.json
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

from PySide6.QtCore import QSettings

from gui.app import application
from gui.main_window import MainWindow
from gui.panels.live import LivePanel
from gui.session import BenchSession
from gui.theme import apply_theme
from instrument.bench.config_file import parse_config
from instrument.bench.lit import LightState
from tests.gui.event_loop import let_work, wait_until

SIZES = {"0.3 MP": (480, 640), "1.0 MP": (1024, 1024), "1.3 MP": (1024, 1280), "5.5 MP": (2160, 2560)}
BENCH = """
[bench]
name = "live view benchmark"
[camera]
driver = "simulated"
exposure_ms = 5.0
frames_per_s = {rate}
replay_frames = 8
roi = [{top}, {left}, {height}, {width}]
[stage]
driver = "simulated"
[led_array]
driver = "simulated"
[scene]
control = "simulated"
[simulated]
preset = "pco"
scene = "none"
"""


def main() -> None:
    """Measure every size and print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=10.0, help="measured for each size")
    parser.add_argument("--rate", type=float, default=30.0, help="of the camera, frames a second")
    parser.add_argument("--out", type=Path, help="write the figures as JSON")
    arguments = parser.parse_args()
    app = application()
    apply_theme(app, "dark")
    rows = []
    print(
        f"{'':8} {'screen':>8} {'camera':>8} {'dropped':>8} {'CPU':>8} {'window thread':>14} "
        f"{'camera alone':>13} {'CPU ms/frame':>16} {'at 30/s':>8}"
    )
    for name, shape in SIZES.items():
        row = measure(shape, arguments.rate, arguments.seconds)
        rows.append({"size": name, **row})
        print(
            f"{name:8} {row['screen_per_s']:6.1f}/s {row['camera_per_s']:6.1f}/s {row['dropped']:8d} "
            f"{row['cpu_share']:8.1%} {row['window_thread_share']:14.1%} {row['camera_alone_share']:13.1%} "
            f"{row['frame_ms']:16.2f} {row['share_at_30_per_s']:8.1%}"
        )
    print(
        "CPU: of one core, whole process; camera alone: the same with the window hidden; ms/frame: of the\n"
        "whole process beyond the window standing still; at 30/s: what that makes at 30 frames a second."
    )
    if arguments.out:
        facts = {"date": datetime.now(UTC).isoformat(), "machine": platform.processor() or platform.machine()}
        arguments.out.write_text(
            json.dumps({**facts, "cores": os.cpu_count(), "rows": rows}, indent=1) + "\n"
        )


def measure(shape: tuple[int, int], rate: float, seconds: float) -> dict[str, Any]:
    """Return the figures for one size of frame."""
    height, width = shape
    text = BENCH.format(
        rate=rate, height=height, width=width, top=(2160 - height) // 8 * 4, left=(2560 - width) // 8 * 4
    )
    with tempfile.TemporaryDirectory() as folder:
        session = BenchSession(parse_config(text, Path(folder) / "bench.toml"))
        window = MainWindow(session, QSettings(f"{folder}/window.ini", QSettings.Format.IniFormat))
        window.show()
        window.resize(1600, 980)
        session.open()
        panel = window.panel("live")
        assert isinstance(panel, LivePanel)
        wait_until(lambda: panel.picture.frame is not None)
        panel.switch_light(LightState.SOURCE)
        wait_until(lambda: session.bench.source_lit)
        frame = panel.picture.frame
        assert frame is not None
        bright = 2 * frame.image.max()
        wait_until(lambda: panel.picture.frame is not None and panel.picture.frame.image.max() > bright)
        wait_until(lambda: not session.jobs.jobs)  # panels prepared, kernels compiled: once
        let_work(2500)
        shown = _Count(panel)
        before, acquired = _Clock(), session.live.status()
        let_work(int(1e3 * seconds))
        spent = _Clock().since(before)
        after = session.live.status()
        result = {
            "screen_per_s": shown.count / spent.wall_s,
            "camera_per_s": (after.acquired - acquired.acquired) / spent.wall_s,
            "dropped": after.dropped - acquired.dropped,
            "cpu_share": spent.process_s / spent.wall_s,
            "window_thread_share": spent.thread_s / spent.wall_s,
        }
        session.viewing.hold()
        wait_until(lambda: not session.live.is_running)
        idle = _Clock()
        let_work(int(1e3 * seconds / 2))
        standing = _Clock().since(idle)
        session.viewing.start()
        window.hide()
        let_work(1000)
        before = _Clock()
        let_work(int(1e3 * seconds / 2))
        alone = _Clock().since(before)
        result["camera_alone_share"] = alone.process_s / alone.wall_s
        # What a frame costs beyond the window standing still, and what that makes at 30 frames a second:
        # holds also on a busy machine, where fewer are shown.
        still = standing.process_s / standing.wall_s
        extra_s = spent.process_s - still * spent.wall_s
        result["frame_ms"] = 1e3 * extra_s / max(1, shown.count)
        result["share_at_30_per_s"] = still + 30 * result["frame_ms"] / 1e3
        session.close()
        wait_until(lambda: session.is_closed)
        session.join()
        window.deleteLater()
    return result


class _Clock:
    """Wall, process and window-thread seconds."""

    def __init__(self) -> None:
        self.wall_s, self.process_s, self.thread_s = (
            time.perf_counter(),
            time.process_time(),
            time.thread_time(),
        )

    def since(self, before: _Clock) -> _Clock:
        self.wall_s -= before.wall_s
        self.process_s -= before.process_s
        self.thread_s -= before.thread_s
        return self


class _Count:
    """Counts the frames that a live view shows."""

    def __init__(self, panel: LivePanel) -> None:
        self.count = 0
        show = panel.picture.view.show_image

        def counted(*arguments: Any) -> None:
            self.count += 1
            show(*arguments)

        panel.picture.view.show_image = counted  # type: ignore[method-assign]


if __name__ == "__main__":
    main()
