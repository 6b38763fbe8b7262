"""What the data alone tell about a reconstruction: light, misfit, load, missing pixels.

Nothing here knows the truth. Everything is relative, so that it means the same at any exposure and size.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base import fft
from recon.verdict.content import lit_and_edges, points_of

Array = npt.NDArray[Any]

NEAR_PX = 2
"""Shifts up to here belong to the PSF's own sharpness."""
NO_LESS = 1e-4
"""Least variance of the signal in units of the noise', so that ratios to it stay finite."""
RING = (0.1, 0.25)
"""Spatial frequencies of details, cycles a pixel: periods from ten to four pixels."""


@dataclass(frozen=True, slots=True)
class Evidence:
    """What was measured.

    Attributes
    ----------
    signal : float
        Standard deviation of the measurement over its pixels, less the noise', in units of the noise: what
        there is to reconstruct from.
    detail : float
        Signal over noise of the picture's details of four to ten pixels, as the camera transmits them: root
        of the power of the picture times the PSF's on that ring of frequencies, over the noise'.
    unexplained : float
        Residual beyond the expected noise, relative to the measurement's standard deviation without noise:
        what the model does not describe (a moved diffuser, another depth or colour, stray light, saturation).
    erased, saturated : float
        Shares of the pixels: not used; used though at full scale.
    lit, edges : float
        Shares of the voxels that are not dark, and that differ from a neighbour.
    load : float
        Unknowns a measured pixel: lit voxels or edges, whichever are fewer, over the pixels used.
    planes : int
        Depths.
    similarity : float
        Greatest inner product of PSFs of neighbouring depths; 0 for one depth.
    dimming : float
        Least norm of a depth's PSF relative to the greatest: how much dimmer the farthest points are.
    ambiguity : float
        Greatest correlation of a PSF with itself, three pixels or more apart: near 1 for a regular array.
    unsettled : float
        Change of the last iteration over ten times the tolerance, where a limit ended the run; else 0.
    height, peaks, ends : float or None
        Of the bright points of a volume (:class:`~recon.verdict.content.Points`); None of a picture.
    """

    signal: float
    detail: float
    unexplained: float
    erased: float
    saturated: float
    lit: float
    edges: float
    load: float
    planes: int
    similarity: float
    dimming: float
    ambiguity: float
    unsettled: float
    height: float | None = None
    peaks: float | None = None
    ends: float | None = None

    def as_json(self) -> dict[str, float]:
        """Return the numbers by name, but for those that were not measured."""
        values = ((field.name, getattr(self, field.name)) for field in fields(self))
        return {name: float(value) for name, value in values if value is not None}


@dataclass(frozen=True, slots=True)
class Observation:
    """One channel of what the camera saw.

    Attributes
    ----------
    data : ndarray, (height, width)
        Measurement, background subtracted, in units of its noise.
    valid : ndarray of bool, (height, width)
    noise : float
        Its deviation, counts.
    saturated : float
        Share of the valid pixels at full scale.
    """

    data: Array
    valid: npt.NDArray[np.bool_]
    noise: float
    saturated: float = 0.0


def measure(
    seen: Observation,
    volume: Array,
    psfs: Array,
    residual_norm: float,
    *,
    unsettled: float,
    points: bool = False,
) -> Evidence:
    """Measure a reconstruction of one channel.

    Parameters
    ----------
    seen : Observation
    volume : ndarray, (n_z, rows, columns)
        The result: ``measurement = sum_z PSF_z * volume_z``.
    psfs : ndarray, (n_z, height, width)
        On-axis PSFs as calibrated.
    residual_norm : float
        ``||A x - b||`` over the valid pixels, in units of the noise.
    unsettled : float
    points : bool
        Whether to look for its bright points as well.
    """
    data, noise = seen.data, seen.noise
    used = data[seen.valid].astype(np.float64)
    signal2 = max(float(np.var(used)) - 1.0, NO_LESS)
    beyond2 = max(residual_norm**2 / len(used) - 1.0, 0.0)
    lit, edges = lit_and_edges(volume)
    found = points_of(volume, _norms(psfs) / noise, len(used)) if points else None
    return Evidence(
        signal=float(np.sqrt(signal2)),
        detail=_detail(volume, psfs, noise, len(used)),
        unexplained=float(np.sqrt(beyond2 / signal2)),
        erased=1.0 - len(used) / data.size,
        saturated=seen.saturated,
        lit=lit,
        edges=edges,
        load=min(lit, edges) * volume.size / len(used),
        planes=len(volume),
        similarity=_similarity(psfs),
        dimming=_dimming(psfs),
        ambiguity=_ambiguity(psfs[len(psfs) // 2]),
        unsettled=unsettled,
        height=None if found is None else found.height,
        peaks=None if found is None else found.peaks,
        ends=None if found is None else found.ends,
    )


def _detail(volume: Array, psfs: Array, noise: float, count: int) -> float:
    """Signal over noise of what a picture's finer half throws onto ``count`` pixels."""
    shape = fft.fast_shape([a + b for a, b in zip(volume.shape[1:], psfs.shape[1:], strict=True)])
    y, x = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    frequency = np.hypot(y, x)
    ring = (frequency > RING[0]) & (frequency < RING[1])
    if not ring.any():  # a picture of a few pixels has no such frequency
        return 0.0
    thrown = np.zeros(int(np.count_nonzero(ring)), np.complex64)
    padded = np.zeros((2, *shape), np.float32)
    spectra = np.empty(fft.spectrum_shape(padded.shape), np.complex64)
    for plane, psf in zip(volume, psfs, strict=True):
        padded[0, : plane.shape[0], : plane.shape[1]] = plane
        padded[1, : psf.shape[0], : psf.shape[1]] = psf / noise
        fft.rfft(padded, out=spectra)
        thrown += spectra[0][ring] * spectra[1][ring]
    # White noise of deviation 1 on so many pixels has this power at every frequency.
    return float(np.sqrt(np.mean(np.abs(thrown) ** 2, dtype=np.float64) / count))


def _similarity(psfs: Array) -> float:
    if len(psfs) < 2:
        return 0.0
    products = np.array([_inner(a, b) for a, b in pairwise(psfs)])
    norms = np.maximum(_norms(psfs), 1e-30)
    return float(np.max(products / norms[1:] / norms[:-1]))


def _dimming(psfs: Array) -> float:
    norms = _norms(psfs)
    return float(norms.min() / norms.max()) if norms.max() > 0 else 1.0


def _norms(psfs: Array) -> npt.NDArray[np.float64]:
    return np.sqrt([_inner(psf, psf) for psf in psfs])


def _inner(one: Array, other: Array) -> float:
    """Return the inner product of two planes; only they are ever in memory as float64, never the stack."""
    return float(np.vdot(one.astype(np.float64), other.astype(np.float64)))


def _ambiguity(psf: Array) -> float:
    """Return the highest side peak of a PSF's autocorrelation, over the mean that any PSF has."""
    shape = fft.fast_shape([2 * n for n in psf.shape])
    padded = np.zeros((1, *shape), np.float32)
    padded[0, : psf.shape[0], : psf.shape[1]] = psf
    spectrum = fft.rfft(padded)
    correlation = fft.irfft((spectrum * spectrum.conj()).astype(np.complex64), shape[1])[0]
    peak = float(correlation[0, 0])
    if peak <= 0:
        return 0.0
    near = NEAR_PX
    correlation[: near + 1, : near + 1] = correlation[: near + 1, -near:] = 0
    correlation[-near:, : near + 1] = correlation[-near:, -near:] = 0
    return float(correlation.max()) / peak


def averaged(channels: list[Evidence]) -> Evidence:
    """Return the mean over channels, the worst of what must not average."""
    known = [c.as_json() for c in channels]
    numbers: Mapping[str, list[float]] = {k: [c[k] for c in known] for k in known[0]}
    mean = {k: float(np.mean(v)) for k, v in numbers.items()}
    worst = {k: max(numbers[k]) for k in ("unexplained", "saturated", "unsettled", "load")}
    return Evidence(**{**mean, **worst, "planes": int(numbers["planes"][0])})  # type: ignore[arg-type]
