"""Spots as files: lists that are read, patterns, descriptions and previews that are written."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from instrument.display.hologram_files import HologramFiles
from instrument.files.atomic import protect
from instrument.files.errors import FileError
from instrument.files.figures import Convergence, Panel, Summary, save_figure, summary_figure
from instrument.files.images import side_car
from instrument.files.reading import read_bytes
from instrument.files.record import plain, value_of
from instrument.files.slm_image import phase_levels, write_slm_image
from recon.base.declare import record
from recon.errors import InputError
from recon.holography import (
    Display,
    Hologram,
    HologramModel,
    SpotList,
    SpotScores,
    Target,
    spot_array,
)

_COLUMNS = {"y": None, "x": None, "intensity": 1.0, "z_mm": 0.0}
"""Of a list of spots, with what is taken where a column is missing."""


def spots_of(typed: str) -> SpotList:
    """Return the spots of ``ROWSxCOLUMNS`` or of a CSV file.

    Raises FileError when the file is missing or no list of spots; InputError when spots do not make sense.
    """
    rows, _, columns = typed.partition("x")
    if rows.isdecimal() and columns.isdecimal():
        return spot_array(int(rows), int(columns))
    return read_spots(Path(typed))


def read_spots(path: Path) -> SpotList:
    """Read a list of spots; errors as :func:`spots_of`.

    CSV with a line of names: ``y`` and ``x`` in fractions of the field from its top left corner, and where
    wanted ``intensity`` and ``z_mm``.
    """
    if not path.exists():
        raise FileError(path, "there is no such file; spots are ROWSxCOLUMNS or a CSV file.")
    try:
        protect(path)
        lines = list(csv.DictReader(io.StringIO(read_bytes(path).decode("utf-8-sig"), newline="")))
    except (csv.Error, UnicodeDecodeError) as error:
        raise FileError(path, f"is no CSV file: {error}.") from error
    if not lines or not {"y", "x"} <= set(lines[0]):
        raise FileError(
            path, "is no list of spots: its first line names columns y and x, then one spot a line."
        )
    if unknown := sorted(str(name) for name in set(lines[0]) - set(_COLUMNS)):
        raise FileError(path, f"has unknown columns {', '.join(unknown)}; a spot has {', '.join(_COLUMNS)}.")
    values: dict[str, list[float]] = {name: [] for name in _COLUMNS}
    for number, line in enumerate(lines, start=2):
        for name, missing in _COLUMNS.items():
            try:
                values[name].append(float(line[name]) if name in line else float(missing or 0.0))
            except (TypeError, ValueError):
                raise FileError(path, f"line {number}: {name} is {line.get(name)!r}, no number.") from None
    found = {name: np.array(column) for name, column in values.items()}
    try:
        return SpotList(np.column_stack([found["y"], found["x"]]), found["intensity"], found["z_mm"])
    except InputError as error:
        raise FileError(path, str(error)) from error


def spots_of_facts(pattern: Path, facts: Mapping[str, Any]) -> SpotList:
    """Return the spots that a pattern was computed for; FileError where what is beside it is damaged."""
    try:
        return value_of(SpotList, facts["spots"])
    except (LookupError, TypeError, ValueError) as error:
        raise FileError(side_car(pattern), f"does not say which spots: {error}.") from error


def middle_line(display: Display, wanted: SpotList, scores: SpotScores) -> str:
    """Say how bright the light is that is not modulated, where it is a spot of its own; else empty."""
    cells = np.abs(wanted.places - 0.5) * display.slm_shape
    is_spot = display.factor == 1 and not display.near and display.dc.power > 0
    if not is_spot or scores.efficiency <= 0 or (cells.max(axis=1) < 1).any():
        return ""
    times = display.dc.power * len(wanted) / scores.efficiency
    return (
        f"  in the middle: a spot {times:.2g} times as bright as one of these, of the light that the SLM "
        "does not modulate (dc_power of [display])"
    )


@dataclass(frozen=True, slots=True)
class SpotFiles:
    """Writes a hologram of spots: patterns, description with every spot, preview."""

    files: HologramFiles

    def write(self, spots: SpotList, hologram: Hologram, scores: SpotScores) -> None:
        """Write all of it; errors as ``write_slm_image`` and ``whole_file``."""
        files, display = self.files, self.files.displays[0]
        patterns = files.patterns(0, 0)
        facts: dict[str, Any] = {
            "computed": True,
            "spots": plain(spots),
            "spot_scores": {
                "deviation": scores.deviation,
                "least": float(scores.relative.min()),
                "greatest": float(scores.relative.max()),
                "efficiency": scores.efficiency,
            },
            "options": record(files.options),
            "iterations": hologram.history[-1].iteration,
            "stopped": str(hologram.stop_reason),
            **files.display_facts(0),
        }
        for frame, path in enumerate(patterns):
            about = {**facts, "frame": frame + 1, "of_frames": len(patterns)}
            write_slm_image(path, phase_levels(hologram.phase_rad[frame], files.binning), about)
        _draw(files.preview(0, 0), spots, display, hologram, scores)


def _draw(path: Path, spots: SpotList, display: Display, hologram: Hologram, scores: SpotScores) -> None:
    from recon.holography.scores import intensity
    from recon.holography.target import near_window

    phase = np.mod(np.angle(hologram.slm[0]), 2 * np.pi)
    first = float(spots.z_mm[0])
    padding = 2 if display.mask.levels.size < 2e6 else 1
    straight = replace(display, displacement=None)
    if display.near:
        model = HologramModel(straight, [Target(np.ones((8, 8)), first)], frames=len(hologram.slm))
        seen = model.intensity(hologram.slm)
        seen = seen[near_window(display).part(seen.shape)]
    else:
        seen = np.fft.fftshift(intensity(hologram.slm, straight, z_mm=first, padding=padding))
    side = 480
    blocks = [np.linspace(0, n, side + 1).astype(int)[:-1] for n in seen.shape]
    seen = np.maximum.reduceat(np.maximum.reduceat(seen, blocks[0], axis=0), blocks[1], axis=1)
    share = np.sort(scores.relative)
    history = hologram.history
    summary = Summary(
        f"Spots {path.stem.removesuffix('-preview')}",
        (
            Panel("Seen (computed)", seen, caption=f"at {first:g} mm, peaks", gamma=0.5),
            Panel(
                "SLM phase", phase, caption=f"{phase.shape[1]} x {phase.shape[0]}, 0 to 2 pi", white=2 * np.pi
            ),
        ),
        Convergence(
            [float(r.iteration) for r in history],
            [100 * r.loss for r in history],
            "Deviation of the spots' brightness, %",
            f"{100 * scores.deviation:.2f} %",
            "iterations",
        ),
        lines=[
            ("spots", f"{len(spots)}"),
            (
                "brightness",
                f"{share[0]:.3f} to {share[-1]:.3f} of the mean, deviation {scores.deviation:.2%}",
            ),
            ("light", f"{scores.efficiency:.1%} of what falls on the SLM is in the spots"),
            ("expansion", "no mask" if display.expansion == 1 else f"{display.expansion}x"),
            ("stopped", str(hologram.stop_reason)),
        ],
        simulated=True,
    )
    save_figure(summary_figure(summary), path)
