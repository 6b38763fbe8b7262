"""How large the source is, told by a sweep over depths: its image on the sensor is ``size d / z`` wide.

Under a small source the finest structure of a smooth diffuser's pattern is as wide at every depth, within
some percent. Under a large one it widens towards the diffuser; so it does where a diffuser is out of focus
there, which the sweep cannot tell from it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from recon.types import Geometry

_LEAST_DEPTHS = 3
_LEAST_RANGE = 1.2  # of depths, farthest over nearest
_SEEN_PX = 1.0  # widening at the nearest depth that is said
_SURE = 3.0  # standard deviations
_LEAST_ERROR = 0.03  # of a structure's width: what the diffuser itself leaves (2 to 4 % over 60 to 200 mm)
_EXPLAINED = 1.5  # of the configured source's image
_WIDE_PX = 4.0  # structure of one depth that a source may be the reason of: twice what two pixels resolve
_MATTERS_PX = 0.5
"""Width of the source's image from which on PSFs change: by 3.5 % at 0.64 pixels, 8.7 % at 1.3 (noise alone
1.5 %; ``tiny``)."""
_UNTOLD = {
    1: ("one depth does", "sweep over more depths"),
    2: ("two depths do", "sweep over more depths"),
    3: ("depths so near one another do", "sweep over a wider range of them"),
}
"""By how many depths there are: what does not tell the source's size, and what would."""


def _two_digits(value: float) -> str:
    return f"{float(f'{value:.2g}'):g}"


@dataclass(frozen=True, slots=True)
class Structure:
    """Widths of the pattern's finest structure, pixels of the PSFs."""

    near_px: float
    far_px: float
    """At the nearest and at the farthest depth."""
    widened_px: float
    """By what goes with ``1 / z``, at the nearest depth: about the width of the source's image there."""
    error_px: float
    """Standard deviation of that."""
    source_um: float
    """A source whose image is so wide; one that is much wider than the structure is larger, by up to 1.8."""
    depths: int
    """How many there are."""
    um_per_px: float
    """Size of a source whose image is a pixel wide at the nearest depth."""
    least_um: float | None
    """A smaller source would not have been told from what the diffuser itself leaves; None: one depth, or few
    that lie near one another, tell only how large it is at most."""

    def line(self, size_um: float | None, configured_px: float) -> str:
        """Return what is to be said of it; nothing where the configured size explains it.

        Parameters
        ----------
        size_um, configured_px : float
            The source's size as configured, None where it is not, and its image's width at the nearest depth.
        """
        half = f"{_two_digits(_MATTERS_PX * self.um_per_px)} um"
        if self.least_um is None:
            if size_um is not None:
                return ""
            told, better = _UNTOLD[min(self.depths, 3)]
            if self.near_px <= _WIDE_PX:
                return (
                    f"Source: {told} not tell how large it is, and [source] size_um does not say. A "
                    f"pinhole of {half} would be half a pixel wide: a larger one blurs the PSFs by more than "
                    f"3 %. Measure it, or {better}."
                )
            return (
                f"Source: the pattern's finest structure is {self.near_px:.1f} pixels wide. The image of a "
                f"source of {self.source_um:.0f} um would be, too: {told} not tell it from the "
                "diffuser's own. Measure the pinhole, and set [source] size_um."
            )
        if self.widened_px <= max(_SEEN_PX, _SURE * self.error_px, _EXPLAINED * configured_px):
            if size_um is not None:
                return ""
            return (
                f"Source: one of {_two_digits(self.least_um)} um or more would have been told by these "
                f"depths. From {half} on its image is half a pixel wide and blurs the PSFs by more than 3 %; "
                "[source] size_um does not say how large it is: measure the pinhole."
            )
        whose = "whose size is not configured" if size_um is None else f"not {size_um:g} as configured"
        return (
            f"Source: towards the diffuser the pattern's finest structure widens from {self.far_px:.1f} to "
            f"{self.near_px:.1f} pixels, as under a source of {self.source_um:.0f} um or more, {whose}: the "
            "PSFs are blurred by that, or the diffuser is out of focus there. Measure the pinhole, and set "
            "[source] size_um."
        )


def fit_structure(
    depths_um: Sequence[float], widths_px: Sequence[float], geometry: Geometry
) -> Structure | None:
    """Fit how the finest structure's width goes with depth; None where too little tells.

    Parameters
    ----------
    depths_um, widths_px : sequence of float
        Of the central PSFs.
    geometry : Geometry
        Of the PSFs' pixels.
    """
    z, widths = np.array(depths_um, np.float64), np.array(widths_px, np.float64)
    d_mm, pitch_um = geometry.diffuser_distance_mm, geometry.pixel_pitch_um
    if d_mm is None or pitch_um is None or not len(z):
        return None
    um_per_px = pitch_um * float(z.min()) / (1e3 * d_mm)
    if len(z) < _LEAST_DEPTHS or z.max() < _LEAST_RANGE * z.min():
        width = float(widths.max())
        return Structure(width, width, width, 0.0, width * um_per_px, len(z), um_per_px, None)
    # Widths of what is folded with one another add as squares.
    design = np.stack([np.ones_like(z), (z.min() / z) ** 2], axis=1)
    solution, *_ = np.linalg.lstsq(design, widths**2, rcond=None)
    rest = widths**2 - design @ solution
    spread = max(float(np.sqrt((rest**2).sum() / (len(z) - 2))), 2 * _LEAST_ERROR * float(widths.mean()) ** 2)
    of_square = spread * float(np.sqrt(np.linalg.inv(design.T @ design)[1, 1]))
    widened = float(np.sqrt(max(float(solution[1]), 0.0)))
    error = of_square / (2 * widened) if widened > 0 else float(np.sqrt(of_square))
    near, far = int(np.argmin(z)), int(np.argmax(z))
    return Structure(
        float(widths[near]),
        float(widths[far]),
        widened,
        error,
        widened * um_per_px,
        len(z),
        um_per_px,
        um_per_px * max(_SEEN_PX, float(np.sqrt(_SURE * of_square / 2))),
    )
