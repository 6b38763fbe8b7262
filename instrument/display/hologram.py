"""From image files to holograms: targets, optimiser, verdict."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from math import ceil
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from instrument.files.errors import BenchError, FileError
from instrument.files.images import ImageFile, read_image
from recon.arrays import Array, Float64Array
from recon.base.declare import option, record
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
from recon.holography.limit import limited_by
from recon.holography.options import Fit
from recon.holography.scores import compare
from recon.holography.target import EVERYWHERE, FIRST_ORDER, Window, band_of, near_window

JUDGED_PX = 21
"""Along each axis, at least: the middle half has 11 then, the SSIM's window."""


HOLOGRAM, PHOTOGRAPHED = "hologram", "Photographed, with --capture"
"""What options of photographs are about, and their heading."""


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """How a hologram is photographed."""

    average: int = option(4, least=1, help="Photographs a frame.", applies=(HOLOGRAM,), group=PHOTOGRAPHED)
    refine: int = option(
        0,
        least=0,
        help="Rounds with the camera in the loop; writes PATTERN-refined.png.",
        applies=(HOLOGRAM,),
        group=PHOTOGRAPHED,
    )


@dataclass(frozen=True, slots=True)
class HologramResult:
    """A hologram and what will be seen of it, plane by plane."""

    hologram: Hologram
    wanted: tuple[Float64Array, ...]
    seen: tuple[Float64Array, ...]
    unfiltered: tuple[Float64Array, ...]
    """Target and image through the eye's low-pass, and the image before; in units of the target's white."""
    scores: tuple[Scores, ...]
    """Alias-free, with the envelope that was asked for and all frames."""
    efficiency: float
    """Part of the light on the SLM that reaches the field, DC term and envelope included; of mirrors the part
    that reaches the picture."""
    limited_by: tuple[str, ...] = ()
    """What keeps it from being better, in words."""
    depths_mm: tuple[float, ...] = (0.0,)
    """Of its planes."""

    def facts(self, options: HologramOptions) -> dict[str, Any]:
        """Return metrics and options, JSON-compatible."""
        last = self.hologram.history[-1]
        return {
            "computed": True,
            "z_mm": list(self.depths_mm),
            "metrics": [asdict(score) for score in self.scores],
            "efficiency": round(self.efficiency, 6),
            "limited_by": list(self.limited_by),
            "metrics_computed_for": {
                "grid": "alias-free",
                "envelope": options.envelope,
                "frames": options.frames,
                "phase_levels": options.phase_levels or "continuous",
            },
            "options": record(options),
            "own_weights": options.weights is not None,
            "iterations": last.iteration,
            "seconds": round(self.hologram.seconds, 3),
            "stopped": str(self.hologram.stop_reason),
        }


def compute_and_judge(
    display: Display,
    targets: Sequence[Target],
    options: HologramOptions | None = None,
    *,
    initial: Array | None = None,
    callback: Callable[[HologramRecord, Any], object] | None = None,
    cancel: threading.Event | None = None,
    part: Window | None = None,
) -> HologramResult:
    """Compute one hologram (of one or more planes) and judge it on the alias-free grid.

    ``part`` is where in the field it is judged; by default where the targets count. What limits it is told
    where it has no start, ``initial``.
    """
    model = HologramModel(display, targets, options)
    if min(seen_px := within(part or targets[0].window, model.wanted(0)).shape) < JUDGED_PX:
        height, width = display.slm_shape
        raise BenchError(
            f"The SLM's {height} x {width} pixels (binned as [display] says) show {seen_px[0]} x "
            f"{seen_px[1]} details of a picture, and it is judged from {JUDGED_PX} x {JUDGED_PX} on. "
            "Take more of them."
        )
    hologram = compute_hologram(model, initial=initial, callback=callback, cancel=cancel)
    if model.options.grid != "alias-free":
        model = HologramModel(display, targets, options, grid="alias-free")
    planes = range(len(targets))
    part = part or targets[0].window
    wanted = tuple(within(part, model.wanted(p)) / model.peaks[p] for p in planes)
    seen = tuple(within(part, model.seen(hologram.slm, p)) / model.peaks[p] for p in planes)
    whole = [model.intensity(hologram.slm, p) for p in planes]
    raw = tuple(within(part, whole[p]) / model.peaks[p] for p in planes)
    weights = model.options.field_weights() if part is None else None
    scores = tuple(compare(s, w, 1.0, weights) for s, w in zip(seen, wanted, strict=True))
    efficiency = model.efficiency(hologram.slm)
    if targets[0].window is not None:
        efficiency *= float(within(targets[0].window, whole[0]).sum() / whole[0].sum())
    why = limited_by(display, targets, hologram, model.options, efficiency) if initial is None else ()
    depths_mm = tuple(float(target.z_mm) for target in targets)
    return HologramResult(hologram, wanted, seen, raw, scores, efficiency, why, depths_mm)


def within(window: Window | None, image: Array) -> Float64Array:
    """Return what an image over the field, its centre in the middle, has inside a window, float64."""
    inside = image if window is None else image[window.part(image.shape)]
    return np.asarray(inside, np.float64)


def square(image: Array) -> Float64Array:
    """Return an image over the square field, (height, width), on as many pixels along both axes, float64.

    What is seen has as many pixels along an axis as there is detail; looked at, it would be stretched.
    """
    side = max(image.shape)
    drawn = np.asarray(image, np.float64)
    if image.shape != (side, side):
        drawn = np.asarray(cv2.resize(drawn, (side, side), interpolation=cv2.INTER_CUBIC), np.float64)
    return drawn


def prepare_target(
    pixels: Array,
    display: Display,
    options: HologramOptions | None = None,
    *,
    z_mm: float = 0.0,
    share: float = 1.0,
) -> Target:
    """Turn a picture into a target over the whole field of view, which is square.

    Parameters
    ----------
    pixels : ndarray, (height, width), or (height, width, 3), of which the mean of the channels is taken
        Intensity; 0 is black, the greatest value that is shown is white, whatever the type.
    options : HologramOptions
        Its ``fit``, ``srgb``, ``lift`` and ``envelope``.
    share : float
        Part of the field that the picture fills, along each axis; around it is black.
    """
    options = options or HologramOptions()
    image = options.lift + (1 - options.lift) * field_picture(pixels, fit=options.fit, srgb=options.srgb)
    if not image.any():
        raise BenchError(f"The picture {unshowable(pixels, options)}")
    white = float(image.max())
    window = None if options.mirrors is None else FIRST_ORDER
    if display.near:
        window = near_window(display)
    if window is not None:
        image = _placed(image, window)
    small = band_of(display).seen_shape
    if image.shape[0] < small[0] or image.shape[1] < small[1]:
        wide, high = max(small[1], image.shape[1]), max(small[0], image.shape[0])
        image = cv2.resize(image, (wide, high), interpolation=cv2.INTER_CUBIC).clip(0, 1)
    if options.envelope == "shade":
        ey, ex = (np.fft.fftshift(e) for e in display.envelope((image.shape[0], image.shape[1])))
        image = image * ey[:, None] * ex
    if share < 1:
        image = _placed(image, EVERYWHERE.shrunk(share))
        window = None if window is None else window.shrunk(share)
    return Target(image, z_mm, white=white or None, window=window)


def _placed(image: Float64Array, window: Window) -> Float64Array:
    """Return a picture in its window of a field that is dark elsewhere."""
    height, width = image.shape
    field = np.zeros(
        (ceil(height / (window.bottom - window.top)), ceil(width / (window.right - window.left)))
    )
    rows, columns = window.part(field.shape)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    field[rows, columns] = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return field


def colour_shares(displays: Sequence[Display]) -> list[float]:
    """Return which part of its field each colour's picture fills so that all are of one size.

    Far away the field of view is as wide as the wavelength is long, so that of the shortest is what all have;
    near, all have the mask's size.

    Raises BenchError where a picture is near in one colour and not in another.
    """
    near = {display.near for display in displays}
    if len(near) > 1:
        raise BenchError(
            f"A picture {displays[0].distance_mm:g} mm away is near for some of the colours only: give a "
            f"distance below {min(d.nearest_mm for d in displays):.4g} mm or from "
            f"{max(d.nearest_mm for d in displays):.4g} mm on."
        )
    least = min(display.wavelength_nm for display in displays)
    return [1.0 if display.near else least / display.wavelength_nm for display in displays]


def field_picture(pixels: Array, *, fit: Fit = "cover", srgb: bool = False) -> Float64Array:
    """Return a picture as it fills the square field, intensity in 0 to 1; see :class:`HologramOptions`.

    Stretched, it keeps its own number of pixels. Its greatest value is 1: phases dim nothing, a dark picture
    is shown as a bright one.

    Raises BenchError for a picture with values below 0 or that are not finite, which are no intensities.
    """
    if words := _no_intensities(pixels):
        raise BenchError(f"The picture {words}")
    image = np.asarray(pixels, np.float64)
    height, width = image.shape[:2]
    side = min(height, width) if fit == "cover" else max(height, width)
    if fit == "cover":
        top, left = (height - side) // 2, (width - side) // 2
        image = image[top : top + side, left : left + side]
    elif fit == "contain":
        top, left = (side - height) // 2, (side - width) // 2
        around = ((top, side - height - top), (left, side - width - left), (0, 0))
        image = np.pad(image, around[: image.ndim])
    if srgb:
        image = image / _full_scale(pixels)
        image = np.where(image <= 0.04045, image / 12.92, ((np.abs(image) + 0.055) / 1.055) ** 2.4)
    return _to_white(image.mean(axis=2) if image.ndim == 3 else image)


def unshowable(pixels: Array, options: HologramOptions | None = None) -> str:
    """Say, after a picture's name, why no hologram can show it; empty where one can."""
    options = options or HologramOptions()
    if words := _no_intensities(pixels):
        return words
    if options.lift or field_picture(pixels, fit=options.fit).any():
        return ""
    where = "in the square that is shown of it" if np.any(pixels) else "everywhere"
    return f"is black {where}, and a hologram sends its light somewhere."


def _no_intensities(pixels: Array) -> str:
    finite = np.isfinite(pixels)
    if not finite.all():
        count = np.count_nonzero(~finite)
        return (
            f"holds values that are no finite numbers (NaN, infinite or masked: {count}). "
            "Replace them, e.g. by the mean of their neighbours."
        )
    if (least := float(np.min(pixels))) >= 0:
        return ""
    return (
        f"has values below 0 (the least is {least:.4g}), and light has none. Add an offset, or set them to 0."
    )


def read_picture(path: Path | str | ImageFile, options: HologramOptions | None = None) -> ImageFile:
    """Read a picture that is to be shown; errors as ``read_image``, and FileError for :func:`unshowable`."""
    image = read_image(path)
    if words := unshowable(image.pixels, options):
        raise FileError(image.path, words)
    return image


def field_words(
    pixels: Array,
    fit: Fit,
    otherwise: str = "--fit contain shows all of it, --fit stretch stretches it",
    *,
    in_colour: bool = False,
) -> str:
    """Say what of a picture is not shown, and what shows it; empty where all of it is shown.

    ``in_colour``: its channels are shown one after the other.
    """
    height, width = pixels.shape[:2]
    said = []
    if fit == "cover" and height != width:
        side = min(height, width)
        said.append(
            f"The field is square: the middle {side} x {side} of the picture's {height} x {width} pixels are "
            f"shown ({otherwise})."
        )
    if not in_colour and pixels.ndim == 3 and (pixels != pixels[..., :1]).any():
        said.append("The picture is in colour: the mean of its channels is shown, in one colour.")
    return " ".join(said)


def _full_scale(pixels: Array) -> float:
    """Return the number of full light: of the fewest bits of any camera or file that hold the picture."""
    most = float(pixels.max())
    if pixels.dtype.kind not in "ui":
        return max(most, 1.0)
    return next((2.0**bits - 1 for bits in (8, 10, 12, 14, 16) if most < 2**bits), most)


def _to_white(image: Float64Array) -> Float64Array:
    """Return an image with 1 as its greatest value; a black one stays black."""
    return image / max(float(image.max()), 1e-30)


def read_weights(path: Path) -> Float64Array:
    """Read a weight image (grey, any scale); errors as ``read_image``."""
    pixels = read_image(path).pixels
    if pixels.ndim != 2 or pixels.min() < 0 or pixels.max() <= 0:
        raise FileError(path, "is no weight image: grey, not negative, not all zero.")
    return np.asarray(pixels, np.float64)
