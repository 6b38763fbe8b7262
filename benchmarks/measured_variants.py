"""The measured hand as other laboratories' files are, and pairs in coarse pixels: for ``measured.py``."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from instrument.files.errors import FileError
from instrument.files.images import ImageFile
from instrument.reconstruction.job import job_from_files
from instrument.reconstruction.options import InputOptions
from recon import reconstruct
from recon.arrays import Array
from recon.base.blocks import block_mean
from recon.blind.known_pictures import psf_from_pictures
from recon.blind.left_out import judged_by
from recon.evaluation.measured_sets import HAND_DARK, data_folder, measured_pairs, measured_set

BINNING, COARSE = 8, 6
FULL = 65520


def variants(_: Path) -> list[str]:
    """Show what becomes of the hand, by defaults, as files of many kinds."""
    psfs, photograph = measured_set("hand")
    reference = reconstruct(
        block_mean(photograph, BINNING),
        block_mean(psfs[0], BINNING),
        solver="admm-sensor",
        iterations=400,
        tolerance=1e-5,
        judged=False,
    ).image
    lines = [
        f"Files by defaults and `--bin {BINNING}`, PSNR to the converged picture of the clean ones after the "
        "best shift and gain.",
        "",
        "| files | dB | correlation | calibration | verdict | CPU s |",
        "|---|---|---|---|---|---|",
    ]
    folder = data_folder() / "diffusercam_hand"
    psf, raw = (
        np.asarray(cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED))
        for name in ("psf_sample.tif", "rawdata_hand_sample.tif")
    )
    for name, make in VARIANTS.items():
        began = time.process_time()
        files = [ImageFile(Path(n), a) for n, a in zip(("psf.tif", "raw.tif"), make(psf, raw), strict=True)]
        try:
            job = job_from_files(
                files[0], files[1], InputOptions(**{"binning": BINNING} | dict(INPUTS.get(name, {})))
            )
        except FileError as error:
            lines.append(f"| {name} | refused: {error} | | | | |")
            continue
        result = reconstruct(job.as_measurement(None), job.calibration)
        seconds = time.process_time() - began
        decibels, correlation = alike(result.image, reference)
        verdict = result.verdict
        assert verdict is not None
        fit = "not asked" if verdict.calibration is None else str(verdict.calibration.fit)
        said = verdict.sentences[0].split(":")[0]
        lines.append(f"| {name} | {decibels:.1f} | {correlation:.3f} | {fit} | {said} | {seconds:.1f} |")
        print(lines[-1], flush=True)
    return lines


def counts(values: Array) -> Array:
    """Return 16-bit counts."""
    return np.clip(np.round(values), 0, FULL).astype(np.uint16)


def light(raw: Array) -> Array:
    """Return what is above the dark level."""
    return np.asarray(raw - raw[HAND_DARK].mean())


def planted(raw: Array, share: float, value: int | None = None) -> Array:
    """Return a copy with defective pixels, always the same: at one value, or at random ones."""
    rng = np.random.default_rng(3)
    where = rng.choice(raw.size, round(share * raw.size), replace=False)
    copy = raw.copy()
    copy.flat[where] = rng.integers(0, FULL, len(where)) if value is None else value
    return copy


def vignetted(raw: Array) -> Array:
    """Return light that falls off to a half in the corners, which the PSF does not know."""
    y, x = (np.linspace(-1, 1, n) for n in raw.shape)
    return light(raw) * (1 - 0.25 * (y[:, None] ** 2 + x**2))


def cos4(shape: tuple[int, ...], corner: float) -> Array:
    """Return light that falls off round about the middle, as of a lens, to so much in the corners."""
    y, x = (np.arange(n) - (n - 1) / 2 for n in shape)
    off_axis2 = (y[:, None] ** 2 + x**2) / (y[0] ** 2 + x[0] ** 2)
    return np.asarray(1 / (1 + (corner**-0.5 - 1) * off_axis2) ** 2)


def off_middle(shape: tuple[int, ...]) -> Array:
    """Return light of a hill that stands beside the middle."""
    y, x = (np.linspace(-1, 1, n) for n in shape)
    hill = np.exp(-((y[:, None] + 0.2) ** 2 + (x - 0.3) ** 2) / 1.3)
    return np.asarray(hill / hill.max())


def fewer(raw: Array, share: float, counts_per_electron: float = 8.0) -> Array:
    """Return a photograph with a share of its light."""
    electrons = np.round(np.maximum(light(raw), 0) / counts_per_electron).astype(int)
    return np.random.default_rng(5).binomial(electrons, share) * counts_per_electron


def coded(raw: Array) -> Array:
    """Return a photograph as an 8-bit file for the eye (sRGB)."""
    share = np.clip(light(raw) / light(raw).max(), 0, 1)
    return np.round(255 * np.where(share < 0.0031, 12.92 * share, 1.055 * share ** (1 / 2.4) - 0.055)).astype(
        np.uint8
    )


def compressed(raw: Array, quality: int) -> Array:
    """Return an 8-bit JPEG of counts."""
    _, data = cv2.imencode(".jpg", (raw >> 8).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return np.asarray(cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def striped(raw: Array, deviation: float) -> Array:
    """Return counts with a noise that a whole row shares."""
    return counts(raw + np.random.default_rng(4).normal(0, deviation, (len(raw), 1)))


def columns(raw: Array, value: int, places: tuple[int, ...]) -> Array:
    """Return a copy with defective columns."""
    copy = raw.copy()
    copy[:, places] = value
    return copy


def clusters(raw: Array, count: int, side: int = 3) -> Array:
    """Return a copy with squares of pixels at full scale."""
    copy, rng = raw.copy(), np.random.default_rng(6)
    for row, column in rng.integers(0, np.array(raw.shape) - side, (count, 2)):
        copy[row : row + side, column : column + side] = FULL
    return copy


def halved(raw: Array) -> Array:
    """Return what a camera gives that averages 2 x 2 pixels."""
    return counts(block_mean(raw.astype(np.float32), 2))


def middle(raw: Array) -> Array:
    """Return the middle half of the rows and columns, as a region of interest."""
    rows, columns = (slice(n // 4, n // 4 + n // 2) for n in raw.shape)
    return np.ascontiguousarray(raw[rows, columns])


def electrons(raw: Array, most: float) -> Array:
    """Return a photograph of few photo-electrons, a count each."""
    share = np.maximum(light(raw), 0) / light(raw).max()
    return np.random.default_rng(5).poisson(share * most).astype(np.uint16)


def on_a_hill(psf: Array) -> Array:
    """Return a PSF over a hill of light of a tenth of its peak, from the room."""
    y, x = (np.linspace(-1, 1, n) for n in psf.shape)
    return counts(light(psf) + 0.09 * psf.max() * np.exp(-(y[:, None] ** 2) - x**2) + 30)


VARIANTS: Mapping[str, Callable[[Array, Array], tuple[Array, ...]]] = {
    "as they are": lambda p, y: (p, y),
    "8 bits": lambda p, y: ((p >> 8).astype(np.uint8), (y >> 8).astype(np.uint8)),
    "dark level taken off, below zero cut": lambda p, y: (counts(light(p) - 300), counts(light(y) - 300)),
    "fractions of the peak, with negative ones": lambda p, y: (
        (light(p) / FULL).astype(np.float32),
        (light(y) / FULL).astype(np.float32),
    ),
    "a dark level of 1000 in the photograph alone": lambda p, y: (p, counts(light(y) + 1000)),
    "a tenth of the light": lambda p, y: (p, counts(fewer(y, 0.1) + 30)),
    "PSF at a thirtieth of the exposure": lambda p, y: (counts(light(p) / 30 + 30), y),
    "PSF moved by 40 and 60 pixels": lambda p, y: (np.roll(p, (40, -60), axis=(0, 1)), y),
    "PSF: 1 % of the pixels at random values": lambda p, y: (planted(p, 0.01), y),
    "photograph: 1 % of the pixels at random values": lambda p, y: (p, planted(y, 0.01)),
    "both: the same 0.1 % at full scale": lambda p, y: (planted(p, 0.001, FULL), planted(y, 0.001, FULL)),
    "photograph vignetted": lambda p, y: (p, counts(vignetted(y) + 30)),
    "photograph falling off by cos^4 to 69 %": lambda p, y: (p, counts(light(y) * cos4(y.shape, 0.69) + 30)),
    "photograph falling off by cos^4 to 25 %": lambda p, y: (p, counts(light(y) * cos4(y.shape, 0.25) + 30)),
    "photograph under a hill beside the middle": lambda p, y: (
        p,
        counts(light(y) * off_middle(y.shape) + 30),
    ),
    "both falling off by cos^4 to 39 %": lambda p, y: tuple(
        counts(light(a) * cos4(a.shape, 0.39) + 30) for a in (p, y)
    ),
    "photograph: 2000 counts too many taken off": lambda p, y: (p, counts(light(y) - 2000)),
    "photograph: rows share a noise of 400": lambda p, y: (p, striped(y, 400)),
    "both: three dead columns": lambda p, y: tuple(columns(a, 0, (200, 777, 1300)) for a in (p, y)),
    "both: two columns at full scale": lambda p, y: tuple(columns(a, FULL, (400, 1100)) for a in (p, y)),
    "both: 40 squares of 3 x 3 at full scale": lambda p, y: (clusters(p, 40), clusters(y, 40)),
    "photograph of at most 10 electrons": lambda p, y: (p, electrons(y, 10)),
    "both as JPEG, quality 50": lambda p, y: (compressed(p, 50), compressed(y, 50)),
    "photograph for the eye (sRGB), PSF raw": lambda p, y: ((p >> 8).astype(np.uint8), coded(y)),
    "both for the eye (sRGB)": lambda p, y: (coded(p), coded(y)),
    "PSF for the eye (sRGB), photograph raw": lambda p, y: (coded(p), (y >> 8).astype(np.uint8)),
    "photograph for the eye, `--srgb photograph`": lambda p, y: ((p >> 8).astype(np.uint8), coded(y)),
    "both for the eye, `--srgb both`": lambda p, y: (coded(p), coded(y)),
    "PSF for the eye, `--srgb psf`": lambda p, y: (coded(p), (y >> 8).astype(np.uint8)),
    "photograph binned 2 x 2": lambda p, y: (p, halved(y)),
    "PSF binned 2 x 2": lambda p, y: (halved(p), y),
    "the middle half of the photograph, taken for a binned one": lambda p, y: (p, middle(y)),
    "PSF with colours": lambda p, y: (
        np.stack([counts(g * light(p) + 30) for g in (1, 0.6, 0.3)], axis=-1),
        y,
    ),
    "PSF over a hill of light": lambda p, y: (on_a_hill(p), y),
    "PSF twice, moved by 40 and 25 pixels": lambda p, y: (
        counts((light(p) + np.roll(light(p), (40, 25), axis=(0, 1))) / 2 + 30),
        y,
    ),
    "photograph exposed 4 times as long": lambda p, y: (p, counts(4 * light(y) + 30)),
    "photograph exposed 8 times as long": lambda p, y: (p, counts(8 * light(y) + 30)),
}
"""By name: from PSF and photograph, raw counts, what is given."""
INPUTS: Mapping[str, Mapping[str, Any]] = {
    "photograph for the eye, `--srgb photograph`": {"srgb": "photograph"},
    "both for the eye, `--srgb both`": {"srgb": "both"},
    "PSF for the eye, `--srgb psf`": {"srgb": "psf"},
    "photograph binned 2 x 2": {"binning": BINNING // 2},
    "PSF binned 2 x 2": {"binning": BINNING // 2},
    "the middle half of the photograph, taken for a binned one": {"binning": BINNING // 2},
}
"""By name: what is said besides."""


def alike(image: Array, reference: Array) -> tuple[float, float]:
    """Return PSNR, dB, and correlation with a reference after the best whole shift and gain."""
    shape = tuple(2 * n for n in reference.shape)
    spectra = np.fft.rfft2(reference, shape) * np.conj(np.fft.rfft2(image, shape))
    peak = np.unravel_index(int(np.fft.irfft2(spectra, shape).argmax()), shape)
    rows, columns = (int(p) - n * (p >= n // 2) for p, n in zip(peak, shape, strict=True))
    height, width = reference.shape
    kept = np.s_[max(rows, 0) : height + min(rows, 0), max(columns, 0) : width + min(columns, 0)]
    moved = np.roll(image, (rows, columns), axis=(0, 1))[kept].astype(np.float64)
    truth = reference[kept].astype(np.float64)
    gain = float(np.sum(moved * truth) / np.sum(moved**2))
    error = float(np.sqrt(np.mean((gain * moved - truth) ** 2)))
    correlation = float(np.corrcoef(moved.ravel(), truth.ravel())[0, 1])
    return float(20 * np.log10(float(reference.max()) / error)), correlation


def coarse_pairs(_: Path, names: tuple[str, ...] = ("394", "65")) -> list[str]:
    """Show the two pairs that a background spoilt in coarse pixels, each by the PSF of the other six."""
    known, photographs, pictures = measured_pairs()
    data, truths = (block_mean(images, COARSE, about_axis=True) for images in (photographs, pictures))
    truths = truths / truths.max()
    lines = [f"Binned {COARSE} x {COARSE}.", "", "| picture | even | by default, dB |", "|---|---|---|"]
    for name in names:
        number = known.index(name)
        others = np.arange(len(data)) != number
        solved = psf_from_pictures(data[others], truths[others])
        found = judged_by(solved.psf, data[number], truths[number] ** solved.gamma, name)
        lines.append(f"| {name} | {found.flat_db:.1f} | {found.psnr_db:.1f} |")
    return lines


def dark_levels(_: Path, binning: int = 4) -> list[str]:
    """Show pairs with too much taken off as their dark level, each by the PSF of the other six."""
    known, photographs, pictures = measured_pairs()
    data, truths = (block_mean(images, binning, about_axis=True) for images in (photographs, pictures))
    truths = truths / truths.max()
    y, x = (np.linspace(-1, 1, n) for n in data.shape[-2:])
    changes: Mapping[str, Callable[[Array], Array]] = {
        "as it is": lambda b: b,
        "a tenth of its mean taken off": lambda b: b - 0.1 * b.mean(),
        "a quarter": lambda b: b - 0.25 * b.mean(),
        "a quarter, below zero cut": lambda b: np.maximum(b - 0.25 * b.mean(), 0),
        "falling off to a half": lambda b: b * (1 - 0.25 * (y[:, None] ** 2 + x**2)),
        "a quarter added": lambda b: b + 0.25 * b.mean(),
    }
    lines = [
        f"Binned {binning} x {binning}, dB by default.",
        "",
        f"| picture | {' | '.join(changes)} |",
        "|---" * (1 + len(changes)) + "|",
    ]
    for number, name in enumerate(known):
        others = np.arange(len(data)) != number
        solved = psf_from_pictures(data[others], truths[others])
        light = truths[number] ** solved.gamma
        found = [judged_by(solved.psf, change(data[number]), light, name) for change in changes.values()]
        lines.append(f"| {name} | {' | '.join(f'{one.psnr_db:.1f}' for one in found)} |")
    return lines
