"""The display that a bench has: its SLM asked for, its mask and lens as ``[display]`` describes them."""

from __future__ import annotations

from math import isqrt
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from instrument.bench.config import BenchConfig
from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image
from instrument.files.slm_image import mismatch
from recon.holography import DcTerm, Display, ScatteringMask, random_mask
from recon.holography.display import greatest_defocus_mm, no_mask

if TYPE_CHECKING:
    from drivers.slm import Slm


def slm_size(
    config: BenchConfig, *, phases: bool = True, spots: bool = False
) -> tuple[tuple[int, int], float]:
    """Ask the bench's SLM for its shape and pixel pitch in micrometres; opens and closes it.

    ``phases``: it is to show phases; ``spots``: those of spots.

    Raises BenchError when the bench has no SLM, or phases are asked of mirrors; DeviceError when it does not
    answer.
    """
    from instrument.bench.bench import Bench

    if "slm" not in config.devices:
        raise BenchError(f"{config.label} has no [slm], so it is not known what to compute a hologram for.")
    bench = Bench(config)
    try:
        slm: Slm = bench.open_device("slm")  # type: ignore[assignment]
        if phases and (words := mismatch(slm, mirrors=False, spots=spots)):
            raise BenchError(words)
        return slm.shape, slm.pixel_pitch_um
    finally:
        bench.close()


def bench_display(
    config: BenchConfig,
    size: tuple[tuple[int, int], float],
    *,
    expansion: int | None = None,
    wavelength_nm: float | None = None,
) -> Display:
    """Return the display that ``[display]`` describes.

    ``size`` is the SLM's shape and pitch, of :func:`slm_size`. Another ``expansion`` than the bench's has a
    random mask of its own, 1 none; with another wavelength the mask keeps its height.

    Raises BenchError or FileError when SLM, binning, expansion and mask do not fit together.
    """
    table = config.display
    q = expansion or table.expansion
    k = expansion_side(q)
    (height, width), pitch_um = size
    binning = table.slm_binning
    if height % binning or width % binning:
        raise BenchError(f"An SLM of {height} x {width} pixels cannot be binned by slm_binning = {binning}.")
    shape = (height // binning, width // binning)
    if q == 1 and (table.mask_file is None or table.expansion != 1):
        mask = no_mask(shape, design_wavelength_nm=table.wavelength_nm)
    elif table.mask_file is not None and q == table.expansion:
        base = config.path.parent if config.path else Path()
        mask = _mask_from(base / table.mask_file, (shape[0] * k, shape[1] * k), table.wavelength_nm)
    else:
        mask = random_mask(
            (shape[0] * k, shape[1] * k), seed=table.mask_seed, design_wavelength_nm=table.wavelength_nm
        )
    return Display(
        shape,
        mask,
        slm_pitch_um=pitch_um * binning,
        wavelength_nm=wavelength_nm or table.wavelength_nm,
        focal_mm=table.focal_mm,
        dc=DcTerm(table.dc_power, table.dc_phase_rad),
        mask_fill=table.mask_fill,
    )


def depth_limit_mm(
    config: BenchConfig, size: tuple[tuple[int, int], float], *, expansion: int | None = None
) -> float:
    """Return how far out of focus a plane may lie for :func:`bench_display`, without making its mask."""
    table = config.display
    k = expansion_side(expansion or table.expansion)
    (height, width), pitch_um = size
    binning = table.slm_binning
    shape = (height // binning * k, width // binning * k)
    return greatest_defocus_mm(shape, pitch_um * binning / k, table.wavelength_nm, table.focal_mm)


def expansion_side(expansion: int) -> int:
    """Return how many mask pixels an étendue expansion puts along each side of an SLM pixel.

    Raises BenchError when the expansion is no square.
    """
    side = isqrt(expansion)
    if side * side != expansion:
        raise BenchError(f"The expansion must be a square (1, 4, 9, 16, 25, 36 ...), not {expansion}.")
    return side


def _mask_from(path: Path, shape: tuple[int, int], wavelength_nm: float) -> ScatteringMask:
    """Read a binary mask image: two values, the greater one is pi."""
    pixels = read_image(path).pixels
    values = np.unique(pixels)
    if pixels.shape != shape:
        raise FileError(path, f"is a mask of {pixels.shape} pixels; SLM and expansion need {shape}.")
    if len(values) != 2:
        raise FileError(path, f"holds {len(values)} different values; a binary mask has two (0 and pi).")
    return ScatteringMask((pixels == values[1]).astype(np.uint8), np.array([0.0, np.pi]), wavelength_nm)
