"""What any number of frames could reach for a picture, a mask and a phase SLM: a bound with its gap.

The mean of frames knows an SLM field ``s`` by ``X = mean(s s^H)`` only: positive, with ones on its diagonal.
All such matrices, few of which are frames of phases, are a convex set with the loss a convex quadratic on it:
its least value there is below that of any frames. ``X = V V^H`` with a few columns and rows of length 1 finds
it (Burer and Monteiro 2003). With the loss's gradient ``Q`` there, ``y_i`` the real part of ``(Q X)_ii`` and

    gap = -N min(0, least eigenvalue of Q - diag(y))

every other ``X'`` has ``loss(X') >= loss(X) + tr(Q (X' - X)) >= loss(X) - gap``. Scaled as a dual variable
may be, the same ``Q`` gives ``(2 loss - gap)^2 / (4 loss)``, which is never less. Light that the SLM does not
modulate is one more row, which all frames share.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float64Array
from recon.errors import InputError
from recon.holography.display import Display, greatest_defocus_mm
from recon.holography.model import HologramModel
from recon.holography.optimise import Hologram, HologramRecord, HologramStop, _Lbfgs, _Watch, compute_hologram
from recon.holography.options import HologramOptions
from recon.holography.target import ORDER, Target
from recon.holography.variables import Point

COLUMNS = 6
"""Of V: more do not lower the loss by a hundredth of a decibel at 16x."""
SETTLED = 1e-3
"""Part of the loss by which it falls in an iteration, below which what is left to gain costs more than it
sharpens the bound: 0.03 dB at 16x."""
FAR_DB = 40.0
"""Where the relaxation is that good nothing limits a picture that an eye sees: no bound is looked for."""
BANDS = (0.0, 0.05, 0.15, 0.4, 1.0)
"""Edges, in parts of the eye's cut-off, of the bands that are told apart."""
DENSE, STEPS, DOUBT = 400, 400, 1e-6
"""Up to so many dimensions eigenvalues are computed directly; beyond, Lanczos' steps, and the probability
that what they tell is no bound."""


@dataclass(frozen=True)
class Limit:
    """What no number of frames can exceed.

    Attributes
    ----------
    bound_db : float
        Of the seen image's PSNR (the target's white as peak, the target's light): no frames are better.
        Infinite where none is in sight: the relaxation itself reaches :data:`FAR_DB`, or says too little.
    reached_db : float
        Of the relaxation's own solution; the bound is as sharp as the two are close.
    wanted, reached : ndarray, float64, (n_bands,)
        Contrast that the picture has in each band of spatial frequencies (:data:`BANDS`), rms relative to the
        mean, and the part of it that is reached, 1 for all.
    stop_reason : HologramStop
    seconds : float
        Of the search.
    columns : ndarray, complex64, (n_columns, height, width)
        The relaxation's solution: where the search for a like target may start.
    """

    bound_db: float
    reached_db: float
    wanted: Float64Array
    reached: Float64Array
    stop_reason: HologramStop
    seconds: float
    columns: npt.NDArray[np.complex64]


def hologram_limit(
    display: Display,
    target: Target,
    options: HologramOptions | None = None,
    *,
    initial: Array | None = None,
    callback: Callable[[HologramRecord, Array], object] | None = None,
    cancel: threading.Event | None = None,
) -> Limit:
    """Find what any number of frames of a phase SLM could reach.

    Parameters
    ----------
    display : Display
    target : Target
    options : HologramOptions
        Its iterations, time, tolerance (:data:`SETTLED` where none is given) and seed. The loss is
        "frequency": what an eye resolves counts.
    initial : ndarray, optional
        ``columns`` of a like target's limit.
    callback, cancel
        As :func:`recon.holography.compute_hologram`; what ends early is a bound that is less sharp.

    Raises InputError for another loss or a complex SLM, and for a display of which something was learned.
    """
    options = options or HologramOptions()
    if display.learned is not None:
        raise InputError(
            "The limit is known for a display as it is described, and this one was learned from photographs. "
            "Give the alignment from align mask, without what was learned, or none."
        )
    if options.complex_slm or options.mirrors is not None or options.loss != "frequency":
        raise InputError("The limit is known for a phase SLM and the loss 'frequency'.")
    model = HologramModel(display, [target], options, frames=COLUMNS)
    variable = _Rows(model)
    if initial is None:
        start = np.random.default_rng(options.seed).normal(size=(2, COLUMNS, *display.slm_shape))
        initial = start[0] + 1j * start[1]
    search = _Lbfgs(variable, variable.pack(initial))
    if options.tolerance is None:
        options = replace(options, tolerance=SETTLED)
    history, reason = _Watch(options, callback, cancel).run(search, options.iterations, FAR_DB)
    slm = variable.field(search.x)
    found = model.evaluate(slm)
    peak = model.peaks[0] ** 2 * model.counted
    least = 0.0
    if reason is not HologramStop.QUALITY:
        gap = _gap(model, slm, found.gradient, cancel)
        least = max(2 * found.loss - gap, 0.0) ** 2 / (2 * found.loss)
    wanted, reached = _bands(model, slm)
    return Limit(
        -10 * np.log10(least / peak) if least > 0 else float("inf"),
        -10 * np.log10(2 * found.loss / peak),
        wanted,
        reached,
        reason,
        history[-1].seconds,
        slm,
    )


SMALL, SMALL_DEEP, SMALL_ITERATIONS = 2000, 5000, 40
"""SLM pixels, of one plane and of several, and iterations from which :func:`gain_of_frames` tells."""
MOST_DEEP = 200_000
"""Pixels of the mask's part that planes far apart may need."""


def gain_of_frames(display: Display, targets: Sequence[Target], options: HologramOptions) -> float:
    """Return about how many decibels any number of frames would gain over those that were asked for.

    From a part of the SLM and its mask, behind which both are computed: quick, and for telling whether frames
    are what a picture lacks. Planes are as much farther apart there as the part's depth of focus is
    larger: of 19,200 pixels, two planes 5 and 30 mm apart at 1x and 4x, 0.1 to 2.0 dB more than by the whole
    SLM. Where that is not the question (a complex SLM, mirrors, near pictures), nan; for planes without a
    lens too, and for those so far apart that only a large part could show them.
    """
    deep = len({target.z_mm for target in targets}) > 1
    if options.complex_slm or options.mirrors is not None or display.near:
        return float("nan")
    if deep and display.distance_mm is not None:
        return float("nan")
    k, (height, width) = display.factor, display.slm_shape
    part = min(1.0, (SMALL / (height * width)) ** 0.5)
    if deep:
        limit_mm = greatest_defocus_mm(
            display.mask.shape, display.mask_pitch_um, display.wavelength_nm, display.focal_mm
        )
        needed = 1.1 * max(abs(target.z_mm) for target in targets) / limit_mm
        if needed**2 * display.mask.levels.size > MOST_DEEP:
            return float("nan")
        part = min(1.0, max(needed, (SMALL_DEEP / (height * width)) ** 0.5))
    rows, columns = (max(round(part * n), min(n, 8)) for n in (height, width))
    mask = replace(display.mask, levels=np.ascontiguousarray(display.mask.levels[: rows * k, : columns * k]))
    small = replace(display, slm_shape=(rows, columns), mask=mask, displacement=None, learned=None)
    if deep:
        farther = height * width / (rows * columns)
        targets = [replace(target, z_mm=target.z_mm * farther) for target in targets]
    settings = HologramOptions(
        loss="frequency", frames=options.frames, iterations=SMALL_ITERATIONS, seed=options.seed
    )
    alone = compute_hologram(HologramModel(small, targets, settings)).history[-1].psnr_db
    model = HologramModel(small, targets, settings, frames=max(COLUMNS, options.frames))
    variable = _Rows(model)
    rng = np.random.default_rng(options.seed)
    start = rng.normal(size=(2, model.frames, *small.slm_shape)).astype(np.float32)
    search = _Lbfgs(variable, variable.pack(start[0] + 1j * start[1]))
    history, _ = _Watch(settings, None, None).run(search, SMALL_ITERATIONS, None)
    return history[-1].psnr_db - alone


_CLEARLY_DB, _DIM, _FELT_DB = 3.0, 0.1, 0.3
_GOOD_DB = 35.0
"""From here on nothing is said of contrast: 1.8 % of white rms, about the least difference an eye sees."""


def limited_by(
    display: Display,
    targets: Sequence[Target],
    hologram: Hologram,
    options: HologramOptions,
    efficiency: float,
) -> tuple[str, ...]:
    """Return what keeps a hologram from being better: search, levels, frames, contrast, light, alignment."""
    found = []
    history = hologram.history
    late_db = history[-1].psnr_db - history[int(0.8 * (len(history) - 1))].psnr_db
    ended = (HologramStop.ITERATIONS, HologramStop.TIME, HologramStop.CANCELLED)
    if searching := late_db > 0.5 and hologram.stop_reason in ended:
        found.append(f"search: it still gained {late_db:.1f} dB in its last fifth (--iterations)")
    lost_db = max(record.psnr_db for record in history) - history[-1].psnr_db
    if options.phase_levels is not None and lost_db > _FELT_DB:
        found.append(f"levels: rounded to {options.phase_levels} phases it lost {lost_db:.1f} dB (--levels)")
    gain_db = gain_of_frames(display, targets, options)
    if gain_db > _CLEARLY_DB:
        found.append(f"frames: many would reach about {gain_db:.0f} dB more (--frames {2 * options.frames})")
    elif not (np.isnan(gain_db) or searching) and history[-1].psnr_db < _GOOD_DB:
        mask = "" if display.factor == 1 else "through this mask "
        found.append(
            f"contrast: many frames would gain {max(gain_db, 0.0):.1f} dB only; phases cannot make so much "
            f"of the field as dark {mask}as this picture asks (--lift 0.2, --complex, less --expansion)"
        )
    if efficiency < _DIM:
        found.append(f"light: {efficiency:.1%} of what falls on the SLM is used")
    if display.lost_db is not None and display.lost_db > _FELT_DB:
        found.append(f"alignment: what is not known of the mask's place costs about {display.lost_db:.1f} dB")
    elif display.factor > 1 and display.displacement is None:
        found.append("alignment: none is given, the mask is taken to be exactly in its place (align mask)")
    return tuple(found)


class _Rows:
    """Fields whose power, summed over all columns, is that of as many phase frames at every SLM pixel."""

    def __init__(self, model: HologramModel) -> None:
        self.model = model
        self.first_step = 0.5

    def pack(self, slm: Array) -> Array:
        return self._normed(slm.astype(self.model.dtype))[0].view(np.float32).ravel()

    def field(self, x: Array) -> Array:
        return self._normed(self._inside(x))[0]

    def evaluate(self, x: Array) -> tuple[Point, Array]:
        slm, length = self._normed(self._inside(x))
        found = self.model.evaluate(slm)
        along = np.sum((np.conj(slm) * found.gradient).real, axis=0) / len(slm)
        gradient = 2 * (found.gradient - slm * along) / length
        return Point(found.loss, found.seen_psnr_db), gradient.astype(np.complex64).view(np.float32).ravel()

    def _inside(self, x: Array) -> Array:
        return x.view(np.complex64).reshape(self.model.frames, *self.model.display.slm_shape)

    def _normed(self, z: Array) -> tuple[Array, Array]:
        length = np.sqrt(np.mean(np.abs(z) ** 2, axis=0))
        return np.asarray(z / length, np.complex64), length


def _bands(model: HologramModel, slm: Array) -> tuple[Array, Array]:
    """Return the contrast wanted in each band, and the part of it that is reached."""
    wanted, seen = model.lags(), model.lags(slm)
    y, x = model.band.lags()
    cutoff = model.band.cutoff
    if model.window is not None:  # only what is inside it is the picture
        part = model.window.part(model.band.seen_shape)
        inside = model.wanted()[part], model.seen(slm)[part]
        height = len(inside[0])
        wanted, seen = (np.fft.rfft2(image) / image.size for image in inside)
        y = np.asarray(np.fft.fftfreq(height) * height, np.float64)
        x = np.arange(wanted.shape[1], dtype=np.float64)
        cutoff *= height / model.band.seen_shape[0]
    radius = np.hypot(y[:, None], x) / cutoff
    weight = np.where(x == 0, 1.0, 2.0) / (1 + radius ** (2 * ORDER)) ** 2
    found = []
    for low, high in pairwise(BANDS):
        here = (radius > low) & (radius <= high)
        power = float(np.sum((weight * np.abs(wanted) ** 2)[here]))
        missed = float(np.sum((weight * np.abs(seen - wanted) ** 2)[here]))
        contrast = np.sqrt(power) / abs(wanted[0, 0])
        found.append((contrast, max(0.0, 1 - np.sqrt(missed / power)) if power else 1.0))
    contrasts, parts = np.array(found).T
    return contrasts, parts


def _gap(model: HologramModel, slm: Array, gradient: Array, cancel: threading.Event | None = None) -> float:
    """Return how far the loss may be above the relaxation's least."""
    display = model.display
    alpha, dc = display.dc.modulated, display.dc.amplitude
    slope = model.slope()
    single = HologramModel(display, model.targets, model.options, frames=1)
    # Multipliers: of each SLM pixel, and of the light that is not modulated.
    pixels = np.sum((np.conj(slm) * gradient).real, axis=0).astype(np.float64)
    rest = float(np.sum((np.conj(dc) / alpha * gradient).real)) if dc else 0.0
    n = slm[0].size

    def apply(x: Array) -> Array:
        x = np.asarray(x, np.complex64).ravel()
        field = x[:n].reshape(display.slm_shape)
        back = single.weighed(alpha * field + dc * x[n], slope)
        out = np.empty(n + 1, np.complex64)
        out[:n] = (alpha * back - pixels * field).ravel()
        out[n] = np.conj(dc) * back.sum() - rest * x[n] if dc else 0
        return out

    return float((n + 1) * max(0.0, -_below_least(apply, n + 1, cancel)))


def _below_least(apply: Callable[[Array], Array], n: int, cancel: threading.Event | None = None) -> float:
    """Return what no eigenvalue of a Hermitian map of C^n is below; less sharp where it is cancelled.

    Certain up to :data:`DENSE` dimensions. Beyond, Lanczos' from a random start ``b``. With the least
    eigenvalue ``l`` and its vector ``v``, ``|p(A) b|^2 >= |p(l)|^2 |<b, v>|^2`` for every polynomial ``p``.
    Of all of degree below ``k`` and 1 at ``l``, the least ``|p(A) b|^2`` is ``1 / K(l)``, ``K`` the sum
    of the squared polynomials that Lanczos' recurrence makes (Christoffel's function of what ``b`` sees). So
    ``|<b, v>|^2 <= 1 / K(l)``, and in C^n that is as small with a probability below ``n / K(l)``: where this
    is :data:`DOUBT`, no eigenvalue is below. A bulk of eigenvalues near the least one does not blur it, and a
    few far above cost a few steps.
    """
    if n <= DENSE:
        dense = np.stack([apply(row) for row in np.eye(n, dtype=np.complex64)], axis=1)
        return float(np.linalg.eigvalsh(0.5 * (dense + dense.conj().T))[0])
    from scipy.linalg import eigvalsh_tridiagonal

    rng = np.random.default_rng(0)
    v = (rng.normal(size=n) + 1j * rng.normal(size=n)).astype(np.complex64)
    v /= np.float32(np.linalg.norm(v))
    before, beta = np.zeros_like(v), 0.0
    diagonal: list[float] = []
    off: list[float] = []
    for step in range(1, STEPS + 1):
        w = apply(v) - np.float32(beta) * before
        diagonal.append(float(np.vdot(v, w).real))
        w -= np.float32(diagonal[-1]) * v
        beta = float(np.linalg.norm(w))
        ended = beta <= 1e-6 * abs(diagonal[0])  # all that the start has a part in was seen
        if ended or step % _LOOKS == 0:
            ritz = eigvalsh_tridiagonal(diagonal, off)
            rounding = (1e-5 if ended else _ROUNDED) * float(np.abs(ritz).max())
            below = float(ritz[0]) if ended else _unlikely(diagonal, off, ritz, np.log(n / DOUBT))
            hurried = step == STEPS or (cancel is not None and cancel.is_set())
            if ended or hurried or ritz[0] - below < _SHARP * abs(below):
                return below - rounding
        off.append(beta)
        before, v = v, w / np.float32(beta)
    raise AssertionError("the last step returns")


_LOOKS, _SHARP = 25, 0.1
"""Steps from one look at what Lanczos tells to the next, and how near to it is near enough."""
_ROUNDED = 4 * float(np.finfo(np.float32).eps)
"""Of the greatest eigenvalue: what single precision may move an eigenvalue by."""


def _unlikely(diagonal: Sequence[float], off: Sequence[float], ritz: Array, most: float) -> float:
    """Return the value below Lanczos' least where the logarithm of Christoffel's sum is ``most``."""

    def growth(value: float) -> float:
        last, here, total, scale = 0.0, 1.0, 1.0, 0.0
        for k, beta in enumerate(off):
            last, here = here, ((value - diagonal[k]) * here - (off[k - 1] * last if k else 0.0)) / beta
            total += here * here
            if total > 1e100:
                last, here, total, scale = last * 1e-50, here * 1e-50, total * 1e-100, scale + 100
        return float(np.log(total) + scale * np.log(10))

    above = float(ritz[0])
    reach = max(float(ritz[-1]) - above, abs(above), 1e-30)
    while growth(above - reach) < most:
        reach *= 2
    below = above - reach
    while above - below > 1e-3 * max(abs(below), 1e-6 * reach):
        middle = 0.5 * (above + below)
        above, below = (middle, below) if growth(middle) < most else (above, middle)
    return below
