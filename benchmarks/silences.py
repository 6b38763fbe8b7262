"""How long commands say nothing, and how long they work without saying for how long.

    python benchmarks/silences.py [--only snap ...] [--out FILE.json]

Types commands in a terminal of its own, in a folder of its own, on the built-in simulated bench; each
twice: what tells of no progress is told by what it took last time. Printed are the seconds by the clock
and (of the processor), the longest stretch in which nothing was written, and the longest without a word
of how long or how much of how much, with the last words before. Where others work on the machine the
processor's seconds stand for a quiet one; what waits (motion, exposure) shows by the clock.
"""

from __future__ import annotations

import argparse
import json
import os
import pty
import re
import select
import signal
import struct
import sys
import tempfile
import termios
import time
from dataclasses import dataclass, field
from fcntl import ioctl
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

TIME = re.compile(
    r"left (about )?\d|about [\d.]+ ?\w+ (left|in all)|in all|"
    r"longer than (last time|a first guess)|\d+ of \d+|at most|About ten seconds"
)
"""Words that tell a time, or how much of how much is done."""
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")
STEPS = {
    "new": "new --camera sample.toml",
    "check": "check",
    "devices": "devices",
    "drivers": "drivers",
    "snap": "snap --out photo.tif --figure photo.png",
    "snap source": "snap --source --out psf.tif",
    "snap dark": "snap --dark --out dark.tif",
    "snap mean": "snap --average 4 --exposure-ms 5 --out mean.tif",
    "record": "record --seconds 3 --exposure-ms 20 --out records",
    "axial": "calibrate axial --z-min 100 --z-max 300 --planes 3 --out sweep",
    "list": "list sweep",
    "show": "show SWEEP",
    "verify": "verify SWEEP",
    "export": "export SWEEP frames.npy",
    "analyze": "analyze SWEEP --out page.png",
    "compare": "compare SWEEP SWEEP",
    "refocus": "refocus SWEEP --z-mm 150 --out near --figure near.png",
    "reconstruct": "reconstruct --psf psf.tif --image photo.tif --bin 8 --out scene.tif --figure page2.png",
    "calibrated": "reconstruct --calibration SWEEP --z-mm 200 --image photo.tif --bin 8 --out two.tif",
    "etendue": "etendue",
    "hologram": "hologram photo.png --out slm.png --iterations 20",
    "optics": "optics --out optics.png",
    "stability": "stability light --out maps",
    "chart": "chart scene sparse-picture --size 32 --budget 20 --out chart",
    "test": "test",
    "table7.1": "table7.1 --iterations 10 --pictures head --expansion 4 --out table71",
    "plan new": "plan new plan.toml",
    "plan show": "plan show plan.toml",
    "run": "run plan.toml --out planned",
    "resume": "resume SWEEP",
    "explain": "reconstruct --psf psf.tif --image photo.tif --bin 8 --explain",
    "volume": "reconstruct --volume SWEEP --image photo.tif --bin 16 --out volume.tif",
    "lateral": "calibrate lateral --z 200 --half-field-x 10 --half-field-y 10 --spacing 10 --out grids",
    "volume sweep": "calibrate volume --z-min 150 --z-max 300 --dry-run",
    "stage": "calibrate stage --out stages",
    "photograph": "calibrate photograph --out photographs",
    "angular": "calibrate angular --average 1 --out angles",
    "beads": "calibrate beads --binning 4 --out slide",
    "screen bench": "new screen.toml --screen --no-look",
    "screen": "calibrate screen --bench screen.toml --pictures 4 --average 2 --binning 4 --out screens",
    "microscope bench": "new microscope.toml --microscope --no-look",
    "dpc": "calibrate dpc --bench microscope.toml --na 0.1 --magnification 4 --out surfaces",
    "display bench": "new display.toml --display --no-look",
    "align mask": "align mask --bench display.toml --out alignment.json",
    "slm": "calibrate slm --bench display.toml --levels 9 --out slm.json",
    "display": "calibrate display --bench display.toml --alignment alignment.json --out display.json",
    "demo camera": "demo camera --out shown",
    "demo film": "demo film --out filmed",
    "demo display": "demo display --out displayed",
    "activity": "activity RECORD --psf psf.tif --bin 16 --out active",
}
"""Of the others completion ends at once, gui and serve when they are told to; further charts and plans are as
those here."""


@dataclass
class Heard:
    """What a command wrote, and when."""

    began_s: float
    said: list[tuple[float, float, str]] = field(default_factory=list)
    """Seconds by the clock and of the processor since it began, and words."""
    status: int = 0

    def stretch(self, telling: re.Pattern[str] | None) -> tuple[float, float, str]:
        """Return the longest stretch without words, or without such: clock, processor, the words before."""
        longest, since, words = (0.0, 0.0, ""), (0.0, 0.0), ""
        for at_s, cpu_s, text in self.said:
            if text and telling is not None and telling.search(text) is None:
                words = text
                continue
            stretch = at_s - since[0], cpu_s - since[1], words
            longest = max(longest, stretch)
            since, words = (at_s, cpu_s), text
        return longest


def processor_s(process: int) -> float:
    """Return what a process, and its children that have ended, took of the processor."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except (OSError, IndexError):
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")


BY_PROCESSOR = (
    "from types import SimpleNamespace as N; from instrument.files import kept_times as k; "
    "k.time = N(monotonic=k.time.process_time, process_time=k.time.process_time); "
)
"""Code by which a program keeps what its steps took of the processor: what a first guess goes by."""


def typed(words: list[str], folder: Path, most_s: float, before: str = "") -> Heard:
    """Type a command in a terminal and listen to it; after so long press Ctrl-C."""
    heard = Heard(time.monotonic())
    process, terminal = pty.fork()
    if process == 0:
        os.chdir(folder)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # ignored in the background
        os.environ.update(PYTHONPATH=str(ROOT), TERM="xterm-256color", XDG_CACHE_HOME=str(folder / "cache"))
        code = f"import sys; {before}from instrument.cli import main; sys.exit(main({words!r}))"
        os.execv(sys.executable, [sys.executable, "-c", code])
    ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 80, 200, 0, 0))
    cpu_s, pressed = 0.0, False
    while True:
        if not pressed and time.monotonic() - heard.began_s > most_s:
            pressed = bool(os.write(terminal, b"\x03"))
        ready, _, _ = select.select([terminal], [], [], 0.2)
        cpu_s = max(cpu_s, processor_s(process))
        if not ready:
            continue
        try:
            text = os.read(terminal, 65536).decode(errors="replace")
        except OSError:
            break
        shown = " ".join(CONTROL.sub(" ", text).split())
        if shown:
            heard.said.append((time.monotonic() - heard.began_s, cpu_s, shown))
    _, status, used = os.wait4(process, 0)
    heard.said.append((time.monotonic() - heard.began_s, used.ru_utime + used.ru_stime, ""))
    heard.status = os.waitstatus_to_exitcode(status)
    os.close(terminal)
    return heard


def main() -> None:
    """Type the commands and print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="*", choices=STEPS, help="these")
    parser.add_argument("--once", action="store_true", help="not a second time")
    parser.add_argument("--most", type=float, default=300.0, help="seconds by the clock, then Ctrl-C")
    parser.add_argument("--folder", type=Path, help="kept")
    parser.add_argument("--steps", action="store_true", help="once, and what each step took, in transforms")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = (options.folder or Path(scratch)).resolve()
        folder.mkdir(parents=True, exist_ok=True)
        print(
            "| command | status | took, s (CPU) | silent | after | no time told | after |\n"
            + "|---" * 7
            + "|"
        )
        for name in options.only or STEPS:
            runs = sorted(folder.glob("sweep/*"))
            words = STEPS[name].replace("SWEEP", str(runs[-1]) if runs else "none").split()
            records = sorted(folder.glob("records/*"))
            words = [str(records[-1]) if word == "RECORD" and records else word for word in words]
            for again in range(1 if options.once or options.steps else 2):
                forced = [*words, "--force"] if again and needs_force(words) else words
                heard = typed(forced, folder, options.most, BY_PROCESSOR if options.steps else "")
                silent, untold = heard.stretch(None), heard.stretch(TIME)
                took = heard.said[-1]
                rows.append({"name": name, "again": again, "said": heard.said, "status": heard.status})
                print(
                    f"| {name}{' again' if again else ''} | {heard.status} | {took[0]:.1f} ({took[1]:.1f}) "
                    f"| {silent[0]:.1f} ({silent[1]:.1f}) | {silent[2][-50:]} "
                    f"| {untold[0]:.1f} ({untold[1]:.1f}) | {untold[2][-60:]} |",
                    flush=True,
                )
        if options.steps:
            print_steps(folder / "cache")
    if options.out:
        options.out.write_text(json.dumps(rows, indent=1) + "\n")


def print_steps(cache: Path) -> None:
    """Print what was kept of steps: seconds of the processor, and how many transforms that is."""
    from instrument.files.kept_times import transform_s

    one_s = transform_s()
    for times in cache.rglob("times.json"):
        for step, took_s in json.loads(times.read_text()).items():
            if isinstance(took_s, float):
                print(f"{took_s:8.2f} s {took_s / one_s:8.0f} transforms   {step}")


def needs_force(words: list[str]) -> bool:
    """Whether a command, typed again, has to be told to write over its files."""
    return words[0] == "new" or ("--out" in words and words[0] not in ("record", "calibrate"))


if __name__ == "__main__":
    main()
