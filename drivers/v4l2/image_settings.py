"""What a V4L2 camera's images are: format, size, region, frame rate, trigger, set and read back."""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping

from drivers.camera import Roi, TriggerMode
from drivers.common.pixels import compile_kernels
from drivers.device import DriverOptions, Setting, SharedPart
from drivers.errors import DeviceError, DeviceLostError, LimitError
from drivers.v4l2 import api
from drivers.v4l2.device import VideoDevice
from drivers.v4l2.formats import FORMATS, V4l2Format, code_text
from drivers.v4l2.settings import V4l2Settings


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


_log = logging.getLogger(__name__)
_RATE_TOLERANCE = 0.01
"""A difference below it is the rounding of intervals: 29.97 for 30."""


class V4l2ImageSettings(V4l2Settings):
    """The part of a V4L2 camera that decides what its images are."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._trigger_mode: TriggerMode = "free_run"

    def _open_images(self) -> None:
        self._trigger_mode = "free_run"
        self._formats = offered_formats(self._device)
        self._apply_format(self._formats[0])

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings, the driver's controls under ``control.NAME``."""
        self._require()
        made: dict[str, Setting] = {
            "exposure_ms": self._read_exposure(),
            "gain": self._read_gain(),
            "black_level": self.black_level,
            "pixel_format": self.pixel_format,
            "significant_bits": self.significant_bits,
            "roi": self.roi.as_tuple(),
            "roi_cut_by": "camera" if self._cropped else "driver",
            "binning": 1,
            "trigger_mode": self._trigger_mode,
            "sensor_shape": self.sensor_shape,
            "pixel_pitch_um": self.pixel_pitch_um,
            "frames_per_s": 1 / self._period if self._period else None,
        }
        for control in self._controls.by_name.values():
            if control.readable:
                made[f"control.{control.name}"] = self._controls.text(control)
        return made

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the images of the present format without a region."""
        self._require()
        return self._whole.height, self._whole.width

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the pixels, as configured."""
        return self.options.pixel_pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats that can be decoded, the best for measuring first."""
        self._require()
        return tuple(offered.name for offered in self._formats)

    @property
    def _period_s(self) -> float:
        return self._period or 0.0

    # Format and region -----------------------------------------------------------------------------
    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name, with the kernel's code where the image is computed from it."""
        self._require()
        return self._format.name

    @property
    def significant_bits(self) -> int:
        """Bits of the pixel format."""
        self._require()
        return self._format.pixels.bits

    @property
    def frame_shape(self) -> tuple[int, ...]:
        """Shape of the frames, with 3 channels for colours."""
        channels = self._format.pixels.channels
        return (*self.image_shape, channels) if channels > 1 else self.image_shape

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format; a region that the new format's images still have stays."""
        self._require_idle("pixel format")
        wanted = next((offered for offered in self._formats if offered.name == pixel_format), None)
        if wanted is None:
            raise LimitError(
                self.name,
                f"has no pixel format {pixel_format!r}.",
                f"It offers {', '.join(self.pixel_formats)}.",
            )
        before, roi, whole = self._format, self._roi, self._whole
        try:
            self._apply_format(wanted)
        except DeviceLostError:
            raise
        except (
            DeviceError
        ):  # the driver may have another one now, whose bytes must not pass for the old one's
            self._apply_format(before)
            if roi != whole:
                self.set_roi(roi)
            raise
        if self._whole != whole:
            self._forget("roi")
        elif roi != whole:
            self.set_roi(roi)
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._format.name

    def _apply_format(self, wanted: V4l2Format) -> None:
        """Set a format at the configured or largest size, the whole of it, at the configured frame rate."""
        region = full_region(self._device)
        shape = self.options.size or largest_shape(self._device, wanted.code)
        if region is not None and self.options.size is None:
            shape = region.height, region.width
        made = set_format(self._device, wanted, shape)
        self._format, self._made = wanted, made
        compile_kernels(wanted.pixels.packing)
        self._can_crop = region is not None and (region.height, region.width) == (made.height, made.width)
        self._origin = (region.top, region.left) if self._can_crop and region is not None else (0, 0)
        self._roi = self._whole = Roi(0, 0, made.height, made.width)
        self._cropped = False
        self._period = frame_period_s(self._device, self.options.frames_per_s)
        self._say_what_differs(made.height, made.width)
        if self._exposure_control is None:
            self._exposure_ms = self._read_exposure()

    def _say_what_differs(self, height: int, width: int) -> None:
        """Log where the driver made something else of size and frame rate than was asked for."""
        asked = self.options
        if asked.size is not None and (height, width) != asked.size:
            _log.warning("%s: images are %d x %d, asked for %d x %d", self.name, height, width, *asked.size)
        if asked.frames_per_s is None:
            return
        if self._period is None:
            _log.warning("%s: knows no frame rate, asked for %g frames/s", self.name, asked.frames_per_s)
        elif not math.isclose(1 / self._period, asked.frames_per_s, rel_tol=_RATE_TOLERANCE):
            _log.warning(
                "%s: takes %g frames/s, asked for %g", self.name, 1 / self._period, asked.frames_per_s
            )

    @property
    def roi(self) -> Roi:
        """Region of interest."""
        self._require()
        return self._roi

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region, by the camera where it can, else cut out of each image by this driver.

        Borders of a Bayer mosaic fall on even pixels, inside the region asked for.
        """
        self._require_idle("region of interest")
        whole = self._whole
        asked = whole if roi is None else roi
        wanted = whole if roi is None else _inner(asked, 2 if self._format.pixels.bayer else 1)
        if not _contains(whole, asked) or wanted.height < 1 or wanted.width < 1:
            raise LimitError(
                self.name,
                f"cannot read the region (top, left, height, width) = {asked.as_tuple()}.",
                f"Its images have {whole.height} x {whole.width} pixels.",
            )
        if self._cropped:
            self._apply_format(self._format)
        self._roi = self._crop(wanted) or wanted
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    def _crop(self, wanted: Roi) -> Roi | None:
        """Have the camera cut the region; None, with everything as before, when it cannot."""
        if not self._can_crop or wanted == self._whole:
            return None
        # Drivers move regions to their steps, even out of what was asked: then once more on multiples of 8.
        for region in (wanted, _inner(wanted, 8)):
            made = crop(self._device, region, self._origin) if region.height and region.width else None
            if made is None or not _contains(wanted, made):
                continue
            if self._format.pixels.bayer and (made.top % 2 or made.left % 2):
                continue
            image = set_format(self._device, self._format, (made.height, made.width))
            if (image.height, image.width) == (made.height, made.width):
                self._made, self._cropped = image, True
                self._period = frame_period_s(self._device, self.options.frames_per_s)
                return made
        self._apply_format(self._format)
        return None

    # Binning and trigger ---------------------------------------------------------------------------
    @property
    def binning(self) -> int:
        """Always 1: V4L2 has no binning, sizes other than the largest may be binned by the camera."""
        return 1

    @property
    def binnings(self) -> tuple[int, ...]:
        """Only 1."""
        return (1,)

    def set_binning(self, binning: int) -> int:
        """Take 1, refuse everything else."""
        self._require_idle("binning")
        if binning != 1:
            raise LimitError(self.name, f"has no binning {binning}.", "V4L2 has none: choose a smaller size.")
        return 1

    @property
    def trigger_mode(self) -> TriggerMode:
        """What starts an exposure."""
        return self._trigger_mode

    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        """Choose free running or software; V4L2 knows no trigger line.

        In mode ``"software"`` the camera runs on, and the driver hands out, for each trigger, the first frame
        whose exposure began after it: up to a frame's time late.
        """
        self._require_idle("trigger mode")
        if mode not in ("free_run", "software"):
            raise LimitError(self.name, f"has no trigger mode {mode!r}.", "It offers free_run, software.")
        self._trigger_mode = mode
        self._remember("trigger_mode", lambda: self.set_trigger_mode(mode))
        return mode


def _inner(region: Roi, step: int) -> Roi:
    """Return the largest region inside another with all borders on multiples of ``step``."""
    top, left = (-(-start // step) * step for start in (region.top, region.left))
    bottom = (region.top + region.height) // step * step
    right = (region.left + region.width) // step * step
    return Roi(top, left, max(0, bottom - top), max(0, right - left))


def _contains(outer: Roi, inner: Roi) -> bool:
    return (
        inner.top >= outer.top
        and inner.left >= outer.left
        and inner.top + inner.height <= outer.top + outer.height
        and inner.left + inner.width <= outer.left + outer.width
    )
