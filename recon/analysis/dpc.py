r"""Phase from differential phase contrast: images lit by opposite halves of an LED array (Kuo 2020, A.2).

The difference of two opposite halves over their sum shows the phase's slope along the axis between them. For
a weak phase it is linear,

.. math:: D(q) = H(q)\,\varphi(q), \quad H(q) = \frac{i}{\sum_s |P(s)|^2} \sum_s \pm_s
          \left[P^*(s) P(s + q) - P(s) P^*(s - q)\right]

with the pupil :math:`P` and the source's points :math:`s`, positive for one half. Both axes together are
inverted in least squares with a small Tikhonov term (Tian & Waller 2015; Kuo 2020 cites it for A.2).

A diffuser's phase is not weak: several radians, but slow. Rays are then deflected by the phase's slope, and
the light of a half is what of it still passes the pupil. If the source fills more than the pupil, that is
the same straight line :math:`4 g / (\pi \rho)` in the slope :math:`g` as above; if it just matches the
pupil, light can only be lost, and the slope comes out half (docs/decisions/0016-dpc.md).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from recon.arrays import Float32Array, Float64Array
from recon.errors import InputError

SIDES = ("left", "right", "top", "bottom")
_ALIKE = 3.0
"""Times as bright as its opposite a half may be: light that flickers by 40 % makes it 2.3."""
_LINES = 48  # across the pupil, for the transfer function


@dataclass(frozen=True, slots=True)
class DpcOptics:
    """The microscope."""

    pitch_um: float
    """Of the pixels, in the object."""
    wavelength_nm: float
    objective_na: float
    illumination_na: float
    lit_share: float = 1.0
    """Of the LEDs inside the objective's aperture, how many belong to a half: those on the line between the
    halves are dark in both, and miss in the sum that the difference is divided by."""

    def __post_init__(self) -> None:
        if not (self.pitch_um > 0 and self.wavelength_nm > 0 and 0 < self.objective_na < 1):
            raise InputError(
                f"A microscope has a pixel pitch, a wavelength and an aperture below 1; got "
                f"{self.pitch_um:g} um, {self.wavelength_nm:g} nm, {self.objective_na:g}."
            )
        if not 0 < self.lit_share <= 1:
            raise InputError(f"lit_share lies between 0 and 1, not {self.lit_share:g}.")
        if self.illumination_na < self.objective_na:
            raise InputError(
                f"The LEDs' half circles (NA {self.illumination_na:g}) do not fill the objective's aperture "
                f"(NA {self.objective_na:g}): slow phases leave no trace then. Light more of the array."
            )


REGULARISATION = 0.1
"""Weight of the phase's curvature (in units of the aperture) against the data: keeps the finest structure,
which the pupil hardly passes, from drowning in noise; what is ten times as coarse as the aperture resolves
loses 0.06 %."""


def phase_from_halves(halves: Mapping[str, npt.ArrayLike], optics: DpcOptics) -> Float32Array:
    """Return the phase of a thin sample in radians, float32 (height, width), mean and mean slope zero.

    Halves of unequal brightness look like a sample tilted up to its edges: each is brought to its opposite's
    mean, within 3 : 1, and the tilt that is left is taken off.

    Raises InputError when a half is missing, shapes differ, there is no light, or a half has less than a
    third of its opposite's.

    Parameters
    ----------
    halves : mapping of str to array, (height, width)
        ``"left"``, ``"right"``, ``"top"``, ``"bottom"``: lit by the LEDs with negative and positive x, and
        with positive and negative y; dark frame subtracted.
    """
    images = {}
    for side in SIDES:
        if side not in halves:
            raise InputError(f"The half {side!r} is missing; needed are {', '.join(SIDES)}.")
        images[side] = np.asarray(halves[side], np.float64)
    shapes = {image.shape for image in images.values()}
    if len(shapes) != 1 or images["left"].ndim != 2:
        raise InputError(f"The halves must be grey images of one shape, not {sorted(shapes)}.")
    across = _contrast(images, "right", "left")
    down = _contrast(images, "top", "bottom")
    height, width = across.shape
    # A phase mirrored at the edges is continuous; its slope then changes sign across the mirror.
    x, y = _mirrored(across, odd_axis=1), _mirrored(down, odd_axis=0)
    transfer_x = transfer(x.shape, optics, axis=1)
    transfer_y = transfer(x.shape, optics, axis=0)
    power = np.abs(transfer_x) ** 2 + np.abs(transfer_y) ** 2
    seen = np.conj(transfer_x) * np.fft.fft2(x) + np.conj(transfer_y) * np.fft.fft2(y)
    radius = optics.objective_na / (1e-3 * optics.wavelength_nm)
    qy, qx = (np.fft.fftfreq(n, optics.pitch_um) for n in x.shape)
    power += REGULARISATION * ((qy[:, None] ** 2 + qx**2) / radius**2) ** 2
    power[0, 0] = 1.0  # the mean leaves no trace
    phase = np.fft.ifft2(seen / power).real[:height, :width]
    return np.asarray(level(phase), np.float32)


def level(surface: npt.ArrayLike) -> Float64Array:
    """Return a surface less the plane that fits it best."""
    values = np.asarray(surface, np.float64)
    y, x = (np.linspace(-1, 1, n) if n > 1 else np.zeros(1) for n in values.shape)
    tilt_y = float((y @ values).sum() / max((y**2).sum() * len(x), 1e-30))
    tilt_x = float((values @ x).sum() / max((x**2).sum() * len(y), 1e-30))
    return np.asarray(values - values.mean() - tilt_y * y[:, None] - tilt_x * x)


def transfer(shape: tuple[int, int], optics: DpcOptics, *, axis: int) -> npt.NDArray[np.complex128]:
    """Return the weak-phase transfer function ``H`` of one axis, on the frequencies of ``np.fft.fft2``.

    Parameters
    ----------
    shape : (int, int)
    axis : {0, 1}
        0: half with positive y minus the other; 1: the same along x.
    """
    radius = optics.objective_na / (1e-3 * optics.wavelength_nm)
    qy, qx = np.fft.fftfreq(shape[0], optics.pitch_um)[:, None], np.fft.fftfreq(shape[1], optics.pitch_um)
    along, beside = (qx, qy) if axis == 1 else (qy, qx)
    # Only points with P(s) = 1 have light for the sample's to interfere with. Of the lens in which P(s) and
    # P(s + q) overlap, each line along the axis is integrated exactly: slow phases move its ends by little.
    nodes, weights = np.polynomial.legendre.leggauss(_LINES)
    total = np.zeros(shape)
    for node, weight in zip(radius * nodes, radius * weights, strict=True):
        half = np.sqrt(radius**2 - node**2)
        other = np.sqrt(np.maximum(radius**2 - (node + beside) ** 2, 0.0))
        for sign in (1.0, -1.0):  # P(s + q), then P(s - q) with the line mirrored
            low, high = np.maximum(-half, -sign * along - other), np.minimum(half, -sign * along + other)
            lit = (high > low) & (other > 0)
            # The LED at +x sends its light towards -x: positive s belong to the negative half.
            total -= sign * weight * np.where(lit, np.abs(high) - np.abs(low), 0.0)
    return np.asarray(1j * total / (optics.lit_share * np.pi * radius**2), np.complex128)


def slopes_deg(height_um: Float32Array, pitch_um: float) -> Float64Array:
    """Return the magnitude of a surface's slope, degrees, (height, width)."""
    dy, dx = np.gradient(np.asarray(height_um, np.float64), pitch_um)
    return np.asarray(np.rad2deg(np.arctan(np.hypot(dy, dx))))


def deflections_deg(slope_deg: Float64Array, index: float) -> Float64Array:
    """Return by how much a surface of that slope deflects a ray at normal incidence into air, degrees.

    Snell's law at the textured exit: ``asin(n sin(slope)) - slope``.
    """
    slope = np.deg2rad(slope_deg)
    return np.asarray(np.rad2deg(np.arcsin(np.minimum(index * np.sin(slope), 1.0)) - slope))


def _contrast(images: Mapping[str, Float64Array], one: str, opposite: str) -> Float64Array:
    first, second = images[one], images[opposite]
    total = first + second
    if not (total.mean() > 0 and (total > 0).mean() > 0.99):
        raise InputError("The halves show no light above dark: are the LEDs on, and is the exposure right?")
    light = {side: float(images[side].mean()) for side in (one, opposite)}
    dim, bright = sorted(light, key=light.__getitem__)
    if light[bright] > _ALIKE * light[dim]:
        raise InputError(
            f"The half {dim!r} is dim: {light[dim]:.3g} counts of light, and {light[bright]:.3g} in its "
            f"opposite {bright!r}; at most {_ALIKE:g} times as many can be evened out. Are its LEDs on? "
            "Light it as its opposite is lit, and take the halves again."
        )
    second = second * (light[one] / light[opposite])  # in between the light may have changed
    total = first + second
    contrast = (first - second) / np.maximum(total, 1e-3 * float(total.mean()))
    return np.asarray(contrast)


def _mirrored(image: Float64Array, *, odd_axis: int) -> Float64Array:
    """Extend to twice the size: odd along one axis, even along the other."""
    for axis in (0, 1):
        mirror = np.flip(image, axis)
        image = np.concatenate([image, -mirror if axis == odd_axis else mirror], axis=axis)
    return image
