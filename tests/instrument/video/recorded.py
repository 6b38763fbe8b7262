"""A recording of spots, and what is asked of it."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import zarr

from instrument.reconstruction.options import InputOptions, VideoOptions
from instrument.reconstruction.video import (
    VideoRequest,
    finish_video,
    prepare_video,
    solve_video,
)
from instrument.reconstruction.video_work import BlockReport
from recon.reconstruction.options import ReconstructionOptions

SHAPE = (40, 52)

LENSES = np.random.default_rng(0).uniform(-14, 14, (30, 2))

MISSING = 5


def cast(points: list[tuple[float, float, float]]) -> np.ndarray:
    """What points (row, column, light) cast through lenslets, spot by spot: no FFT, no grid."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    image = np.zeros(SHAPE)
    for row, column, light in points:
        for dy, dx in LENSES:
            distance = (y - 20 - row - dy) ** 2 + (x - 26 - column - dx) ** 2
            image += light * np.exp(-distance / (2 * 1.2**2))
    return image


def scene(t: int) -> np.ndarray:
    clean = cast([(-4, -6 + 0.3 * t, 1.0), (5, 3, 0.6 + 0.3 * np.sin(t))])
    rng = np.random.default_rng(t)
    return np.clip(rng.poisson(clean * 500) + rng.normal(20, 2, SHAPE), 0, 4095).astype(np.uint16)


def request(recording: Path, folder: Path, **changes: object) -> VideoRequest:
    given = VideoRequest(
        run=recording,
        out=folder / "v.ome.zarr",
        psf=recording.parent / "psf.npy",
        inputs=InputOptions(dark=20.0, binning=1),
        options=ReconstructionOptions(iterations=25),
        video=VideoOptions(block=4, warm_iterations=5),
    )
    of_video = {name: changes.pop(name) for name in list(changes) if hasattr(given.video, name)}
    return replace(given, video=replace(given.video, **of_video), **changes)  # type: ignore[arg-type]


def solved(wanted: VideoRequest) -> list[BlockReport]:
    reports: list[BlockReport] = []
    prepared = prepare_video(wanted)
    assert solve_video(prepared, reports.append, threading.Event())
    finish_video(prepared)
    return reports


def pictures(folder: Path) -> np.ndarray:
    return np.asarray(zarr.open_array(folder / "v.ome.zarr" / "0", mode="r")[:])


def assert_same(one: np.ndarray, other: np.ndarray) -> None:
    """To the tolerance that docs/video.md states."""
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-5 * float(np.nanmax(other)))
