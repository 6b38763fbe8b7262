"""What the camera's demo made, and how good it is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from calibration_routines.demos.measured import Measured
from calibration_routines.demos.picture import Comparison
from calibration_routines.demos.settings import DemoSettings
from calibration_routines.demos.volume import Placed
from instrument.evaluation.chart import ChartData
from recon import Reconstruction


@dataclass(frozen=True, slots=True)
class DemoResult:
    """What the demo made and how good it is."""

    folder: Path
    settings: DemoSettings
    measured: Measured
    reconstruction: Reconstruction
    comparison: Comparison
    """Of the reconstruction with the ground truth, inside the picture on the screen."""
    volume: Reconstruction
    placed: Placed
    """Where the second scene's lights are, and were found."""
    chart: ChartData
    seconds: dict[str, float]
    """Seconds of each stage."""
    files: dict[str, Path]
    """What it is, and where."""
