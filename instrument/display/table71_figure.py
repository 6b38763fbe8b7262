"""Table 7.1 as text rows, CSV and picture."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from pathlib import Path

from instrument.files.atomic import whole_file, write_text
from recon.holography.table71 import DISSERTATION, GRIDS, METHODS, Cell, average


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
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    found = expansions_of(cells)
    figure = Figure(figsize=(4.6 * len(found), 8.0), dpi=100, facecolor="white", layout="constrained")
    FigureCanvasAgg(figure)
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
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=4)
    figure.suptitle(f"Table 7.1 (computed). {note}", x=0.01, ha="left", fontsize=11)
    with whole_file(path) as temporary:
        figure.savefig(temporary)
