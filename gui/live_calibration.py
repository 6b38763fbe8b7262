"""Which calibration the live reconstruction begins with, and the depths that one offers."""

from __future__ import annotations

import contextlib
from pathlib import Path

import numpy as np

from instrument.bench.kept import KeptWithBench
from instrument.files.calibration_file import find_calibration, is_calibration, newest_calibration
from instrument.files.errors import BenchError
from recon.camera.camera_model import members_of_depths
from recon.types import Calibration


def last_or_newest(kept: KeptWithBench, folder: Path) -> Path | None:
    """Return the calibration that worked last with this bench; the newest where there is none any more."""
    with contextlib.suppress(BenchError):  # whoever opens the bench says so
        kept.read()
    last = kept.of("live").get("calibration")
    return Path(last) if last and is_calibration(Path(last)) else newest_calibration(folder)


def calibration_of(run: Path) -> Path | None:
    """Return the calibration that a run is or holds, if there is one."""
    return find_calibration(run) if is_calibration(run) or any(run.glob("*/calibration.json")) else None


def depths_um(calibration: Calibration) -> list[float]:
    """Return the depths to choose from, ascending; none where there is but one, or none is known."""
    z_um = calibration.source_positions_um[:, 2]
    groups = members_of_depths(calibration.source_positions_um)  # a stage does not come back to the same z
    depths = sorted(float(z_um[group[0]]) for group in groups if np.isfinite(z_um[group[0]]))
    return depths if len(depths) > 1 else []
