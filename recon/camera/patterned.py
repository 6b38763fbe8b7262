"""Active illumination: a scene lit by known patterns in turn, seen by any camera.

Each pattern lights part of the scene, so that each frame is that of a sparser scene, whose light is spread
over the sensor less mixed up: ``b_k = A (p_k x) + noise`` with patterns ``p_k`` of the scene's pixels. One
object ``x`` explains all frames; nothing of it may move meanwhile.
"""

from __future__ import annotations

import numpy as np

from recon.camera.base import Array, LinearOperator


class PatternedCamera(LinearOperator):
    """``x -> (A (p_1 x), ..., A (p_K x))``.

    Parameters
    ----------
    camera : LinearOperator
        Of one channel: domain (1, n_z, grid height, grid width), range (1, height, width).
    patterns : ndarray, (n_patterns, height, width)
        Relative light on the part of the scene opposite to the sensor; beyond it the nearest edge's.
    window : (slice, slice)
        Where that part lies on the camera's grid.
    """

    def __init__(self, camera: LinearOperator, patterns: Array, window: tuple[slice, slice]) -> None:
        self.camera, self.window = camera, window
        grid = camera.domain_shape[2:]
        margins = [(w.start, n - w.stop) for w, n in zip(window, grid, strict=True)]
        self._patterns = np.pad(patterns, ((0, 0), *margins), mode="edge").astype(camera.dtype)
        super().__init__(camera.domain_shape, (len(patterns), *camera.range_shape[1:]), camera.dtype)
        brightest = float(np.max(np.sum(self._patterns.astype(np.float64) ** 2, axis=0)))
        self._norm_bound = camera.norm_bound * float(np.sqrt(brightest))

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return the frames of a scene (1, n_z, grid height, grid width)."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        for frame, pattern in zip(out, self._patterns, strict=True):
            frame[...] = self.camera.forward(pattern * x)[0]
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Apply the camera's adjoint to each frame, weigh it with its pattern, and add up."""
        out = np.zeros(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        for frame, pattern in zip(y, self._patterns, strict=True):
            out += pattern * self.camera.adjoint(frame[None])
        return out

    @property
    def norm_bound(self) -> float:
        """The camera's times the root of the brightest pixel's summed squared patterns."""
        return self._norm_bound
