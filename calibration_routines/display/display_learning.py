"""Learn how a display differs from its description, by photographs of random phases."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from calibration_routines.display.display_io import DisplayBench, bring_mask, require_slm, writable
from calibration_routines.display.hologram_photograph import HologramCamera
from calibration_routines.display.kept_frames import KeptFrames, SeenAgain, kept_words
from calibration_routines.display.pattern_series import photograph_series, series_frames, visited_before
from calibration_routines.options import Checked
from calibration_routines.procedure import Listener, Outcome, Outlook, Procedure
from calibration_routines.routine import Routine
from instrument.bench.bench import Bench
from instrument.display.alignment import Alignment, load_alignment, save_alignment
from instrument.display.bench_display import bench_display
from instrument.files.atomic import named_by_worth, require_new
from instrument.files.record import plain
from instrument.files.slm_image import load_slm_correction
from instrument.runs.run_control import RunControl
from recon.arrays import Array
from recon.base.declare import option
from recon.holography import Display
from recon.holography.learn import Lesson, learn_display, learning_work
from recon.holography.pose import NODES, Pose

DISPLAY_FILE = "display.json"
"""Where the command line writes it."""
ASIDE = 3
"""Photographs that are not fitted but judge."""
_REGISTERING = 2  # frames: a dark one, and the blank SLM's


PHOTOGRAPHING, LEARNING = "photographing random patterns", "learning"
"""Its steps."""
_REGISTER, _SEE, _LIGHT, _FRAME = 42.0, 11.0, 8.0, 2.0
"""Transforms of 1024 x 1024 a megapixel of the sensor: to register the camera, to see a frame, and on a
simulated bench for a pattern's light and a frame of it; once, on 1.2 megapixels."""


@dataclass(frozen=True, kw_only=True)
class LearningProcedure(SeenAgain, Checked, Procedure):
    """Photograph random phases, fit the display's model to them, judge it by others."""

    alignment: Path | None = option(
        None,
        metavar="FILE",
        help="Of the mask, from align mask; or an earlier display file, which is gone on from.",
        default_words="none: the mask is in its place",
    )
    slm_calibration: Path | None = option(
        None,
        metavar="FILE",
        label="SLM calibration",
        help="Look-up table and flatness, from calibrate slm.",
        default_words="none: an ideal SLM",
    )
    patterns: int = option(
        13, least=ASIDE + 2, most=58, help=f"Random patterns to photograph; {ASIDE} of them judge."
    )
    out: Path | None = option(
        None,
        flags=("--out", "-o"),
        metavar="FILE",
        label="File",
        help="Where what is learned goes (.json).",
        default_words=f"{DISPLAY_FILE}; in the window dated, beside the runs",
    )
    overwrite: bool = option(False, flags=("--force",), help="Overwrite a file that exists.")

    @property
    def frames(self) -> int:
        """Frames it takes."""
        return _REGISTERING + series_frames(self.patterns)

    @property
    def _shown(self) -> int:
        """How often a pattern is shown."""
        return self.patterns - 1 + len(visited_before(self.patterns))

    def outlook(self, bench: Bench, folder: Path | None = None) -> Outlook:
        """Refuse a bench without SLM or with mirrors, files that cannot be read or do not fit or exist."""
        slm = require_slm(bench, "only phases can be learned")
        if self.out is not None:
            require_new(self.out, overwrite=self.overwrite)
        if self.slm_calibration is not None:
            load_slm_correction(self.slm_calibration)
        display = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))
        if self.alignment is not None:
            place = load_alignment(self.alignment)
            place.of(display)
            place.require_correction(self.slm_calibration is not None)
        height, width = display.slm_shape
        return Outlook(
            (
                f"{self.patterns} random patterns of {height} x {width} pixels, {self.frames} frames",
                kept_words(bench, self.frames, self.again, folder),
            ),
            beside_s=1e-3 * (self.frames * bench.camera.exposure_ms + self._shown * slm.settle_ms),
            work=(
                (PHOTOGRAPHING, self._photographing(bench)),
                (LEARNING, learning_work(int(np.prod(display.mask.shape)), self.patterns - ASIDE)),
            ),
        )

    def _photographing(self, bench: Bench) -> float:
        """Return what photographing computes, in transforms of 1024 x 1024, simulated light with it."""
        height, width = bench.camera.frame_shape[:2]
        transforms = _REGISTER + _SEE * series_frames(self.patterns)
        if bench.simulated_kinds:
            transforms += _LIGHT * self._shown + _FRAME * self.frames
        return 1e-6 * height * width * transforms

    def perform(self, bench: Bench, folder: Path | None, control: RunControl, listener: Listener) -> Outcome:
        """Photograph, learn, and save what ``hologram`` and ``show`` take as an alignment."""
        slm, out = require_slm(bench), writable(bench, folder, self.out, "display")
        place = load_alignment(self.alignment) if self.alignment is not None else None
        nominal = bench_display(bench.config, (slm.shape, slm.pixel_pitch_um))

        def progress(share: float, _words: str) -> None:
            control.check()
            listener.share(share, 1.0)

        with KeptFrames(bench, folder, "calibrate display", self) as kept:
            io = DisplayBench(
                bench,
                bench.config.display.slm_binning,
                load_slm_correction(self.slm_calibration) if self.slm_calibration else None,
                check=control.check,
                on_frame=lambda frames: listener.share(frames, self.frames),
                kept=kept,
            )
            if place is not None:
                bring_mask(bench, place.stage_position)
            else:
                place = _in_place(nominal, bench)
            listener.step(PHOTOGRAPHING)
            seen = HologramCamera.registered(io, place.of(nominal))
            series = photograph_series(seen, self.patterns)
            bench.stop()
            kept.finish()
            listener.step(LEARNING)  # who interrupts it is told how to see the frames again
            lesson = learn_display(seen.display, series.looks, aside=ASIDE, on_progress=progress)
        found = learned_alignment(place, nominal, lesson, corrected=self.slm_calibration is not None)
        doubted = bool(series.findings)
        out = named_by_worth(out, doubted=doubted, overwrite=self.overwrite)
        facts = {
            "bench": bench.label,
            "frames": io.frames,
            "scatter": plain(series.scatter),
            "visits": plain(list(series.visits)),
            "findings": list(series.findings),
            "camera_residual_px": seen.camera.residual_px,
            "unexplained": {"before": lesson.before, "after": lesson.after, "rounds": list(lesson.rounds)},
        }
        save_alignment(out, found, facts)
        return Outcome(
            verdict=(
                *(f"Quality: {words}" for words in series.findings),
                *learning_lines(lesson, io.frames, simulated=found.simulated),
                *(f"  {words}" for words in series.notes),
            ),
            good=not doubted,
            runs=kept.paths,
            calibration=out,
            result=lesson,
        )


def _in_place(display: Display, bench: Bench) -> Alignment:
    """Return the alignment of a mask that is where it should be."""
    rest = np.zeros((*NODES, 2))
    return Alignment(Pose(), {}, rest, 1.0, {}, display.mask.shape, bool(bench.simulated_kinds))


def learned_alignment(place: Alignment, nominal: Display, lesson: Lesson, *, corrected: bool) -> Alignment:
    """Return an alignment with what was learned; as it was where nothing was."""
    if not lesson.helps or lesson.display.displacement is None:
        return place
    rest: Array = lesson.display.displacement - place.pose.displacement(nominal.mask.shape)
    return replace(place, rest=rest, learned=lesson.display.learned, corrected=corrected)


def learning_lines(lesson: Lesson, frames: int, *, simulated: bool) -> list[str]:
    """Return what was learned and how good it is, in lines."""
    mark = " (SIMULATED)" if simulated else ""
    lines = [
        f"{frames} frames{mark}. Of the contrast of {ASIDE} photographs that were not fitted, "
        f"{1 - lesson.before**2:.1%} was explained before, {1 - lesson.after**2:.1%} is now"
    ]
    learned = lesson.display.learned
    if not lesson.helps or learned is None:
        return [*lines, "  The display is as it is described: nothing was changed."]
    told = learned.response[:, 0] + 1j * learned.response[:, 1]
    told = told / told.mean()
    light, height_width = learned.illumination((32, 64)), (64, 64)
    down, across = (np.fft.fftshift(row) for row in learned.shading(height_width))
    least = np.sort(np.abs(light) ** 2, axis=None)[len(light) // 2]
    lines += [
        f"  light that is not modulated {lesson.display.dc.power:.1%}; cross-talk "
        f"{learned.crosstalk_px[0]:.2f} x {learned.crosstalk_px[1]:.2f} SLM pixels; mask depth "
        f"{learned.mask_depth:.3f} of what it should be",
        f"  SLM levels: phase off by {np.abs(np.angle(told)).max():.2f} rad, amplitude by "
        f"{np.abs(np.abs(told) - 1).max():.0%} at most",
        f"  light on the SLM: {least:.0%} of the mean where it is dim; wavefront "
        f"{np.sqrt((learned.phase[2:] ** 2).sum()):.2f} rad rms beyond tilt",
        f"  light at the field's border: {down[[0, -1]].mean() / down[32]:.0%} (above, below), "
        f"{across[[0, -1]].mean() / across[32]:.0%} (sides) of the middle's, mask pixels' envelope apart",
    ]
    return lines


ROUTINES = (
    Routine(
        name="display",
        title="Display model",
        help="Learn from photographs of random patterns how the display differs from its description: SLM, "
        "light, lens, mask.",
        details="SLM amplitude and phase, cross-talk, light that is not modulated, illumination, wavefront, "
        "vignetting, depth and place of the mask are fitted to photographs, and judged by others. Align the "
        "mask before. Give the file to hologram and show as --alignment.",
        options=LearningProcedure,
        procedure=lambda options: options,
        needs=("slm",),
        tried_on="display",
        examples=(
            "diffuserbench calibrate display --bench display.toml --alignment alignment.json",
            "diffuserbench calibrate display --alignment alignment.json --patterns 40",
        ),
        file=DISPLAY_FILE,
    ),
)
"""Row of :data:`calibration_routines.routine.routines`."""
