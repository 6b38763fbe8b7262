"""What the quasi-Newton method moves: a flat real vector, the SLM fields that it stands for, its loss."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from recon.arrays import Array, BoolArray
from recon.holography.model import Evaluation, HologramModel


class Point(NamedTuple):
    """What is kept of an evaluation."""

    loss: float
    psnr_db: float


class Variable(Protocol):
    """What the quasi-Newton method moves: how a flat real vector becomes SLM fields, and its loss."""

    @property
    def first_step(self) -> float:
        """Root mean square of the first step."""
        ...

    def pack(self, slm: Array) -> Array:
        """Return the vector of SLM fields, complex (n_frames, height, width)."""
        ...

    def field(self, x: Array) -> Array:
        """Return the SLM fields of a vector."""
        ...

    def evaluate(self, x: Array) -> tuple[Point, Array]:
        """Return loss and PSNR, and the gradient by the vector."""
        ...


def _of_part(model: HologramModel, slm: Array, part: float) -> Evaluation:
    """Evaluate a part of a field; the gradient is by the field."""
    if part == 1:
        return model.evaluate(slm)
    found = model.evaluate(slm * model.dtype.type(part))
    return replace(found, gradient=found.gradient * model.dtype.type(part))


# The methods are Variable's.
class Phase:
    """The SLM's phases as a flat real vector; where ``held`` is true they stay as they are.

    ``part``: the amplitude that reaches the mask, of a coded field.
    """

    held: BoolArray | None = None

    def __init__(self, model: HologramModel, part: float = 1.0) -> None:
        self.model, self.part = model, part
        self.first_step = 0.5
        """Root mean square of the first step, radians."""

    def pack(self, slm: Array) -> Array:  # noqa: D102
        phases: Array = np.angle(slm).astype(self.model.dtype.type(0).real.dtype)
        return phases.ravel()

    def field(self, x: Array) -> Array:  # noqa: D102
        slm: Array = self.model.xp.empty((self.model.frames, *self.model.display.slm_shape), self.model.dtype)
        phases = x.reshape(slm.shape)
        np.cos(phases, out=slm.real)
        np.sin(phases, out=slm.imag)
        return slm

    def evaluate(self, x: Array) -> tuple[Point, Array]:  # noqa: D102
        slm = self.field(x)
        found = _of_part(self.model, slm, self.part)
        # dL/dphi = 2 Im(gradient conj(s)); formed in place of the gradient's imaginary part.
        found.gradient.imag *= slm.real
        found.gradient.real *= slm.imag
        found.gradient.imag -= found.gradient.real
        gradient: Array = np.multiply(found.gradient.imag, 2).ravel()
        if self.held is not None:
            gradient[self.held] = 0
        return Point(found.loss, found.seen_psnr_db), gradient


class Bounded:
    """The field of a complex SLM, amplitude at most 1, as a flat real vector.

    ``s = z (1 + |z|^4)^(-1/4)`` takes any ``z`` into the disc, nearly unchanged where it is small: without a
    constraint to watch, L-BFGS walks as on the phases. (With ``(1 + |z|^2)^(-1/2)`` or the mean of two phases
    0.3 to 2.8 dB less after 100 iterations at 4x, 10 % of the light.)
    """

    def __init__(self, model: HologramModel, part: float = 1.0) -> None:
        self.model, self.part = model, part
        self.first_step = 0.5 * float(np.sqrt(model.options.share))

    def pack(self, slm: Array) -> Array:  # noqa: D102
        start = slm.astype(self.model.dtype)
        start *= np.minimum(1, 0.95 / np.maximum(np.abs(start), 1e-12))  # the disc's edge is infinitely far
        start *= (1 - np.abs(start) ** 4) ** -0.25
        return start.view(self._real).ravel()

    def field(self, x: Array) -> Array:  # noqa: D102
        z = self._inside(x)
        slm: Array = (z * (1 + np.abs(z) ** 4) ** -0.25).astype(self.model.dtype, copy=False)
        return slm

    def evaluate(self, x: Array) -> tuple[Point, Array]:  # noqa: D102
        z = self._inside(x)
        power = np.abs(z) ** 2
        shrink = (1 + power**2) ** -0.25
        found = _of_part(self.model, z * shrink, self.part)
        gradient = found.gradient
        # ds = shrink dz - shrink^5 |z|^2 z Re(conj(z) dz)
        radial = (np.conj(z) * gradient).real
        gradient = 2 * (shrink * gradient - (shrink**5 * power * radial) * z).astype(self.model.dtype)
        return Point(found.loss, found.seen_psnr_db), gradient.view(self._real).ravel()

    @property
    def _real(self) -> np.dtype[Any]:
        return np.empty(0, self.model.dtype).real.dtype

    def _inside(self, x: Array) -> Array:
        z: Array = x.view(self.model.dtype).reshape(self.model.frames, *self.model.display.slm_shape)
        return z


class Mirrors(Phase):
    """How much of the light each mirror sends, ``(1 + cos x) / 2``: whole turns of ``x`` send all of it.

    So two levels of ``x`` are the two states of a mirror, and mirrors are rounded as phases are.
    """

    def pack(self, slm: Array) -> Array:  # noqa: D102
        # At the ends a mirror would not move: a start is drawn a little inwards.
        inside = np.clip(2 * slm.real - 1, -0.8, 0.8)
        return np.asarray(np.arccos(inside), self.model.dtype.type(0).real.dtype).ravel()

    def field(self, x: Array) -> Array:  # noqa: D102
        slm = np.zeros((self.model.frames, *self.model.display.slm_shape), self.model.dtype)
        slm.real = 0.5 + 0.5 * np.cos(x.reshape(slm.shape))
        return slm

    def evaluate(self, x: Array) -> tuple[Point, Array]:  # noqa: D102
        found = self.model.evaluate(self.field(x))
        gradient: Array = (-np.sin(x) * found.gradient.real.ravel()).astype(x.dtype)
        if self.held is not None:
            gradient[self.held] = 0
        return Point(found.loss, found.seen_psnr_db), gradient


FIRST_ORDER = 1 / np.pi
"""Where a mirror sends light if ``cos(phase) > cos(arcsin(amplitude))``, a grating of period ``2 pi`` in the
phase has first orders of ``amplitude / pi``, one conjugate to the other (Lee 1979)."""


def decoded(patterns: Array) -> Array:
    """Return the field that patterns of mirrors code, where no mask is behind them."""
    spectrum = np.fft.fft2(2 * patterns.real - 1)
    spectrum[:, : patterns.shape[1] // 2] = 0  # kept: the quarter of the field where the picture is
    spectrum[:, :, patterns.shape[2] // 2 :] = 0
    return np.asarray(2 * np.fft.ifft2(spectrum), patterns.dtype)


def coded(slm: Array) -> Array:
    """Return the patterns of mirrors whose first order is a field of modulus at most 1, over pi."""
    sent = np.cos(np.angle(slm)) > np.cos(np.arcsin(np.minimum(np.abs(slm), 1)))
    return np.asarray(sent, slm.dtype)
