"""An operator's day in the desktop program by clicks and keys, step by step, at three sizes of screen.

    python benchmarks/gui_day.py
    python benchmarks/gui_day.py --size 1350x690 --folder /tmp/day --pictures

Starts in an empty folder without a bench, goes on to a simulated one, calibrates, photographs, reconstructs,
looks back, unplugs the camera (``tests/gui/day.py`` has the steps). Prints for every step its time, the
processor time of the window's thread, and the longest turn of that thread's events, with what the step itself
does in it; of a day how long it was from the first start to the first calibrated reconstruction.
``--pictures`` keeps one of the window after every step. Exit status 1 where a step fails. Needs no screen;
with one: QT_QPA_PLATFORM=xcb xvfb-run python ...
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.append(str(Path(__file__).parents[1]))

from gui_stalls import Turns
from PySide6.QtCore import QSize

from gui.app import application, go_first
from gui.theme import apply_theme
from tests.gui.day import STEPS, Operator
from tests.gui.looks import SIZES

FINE = "3840x2160 at scale 2"
RECONSTRUCTED = "the first calibrated reconstruction"


def main() -> int:
    """Go through the day at each size."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", action="append", help="of the window, e.g. 1350x690; repeatable")
    parser.add_argument("--folder", type=Path, help="where the day is spent; default: a temporary one")
    parser.add_argument("--pictures", action="store_true", help="keep one after every step, in the folder")
    given = parser.parse_args()
    sizes = {text: QSize(*map(int, text.split("x"))) for text in given.size or ()} or SIZES
    go_first()
    apply_theme(application(), "dark")
    failed = 0
    spent = given.folder or Path(tempfile.mkdtemp())
    for name, size in sizes.items():
        folder = spent / name
        folder.mkdir(parents=True, exist_ok=True)
        failed += _day(name, size, folder, pictures=given.pictures)
    if sizes is SIZES:  # Qt takes a scale when it starts
        print(FINE, flush=True)
        again = [sys.executable, __file__, "--size", "1904x1000", "--folder", str(spent / "fine")]
        again += ["--pictures"] if given.pictures else []
        failed += subprocess.run(again, env=os.environ | {"QT_SCALE_FACTOR": "2"}, check=False).returncode
    return 1 if failed else 0


def _day(name: str, size: QSize, folder: Path, *, pictures: bool) -> int:
    """Spend a day; returns how many steps failed."""
    print(f"{name}: window {size.width()} x {size.height()}")
    turns, began_s, began_cpu_s = Turns(), time.monotonic(), time.process_time()
    operator = Operator(folder, size)
    failed = 0
    for number, step in enumerate(STEPS, 1):
        start_s, cpu_s = time.monotonic(), time.thread_time()
        try:
            step.do(operator)
            came = "     "
        except Exception:  # noqa: BLE001 - the day goes on
            traceback.print_exc()
            failed, came = failed + 1, "FAILS"
        print(
            f"{number:3} {came} {time.monotonic() - start_s:7.2f} s {time.thread_time() - cpu_s:6.2f} s CPU "
            f"longest {max(turns.fetch(), default=0.0):4.0f} ms  {step.words}",
            flush=True,
        )
        if pictures and operator.window.isVisible():
            operator.window.grab().save(str(folder / f"{number:02}.png"))
            turns.forget()
        if step.words == RECONSTRUCTED and came.isspace():
            clock_s, cpu_s = time.monotonic() - began_s, time.process_time() - began_cpu_s
            print(f"{clock_s:.0f} s ({cpu_s:.0f} of the processor) from the first start to {RECONSTRUCTED}")
    print(f"{len(STEPS)} steps, {failed} failed, {time.monotonic() - began_s:.0f} s in all\n")
    return failed


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # windows of failed steps are not asked
