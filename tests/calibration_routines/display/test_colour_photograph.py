"""Pictures in colour: one hologram a colour, photographed one after the other by simulated lasers."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from drivers.led_array import LedPattern
from drivers.simulated.display import DisplayWorld
from instrument.bench.bench import open_bench
from instrument.bench.config_file import parse_config
from instrument.cli import main
from instrument.files.slm_image import SlmCorrection

BENCH = """\
[bench]
name = "colours"
[camera]
driver = "simulated_display"
exposure_ms = 2.0
[stage]
driver = "simulated_display"
[slm]
driver = "simulated_display"
shape = [108, 192]
[led_array]
driver = "simulated_display"
[scene]
control = "simulated"
[display]
slm_binning = 1
expansion = 4
mask_fill = 1.0
focal_mm = 35.0
dc_power = 0.1
dc_phase_rad = 0.6
[simulated_display]
time_scale = 0.0
shift_um = [0.0, 0.0]
z_um = 0.0
roll_mrad = 0.0
pitch_mrad = 0.0
yaw_mrad = 0.0
magnification = 0.0
relay_distortion_um = 0.0
dc_power = 0.1
dc_phase_rad = 0.6
"""
SHOWN = ["show", "slm-red.png", "slm-green.png", "slm-blue.png"]
PHOTOGRAPHED = ["--target", "picture.png", "--capture"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with a bench, a picture of three coloured discs, and its holograms."""
    folder = tmp_path_factory.mktemp("colours")
    (folder / "bench.toml").write_text(BENCH)
    y, x = np.mgrid[:128, :128]
    picture = np.full((128, 128, 3), 40, np.uint8)
    for channel, (row, column) in enumerate([(40, 40), (40, 88), (88, 64)]):
        picture[(y - row) ** 2 + (x - column) ** 2 < 500, channel] = 255
    cv2.imwrite(str(folder / "picture.png"), picture[..., ::-1])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        assert main(["hologram", "picture.png", "--color", "--out", "slm.png", "-n", "20"]) == 0
    return folder


def test_the_colours_photographed_lie_on_one_another(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main([*SHOWN, *PHOTOGRAPHED, "seen.png"]) == 0
    assert "photographed in colour" in capsys.readouterr().out
    facts = json.loads((folder / "seen.json").read_text())
    assert facts["wavelengths_nm"] == [638, 520, 450]
    assert min(facts["psnr_db_of_colours"]) > 22  # 24.7 and more; with the table of 660 nm 17.7
    seen = cv2.imread(str(folder / "seen.png"))[..., ::-1].astype(float)
    n = len(seen)
    for channel, (row, column) in enumerate([(40, 40), (40, 88), (88, 64)]):
        y, x = np.mgrid[:n, :n] * (128 / n)
        disc = (y - row) ** 2 + (x - column) ** 2 < 300
        others = [(y - r) ** 2 + (x - c) ** 2 < 300 for r, c in [(40, 40), (40, 88), (88, 64)]]
        elsewhere = np.logical_or.reduce(others) & ~disc
        assert seen[disc, channel].mean() > 3 * seen[elsewhere, channel].mean()
        # It is where the disc is: the colours' fields differ by 40 %, the pictures do not.
        smooth = gaussian_filter(seen[..., channel], 2)
        bright = (smooth > smooth[disc].mean() / 2) & (np.hypot(y - row, x - column) < 22)
        assert (bright * y).sum() / bright.sum() == pytest.approx(row, abs=1.5)
        assert (bright * x).sum() / bright.sum() == pytest.approx(column, abs=1.5)


def test_one_colour_is_compared_with_its_own_channel(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main(["show", "slm-green.png", *PHOTOGRAPHED, "g.png"]) == 0
    assert float(capsys.readouterr().out.split("photographed: ")[1].split(" dB")[0]) > 14


def test_one_colour_is_held_in_its_own_light(folder, monkeypatch):
    monkeypatch.chdir(folder)
    lit = []
    shine = DisplayWorld.shine
    monkeypatch.setattr(DisplayWorld, "shine", lambda self, lasers: (lit.append(lasers), shine(self, lasers)))
    assert main(["show", "slm-red.png", "--seconds", "0.05"]) == 0
    assert ((638.0, 1.0),) in lit
    assert lit[-1] == ()


def test_what_does_not_go_together_is_refused_in_words(folder, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    assert main([*SHOWN[:3], *PHOTOGRAPHED, "two.png"]) == 2
    assert "these are for 638 nm, 520 nm" in capsys.readouterr().err
    bench = BENCH.replace('[led_array]\ndriver = "simulated_display"\n', "")
    (folder / "single.toml").write_text(bench)
    assert main(["show", "slm-red.png", "--bench", "single.toml", "--seconds", "0"]) == 2
    said = capsys.readouterr().err
    assert "638 nm" in said
    assert "[led_array]" in said
    bench = BENCH.replace("[led_array]\n", "[led_array]\nwavelengths_nm = [660.0, 532.0, 473.0]\n")
    (folder / "other.toml").write_text(bench)
    assert main(["show", "slm-red.png", "--bench", "other.toml", "--seconds", "0"]) == 2
    assert "--wavelengths 660 532 473" in capsys.readouterr().err


def test_a_field_is_as_wide_as_its_light_is_long():
    with open_bench(parse_config(BENCH, "bench.toml")) as bench:
        bench.camera.set_exposure_ms(0.5)
        dark, widths = bench.snap().image.astype(float), []
        for rgb in ((255, 0, 0), (0, 0, 255)):
            bench.led_array.set_pattern(LedPattern("laser", ((0, rgb),)))
            across = gaussian_filter1d((bench.snap().image - dark).mean(axis=0), 4)
            widths.append(np.count_nonzero(across > 0.3 * np.median(across[400:700])))
        bench.led_array.off()
        assert np.abs(bench.snap().image - dark).mean() < across.max() / 20
    assert widths[0] / widths[1] == pytest.approx(638 / 450, rel=0.02)


def test_a_correction_at_another_wavelength_shows_the_phase_asked_for():
    correction = SlmCorrection.ideal().at(660 / 450)
    shown = correction.apply(np.arange(256, dtype=np.uint8)[None])[0]
    phase = shown * (2 * np.pi / 256) * 660 / 450
    error = np.angle(np.exp(1j * (phase - np.arange(256) * (2 * np.pi / 256))))
    assert np.abs(error).max() < 0.02
