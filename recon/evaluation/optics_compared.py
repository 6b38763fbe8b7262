"""An objective, a smooth diffuser, regular and random lenslets on one scene at equal light (Kuo 2020, 6.3).

All four have one aperture at one distance from one sensor, and send as many photons onto it. Photographs are
propagated as light, each cell of the scene at its own place; PSFs are those of a point on the axis of each
depth, without noise. The objective is corrected over its field, as such lenses are: it throws every point's
light about the straight ray as the axis's. Everything is reconstructed alike: by l1, as sec. 6.2 does, with
one PSF a depth, each picture with the best of three weights. Beads are drawn at calibrated depths only; light
from between them, which every real sample sends, is not tested.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from recon.arrays import Float32Array, Float64Array
from recon.base import metrics
from recon.base.declare import option
from recon.optics.diffuser import OPTICAL_EPOXY, Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.fall_off import no_fall_off
from recon.optics.grid import GREEN, PixelGrid, Spectrum
from recon.optics.render import RenderSettings, render
from recon.optics.scene import Scene, TruthGrid, bead_volume, picture
from recon.optics.wave import Emission, Source, WavePropagator
from recon.reconstruction.options import Options
from recon.reconstruction.reconstruct import reconstruct
from recon.types import Calibration, Geometry

SHAPE, PITCH_UM = (111, 111), 20.0
"""Odd: the axis meets the middle of a pixel. A spot on the corner of four is a square of four."""
APERTURE_UM, LENSLET_UM = 500.0, 125.0
DISTANCE_UM = 3800.0
DEPTHS_UM = (1613.0, 2000.0, 2632.0)
"""Even in 1/z, 120 / m apart: within the axial sampling of Eq. 5.10 for these lenslets."""
READ_NOISE_E = 1.0
_WEIGHTS = (0.0, 1.0, 0.0)
_HEIGHTS_UM = 1.25

OPTICS = ("objective", "smooth diffuser", "regular lenslets", "random lenslets")
_RENDERED = {name: (12, 6) if name == "objective" else (6, 6) for name in OPTICS}
"""What rendering picture and beads takes, in lights' reconstructions."""
_NODES = RenderSettings(node_tolerance=0.3, widest_spacing=0.05)
"""Sharp spots are blurred between PSFs that are farther apart."""
_OF_DEFAULT = (0.3, 1.0, 3.0)
"""Weights that are tried: the default alone leaves nothing of a smooth diffuser's little light."""


@dataclass(frozen=True, kw_only=True)
class OpticsOptions:
    """At which light, with which scene, and how long optics are compared."""

    photons: tuple[float, ...] = option(
        (3e4, 1e5, 3e5, 1e6, 1e7),
        help="Photons that reach the sensor from the picture; repeatable.",
        default_words="30,000 to 10,000,000",
        above=0,
    )
    beads: int = option(60, help="Beads in depth: a few are found through any optics.", least=1)
    volume_photons: float = option(1e5, help="Photons from the beads in depth.", above=0)
    iterations: int = option(100, help="Iterations of every reconstruction.", least=1)
    seed: int = option(0, help="Another one: other diffusers, beads and noise.", least=0)


@dataclass(frozen=True)
class Compared:
    """What one kind of optics made of the scenes.

    Attributes
    ----------
    psfs : ndarray, (n_z, height, width)
        Of a point on the axis at each depth.
    photograph, bead_photograph : ndarray, (height, width)
        Of the picture, at the middle one of the lights; of the beads.
    pictures : mapping of float to ndarray
        Reconstructed from each number of photons.
    psnr_db : mapping of float to float
        Of the pictures against the scene.
    volume : ndarray, (n_z, height, width)
        The beads.
    volume_psnr_db : float
    light_in_place : float
        Share of the volume's light that is where beads are: in a bead's plane, a pixel from it at most.
    """

    psfs: Float32Array
    photograph: Float32Array
    bead_photograph: Float32Array
    pictures: Mapping[float, Float32Array]
    psnr_db: Mapping[float, float]
    volume: Float32Array
    volume_psnr_db: float
    light_in_place: float


@dataclass(frozen=True)
class Comparison:
    """All optics, by :data:`OPTICS`, with the scenes: the picture, and the beads by plane."""

    found: Mapping[str, Compared]
    picture: Float32Array
    beads: Float32Array


def compare_optics(
    options: OpticsOptions, on_progress: Callable[[float, float], object] | None = None
) -> Comparison:
    """Photograph and reconstruct one picture and one volume of beads through every kind of optics.

    ``on_progress(done, of)`` counts in units of a reconstruction's time; it may raise to end the work.
    """
    rng = np.random.default_rng([63, options.seed])
    width_um = 36 * PITCH_UM * DEPTHS_UM[1] / DISTANCE_UM
    flat = picture(_spokes(), DEPTHS_UM[1], width_um)
    spread = (24 * PITCH_UM * DEPTHS_UM[0] / DISTANCE_UM,) * 2
    beads = bead_volume(
        options.beads,
        spread,
        (DEPTHS_UM[0], DEPTHS_UM[-1]),
        diameter_um=8.0,
        seed=int(rng.integers(1_000_000)),
    )
    beads = _onto_depths(beads)
    truth, planes = _truth(flat, None), np.stack([_truth(beads, k) for k in range(len(DEPTHS_UM))])
    total, done = len(OPTICS) * (len(options.photons) + 1) + sum(map(sum, _RENDERED.values())), 0

    def advance(by: int) -> None:
        nonlocal done
        done += by
        if on_progress is not None:
            on_progress(done, total)

    found = {}
    for name in OPTICS:
        optics = _Corrected if name == "objective" else WavePropagator
        light = optics(_diffuser(name, options.seed), DISTANCE_UM)
        grid = PixelGrid(SHAPE, PITCH_UM)
        psfs = [light.psf((0.0, 0.0, z), grid, GREEN.samples(1), emission="isotropic") for z in DEPTHS_UM]
        calibration = _calibration(np.stack(psfs))
        middle = calibration.part([1])
        clean = []
        for scene, takes in zip((flat, beads), _RENDERED[name], strict=True):
            clean.append(_photographed(scene, grid, light))
            advance(takes)
        pictures, psnr_db, shown = {}, {}, {}
        for photons in options.photons:
            shown[photons] = _noisy(clean[0], photons, rng)
            best = _solved(shown[photons], middle, options.iterations, truth[None])
            pictures[photons], psnr_db[photons] = best[0][0], best[1]
            advance(1)
        of_beads = _noisy(clean[1], options.volume_photons, rng)
        volume, volume_psnr_db = _solved(of_beads, calibration, options.iterations, planes)
        advance(1)
        found[name] = Compared(
            np.stack(psfs),
            shown[sorted(shown)[len(shown) // 2]],
            of_beads,
            pictures,
            psnr_db,
            volume,
            volume_psnr_db,
            _light_in_place(volume, planes),
        )
    return Comparison(found, truth, planes)


class _Corrected(WavePropagator):
    """A lens corrected over its field: off the axis it makes of a point what it makes of one on the axis."""

    def psf(
        self,
        source_um: Source,
        grid: PixelGrid,
        spectrum: Spectrum,
        *,
        diameter_um: float = 0.0,
        emission: Emission = "lambertian",
        cell: bool = False,
    ) -> Float32Array:
        """Return the light of a point on the axis, moved to where the straight ray ends."""
        x, y, z = source_um
        moved = (grid.center_um[0] + x * self.distance_um / z, grid.center_um[1] + y * self.distance_um / z)
        # Rounding would make the same places many: they are kept by their grids.
        center = (round(moved[0], 6) + 0.0, round(moved[1], 6) + 0.0)
        about = replace(grid, center_um=center)
        return super().psf(
            (0.0, 0.0, z), about, spectrum, diameter_um=diameter_um, emission=emission, cell=cell
        )


def _diffuser(name: str, seed: int) -> Diffuser:
    """Return the relief of one kind of optics; lenses are sharp at the middle depth."""
    size, z = (APERTURE_UM, APERTURE_UM), DEPTHS_UM[1]
    focus_um = 1 / (1 / z + 1 / DISTANCE_UM)
    if name == "smooth diffuser":
        return smooth_diffuser(size, _HEIGHTS_UM, feature_size_um=80, mean_slope_deg=2.2, seed=seed)
    if name != "objective":
        regular = name == "regular lenslets"
        return microlens_diffuser(
            size, _HEIGHTS_UM, lenslet_um=LENSLET_UM, focal_length_um=focus_um, regular=regular, seed=seed
        )
    # Without aberrations at the middle depth: as much glass as makes all paths from there equally long.
    samples = (np.arange(int(APERTURE_UM / _HEIGHTS_UM)) + 0.5) * _HEIGHTS_UM - APERTURE_UM / 2
    squared = samples[:, None] ** 2 + samples**2
    longer = np.hypot(z, np.sqrt(squared)) - z + np.hypot(DISTANCE_UM, np.sqrt(squared)) - DISTANCE_UM
    heights = -longer / (OPTICAL_EPOXY.index - 1)
    return Diffuser((heights - heights.mean()).astype(np.float32), _HEIGHTS_UM, size, OPTICAL_EPOXY)


def _spokes() -> Float64Array:
    """Draw eight bright spokes on black, (72, 72)."""
    n = 72
    y, x = np.mgrid[:n, :n] - (n - 1) / 2
    radius = np.hypot(y, x) / (n / 2)
    return np.where((np.sin(8 * np.arctan2(y, x)) > 0.35) & (radius > 0.2) & (radius < 0.95), 1.0, 0.0)


def _onto_depths(scene: Scene) -> Scene:
    """Put every bead at the nearest calibrated depth, where the camera sees it at the same place."""
    depths, beads = np.array(DEPTHS_UM), scene.beads[0]
    places = beads.positions_um.copy()
    nearest = depths[np.abs(1 / places[:, 2:] - 1 / depths).argmin(axis=1)]
    places[:, :2] *= (nearest / places[:, 2])[:, None]
    places[:, 2] = nearest
    return Scene(scene.name, beads=(replace(beads, positions_um=places),))


def _truth(scene: Scene, plane: int | None) -> Float32Array:
    ranges = {} if plane is None else {"z_range_um": (0.99 * DEPTHS_UM[plane], 1.01 * DEPTHS_UM[plane])}
    grid = TruthGrid(SHAPE, PITCH_UM, DISTANCE_UM)
    return np.asarray(scene.true_image(grid, _WEIGHTS, **ranges), np.float32)


def _photographed(scene: Scene, grid: PixelGrid, light: WavePropagator) -> Float32Array:
    return render(scene, _WEIGHTS, grid, light, no_fall_off, layer_photons=1, bead_photons=1, settings=_NODES)


def _noisy(clean: Float32Array, photons: float, rng: np.random.Generator) -> Float32Array:
    counts = rng.poisson(clean.astype(np.float64) * (photons / float(clean.sum())))
    return np.asarray(counts + rng.normal(0, READ_NOISE_E, clean.shape), np.float32)


def _calibration(psfs: Float32Array) -> Calibration:
    places = np.array([(0.0, 0.0, z) for z in DEPTHS_UM])
    return Calibration(psfs[:, None], places, geometry=Geometry(PITCH_UM, DISTANCE_UM / 1e3))


def _solved(
    counts: Float32Array, calibration: Calibration, iterations: int, truth: Float32Array
) -> tuple[Float32Array, float]:
    """Return what comes next to the truth by one of the weights, and its PSNR in dB."""
    wanted = Options(model="convolution", prior="l1", iterations=iterations, judged=False)
    default = reconstruct(counts, calibration, options=replace(wanted, iterations=1)).tau or 0.0
    found = []
    for times in _OF_DEFAULT:
        volume = reconstruct(counts, calibration, options=replace(wanted, tau=times * default)).volume
        found.append((volume, metrics.psnr(volume, truth, fit_scale=True)))
    return max(found, key=lambda one: one[1])


def _light_in_place(volume: Float32Array, truth: Float32Array) -> float:
    """Share of the light that is a pixel at most from a bead, in its plane."""
    lit = truth > 0.1 * truth.max()
    near = np.zeros_like(lit)
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            near |= np.roll(lit, (row, column), (1, 2))
    return float(volume[near].sum() / max(float(volume.sum()), 1e-30))
