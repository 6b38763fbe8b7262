"""How soon the window's thread takes a click while other threads of Python work, by how often they hand over.

    python benchmarks/gui_handover.py

Three threads compile Python, as imports do; clicks come from a fourth, every 30 ms. Both intervals in turns,
in one process. By the clock, on however busy a machine: only their ratio says something. Needs no screen.
"""

from __future__ import annotations

import os
import sys
import threading
import time

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

import numpy as np
from PySide6.QtCore import QCoreApplication, QObject, Qt, Signal

from gui.app import HANDOVER_S

USUAL_S = 0.005
"""Python's own."""
ROUNDS, ROUND_S, CLICK_S, THREADS = 8, 2.0, 0.03, 3


class _Button(QObject):
    clicked = Signal(float)


def main() -> int:
    """Measure both, and print them."""
    app, button, heard_ms, lines = QCoreApplication([]), _Button(), list[float](), [0]

    def heard(clicked_s: float) -> None:
        for _ in range(200):  # a slot is many steps of Python, each of which needs the interpreter
            sum(range(50))
        heard_ms.append(1e3 * (time.monotonic() - clicked_s))

    def work() -> None:
        while True:
            compile("\n".join(f"x{i} = [{i}, 'a', (1, 2)]" for i in range(100)), "busy", "exec")
            lines[0] += 1

    def click() -> None:
        while True:
            time.sleep(CLICK_S)
            button.clicked.emit(time.monotonic())

    button.clicked.connect(heard, Qt.ConnectionType.QueuedConnection)
    for target in (*[work] * THREADS, click):
        threading.Thread(target=target, daemon=True).start()
    times: dict[float, list[float]] = {USUAL_S: [], HANDOVER_S: []}
    done = dict.fromkeys(times, 0.0)
    for _ in range(ROUNDS):
        for interval_s, ms in times.items():
            sys.setswitchinterval(interval_s)
            heard_ms.clear()
            before, cpu_s, end_s = lines[0], time.process_time(), time.monotonic() + ROUND_S
            while time.monotonic() < end_s:
                app.processEvents()
                time.sleep(0.001)
            ms += heard_ms
            done[interval_s] += (lines[0] - before) / (time.process_time() - cpu_s) / ROUNDS
    for interval_s, ms in times.items():
        median, most_of, most = np.percentile(ms, (50, 95, 100))
        spread = f"{median:.0f}, {most_of:.0f}, {most:.0f} ms (median, 95 %, most of {len(ms)})"
        others = f"the others' work a second of the processor {done[interval_s]:.0f}"
        print(f"handed over every {1e3 * interval_s:g} ms: heard after {spread}; {others}")
    return 0


if __name__ == "__main__":
    status = main()
    sys.stdout.flush()
    os._exit(status)  # its threads go on for ever
