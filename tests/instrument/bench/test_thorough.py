"""The thorough check uses every device, says what it found, moves nothing unasked, and writes a report."""

from __future__ import annotations

from pathlib import Path

import pytest

from instrument.bench import thorough as tests_of
from instrument.bench.bench import Bench
from instrument.bench.config_file import parse_config, template
from instrument.bench.thorough import thorough
from instrument.cli import main

MICROSCOPE = template("led_microscope").replace("pixels = 384", "pixels = 64")


@pytest.fixture(autouse=True)
def _short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tests_of, "_STREAM_S", 0.3)


def test_a_report_is_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bench, report = tmp_path / "bench.toml", tmp_path / "report.txt"
    bench.write_text(MICROSCOPE)
    assert main(["check", "--bench", str(bench), "--thorough", "--out", str(report)]) == 0
    text = report.read_text()
    assert "light of [source]: more light: mean" in text
    assert "one frame for each pattern" in text
    assert "frames a second" in text
    assert 'driver = "simulated_led_microscope"' in text
    assert "microscope camera  SIMULATED" in text
    assert f"Report: {report}" in capsys.readouterr().out
    assert main(["check", "--bench", str(bench), "--thorough", "--out", str(report)]) == 2
    assert main(["check", "--bench", str(bench), "--move"]) == 2


def test_light_that_does_not_reach_the_camera_is_a_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    with Bench(parse_config(MICROSCOPE, None)) as bench:
        bench.open()
        monkeypatch.setattr(bench.led_array, "set_pattern", lambda _: None)
        light = next(found for found in thorough(bench) if found.device == "led_array")
    assert light.failed
    assert "gives no more light" in light.words


@pytest.mark.usefixtures("mock_drivers")
def test_axes_move_only_where_it_is_allowed_and_failures_are_findings() -> None:
    text = '[camera]\ndriver = "mock"\nfail = ["snap"]\n[stage]\ndriver = "mock"\n'
    with Bench(parse_config(text, None)) as bench:
        bench.open()
        still = {finding.device: finding for finding in thorough(bench) if finding.device == "stage"}
        assert "nothing moves without --move" in still["stage"].words
        found = list(thorough(bench, moves=True))
    assert "x_um by" in next(finding.words for finding in found if finding.device == "stage")
    assert found[0].failed
    assert str(found[0]).startswith("FAILED camera: 10 photographs: camera (mock): snap failed.")
