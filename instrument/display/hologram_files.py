"""What is written of holograms: patterns, previews, pictures of the alignment, and Table 7.1."""

from __future__ import annotations

import csv
import io
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from instrument.display.hologram import HologramResult, colour_shares, square
from instrument.files.atomic import require_new, write_text
from instrument.files.errors import BenchError, FileError
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.images import side_car, write_image
from instrument.files.slm_image import field_levels, write_slm_image
from recon.arrays import Float32Array, Float64Array
from recon.holography import Display, HologramOptions, Scores
from recon.holography.losses import loss_of
from recon.holography.scores import DISSERTATION, GRIDS, METHODS, Cell, average

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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
            kind = "a complex pattern" if self.options.complex_slm else "a pattern"
            raise FileError(self.out, f"{kind} is written as {expected}.")
        if not self.out.parent.is_dir():
            raise FileError(self.out.parent, "there is no such folder.")
        for file in self.files():
            require_new(file, overwrite=overwrite)

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
                files += [*patterns, *map(side_car, patterns), self.preview(number, channel)]
        return files

    def write(self, number: int, channel: int, result: HologramResult) -> None:
        """Write one hologram's patterns and its preview."""
        display = self.displays[channel]
        facts = {**result.facts(self.options), **self.display_facts(channel)}
        patterns = self.patterns(number, channel)
        for frame, path in enumerate(patterns):
            about = {**facts, "frame": frame + 1, "of_frames": len(patterns)}
            if self.options.complex_slm:
                write_image(path, result.hologram.slm[frame], {"format": "diffuserbench SLM field", **about})
            else:
                shown, mirrors = result.hologram.slm[frame], self.options.mirrors is not None
                write_slm_image(path, field_levels(shown, self.binning, mirrors=mirrors), about)
        lines = [
            ("expansion", f"{display.expansion}x, {display.slm_shape[1]} x {display.slm_shape[0]} pixels"),
            ("loss, method", f"{loss_of(self.options.loss).name}, {self.options.method}"),
            ("judged", f"alias-free grid, envelope {self.options.envelope}, {self.options.frames} frame(s)"),
            _part_words(result.scores[0]),
            ("light", light_words(result, self.options)),
            ("stopped", str(result.hologram.stop_reason)),
            ("iterations", f"{result.hologram.history[-1].iteration}"),
        ]
        figure = hologram_figure(result, title=f"Hologram {patterns[0].stem}", facts=lines)
        save_figure(figure, self.preview(number, channel))

    @property
    def shares(self) -> list[float]:
        """Which part of its field each colour's picture fills."""
        return colour_shares(self.displays)

    def display_facts(self, channel: int) -> dict[str, Any]:
        """Return what a pattern was computed for, JSON-compatible."""
        display = self.displays[channel]
        return {
            "binning": self.binning,
            "expansion": display.expansion,
            "slm_shape": list(display.slm_shape),
            "slm_pitch_um": display.slm_pitch_um,
            "wavelength_nm": display.wavelength_nm,
            "field_share": round(self.shares[channel], 6),
            "colour": CHANNELS[channel] if len(self.displays) > 1 else None,
            "dc_power": display.dc.power,
            "mask_fill": display.mask_fill,
        }

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

    def preview(self, number: int, channel: int) -> Path:
        """Return the preview's file."""
        return self.out.with_name(f"{self._stem(number, channel)}-preview.png")


def score_words(scores: Scores) -> str:
    """Say how good a picture is: over the field, in its middle quarter, in the fovea where there is one."""
    fovea = "" if scores.fovea_psnr_db is None else f"fovea {scores.fovea_psnr_db:.2f} dB; "
    return (
        f"{scores.psnr_db:.2f} dB, SSIM {scores.ssim:.3f}; {fovea}"
        f"middle quarter {scores.crop_psnr_db:.2f} dB, SSIM {scores.crop_ssim:.3f}"
    )


def _part_words(scores: Scores) -> tuple[str, str]:
    if scores.fovea_psnr_db is not None:
        return "fovea", f"{scores.fovea_psnr_db:.1f} dB where the field counts fully"
    return "crop", f"{scores.crop_psnr_db:.1f} dB in the middle quarter"


def light_words(result: HologramResult, options: HologramOptions) -> str:
    """Say how much light a hologram uses."""
    where = "field" if options.mirrors is None else "picture"
    return f"{result.efficiency:.1%} of what falls on the SLM reaches the {where}"


_DETAIL = "its middle, raw, half as bright"


def hologram_figure(result: HologramResult, *, title: str, facts: list[tuple[str, str]]) -> Figure:
    """Draw wanted, seen and unfiltered image, the SLM's phase and the convergence.

    The first plane is drawn large; further planes as a strip below.
    """
    score = result.scores[0]
    drawn = drawn_pattern(result.hologram.slm[0])
    height, width = drawn.shape
    slm = Panel("SLM phase", drawn, caption=f"{width} x {height}, 0 to 2 pi", white=2 * np.pi)
    if is_of_light(result.hologram.slm[0]):
        slm = Panel("Mirrors", drawn, caption=f"{width} x {height}, white sends light", white=2 * np.pi)
    panels = (
        Panel("Wanted", square(result.wanted[0]), caption="through the eye's low-pass", white=1.0),
        Panel(
            "Seen (computed)",
            np.maximum(square(result.seen[0]), 0),
            caption=f"low-pass: {score.psnr_db:.1f} dB, SSIM {score.ssim:.2f}",
            white=1.0,
        ),
        Panel("Without the low-pass", _detail(result.unfiltered[0]), caption=_DETAIL, white=2.0),
        slm,
    )
    strip = tuple(
        Panel(
            f"plane {number + 2}", np.maximum(square(seen), 0), caption=f"{other.psnr_db:.1f} dB", white=1.0
        )
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
    return summary_figure(Summary(title, panels, convergence, sweep=strip, lines=facts, simulated=True))


def is_of_light(field: npt.NDArray[np.complexfloating]) -> bool:
    """Return whether an SLM field is what mirrors send: real, and not negative."""
    return not np.any(field.imag) and bool(np.min(field.real) >= 0)


def drawn_pattern(field: npt.NDArray[np.complexfloating]) -> Float32Array:
    """Return an SLM field, (height, width), as it is drawn in 0 to 2 pi: its phase, or what mirrors send."""
    if is_of_light(field):
        return np.asarray(2 * np.pi * field.real, np.float32)
    return np.asarray(np.mod(np.angle(field), 2 * np.pi), np.float32)


def _detail(image: Float64Array) -> Float64Array:
    """Cut out the middle of the field and sample it to squares, as the field is square."""
    height, width = image.shape
    cut = image[height * 3 // 8 : height * 5 // 8, width * 3 // 8 : width * 5 // 8]
    side = max(cut.shape)
    rows, columns = (np.arange(side) * n // side for n in cut.shape)
    square: Float64Array = cut[np.ix_(rows, columns)]
    return square


Field = Float64Array


def write_alignment_figure(
    path: Path,
    displacement: Field,
    rest: Field,
    mask_shape: tuple[int, int],
    efficiencies: Sequence[tuple[int, float]],
    title: str,
    *,
    simulated: bool,
) -> None:
    """Draw efficiency against frames and the displacement that is kept; errors as ``whole_file``.

    Parameters
    ----------
    displacement, rest : ndarray, (rows, columns, 2)
        Of the pose, and the smooth rest; mask pixels on nodes from edge to edge of the mask.
    mask_shape : (int, int)
    efficiencies : sequence of (int, float)
        Frames taken, and spot brightness over the model's ideal.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 4.4), dpi=100, facecolor="white", layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=[1, 1.3, 1.3])
    frames, values = zip(*efficiencies, strict=True)
    left.plot(frames, values, "o-", color="#00798c")
    left.set_ylim(0, max(1.05, 1.05 * max(values)))
    left.set_xlabel("frames taken")
    left.set_title("Spot brightness / model's ideal", loc="left")
    left.grid(color="#e3e8ec")
    height, width = mask_shape
    for axes, field, words in (
        (middle, displacement, "Shift, rotation and scale left"),
        (right, rest, "Smooth rest"),
    ):
        y, x = np.meshgrid(
            np.linspace(0, height, field.shape[0]), np.linspace(0, width, field.shape[1]), indexing="ij"
        )
        size = np.hypot(field[..., 0], field[..., 1])
        arrows = axes.quiver(x, y, field[..., 1], field[..., 0], size, angles="xy", cmap="viridis")
        figure.colorbar(arrows, ax=axes, label="mask pixels", shrink=0.7)
        axes.set_aspect("equal")
        axes.invert_yaxis()
        axes.set_title(f"{words}: {np.sqrt(np.mean(size**2)):.2f} mask pixels rms", loc="left")
    figure.suptitle(title + ("   SIMULATED" if simulated else ""), x=0.01, ha="left")
    save_figure(figure, path)


def expansions_of(cells: Sequence[Cell]) -> list[int]:
    """Return the expansions present, ascending."""
    return sorted({cell.expansion for cell in cells})


def rows(cells: Sequence[Cell], *, crop: bool) -> list[tuple[int, str, list[float]]]:
    """Return ``(expansion, method, figures)`` in dB.

    The figures are: what the dissertation prints (NaN where it has none), optimised and judged on the
    dissertation's grid, the same judged without aliasing, optimised and judged without aliasing.
    """
    name = "crop_psnr_db" if crop else "psnr_db"
    table = []
    for q in expansions_of(cells):
        for method in METHODS:
            printed = DISSERTATION.get((q, method))
            figures = [getattr(printed, name) if printed else float("nan")]
            for grid, own in ((GRIDS[0], True), (GRIDS[0], False), (GRIDS[1], False)):
                figures.append(getattr(average(cells, q, grid, method, own=own), name))
            table.append((q, method, figures))
    return table


def write_csv(path: Path, cells: Sequence[Cell]) -> None:
    """Write every picture's figures, one line a cell, and the dissertation's; errors as ``whole_file``."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    scores = ("psnr_db", "ssim", "crop_psnr_db", "crop_ssim")
    writer.writerow(["expansion", "optimised_on", "judged_on", "method", "picture", *scores, "seconds"])
    for (q, method), printed in DISSERTATION.items():
        figures = [getattr(printed, s) for s in scores]
        writer.writerow(
            [q, "dissertation", "dissertation", method, "printed in the dissertation", *figures, ""]
        )
    for cell in cells:
        judged = [("alias-free", cell.alias_free)]
        if cell.grid == "dissertation":
            judged.insert(0, ("dissertation", cell.own))
        for name, found in judged:
            figures = [f"{getattr(found, s):.4f}" for s in scores]
            writer.writerow(
                [cell.expansion, cell.grid, name, cell.method, cell.picture, *figures, f"{cell.seconds:.2f}"]
            )
    write_text(path, text.getvalue())


def write_chart(path: Path, cells: Sequence[Cell], note: str) -> None:
    """Draw PSNR by method, whole field above and middle quarter below; errors as ``whole_file``."""
    from matplotlib.figure import Figure

    found = expansions_of(cells)
    figure = Figure(figsize=(4.6 * len(found), 8.0), dpi=100, facecolor="white", layout="constrained")
    axes = figure.subplots(2, len(found), squeeze=False, sharey="row")
    looks = (
        ("printed in the dissertation", "#8496a5", "D"),
        ("dissertation's grid, judged on it", "#edae49", "s"),
        ("dissertation's grid, judged alias-free", "#d1495b", "v"),
        ("alias-free grid, judged alias-free", "#00798c", "o"),
    )
    for line, crop in enumerate((False, True)):
        table = rows(cells, crop=crop)
        for column, q in enumerate(found):
            ax = axes[line][column]
            values = [figures for expansion, _, figures in table if expansion == q]
            for i, (name, colour, marker) in enumerate(looks):
                places = [x + 0.12 * (i - 1.5) for x in range(len(METHODS))]
                ax.plot(places, [v[i] for v in values], marker, color=colour, markersize=8, label=name)
            ax.set_xticks(range(len(METHODS)), METHODS)
            ax.grid(True, axis="y", color="#e3e8ec")
            ax.set_title(f"{q}x expansion, {'middle quarter' if crop else 'whole field'}", loc="left")
            if column == 0:
                ax.set_ylabel("PSNR of the low-passed image, dB")
    columns = len(found) if len(found) < 3 else 4  # what is wider than the plots would be cut off
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=columns)
    title = textwrap.fill(f"Table 7.1 (computed). {note}", 60 * len(found))
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    save_figure(figure, path)
