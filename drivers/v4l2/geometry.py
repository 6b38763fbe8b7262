"""Image formats, sizes, regions and frame rates of a video device, set and read back."""

from __future__ import annotations

from drivers.camera import Roi
from drivers.errors import DeviceError
from drivers.v4l2 import api
from drivers.v4l2.device import VideoDevice
from drivers.v4l2.formats import FORMATS, V4l2Format, code_text


def offered_formats(device: VideoDevice) -> tuple[V4l2Format, ...]:
    """Return the device's formats that can be decoded, the best for measuring first.

    Raises
    ------
    DeviceError
        When there is none, naming those that it has.
    """
    found = device.enumerate(api.ENUM_FMT, api.FormatDescription, type=api.BUF_TYPE_VIDEO_CAPTURE)
    codes = [item.pixelformat for item in found]
    formats = tuple(known for known in FORMATS if known.code in codes)
    if not formats:
        listed = ", ".join(map(code_text, codes)) or "none"
        raise DeviceError(
            device.name,
            f"offers no pixel format that can be read here, only {listed}.",
            "Readable are grey and Bayer of 8 to 16 bits, RGB, YUYV and MJPG.",
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

    Raises
    ------
    DeviceError
        When the driver takes another format instead.
    """
    asked = api.Format(type=api.BUF_TYPE_VIDEO_CAPTURE)
    device.call(api.G_FMT, asked, "say its image format")
    if shape is not None:
        asked.fmt.pix.height, asked.fmt.pix.width = shape
    asked.fmt.pix.pixelformat = wanted.code
    asked.fmt.pix.field = api.FIELD_NONE
    asked.fmt.pix.bytesperline = asked.fmt.pix.sizeimage = 0
    device.call(api.S_FMT, asked, f"take the image format {wanted.name}")
    made = asked.fmt.pix
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
    parm = api.StreamParm(type=api.BUF_TYPE_VIDEO_CAPTURE)
    if device.attempt(api.G_PARM, parm):
        return None
    if frames_per_s is not None and parm.parm.capture.capability & api.CAP_TIMEPERFRAME:
        parm.parm.capture.timeperframe = api.Fraction(1000, max(1, round(frames_per_s * 1000)))
        device.call(api.S_PARM, parm, f"take {frames_per_s:g} frames/s")
    period = parm.parm.capture.timeperframe
    if period.numerator == 0 or period.denominator == 0:
        return None
    return float(period.numerator / period.denominator)
