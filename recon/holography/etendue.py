"""How wide a holographic display is seen, and from where: étendue arithmetic (Kuo 2020, Eqs. 7.1 to 7.10).

Everything is one-dimensional; call once for the width and once for the height. :class:`Etendue` is the
geometry of Eqs. 7.4 and 7.5 with lenses of focal lengths ``f1`` and ``f2``. The functions exchange field of
view and eyebox through the conserved product, either exactly (``2 sin(FoV / 2) eyebox``, Eqs. 7.1 and 7.3) or
paraxially (Eq. 7.6). The dissertation's examples mix the two: its 1.05 mm at 120 degrees is paraxial (the
sine gives 1.28 mm), its 32,500 pixels for 120 degrees and 10 mm have the sine (paraxially 39,400).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import asin, atan, ceil, degrees, radians, sin, sqrt, tan

from recon.errors import InputError


@dataclass(frozen=True, slots=True)
class Etendue:
    """One axis of a display: SLM, expansion, and the two lenses of Fig. 7.2.

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
    def pixels_per_degree(self) -> float:
        """Resolution that the eye's low-pass leaves: SLM pixels over the field (Eq. 7.18's cut-off)."""
        return self.pixels / self.field_of_view_deg

    @property
    def etendue_mm(self) -> float:
        """One-dimensional étendue ``lambda N`` times the expansion along one axis (Eqs. 7.3, 7.10)."""
        return self.wavelength_nm * 1e-6 * self.pixels * sqrt(self.expansion)


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
