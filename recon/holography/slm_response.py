"""What an SLM does to its grey levels: the look-up table from interference, flatness from spots."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from recon.errors import InputError

Array = npt.NDArray[Any]

MODES = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of y and x of the flatness modes; constant and linear terms move nothing but the whole picture."""


def phases_from_frames(frames: Array) -> npt.NDArray[np.float64]:
    """Return the phase steps behind a series of interference pictures.

    Part of the SLM's pixels shows level 0, the others one level after the other. Every camera pixel then sees
    ``a + b cos(phi_n) + c sin(phi_n)`` with ``a, b, c`` of its own, whatever optics, mask and DC light are in
    between. So all pictures lie on an ellipse in a plane; its equation turns them into phases.

    Parameters
    ----------
    frames : ndarray, (n_levels, ...), at least 8
        One picture a level, background subtracted, equal exposure.

    Returns
    -------
    ndarray, float64, (n_levels,)
        Unwrapped, 0 at the first level, and growing with the level (the sign cannot be told from pictures).

    Raises InputError when the pictures do not lie on an ellipse: too little phase, too much noise, or
    unstable light.
    """
    flat = np.asarray(frames, np.float64).reshape(len(frames), -1)
    if len(flat) < 8:
        raise InputError(f"At least 8 levels are needed, not {len(flat)}.")
    centred = flat - flat.mean(axis=0)
    # The pictures' inner products suffice: as many as levels squared, not as pixels.
    values, vectors = np.linalg.eigh(centred @ centred.T)
    scores = vectors[:, ::-1][:, :2] * np.sqrt(np.maximum(values[::-1][:2], 0))
    if values[::-1][1] <= 4 * max(values[::-1][2], 0.0):
        raise InputError(
            "The pictures do not change as interference does: look for unstable light, saturation, or an SLM "
            "whose phase hardly changes with the level."
        )
    u, v = (scores / np.abs(scores).max()).T
    design = np.stack([u * u, u * v, v * v, u, v], axis=1)
    a, b, c, d, e = np.linalg.lstsq(design, np.ones(len(u)), rcond=None)[0]
    form = np.array([[a, b / 2], [b / 2, c]])
    if np.linalg.det(form) <= 0 or a <= 0:
        raise InputError("The phase covers too little of a turn for the look-up table to be measured.")
    centre = np.linalg.solve(-2 * form, [d, e])
    root = np.linalg.cholesky(form).T
    round_ = (np.stack([u, v], axis=1) - centre) @ root.T
    phases = np.unwrap(np.arctan2(round_[:, 1], round_[:, 0]))
    phases -= phases[0]
    growing: npt.NDArray[np.float64] = phases if phases[-1] >= 0 else -phases
    return growing


def mode(index: int, shape: tuple[int, int]) -> npt.NDArray[np.float64]:
    """Return a flatness mode on a grid over the SLM: orthonormal polynomials, rms 1."""
    basis = _basis(shape)
    found: npt.NDArray[np.float64] = basis[index]
    return found


def _basis(shape: tuple[int, int]) -> Array:
    y, x = (np.linspace(-1, 1, n) for n in shape)
    low = [np.multiply.outer(y**i, x**j).ravel() for i, j in ((0, 0), (1, 0), (0, 1))]
    high = [np.multiply.outer(y**i, x**j).ravel() for i, j in MODES]
    q, _ = np.linalg.qr(np.stack(low + high, axis=1))
    q = q * np.sign((q * np.stack(low + high, axis=1)).sum(axis=0))
    basis: Array = (q[:, 3:].T * np.sqrt(q.shape[0])).reshape(len(MODES), *shape)
    return basis


def flatness_jacobian(step: float, shape: tuple[int, int] = (48, 64)) -> npt.NDArray[np.float64]:
    """Return how ``(a+ - a-) / (a+ + a-)`` of spot pairs answers to an error, per radian, (7, 7).

    The pair of mode ``p`` takes off ``+step`` and ``-step`` radians of it; a spot's amplitude is the mean of
    ``exp(j error)`` over the SLM.
    """
    basis = _basis(shape)
    small = 0.1
    jacobian = np.zeros((len(MODES), len(MODES)))
    for q, error in enumerate(basis):
        sides = []
        for sign in (1, -1):
            plus, minus = (
                np.abs(np.exp(1j * (sign * small * error - s * step * basis)).mean(axis=(1, 2)))
                for s in (1, -1)
            )
            sides.append((plus - minus) / (plus + minus))
        jacobian[:, q] = (sides[0] - sides[1]) / (2 * small)
    return jacobian
