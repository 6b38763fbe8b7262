"""Diffusers as height maps: smooth (Gaussian low-pass noise), random microlenses, a regular lenslet array."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from recon.arrays import Float32Array, Float64Array

LINE_D_NM = 589.3
LINE_F_NM = 486.1
LINE_C_NM = 656.3


@dataclass(frozen=True, slots=True)
class Glass:
    """A transparent material whose index follows Cauchy's formula ``n = A + B / wavelength^2``.

    ``index`` is the index at 589.3 nm; ``abbe_number`` the dispersion (infinite: none).
    """

    index: float
    abbe_number: float = float("inf")

    def at(self, wavelength_nm: float) -> float:
        """Index at a wavelength in nanometres."""
        slope = (self.index - 1) / self.abbe_number / (LINE_F_NM**-2 - LINE_C_NM**-2)
        return float(self.index + slope * (wavelength_nm**-2 - LINE_D_NM**-2))


AIR = Glass(1.0)
POLYCARBONATE = Glass(1.58, 30.0)
OPTICAL_EPOXY = Glass(1.56, 40.0)


@dataclass(frozen=True, slots=True)
class Diffuser:
    """A thin refracting surface behind a rectangular aperture, centred on the origin.

    Attributes
    ----------
    heights_um : ndarray, float32, (h, w)
        Thickness of the diffuser above its mean, on a square grid that covers the aperture.
    pitch_um : float
        Sampling pitch of the height map.
    aperture_um : tuple of float
        ``(height, width)`` of the open aperture.
    glass, ambient : Glass
        The diffuser's material and what fills its relief (air, or an index-matching polymer).
    """

    heights_um: Float32Array
    pitch_um: float
    aperture_um: tuple[float, float]
    glass: Glass = POLYCARBONATE
    ambient: Glass = AIR

    def __post_init__(self) -> None:
        height, width = self.heights_um.shape
        if height * self.pitch_um < self.aperture_um[0] or width * self.pitch_um < self.aperture_um[1]:
            raise ValueError(
                f"A height map of {height} x {width} samples at {self.pitch_um} um does not cover the "
                f"aperture of {self.aperture_um[0]} x {self.aperture_um[1]} um."
            )

    def slopes(self) -> tuple[Float32Array, Float32Array]:
        """Surface slopes along y and x (dimensionless), each of the height map's shape."""
        dy, dx = np.gradient(self.heights_um, np.float32(self.pitch_um))
        return np.asarray(dy, np.float32), np.asarray(dx, np.float32)


def map_shape(aperture_um: tuple[float, float], pitch_um: float) -> tuple[int, int]:
    """Smallest height map that covers the aperture."""
    return (int(np.ceil(aperture_um[0] / pitch_um)), int(np.ceil(aperture_um[1] / pitch_um)))


def smooth_diffuser(
    aperture_um: tuple[float, float],
    pitch_um: float,
    *,
    feature_size_um: float = 140.0,
    mean_slope_deg: float = 0.7,
    seed: int = 0,
) -> Diffuser:
    """Smooth diffuser: white noise through a Gaussian low-pass (Kuo 2020, 4.3 and A.2).

    Parameters
    ----------
    aperture_um : tuple of float
        ``(height, width)``.
    pitch_um : float
        Sampling pitch of the height map.
    feature_size_um : float
        Full width at half maximum of the low-pass kernel. With 140 um and the slope below the bumps focus
        at 8 mm on average, which is where the dissertation finds its caustics sharpest.
    mean_slope_deg : float
        Mean magnitude of the surface slope; the map is scaled to have exactly this.
    seed : int
        The same seed gives the same surface.
    """
    from scipy import fft  # late: a quarter of a second

    rng = np.random.default_rng(seed)
    sigma_um = feature_size_um / (2 * np.sqrt(2 * np.log(2)))
    shape = map_shape(aperture_um, pitch_um)
    # Filtering is periodic: generate a rim of four kernel widths so that opposite edges are independent.
    rim = int(np.ceil(4 * sigma_um / pitch_um))
    rows, columns = (fft.next_fast_len(n + rim, real=True) for n in shape)
    spectrum = fft.rfft2(rng.standard_normal((rows, columns), dtype=np.float32))
    exponent = -2 * (np.pi * sigma_um / pitch_um) ** 2
    spectrum *= np.exp(exponent * fft.fftfreq(rows) ** 2).astype(np.float32)[:, None]
    spectrum *= np.exp(exponent * fft.rfftfreq(columns) ** 2).astype(np.float32)
    heights = fft.irfft2(spectrum, s=(rows, columns))[: shape[0], : shape[1]]
    heights = heights - heights.mean()
    dy, dx = np.gradient(heights, pitch_um)
    heights *= np.tan(np.deg2rad(mean_slope_deg)) / np.hypot(dy, dx).mean()
    return Diffuser(np.ascontiguousarray(heights, np.float32), pitch_um, aperture_um, POLYCARBONATE)


def microlens_diffuser(
    aperture_um: tuple[float, float],
    pitch_um: float,
    *,
    lenslet_um: float = 250.0,
    focal_length_um: float = 1500.0,
    regular: bool = False,
    glass: Glass = OPTICAL_EPOXY,
    seed: int = 0,
) -> Diffuser:
    """Plano-spherical lenslets without gaps, at random places or on a square lattice (Kuo 2020, 6.3).

    Parameters
    ----------
    aperture_um, pitch_um, seed
        As for :func:`smooth_diffuser`.
    lenslet_um : float
        Mean lenslet diameter: each covers an area of ``lenslet_um^2`` on average.
    focal_length_um : float
        Focal length in air for light at 589 nm; sets the surfaces' radius ``R = f (n_glass - n_air)``.
    regular : bool
        Lenslets on a square lattice of period ``lenslet_um`` instead of random ones.
    """
    from scipy.spatial import cKDTree  # late: a quarter of a second

    shape = map_shape(aperture_um, pitch_um)
    extent = np.array(shape) * pitch_um
    rng = np.random.default_rng(seed)
    if regular:
        counts = np.ceil(extent / lenslet_um).astype(int) // 2 + 1
        lattice = [np.arange(-n, n + 1) * lenslet_um for n in counts]
        centers = np.stack(np.meshgrid(*lattice, indexing="ij"), axis=-1).reshape(-1, 2)
    else:
        centers = _random_centers(rng, extent + 2 * lenslet_um, lenslet_um)
    radius_um = focal_length_um * (glass.index - AIR.index)
    y = (np.arange(shape[0]) - (shape[0] - 1) / 2) * pitch_um
    x = (np.arange(shape[1]) - (shape[1] - 1) / 2) * pitch_um
    points = np.stack(np.meshgrid(y, x, indexing="ij"), axis=-1).reshape(-1, 2)
    distance = cKDTree(centers).query(points)[0].reshape(shape)
    if distance.max() >= radius_um:
        raise ValueError(
            f"Lenslets of {lenslet_um} um cannot have a focal length of {focal_length_um} um: their surface "
            f"would need a radius of {radius_um:.0f} um, less than their half width {distance.max():.0f} um."
        )
    heights = np.sqrt(radius_um**2 - distance**2)
    heights -= heights.mean()
    return Diffuser(heights.astype(np.float32), pitch_um, aperture_um, glass, AIR)


def _random_centers(rng: np.random.Generator, extent_um: Float64Array, lenslet_um: float) -> Float64Array:
    """Random places, one per ``lenslet_um^2`` on average, with no room for another one between them.

    Random sequential adsorption: discs of diameter ``c`` saturate at ``0.70 / c^2``, hence the factor 0.83.
    """
    closest = 0.83 * lenslet_um
    counts = np.ceil(extent_um / (lenslet_um / 20)).astype(int)
    axes = [(np.arange(n) - (n - 1) / 2) * lenslet_um / 20 for n in counts]
    candidates = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    free = np.ones(len(candidates), bool)
    centers = []
    for index in rng.permutation(len(candidates)):
        if free[index]:
            centers.append(candidates[index])
            free &= ((candidates - candidates[index]) ** 2).sum(axis=1) >= closest**2
    return np.array(centers)
