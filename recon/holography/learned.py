"""What photographs taught of one display: how its SLM, light, lens and mask differ from the plain.

In the symbols of :mod:`recon.holography.model`, with ``phi`` the phase that a pixel is asked for::

    phi' = K phi                        cross-talk: smoothed across pixel borders
    s    = A (r(phi') exp(j phi') + d)  response, light not modulated, illumination and wavefront
    e    = sinc^2 exp(v_y + v_x)        mask pixels' envelope and vignetting

``r`` is linear between levels, ``log A``, ``v`` are Legendre polynomials.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from numpy.polynomial.legendre import legvander

from recon.arrays import Array, Float64Array
from recon.errors import InputError

_SHADE_ORDERS = (1, 2, 3, 4)


@dataclass(frozen=True, slots=True)
class Learned:
    """How a display differs from a plain one.

    Attributes
    ----------
    response : ndarray, float64, (n_levels + 1, 2)
        Real and imaginary part of ``r``, from phase 0 to a whole turn; 1 where the SLM does as it is told.
    dc : ndarray, float64, (2,)
        Light that is not modulated, in the same unit.
    crosstalk_px : ndarray, float64, (2,)
        Width of what smooths the phase, down and across, standard deviation in SLM pixels.
    amplitude, phase : ndarray, float64, (n,)
        Of ``log A``, coefficients of :func:`terms`: the illumination, and the SLM's flatness error together
        with the lens' wavefront.
    shade : ndarray, float64, (2, 4)
        Of the logarithm of the light that reaches the camera from a place in the field, over y and over x.
    mask_depth : float
        Phase of the mask's steps over what they should be.
    """

    response: Float64Array
    dc: Float64Array
    crosstalk_px: Float64Array
    amplitude: Float64Array
    phase: Float64Array
    shade: Float64Array
    mask_depth: float

    def __post_init__(self) -> None:
        arrays = (self.response, self.dc, self.crosstalk_px, self.amplitude, self.phase, self.shade)
        if not all(np.isfinite(array).all() for array in arrays) or not np.isfinite(self.mask_depth):
            raise InputError("What was learned of a display has values that are not finite.")
        if self.response.ndim != 2 or self.response.shape[1:] != (2,) or len(self.response) < 2:
            raise InputError(f"A learned response is (levels, 2), not {self.response.shape}.")
        if self.dc.shape != (2,) or self.crosstalk_px.shape != (2,) or self.shade.shape != (2, 4):
            raise InputError("Of a learned display dc and crosstalk_px are 2 numbers, shade is 2 x 4.")
        order_of(len(self.amplitude))
        order_of(len(self.phase))

    def at(self, turns: float) -> Learned:
        """Return what this says of the display in light in which phases are ``turns`` times as large.

        Errors are optical paths and amplitudes: those of a pixel belong to its height, those of the light
        that reaches the camera to its angle. Light that is not modulated keeps its phase; glass and liquid
        crystal have no dispersion.
        """
        if turns == 1:
            return self
        count = len(self.response)
        known = self.response[:, 0] + 1j * self.response[:, 1]
        turn = np.arange(count) / (count - 1)
        # What a phase needs of the pixel: less than a turn of before at a shorter wavelength.
        at = np.mod(turn / turns, 1)
        error = np.interp(at, turn, np.unwrap(np.angle(known))) * turns
        response = np.interp(at, turn, np.abs(known)) * np.exp(1j * error)
        places = np.linspace(-1, 1, 1 + max(_SHADE_ORDERS))
        here, there = (legvander(x, max(_SHADE_ORDERS))[:, 1:] for x in (places, places / turns))
        whole = np.column_stack([np.ones_like(places), here])  # what is constant over the field is left out
        shade = [np.linalg.solve(whole, there @ row)[1:] for row in self.shade]
        return replace(
            self,
            response=np.stack([response.real, response.imag], axis=-1),
            phase=self.phase * turns,
            shade=np.array(shade),
        )

    def illumination(self, shape: tuple[int, int]) -> npt.NDArray[np.complex64]:
        """Return ``A`` over the SLM on a grid of any size, mean power 1."""
        log: Array = np.zeros(shape, complex)
        for coefficients, unit in ((self.amplitude, 1), (self.phase, 1j)):
            for value, (i, j) in zip(coefficients, terms(order_of(len(coefficients))), strict=True):
                if value:
                    log += unit * value * np.multiply.outer(legendre(i, shape[0]), legendre(j, shape[1]))
        field = np.exp(log)
        return np.asarray(field / np.sqrt(np.mean(np.abs(field) ** 2)), np.complex64)

    def shading(self, shape: tuple[int, int]) -> tuple[Array, Array]:
        """Return what reaches the camera over the field, in FFT order, as a column and a row."""
        return self.shading_at(*(np.fft.fftfreq(n) for n in shape))

    def shading_at(self, y: Array, x: Array) -> tuple[Array, Array]:
        """Return what reaches the camera from places in fractions of the field, 0 its middle: by y, by x."""
        from scipy.special import eval_legendre

        down, across = (
            np.exp(sum(c * eval_legendre(n, 2 * at) for n, c in zip(_SHADE_ORDERS, row, strict=True)))
            for row, at in zip(self.shade, (y, x), strict=True)
        )
        return down, across


def terms(order: int) -> list[tuple[int, int]]:
    """Return powers ``(y, x)`` of the polynomials up to an order, without the constant."""
    return [(n - j, j) for n in range(1, order + 1) for j in range(n + 1)]


def order_of(count: int) -> int:
    """Return the order whose :func:`terms` are so many; InputError where there is none."""
    for order in range(41):
        if len(terms(order)) == count:
            return order
    raise InputError(f"{count} coefficients are those of no order of polynomials.")


def legendre(order: int, n: int) -> Float64Array:
    """Return a Legendre polynomial over ``n`` pixels, rms about 1."""
    from scipy.special import eval_legendre

    places = (np.arange(n) + 0.5) / n * 2 - 1
    return np.asarray(np.sqrt(2 * order + 1) * eval_legendre(order, places), np.float64)
