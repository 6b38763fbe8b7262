"""What makes a run a sweep: ``sweep.json``, which says what its frames are for."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from calibration_routines.errors import CalibrationError
from calibration_routines.psf.exposure import AutoExposure, ExposureOutcome, ExposureTrial, SweepExposures
from calibration_routines.psf.sampling import Position
from calibration_routines.psf.sweep_options import AxialSweep, PointSweep, Sweep
from instrument.files.atomic import write_text
from recon.base.declare import options_of
from recon.types import Geometry

SWEEP_FILE = "sweep.json"
"""In the run's folder, beside the files of any run."""
RETAKES_FILE = "retakes.json"
"""Beside it, once a point was taken again: which, and in which run."""


@dataclass(frozen=True, slots=True)
class SweepRecord:
    """What ``sweep.json`` keeps: all that the analysis needs besides the frames."""

    sweep: Sweep
    exposures: SweepExposures
    geometry: Geometry
    bench: str
    simulated: bool


def is_sweep(run: Path | str) -> bool:
    """Whether a run's frames are those of a sweep."""
    return (Path(run) / SWEEP_FILE).is_file()


def rebinned(sweep: Sweep, binning: int) -> Sweep:
    """Return the sweep with another software binning."""
    return replace(_known(sweep), binning=binning)


def sweep_json(sweep: Sweep) -> dict[str, Any]:
    """Return a sweep's settings as JSON-compatible values."""
    left_out = {o.name for o in options_of(_known(sweep)) if not o.declaration.recorded}
    kept = {name: value for name, value in asdict(_known(sweep)).items() if name not in left_out}
    return kept | {"kind": sweep.kind}


def to_json(record: SweepRecord) -> str:
    """Return the text of ``sweep.json``."""
    found = [
        asdict(one) | {"z_um": z_um, "outcome": one.outcome.value} for z_um, one in record.exposures.found
    ]
    data = {
        "sweep": sweep_json(record.sweep),
        "exposures_ms": list(record.exposures.exposures_ms),
        "found": found,
        "geometry": asdict(record.geometry),
        "bench": record.bench,
        "simulated": record.simulated,
    }
    return json.dumps(data, indent=1) + "\n"


def read_record(run: Path) -> SweepRecord:
    """Read the ``sweep.json`` of a run's folder.

    Raises
    ------
    CalibrationError
        When there is none, or it is damaged.
    """
    path = run / SWEEP_FILE
    if not is_sweep(run):
        raise CalibrationError(f"{run} is no sweep: it has no {SWEEP_FILE}.")
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        settings = dict(data["sweep"])
        sweep: Sweep
        if settings["kind"] == AxialSweep.kind:
            settings.pop("kind")
            sweep = AxialSweep(**settings)
        else:
            settings["points_um"] = tuple((x, y, z) for x, y, z in settings["points_um"])
            sweep = PointSweep(**settings)
        found = []
        for one in data["found"]:
            z_um = one.pop("z_um")
            trace = tuple(ExposureTrial(**trial) for trial in one.pop("trace"))
            outcome = ExposureOutcome(one.pop("outcome"))
            found.append((z_um, AutoExposure(outcome=outcome, trace=trace, **one)))
        geometry = dict(data["geometry"])
        if geometry["aperture_mm"] is not None:
            geometry["aperture_mm"] = tuple(geometry["aperture_mm"])
        exposures = SweepExposures(tuple(data["exposures_ms"]), tuple(found))
        return SweepRecord(sweep, exposures, Geometry(**geometry), data["bench"], data["simulated"])
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} cannot be read ({error}): it was changed or damaged. The frames beside it are not "
            "touched; take the sweep again, or restore the file from a copy."
        ) from error


def add_retakes(run: Path, points_um: Iterable[Position], retake: str) -> None:
    """Keep that points of the sweep in folder ``run`` were taken again in the run named ``retake``."""
    entries = [{"point_um": list(point), "run": name} for point, name in read_retakes(run)]
    entries += [{"point_um": list(point), "run": retake} for point in points_um]
    write_text(run / RETAKES_FILE, json.dumps(entries, indent=1) + "\n")


def read_retakes(run: Path) -> list[tuple[Position, str]]:
    """Return which points were taken again in which run beside this one, in the order of time.

    Raises
    ------
    CalibrationError
        When the file is damaged.
    """
    path = run / RETAKES_FILE
    if not path.exists():
        return []
    try:
        entries = json.loads(path.read_text(encoding="utf-8"))
        found: list[tuple[Position, str]] = []
        for entry in entries:
            x, y, z = (float(v) for v in entry["point_um"])
            found.append(((x, y, z), str(entry["run"])))
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise CalibrationError(
            f"{path} cannot be read ({error}): it was changed or damaged. Without it the sweep's first takes "
            "count: remove the file, or restore it from a copy."
        ) from error
    return found


def _known(sweep: Sweep) -> AxialSweep | PointSweep:
    if not isinstance(sweep, AxialSweep | PointSweep):
        raise TypeError(f"{type(sweep).__name__} is no sweep that this program keeps.")
    return sweep
