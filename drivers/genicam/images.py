"""What a GenICam camera's images are: format, region, binning, trigger."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from drivers.camera import Roi, TriggerEdge, TriggerMode
from drivers.common.pixels import PixelFormat, compile_kernels, genicam_format
from drivers.errors import DeviceError, LimitError
from drivers.genicam.features import FRAME_TRIGGERS, Features

_AXES = ("Horizontal", "Vertical")


class Images:
    """Format, region and binning of an open camera's images; at first all of the sensor, unbinned.

    Parameters
    ----------
    features : Features
    sensor : callable
        Asks for the sensor's ``(height, width)``.

    Attributes
    ----------
    formats : dict of str to PixelFormat
        Those that can be unpacked, the best for measuring first.
    format_name : str
    roi : Roi
    binning : int
    sensor : (int, int)
    """

    def __init__(self, features: Features, sensor: Callable[[], tuple[int, int]]) -> None:
        self._features = features
        for name in (f"{what}{axis}" for what in ("Binning", "Decimation") for axis in _AXES):
            if features.find(name) and features.number(name) != 1:
                features.set_number(name, 1)
        self.binning = 1
        self.sensor = sensor()
        self.formats = self._read_formats()
        self.apply_format(next(iter(self.formats)))
        self._apply_whole()

    def _read_formats(self) -> dict[str, PixelFormat]:
        features = self._features
        offered = features.entries("PixelFormat")
        known = {name: pixels for name in offered if (pixels := genicam_format(name)) is not None}
        if not known:
            raise DeviceError(
                features.name,
                f"offers only pixel formats that cannot be read here: {', '.join(offered)}.",
                "Readable: Mono and Bayer of 8 to 16 bits, RGB8, BGR8.",
            )
        # The best for measuring first: one sample a pixel, no mosaic, many bits, unpacked.
        best = sorted(
            known.items(), key=lambda item: (item[1].channels, item[1].bayer, -item[1].bits, len(item[0]))
        )
        return dict(best)

    def look_again(self) -> None:
        """Read format, region and binning, which another feature may have changed; where it raises, all stay.

        Raises DeviceError when the format is none that can be read; LimitError when it bins differently along
        the two axes.
        """
        features, binning = self._features, self.binning
        formats = self._read_formats()
        if (now := features.text("PixelFormat")) not in formats:
            raise DeviceError(
                features.name, f"sends {now}, which cannot be read.", f"Readable: {', '.join(formats)}."
            )
        if features.find("BinningHorizontal"):
            binning = self._same_along([features.number(f"Binning{axis}") for axis in _AXES])
        self.formats, self.format_name, self.binning = formats, now, binning
        compile_kernels(self.format.packing)
        self.roi = self._read_roi()

    def _same_along(self, made: list[float]) -> int:
        if made[0] != made[1]:
            raise LimitError(
                self._features.name, f"bins {made[0]:g} x {made[1]:g} pixels.", "Bin both axes alike."
            )
        return int(made[0])

    @property
    def format(self) -> PixelFormat:
        """The present pixel format."""
        return self.formats[self.format_name]

    def apply_format(self, pixel_format: str) -> None:
        """Set the pixel format."""
        self.format_name = self._features.choose("PixelFormat", pixel_format)
        compile_kernels(self.formats[pixel_format].packing)

    def refused(self) -> str:
        """Return which regions the camera takes, for the refusal of another."""
        smallest = [int(self._features.bounds(name)[0]) * self.binning for name in ("Height", "Width")]
        return (
            f"The sensor has {self.sensor[0]} x {self.sensor[1]} pixels, "
            f"the smallest region {smallest[0]} x {smallest[1]}."
        )

    def apply_roi(self, asked: Roi) -> bool:
        """Set the largest region on the camera's steps inside one on the sensor; False when there is none."""
        features, factor = self._features, self.binning
        mosaic = 2 if self.format.bayer else 1
        sides = []
        for start, length, offset, size in (
            (asked.top, asked.height, "OffsetY", "Height"),
            (asked.left, asked.width, "OffsetX", "Width"),
        ):
            movable = features.find(offset) is not None
            step = max(features.increment(offset), mosaic) if movable else 1
            first = -(-start // (factor * step)) * step
            steps = features.increment(size)
            count = ((start + length) // factor - first) // steps * steps
            if count < features.bounds(size)[0] or (first and not movable):
                return False
            sides.append((offset, first, size, count, movable))
        for offset, _, _, _, movable in sides:  # the size's limits shrink by the offset
            if movable:
                features.set_number(offset, 0)
        for offset, first, size, count, movable in sides:
            features.set_number(size, count)
            if movable:
                features.set_number(offset, first)
        self.roi = self._read_roi()
        return True

    def _apply_whole(self) -> None:
        if not self.apply_roi(Roi(0, 0, *self.sensor)):
            raise LimitError(
                self._features.name, f"has no region at binning {self.binning} on its sensor.", self.refused()
            )

    def _read_roi(self) -> Roi:
        top, left, height, width = (
            int(self._features.number(name)) if self._features.find(name) else 0
            for name in ("OffsetY", "OffsetX", "Height", "Width")
        )
        factor = self.binning
        return Roi(top * factor, left * factor, height * factor, width * factor)

    def apply_binning(self, binning: int) -> None:
        """Set the binning along both axes; the region becomes the whole sensor."""
        if self._features.find("BinningHorizontal"):
            made = [self._features.set_number(f"Binning{axis}", binning) for axis in _AXES]
            self.binning = self._same_along(made)
        self._apply_whole()


TRIGGER_EDGES: Mapping[TriggerEdge, str] = {"rising": "RisingEdge", "falling": "FallingEdge"}
"""By their names of TriggerActivation."""


def trigger_lines(features: Features) -> tuple[str, ...]:
    """Return the inputs that a hardware trigger may come in on; none of a camera without triggers."""
    if not features.find("TriggerSource"):
        return ()
    return tuple(name for name in features.entries("TriggerSource") if not name.startswith("Software"))


def set_trigger(features: Features, mode: TriggerMode, line: str, edge: TriggerEdge) -> None:
    """Choose what starts an exposure; ``line`` and ``edge`` are of the hardware trigger."""
    if not features.find("TriggerMode"):
        if mode != "free_run":
            raise LimitError(features.name, f"has no trigger mode {mode!r}.", "It has no triggers.")
        return
    selectors = features.entries("TriggerSelector") if features.find("TriggerSelector") else ()
    for selector in selectors or (None,):
        if selector is not None:
            features.choose("TriggerSelector", selector)
        if features.find("TriggerMode"):  # not every selector has it
            features.choose("TriggerMode", "Off")
    if mode != "free_run":
        frame = next((trigger for trigger in FRAME_TRIGGERS if trigger in selectors), None)
        if frame is not None:
            features.choose("TriggerSelector", frame)
        source = "Software" if mode == "software" else line
        features.choose("TriggerSource", source)
        if mode == "hardware" and features.find("TriggerActivation"):
            features.choose("TriggerActivation", TRIGGER_EDGES[edge])
        features.choose("TriggerMode", "On")
