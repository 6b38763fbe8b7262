"""Spots on a simulated display without a mask: found, measured, made even by what the camera sees."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from instrument.bench.config_file import template
from instrument.cli import main

WITHOUT_MASK = {
    "shape": "[96, 128]",
    "slm_binning": "1",
    "expansion": "1",
    "mask_pitch_um": "8.0\nmasked = false",
    "shift_um": "[0.0, 0.0]",
    "z_um": "0.0",
    "roll_mrad": "0.0",
    "pitch_mrad": "0.0",
    "yaw_mrad": "0.0",
    "magnification": "0.0",
    "relay_distortion_um": "0.0",
    "flatness_rad": "0.6",
}


def test_spots_are_found_measured_and_evened_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = template("display")
    for key, value in WITHOUT_MASK.items():
        text = re.sub(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
    Path("bench.toml").write_text(text)
    assert main(["hologram", "--spots", "4x5", "--out", "spots.png"]) == 0
    capsys.readouterr()
    assert main(["show", "spots.png", "--capture", "seen.png", "--refine", "2", "--average", "2"]) == 0
    said = capsys.readouterr().out
    gained = re.search(r"loop: deviation ([\d.]+)% -> ([\d.]+)%", said)
    residual = re.search(r"registered to ([\d.]+) px \(SIMULATED\)", said)
    assert gained is not None
    assert residual is not None
    assert float(residual[1]) < 0.3
    assert float(gained[2]) < 0.5 * float(gained[1])
    assert float(gained[2]) < 2.0
    assert Path("spots-refined.png").exists()
    assert main(["show", "spots.png", "--capture", "b.png", "--target", "seen.png"]) == 2
    assert "leave --target out" in capsys.readouterr().err
