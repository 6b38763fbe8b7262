"""What the data alone tell about a reconstruction: light, misfit, load, missing pixels, what it holds.

Nothing here knows the truth. Everything is relative, so that it means the same at any exposure and size.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float64Array
from recon.base import fft
from recon.base.checks import as_channels, saturated_share
from recon.solvers.base import IterationRecord, StoppingRules, StopReason

NEAR_PX = 2
"""Shifts up to here, or up to the full width of the PSF's autocorrelation, belong to its own sharpness."""
NO_LESS = 1e-4
"""Least variance of the signal in units of the noise', so that ratios to it stay finite."""
RING = (0.2, 0.5)
"""Spatial frequencies of details, cycles a resolved distance: periods of five to two of them."""
SPOT, LEAST_SPOT_PX = 0.7, 2.0
"""Autocorrelation of a PSF at the distance that it resolves, and the least that pixels resolve."""
LIT = 0.05
"""Share of the brightest voxels' value (their 99.5th percentile) from which a voxel counts as lit, and a
difference between neighbours as an edge."""
MOST_SAMPLES = 4_000_000
SMOOTH_PX = 0.7
"""A point between pixels is shared by up to four: smoothed so far before peaks are looked for."""
FOUND = 0.1
STRONG = 0.5
"""Height from which a peak counts as found and as strong, relative to the height at which the light lies
(``sum y^2 / sum y``, which empty space around it does not change)."""
DIVERGED = 1e3
"""``unsettled`` of a run whose iterates were no longer finite; it is never more."""
LIMITS = (StopReason.ITERATIONS, StopReason.TIME, StopReason.CANCELLED)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What was measured."""

    signal: float
    """Standard deviation of the measurement over its pixels, less the noise', in units of the noise: what
    there is to reconstruct from."""
    detail: float
    """Signal over noise of the picture's details of two to five resolved distances (four to ten pixels with
    sharp optics), as the camera transmits them: root of the power of the picture times the PSF's on that ring
    of frequencies, over the noise'."""
    unexplained: float
    """Residual beyond the expected noise, relative to the measurement's standard deviation without noise:
    what the model does not describe (a moved diffuser, another depth or colour, stray light, saturation)."""
    erased: float
    saturated: float
    """``erased`` and ``saturated``: shares of the pixels: not used; used though at full scale."""
    lit: float
    edges: float
    """``lit`` and ``edges``: shares of the voxels that are not dark, and that differ from a neighbour."""
    load: float
    """Unknowns a measured pixel: lit voxels or edges, whichever are fewer, over the pixels used."""
    planes: int
    """Depths."""
    similarity: float
    """Greatest inner product of PSFs of neighbouring depths; 0 for one depth."""
    dimming: float
    """Least norm of a depth's PSF relative to the greatest: how much dimmer the farthest points are."""
    ambiguity: float
    """Greatest correlation of a PSF with itself, moved by more than its width: near 1 for a regular array."""
    unsettled: float
    """Change of the last iteration over ten times the tolerance, where a limit ended the run; else 0."""
    height: float | None = None
    peaks: float | None = None
    ends: float | None = None
    """``height``, ``peaks`` and ``ends``: of the bright points of a volume (:class:`Points`); None of a
    picture."""

    def as_json(self) -> dict[str, float]:
        """Return the numbers by name, but for those that were not measured."""
        return {name: float(value) for name, value in asdict(self).items() if value is not None}


@dataclass(frozen=True, slots=True)
class Observation:
    """One channel of what the camera saw."""

    data: Array
    """(height, width): measurement, background subtracted, in units of its noise."""
    valid: BoolArray
    """(height, width)."""
    noise: float
    """Its deviation, counts."""
    saturated: float = 0.0
    """Share of the valid pixels at full scale."""


def measure(
    seen: Observation,
    volume: Array,
    psfs: Array,
    residual_norm: float,
    *,
    unsettled: float,
    points: bool = False,
) -> Evidence:
    """Measure one channel of a reconstruction, as :func:`evidence_of`.

    ``volume`` is (n_z, rows, columns) and ``psfs`` (n_z, height, width): ``measurement = sum_z PSF_z *
    volume_z``.
    """
    data, noise = seen.data, seen.noise
    used = data[seen.valid].astype(np.float64)
    signal2 = max(float(np.var(used)) - 1.0, NO_LESS)
    beyond2 = max(residual_norm**2 / len(used) - 1.0, 0.0)
    lit, edges = lit_and_edges(volume)
    correlation = _autocorrelation(psfs[len(psfs) // 2])
    found = asdict(points_of(volume, _norms(psfs) / noise, len(used))) if points else {}
    return Evidence(
        signal=float(np.sqrt(signal2)),
        detail=_detail(volume, psfs, noise, len(used), _spot_px(correlation)),
        unexplained=float(np.sqrt(beyond2 / signal2)),
        erased=1.0 - len(used) / data.size,
        saturated=seen.saturated,
        lit=lit,
        edges=edges,
        load=min(lit, edges) * volume.size / len(used),
        planes=len(volume),
        similarity=_similarity(psfs),
        dimming=_dimming(psfs),
        ambiguity=_ambiguity(correlation),
        unsettled=unsettled,
        **found,
    )


def _detail(volume: Array, psfs: Array, noise: float, count: int, spot_px: float) -> float:
    """Signal over noise of what a picture's finer half throws onto ``count`` pixels."""
    shape = fft.fast_shape([a + b for a, b in zip(volume.shape[1:], psfs.shape[1:], strict=True)])
    y, x = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])
    frequency = np.hypot(y, x) * max(spot_px, LEAST_SPOT_PX)
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


def _norms(psfs: Array) -> Float64Array:
    return np.sqrt([_inner(psf, psf) for psf in psfs])


def _inner(one: Array, other: Array) -> float:
    """Return the inner product of two planes; only they are ever in memory as float64, never the stack."""
    return float(np.vdot(one.astype(np.float64), other.astype(np.float64)))


def _autocorrelation(psf: Array) -> Array:
    """Return the correlation of a PSF with itself moved down and to either side, 1 where it is not moved.

    Shifts to the left are counted from the last column back.
    """
    height, width = psf.shape
    shape = fft.fast_shape([2 * height, 2 * width])
    padded = np.zeros((1, *shape), np.float32)
    padded[0, :height, :width] = psf
    spectrum = fft.rfft(padded)
    correlation: Array = fft.irfft((spectrum * spectrum.conj()).astype(np.complex64), shape[1])[0, :height]
    return correlation / max(float(correlation[0, 0]), 1e-30)


def _ambiguity(correlation: Array) -> float:
    """Return the highest side peak of a PSF's autocorrelation."""
    cuts = correlation[:, 0], correlation[0, : correlation.shape[1] // 2]
    bars = [(float(cut[0]) + float(np.median(cut[: len(cut) // 2]))) / 2 for cut in cuts]
    near = max(NEAR_PX, *(2 * int(np.ceil(_crossing(*of))) for of in zip(cuts, bars, strict=True)))
    away = correlation.copy()
    away[: near + 1, : near + 1] = away[: near + 1, -near:] = 0
    return float(away.max())


def _spot_px(correlation: Array) -> float:
    """Return the size of a PSF's finest details, as the optics' resolution is defined, pixels."""
    down, across = correlation[:, 0], correlation[0, : correlation.shape[1] // 2]
    return float(np.sqrt(_crossing(down, SPOT) * _crossing(across, SPOT)))


def _crossing(cut: Array, bar: float) -> float:
    """Return how far from its beginning a cut falls to a bar, pixels, linear between them; 0 if never."""
    first = int(np.argmax(cut < bar))
    if not first:
        return 0.0
    above, below = float(cut[first - 1]), float(cut[first])
    return first - 1 + (above - bar) / (above - below)


def averaged(channels: list[Evidence]) -> Evidence:
    """Return the mean over channels, the worst of what must not average."""
    rows = [c.as_json() for c in channels]
    numbers = {name: [row[name] for row in rows] for name in rows[0]}
    mean = {name: sum(values) / len(values) for name, values in numbers.items()}
    worst = {k: max(numbers[k]) for k in ("unexplained", "saturated", "unsettled", "load")}
    return Evidence(**{**mean, **worst, "planes": int(numbers["planes"][0])})  # type: ignore[arg-type]


# What it holds --------------------------------------------------------------------------------------
def lit_and_edges(volume: Array) -> tuple[float, float]:
    """Return the shares of lit voxels and of edges, plane by plane: volumes may be as large as the memory."""
    sample = volume.reshape(-1)[:: max(volume.size // MOST_SAMPLES, 1)]
    white = float(np.percentile(sample, 99.5))
    if white <= 0:
        white = float(volume.max())
    if white <= 0:
        return 0.0, 0.0
    level = LIT * white
    lit = edges = 0
    for z, plane in enumerate(volume):
        step = np.zeros(plane.shape, bool)
        step[:-1] |= np.abs(np.diff(plane, axis=0)) > level
        step[:, :-1] |= np.abs(np.diff(plane, axis=1)) > level
        if z + 1 < len(volume):
            step |= np.abs(volume[z + 1] - plane) > level
        lit += int(np.count_nonzero(plane > level))
        edges += int(np.count_nonzero(step))
    return lit / volume.size, edges / volume.size


@dataclass(frozen=True, slots=True)
class Points:
    """The bright points of a volume."""

    height: float
    """Median height of the peaks found, as the camera sees them: a voxel's value times its PSF's norm, over
    the noise. That is how far a single point stands above the noise of all pixels which it lights."""
    peaks: float
    """Strong peaks for each thousand measured pixels."""
    ends: float
    """Mean light of the two outermost planes over the mean plane's: above 1 where light that fits nowhere
    gathers, or where the scene goes on beyond the calibrated depths."""


def points_of(volume: Array, norms: Float64Array, count: int) -> Points:
    """Measure the bright points of a volume, three planes in memory at a time.

    Parameters
    ----------
    volume : ndarray, (n_z, rows, columns)
    norms : ndarray, (n_z,)
        Norms of the planes' PSFs over the noise.
    count : int
        Measured pixels.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    light = np.zeros(len(volume))
    squares = 0.0
    heights = []
    window: deque[tuple[Array, Array]] = deque(maxlen=3)  # planes, smoothed, each with its local maxima
    for z in range(len(volume) + 1):
        if z < len(volume):
            seen = np.maximum(volume[z], 0) * np.float32(norms[z])
            plane = gaussian_filter(seen, SMOOTH_PX)
            window.append((plane, maximum_filter(plane, 3)))
            light[z] = float(np.sum(seen, dtype=np.float64))
            squares += float(np.sum(np.square(plane), dtype=np.float64))
        elif len(window) == 3:
            window.popleft()
        if z > 0:  # the plane before is known with both its neighbours
            middle = window[-2 if z < len(volume) else -1][0]
            highest = np.max([maxima for _, maxima in window], axis=0)
            heights.append(middle[(middle == highest) & (middle > 0)])
    total = float(light.sum())
    if total <= 0:
        return Points(0.0, 0.0, 1.0)
    found = np.concatenate(heights)
    level = squares / total
    strong = int(np.count_nonzero(found > STRONG * level))
    above = found[found > FOUND * level]
    return Points(
        height=float(np.median(above)) if len(above) else 0.0,
        peaks=1000 * strong / max(count, 1),
        ends=float((light[0] + light[-1]) / 2 / light.mean()),
    )


# From a result --------------------------------------------------------------------------------------
def observations(
    measurement: npt.ArrayLike, data: Array, valid: BoolArray, noise: Array
) -> list[Observation]:
    """Return what the camera saw, a channel each.

    Parameters
    ----------
    measurement : array
        As it came: (height, width[, n_channels]).
    data : ndarray, (n_channels, height, width)
        Background subtracted, in units of the noise.
    valid : ndarray of bool, shape of ``data``
    noise : ndarray, (n_channels,)
        Deviations, counts.
    """
    counts = as_channels(measurement, "measurement")
    return [
        Observation(d, v, float(n), saturated_share(c[v]))
        for d, v, n, c in zip(data, valid, noise, counts, strict=False)
    ]


def evidence_of(
    seen: Sequence[Observation],
    volume: Array,
    psfs: Array,
    residuals: Sequence[float],
    unsettled: float,
    *,
    points: bool = False,
) -> Evidence:
    """Measure all channels of a reconstruction.

    Parameters
    ----------
    seen : sequence of Observation
        One a channel.
    volume : ndarray, (n_z, rows, columns[, n_channels])
        The result in measurement units.
    psfs : ndarray, (n_z, 1 or n_channels, height, width)
        As calibrated.
    residuals : sequence of float
        Norms ``||A x - b||`` over the valid pixels, in units of the noise: one a channel, or one of
        all together.
    points : bool
        Whether to look for the result's bright points as well: of volumes.
    """
    n = len(seen)
    channels = [
        measure(
            one,
            volume if volume.ndim == 3 else volume[..., c],
            psfs[:, min(c, psfs.shape[1] - 1)],
            residuals[c] if len(residuals) == n else residuals[0] / n**0.5,
            unsettled=unsettled,
            points=points,
        )
        for c, one in enumerate(seen)
    ]
    return averaged(channels)


def not_judged(error: Exception) -> str:
    """Say that there is no verdict, and why: a result is never lost for want of one."""
    why = f"{type(error).__name__}: {error}"
    return f"No verdict: judging the result failed ({why}). The result itself is whole."


def unsettled_by(
    history: tuple[IterationRecord, ...], reason: StopReason | None, tolerance: float, *, started: bool
) -> float:
    """Return the last change over ten times the tolerance, where a limit ended the run; else 0.

    A run that was ended before it could be seen to settle (:class:`~recon.solvers.base.StoppingRules`
    ask for several calm iterations in a row) counts as if everything had changed: many solvers do not move
    at all in their first iteration. One that was ``started`` from a result had not to begin anew: there the
    residuals count as they do for those rules, as the change alone would call any start settled. Where they
    are nil as well, the start was empty, and nothing is known.
    """
    if reason is StopReason.NOT_FINITE:
        return DIVERGED
    if not history or tolerance <= 0 or reason not in LIMITS:
        return 0.0
    change = history[-1].change
    if len(history) < StoppingRules().patience:
        unrest = history[-1].unrest
        change = unrest if started and unrest > 0 else max(change, 1.0)
    return min(float(change / (10 * tolerance)), DIVERGED) if np.isfinite(change) else DIVERGED
