"""The measured hand as an outsider would give it, against a plain ADMM of few lines: for ``measured.py``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.fft import irfft2, rfft2

from benchmarks.measured_variants import BINNING, FULL, alike, compressed, counts, light
from instrument.files.errors import BenchError
from instrument.files.images import ImageFile
from instrument.reconstruction.job import Job, job_from_files
from instrument.reconstruction.options import InputOptions
from recon import reconstruct
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.errors import InputError
from recon.evaluation.measured_sets import data_folder, measured_set

WEIGHTS = (3e-4, 1e-3, 3e-3)
"""Of total variation, of a photograph scaled to 1: the best counts, which a user could not know."""
ITERATIONS = 150


def plain_admm(photograph: Array, psf: Array, weight: float, iterations: int = ITERATIONS) -> Array:
    """Reconstruct by the usual splitting (crop, total variation, at least 0), NumPy and SciPy's FFT alone.

    Both (height, width), less their dark level. The penalties are those of DiffuserCam's tutorial scaled to
    a PSF of unit energy.
    """
    height, width = photograph.shape
    shape = (2 * height, 2 * width)
    top, left = height // 2, width // 2
    centre = np.s_[top : top + height, left : left + width]
    padded = np.zeros(shape, np.float32)
    padded[centre] = psf / np.linalg.norm(psf)
    transfer = rfft2(np.fft.ifftshift(padded))
    data = np.zeros(shape, np.float32)
    data[centre] = photograph / photograph.max()
    inside = np.zeros(shape, np.float32)
    inside[centre] = 1
    steps = np.zeros(shape, np.float32)
    steps[0, 0], steps[0, 1], steps[0, -1], steps[1, 0], steps[-1, 0] = 4, -1, -1, -1, -1
    of_steps = np.abs(rfft2(steps))
    crop, slope, above = 1.0, 1.0, 1.0
    divisor = crop * np.abs(transfer) ** 2 + slope * of_steps + above

    def forward(x: Array) -> Array:
        return irfft2(transfer * rfft2(x), shape)

    def differences(x: Array) -> Array:
        return np.stack([np.roll(x, -1, axis=0) - x, np.roll(x, -1, axis=1) - x])

    def adjoint(d: Array) -> Array:
        return np.roll(d[0], 1, axis=0) - d[0] + np.roll(d[1], 1, axis=1) - d[1]

    x = np.zeros(shape, np.float32)
    dual_v, dual_u, dual_w = (np.zeros(axes + shape, np.float32) for axes in ((), (2,), ()))
    for _ in range(iterations):
        seen, change = forward(x), differences(x)
        v = (data + crop * seen + dual_v) / (inside + crop)
        raised = change + dual_u / slope
        u = np.sign(raised) * np.maximum(np.abs(raised) - weight / slope, 0)
        w = np.maximum(x + dual_w / above, 0)
        right = rfft2(adjoint(slope * u - dual_u) + above * w - dual_w)
        right += np.conj(transfer) * rfft2(crop * v - dual_v)
        x = irfft2(right / divisor, shape)
        dual_v += crop * (forward(x) - v)
        dual_u += slope * (differences(x) - u)
        dual_w += above * (x - w)
    return np.maximum(x, 0)[centre]


@dataclass(frozen=True)
class Case:
    """What is given: from the raw PSF and photograph; what the right picture is, from the clean one.

    ``known``: what the plain ADMM gets, where somebody who knows would have mended what is given.
    """

    give: Callable[[Array, Array], tuple[Array, Array]]
    inputs: Mapping[str, Any] = field(default_factory=dict)
    truth: Callable[[Array], Array] = lambda picture: picture
    known: Callable[[Array, Array], tuple[Array, Array]] | None = None


def window(image: Array, share: float, down: float = 0.5, across: float = 0.5) -> Array:
    """Return a window of a share of both sides, in whole binned pixels, at a place between 0 and 1."""
    unit = BINNING if image.shape[0] > 1000 else 1
    sides = [round(share * n / unit / 2) * 2 * unit for n in image.shape]
    starts = [
        int((n - m) * at / unit) * unit for n, m, at in zip(image.shape, sides, (down, across), strict=True)
    ]
    return np.ascontiguousarray(image[tuple(slice(s, s + m) for s, m in zip(starts, sides, strict=True))])


def framed(psf: Array, share: float) -> Array:
    """Return a PSF that somebody cut out, with the dark level around it."""
    cut = window(psf, share)
    before = [(n - m) // 2 for n, m in zip(psf.shape, cut.shape, strict=True)]
    around = [(b, n - m - b) for n, m, b in zip(psf.shape, cut.shape, before, strict=True)]
    return np.pad(cut, around, constant_values=34)


def dusty(raw: Array, down: float, across: float) -> Array:
    """Return a photograph in which something small on the sensor's glass casts a shadow."""
    y, x = (np.arange(n) for n in raw.shape)
    far2 = (y[:, None] - down * len(y)) ** 2 + (x - across * len(x)) ** 2
    return counts(light(raw) * (1 - 0.6 / (1 + np.exp((np.sqrt(far2) - 35) / 5))) + 30)


def moved(raw: Array, pixels: int) -> Array:
    """Return a photograph smeared along its rows."""
    return counts(cv2.blur(light(raw), (pixels, 1), borderType=cv2.BORDER_REFLECT) + 30)


def glowing(raw: Array, peak: float, left: float) -> Array:
    """Return a photograph under the sensor's own glow in a corner, some of which a dark frame took off."""
    y, x = (np.linspace(0, 1, n) for n in raw.shape)
    return counts(light(raw) + 30 + left * peak * np.exp(-((1 - y[:, None]) ** 2 + (1 - x) ** 2) / 0.05))


def larger(psf: Array, scale: float) -> Array:
    """Return a PSF as of another depth."""
    height, width = psf.shape
    turn = cv2.getRotationMatrix2D((width / 2, height / 2), 0, scale)
    return np.asarray(cv2.warpAffine(psf, turn, (width, height), flags=cv2.INTER_AREA))


def in_circle(psf: Array, radius: float) -> Array:
    """Return a PSF that somebody cut out, round, with nothing beyond."""
    y, x = (np.arange(n) - n / 2 for n in psf.shape)
    return np.where(y[:, None] ** 2 + x**2 < (radius * len(y)) ** 2, psf, 0).astype(psf.dtype)


def on_a_slope(psf: Array, share: float) -> Array:
    """Return a PSF over light of the room that grows across it."""
    slope = np.linspace(0, share * light(psf).max(), psf.shape[1])
    return counts(light(psf) + slope + 30)


def noise_alone(raw: Array) -> Array:
    """Return a photograph of nothing."""
    return counts(34 + 8 * np.random.default_rng(6).standard_normal(raw.shape))


def even(raw: Array) -> Array:
    """Return a photograph of even light, with its photons' noise."""
    return counts(20000 + 400 * np.random.default_rng(6).standard_normal(raw.shape))


def unequally(raw: Array, rows: int, columns: int) -> Array:
    """Return a photograph of oblong binned pixels."""
    height, width = (n // m for n, m in zip(raw.shape, (rows, columns), strict=True))
    cut = raw[: height * rows, : width * columns].astype(np.float32)
    return counts(cut.reshape(height, rows, width, columns).mean(axis=(1, 3)))


CASES: Mapping[str, Case] = {
    "as they are": Case(lambda p, y: (p, y)),
    "PSF 8 bits, photograph fractions": Case(
        lambda p, y: ((p >> 8).astype(np.uint8), (light(y) / FULL).astype(np.float32))
    ),
    "both as JPEG, quality 20": Case(lambda p, y: (compressed(p, 20), compressed(y, 20))),
    "photograph as JPEG, quality 75": Case(lambda p, y: ((p >> 8).astype(np.uint8), compressed(y, 75))),
    "both mirrored": Case(lambda p, y: (p[:, ::-1], y[:, ::-1]), truth=lambda t: t[:, ::-1]),
    "photograph mirrored": Case(lambda p, y: (p, y[:, ::-1]), truth=lambda t: t[:, ::-1]),
    "both turned by 90 degrees": Case(lambda p, y: (np.rot90(p), np.rot90(y)), truth=np.rot90),
    "both cut to 85 %": Case(
        lambda p, y: (window(p, 0.85), window(y, 0.85)), truth=lambda t: window(t, 0.85)
    ),
    "both cut to 70 %": Case(lambda p, y: (window(p, 0.7), window(y, 0.7)), truth=lambda t: window(t, 0.7)),
    "both cut to a half": Case(lambda p, y: (window(p, 0.5), window(y, 0.5)), truth=lambda t: window(t, 0.5)),
    "both cut to 70 %, beside the middle": Case(
        lambda p, y: (window(p, 0.7, 0.2, 0.8), window(y, 0.7, 0.2, 0.8)),
        truth=lambda t: window(t, 0.7, 0.2, 0.8),
    ),
    "photograph cut to 85 %": Case(lambda p, y: (p, window(y, 0.85)), truth=lambda t: window(t, 0.85)),
    "PSF cut to 70 %, black around": Case(lambda p, y: (framed(p, 0.7), y)),
    "PSF cut out in a circle of 0.3 of the height": Case(lambda p, y: (in_circle(p, 0.3), y)),
    "PSF cut out in a circle of 0.45 of the height": Case(lambda p, y: (in_circle(p, 0.45), y)),
    "PSF over light that grows across, 5 %": Case(lambda p, y: (on_a_slope(p, 0.05), y)),
    "PSF over light that grows across, 15 %": Case(lambda p, y: (on_a_slope(p, 0.15), y)),
    "PSF exposed 2 times as long": Case(
        lambda p, y: (counts(2 * light(p) + 30), y), {"allow_saturated": True}
    ),
    "PSF exposed 6 times as long": Case(
        lambda p, y: (counts(6 * light(p) + 30), y), {"allow_saturated": True}
    ),
    "PSF 2 % larger": Case(lambda p, y: (larger(p, 1.02), y)),
    "PSF 6 % larger": Case(lambda p, y: (larger(p, 1.06), y)),
    "a shadow of dust, in both": Case(lambda p, y: (dusty(p, 0.4, 0.6), dusty(y, 0.4, 0.6))),
    "a shadow of dust, moved": Case(lambda p, y: (dusty(p, 0.4, 0.6), dusty(y, 0.5, 0.5))),
    "photograph smeared by 8 pixels": Case(lambda p, y: (p, moved(y, 8))),
    "photograph smeared by 32 pixels": Case(lambda p, y: (p, moved(y, 32))),
    "glow in a corner left": Case(lambda p, y: (p, glowing(y, 8000, 1.0))),
    "glow in a corner taken off twice": Case(lambda p, y: (p, glowing(y, 8000, -1.0))),
    "columns share a noise of 400": Case(
        lambda p, y: (p, counts(y + np.random.default_rng(4).normal(0, 400, (1, y.shape[1]))))
    ),
    "swapped": Case(lambda p, y: (y, p)),
    "photograph of nothing": Case(lambda p, y: (p, noise_alone(y))),
    "photograph of even light": Case(lambda p, y: (p, even(y))),
    "photograph of oblong pixels, 2 x 1": Case(lambda p, y: (p, unequally(y, 2, 1))),
}
"""By name."""


def prepared(given: tuple[Array, Array], case: Case) -> Job:
    """Return the PSF and photograph that are given as the job of reconstructing them."""
    files = [
        ImageFile(Path(name), np.ascontiguousarray(one))
        for name, one in zip(("psf.tif", "raw.tif"), given, strict=True)
    ]
    return job_from_files(*files, InputOptions(**{"binning": BINNING} | dict(case.inputs)))


def grey(image: Array) -> Array:
    """Return the mean of a picture's colours, if it has any."""
    return image if image.ndim == 2 else image.mean(axis=-1)


def blind(_: Path) -> list[str]:
    """Show what becomes of the hand by defaults and by the plain ADMM on the same numbers."""
    return rows_of(CASES)


def rows_of(cases: Mapping[str, Case], *, words: bool = False) -> list[str]:
    """Return the lines of a section with these cases; ``words``: print also what was said."""
    psfs, photograph = measured_set("hand")
    clean, own = block_mean(photograph, BINNING), block_mean(psfs[0], BINNING)
    reference = reconstruct(clean, own, solver="admm-sensor", iterations=400, tolerance=1e-5, judged=False)
    folder = data_folder() / "diffusercam_hand"
    psf, raw = (
        np.asarray(cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED))
        for name in ("psf_sample.tif", "rawdata_hand_sample.tif")
    )
    lines = [
        f"Files by defaults and `--bin {BINNING}`, PSNR to the converged picture of the clean ones after the "
        f"best shift and gain; plain: ADMM of {ITERATIONS} iterations, at least 0, the best of "
        f"{len(WEIGHTS)} weights, on the same binned numbers (`benchmarks/measured_blind.py`).",
        "",
        "| files | dB | plain, dB | correlation | calibration | verdict | CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, case in cases.items():
        began = time.process_time()
        try:
            job = prepared(case.give(psf, raw), case)
            result = reconstruct(job.as_measurement(None), job.calibration)
        except (BenchError, InputError) as error:
            lines.append(f"| {name} | refused: {error} | | | | | |")
            print(lines[-1], flush=True)
            continue
        seconds = time.process_time() - began
        truth = np.ascontiguousarray(case.truth(reference.image))
        decibels, correlation = alike(grey(result.image), truth)
        mended = job if case.known is None else prepared(case.known(psf, raw), case)
        one, seen = mended.calibration.psfs[0].mean(axis=0), grey(mended.measurement)
        plain = max(alike(plain_admm(seen, one, w), truth)[0] for w in WEIGHTS)
        verdict = result.verdict
        fit = "not asked" if verdict is None or verdict.calibration is None else str(verdict.calibration.fit)
        said = "not judged" if verdict is None else verdict.sentences[0].split(":")[0]
        lines.append(
            f"| {name} | {decibels:.1f} | {plain:.1f} | {correlation:.3f} | {fit} | {said} | {seconds:.1f} |"
        )
        print(lines[-1], flush=True)
        if words and verdict is not None:
            print("    ", *job.warnings, *result.warnings, *verdict.sentences, sep="\n    ", flush=True)
    return lines
