"""The files of a computed hologram: patterns, what is known of them, previews."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from instrument.display.hologram_job import HologramResult
from instrument.files.errors import BenchError, FileError
from instrument.files.images import side_car, write_image
from instrument.files.slm_image import phase_levels, write_slm_image
from recon.holography import Display, HologramOptions
from recon.holography.losses import loss_of

CHANNELS = ("red", "green", "blue")


@dataclass(frozen=True, slots=True)
class HologramFiles:
    """Names and writes the files of one call: patterns, descriptions, previews.

    One file a pattern: ``slm.png``, or ``slm-red.png``, ``slm-frame1.png``, ``slm-0001.png`` and their
    combinations where there are colours, time-multiplexed frames or video frames.
    """

    out: Path
    binning: int
    options: HologramOptions
    displays: Sequence[Display]
    video: int = 0

    def check(self, *, overwrite: bool) -> None:
        """Refuse what could not be written, before any work."""
        levels = self.options.phase_levels
        if levels is not None and 256 % levels:
            raise BenchError(
                f"{levels} phase levels cannot be written in 256: 2, 4, 8, 16, 32, 64, 128 or 256 can."
            )
        expected = ".npy" if self.options.complex_slm else ".png"
        if self.out.suffix.lower() != expected:
            kind = "a complex" if self.options.complex_slm else "a phase"
            raise FileError(self.out, f"{kind} pattern is written as {expected}.")
        if not self.out.parent.is_dir():
            raise FileError(self.out.parent, "there is no such folder.")
        existing = [file for file in self.files() if file.exists()]
        if existing and not overwrite:
            raise FileError(existing[0], "exists already.", "Choose another name, or overwrite with --force.")

    def label(self, number: int, channel: int) -> str:
        """Return which pattern it is, for bar and report."""
        parts = [f"frame {number + 1}/{self.video}"] if self.video else []
        parts += [CHANNELS[channel]] if len(self.displays) > 1 else []
        return " ".join(parts) or "hologram"

    def files(self) -> list[Path]:
        """Return every file that will be written."""
        files = []
        for number in range(max(self.video, 1)):
            for channel in range(len(self.displays)):
                patterns = self.patterns(number, channel)
                files += [*patterns, *map(side_car, patterns), self._preview(number, channel)]
        return files

    def write(self, number: int, channel: int, result: HologramResult) -> None:
        """Write one hologram's patterns and its preview."""
        from instrument.display.figures import (
            write_hologram_figure,  # matplotlib, only where it is drawn
        )

        display = self.displays[channel]
        facts = {
            **result.facts(self.options),
            "binning": self.binning,
            "expansion": display.expansion,
            "slm_shape": list(display.slm_shape),
            "slm_pitch_um": display.slm_pitch_um,
            "wavelength_nm": display.wavelength_nm,
            "dc_power": display.dc.power,
            "mask_fill": display.mask_fill,
        }
        patterns = self.patterns(number, channel)
        for frame, path in enumerate(patterns):
            about = {**facts, "frame": frame + 1, "of_frames": len(patterns)}
            if self.options.complex_slm:
                write_image(path, result.hologram.slm[frame], {"format": "diffuserbench SLM field", **about})
            else:
                write_slm_image(path, phase_levels(result.hologram.phase_rad[frame], self.binning), about)
        lines = [
            ("expansion", f"{display.expansion}x, {display.slm_shape[1]} x {display.slm_shape[0]} pixels"),
            ("loss, method", f"{loss_of(self.options.loss).name}, {self.options.method}"),
            ("judged", f"alias-free grid, envelope {self.options.envelope}, {self.options.frames} frame(s)"),
            ("crop", f"{result.scores[0].crop_psnr_db:.1f} dB in the middle quarter"),
            ("stopped", str(result.hologram.stop_reason)),
            ("iterations", f"{result.hologram.history[-1].iteration}"),
        ]
        write_hologram_figure(
            self._preview(number, channel),
            result,
            title=f"Hologram {patterns[0].stem}",
            facts=lines,
        )

    def _stem(self, number: int, channel: int) -> str:
        stem = self.out.stem
        if self.video:
            stem += f"-{number + 1:04d}"
        if len(self.displays) > 1:
            stem += f"-{CHANNELS[channel]}"
        return stem

    def patterns(self, number: int, channel: int) -> list[Path]:
        """Return the pattern files of one hologram, one a time-multiplexed frame."""
        stem = self._stem(number, channel)
        if self.options.frames == 1:
            return [self.out.with_name(stem + self.out.suffix)]
        return [
            self.out.with_name(f"{stem}-frame{frame + 1}{self.out.suffix}")
            for frame in range(self.options.frames)
        ]

    def _preview(self, number: int, channel: int) -> Path:
        return self.out.with_name(f"{self._stem(number, channel)}-preview.png")
