"""Spots without a mask, made even by what the camera sees; pictures by mirrors."""

from __future__ import annotations

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from calibration_routines.display import hologram_photograph, spot_photograph
from calibration_routines.display.hologram_photograph import Capture
from instrument.bench.config_file import template
from instrument.cli import main
from instrument.cli.app import Terminated
from instrument.files.images import write_image
from instrument.files.slm_image import phase_levels, read_slm_image
from recon.holography import Scores, Target

WITHOUT_MASK = {
    "shape": "[96, 128]",
    "slm_binning": "1",
    "expansion": "1",
    "mask_pitch_um": "8.0",
    "masked": "false",
    "magnification": "0.0",
    "relay_distortion_um": "0.0",
    "flatness_rad": "0.6",
}
IN_PLACE = {"shift_um": "[0.0, 0.0]"} | dict.fromkeys(("z_um", "roll_mrad", "pitch_mrad", "yaw_mrad"), "0.0")
"""Of a mask, where there is one."""


def write_bench(**changes: str) -> None:
    """Write the bench of a display without a mask."""
    text = template("display")
    text = text.replace("mask_pitch_um", "masked = true\nmask_pitch_um")
    for key, value in (WITHOUT_MASK | changes).items():
        text = re.sub(rf"(?m)^{key} = [^#\n]*", f"{key} = {value} ", text)
    Path("bench.toml").write_text(text)


def test_a_picture_by_mirrors_is_photographed_as_it_was_computed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    masked = {"expansion": "4", "mask_pitch_um": "4.0", "masked": "true", "flatness_rad": "0.0"} | IN_PLACE
    write_bench(**masked)
    write_image("picture.png", np.add.outer(np.arange(80), np.arange(90)).astype(np.uint8))
    shown = ["--capture", "seen.png", "--target", "picture.png"]
    assert main(["hologram", "picture.png", "--iterations", "2", "--out", "phases.png"]) == 0
    assert main(["hologram", "picture.png", "--mirrors", "optimised", "--iterations", "25"]) == 0
    assert main(["show", "slm.png", *shown]) == 2
    assert "sets phases" in capsys.readouterr().err
    write_bench(**masked | {"masked": "true\nmirrors = true"})
    assert main(["hologram", "picture.png", "--out", "p.png"]) == 2
    assert "--mirrors optimised" in capsys.readouterr().err
    assert main(["hologram", "--spots", "3x3", "--out", "p.png"]) == 2
    assert "give a picture of them instead, with --mirrors optimised" in capsys.readouterr().err
    assert main(["show", "phases.png", *shown]) == 2
    assert "this pattern is of phases" in capsys.readouterr().err
    for command, words in (
        (["calibrate", "display"], "only phases can be learned"),
        (["calibrate", "slm"], "they have no phase that their levels could be measured by"),
        (["align", "mask"], "a mask is aligned by the spots of a phase SLM in their place"),
    ):
        assert main([*command, "--dry-run"]) == 2
        assert f"has mirrors that send light or not: {words}." in capsys.readouterr().err
    assert set(np.unique(read_slm_image("slm.png")[0])) == {0, 255}
    computed = json.loads(Path("slm.json").read_text())
    assert 0.03 < computed["efficiency"] < 0.1
    assert main(["show", "slm.png", *shown, "--refine", "1", "--average", "2"]) == 0
    found = re.search(r"loop: ([\d.]+) dB -> ([\d.]+) dB", capsys.readouterr().out)
    assert found is not None
    assert float(found[1]) == pytest.approx(computed["metrics"][0]["psnr_db"], abs=1.5)
    assert float(found[2]) >= float(found[1]) > 20
    assert set(np.unique(read_slm_image("slm-refined.png")[0])) == {0, 255}


def test_spots_are_found_measured_and_evened_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_bench()
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


@pytest.mark.parametrize(
    ("interruption", "status", "words"),
    [(KeyboardInterrupt(), 130, "interrupted."), (Terminated(143), 143, "stopped by a signal.")],
    ids=["Ctrl-C", "signal"],
)
@pytest.mark.parametrize("spots", [True, False], ids=["spots", "picture"])
def test_what_ends_the_camera_in_the_loop_keeps_what_was_best(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    spots: bool,
    interruption: BaseException,
    status: int,
    words: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write_bench()
    seen: list[np.ndarray] = []

    def photographed(slm: np.ndarray) -> float:
        if len(seen) == 2:
            raise interruption
        seen.append(np.array(slm))
        return 20.0 + len(seen)  # dB; the second is better

    def measure(_spots: object, slm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        off = 1 / photographed(slm)
        return np.ones((16, 20)), np.array([1 + off, 1 - off] * 3)

    def capture(_camera: object, slm: list[np.ndarray], target: Target, **_: int) -> Capture:
        wanted = np.ones(target.image.shape)
        return Capture(wanted, wanted, Scores(photographed(np.array(slm)), 0.0, 0.0, 0.0), 0.0)

    def camera(*_: object) -> tuple[object, float]:
        return SimpleNamespace(residual_px=0.1), 1.0

    monkeypatch.setattr(spot_photograph, "registered_camera", camera)
    monkeypatch.setattr(hologram_photograph, "registered_camera", camera)
    monkeypatch.setattr(spot_photograph._Spots, "measure", measure)
    monkeypatch.setattr(hologram_photograph.HologramCamera, "capture", capture)
    write_image("picture.png", np.add.outer(np.arange(80), np.arange(90)).astype(np.uint8))
    made = ["--spots", "2x3"] if spots else ["picture.png", "--iterations", "1"]
    assert main(["hologram", *made]) == 0
    shown = ["show", "slm.png", "--capture", "seen.png", *([] if spots else ["--target", "picture.png"])]
    assert main([*shown, "--refine", "9"]) == status
    said = capsys.readouterr().err
    assert words in said
    assert "This is the best pattern so far." in said
    assert "Written: slm-refined.png, seen.png." in said
    levels = read_slm_image("slm-refined.png")[0]
    np.testing.assert_array_equal(levels, phase_levels(np.angle(seen[1][0])))
    Path("seen.png").unlink()
    assert main([*shown, "--force"]) == status
    assert "Nothing was written." in capsys.readouterr().err
    assert not Path("seen.png").exists()
