"""Points of light in a volume, with their places in the scene: ``points``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from instrument.files.atomic import require_new, write_text
from instrument.files.errors import FileError, count
from instrument.tasks.task import Desk, Done, task
from recon.analysis.point_places import PointOptions, PointPlaces
from recon.base.declare import option

if TYPE_CHECKING:
    from instrument.reconstruction.stored_result import StoredResult

_SHOWN = 20
_COLUMNS = (
    "x_um,y_um,z_um,x_deviation_um,y_deviation_um,z_deviation_um,light,plane,row,column,in_outermost_plane"
)


@dataclass(frozen=True, kw_only=True)
class PointFiles:
    """In which volume, and where its points go."""

    volume: Path = option(
        help="A reconstructed volume (.ome.zarr, .tif; .npy, which keeps no places), exported ones too.",
        metavar="VOLUME",
        positional=True,
        group="Files",
    )
    out: Path = option(
        Path("points.csv"),
        help="Table of the points.",
        metavar="FILE",
        flags=("--out", "-o"),
        label="Result",
        group="Files",
    )
    force: bool = option(False, help="Overwrite a file that exists.", label="Overwrite", group="Files")


@task("diffuserbench points volume.ome.zarr", "diffuserbench points volume.tif --least 0.3 --out beads.csv")
def points(desk: Desk, files: PointFiles, options: PointOptions) -> Done:
    """Find points of light in a volume (beads, cells): x, y, z in micrometres, how well known, and light.

    Places are between voxels and in the scene's coordinates: a point's light is followed along its ray
    through the diffuser. The volume as it was reconstructed serves best, not one made metric, of which
    voxels finer than the planes are summed. Deviations are one standard deviation, as points of simulated
    photographs were off.
    """
    from instrument.reconstruction.stored_result import open_result
    from recon.analysis.point_places import point_places

    require_new(files.out, overwrite=files.force)
    result = open_result(files.volume)
    try:
        grid = result.grid
        if result.volume is None or grid is None:
            raise FileError(
                files.volume,
                "is a picture; points in depth are found in a volume.",
                "Of pictures reconstruct --prior l1 --uncertainty tells the points.",
            )
        with desk.step("looking for points", 1.0) as advance:
            found = point_places(result.volume.plane, grid, options, advance)
    finally:
        result.close()
    if grid.upright and grid.is_metric and grid.made_of_um is None:
        desk.warn(
            "Warning: this metric volume does not tell the planes it was made of. Where voxels are finer, "
            "one point is told as several: give the volume as it was reconstructed, or export it again."
        )
    known = bool(np.isfinite(found.places_um).all())
    write_text(files.out, _table(found))
    desk.fact("Points", str(len(found)))
    if not len(found):
        desk.warn("Warning: nothing in the volume is above 0.")
    elif known:
        across, deep = np.median(found.deviations_um[:, :2].max(axis=1)), np.median(found.deviations_um[:, 2])
        desk.fact("Known to", f"{across:.3g} um across, {deep:.3g} um in depth (medians)")
        desk.table(
            ("x (mm)", "y (mm)", "z (mm)", "light"),
            [
                (*(f"{at / 1e3:.5g}" for at in place), f"{light:.4g}")
                for place, light in zip(found.places_um[:_SHOWN], found.light, strict=False)
            ],
            "" if len(found) <= _SHOWN else f"The brightest {_SHOWN}",
        )
    else:
        desk.warn(
            "Warning: the volume does not tell where its planes are: the table has planes, rows and columns "
            f"alone. {_why_unknown(result)}"
        )
    if ends := int(found.at_end.sum()):
        desk.warn(f"Warning: {_at_the_ends(ends, grid.shape[0])}")
    return Done((files.out,))


def _why_unknown(result: StoredResult) -> str:
    """Say why a volume's places are not known, and what to do."""
    if result.path.suffix.lower() == ".npy":
        return "A .npy keeps no places: give the .ome.zarr or .tif that it was exported from."
    if result.volume is not None and "z_um" in {**result.record.get("grid", {}), **result.volume.facts}:
        return "It was made of PSFs from files: --pixel-um and --distance-mm of reconstruct say them."
    return "This program's .ome.zarr and .tif keep places; other programs' tell steps at most."


def _at_the_ends(ends: int, planes: int) -> str:
    """Say what it means that so many points are brightest in an outermost plane."""
    if planes == 2:
        return "the volume has two planes; points may lie beyond either of them."
    are, they = ("is", "it") if ends == 1 else ("are", "they")
    return f"{count(ends, 'point')} {are} brightest in an outermost plane; {they} may lie beyond it."


def _table(found: PointPlaces) -> str:
    """Return points as CSV; what is not known is left empty."""
    numbers = np.column_stack([found.places_um, found.deviations_um, found.light, found.voxels])
    lines = [
        ",".join([*(f"{value:.7g}" if np.isfinite(value) else "" for value in row), str(int(end))])
        for row, end in zip(numbers, found.at_end, strict=True)
    ]
    return "\n".join([_COLUMNS, *lines, ""])
