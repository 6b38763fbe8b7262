"""The bench as display procedures see it: show an SLM field, photograph it, background subtracted."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.bench import Bench
from instrument.files.atomic import check_writable
from instrument.files.errors import BenchError, FileError
from instrument.files.slm_correction import SlmCorrection
from instrument.files.slm_image import phase_levels
from instrument.reconstruction.preparation import darkest_block
from instrument.runs.folder import dated_name, free_name

Array = npt.NDArray[Any]


class DisplayBench:
    """Shows fields on the bench's SLM and counts the frames taken.

    Parameters
    ----------
    bench : Bench
        Open, with SLM and camera.
    binning : int
        SLM pixels used as one.
    correction : SlmCorrection
        Look-up table and flatness, applied here and nowhere else.
    estimate_background : bool
        For a laser that nobody can switch off: the background is not measured but estimated, the mean of the
        first photograph's darkest 10 x 10 pixels.
    check : callable, optional
        Called before anything is shown or photographed; what it raises ends that, e.g. ``RunControl.check``.
    """

    def __init__(
        self,
        bench: Bench,
        binning: int,
        correction: SlmCorrection | None = None,
        *,
        estimate_background: bool = False,
        check: Callable[[], object] | None = None,
    ) -> None:
        if bench.slm is None:
            raise BenchError(f"{bench.label} has no [slm].")
        self.bench = bench
        self.slm = bench.slm
        self.binning = binning
        self.correction = correction or SlmCorrection.ideal()
        self.estimates_background = estimate_background
        self._check = check or (lambda: None)
        self.frames = 0
        self._dark: tuple[tuple[float, ...], Array | float] | None = None

    def show(self, field: Array) -> None:
        """Show the phase of an SLM field, complex (height, width) in binned pixels."""
        self._check()
        self.slm.display(self.correction.apply(phase_levels(np.angle(field), self.binning)))

    def show_levels(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels as they are, uncorrected, (height, width) of the whole SLM."""
        self._check()
        self.slm.display(levels)

    def photograph(self, exposure_ms: float) -> Array:
        """Return counts a millisecond, background subtracted, float64: one frame, and a dark one at first.

        The dark level is measured once with the laser off (or estimated with it on), at the first exposure
        asked for; its part that grows with time is small against it.
        """
        self._check()
        camera = self.bench.camera
        low, high = camera.exposure_limits_ms
        exposure = camera.set_exposure_ms(float(np.clip(exposure_ms, low, high)))
        key = (camera.gain, float(camera.binning), *map(float, camera.roi.as_tuple()))
        if self.estimates_background:
            self.bench.scene_on()
            frame = self._snap()
            if self._dark is None or self._dark[0] != key:
                self._dark = key, darkest_block(frame)
            return (frame - self._dark[1]) / exposure
        if self._dark is None or self._dark[0] != key:
            self.bench.scene_off()
            self._dark = key, self._snap()
            self._check()
        self.bench.scene_on()
        return (self._snap() - self._dark[1]) / exposure

    def _snap(self) -> Array:
        self.frames += 1
        return np.asarray(self.bench.snap().image, np.float64)


def approach_from_below(stage: Stage, target: Mapping[str, float]) -> None:
    """Move to a place so that every axis ends upwards: the play of its screw is then always on one side."""
    limits = stage.limits
    play = {name: 5.0 if name.endswith("_um") else 0.1 for name in target}
    stage.move_to({name: max(value - play[name], limits[name][0]) for name, value in target.items()})
    stage.move_to(target)


def bring_mask(bench: Bench, place: Mapping[str, float]) -> None:
    """Bring the mask's stage to where an alignment left it, homing it where it has lost its reference.

    An empty place moves nothing.

    Raises
    ------
    BenchError
        When there is a place and no stage.
    DeviceError
        When the stage refuses or fails.
    """
    if not place:
        return
    if bench.stage is None:
        raise BenchError(f"{bench.label} has no [stage] to bring the mask to its place.")
    if not bench.stage.is_homed:
        bench.stage.home()
    approach_from_below(bench.stage, place)


# Files ------------------------------------------------------------------------------------------------
def require_slm(bench: Bench) -> Slm:
    """Return the bench's SLM; BenchError where it has none."""
    if bench.slm is None:
        raise BenchError(f"{bench.label} has no [slm].")
    return bench.slm


def refuse_existing(file: Path | None, *, overwrite: bool) -> None:
    """Refuse to write over a file that nobody allowed to be replaced.

    Raises
    ------
    FileError
        When it exists.
    """
    if file is not None and file.exists() and not overwrite:
        raise FileError(file, "exists already.", "Choose another name, or overwrite with --force.")


def writable(bench: Bench, folder: Path | None, out: Path | None, label: str) -> Path:
    """Return the file to write in the end, by default one with a date, sure now that it can be written."""
    if out is None:
        where = folder or bench.config.data_folder
        where.mkdir(parents=True, exist_ok=True)
        out = free_name(where, dated_name(label), ".json")
    check_writable(out)
    return out
