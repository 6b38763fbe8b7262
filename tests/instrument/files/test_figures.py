"""Figures are drawn without a screen and show what they were given."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure


def make(*, sweep: bool = True, simulated: bool = True) -> Summary:
    picture = np.random.default_rng(0).random((40, 50))
    return Summary(
        title="A test",
        panels=[
            Panel("PSF", picture, "100 mm", pixel_mm=0.013, gamma=0.5),
            Panel("Raw frame", np.stack([picture] * 3, -1)),
            Panel("Reconstruction", picture, pixel_mm=30.0),
            Panel("Truth", np.zeros((40, 50))),
        ],
        convergence=Convergence([0.5, 1.0, 2.0], [10.0, 20.0, 22.0], "PSNR (dB)", "22 dB"),
        sweep=[Panel(f"z = {z} mm", picture) for z in (100, 200, 300)] if sweep else (),
        lines=[("PSNR", "22 dB"), ("SSIM", "0.8")],
        simulated=simulated,
    )


def texts(summary: Summary) -> list[str]:
    figure = summary_figure(summary)
    return [text.get_text() for text in figure.findobj() if hasattr(text, "get_text")]


def test_the_file_is_a_picture_with_content(tmp_path: Path) -> None:
    image = cv2.imread(str(save_figure(summary_figure(make()), tmp_path / "summary.png")))
    assert image is not None
    assert image.shape[1] == 1400
    assert image.std() > 20


def test_simulated_is_written_on_it_only_when_it_is() -> None:
    assert "SIMULATED" in texts(make())
    assert "SIMULATED" not in texts(make(simulated=False))


@pytest.mark.parametrize("sweep", [True, False])
def test_every_title_fact_and_scale_bar_is_there(sweep: bool) -> None:
    shown = texts(make(sweep=sweep))
    for expected in (
        "A test",
        "PSF",
        "Raw frame",
        "Reconstruction",
        "Truth",
        "SSIM",
        "0.8",
        "22 dB",
        "0.1 mm",
    ):
        assert expected in shown
    assert ("z = 300 mm" in shown) is sweep
