"""Priors over time: what the frames of a block have to do with one another, as proximal maps of stacks.

A stack is (n_frames, height, width); each map takes it whole.
"""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from recon.base.threads import in_blocks

Array = npt.NDArray[Any]


class OverTime(Protocol):
    """A prior that couples frames."""

    def value(self, stack: Array) -> float:
        """Return the prior's value."""

    def prox(self, stack: Array, step: float) -> Array:
        """Return ``argmin_z 1/2 ||z - stack||^2 + step value(z)``, a new array."""


class TemporalTotalVariation:
    """``weight sum_t |x[t + 1] - x[t]|``: pixels keep their value but for jumps.

    The prox is exact, pixel by pixel (Condat 2013, "A direct algorithm for 1-D total variation denoising").
    """

    def __init__(self, weight: float) -> None:
        self.weight = weight

    def value(self, stack: Array) -> float:
        """Return the weighted sum of jumps."""
        return self.weight * float(np.sum(np.abs(np.diff(stack, axis=0)), dtype=np.float64))

    def prox(self, stack: Array, step: float) -> Array:
        """Denoise each pixel's course."""
        from recon.streams import _time_kernels

        courses = np.ascontiguousarray(stack.reshape(len(stack), -1).T)
        result = np.empty_like(courses)
        threshold = courses.dtype.type(step * self.weight)
        kernel = _time_kernels.denoise
        in_blocks(lambda a, b: kernel(a, b, courses, threshold, result), len(courses), grain=1024)
        return np.ascontiguousarray(result.T).reshape(stack.shape)


class LowRankPlusSparse:
    """``min_(L + S = x) weight_rank ||L||_* + weight_sparse ||S||_1``: background plus activity.

    Nuclear norm of the stack as a matrix of frames by pixels (Candès et al. 2011). The prox alternates
    between the two parts, from where it was last time; with a solver that calls it again and again the
    parts settle with it.

    Attributes
    ----------
    sparse : ndarray or None
        Of the last prox.
    """

    def __init__(self, weight_rank: float, weight_sparse: float, rounds: int = 2) -> None:
        self.weight_rank, self.weight_sparse, self.rounds = weight_rank, weight_sparse, rounds
        self.sparse: Array | None = None

    def value(self, stack: Array) -> float:
        """Return the value of the parts that the last prox found, scaled to add up to ``stack``."""
        sparse = np.zeros_like(stack) if self.sparse is None else self.sparse
        low = (stack - sparse).reshape(len(stack), -1)
        nuclear = float(np.sum(np.sqrt(np.maximum(np.linalg.eigvalsh(_gram(low)), 0))))
        return self.weight_rank * nuclear + self.weight_sparse * float(
            np.sum(np.abs(sparse), dtype=np.float64)
        )

    def prox(self, stack: Array, step: float) -> Array:
        """Return background plus activity."""
        sparse = np.zeros_like(stack) if self.sparse is None else self.sparse
        for _ in range(self.rounds):
            low = _shrunk_rank(stack - sparse, step * self.weight_rank)
            rest = stack - low
            limit = stack.dtype.type(step * self.weight_sparse)
            sparse = rest - np.clip(rest, -limit, limit)
        self.sparse = sparse
        together: Array = low + sparse
        return together


def _gram(matrix: Array) -> Array:
    product: Array = (matrix @ matrix.T).astype(np.float64)
    return product


def _shrunk_rank(stack: Array, threshold: float) -> Array:
    """Lessen a stack's singular values (frames by pixels), from the small matrix of frames by frames."""
    matrix = stack.reshape(len(stack), -1)
    values, vectors = np.linalg.eigh(_gram(matrix))
    singular = np.sqrt(np.maximum(values, 0))
    kept = np.where(singular > threshold, 1 - threshold / np.maximum(singular, 1e-30), 0)
    weights = ((vectors * kept) @ vectors.T).astype(stack.dtype)
    shrunk: Array = (weights @ matrix).reshape(stack.shape)
    return shrunk
