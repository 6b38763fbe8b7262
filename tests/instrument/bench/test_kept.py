"""What is kept with a bench comes back; a damaged file is never written over."""

from __future__ import annotations

from pathlib import Path

import pytest

from instrument.bench.kept import KeptWithBench
from instrument.files.errors import FileError


def test_values_come_back_by_kind_and_name_and_a_damaged_file_is_left(tmp_path: Path) -> None:
    kept = KeptWithBench(tmp_path / "runs")
    kept.read()
    kept.put("places", "corner", {"x_um": 12.5})
    kept.put("places", "gone", {"x_um": 1.0})
    kept.write()
    kept.put("places", "gone", None)
    kept.write()  # into a folder that is there by now
    again = KeptWithBench(tmp_path / "runs")
    again.read()
    assert again.of("places") == {"corner": {"x_um": 12.5}}
    assert again.of("camera") == {}
    for damage in ("{", "[1]", '{"places": 3}'):
        kept.path.write_text(damage)
        damaged = KeptWithBench(tmp_path / "runs")
        with pytest.raises(FileError, match="Move it away"):
            damaged.read()
        damaged.put("places", "new", {})
        with pytest.raises(FileError):
            damaged.write()
        assert kept.path.read_text() == damage
