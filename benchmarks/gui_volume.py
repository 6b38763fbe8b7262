"""What it costs to browse large volumes in the window: how long it does not answer, how fast they turn.

Writes a volume of random voxels as OME-TIFF, opens it in the panel's viewer, looks through it, pulls the
slider of slices, turns it, and asks a timer of the window how late it came. Needs no screen. Run:

    python benchmarks/gui_volume.py
    python benchmarks/gui_volume.py --shape 64x512x512 --format .npy
    python benchmarks/gui_volume.py --shape 128x1024x1024 --format .ome.zarr
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

import numpy as np
from PySide6.QtCore import QTimer, qInstallMessageHandler

from gui.app import application
from gui.jobs import JobRunner
from gui.panel import whole
from gui.theme import apply_theme
from gui.widgets.volume_view import VolumeView
from instrument.reconstruction.stored_result import export_result, open_result
from tests.gui.event_loop import let_work, wait_until

TICK_MS = 5
TURNS = 90


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--shape", default="128x512x512", help="planes x rows x columns")
    parser.add_argument("--format", default=".tif", choices=(".tif", ".ome.zarr", ".npy"))
    given = parser.parse_args()
    shape = tuple(int(part) for part in given.shape.split("x"))
    qInstallMessageHandler(lambda *_: None)
    apply_theme(application(), "dark")
    with tempfile.TemporaryDirectory() as folder:
        path = _write(Path(folder), shape, given.format)
        size_mb = sum(p.stat().st_size for p in ([path] if path.is_file() else path.rglob("*"))) / 1e6
        print(f"{given.shape} {given.format}, {size_mb:.0f} MB; SIMULATED voxels")
        view = whole(VolumeView(JobRunner()))
        view.resize(900, 700)
        view.show()
        late = _Lateness()
        start_s, cpu_s = time.perf_counter(), time.process_time()
        result = open_result(path)
        assert result.volume is not None
        view.open(result.volume)
        late.reset()
        wait_until(lambda: "z" in view.slices)
        print(f"first slice after     {time.perf_counter() - start_s:.2f} s")
        wait_until(lambda: view.projections is not None)
        print(
            f"projections after     {time.perf_counter() - start_s:.2f} s "
            f"({time.process_time() - cpu_s:.2f} s of processor)"
        )
        late.tell("while looking through")
        view.set_mode("slices")
        late.reset()
        for plane in range(0, shape[0], 2):
            view.slider.setValue(plane)
            let_work(10)
        wait_until(lambda: view.slices["z"].index == view.point[0])
        late.tell("while the slider is pulled")
        view.set_mode("turning")
        canvas = view.turning.canvas
        wait_until(lambda: canvas.pixels is not None)
        late.reset()
        _turn(view)
        late.tell("while it turns")
        view.release()


class _Lateness:
    """How late a timer of the window comes."""

    def __init__(self) -> None:
        self._timer = QTimer()
        self._timer.timeout.connect(self._tick)
        self._timer.start(TICK_MS)
        self.reset()

    def reset(self) -> None:
        """Begin again."""
        self._last = time.perf_counter(), time.thread_time()
        self._gaps: list[tuple[float, float]] = [(0.0, 0.0)]

    def tell(self, when: str) -> None:
        """Print the longest gap by the clock, and by the window's own work."""
        wall_ms, own_ms = 1e3 * np.array(self._gaps).T
        print(
            f"window silent {when}: at most {wall_ms.max():.0f} ms by the clock (99 % below "
            f"{np.percentile(wall_ms, 99):.0f}), {own_ms.max():.0f} ms of its own work"
        )

    def _tick(self) -> None:
        now = time.perf_counter(), time.thread_time()
        self._gaps.append((now[0] - self._last[0], now[1] - self._last[1]))
        self._last = now


def _turn(view: VolumeView) -> None:
    """Turn the volume all round, one view after the other, and print how fast they were drawn."""
    canvas = view.turning.canvas
    start_s, cpu_s, shown = time.perf_counter(), time.process_time(), 0
    for _ in range(TURNS):
        before = canvas.pixels
        canvas.turn(360 / TURNS, 0.0)
        wait_until(lambda before=before: canvas.pixels is not before)  # type: ignore[misc]
        shown += 1
    wall_s, cpu_s = time.perf_counter() - start_s, time.process_time() - cpu_s
    print(
        f"turned                {shown / wall_s:.0f} views of {canvas.width()} x {canvas.height()} a second; "
        f"{1e3 * cpu_s / shown:.1f} ms of processor each: {shown / cpu_s:.0f} a second on one free core"
    )


def _write(folder: Path, shape: tuple[int, ...], suffix: str) -> Path:
    rng = np.random.default_rng(0)
    plain = folder / "plain.npy"
    voxels = np.lib.format.open_memmap(plain, mode="w+", dtype=np.float32, shape=shape)
    for plane in voxels:
        plane[...] = rng.random(plane.shape, np.float32) ** 8
    voxels.flush()
    if suffix == ".npy":
        return plain
    path = folder / f"volume{suffix}"
    export_result(open_result(plain), path)
    plain.unlink()
    return path


if __name__ == "__main__":
    main()
