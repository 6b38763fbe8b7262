"""What an SLM does to its grey levels: the look-up table from interference, flatness from spots."""

from __future__ import annotations

import numpy as np

from recon.arrays import Array, Float64Array
from recon.errors import InputError

_OF_ELLIPSE = 5  # parameters
_ROUNDS = 60
_FLAT_CONE = 1e4  # condition beyond which pictures do not span a cone
MODES = ((2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3))
"""Powers of y and x of the flatness modes; constant and linear terms move nothing but the whole picture."""


def phases_from_frames(frames: Array) -> tuple[Float64Array, float]:
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
    float
        Standard deviation of a phase, radians, by how far the pictures lie off the ellipse.

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
    radius = np.hypot(*round_.T)
    error = float(np.sqrt(((radius / radius.mean() - 1) ** 2).sum() / max(len(u) - _OF_ELLIPSE, 1)))
    level_phases, level_error = _with_levels(flat, phases)
    if level_error < error:
        phases, error = level_phases, level_error
    phases = phases - phases[0]
    return (phases if phases[-1] >= 0 else -phases), error


def _with_levels(flat: Array, phases: Array) -> tuple[Float64Array, float]:
    """Let each picture have a brightness of its own; returns phases and their standard deviation, radians.

    ``s_n (a + b cos(phi_n) + c sin(phi_n))`` lies on a cone. Its apex tells every ``s_n`` but for what goes
    with the phase's own cosine and sine: they are taken not to, which is true to ``std(s) sqrt(2 / n)``.
    """
    values, vectors = np.linalg.eigh(flat @ flat.T)
    points = vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], 0))
    levels = np.ones(len(points))
    for _ in range(_ROUNDS):
        turn = np.stack([np.ones_like(phases), np.cos(phases), np.sin(phases)], axis=1)
        scaled = points / levels[:, None]
        model = np.linalg.lstsq(turn, scaled, rcond=None)[0]
        if np.linalg.cond(model) > _FLAT_CONE:
            return phases, float("inf")
        on_cone = turn @ model
        levels = (points * on_cone).sum(axis=1) / (on_cone**2).sum(axis=1)
        levels /= levels.mean()
        places = np.linalg.solve(model.T, (points / levels[:, None]).T).T
        phases = np.unwrap(np.arctan2(places[:, 2], places[:, 1]))
    radius = np.hypot(places[:, 1], places[:, 2]) / places[:, 0]
    noise = ((radius / radius.mean() - 1) ** 2).sum() / max(len(points) - _OF_ELLIPSE, 1)
    return phases, float(np.sqrt(noise + 2 * levels.var() / len(points)))


def mode(index: int, shape: tuple[int, int]) -> Float64Array:
    """Return a flatness mode on a grid over the SLM: orthonormal polynomials, rms 1."""
    basis = _basis(shape)
    found: Float64Array = basis[index]
    return found


def _basis(shape: tuple[int, int]) -> Array:
    y, x = (np.linspace(-1, 1, n) for n in shape)
    low = [np.multiply.outer(y**i, x**j).ravel() for i, j in ((0, 0), (1, 0), (0, 1))]
    high = [np.multiply.outer(y**i, x**j).ravel() for i, j in MODES]
    q, _ = np.linalg.qr(np.stack(low + high, axis=1))
    q = q * np.sign((q * np.stack(low + high, axis=1)).sum(axis=0))
    basis: Array = (q[:, 3:].T * np.sqrt(q.shape[0])).reshape(len(MODES), *shape)
    return basis


def flatness_jacobian(step: float) -> Float64Array:
    """Return how ``(a+ - a-) / (a+ + a-)`` of spot pairs answers to an error, per radian, (7, 7).

    The pair of mode ``p`` takes off ``+step`` and ``-step`` radians of it; a spot's amplitude is the mean of
    ``exp(j error)`` over the SLM.
    """
    basis = _basis((48, 64))
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
