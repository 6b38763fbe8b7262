"""The measured hand by other laboratories' habits, against a plain ADMM of who knows: for ``measured.py``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.signal import fftconvolve

from benchmarks.measured_blind import Case, dusty, on_a_slope, rows_of, window
from benchmarks.measured_variants import BINNING, FULL, alike, columns, compressed, counts, light, middle
from recon import reconstruct
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.evaluation import content
from recon.evaluation.measured_sets import MeasuredSet, measured_set
from recon.reconstruction.problem import Problem
from recon.reconstruction.reconstruct import judged, lacking
from recon.reconstruction.result import window_of
from recon.reconstruction.selection import choose
from recon.reconstruction.solve import solve
from recon.verdict.missing_light import MUCH, MUCH_INSIDE


def few_counts(raw: Array, share: float, dark: float = 30) -> Array:
    """Return a photograph exposed too short: a share of the counts, with the camera's own noise of 2."""
    noise = 2 * np.random.default_rng(7).standard_normal(raw.shape)
    return counts(share * light(raw) + dark + noise)


def over_exposed(raw: Array, share: float) -> Array:
    """Return a frame in which a share of the lit pixels is at full scale."""
    lit = light(raw)
    top = np.percentile(lit[lit > 0.05 * lit.max()], 100 * (1 - share))
    return counts(lit * FULL / top + 30)


def speckled(raw: Array, spots: int) -> Array:
    """Return a frame with dust on the sensor's glass in places."""
    rng = np.random.default_rng(8)
    for down, across in rng.random((spots, 2)):
        raw = dusty(raw, down, across)
    return raw


def of_jpegs(raw: Array, frames: int = 4, quality: int = 85) -> Array:
    """Return the mean of a camera's JPEGs."""
    rng = np.random.default_rng(9)
    taken = [
        compressed(counts(raw + 200 * rng.standard_normal(raw.shape)), quality).astype(np.float32)
        for _ in range(frames)
    ]
    return np.mean(taken, axis=0, dtype=np.float32)


def balanced(raw: Array, gains: tuple[float, ...]) -> Array:
    """Return a grey frame as colours that a white balance has scaled."""
    return np.stack([counts(g * light(raw) + 30) for g in gains], axis=-1)


def doubled(psf: Array, rows: int, columns: int, share: float) -> Array:
    """Return a PSF of two sources, the second of a share of the first's light."""
    second = np.roll(light(psf), (rows, columns), axis=(0, 1))
    return counts((light(psf) + share * second) / (1 + share) + 30)


def as_8_bits(raw: Array) -> Array:
    """Return the upper byte."""
    return (raw >> 8).astype(np.uint8)


def in_a_frame(raw: Array, share: float) -> Array:
    """Return a frame with zeros along its edges, a share of each side."""
    down, across = (round(share * n) for n in raw.shape)
    return np.pad(raw[down:-down, across:-across], ((down, down), (across, across)))


def half_covered(raw: Array) -> Array:
    """Return a frame whose right half was covered and has one value."""
    return np.where(np.arange(raw.shape[1]) < raw.shape[1] // 2, raw, 34).astype(raw.dtype)


def under_a_lamp(raw: Array, peak: float) -> Array:
    """Return a frame with a lamp's reflection of a share of full scale."""
    y, x = (np.arange(n) for n in raw.shape)
    far2 = (y[:, None] - 300) ** 2 + (x - 1200) ** 2
    return counts(light(raw) + peak * FULL * np.exp(-far2 / (2 * 40**2)) + 30)


LABS: Mapping[str, Case] = {
    "photograph 8 bits, PSF 16": Case(lambda p, y: (p, as_8_bits(y))),
    "photograph 8 bits, PSF 16, `--mixed-depth`": Case(
        lambda p, y: (p, as_8_bits(y)), {"allow_mixed_depth": True}
    ),
    "photograph: a hot column": Case(lambda p, y: (p, columns(y, FULL, (777,))), known=lambda p, y: (p, y)),
    "photograph: a column 5 % too bright": Case(
        lambda p, y: (p, counts(y + 0.05 * FULL * (np.arange(y.shape[1]) == 777))), known=lambda p, y: (p, y)
    ),
    "PSF: five spots of dust": Case(lambda p, y: (speckled(p, 5), y)),
    "photograph: five spots of dust": Case(lambda p, y: (p, speckled(y, 5)), known=lambda p, y: (p, y)),
    "photograph: a lamp's reflection": Case(
        lambda p, y: (p, under_a_lamp(y, 0.5)), known=lambda p, y: (p, y)
    ),
    "photograph: zeros along its edges, 5 % a side": Case(lambda p, y: (p, in_a_frame(y, 0.05))),
    "both: zeros along the edges, 5 % a side": Case(lambda p, y: (in_a_frame(p, 0.05), in_a_frame(y, 0.05))),
    "photograph: half of it covered": Case(lambda p, y: (p, half_covered(y))),
    "PSF over light that grows across, 2 %": Case(
        lambda p, y: (on_a_slope(p, 0.02), y), known=lambda p, y: (p, y)
    ),
    "PSF the mean of four JPEGs": Case(lambda p, y: (of_jpegs(p), as_8_bits(y))),
    "photograph of a hundredth of the counts": Case(lambda p, y: (p, few_counts(y, 0.01))),
    "photograph of a thousandth of the counts": Case(lambda p, y: (p, few_counts(y, 0.001))),
    "the same, of a dark level of 100": Case(
        lambda p, y: (p, few_counts(y, 0.001, 100)), known=lambda p, y: (p, few_counts(y, 0.001))
    ),
    "PSF: 5 % of its lit pixels at full scale": Case(lambda p, y: (over_exposed(p, 0.05), y)),
    "the same, `--allow-saturated`": Case(lambda p, y: (over_exposed(p, 0.05), y), {"allow_saturated": True}),
    "photograph turned by 90 degrees": Case(lambda p, y: (p, np.rot90(y)), truth=np.rot90),
    "photograph turned by 180 degrees": Case(
        lambda p, y: (p, np.rot90(y, 2)), truth=lambda t: np.rot90(t, 2)
    ),
    "PSF of another gain and black level": Case(lambda p, y: (counts(0.3 * light(p) + 1000), y)),
    "PSF: its middle 80 %": Case(lambda p, y: (window(p, 0.8), y)),
    "PSF: its middle half, taken for a binned one": Case(lambda p, y: (middle(p), y), {"binning": 4}),
    "photograph in white-balanced colours": Case(lambda p, y: (p, balanced(y, (0.9, 0.5, 0.7)))),
    "both in colours, balanced otherwise": Case(
        lambda p, y: (balanced(p, (0.9, 0.5, 0.7)), balanced(y, (0.5, 0.5, 0.9)))
    ),
    "PSF of two sources, 60 and 40 pixels apart, the second a third": Case(
        lambda p, y: (doubled(p, 60, 40, 1 / 3), y), known=lambda p, y: (p, y)
    ),
    "PSF of two sources, 8 pixels apart": Case(
        lambda p, y: (doubled(p, 0, 8, 1.0), y), known=lambda p, y: (p, y)
    ),
}
"""By name."""


def labs(_: Path) -> list[str]:
    """Show what becomes of the hand by defaults and by the plain ADMM on what its owner would have mended."""
    return rows_of(LABS)


PLACES = ((0, 0), (1, 1), (0, 1), (1, 0), (0.5, 0), (0, 0.5), (0.5, 1), (1, 0.5))
"""Of windows beside the middle: corners and sides."""


def cut(_: Path) -> list[str]:
    """Show what tells a PSF that was cut with its photograph: light that it lacks for what was found."""
    psfs, photograph = measured_set("hand")
    psf, seen = block_mean(psfs[0], BINNING), block_mean(photograph, BINNING)
    truth = reconstruct(seen, psf, solver="admm-sensor", iterations=400, tolerance=1e-5, judged=False).image
    central = [(share, 0.5, 0.5) for share in (1, 0.85, 0.7, 0.6, 0.5, 0.4)]
    beside = [(share, *place) for share in (0.7, 0.5) for place in PLACES]
    lines = [
        f"Both cut, bin {BINNING}; beyond: share of the light that was found beyond the sensor's field; "
        "lacks: light that the PSF lacks of what was found, relative to what it explains, and of what lies "
        f"within the field. From {MUCH} and {MUCH_INSIDE} a picture is doubtful "
        "([0311](../decisions/0311-light-that-a-cut-psf-lacks.md)).",
        "",
        "| window's sides, down, across | dB | correlation | beyond | lacks | within | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    for share, down, across in (*central, *beside):
        one, data, picture = (window(a, share, down, across) for a in (psf, seen, truth))
        lines.append(_lacking(f"{share:g}, {down:g}, {across:g}", data, one, picture))
        print(lines[-1], flush=True)
    return lines


def _lacking(name: str, data: Array, psf: Array, picture: Array) -> str:
    problem = choose(Problem.of(data, psf))
    result = judged(solve(problem), problem)
    decibels, correlation = alike(result.image, picture)
    assert result.state is not None
    assert result.verdict is not None
    lacks = lacking(result, problem)
    assert lacks is not None
    (rows, columns), _ = window_of("sensor", data.shape, psf.shape)
    lit = np.maximum(result.state, 0)
    beyond = 1 - lit[..., rows, columns].sum() / lit.sum()
    said = result.verdict.sentences[0].split(":")[0]
    return (
        f"| {name} | {decibels:.1f} | {correlation:.3f} | {beyond:.2f} | {lacks.of_all:.2f} | "
        f"{lacks.inside:.2f} | {said} |"
    )


DRAWN: Mapping[str, tuple[Callable[[np.random.Generator, int, float], Array], float]] = {
    "text over 0.15": (content.text, 0.15),
    "leaves over 0.15": (content.dense_picture, 0.15),
    "leaves over 0.6": (content.dense_picture, 0.6),
}
"""By name: a picture, and the share of the field's height it takes in its middle."""


DRAWN_THROUGH: tuple[tuple[MeasuredSet, int, int], ...] = (
    ("hand", BINNING, 0),
    ("usaf", 4, 3),
    ("usaf", 4, 22),
    ("usaf", 4, 40),
)
"""PSFs: the set, the bins, and which of its depths."""


def cut_drawn(_: Path) -> list[str]:
    """Show the same of drawn pictures through measured PSFs, cast whole and cut to the middle."""
    lines = [
        "Pictures drawn, cast by a whole PSF (20,000 electrons at most, read noise 3), then both cut; the "
        f"hand's PSF in bins of {BINNING}, the USAF target's in bins of 4. Columns as above.",
        "",
        "| PSF, window's sides, picture | dB | correlation | beyond | lacks | within | verdict |",
        "|---|---|---|---|---|---|---|",
    ]
    rng = np.random.default_rng(12)
    for name, bins, plane in DRAWN_THROUGH:
        whole = np.maximum(_binned(measured_set(name)[0][plane], bins), 0)
        for share in (0.7, 0.5):
            for what, (draw, extent) in DRAWN.items():
                side = max(16, int(extent * share * whole.shape[0]))
                top, left = ((n - side) // 2 for n in whole.shape)
                scene = np.zeros(whole.shape)
                scene[top : top + side, left : left + side] = draw(rng, side, 1.0)
                cast = fftconvolve(scene, whole)[whole.shape[0] // 2 :, whole.shape[1] // 2 :]
                seen = np.maximum(cast[: whole.shape[0], : whole.shape[1]], 0)
                photograph = rng.poisson(2e4 * seen / seen.max()) + 3 * rng.standard_normal(seen.shape)
                given = (window(a.astype(np.float32), share) for a in (photograph, whole, scene))
                lines.append(_lacking(f"{name} {plane}, {share:g}, {what}", *given))
                print(lines[-1], flush=True)
    return lines


def _binned(image: Array, bins: int) -> Array:
    height, width = (n // bins * bins for n in image.shape)
    return block_mean(image[:height, :width], bins)
