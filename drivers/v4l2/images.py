"""What a V4L2 device's images are: format, size, region, frame rate, set and read back."""

from __future__ import annotations

import logging
import math

from drivers.camera import Roi
from drivers.common.pixels import compile_kernels
from drivers.errors import DeviceError
from drivers.v4l2 import api
from drivers.v4l2.device import VideoDevice
from drivers.v4l2.formats import FORMATS, V4l2Format, code_text

_log = logging.getLogger(__name__)
_RATE_TOLERANCE = 0.01
"""A difference below it is the rounding of intervals: 29.97 for 30."""


def offered_formats(device: VideoDevice) -> tuple[V4l2Format, ...]:
    """Return the device's formats that can be decoded, the best for measuring first.

    Raises DeviceError when there is none, naming those that it has.
    """
    found = device.enumerate(api.ENUM_FMT, api.FormatDescription, type=device.buffer_type)
    codes = [item.pixelformat for item in found]
    formats = tuple(known for known in FORMATS if known.code in codes)
    if not formats:
        listed = ", ".join(map(code_text, codes)) or "none"
        raise DeviceError(
            device.name,
            f"offers no pixel format that can be read here, only {listed}.",
            "Readable are grey and Bayer of 8 to 16 bits, RGB, YUYV, UYVY, NV12 and MJPG.",
        )
    return formats


def largest_shape(device: VideoDevice, code: int) -> tuple[int, int] | None:
    """Return the ``(height, width)`` of the largest images of a format; None when the driver does not say."""
    shapes = []
    for size in device.enumerate(api.ENUM_FRAMESIZES, api.FrameSize, pixel_format=code):
        step = size.stepwise
        if size.type == api.FRMSIZE_TYPE_DISCRETE:
            shapes.append((int(step.max_width), int(step.min_width)))  # height lies where max_width does
        else:
            shapes.append((int(step.max_height), int(step.max_width)))
            break  # stepwise and continuous have one entry
    return max(shapes, key=lambda shape: shape[0] * shape[1], default=None)


def set_format(device: VideoDevice, wanted: V4l2Format, shape: tuple[int, int] | None) -> api.PixFormat:
    """Set format and image size (None: as it is); returns what the driver made of them.

    Raises DeviceError when the driver takes another format instead, or spreads an image over memory planes.
    """
    asked = api.Format(type=device.buffer_type)
    device.call(api.G_FMT, asked, "say its image format")
    planes = device.buffer_type == api.BUF_TYPE_VIDEO_CAPTURE_MPLANE
    image = asked.fmt.planes if planes else asked.fmt.pix
    layout = asked.fmt.planes.plane_fmt[0] if planes else asked.fmt.pix
    if shape is not None:
        image.height, image.width = shape
    image.pixelformat, image.field = wanted.code, api.FIELD_NONE
    layout.bytesperline = layout.sizeimage = 0
    device.call(api.S_FMT, asked, f"take the image format {wanted.name}")
    if planes and asked.fmt.planes.num_planes != 1:
        raise DeviceError(
            device.name,
            f"spreads {wanted.name} over {asked.fmt.planes.num_planes} memory planes; one can be read here.",
            "Choose another format.",
        )
    made = api.PixFormat(
        width=image.width,
        height=image.height,
        pixelformat=image.pixelformat,
        field=image.field,
        bytesperline=layout.bytesperline,
        sizeimage=layout.sizeimage,
    )
    if made.pixelformat != wanted.code:
        raise DeviceError(
            device.name,
            f"takes {code_text(made.pixelformat)} instead of {wanted.name}.",
            "Choose another format.",
        )
    return made


def full_region(device: VideoDevice) -> Roi | None:
    """Return the region that the sensor has by default; None when the driver cannot crop."""
    selection = api.Selection(type=api.BUF_TYPE_VIDEO_CAPTURE, target=api.SEL_TGT_CROP_DEFAULT)
    if device.attempt(api.G_SELECTION, selection):
        return None
    current = api.Selection(type=api.BUF_TYPE_VIDEO_CAPTURE, target=api.SEL_TGT_CROP, flags=0, r=selection.r)
    if device.attempt(api.S_SELECTION, current):
        return None
    area = selection.r
    return Roi(area.top, area.left, area.height, area.width)


def crop(device: VideoDevice, region: Roi, origin: tuple[int, int]) -> Roi | None:
    """Have the driver read no more than a region; returns what it made of it, None when it refuses.

    ``origin`` is the ``(top, left)`` of the default region, which the driver counts from elsewhere.
    """
    top, left = origin
    asked = api.Selection(
        type=api.BUF_TYPE_VIDEO_CAPTURE,
        target=api.SEL_TGT_CROP,
        flags=api.SEL_FLAG_LE,
        r=api.Rect(region.left + left, region.top + top, region.width, region.height),
    )
    if device.attempt(api.S_SELECTION, asked):
        return None
    return Roi(asked.r.top - top, asked.r.left - left, asked.r.height, asked.r.width)


def frame_period_s(device: VideoDevice, frames_per_s: float | None) -> float | None:
    """Set the frame rate (None: leave it) and return the period that the driver has now.

    None when the driver knows no frame rate.
    """
    parm = api.StreamParm(type=device.buffer_type)
    if device.attempt(api.G_PARM, parm):
        return None
    if frames_per_s is not None and parm.parm.capture.capability & api.CAP_TIMEPERFRAME:
        parm.parm.capture.timeperframe = api.Fraction(1000, max(1, round(frames_per_s * 1000)))
        device.call(api.S_PARM, parm, f"take {frames_per_s:g} frames/s")
    period = parm.parm.capture.timeperframe
    if period.numerator == 0 or period.denominator == 0:
        return None
    return float(period.numerator / period.denominator)


class Images:
    """Format, region and frame rate of an open device's images.

    Parameters
    ----------
    device : VideoDevice
    size : (int, int) or None
        ``(height, width)`` to ask for before a region is chosen; None for the largest.
    frames_per_s : float or None
        To ask for; None leaves it as the driver has it.

    Attributes
    ----------
    formats : tuple of V4l2Format
        Those that can be decoded, the best for measuring first.
    format : V4l2Format
    made : PixFormat
        What the driver made of it.
    whole : Roi
        All of the images of the present format.
    cropped : bool
        Whether the device cuts a region.
    period_s : float or None
        From frame to frame; None when the driver knows no frame rate.
    """

    def __init__(self, device: VideoDevice, size: tuple[int, int] | None, frames_per_s: float | None) -> None:
        self._device, self._size, self._frames_per_s = device, size, frames_per_s
        self.formats = offered_formats(device)
        self.apply(self.formats[0])

    def apply(self, wanted: V4l2Format) -> None:
        """Set a format at the configured or largest size, the whole of it, at the configured frame rate."""
        region = full_region(self._device)
        shape = self._size or largest_shape(self._device, wanted.code)
        if region is not None and self._size is None:
            shape = region.height, region.width
        made = set_format(self._device, wanted, shape)
        self.format, self.made = wanted, made
        compile_kernels(wanted.pixels.packing)
        self._can_crop = region is not None and (region.height, region.width) == (made.height, made.width)
        self._origin = (region.top, region.left) if self._can_crop and region is not None else (0, 0)
        self.whole = Roi(0, 0, made.height, made.width)
        self.cropped = False
        self.period_s = frame_period_s(self._device, self._frames_per_s)
        self._say_what_differs(made.height, made.width)

    def look_again(self) -> None:
        """Set the format anew that a control has made of the present one: the order of a turned mosaic."""
        before = self.format
        self.formats = offered_formats(self._device)
        made = api.Format(type=self._device.buffer_type)
        self._device.call(api.G_FMT, made, "say its image format")
        planes = self._device.buffer_type == api.BUF_TYPE_VIDEO_CAPTURE_MPLANE
        code = (made.fmt.planes if planes else made.fmt.pix).pixelformat
        same = (before.pixels.packing, before.pixels.bits, before.pixels.channels)
        likely = [
            *(known for known in (before, *self.formats) if known.code == code and known in self.formats),
            *(f for f in self.formats if (f.pixels.packing, f.pixels.bits, f.pixels.channels) == same),
            *self.formats,
        ]
        self.apply(likely[0])

    def _say_what_differs(self, height: int, width: int) -> None:
        """Log where the driver made something else of size and frame rate than was asked for."""
        name, size, rate = self._device.name, self._size, self._frames_per_s
        if size is not None and (height, width) != size:
            _log.warning("%s: images are %d x %d, asked for %d x %d", name, height, width, *size)
        if rate is None:
            return
        if self.period_s is None:
            _log.warning("%s: knows no frame rate, asked for %g frames/s", name, rate)
        elif not math.isclose(1 / self.period_s, rate, rel_tol=_RATE_TOLERANCE):
            _log.warning("%s: takes %g frames/s, asked for %g", name, 1 / self.period_s, rate)

    def cut(self, wanted: Roi) -> Roi:
        """Have the device read no more than a region where it can; returns what frames are to show of it."""
        if self.cropped:
            self.apply(self.format)
        return self._crop(wanted) or wanted

    def _crop(self, wanted: Roi) -> Roi | None:
        """Have the camera cut the region; None, with everything as before, when it cannot."""
        if not self._can_crop or wanted == self.whole:
            return None
        # Drivers move regions to their steps, even out of what was asked: then once more on multiples of 8.
        for region in (wanted, wanted.inside(8)):
            made = crop(self._device, region, self._origin) if region.height and region.width else None
            if made is None or not wanted.contains(made):
                continue
            if self.format.pixels.bayer and (made.top % 2 or made.left % 2):
                continue
            image = set_format(self._device, self.format, (made.height, made.width))
            if (image.height, image.width) == (made.height, made.width):
                self.made, self.cropped = image, True
                self.period_s = frame_period_s(self._device, self._frames_per_s)
                return made
        self.apply(self.format)
        return None
