"""What the crash test kills can be interrupted, wherever the test itself was started."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPT = """
import os, signal, sys
from pathlib import Path
from benchmarks import crash_work

crash_work.promising = lambda promises: os.kill(os.getpid(), signal.SIGINT)
crash_work.work(Path(sys.argv[1]), ("--version",), 1, clock_jumps=False)
"""


def test_work_of_a_background_job_answers_ctrl_c(tmp_path: Path) -> None:
    # a shell starts background jobs with SIGINT ignored: `--signal int` interrupted nothing there, unsaid
    ignoring = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, str(tmp_path)],
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            check=False,
        )
    finally:
        signal.signal(signal.SIGINT, ignoring)
    assert done.returncode == 128 + signal.SIGINT, (tmp_path / "said").read_text()
