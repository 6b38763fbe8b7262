"""Points of light in a volume, with their places in the scene: ``points``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from instrument.files.atomic import require_new, write_text
from instrument.files.errors import BenchError, FileError, count, ranges
from instrument.reconstruction.film import Film, is_film
from instrument.tasks.task import Desk, Done, task
from recon.analysis.point_places import PointOptions, PointPlaces, point_places
from recon.arrays import Float32Array
from recon.base.declare import option
from recon.errors import InputError

if TYPE_CHECKING:
    from instrument.reconstruction.stored_result import StoredResult

_SHOWN = 20
_COLUMNS = (
    "x_um,y_um,z_um,x_deviation_um,y_deviation_um,z_deviation_um,light,plane,row,column,in_outermost_plane,"
    "fitted"
)
_LEFT = 2.0
_UNEXPLAINED = 0.04
"""Of a photograph of points they leave so many times the noise, or beyond it so much of what is seen of them,
root mean square, at most (0258)."""


@dataclass(frozen=True, kw_only=True)
class PointFiles:
    """In which volume, what of, and where its points go."""

    volume: Path = option(
        help="A reconstructed volume (.ome.zarr, .tif; .npy, which keeps no places), exported ones too; or a "
        "film of volumes (.ome.zarr).",
        metavar="VOLUME",
        positional=True,
        group="Files",
    )
    fit: bool = option(
        False,
        help="Fit places and light to the photograph that the volume was made of, by its PSFs.",
        label="Fit to the photograph",
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


@task(
    "diffuserbench points volume.ome.zarr",
    "diffuserbench points volume.ome.zarr --fit",
    "diffuserbench points volume.tif --least 0.3 --out beads.csv",
    "diffuserbench points film.ome.zarr --out tracks.csv",
)
def points(desk: Desk, files: PointFiles, options: PointOptions) -> Done:
    """Find points of light in a volume (beads, cells): x, y, z in micrometres, how well known, and light.

    Places are between voxels and in the scene's coordinates: a point's light is followed along its ray
    through the diffuser. The volume as it was reconstructed serves best, not one made metric, of which
    voxels finer than the planes are summed. Deviations are one standard deviation, as points of simulated
    photographs were off. --fit looks for the places and lights that leave least of the photograph: better
    known, and free of the planes that there are and of the prior. Of a film each volume's points are told,
    with its number and time.
    """
    from instrument.reconstruction.again import made_of
    from instrument.reconstruction.stored_result import open_result
    from recon.reconstruction.point_errors import LEAST, fitted_places

    require_new(files.out, overwrite=files.force)
    if is_film(files.volume):
        return _of_film(desk, files, options)
    result = open_result(files.volume)
    try:
        grid = result.grid
        if result.volume is None or grid is None:
            raise FileError(
                files.volume,
                "is a picture; points in depth are found in a volume.",
                "Of pictures reconstruct --prior l1 --uncertainty tells the points.",
            )
        made = made_of(result) if files.fit else None
        sought = options if made is None else PointOptions(least=min(options.least, LEAST))
        with desk.step("looking for points", 1.0) as advance:
            found = point_places(result.volume.plane, grid, sought, advance)
        seen = len(found)
        if made is not None and seen:
            seen = len(found.of_at_least(options.least))
            with desk.step("fitting them", 1.0) as advance:
                found = fitted_places(found, grid, made.measurement, made.calibration, on_progress=advance)
            found = found.of_at_least(options.least)
    finally:
        result.close()
    if grid.upright and grid.is_metric and grid.made_of_um is None:
        desk.warn(
            "Warning: this metric volume does not tell the planes it was made of. Where voxels are finer, "
            "one point is told as several: give the volume as it was reconstructed, or export it again."
        )
    if made is not None and made.doubt:
        desk.warn(f"Warning: {made.doubt}")
    known = bool(np.isfinite(found.places_um).all())
    write_text(files.out, "\n".join([_COLUMNS, *_lines(found), ""]))
    desk.fact("Points", str(len(found)))
    if not seen:
        desk.warn("Warning: nothing in the volume is above 0.")
    elif known:
        desk.fact("Places", _where_from(result, found))
        _tell_places(desk, found)
    else:
        desk.warn(
            "Warning: the volume does not tell where its planes are: the table has planes, rows and columns "
            f"alone. {_why_unknown(result)}"
        )
    if (fewer := seen - len(found)) > 0:
        desk.warn(
            f"Warning: {count(fewer, 'point')} of the volume {'is' if fewer == 1 else 'are'} left out: the "
            "photograph does not tell them from noise, or from a point beside them."
        )
    if found.misfit is not None and found.misfit > _LEFT and (found.unexplained or 0.0) > _UNEXPLAINED:
        desk.warn(f"Warning: {left_over(len(found), found.misfit, found.unexplained or 0.0)}")
    if ends := int(found.at_end.sum()):
        desk.warn(f"Warning: {_at_the_ends(ends, grid.shape[0], fitted=found.misfit is not None)}")
    return Done((files.out,))


def left_over(points: int, misfit: float, unexplained: float) -> str:
    """Say how much of the photograph the points do not explain, and why that may be."""
    why = "there is more in it than points, or its PSFs are others."
    if not points:
        return f"the photograph holds {misfit:.1f} times its noise, and no point explains any of it: {why}"
    share = f"{unexplained:.0%} of" if unexplained < 1 else "more than"
    return (
        f"these points leave {misfit:.1f} times the noise of the photograph, {share} what is seen of them: "
        f"{why} Places may be off by more than their deviations."
    )


def _of_film(desk: Desk, files: PointFiles, options: PointOptions) -> Done:
    """Tell the points of each volume of a film; how bright one must be goes by the brightest of all."""
    film = Film(files.volume)
    grid = film.grid
    if grid is None or grid.shape[0] < 2:
        raise FileError(files.volume, "is a film of pictures; points in depth are found in one of volumes.")
    if files.fit:
        raise BenchError("--fit is for the volume of one photograph: leave it out for a film.")
    lines, numbers = [f"frame,{'time_s' if film.period_s else 'frame_number'},{_COLUMNS}"], []
    refused: dict[int, str] = {}
    with desk.step("Pictures", len(film)) as advance:
        top = 0.0
        for place in range(len(film)):
            top = max(top, float(_brightest(film.whole(place))))
            advance(0, len(film), note="the brightest of all")
        for place, (index, at) in enumerate(zip(film.indices, film.times_s, strict=True)):
            volume = film.whole(place)
            own = _brightest(volume)
            told: list[str] = []
            if own > 0 and (least := options.least * top / own) <= 1:
                try:
                    told = _lines(point_places(volume, grid, PointOptions(least=least)))
                except InputError as error:  # the others are told nevertheless
                    refused[index] = str(error)
            lines += [f"{index},{at:.12g},{line}" for line in told]
            numbers.append(len(told))
            advance(place + 1, len(film))
    if len(refused) == len(film):
        raise InputError(next(iter(refused.values())))
    write_text(files.out, "\n".join([*lines, ""]))
    desk.fact("Volumes", str(len(film)))
    desk.fact("Points", f"{sum(numbers)}, {min(numbers)} to {max(numbers)} a volume")
    if refused:
        first = next(iter(refused.values()))
        desk.warn(
            f"Warning: no points are told of frame{'s' * (len(refused) > 1)} {ranges(list(refused))}: {first}"
        )
    elif not sum(numbers):
        desk.warn("Warning: nothing in the film is above 0.")
    if sum(numbers) and not np.isfinite(grid.z_um).all():
        desk.warn("Warning: the film does not tell where its planes are: the table has voxels alone.")
    return Done((files.out,))


def _brightest(volume: Float32Array) -> float:
    """Return the light of the brightest voxel, of all channels together."""
    grey = volume.sum(axis=3) if volume.ndim == 4 else volume
    return float(np.max(grey, where=~np.isnan(grey), initial=0.0))


def _tell_places(desk: Desk, found: PointPlaces) -> None:
    """Tell how well places are known, and the brightest."""
    if not len(found):
        return
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


def _where_from(result: StoredResult, found: PointPlaces) -> str:
    """Say what places are of."""
    from instrument.reconstruction.again import can_be_fitted

    if found.misfit is not None:
        return f"fitted to the photograph; {found.misfit:.2f} times its noise is left of it"
    if can_be_fitted(result):
        return "of the volume alone (--fit: fitted to its photograph)"
    return "of the volume alone"


def _why_unknown(result: StoredResult) -> str:
    """Say why a volume's places are not known, and what to do."""
    if result.path.suffix.lower() == ".npy":
        return "A .npy keeps no places: give the .ome.zarr or .tif that it was exported from."
    if result.volume is not None and "z_um" in {**result.record.get("grid", {}), **result.volume.facts}:
        return "It was made of PSFs from files: --pixel-um and --distance-mm of reconstruct say them."
    return "This program's .ome.zarr and .tif keep places; other programs' tell steps at most."


def _at_the_ends(ends: int, planes: int, *, fitted: bool) -> str:
    """Say what it means that so many points are brightest in an outermost plane, or lie beyond it."""
    are, they = ("is", "it") if ends == 1 else ("are", "they")
    if fitted:
        return f"{count(ends, 'point')} {are} beyond an outermost plane, by PSFs that were made for there."
    if planes == 2:
        return "the volume has two planes; points may lie beyond either of them."
    return f"{count(ends, 'point')} {are} brightest in an outermost plane; {they} may lie beyond it."


def _lines(found: PointPlaces) -> list[str]:
    """Return points as lines of CSV; what is not known is left empty."""
    numbers = np.column_stack([found.places_um, found.deviations_um, found.light, found.voxels])
    fitted = int(found.misfit is not None)
    return [
        ",".join([*(f"{value:.7g}" if np.isfinite(value) else "" for value in row), f"{int(end)},{fitted}"])
        for row, end in zip(numbers, found.at_end, strict=True)
    ]
