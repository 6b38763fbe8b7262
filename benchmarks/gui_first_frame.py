"""How soon the window shows a simulated scene: seconds of the processor, and by the clock, since the start.

The terminal's command is counted, too. Each preset starts twice in processes of their own: with nothing kept
of its light on disk, and with what the first start left there. Compiled kernels are there both times. Last,
another slide of beads is put before the camera that runs: seconds of the processor from then on until it is
seen coarsely, and as a frame. A start that shows no frame in time tells where its threads are.

    python benchmarks/gui_first_frame.py
    python benchmarks/gui_first_frame.py --presets pco
"""

from __future__ import annotations

import argparse
import faulthandler
import os
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
PRESETS = ("tiny", "pointgrey", "pco")
LIMIT_S = 120.0
LIT = 1e-3
"""Of full scale, in the mean of all pixels: a frame of the scene."""


@dataclass(frozen=True, slots=True)
class Spent:
    """Seconds of the processor, of the whole process, and by the clock."""

    cpu_s: float
    clock_s: float

    @classmethod
    def now(cls) -> Spent:
        """Return both as they stand."""
        return cls(time.process_time(), time.monotonic())

    @classmethod
    def since(cls, earlier: Spent) -> Spent:
        """Return what was spent since then."""
        now = cls.now()
        return cls(now.cpu_s - earlier.cpu_s, now.clock_s - earlier.clock_s)

    def __str__(self) -> str:
        """Return both, the clock in brackets."""
        return f"{self.cpu_s:.2f} ({self.clock_s:.2f})"


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--presets", nargs="+", default=list(PRESETS))
    parser.add_argument("--one", metavar="PRESET", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.one:
        watch(arguments.one)
        return
    print(
        "| preset | kept | window | coarsely | first frame | scene's frame | another coarsely | its frame |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for preset in arguments.presets:
        with tempfile.TemporaryDirectory() as folder:
            start(preset, folder)  # compiles
            for path in (Path(folder) / "diffuserbench" / "light").glob("*"):
                path.unlink()
            for kept in ("nothing", "its light"):
                print(f"| {preset} | {kept} | {start(preset, folder)} |", flush=True)


def start(preset: str, folder: str) -> str:
    """Start the program in a process of its own; return its figures."""
    environment = os.environ | {
        "QT_QPA_PLATFORM": "offscreen",
        "XDG_CACHE_HOME": folder,
        "XDG_CONFIG_HOME": folder,
        "MPLCONFIGDIR": folder,
        "PYTHONPATH": str(ROOT),
    }
    command = [sys.executable, __file__, "--one", preset]
    done = subprocess.run(
        command,
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        timeout=3 * LIMIT_S,
        check=True,
    )
    return done.stdout.splitlines()[-1]


def watch(preset: str) -> None:
    """Start the program as ``diffuserbench gui`` does and print when what was seen first, " | " between."""
    devices = "".join(f'[{kind}]\ndriver = "simulated"\n' for kind in ("camera", "stage", "led_array"))
    text = f'[bench]\nname = "first frame"\n{devices}[scene]\ncontrol = "simulated"\n'
    Path("bench.toml").write_text(f'{text}[simulated]\npreset = "{preset}"\n')
    threading.Thread(target=look_on, daemon=True).start()
    sys.argv = ["diffuserbench", "gui", "bench.toml"]
    from instrument.cli import console

    console()


def look_on() -> None:
    """Look beside the program what its live view shows; ends the process."""
    seen: dict[str, Spent] = {}
    start = Spent(0.0, time.monotonic() - time.process_time())  # nothing was waited for until now
    maker: Any = None
    deadline = time.monotonic() + LIMIT_S
    while "scene" not in seen and time.monotonic() < deadline:
        time.sleep(0.005)
        if maker is None:
            maker = maker_of(sys._current_frames()[threading.main_thread().ident or 0])
            continue
        seen.setdefault("window", Spent.since(start))
        picture = getattr(maker.panels.get("live"), "picture", None)
        if picture is None:
            continue
        if picture.is_coarse:
            seen.setdefault("coarse", Spent.since(start))
        elif picture.frame is not None:
            seen.setdefault("frame", Spent.since(start))
            above = float(picture.frame.image.mean()) - picture.frame.metadata.black_level
            if above > LIT * picture.frame.full_scale:
                seen.setdefault("scene", Spent.since(start))
    if "scene" in seen:
        seen |= look_at_another(maker)
    else:
        print(
            f"Nothing seen in {LIMIT_S:.0f} s, {time.process_time():.1f} s of the processor", file=sys.stderr
        )
        faulthandler.dump_traceback()
    columns = ("window", "coarse", "frame", "scene", "new coarse", "new frame")
    print(" | ".join(str(seen.get(key, "")) for key in columns))
    sys.stdout.flush()
    os._exit(0)


def look_at_another(maker: Any) -> dict[str, Spent]:
    """Put another slide before the camera; return when it was seen since."""
    picture = maker.panels["live"].picture
    seen: dict[str, Spent] = {}
    rest = time.monotonic() + LIMIT_S
    while maker._session.jobs.jobs and time.monotonic() < rest:  # panels at the side are made
        time.sleep(0.1)
    camera = maker._session.bench.camera
    began, deadline = Spent.now(), time.monotonic() + LIMIT_S
    camera.world.change_slide(1)
    number = camera._next_id  # of the first frame that sees nothing else
    while "new frame" not in seen and time.monotonic() < deadline:
        time.sleep(0.005)
        if picture.is_coarse:
            seen.setdefault("new coarse", Spent.since(began))
        elif picture.frame.metadata.frame_id >= number:
            seen["new frame"] = Spent.since(began)
    return seen


def maker_of(frame: FrameType | None) -> Any:
    """Return what makes the panels of the window whose event loop a thread is in; None before."""
    while frame is not None:
        if frame.f_code.co_name == "_shown":
            window = frame.f_locals.get("window")
            return window.maker if window is not None and window.isVisible() else None
        frame = frame.f_back
    return None


if __name__ == "__main__":
    main()
