"""From image files to holograms: prepare the targets, run the optimiser, judge what will be seen."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files.errors import BenchError, FileError
from instrument.files.images import read_image
from recon.holography import (
    Budget,
    Display,
    Grid,
    Hologram,
    HologramModel,
    HologramRecord,
    Loss,
    Scores,
    Target,
    compute_hologram,
    foveal_weights,
)
from recon.holography.judge import compare
from recon.holography.lowpass import make_band
from recon.holography.optimise import Method

Fit = Literal["cover", "contain", "stretch"]
Envelope = Literal["shade", "correct", "ignore"]
Image = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HologramRequest:
    """How to compute a hologram, apart from display and targets.

    Attributes
    ----------
    method, loss_kind, grid : see :mod:`recon.holography`
    weights : ndarray or None
        For the loss "spatial".
    frames : int
    complex_slm : bool
    phase_levels : int or None
        Of the SLM; None: continuous.
    envelope : "shade", "correct" or "ignore"
        What becomes of the mask pixels' envelope: the target gets it too (a picture darker at the border),
        the hologram works against it, or it is left out of the model.
    budget : Budget
    seed : int
    """

    method: Method = "lbfgs"
    loss_kind: Literal["none", "frequency", "spatial"] = "frequency"
    weights: npt.NDArray[Any] | None = None
    grid: Grid = "alias_free"
    frames: int = 1
    complex_slm: bool = False
    phase_levels: int | None = None
    envelope: Envelope = "shade"
    budget: Budget = field(default_factory=lambda: Budget(iterations=100))
    seed: int = 0

    def display_of(self, display: Display) -> Display:
        """Return the display as it is modelled for this request: without the envelope where it is ignored."""
        return replace(display, mask_fill=0.0) if self.envelope == "ignore" else display


@dataclass(frozen=True, slots=True)
class HologramResult:
    """A hologram and what will be seen of it, plane by plane.

    Attributes
    ----------
    hologram : Hologram
    wanted, seen, unfiltered : tuple of ndarray
        Target and image through the eye's low-pass, and the image before it, in units of the target's white.
    scores : tuple of Scores
        Alias-free, with the request's envelope and all frames.
    """

    hologram: Hologram
    wanted: tuple[Image, ...]
    seen: tuple[Image, ...]
    unfiltered: tuple[Image, ...]
    scores: tuple[Scores, ...]

    def facts(self, request: HologramRequest) -> dict[str, Any]:
        """Return metrics and settings, JSON-compatible."""
        last = self.hologram.history[-1]
        return {
            "computed": True,
            "metrics": [asdict(score) for score in self.scores],
            "metrics_computed_for": {
                "grid": "alias_free",
                "envelope": request.envelope,
                "frames": request.frames,
                "phase_levels": request.phase_levels or "continuous",
            },
            "optimised_on_grid": request.grid,
            "method": request.method,
            "loss": request.loss_kind,
            "complex_slm": request.complex_slm,
            "seed": request.seed,
            "iterations": last.iteration,
            "seconds": round(self.hologram.seconds, 3),
            "stopped": str(self.hologram.stop_reason),
        }


def run_request(
    display: Display,
    targets: Sequence[Target],
    request: HologramRequest,
    *,
    initial: npt.NDArray[Any] | None = None,
    callback: Callable[[HologramRecord, Any], object] | None = None,
    cancel: threading.Event | None = None,
) -> HologramResult:
    """Compute one hologram (of one or more planes) and judge it on the alias-free grid."""
    loss = Loss(request.loss_kind, request.weights)
    model = HologramModel(display, targets, loss, grid=request.grid, frames=request.frames)
    hologram = compute_hologram(
        model,
        method=request.method,
        budget=request.budget,
        complex_slm=request.complex_slm,
        phase_levels=request.phase_levels,
        initial=initial,
        seed=request.seed,
        callback=callback,
        cancel=cancel,
    )
    if request.grid != "alias_free":
        model = HologramModel(display, targets, loss, frames=request.frames)
    planes = range(len(targets))
    wanted = tuple(np.asarray(model.wanted(p), float) / model.peaks[p] for p in planes)
    seen = tuple(np.asarray(model.seen(hologram.slm, p), float) / model.peaks[p] for p in planes)
    raw = tuple(np.asarray(model.intensity(hologram.slm, p), float) / model.peaks[p] for p in planes)
    scores = tuple(compare(s, w, 1.0) for s, w in zip(seen, wanted, strict=True))
    return HologramResult(hologram, wanted, seen, raw, scores)


def prepare_target(
    pixels: npt.NDArray[Any],
    display: Display,
    *,
    z_mm: float = 0.0,
    fit: Fit = "cover",
    srgb: bool = False,
    envelope: Envelope = "shade",
) -> Target:
    """Turn a picture into a target over the whole field of view, which is square.

    Parameters
    ----------
    pixels : ndarray, (height, width), or (height, width, 3), of which the mean of the channels is taken
        Intensity; 0 is black, an integer type's greatest value (float: the maximum) is white.
    z_mm : float
    fit : "cover", "contain" or "stretch"
        A picture that is not square loses its sides, gets black borders, or is stretched.
    srgb : bool
        The values are sRGB-coded and are decoded to intensity.
    envelope : "shade", "correct" or "ignore"
        "shade" multiplies the target by the display's envelope.
    """
    image = field_picture(pixels, fit=fit, srgb=srgb)
    small = make_band(display.slm_shape, display.factor, "alias_free").seen_shape
    if image.shape[0] < small[0] or image.shape[1] < small[1]:
        wide, high = max(small[1], image.shape[1]), max(small[0], image.shape[0])
        image = cv2.resize(image, (wide, high), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    if envelope == "shade":
        ey, ex = (np.fft.fftshift(e) for e in display.envelope((image.shape[0], image.shape[1])))
        image = image * ey[:, None] * ex
    return Target(image, z_mm, white=1.0)


def field_picture(
    pixels: npt.NDArray[Any], *, fit: Fit = "cover", srgb: bool = False
) -> npt.NDArray[np.float64]:
    """Return a picture as it fills the square field, intensity in 0 to 1; parameters as ``prepare_target``.

    Stretched, it keeps its own number of pixels.
    """
    image = np.asarray(pixels, np.float64)
    if image.ndim == 3:
        image = image.mean(axis=2)
    image /= _white(pixels)
    if srgb:
        image = np.where(image <= 0.04045, image / 12.92, ((np.abs(image) + 0.055) / 1.055) ** 2.4)
    height, width = image.shape
    side = min(height, width) if fit == "cover" else max(height, width)
    if fit == "cover":
        top, left = (height - side) // 2, (width - side) // 2
        image = image[top : top + side, left : left + side]
    elif fit == "contain":
        top, left = (side - height) // 2, (side - width) // 2
        image = np.pad(image, ((top, side - height - top), (left, side - width - left)))
    return image


def _white(pixels: npt.NDArray[Any]) -> float:
    if pixels.dtype == np.uint8:
        return 255.0
    return 65535.0 if pixels.dtype == np.uint16 else max(float(pixels.max()), 1e-30)


def read_weights(path: Path) -> npt.NDArray[np.float64]:
    """Read a weight image (grey, any scale); errors as ``read_image``."""
    pixels = read_image(path).pixels
    if pixels.ndim != 2 or pixels.min() < 0 or pixels.max() <= 0:
        raise FileError(path, "is no weight image: grey, not negative, not all zero.")
    return np.asarray(pixels, np.float64)


def foveal(centre: str, radius: float, periphery: float) -> npt.NDArray[np.float64]:
    """Return foveal weights from a text ``"Y,X"`` in fractions of the field."""
    try:
        y, x = (float(part) for part in centre.split(","))
    except ValueError:
        raise BenchError(f"--centre {centre!r}: write Y,X in fractions of the field, e.g. 0.5,0.5.") from None
    if not (0 <= y <= 1 and 0 <= x <= 1):
        raise BenchError(f"--centre {centre}: both fractions lie in 0 to 1.")
    return foveal_weights((256, 256), centre=(y, x), radius=radius, periphery=periphery)
