"""What a holographic display is made of, as far as its holograms know it, and how wide it is seen."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import asin, atan, ceil, degrees, pi, radians, sin, sqrt, tan

import numpy as np
import numpy.typing as npt

from recon.arrays import Float64Array
from recon.base.fft import fast_length
from recon.errors import InputError
from recon.holography.learned import Learned


@dataclass(frozen=True, slots=True)
class ScatteringMask:
    """A thin phase mask with square pixels, ``m(u) = exp(j alpha(u))`` (Kuo 2020, Sec. 7.3).

    Attributes
    ----------
    levels : ndarray, uint8, (height, width)
        Height level of each mask pixel.
    phases_rad : ndarray, float64, (n_levels,)
        Phase of each level at the design wavelength.
    design_wavelength_nm : float
        The phase at another wavelength is scaled by the ratio (same height; no dispersion of the index).
    """

    levels: npt.NDArray[np.uint8]
    phases_rad: Float64Array
    design_wavelength_nm: float = 660.0

    def __post_init__(self) -> None:
        if self.levels.ndim != 2 or self.levels.dtype != np.uint8 or not self.levels.size:
            raise InputError(
                f"Mask levels must be uint8 (height, width), not {self.levels.dtype} {self.levels.shape}."
            )
        if int(self.levels.max()) >= len(self.phases_rad):
            raise InputError(
                f"The mask has level {int(self.levels.max())}, but {len(self.phases_rad)} phases are given."
            )

    @property
    def shape(self) -> tuple[int, int]:
        """``(height, width)`` in mask pixels."""
        height, width = self.levels.shape
        return (height, width)

    def response(self, wavelength_nm: float | None = None) -> npt.NDArray[np.complex128]:
        """Return ``exp(j alpha)`` of each level at a wavelength (default: the design wavelength)."""
        scale = 1.0 if wavelength_nm is None else self.design_wavelength_nm / wavelength_nm
        response: npt.NDArray[np.complex128] = np.exp(1j * scale * self.phases_rad)
        return response

    def field(self, wavelength_nm: float | None = None) -> npt.NDArray[np.complex128]:
        """Return ``m`` of every mask pixel, complex128 (height, width)."""
        field: npt.NDArray[np.complex128] = self.response(wavelength_nm)[self.levels]
        return field


def random_mask(
    shape: tuple[int, int], *, seed: int = 0, design_wavelength_nm: float = 660.0
) -> ScatteringMask:
    """Return a binary mask whose pixels are 0 or pi at random: white, so its far field is flat (Sec. 7.3)."""
    levels = np.random.default_rng(seed).integers(0, 2, shape, dtype=np.uint8)
    return ScatteringMask(levels, np.array([0.0, np.pi]), design_wavelength_nm)


def no_mask(shape: tuple[int, int], *, design_wavelength_nm: float = 660.0) -> ScatteringMask:
    """Return the mask of a display without one: an SLM pixel each, phase 0."""
    return ScatteringMask(np.zeros(shape, np.uint8), np.zeros(1), design_wavelength_nm)


@dataclass(frozen=True, slots=True)
class DcTerm:
    """Light that the SLM does not modulate, one value for all pixels.

    Attributes
    ----------
    power : float
        Its share of the light, 0 to below 1. The modulated part keeps the rest.
    phase_rad : float
        Its phase relative to the SLM's grey level zero.
    """

    power: float
    phase_rad: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.power < 1:
            raise InputError(f"The DC term's share of the power lies in 0 to 1, not {self.power:g}.")

    @property
    def modulated(self) -> float:
        """Amplitude of the modulated light."""
        return sqrt(1 - self.power)

    @property
    def amplitude(self) -> complex:
        """Complex amplitude of the unmodulated light."""
        return complex(sqrt(self.power) * np.exp(1j * self.phase_rad))


@dataclass(frozen=True, slots=True)
class Display:
    """SLM, mask and Fourier lens (Kuo 2020, Fig. 7.2b).

    Attributes
    ----------
    slm_shape : (int, int)
        ``(height, width)`` of the SLM in pixels (after binning).
    mask : ScatteringMask
        An integer number of mask pixels per SLM pixel, the same along both axes.
    slm_pitch_um, wavelength_nm, focal_mm : float
        ``focal_mm`` is the Fourier lens ``f1``; it matters for planes out of focus only.
    dc : DcTerm
    mask_fill : float
        Width of a mask pixel's clear part over the mask pitch; its diffraction envelope is
        ``sinc^2(fill x / field of view)``. 0 leaves the envelope out (as the dissertation does).
    displacement : ndarray, float, (rows, columns, 2), or None
        Where the mask really lies: the mask cell at ``(y, x)`` sees the SLM at ``(y + dy, x + dx)``, in mask
        pixels; ``dy, dx`` on nodes that span the mask from edge to edge, bilinear in between.
    learned : Learned or None
        What photographs taught of it; ``dc`` is part of that then.
    distance_mm : float or None
        Without a Fourier lens: where the picture is behind the mask. ``focal_mm`` does not count then. The
        picture is ``wavelength_nm distance_mm / mask_pitch_um`` wide (Fresnel diffraction), or where that is
        too :attr:`near`, as the mask's shorter side (angular spectrum).
    lost_db : float or None
        What a hologram that is shown loses to what is not known of the mask's place; for telling it only.
    """

    slm_shape: tuple[int, int]
    mask: ScatteringMask
    slm_pitch_um: float = 16.0
    wavelength_nm: float = 660.0
    focal_mm: float = 75.0
    dc: DcTerm = DcTerm(0.0)
    mask_fill: float = 0.0
    displacement: Float64Array | None = None
    learned: Learned | None = None
    distance_mm: float | None = None
    lost_db: float | None = None

    def __post_init__(self) -> None:
        for name in ("slm_pitch_um", "wavelength_nm", "focal_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} must be above 0, not {getattr(self, name)!r}.")
        if self.distance_mm is not None and not self.distance_mm > 0:
            raise InputError(f"distance_mm must be above 0, not {self.distance_mm!r}.")
        if not 0 <= self.mask_fill <= 1:
            raise InputError(f"mask_fill lies in 0 to 1, not {self.mask_fill:g}.")
        height, width = self.slm_shape
        factor, rest = divmod(self.mask.shape[0], height)
        if rest or factor < 1 or self.mask.shape[1] != factor * width:
            raise InputError(
                f"A mask of {self.mask.shape} pixels does not cover an SLM of {self.slm_shape} pixels with a "
                "whole number of mask pixels per SLM pixel, the same along both axes."
            )
        nodes = self.displacement
        if nodes is not None and (nodes.ndim != 3 or nodes.shape[2] != 2 or min(nodes.shape[:2]) < 2):
            raise InputError(
                f"displacement must be (rows, columns, 2) with at least 2 x 2 nodes, not {nodes.shape}."
            )
        if nodes is not None and not np.isfinite(nodes).all():
            raise InputError("displacement has values that are not finite.")

    @property
    def factor(self) -> int:
        """Mask pixels per SLM pixel along each axis, k."""
        return self.mask.shape[0] // self.slm_shape[0]

    @property
    def expansion(self) -> int:
        """Étendue expansion ``q = k^2`` (Eq. 7.10)."""
        return self.factor**2

    @property
    def mask_pitch_um(self) -> float:
        """Mask pixel pitch, micrometres."""
        return self.slm_pitch_um / self.factor

    def defocus(self, z_mm: float) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128]]:
        """Return the Fresnel factor of a plane as a product of a column and a row (Eqs. 7.21, 7.22).

        ``z_mm`` is the plane's distance from the Fourier lens' focal plane, away from the lens. With
        ``u = X / (lambda f1)`` the phase is ``-pi z X^2 / (lambda f1^2)``; without a lens, ``d`` in front of
        the picture, it is ``pi X^2 / (lambda (d + z))``. The constant phase is left out.

        Both hold for an SLM whose larger phase is a longer way. Where it is a shorter way, ``z > 0`` lies
        towards the lens, and the picture without one is virtual.

        Raises InputError when the factor turns by more than pi between mask pixels at the aperture's edge,
        where the plane would be aliased; without a lens, nearer than :attr:`nearest_mm`, where light is
        propagated otherwise (:mod:`recon.holography.near`).
        """
        wavelength_mm = self.wavelength_nm * 1e-6
        if self.distance_mm is None:
            shape, pitch_um = self.mask.shape, self.mask_pitch_um
            require_defocus(z_mm, greatest_defocus_mm(shape, pitch_um, self.wavelength_nm, self.focal_mm))
            curvature = -np.pi * z_mm / (wavelength_mm * self.focal_mm**2)
        else:
            away_mm, least_mm = self.distance_mm + z_mm, self.nearest_mm
            if away_mm < least_mm:
                raise InputError(
                    f"Without a lens a plane {away_mm:g} mm away is too near for a picture "
                    f"{self.distance_mm:g} mm away: give all of them nearer than {least_mm:.4g} mm, or none."
                )
            curvature = np.pi / (wavelength_mm * away_mm)
        factors = []
        for n in self.mask.shape:
            x_mm = (np.arange(n) - (n - 1) / 2) * self.mask_pitch_um * 1e-3
            factors.append(np.exp(1j * curvature * x_mm**2))
        return factors[0], factors[1]

    def require_plane(self, z_mm: float) -> None:
        """Raise InputError for a plane that this display cannot show."""
        if not self.near:
            self.defocus(z_mm)
            return
        away_mm, side = (self.distance_mm or 0.0) + z_mm, max(self.mask.shape)
        if away_mm <= 0:
            raise InputError(f"A plane {away_mm:g} mm behind the mask is none: its distance is above 0.")
        if min(side, self._spread_px(away_mm)) > self.period - side:
            raise InputError(
                f"A plane {away_mm:g} mm behind the mask is too far for a picture {self.distance_mm:g} mm "
                "away: give the farthest plane's distance, and count the others from there, below 0."
            )

    @property
    def nearest_mm(self) -> float:
        """Distance without a lens from which on pictures are computed by Fresnel diffraction.

        Twice that at which the Fresnel factor turns by pi between mask pixels. Nearer, that the envelope of
        a pixel is centred before the pixel and not on the axis would change the picture: against light
        propagated by itself its correlation is 0.93 at 1.1 times, 0.975 at 1.8, 0.994 at 3.5, 0.999 at 7.
        """
        extent_mm = (max(self.mask.shape) - 1) * self.mask_pitch_um * 1e-3
        return 2 * extent_mm * self.mask_pitch_um * 1e-3 / (self.wavelength_nm * 1e-6)

    @property
    def near(self) -> bool:
        """Whether light is propagated by its angular spectrum: a picture nearer than :attr:`nearest_mm`."""
        return self.distance_mm is not None and self.distance_mm < self.nearest_mm

    @property
    def period(self) -> int:
        """Width of the field of a :attr:`near` picture in mask pixels: the mask, and what light spreads."""
        side = max(self.mask.shape)
        return fast_length(side + ceil(min(side, 16 + 1.25 * self._spread_px(self.distance_mm or 0.0))))

    def _spread_px(self, away_mm: float) -> float:
        """Return how far aside a mask pixel's first order is, mask pixels."""
        return self.wavelength_nm * away_mm / self.mask_pitch_um**2

    @property
    def picture_mm(self) -> float:
        """Width of what is asked for: the field, or the mask's shorter side under a :attr:`near` picture."""
        return min(self.mask.shape) * self.mask_pitch_um * 1e-3 if self.near else self.field_mm

    @property
    def field_mm(self) -> float:
        """Width of the field in the focal plane, or ``distance_mm`` away."""
        if self.near:
            return self.period * self.mask_pitch_um * 1e-3
        away_mm = self.focal_mm if self.distance_mm is None else self.distance_mm
        return self.wavelength_nm * 1e-3 * away_mm / self.mask_pitch_um

    def envelope(self, shape: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
        """Return the mask pixels' intensity envelope over the field, in FFT order, as two factors.

        All even where a picture is :attr:`near`: there it is part of the propagation.
        """
        fill = 0.0 if self.near else self.mask_fill
        y, x = (np.sinc(fill * np.fft.fftfreq(n)) ** 2 for n in shape)
        return y, x

    def dimmed(self, z_mm: float = 0.0) -> float:
        """Return the part of its light that a picture costs which leaves no spot of DC light, 0 to 0.8.

        DC light that passes the mask undiffracted and is in focus is a spot on the axis. The modulated light
        takes it away by an opposite mean, and with ``s`` of modulus 1 that leaves ``1 - 2 p`` of all light
        (``p``: the DC term's power). Through a mask, whose mean over an SLM pixel is ``M``, the smallest such
        change of ``s`` goes with ``conj(M)`` and costs ``2 p |mean M|^2 / mean |M|^2``; the mask's pixels are
        taken for independent of each other. Less than a hundredth is none.
        """
        if self.dc.power == 0 or self.near:
            return 0.0
        count = np.bincount(self.mask.levels.ravel(), minlength=len(self.mask.phases_rad))
        straight = abs(count @ self.mask.response(self.wavelength_nm) / self.mask.levels.size) ** 2
        focused = np.prod([abs(h.mean()) ** 2 for h in self.defocus(z_mm)])
        if self.learned is not None:
            focused *= abs(self.learned.illumination(self.slm_shape).mean()) ** 2
        lost = 2 * self.dc.power * straight * focused / (straight + (1 - straight) / self.expansion)
        return float(min(lost, 0.8)) if lost > 0.01 else 0.0

    def taught(self, learned: Learned) -> Display:
        """Return the display with what was learned of it."""
        light = complex(*learned.dc)
        whole = abs(light) ** 2 + float((learned.response**2).sum(axis=1).mean())
        dc = DcTerm(min(abs(light) ** 2 / whole, 0.9), float(np.angle(light)))
        return replace(self, learned=learned, dc=dc)

    def transmitted(self, shape: tuple[int, int]) -> tuple[Float64Array, Float64Array]:
        """Return the envelope with the vignetting that was learned, as :meth:`envelope`."""
        y, x = self.envelope(shape)
        if self.learned is None:
            return y, x
        down, across = self.learned.shading(shape)
        return y * down, x * across


def greatest_defocus_mm(
    mask_shape: tuple[int, int], mask_pitch_um: float, wavelength_nm: float, focal_mm: float
) -> float:
    """Return how far out of focus a plane may lie: there its Fresnel factor turns by pi a mask pixel."""
    extent_mm = (max(mask_shape) - 1) * mask_pitch_um * 1e-3
    if extent_mm == 0:
        return float("inf")
    return wavelength_nm * 1e-6 * focal_mm**2 / (extent_mm * mask_pitch_um * 1e-3)


def require_defocus(z_mm: float, limit_mm: float) -> None:
    """Raise InputError for a plane farther out of focus than a display's limit."""
    if abs(z_mm) > limit_mm:
        raise InputError(
            f"A plane {z_mm:g} mm out of focus is too far for this display (limit {limit_mm:.3g} mm)."
        )


@dataclass(frozen=True, slots=True)
class Etendue:
    """One axis of a display: SLM, expansion, and the two lenses of Fig. 7.2 (Eqs. 7.4 and 7.5).

    Once for the width, once for the height. The functions below exchange field of view and eyebox through the
    conserved product, either exactly (``2 sin(FoV / 2) eyebox``, Eqs. 7.1 and 7.3) or paraxially (Eq. 7.6).
    The dissertation's examples mix the two: its 1.05 mm at 120 degrees is paraxial (the sine gives 1.28 mm),
    its 32,500 pixels for 120 degrees and 10 mm have the sine (paraxially 39,400).

    Attributes
    ----------
    pixels : int
        SLM pixels along this axis, N.
    pitch_um : float
        SLM pixel pitch.
    wavelength_nm : float
    expansion : float
        Étendue expansion q of the mask in two dimensions (Eq. 7.10); 1 without a mask.
    f1_mm, f2_mm : float
        Focal lengths of the Fourier lens and of the eyepiece.
    """

    pixels: int
    pitch_um: float
    wavelength_nm: float
    expansion: float = 1.0
    f1_mm: float = 1.0
    f2_mm: float = 1.0

    def __post_init__(self) -> None:
        for name in ("pixels", "pitch_um", "wavelength_nm", "expansion", "f1_mm", "f2_mm"):
            if not getattr(self, name) > 0:
                raise InputError(f"{name} must be above 0, not {getattr(self, name)!r}.")
        if self.wavelength_nm >= 2000 * self.mask_pitch_um:
            raise InputError(
                f"Mask pixels of {self.mask_pitch_um:g} um are smaller than half the wavelength of "
                f"{self.wavelength_nm:g} nm: no propagating order. Use a smaller expansion."
            )

    @property
    def mask_pitch_um(self) -> float:
        """Mask pixel pitch (Eq. 7.10), micrometres."""
        return self.pitch_um / sqrt(self.expansion)

    @property
    def width_mm(self) -> float:
        """Width of the SLM."""
        return self.pixels * self.pitch_um / 1000

    @property
    def half_angle_deg(self) -> float:
        """Largest diffraction angle behind the mask, ``sin(theta) = lambda / (2 pitch)`` (Eq. 7.2)."""
        return degrees(asin(self.wavelength_nm / (2000 * self.mask_pitch_um)))

    @property
    def field_of_view_deg(self) -> float:
        """Full field of view (Eq. 7.4)."""
        return 2 * degrees(atan(self.f1_mm / self.f2_mm * tan(radians(self.half_angle_deg))))

    @property
    def eyebox_mm(self) -> float:
        """Eyebox (Eq. 7.5)."""
        return self.f2_mm / self.f1_mm * self.width_mm

    @property
    def etendue_mm(self) -> float:
        """One-dimensional étendue ``lambda N`` times the expansion along one axis (Eqs. 7.3, 7.10)."""
        return self.wavelength_nm * 1e-6 * self.pixels * sqrt(self.expansion)


def pixels_per_degree(width: Etendue, height: Etendue) -> float:
    """Return the resolution that the eye's low-pass leaves in every direction, pixels per degree.

    Its cut-off is a circle (Eq. 7.18) of ``sqrt(Nx Ny / pi)`` periods over the field, two pixels a period.
    """
    return 2 * sqrt(width.pixels * height.pixels / pi) / width.field_of_view_deg


def eyebox_for_field_of_view(display: Etendue, field_of_view_deg: float, *, paraxial: bool = False) -> float:
    """Return the eyebox in mm that is left when the field of view is set.

    ``2 sin(FoV / 2) eyebox = lambda N sqrt(q)``; with ``paraxial`` the sine is dropped (Eq. 7.6, 15 % off
    at 90 degrees).
    """
    if not 0 < field_of_view_deg < 180:
        raise InputError(f"A field of view lies between 0 and 180 degrees, not {field_of_view_deg:g}.")
    half = radians(field_of_view_deg / 2)
    return display.etendue_mm / (2 * (half if paraxial else sin(half)))


def field_of_view_for_eyebox(display: Etendue, eyebox_mm: float, *, paraxial: bool = False) -> float:
    """Return the field of view in degrees that is left when the eyebox is set (see above)."""
    if not eyebox_mm > 0:
        raise InputError(f"An eyebox is above 0 mm, not {eyebox_mm:g}.")
    ratio = display.etendue_mm / (2 * eyebox_mm)
    if paraxial:
        return degrees(2 * ratio)
    return 180.0 if ratio >= 1 else 2 * degrees(asin(ratio))


def pixels_for(
    wavelength_nm: float, field_of_view_deg: float, eyebox_mm: float, *, paraxial: bool = False
) -> int:
    """Return how many SLM pixels along one axis a field of view and an eyebox need without a mask."""
    half = radians(field_of_view_deg / 2)
    return ceil(2 * (half if paraxial else sin(half)) * eyebox_mm / (wavelength_nm * 1e-6))
