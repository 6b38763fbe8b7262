"""The noise of a single frame by the photon-transfer curve, as a sweep's frames tell it.

The variance of a pixel from frame to frame is ``read^2 + g * light`` in counts, with ``g`` counts an electron
(Janesick, *Photon Transfer*, 2007). Dark frames tell the first, the bright pixels of the PSFs the second.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from recon.arrays import Float32Array

Float = Float32Array

_PIXELS = 250_000  # enough of them tell a variance
_BRIGHT = 0.9  # quantile above which a pixel's light is looked at


@dataclass(frozen=True, slots=True)
class FrameNoise:
    """Of one frame, after binning; colours together."""

    electrons: float
    """At the brightest pixel of the PSFs on the axis, in the median."""
    read_e: float
    """Standard deviation of a pixel in the dark, electrons."""
    counts_per_electron: float
    """Of the camera's pixels."""


@dataclass
class PhotonTransfer:
    """Looks at a sweep's points one after the other."""

    dark_variance: float
    """Of a pixel in the dark from frame to frame, counts squared; nan where no two dark frames are known."""
    binning: int = 1
    _gains: list[float] = field(default_factory=list)
    _brightest: list[float] = field(default_factory=list)
    _colours: int = 1

    def look(self, frames: Float, light: Float, *, still: bool, off_axis: bool) -> None:
        """Take a point's frames (n_frames, height, width[, 3]) and its light (n_channels, height, width).

        Frames that were not ``still`` were put onto one another, which smooths their noise: they tell none.
        """
        if len(frames) > 1 and still:
            some = frames[:, :: max(1, frames[0].size // _PIXELS)]
            mean = some.mean(axis=0)
            bright = mean >= np.quantile(mean, _BRIGHT)
            variance = float(some[:, bright].var(axis=0, ddof=1).mean(dtype=np.float64))
            self._gains.append((variance - self.dark_variance) / float(mean[bright].mean(dtype=np.float64)))
        if not off_axis:
            self._colours = len(light)
            self._brightest.append(float(light.sum(axis=0).max()))

    def found(self) -> FrameNoise | None:
        """Return what all points together tell; None where there are no two frames of one, or of the dark."""
        gain = float(np.median(self._gains)) if self._gains else float("nan")
        if not (gain > 0 and np.isfinite(gain) and self._brightest):
            return None
        pixels = self.binning**2
        return FrameNoise(
            float(np.median(self._brightest)) * pixels / gain,
            float(np.sqrt(self.dark_variance * pixels * self._colours)) / gain,
            gain,
        )
