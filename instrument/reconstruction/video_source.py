"""Whether a run is a video: frames that follow one another, of one scene, with light."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.frame import FrameMetadata
from instrument.files.calibration_file import is_calibration
from instrument.files.errors import FileError
from instrument.runs.run import Run
from recon.base.blocks import block_mean
from recon.base.noise import estimate_deviation

_BLOCK = 8
"""Pixels along a side over which light is averaged to tell it from noise."""

LIT = 2.0
"""Variance of block means from which a frame has light, in units of what its pixels' noise makes of it."""

STILL = {"um": 0.5, "mrad": 0.02}
"""How far readings of a stage that stands may lie apart, by the unit that an axis' name ends in.

A mask 25 mm wide that turns by 0.02 mrad moves by 0.25 um at its edges: less than any pixel.
"""

_SAME: dict[str, Callable[[FrameMetadata], object]] = {
    "light": lambda m: m.led_pattern,
    "pattern on the SLM": lambda m: m.slm_image_hash,
    "exposure": lambda m: m.exposure_ms,
    "gain": lambda m: m.gain,
}
"""What all frames of a planned run must share to be a video of one scene, besides the stage's position."""


def require_video(run: Run) -> None:
    """Refuse a run that is no video: frames of a plan that moves or lights something, or a calibration.

    A recording is one; so is a plan that takes the same photograph again and again.

    Raises
    ------
    FileError
        With what differs from frame to frame, and what to do.
    """
    if not run.records:
        raise FileError(run.path, "has no frames to reconstruct.")
    planned = run.plan is not None
    if is_calibration(run.path) or (planned and any(run.path.glob("*/calibration.json"))):
        raise FileError(
            run.path,
            "holds a calibration: it is no video of a scene.",
            "Give the recording as RUN and this as --calibration: were the two swapped?",
        )
    if not planned:
        return
    frames = [record.metadata for record in run.records.values()]
    differing = [] if _stands([frame.stage_position for frame in frames]) else ["stage position"]
    differing += [what for what, of in _SAME.items() if len({of(frame) for frame in frames}) > 1]
    if differing:
        raise FileError(
            run.path,
            f"is the run of a plan, no video: its frames differ in {' and '.join(differing)}.",
            "Record a video with 'diffuserbench record'. Single frames: 'diffuserbench export' writes them, "
            "'reconstruct --image' takes each.",
        )


def _stands(positions: Sequence[Mapping[str, float]]) -> bool:
    """Tell whether all positions have the same axes, each at one place as far as readings tell."""
    axes = set(positions[0])
    if any(set(position) != axes for position in positions):
        return False
    for axis in axes:
        readings = [position[axis] for position in positions]
        # An axis of another unit has no tolerance.
        if not np.ptp(readings) <= STILL.get(axis.rsplit("_", 1)[-1], 0.0):
            return False
    return True


def has_light(frame: npt.NDArray[Any], deviation: npt.NDArray[Any]) -> bool:
    """Tell whether there is more in a frame than noise.

    Noise of single pixels goes away where pixels are averaged, a scene through a diffuser does not: the
    variance of the means of 8 x 8 pixels is compared with what noise leaves of it. Noise grows with light: a
    frame dimmer than the one that ``deviation`` was found on has less, which it tells itself.

    Parameters
    ----------
    frame : ndarray, (height, width) or (height, width, n_channels)
        Counts less dark.
    deviation : ndarray, (n_channels,)
        Of the noise, counts; that of another frame of the same camera is enough.
    """
    channels = frame[None] if frame.ndim == 2 else np.moveaxis(frame, 2, 0)
    height, width = (n // _BLOCK for n in channels.shape[1:])
    if min(height, width) < 2:
        return True  # too few blocks to tell
    means = block_mean(channels, _BLOCK, dtype=np.float64)
    spread = means.var(axis=(1, 2)) * _BLOCK**2
    given = np.asarray(deviation, np.float64).reshape(-1)
    if (spread > LIT * given**2).any():
        return True
    own = np.array([estimate_deviation(channel) for channel in channels])
    return bool(((own > 0) & (spread > LIT * own**2)).any())  # 0 is no estimate: most pixels are alike
