"""How fast a camera can be recorded here without losing a frame, beside the disk's own speed.

    python benchmarks/recording.py                   # 1280 x 1024 at 60 frames/s for 60 s, then the limits
    python benchmarks/recording.py --seconds 20 --no-limits
    python benchmarks/recording.py --many 100000     # processor time to open and to describe so many frames

The simulated camera shows frames that were rendered beforehand, so that what is measured is the way from the
driver to the disk: copy into the ring, checksum, file, sync, log. Each case is a process of its own; its peak
memory and processor time are the kernel's figures for it. The limit of a size is the highest rate of a
bisection at which no frame is lost in ``--probe-seconds`` with half a second of frames in memory (more would
only put off the loss).
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.runs.frame_facts import descriptions
from instrument.runs.log import log_line
from instrument.runs.recorder import record
from instrument.runs.run import Run
from instrument.runs.run_files import LOG

SIZES = {"0.3 MP": (480, 640), "1.3 MP": (1024, 1280), "5 MP": (2048, 2560)}
BENCH = """
[bench]
name = "recording benchmark"
[camera]
driver = "simulated"
roi = [0, 0, {height}, {width}]
exposure_ms = 0.5
replay_frames = 8
frames_per_s = {rate}
[scene]
control = "simulated"
[simulated]
preset = "pco"
"""


def case(
    height: int, width: int, rate: float, seconds: float, n_buffers: int | None, folder: Path
) -> dict[str, Any]:
    """Record in this process and return what it cost."""
    with open_bench(parse_config(BENCH.format(height=height, width=width, rate=rate), None)) as bench:
        bench.camera.snap()  # renders what is shown later
        used, began_s = _cpu_s(), time.monotonic()
        base_mb = _rss_mb()
        run = record(bench, folder, seconds=seconds, n_buffers=n_buffers, label="benchmark")
        wall_s = time.monotonic() - began_s
    return {
        "frames": run.n_frames,
        "by_device": sum(gap.by_device for gap in run.gaps),
        "not_written": sum(gap.not_written for gap in run.gaps),
        "rate": 1 / run.frame_period_s if run.frame_period_s else 0.0,
        "mb_per_s": sum(r.n_bytes for r in run.records.values()) / 1e6 / wall_s,
        "cpu": (_cpu_s() - used) / wall_s,
        "before_mb": base_mb,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }


def _cpu_s() -> float:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def _rss_mb() -> float:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize() / 2**20


def measured(
    height: int, width: int, rate: float, seconds: float, parent: Path, n_buffers: int = 0
) -> dict[str, Any]:
    """Record in a new process; its run is removed afterwards."""
    folder = Path(tempfile.mkdtemp(dir=parent))
    arguments = [str(x) for x in (height, width, rate, seconds, n_buffers, folder)]
    answer = subprocess.run(
        [sys.executable, __file__, "--case", *arguments], capture_output=True, text=True, check=False
    )
    shutil.rmtree(folder)
    if answer.returncode != 0:
        raise SystemExit(answer.stderr)
    found: dict[str, Any] = json.loads(answer.stdout.splitlines()[-1])
    return found


def limit(height: int, width: int, seconds: float, parent: Path) -> tuple[float, dict[str, Any] | None]:
    """Return the highest rate without loss, to 10 %, and what it cost."""
    low, high, best = 2.0, 40e9 / (height * width * 2 * 30), None
    while high / low > 1.1:
        rate = (low * high) ** 0.5
        found = measured(height, width, rate, seconds, parent, max(16, round(rate / 2)))
        kept = found["by_device"] + found["not_written"] == 0 and found["rate"] > 0.9 * rate
        print(f"    {rate:7.1f} asked, {found['rate']:7.1f} frames/s, {_lost(found)}", flush=True)
        if kept:
            low, best = rate, found
        else:
            high = rate
    return low, best


def disk_mb_per_s(folder: Path) -> float:
    """Return what ``dd`` writes and syncs, MB/s: 4 GB, as a host's cache may hold one and hide the disk."""
    file = folder / "dd"
    began_s = time.monotonic()
    subprocess.run(
        ["dd", "if=/dev/zero", f"of={file}", "bs=2621440", "count=1600", "conv=fdatasync", "status=none"],
        check=True,
    )
    rate = 1600 * 2.62144 / (time.monotonic() - began_s)
    file.unlink()
    return rate


def _lost(found: dict[str, Any]) -> str:
    return f"lost {found['by_device']} by the camera's ring, {found['not_written']} by the disk"


def many(n_frames: int, parent: Path) -> tuple[float, float]:
    """Return what a log of so many frames takes to be opened, and to be described; processor seconds."""
    folder = Path(tempfile.mkdtemp(dir=parent))
    with open_bench(parse_config(BENCH.format(height=64, width=64, rate=30), None)) as bench:
        run = record(bench, folder, n_frames=2, label="benchmark")
    with (run.path / LOG).open("ab") as log:
        log.writelines(log_line(replace(run.records[1], index=i).to_json()) for i in range(2, n_frames))
    began_s = _cpu_s()
    run = Run.open(run.path)
    opened_s = _cpu_s()
    descriptions(run, n_frames)
    described_s = _cpu_s()
    shutil.rmtree(folder)
    return opened_s - began_s, described_s - opened_s


def main() -> None:
    """Run the benchmark as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60.0, help="of the long recording")
    parser.add_argument("--rate", type=float, default=60.0, help="of the long recording, frames/s")
    parser.add_argument("--probe-seconds", type=float, default=6.0, help="of each step of the bisection")
    parser.add_argument("--no-limits", action="store_true", help="only the long recording")
    parser.add_argument("--folder", type=Path, default=Path(), help="disk to record to")
    parser.add_argument("--many", type=int, help="only: open and describe a recording of so many frames")
    parser.add_argument("--case", nargs=6, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.many:
        opened_s, described_s = many(options.many, options.folder)
        print(f"{options.many} frames: opened in {opened_s:.2f}, described in {described_s:.2f} more CPU s")
        return
    if options.case:
        height, width, rate, seconds, n_buffers, folder = options.case
        size, buffers = (int(height), int(width)), int(n_buffers) or None
        print(json.dumps(case(*size, float(rate), float(seconds), buffers, Path(folder))))
        return
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start")
    print(f"disk (dd, fdatasync): {disk_mb_per_s(options.folder):.0f} MB/s")
    found = measured(1024, 1280, options.rate, options.seconds, options.folder)
    print(
        f"1280 x 1024 uint16, {options.rate:g} frames/s for {options.seconds:g} s: {found['frames']} frames"
    )
    print(f"    {found['rate']:.2f} frames/s, {found['mb_per_s']:.0f} MB/s, {_lost(found)}")
    print(f"    memory {found['before_mb']:.0f} MB before, {found['peak_mb']:.0f} MB at its peak")
    print(f"    processor {100 * found['cpu']:.0f} % of one core, the simulated camera's share included")
    if options.no_limits:
        return
    for name, (height, width) in SIZES.items():
        print(f"{name} ({width} x {height} uint16), bisection:")
        rate, best = limit(height, width, options.probe_seconds, options.folder)
        if best is not None:
            print(f"{name}: {rate:.0f} frames/s hold, {best['mb_per_s']:.0f} MB/s")
    print(f"disk (dd, fdatasync) again: {disk_mb_per_s(options.folder):.0f} MB/s")
    print(f"load {os.getloadavg()[0]:.1f} at the end")


if __name__ == "__main__":
    main()
