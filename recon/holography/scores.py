"""Judge a hologram by itself: what an eye would see, computed plainly and without aliasing.

Deliberately shares no code with the optimiser's model: double precision, NumPy's FFT, the whole intensity on
a grid of at least twice the aperture (which holds its whole bandwidth), the untruncated filter.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from recon.arrays import Array
from recon.base.metrics import psnr, ssim
from recon.errors import InputError
from recon.holography.display import Display, random_mask
from recon.holography.model import HologramModel
from recon.holography.optimise import compute_hologram
from recon.holography.options import HologramOptions
from recon.holography.target import Grid, Target, foveal_weights, weights_on


@dataclass(frozen=True, slots=True)
class Scores:
    """How close the seen image is to the target, both low-passed (Eq. 7.18) and of equal mean.

    Peak is the target's white. The crop is the middle quarter of the field (Table 7.1, "partial FoV"); the
    fovea what counts fully with a loss that weighs the field, None with others.
    """

    psnr_db: float
    ssim: float
    crop_psnr_db: float
    crop_ssim: float
    fovea_psnr_db: float | None = None

    @property
    def asked_psnr_db(self) -> float:
        """What a hologram was asked for: in the fovea where there is one, else over the field."""
        return self.psnr_db if self.fovea_psnr_db is None else self.fovea_psnr_db


def intensity(slm: Array, display: Display, *, z_mm: float = 0.0, padding: int = 2) -> Array:
    """Return the mean intensity of SLM frames, float64, on ``padding`` times the mask's grid in FFT order.

    Parameters
    ----------
    slm : ndarray, complex, (n_frames, height, width)
    display : Display
        Without displacement.
    z_mm : float
    padding : int
        1 is the dissertation's grid, which aliases; from 2 on the result is exact.
    """
    if display.displacement is not None:
        raise InputError("The plain judge knows no displacement; give the display without it.")
    if display.near:
        raise InputError("The plain judge knows far fields only, and this picture is near.")
    k = display.factor
    hy, hx = display.defocus(z_mm)
    mask = display.mask.field(display.wavelength_nm) * hy[:, None] * hx
    shape = (padding * mask.shape[0], padding * mask.shape[1])
    total = np.zeros(shape)
    for frame in slm:
        field = display.dc.modulated * frame + display.dc.amplitude
        field = np.repeat(np.repeat(field, k, axis=0), k, axis=1) * mask
        total += np.abs(np.fft.fft2(field, shape)) ** 2
    ey, ex = display.envelope(shape)
    return total * ey[:, None] * ex / (mask.size * len(slm))


def low_pass(image: Array, slm_shape: tuple[int, int]) -> Array:
    """Apply Eq. 7.18 to an image over the whole field, FFT order; any sampling."""
    from recon.holography.target import ORDER, cutoff_radius

    y, x = (np.fft.fftfreq(n) * n for n in image.shape)
    response = 1 / (1 + ((y[:, None] ** 2 + x**2) / cutoff_radius(slm_shape) ** 2) ** ORDER)
    return np.fft.ifft2(np.fft.fft2(image) * response).real


def seen_image(slm: Array, display: Display, *, z_mm: float = 0.0, padding: int = 2) -> Array:
    """Return the low-passed image at the points of the mask's grid, the field's centre in the middle."""
    image = low_pass(intensity(slm, display, z_mm=z_mm, padding=padding), display.slm_shape)
    return np.fft.fftshift(image[::padding, ::padding])


def judge(slm: Array, display: Display, target: Target, *, padding: int = 2) -> Scores:
    """Compare what is seen with the target, given on the mask's grid, within its window if it has one."""
    if target.image.shape != display.mask.shape:
        raise InputError(
            f"The judge needs the target on the mask's grid {display.mask.shape}, not {target.image.shape}."
        )
    image, peak = target.scaled(display)
    wanted = np.fft.fftshift(low_pass(image, display.slm_shape))
    seen = seen_image(slm, display, z_mm=target.z_mm, padding=padding)
    part = (...,) if target.window is None else target.window.part(seen.shape)
    return compare(seen[part], wanted[part], peak)


def compare(seen: Array, wanted: Array, peak: float, weights: Array | None = None) -> Scores:
    """Score an image against the wanted one after scaling it to the same mean.

    ``weights``: over the same field, its centre in the middle; where they are greatest is the fovea.
    """
    scaled = seen * (wanted.mean() / seen.mean())
    y, x = (slice(n // 4, n - n // 4) for n in wanted.shape)
    crop = scaled[y, x], wanted[y, x]
    fovea = None
    if weights is not None:
        counted = np.fft.fftshift(weights_on(weights, wanted.shape)) >= _FULLY
        fovea = psnr(scaled[counted][None], wanted[counted][None], data_range=peak)
    return Scores(
        psnr(scaled, wanted, data_range=peak),
        ssim(scaled, wanted, data_range=peak),
        psnr(*crop, data_range=peak),
        ssim(*crop, data_range=peak),
        fovea,
    )


_FULLY = 0.99
"""Of the greatest weight."""


METHODS = ("one-step", "none", "frequency", "spatial")
GRIDS: tuple[Grid, Grid] = ("dissertation", "alias-free")

DISSERTATION: Mapping[tuple[int, str], Scores] = {
    (4, "one-step"): Scores(12.059, 0.064, 12.163, 0.069),
    (4, "none"): Scores(18.510, 0.286, 18.996, 0.316),
    (4, "frequency"): Scores(26.958, 0.624, 27.412, 0.655),
    (4, "spatial"): Scores(19.267, 0.472, 36.811, 0.903),
    (16, "one-step"): Scores(12.720, 0.197, 13.044, 0.194),
    (16, "none"): Scores(15.128, 0.363, 15.883, 0.373),
    (16, "frequency"): Scores(18.486, 0.552, 19.773, 0.572),
    (16, "spatial"): Scores(15.341, 0.455, 27.266, 0.829),
    (36, "one-step"): Scores(12.891, 0.389, 13.272, 0.383),
    (36, "none"): Scores(14.217, 0.509, 14.912, 0.515),
    (36, "frequency"): Scores(16.167, 0.633, 17.344, 0.650),
    (36, "spatial"): Scores(14.371, 0.541, 21.500, 0.806),
}
"""What the dissertation prints, for 960 x 540 SLM pixels and 40 photographs that it does not name."""


@dataclass(frozen=True, slots=True)
class Cell:
    """One picture, one method: optimised on ``grid``, judged on that grid and without aliasing."""

    expansion: int
    grid: Grid
    method: str
    picture: str
    own: Scores
    alias_free: Scores
    seconds: float


def table_weights() -> Array:
    """Return the foveated weights of the table: 1 over the middle quarter, 0.1 in the periphery."""
    return foveal_weights((256, 256), radius=0.3, periphery=0.1, edge=0.1)


def run_cell(
    display: Display, image: Array, method: str, grid: Grid, *, picture: str = "", iterations: int = 100
) -> Cell:
    """Compute and judge one hologram; ``image`` is on the mask's grid."""
    one_step = method == "one-step"
    options = HologramOptions(
        method="one-step" if one_step else "lbfgs",
        loss="frequency" if one_step else method,
        weights=table_weights() if method == "spatial" else None,
        grid=grid,
        iterations=iterations,
        tolerance=0,
    )
    target = Target(image, white=1.0)
    found = compute_hologram(HologramModel(display, [target], options))
    clean = judge(found.slm, display, target)
    own = judge(found.slm, display, target, padding=1) if grid == "dissertation" else clean
    return Cell(display.expansion, grid, method, picture, own, clean, found.seconds)


def run_table(
    pictures: Mapping[str, Callable[[tuple[int, int]], Array]],
    slm_shape: tuple[int, int],
    *,
    expansions: Sequence[int] = (4, 16, 36),
    iterations: int = 100,
    on_progress: Callable[[Cell], object] | None = None,
) -> list[Cell]:
    """Compute every cell.

    Parameters
    ----------
    pictures : mapping of name to callable
        ``callable(shape)`` returns the picture on a grid.
    slm_shape : (int, int)
    expansions : sequence of int
        Squares.
    iterations : int
        Of L-BFGS, in every cell but the one-step ones.
    on_progress : callable, optional
        Called with each cell as it is ready.
    """
    cells = []
    for q in expansions:
        k = round(q**0.5)
        mask = random_mask((slm_shape[0] * k, slm_shape[1] * k), seed=q)
        display = Display(slm_shape, mask)
        for name, load in pictures.items():
            image = load(mask.shape)
            for grid in GRIDS:
                for method in METHODS:
                    cell = run_cell(display, image, method, grid, picture=name, iterations=iterations)
                    cells.append(cell)
                    if on_progress is not None:
                        on_progress(cell)
    return cells


def average(cells: Sequence[Cell], expansion: int, grid: Grid, method: str, *, own: bool) -> Scores:
    """Return the mean scores over all pictures."""
    chosen = [
        cell.own if own else cell.alias_free
        for cell in cells
        if (cell.expansion, cell.grid, cell.method) == (expansion, grid, method)
    ]
    names = ("psnr_db", "ssim", "crop_psnr_db", "crop_ssim")
    return Scores(*(float(np.mean([getattr(s, name) for s in chosen])) for name in names))
