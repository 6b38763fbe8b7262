"""A sample of the table of faults at every call: each is safe, honest and said in words."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_a_fault_at_some_calls_is_safe_marked_and_said(tmp_path: Path) -> None:
    faults = (f"--fault={fault}" for fault in ("exception", "nan", "garbage", "unplugged"))
    command = [
        sys.executable,
        str(ROOT / "benchmarks" / "fault_table.py"),
        "snap",
        "record",
        "--every=6",
        *faults,
    ]
    table = subprocess.run(
        command,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)},
    )
    assert table.returncode == 0, table.stdout + table.stderr
    rows = [line for line in table.stdout.splitlines() if " light " in line]
    assert len(rows) > 7
    assert all("(simulated): " in row for row in rows if " ok " in row)
