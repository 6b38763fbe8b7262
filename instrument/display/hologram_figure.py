"""The picture of a computed hologram: wanted, seen, and seen without the eye's low-pass."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from instrument.display.hologram_job import HologramResult
from instrument.files.atomic import whole_file
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure

_DETAIL = "middle sixteenth of the field, raw intensity, half as bright"


def write_hologram_figure(
    path: Path, result: HologramResult, *, title: str, facts: list[tuple[str, str]]
) -> None:
    """Draw wanted, seen and unfiltered image, the SLM's phase and the convergence; errors as ``whole_file``.

    The first plane is drawn large; further planes as a strip below.
    """
    score = result.scores[0]
    phase = np.mod(np.angle(result.hologram.slm[0]), 2 * np.pi)
    panels = (
        Panel("Wanted", result.wanted[0], caption="through the eye's low-pass", white=1.0),
        Panel(
            "Seen (computed)",
            np.maximum(result.seen[0], 0),
            caption=f"low-pass: {score.psnr_db:.1f} dB, SSIM {score.ssim:.2f}",
            white=1.0,
        ),
        Panel("Without the low-pass", _detail(result.unfiltered[0]), caption=_DETAIL, white=2.0),
        Panel("SLM phase", phase, caption=f"{phase.shape[1]} x {phase.shape[0]}, 0 to 2 pi", white=2 * np.pi),
    )
    strip = tuple(
        Panel(f"plane {number + 2}", np.maximum(seen, 0), caption=f"{other.psnr_db:.1f} dB", white=1.0)
        for number, (seen, other) in enumerate(zip(result.seen[1:], result.scores[1:], strict=True))
    )
    history = result.hologram.history
    convergence = Convergence(
        [r.seconds for r in history],
        [r.psnr_db for r in history],
        "PSNR of the seen image against time",
        f"{history[-1].psnr_db:.1f} dB",
        "seconds of optimisation",
    )
    summary = Summary(title, panels, convergence, sweep=strip, lines=facts, simulated=True)
    with whole_file(path) as temporary:
        save_figure(summary_figure(summary), temporary)


def _detail(image: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Cut out the middle of the field and sample it to squares, as the field is square."""
    height, width = image.shape
    cut = image[height * 3 // 8 : height * 5 // 8, width * 3 // 8 : width * 5 // 8]
    side = max(cut.shape)
    rows, columns = (np.arange(side) * n // side for n in cut.shape)
    square: npt.NDArray[np.float64] = cut[np.ix_(rows, columns)]
    return square
