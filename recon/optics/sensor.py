"""An image sensor: photons in, counts out, with every noise source of its photon-transfer curve.

For a pixel that receives ``P`` photons a second during ``t`` seconds (EMVA 1288's linear model):

* charge: Poisson of ``QE P t (1 + PRNU) + dark t``, limited by the full well;
* read-out: plus Gaussian read noise and the pixel's fixed offset, times gain, divided by the conversion gain
  (full well over full scale), plus the black level, rounded and clipped to the bit depth.

Binning sums the charge of ``b x b`` pixels that are each read with their own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array
from recon.base.blocks import block_mean, block_sum
from recon.base.threads import in_blocks
from recon.optics.sensor_kernel import expose_pixels


@dataclass(frozen=True, slots=True)
class SensorSpec:
    """What a data sheet says about a sensor.

    ``quantum_efficiency`` is for the red, green and blue bands. The fractions of hot and dead pixels count
    pixels; ``prnu`` is the relative spread of the pixels' response, ``dsnu_e`` the spread of their offsets in
    electrons, ``dark_spread`` the relative (log-normal) spread of their dark currents.
    """

    name: str
    shape: tuple[int, int]
    pitch_um: float
    quantum_efficiency: tuple[float, float, float]
    full_well_e: float
    read_noise_e: float
    dark_current_e_per_s: float
    prnu: float
    dsnu_e: float
    bits: int
    dark_spread: float = 0.3
    hot_fraction: float = 1e-4
    hot_current_e_per_s: float = 1000.0
    dead_fraction: float = 2e-5
    black_level: float = 0.0015
    """As a fraction of full scale."""
    exposure_limits_ms: tuple[float, float] = (0.05, 20_000.0)
    frames_per_s: float = 30.0


@dataclass(frozen=True, slots=True)
class FixedPattern:
    """One sensor's pixels as they came out of the fab (all ``(h, w)`` float32)."""

    response: Float32Array
    """Relative response; 0 for dead pixels. Binned: the mean of the pixels summed."""
    dark_e_per_s: Float32Array
    offset_e: Float32Array

    def binned(self, factor: int) -> FixedPattern:
        """Sum ``factor x factor`` pixels; a rest at the lower and right border is left out."""
        if factor == 1:
            return self
        return FixedPattern(
            block_mean(self.response, factor),
            block_sum(self.dark_e_per_s, factor),
            block_sum(self.offset_e, factor),
        )

    def cropped(self, rows: slice, columns: slice) -> FixedPattern:
        """Cut a region out."""
        return FixedPattern(
            np.ascontiguousarray(self.response[rows, columns]),
            np.ascontiguousarray(self.dark_e_per_s[rows, columns]),
            np.ascontiguousarray(self.offset_e[rows, columns]),
        )


def fixed_pattern(spec: SensorSpec, seed: int) -> FixedPattern:
    """Draw the pixels of a sensor; the same seed gives the same sensor."""
    rng = np.random.default_rng(seed)
    shape = spec.shape
    response = 1 + np.float32(spec.prnu) * rng.standard_normal(shape, np.float32)
    response[rng.random(shape, np.float32) < spec.dead_fraction] = 0
    spread = spec.dark_spread
    dark = np.exp(np.float32(spread) * rng.standard_normal(shape, np.float32) - np.float32(spread**2 / 2))
    dark *= np.float32(spec.dark_current_e_per_s)
    hot = rng.random(shape, np.float32) < spec.hot_fraction
    dark[hot] += rng.exponential(spec.hot_current_e_per_s, int(hot.sum())).astype(np.float32)
    # Half of the offset's variance is common to a column: its amplifier.
    share = np.float32(spec.dsnu_e / np.sqrt(2))
    offset = share * rng.standard_normal(shape, np.float32)
    offset += share * rng.standard_normal(shape[1], np.float32)
    return FixedPattern(np.maximum(response, 0), dark, offset)


@dataclass(frozen=True, slots=True)
class Readout:
    """How the charge becomes counts.

    ``electrons_per_count`` is the conversion at gain 1, ``noise_scale`` multiplies all temporal noise
    (1: physical, 0: none).
    """

    electrons_per_count: float
    gain: float
    black_level: float
    full_scale: int
    full_well_e: float
    read_noise_e: float
    noise_scale: float = 1.0


def expose(
    electrons_per_s: Float32Array,
    pattern: FixedPattern,
    exposure_s: float,
    readout: Readout,
    seed: int,
) -> npt.NDArray[np.uint16]:
    """Take one exposure.

    Parameters
    ----------
    electrons_per_s : ndarray, float32, (h, w)
        Photons absorbed a second by a pixel of average response.
    pattern : FixedPattern
        Of the same shape.
    exposure_s : float
    readout : Readout
    seed : int
        Draws of the temporal noise; another seed, another frame.
    """
    counts = np.empty(electrons_per_s.shape, np.uint16)

    def rows(start: int, stop: int) -> None:
        expose_pixels(
            electrons_per_s,
            pattern.response,
            pattern.dark_e_per_s,
            pattern.offset_e,
            exposure_s,
            readout.gain / readout.electrons_per_count,
            readout.black_level,
            readout.full_scale,
            readout.full_well_e,
            readout.read_noise_e,
            readout.noise_scale,
            np.uint64(seed & 0xFFFF_FFFF_FFFF_FFFF),
            counts,
            start,
            stop,
        )

    in_blocks(rows, len(counts), grain=64)
    return counts
