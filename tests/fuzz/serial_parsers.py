"""Feed arbitrary bytes to the parsers of the line protocols.

``python tests/fuzz/serial_parsers.py -max_total_time=60 FOLDER``; the folder keeps what reached new code.
Needs atheris (``pip install atheris``), which guides the bytes by the branches that they reach. Whatever
comes in, nothing may raise or hang, and a position is finite and comes from a whole report.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parents[2]))

with atheris.instrument_imports(
    include=[
        "drivers.grbl.protocol",
        "drivers.illuminate.protocol",
        "drivers.zaber.protocol",
        "drivers.common.framing",
    ]
):
    from drivers.common.framing import Belongs, LineFramer
    from drivers.grbl import protocol as grbl
    from drivers.illuminate import protocol as illuminate
    from drivers.zaber import protocol as zaber


def test_one_input(data: bytes) -> None:
    """Cut the bytes into lines, as they would arrive, and parse each every way."""
    framer = LineFramer(longest=512)
    half = len(data) // 2
    lines = framer.feed(data[:half]) + framer.feed(data[half:] + b"\n")
    grbl_judges = (grbl.line_matcher(), grbl.modes_matcher(), grbl.report_matcher)
    version_judge = illuminate.version_matcher()
    for line in lines:
        report = grbl.parse_report(line)
        assert report is None or all(map(math.isfinite, report.places))
        assert (report is not None) == (grbl.report_matcher(line) is Belongs.END)
        for judge in grbl_judges:
            judge(line)
        grbl.parse_error(line)
        grbl.parse_alarm(line)
        grbl.is_banner(line)
        for need_checksum in (False, True):
            zaber.parse(line, need_checksum=need_checksum)
        illuminate.reply_matcher(line)
        version_judge(line)
    grbl.parse_settings(lines)
    grbl.parse_info(lines)
    for columns in (2, 3):
        table = illuminate.parse_table(lines, columns)
        assert table is None or table.shape[1] == columns
    illuminate.parse_version(lines)
    illuminate.parse_properties(lines)
    illuminate.parse_short(lines, "CO")
    illuminate.parse_trigger_outputs(lines)
    illuminate.refusal(lines)


if __name__ == "__main__":
    atheris.Setup(sys.argv, test_one_input)
    atheris.Fuzz()
