"""From image files to holograms: prepare the targets, run the optimiser, judge what will be seen."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from instrument.files.errors import FileError
from instrument.files.images import read_image
from recon.base.declare import record
from recon.holography import (
    Display,
    Hologram,
    HologramModel,
    HologramOptions,
    HologramRecord,
    Scores,
    Target,
    compute_hologram,
)
from recon.holography.judge import compare
from recon.holography.options import Fit
from recon.holography.target import make_band

Image = npt.NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class HologramResult:
    """A hologram and what will be seen of it, plane by plane.

    Attributes
    ----------
    hologram : Hologram
    wanted, seen, unfiltered : tuple of ndarray
        Target and image through the eye's low-pass, and the image before it, in units of the target's white.
    scores : tuple of Scores
        Alias-free, with the envelope that was asked for and all frames.
    """

    hologram: Hologram
    wanted: tuple[Image, ...]
    seen: tuple[Image, ...]
    unfiltered: tuple[Image, ...]
    scores: tuple[Scores, ...]

    def facts(self, options: HologramOptions) -> dict[str, Any]:
        """Return metrics and options, JSON-compatible."""
        last = self.hologram.history[-1]
        return {
            "computed": True,
            "metrics": [asdict(score) for score in self.scores],
            "metrics_computed_for": {
                "grid": "alias-free",
                "envelope": options.envelope,
                "frames": options.frames,
                "phase_levels": options.phase_levels or "continuous",
            },
            "options": record(options),
            "iterations": last.iteration,
            "seconds": round(self.hologram.seconds, 3),
            "stopped": str(self.hologram.stop_reason),
        }


def compute_and_judge(
    display: Display,
    targets: Sequence[Target],
    options: HologramOptions | None = None,
    *,
    initial: npt.NDArray[Any] | None = None,
    callback: Callable[[HologramRecord, Any], object] | None = None,
    cancel: threading.Event | None = None,
) -> HologramResult:
    """Compute one hologram (of one or more planes) and judge it on the alias-free grid."""
    model = HologramModel(display, targets, options)
    hologram = compute_hologram(model, initial=initial, callback=callback, cancel=cancel)
    if model.options.grid != "alias-free":
        model = HologramModel(display, targets, options, grid="alias-free")
    planes = range(len(targets))
    wanted = tuple(np.asarray(model.wanted(p), float) / model.peaks[p] for p in planes)
    seen = tuple(np.asarray(model.seen(hologram.slm, p), float) / model.peaks[p] for p in planes)
    raw = tuple(np.asarray(model.intensity(hologram.slm, p), float) / model.peaks[p] for p in planes)
    scores = tuple(compare(s, w, 1.0) for s, w in zip(seen, wanted, strict=True))
    return HologramResult(hologram, wanted, seen, raw, scores)


def prepare_target(
    pixels: npt.NDArray[Any],
    display: Display,
    options: HologramOptions | None = None,
    *,
    z_mm: float = 0.0,
) -> Target:
    """Turn a picture into a target over the whole field of view, which is square.

    Parameters
    ----------
    pixels : ndarray, (height, width), or (height, width, 3), of which the mean of the channels is taken
        Intensity; 0 is black, an integer type's greatest value (float: the maximum) is white.
    options : HologramOptions
        Its ``fit``, ``srgb`` and ``envelope``.
    z_mm : float
    """
    options = options or HologramOptions()
    image = field_picture(pixels, fit=options.fit, srgb=options.srgb)
    small = make_band(display.slm_shape, display.factor, "alias-free").seen_shape
    if image.shape[0] < small[0] or image.shape[1] < small[1]:
        wide, high = max(small[1], image.shape[1]), max(small[0], image.shape[0])
        image = cv2.resize(image, (wide, high), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    if options.envelope == "shade":
        ey, ex = (np.fft.fftshift(e) for e in display.envelope((image.shape[0], image.shape[1])))
        image = image * ey[:, None] * ex
    return Target(image, z_mm, white=1.0)


def field_picture(
    pixels: npt.NDArray[Any], *, fit: Fit = "cover", srgb: bool = False
) -> npt.NDArray[np.float64]:
    """Return a picture as it fills the square field, intensity in 0 to 1; see :class:`HologramOptions`.

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
