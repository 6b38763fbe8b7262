"""Writing a reconstruction: the numbers, a picture or a page of views to look at, and how it came about."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from instrument.files.atomic import check_writable, write_json, write_text
from instrument.files.errors import FileError
from instrument.files.figures import check_figure, save_figure
from instrument.files.images import write_image
from instrument.files.ome_zarr import is_zarr_name, stem_of
from instrument.files.record import plain
from instrument.files.seen import as_seen, levels_of
from instrument.reconstruction.job import Job
from instrument.volumes.grid_facts import grid_facts, uneven_steps
from instrument.volumes.writing import write_volume_tiff, write_volume_zarr
from recon.camera.grid import Grid
from recon.reconstruction.point_errors import PointErrors
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.uncertainty import Uncertainty


@dataclass(frozen=True, slots=True)
class Outputs:
    """The files of one reconstruction: float32 TIFF, 8-bit preview, settings and history, and optional ones.

    Those are a figure, a float32 TIFF of standard deviations, a table of points, and without a verdict one of
    what is left of the data. A volume may be an OME-Zarr folder instead of a TIFF.
    """

    image: Path
    preview: Path
    record: Path
    figure: Path | None = None
    deviation: Path | None = None
    points: Path | None = None
    residual: Path | None = None

    @classmethod
    def named(
        cls, out: Path, figure: Path | None = None, *, volume: bool = False, uncertainty: bool = False
    ) -> Outputs:
        """Return the files that go with ``out``, whose suffix must be ``.tif`` (volumes: or ``.ome.zarr``).

        With ``uncertainty`` a picture's standard deviations and points are among them. Raises FileError.
        """
        if figure is not None:
            check_figure(figure)
        if volume and is_zarr_name(out):
            if not (stem := stem_of(out)):
                raise FileError(out, "has no name before its suffix.", "Call it volume.ome.zarr, say.")
            record, residual = out.with_name(f"{stem}.json"), out.with_name(f"{stem}-residual.tif")
            return cls(out, out.with_name(f"{stem}.png"), record, figure, residual=residual)
        if out.suffix.lower() not in (".tif", ".tiff"):
            raise FileError(
                out,
                "a volume is written as OME-TIFF or OME-Zarr: the name must end in .tif or .ome.zarr."
                if volume
                else "a picture is written as float32 TIFF: the name must end in .tif (a volume, by "
                "--volume, may be .ome.zarr).",
                "A preview .png and a .json with the settings are written beside it.",
            )
        deviation = out.with_name(f"{out.stem}-deviation{out.suffix}") if uncertainty else None
        points = out.with_name(f"{out.stem}-points.csv") if uncertainty else None
        residual = out.with_name(f"{out.stem}-residual{out.suffix}")
        preview, record = out.with_suffix(".png"), out.with_suffix(".json")
        outputs = cls(out, preview, record, figure, deviation, points, residual)
        if figure in outputs.files()[:3]:
            raise FileError(out.with_suffix(".png"), "is the preview; give the figure another name.")
        return outputs

    def files(self) -> tuple[Path, ...]:
        """Return every file that will be written."""
        files = self.image, self.preview, self.record, self.figure, self.deviation, self.points, self.residual
        return tuple(p for p in files if p is not None)

    def written(self, result: Reconstruction) -> tuple[Path, ...]:
        """Return the files that a result was written to: points and residual are not in every one."""
        found = result.uncertainty
        left_out = (
            None if found is not None else self.deviation,
            None if found is not None and found.points is not None else self.points,
            None if result.residual is not None else self.residual,
        )
        return tuple(p for p in self.files() if p not in left_out)

    def check(self, n_pixels: int, *, overwrite: bool = False) -> None:
        """Refuse places that cannot be written, or are taken, before the work.

        Raises FileError.
        """
        for path in self.files():
            folder = is_zarr_name(path)
            # The place of a folder is as good as that of a file in it that is not there yet.
            check_writable(
                path.with_name(f".{path.name}.draft") if folder else path, 8 * n_pixels + 1_000_000
            )
            if folder and path.exists() and not (path / "zarr.json").is_file():
                raise FileError(
                    path, "is there and is no Zarr folder; it was left as it is.", "Name another."
                )
            if path.exists() and not overwrite:
                raise FileError(path, "exists already and was left as it is.", "Use --force to overwrite it.")


def _take_away_others(outputs: Outputs, result: Reconstruction) -> None:
    """Remove files of an older result that was overwritten, where this one has no such file."""
    written = outputs.written(result)
    for path in outputs.files():
        if path not in written and path != outputs.figure:
            path.unlink(missing_ok=True)


def write_reconstruction(outputs: Outputs, result: Reconstruction, job: Job, *, rotate_deg: int = 0) -> None:
    """Write image, preview and record, each whole or not at all.

    ``rotate_deg``, a multiple of 90, turns the written picture counter-clockwise.

    Raises FileError or OSError when a file cannot be written (a full disk), naming it.
    """
    image = np.rot90(result.image, rotate_deg // 90)
    write_image(outputs.image, image, {"simulated": job.simulated, "record": outputs.record.name})
    levels = levels_of(image)
    write_image(outputs.preview, as_seen(image, levels))
    if outputs.deviation is not None and result.uncertainty is not None:
        deviation = np.rot90(result.uncertainty.deviation[0], rotate_deg // 90)
        write_image(outputs.deviation, deviation, {"simulated": job.simulated, "record": outputs.record.name})
        if outputs.points is not None and result.uncertainty.points is not None:
            write_text(outputs.points, _table(result.uncertainty.points, result.grid, rotate_deg))
    _write_residual(outputs, result, job, rotate_deg)
    record = reconstruction_record(result, job, volume=False) | {
        "uncertainty": _of_uncertainty(result.uncertainty, outputs),
        "residual": None if result.residual is None else outputs.written(result)[-1].name,
        "rotated_deg": rotate_deg,
        "preview": levels.to_json(),
    }
    write_json(outputs.record, record)
    _take_away_others(outputs, result)


def _write_residual(outputs: Outputs, result: Reconstruction, job: Job, rotate_deg: int = 0) -> None:
    """Write what is left of the data, in units of their noise, where no verdict says what that is worth."""
    if outputs.residual is not None and result.residual is not None:
        about = {"simulated": job.simulated, "record": outputs.record.name}
        write_image(outputs.residual, np.rot90(result.residual, rotate_deg // 90), about)


def picture_grid(grid: Grid) -> dict[str, Any]:
    """Return where a picture's pixels lie, JSON-compatible: None for what is not known."""

    def known(value: float) -> float | None:
        return float(value) if np.isfinite(value) else None

    return {
        "shape": grid.shape[1:],
        "centre": grid.centre,
        "sensor_pitch_um": grid.sensor_pitch_um,
        "object_pitch_um": known(grid.pitch_um[0]),
        "pixel_mrad": known(grid.pixel_mrad),
        "z_um": known(grid.z_um[0]),
    }


def reconstruction_record(result: Reconstruction, job: Job, *, volume: bool) -> dict[str, Any]:
    """Return all that is known of a picture or volume but its pixels, JSON-compatible."""
    record = {
        "program": f"diffuserbench {version('diffuserbench')}",
        "utc": datetime.now(UTC).isoformat(timespec="seconds"),
        "simulated": job.simulated,
        "inputs": job.provenance,
        "model": result.model,
        "model_reason": result.reason,
        "method": result.solver,
        "prior": result.prior,
        "tau": result.tau,
        "background_estimated": result.background is not None,
        "noise_norm": result.noise_norm,
        "seconds": result.seconds,
        "warnings": [*job.warnings, *result.warnings],
        "verdict": None if result.verdict is None else result.verdict.as_json(),
        "provenance": result.provenance,
        **(_of_volume(result) if volume else _of_picture(result)),
    }
    written: dict[str, Any] = plain(record)
    return written


def _of_picture(result: Reconstruction) -> dict[str, Any]:
    return {
        "stop_reason": str(result.stop_reason),
        "iterations": len(result.history),
        "grid": picture_grid(result.grid),
        "history": [asdict(entry) for entry in result.history],
    }


_COLUMNS = "row,column,light,row_deviation,column_deviation,light_deviation,x_um,y_um"


def _table(points: PointErrors, grid: Grid, rotate_deg: int) -> str:
    """Return points as CSV: rows and columns of the picture as it is written; x and y from the axis."""
    shape = grid.shape[1:]
    lines = [_COLUMNS]
    across = rotate_deg % 180 != 0
    for place, light, deviation in zip(points.places, points.light, points.deviations, strict=True):
        row, column = place
        x, y = (
            (at - n) * float(grid.pitch_um[0]) for at, n in ((column, grid.centre[1]), (row, grid.centre[0]))
        )
        height, width = shape
        for _ in range(rotate_deg // 90 % 4):
            row, column, height, width = width - 1 - column, row, width, height
        down, over = (deviation[1], deviation[0]) if across else (deviation[0], deviation[1])
        values = (row, column, light, down, over, deviation[2], x, y)
        lines.append(",".join(f"{value:.7g}" if np.isfinite(value) else "" for value in values))
    return "\n".join([*lines, ""])


def _of_uncertainty(found: Uncertainty | None, outputs: Outputs) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "file": None if outputs.deviation is None else outputs.deviation.name,
        "points": None if found.points is None or outputs.points is None else outputs.points.name,
        "sentences": found.sentences,
        "trusted": found.trusted,
        "repeats": found.repeats,
        "residual_over_noise": found.misfit,
        "seconds": found.seconds,
    }


def _of_volume(result: Reconstruction) -> dict[str, Any]:
    grid = result.grid
    return {
        "stop_reasons": [str(reason) for reason in result.stop_reasons],
        "uneven_steps": uneven_steps(grid.z_um),
        "grid": grid_facts(grid),
        "histories": [[asdict(entry) for entry in history] for history in result.histories],
    }


def write_volume(outputs: Outputs, result: Reconstruction, job: Job) -> None:
    """Write volume, page of views and record, each whole or not at all.

    A TIFF holds ``ZYX`` or ``ZCYX`` float32, an OME-Zarr ``zyx`` or ``czyx``; the name says which. OME knows
    one voxel size for all: that of the middle plane is written there; every plane's own is in the record.

    Raises FileError or OSError when a file cannot be written, naming it.
    """
    from instrument.reconstruction.result_figures import volume_figure

    if is_zarr_name(outputs.image):
        about = {"simulated": job.simulated, "record": outputs.record.name}
        write_volume_zarr(outputs.image, result.volume, result.volume.shape, result.grid, about)
    else:
        write_volume_tiff(outputs.image, result.volume, result.volume.shape, result.grid)
    page = volume_figure(result, simulated=job.simulated)
    for path in filter(None, (outputs.preview, outputs.figure)):
        save_figure(page, path)
    _write_residual(outputs, result, job)
    write_json(outputs.record, reconstruction_record(result, job, volume=True))
    _take_away_others(outputs, result)
