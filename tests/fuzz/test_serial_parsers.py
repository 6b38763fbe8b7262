"""A short run of the coverage-guided fuzzer; skipped where atheris is not installed."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

SEEDS = {
    "grbl-report": b"<Idle|MPos:-1.000,2.500,0.000|FS:0,0|WCO:0.000,0.000,0.000|Pn:XZ>\r\nok\r\n",
    "grbl-settings": b"$100=250.000\r\n$110=1200.000\r\n[VER:1.1h:]\r\n[GC:G0 G54]\r\nok\r\nALARM:9\r\n",
    "illuminate-table": b'{ "led_position_list_na" = {\n"0" : [0.000, 0.01],\n"1" : [0.1, 0.2]\n}\n}-==-\n',
    "illuminate-short": b"2.32\nCO.1.2.3\n-==-\nERROR[16]: Invalid command.\n",
    "illuminate-triggers": b'{"channel": 0, "pin": 20, "pulse_width_us": 100, "start_delay_us": 5}\n-==-\n',
}


def test_a_short_fuzz_finds_nothing(tmp_path: Path) -> None:
    pytest.importorskip("atheris", reason="pip install atheris")
    for name, seed in SEEDS.items():
        (tmp_path / name).write_bytes(seed)
    target = Path(__file__).parent / "serial_parsers.py"
    run = subprocess.run(
        [sys.executable, target, "-runs=20000", "-seed=1", "-max_len=400", str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=150,
        check=False,
    )
    assert run.returncode == 0, run.stderr[-3000:]
    assert "Done 20000 runs" in run.stderr
