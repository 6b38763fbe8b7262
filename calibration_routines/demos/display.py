"""The display's job, start to end, on the simulated bench: align, learn, show, photograph, compare."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from calibration_routines.display.colour_photograph import (
    ColourCapture,
    ColourPattern,
    photograph_colours,
)
from calibration_routines.display.display_io import DisplayBench, require_slm
from calibration_routines.display.display_learning import (
    ASIDE,
    learned_alignment,
    learning_lines,
)
from calibration_routines.display.hologram_photograph import (
    Capture,
    HologramCamera,
    display_of_pattern,
    target_of_pattern,
)
from calibration_routines.display.mask_alignment import AlignmentReport, MaskAlignment, alignment_of
from calibration_routines.display.mask_search import AlignmentSettings
from calibration_routines.display.pattern_series import photograph_series
from calibration_routines.procedure import Listener
from instrument.bench.bench import Bench, open_bench
from instrument.bench.config_file import parse_config
from instrument.display.alignment import Alignment, save_alignment
from instrument.display.bench_display import bench_display
from instrument.display.hologram import colour_shares, prepare_target, square
from instrument.display.hologram_files import CHANNELS
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.sample_images import load_sample, portrait_in_colour
from instrument.runs.writer import free_name
from recon.base.declare import option
from recon.holography import Display, HologramModel, HologramOptions, compute_hologram
from recon.holography.learn import Lesson, learn_display

if TYPE_CHECKING:
    from matplotlib.figure import Figure

BENCH = """\
[bench]
name = "demo display"
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
wavelength_nm = 660.0
focal_mm = 35.0
dc_power = 0.1
dc_phase_rad = 0.6
[simulated_display]
time_scale = 0.0
shift_um = [24.0, -16.0]
z_um = 50.0
dc_power = 0.1
dc_phase_rad = 0.6
crosstalk_px = 0.12
amplitude_swing = 0.1
beam_mm = 1.0
beam_centre_um = [80.0, -40.0]
wavefront_rad = 0.5
vignetting = 0.2
mask_depth = 0.95
mask_roughness_rad = 0.05
"""
"""The bench that is simulated, its errors in the open; the programs do not look there."""
LASERS_NM = (638.0, 520.0, 450.0)
"""Of its ``[led_array]``."""


@dataclass(frozen=True, kw_only=True)
class DisplayDemoSettings:
    """The demo's settings."""

    picture: str = option("portrait", help="A sample picture to show.", flags=("",))
    patterns: int = option(11, least=ASIDE + 2, help="Random patterns to learn from.")
    iterations: int = option(60, least=1, help="Of each hologram.", flags=("--iterations", "-n"))


@dataclass(frozen=True, slots=True)
class DisplayDemo:
    """What came out."""

    folder: Path
    aligned: Capture
    """The picture, photographed, by the alignment alone."""
    learned: Capture
    """The same by what was learned of the display."""
    colour: ColourCapture
    """In three colours, one after the other, by what was learned in the light of the bench's own laser."""
    seconds: dict[str, float]
    lesson: Lesson
    frames: int

    @property
    def files(self) -> dict[str, Path]:
        """What was written, by what it is."""
        names = {
            "the bench": "display.toml",
            "alignment": "alignment.json",
            "display, learned": "display.json",
            "pictures side by side": "display-demo.png",
        }
        return {words: self.folder / name for words, name in names.items()}

    def lines(self) -> list[str]:
        """Return what was learned, and how good the photographed pictures are, in lines."""
        aligned, learned = self.aligned.scores, self.learned.scores
        return [
            *learning_lines(self.lesson, self.frames, simulated=True),
            f"Photographed: {aligned.psnr_db:.2f} dB, SSIM {aligned.ssim:.3f} by the alignment alone; "
            f"{learned.psnr_db:.2f} dB, SSIM {learned.ssim:.3f} by what was learned",
            f"In three colours, in turn: {self.colour.psnr_db:.2f} dB, SSIM {self.colour.ssim:.3f}",
        ]


def run_display_demo(
    out: Path, listener: Listener, settings: DisplayDemoSettings | None = None
) -> DisplayDemo:
    """Align the mask, learn the display, show a picture by both, photograph it, and write all of it.

    Raises BenchError or FileError as the parts do.
    """
    settings = settings or DisplayDemoSettings()
    out.mkdir(parents=True, exist_ok=True)
    folder = free_name(out, f"{datetime.now(UTC):%Y%m%d-%H%M%S}-display-demo", "")
    folder.mkdir()
    (folder / "display.toml").write_text(BENCH, encoding="utf-8")
    seconds: dict[str, float] = {}
    with open_bench(parse_config(BENCH, folder / "display.toml")) as bench:
        nominal = bench_display(bench.config, (require_slm(bench).shape, require_slm(bench).pixel_pitch_um))
        io = DisplayBench(bench, 1)
        began = time.perf_counter()
        listener.step("aligning the demo's mask")
        report = _aligned(io, nominal, bench, listener)
        seconds["align"] = time.perf_counter() - began
        alignment = alignment_of(report, bench, nominal.mask.shape)
        listener.step("photographing random patterns")
        seen = HologramCamera.registered(io, alignment.of(nominal))
        series = photograph_series(seen, settings.patterns)
        listener.step("learning the display")
        lesson = learn_display(
            seen.display, series.looks, aside=ASIDE, on_progress=lambda share, _: listener.share(share, 1.0)
        )
        seconds["learn"] = time.perf_counter() - began - seconds["align"]
        learned = learned_alignment(alignment, nominal, lesson, corrected=False)
        save_alignment(folder / "alignment.json", alignment, {})
        save_alignment(folder / "display.json", learned, {})
        captures = []
        for words, display in (("aligned", seen.display), ("learned", learned.of(nominal))):
            listener.step(f"computing and photographing the picture, {words}")
            captures.append(_shown(replace(seen, display=display), nominal, settings))
        seconds["show"] = time.perf_counter() - began - sum(seconds.values())
        listener.step("computing and photographing it in three colours")
        colour = _in_colour(bench, learned, settings)
        seconds["colour"] = time.perf_counter() - began - sum(seconds.values())
        frames = io.frames
    aligned, taught = captures
    save_figure(_figure(aligned, taught, colour, lesson), folder / "display-demo.png")
    return DisplayDemo(folder, aligned, taught, colour, seconds, lesson, frames)


def _aligned(io: DisplayBench, nominal: Display, bench: Bench, listener: Listener) -> AlignmentReport:
    if bench.stage is not None:
        bench.stage.home()
    return MaskAlignment(io, nominal, AlignmentSettings(reach=12.0, depth_um=200.0, moves=2), listener).run()


def _shown(seen: HologramCamera, nominal: Display, settings: DisplayDemoSettings) -> Capture:
    """Compute the picture for a display, show it and photograph it; judged alike for every display."""
    pixels = np.rint(255 * load_sample(settings.picture, (256, 256))).astype(np.uint8)
    options = HologramOptions(iterations=settings.iterations)
    model = HologramModel(seen.display, [prepare_target(pixels, seen.display, options)], options)
    return seen.capture(
        list(compute_hologram(model).slm), prepare_target(pixels, nominal, options), average=2
    )


def _in_colour(bench: Bench, place: Alignment, settings: DisplayDemoSettings) -> ColourCapture:
    """Compute a hologram a colour, show one after the other and photograph them."""
    picture = portrait_in_colour(256)
    options = HologramOptions(iterations=settings.iterations, srgb=True)
    size = require_slm(bench).shape, require_slm(bench).pixel_pitch_um
    lights, patterns = [], []
    plain = [display_of_pattern(bench.config, size, {"wavelength_nm": nm}) for nm in LASERS_NM]
    for name, nm, share in zip(CHANNELS, LASERS_NM, colour_shares(plain), strict=True):
        facts = {"wavelength_nm": nm, "colour": name, "field_share": share, "options": {"srgb": True}}
        display = display_of_pattern(bench.config, size, facts, place)
        model = HologramModel(display, [target_of_pattern(picture, display, facts)], options)
        patterns.append(ColourPattern(list(compute_hologram(model).slm), facts))
        lights.append(DisplayBench(bench, 1, wavelength_nm=nm))
    return photograph_colours(lights, patterns, picture, place, average=2)


def _figure(aligned: Capture, learned: Capture, colour: ColourCapture, lesson: Lesson) -> Figure:
    panels = [Panel("Wanted", square(aligned.wanted), caption="through the eye's low-pass", white=1.0)]
    for title, capture in (("Photographed: aligned", aligned), ("Photographed: learned", learned)):
        score = capture.scores
        panels.append(
            Panel(
                title,
                np.maximum(square(capture.seen), 0),
                caption=f"{score.psnr_db:.1f} dB, SSIM {score.ssim:.2f}",
                white=1.0,
            )
        )
    shades = np.clip(colour.seen, 0, 1)
    panels.append(
        Panel(
            "Photographed: three colours",
            shades,
            caption=f"{colour.psnr_db:.1f} dB, SSIM {colour.ssim:.2f}",
            white=1.0,
            gamma=1 / 2.2,
        )
    )
    unexplained = [100 * part**2 for part in lesson.rounds]
    rounds = Convergence(
        [float(n + 1) for n in range(len(unexplained))],
        unexplained,
        "Contrast of random patterns that is not explained, %",
        f"{unexplained[-1]:.1f} %",
        "rounds of learning",
    )
    facts = [
        ("learned from", f"{len(lesson.rounds)} rounds; others judge"),
        ("unexplained of them", f"{lesson.before**2:.1%} before, {lesson.after**2:.1%} after"),
    ]
    return summary_figure(Summary("Display demo", tuple(panels), rounds, lines=facts, simulated=True))
