"""Active illumination: a scene lit by known patterns in turn, reconstructed from all frames together.

Each pattern lights part of the scene, so that each frame is that of a sparser scene, whose light is spread
over the sensor less mixed up: ``b_k = A (p_k x) + noise`` with patterns ``p_k`` of the scene's pixels. One
picture ``x`` explains all frames; nothing of it may move meanwhile.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.checks import as_channels, select_psf
from recon.base.noise import NoiseModel
from recon.camera.base import Array, LinearOperator
from recon.camera.convolution import PadCropConvolution
from recon.errors import InputError
from recon.priors import PRIORS
from recon.reconstruction.picture import LEAST_TAU, NOISE_WEIGHT
from recon.reconstruction.preparation import channel_noise
from recon.reconstruction.result import ImageGrid, Reconstruction
from recon.solvers.fista import Fista
from recon.solvers.stopping import IterationRecord, StoppingRules
from recon.types import Calibration, Geometry

Floats = npt.NDArray[np.float32]

ITERATIONS, TOLERANCE = 300, 2e-4


class PatternedCamera(LinearOperator):
    """``x -> (A (p_1 x), ..., A (p_K x))``.

    Parameters
    ----------
    psf : ndarray, (height, width)
    patterns : ndarray, (n_patterns, height, width)
        Relative light on the part of the scene opposite to the sensor; beyond it the nearest edge's.
    dtype : dtype
    """

    def __init__(self, psf: Array, patterns: Array, dtype: npt.DTypeLike = np.float32) -> None:
        sensor_shape = (patterns.shape[1], patterns.shape[2])
        self.camera = PadCropConvolution(psf[None], sensor_shape, dtype=dtype)
        (row, column), grid = self.camera.centre, self.camera.grid_shape
        self.window = (
            slice(row - sensor_shape[0] // 2, row - sensor_shape[0] // 2 + sensor_shape[0]),
            slice(column - sensor_shape[1] // 2, column - sensor_shape[1] // 2 + sensor_shape[1]),
        )
        margins = [(w.start, n - w.stop) for w, n in zip(self.window, grid, strict=True)]
        self._patterns = np.pad(patterns, ((0, 0), *margins), mode="edge").astype(dtype)
        super().__init__(self.camera.domain_shape, (len(patterns), *sensor_shape), dtype)
        brightest = float(np.max(np.sum(self._patterns.astype(np.float64) ** 2, axis=0)))
        self._norm_bound = self.camera.norm_bound * float(np.sqrt(brightest))

    def forward(self, x: Array, out: Array | None = None) -> Array:
        """Return the frames of a scene (1, grid height, grid width)."""
        out = np.empty(self.range_shape, self.dtype) if out is None else out
        for frame, pattern in zip(out, self._patterns, strict=True):
            frame[...] = self.camera.forward(pattern * x)[0]
        return out

    def adjoint(self, y: Array, out: Array | None = None) -> Array:
        """Correlate each frame with the PSF, weigh it with its pattern, and add up."""
        out = np.zeros(self.domain_shape, self.dtype) if out is None else out
        out[...] = 0
        for frame, pattern in zip(y, self._patterns, strict=True):
            out += pattern * self.camera.adjoint(frame[None])
        return out

    @property
    def norm_bound(self) -> float:
        """``max |H|`` times the root of the brightest pixel's summed squared patterns."""
        return self._norm_bound


def reconstruct_patterned(
    frames: npt.ArrayLike,
    patterns: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None = None,
    prior: str = "tv-haar",
    tau: float | None = None,
    noise: NoiseModel | float | None = None,
    background: npt.ArrayLike | float = 0.0,
    iterations: int = ITERATIONS,
    watch: Callable[[IterationRecord], object] | None = None,
    cancel: threading.Event | None = None,
) -> Reconstruction:
    """Reconstruct one grey picture from frames lit by known patterns.

    Parameters
    ----------
    frames : array, (n_patterns, height, width)
        Counts, of one exposure time.
    patterns : array, (n_patterns, height, width)
        Relative light of each pattern on the pixels of the picture, not negative: a reconstruction of a plain
        sheet lit by it. A picture of one pattern of ones is the ordinary one.
    calibration, z_um, noise, tau
        As :func:`recon.reconstruct`.
    prior : str
        One of :data:`recon.priors.PRIORS`; ``"tv"`` has an exact, slower prox.
    background : array or number
        Subtracted from each frame.
    iterations : int
    watch : callable, optional
        Called with the record of each iteration.
    cancel : threading.Event, optional

    Raises
    ------
    InputError
        When frames, patterns and PSF do not fit one another.
    """
    data = np.asarray(frames, np.float32) - np.asarray(background, np.float32)
    lit = np.asarray(patterns, np.float32)
    geometry, psf_z_um = Geometry(), None
    if isinstance(calibration, Calibration):
        psfs, psf_z_um = select_psf(calibration, z_um)
        geometry = calibration.geometry
    else:
        psfs = as_channels(calibration, "PSF")
    if data.ndim != 3 or lit.shape != data.shape:
        raise InputError(
            f"One pattern a frame is expected, both (n, height, width); got frames {data.shape} and patterns "
            f"{lit.shape}."
        )
    if len(psfs) != 1 or psfs.shape[1:] != data.shape[1:]:
        raise InputError(f"A grey PSF of {data.shape[1:]} pixels is expected, not {psfs.shape}.")
    if not np.isfinite(data).all() or not np.isfinite(lit).all():
        raise InputError("Frames and patterns must be finite numbers.")
    if lit.min() < 0 or not lit.any():
        raise InputError("Patterns must not be negative, nor all dark.")
    if prior not in PRIORS:
        raise InputError(f"The prior {prior!r} is not known. Choose one of {', '.join(PRIORS)}.")
    valid = np.ones(data.shape[1:], bool)
    deviation = float(np.sqrt(np.mean([channel_noise(frame, valid, noise) ** 2 for frame in data])))
    energy = float(np.linalg.norm(psfs.astype(np.float64)))
    camera = PatternedCamera(psfs[0] / energy, lit)
    scaled = data / np.float32(deviation)
    peak = float(np.max(np.abs(camera.adjoint(scaled))))
    weight = max(NOISE_WEIGHT, LEAST_TAU * peak) if tau is None else tau * peak
    solver = Fista(camera, scaled, PRIORS[prior](weight))
    outcome = solver.run(
        StoppingRules(iterations=iterations, tolerance=TOLERANCE),
        callback=None if watch is None else lambda _, record: watch(record),
        cancel=cancel,
    )
    image = outcome.solution[0][camera.window] * np.float32(deviation / energy)
    height, width = image.shape
    provenance: dict[str, Any] = {"patterns": len(lit), "noise_deviation": deviation, "psf_z_um": psf_z_um}
    return Reconstruction(
        image=np.ascontiguousarray(image, np.float32),
        grid=ImageGrid((height, width), (height // 2, width // 2), geometry.pixel_pitch_um, None, z_um),
        method="fista",
        prior=prior,
        tau=weight / peak if peak > 0 else None,
        noise_norm=float(np.sqrt(scaled.size)),
        history=outcome.history,
        stop_reason=outcome.stop_reason,
        seconds=outcome.seconds,
        provenance=provenance,
    )
