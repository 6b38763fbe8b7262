"""Maps of a holographic display whose mask is not where its holograms were computed for."""

from __future__ import annotations

from functools import lru_cache, partial

import numpy as np

from recon.holography import Display, Target, random_mask
from recon.holography.pose import PlacedHologram, Pose
from recon.verdict.failure import PSNR_DB, Failure, bounded
from recon.verdict.map import Axis, Size, StressMap, Trial

SHIFT = Axis("shift_x", "shift of the mask", "mask pixels", (0, 0.1, 0.25, 0.5, 1, 2), (0, 0.25, 1))
ROLL = Axis("roll", "rotation: shift at the edge", "mask pixels", (0, 0.1, 0.25, 0.5, 1, 2), (0, 0.25, 1))
DEFOCUS = Axis("z_um", "mask too far by", "um", (0, 5, 12, 25, 50, 100), (0, 25, 100))
DISTORTION = Axis(
    "cubic", "distortion: shift at the corners", "mask pixels", (0, 0.1, 0.25, 0.5, 1, 2), (0, 0.25, 1)
)
SLM = (48, 64)
ITERATIONS = {"quick": 30, "full": 60}
METHODS = {"4 mask pixels an SLM pixel": 2, "16 mask pixels an SLM pixel": 4}


@lru_cache(maxsize=4)
def _hologram(factor: int, seed: int, iterations: int) -> PlacedHologram:
    shape = (SLM[0] * factor, SLM[1] * factor)
    display = Display(SLM, random_mask(shape, seed=3 + seed), mask_fill=1.0, focal_mm=35.0)
    y, x = np.mgrid[:96, :96]
    disc = (y - 40) ** 2 + (x - 52) ** 2 < 500
    bars = (abs(y - 76) < 8) & (x // 6 % 2 == 0)
    target = Target(np.where(disc, 1.0, np.where(bars, 0.8, 0.3)), white=1.0)
    return PlacedHologram(display, target, Pose(), iterations=iterations)


def _misplaced(kind: str, method: str, x: float, y: float, seed: int, size: Size) -> Trial:
    factor = METHODS[method]
    hologram = _hologram(factor, seed, ITERATIONS[size])
    half = 0.5 * SLM[1] * factor
    pose = Pose(shift_x=x, roll_mrad=1e3 * y / half) if kind == "moved" else Pose(z_um=x, cubic=y)
    psnr_db = hologram.psnr_db(pose)
    return Trial(psnr_db, {Failure.PICTURE: bounded(10 ** ((PSNR_DB - psnr_db) / 20))})


MAPS = (
    StressMap(
        "mask-moved",
        "Misaligned mask of a holographic display: shift and rotation",
        "How exactly must the mask lie where the hologram believes it?",
        SHIFT,
        ROLL,
        tuple(METHODS),
        partial(_misplaced, "moved"),
        error="PSNR (dB)",
    ),
    StressMap(
        "mask-defocus",
        "Misaligned mask of a holographic display: defocus and distortion",
        "How exactly must the mask's distance and the relay's distortion be known?",
        DEFOCUS,
        DISTORTION,
        tuple(METHODS),
        partial(_misplaced, "focus"),
        error="PSNR (dB)",
    ),
)
