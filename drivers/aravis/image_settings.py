"""What a GenICam camera's images are: format, region, binning, trigger."""

from __future__ import annotations

from collections.abc import Mapping

from drivers.aravis.features import FRAME_TRIGGERS
from drivers.aravis.settings import AravisSettings
from drivers.camera import Roi, TriggerMode
from drivers.common.pixels import PixelFormat, compile_kernels, genicam_format
from drivers.device import Setting
from drivers.errors import DeviceError, LimitError


class AravisImageSettings(AravisSettings):
    """The part of a GenICam camera that decides what its images are."""

    def _open_images(self) -> None:
        features = self._features
        self._trigger_mode: TriggerMode = "free_run"
        self._set_trigger("free_run")
        if features.find("BinningHorizontal"):
            features.set_number("BinningHorizontal", 1)
            features.set_number("BinningVertical", 1)
        self._binning = 1
        self._sensor = self._read_sensor()
        offered = features.entries("PixelFormat")
        known = {name: pixels for name in offered if (pixels := genicam_format(name)) is not None}
        if not known:
            raise DeviceError(
                self.name,
                f"offers only pixel formats that cannot be read here: {', '.join(offered)}.",
                "Readable: Mono and Bayer of 8 to 16 bits, RGB8, BGR8.",
            )
        # The best for measuring first: one sample a pixel, no mosaic, many bits, unpacked.
        best = sorted(
            known.items(), key=lambda item: (item[1].channels, item[1].bayer, -item[1].bits, len(item[0]))
        )
        self._formats: dict[str, PixelFormat] = dict(best)
        self._apply_format(best[0][0])
        self._apply_roi(Roi(0, 0, *self._sensor))

    def _read_sensor(self) -> tuple[int, int]:
        """Return the sensor's ``(height, width)``."""
        features = self._features
        if features.find("SensorHeight") and features.find("SensorWidth"):
            return int(features.number("SensorHeight")), int(features.number("SensorWidth"))
        features.set_number("OffsetX", 0)
        features.set_number("OffsetY", 0)
        return int(features.bounds("Height")[1]), int(features.bounds("Width")[1])

    def settings(self) -> Mapping[str, Setting]:
        """Read all settings from the camera."""
        self._require()
        features = self._features
        made: dict[str, Setting] = {
            "exposure_ms": features.number(self._exposure_name) / 1e3,
            "gain": self._read_gain(),
            "black_level": self.black_level,
            "pixel_format": features.text("PixelFormat"),
            "significant_bits": self.significant_bits,
            "roi": self._roi.as_tuple(),
            "binning": self._binning,
            "trigger_mode": self._trigger_mode,
            "sensor_shape": self._sensor,
            "pixel_pitch_um": self._pitch_um,
            "frames_per_s": features.number(self._rate_name) if self._rate_name else None,
        }
        if self._camera.is_gv_device():
            with features.words("say its packet size"):
                made["packet_size_bytes"] = self._camera.gv_get_packet_size()
                made["packet_delay_ns"] = self._camera.gv_get_packet_delay()
        for name in self.options.features:
            made[f"feature.{name}"] = features.any_text(name)
        return made

    # What the sensor is ----------------------------------------------------------------------------
    @property
    def sensor_shape(self) -> tuple[int, int]:
        """``(height, width)`` of the whole sensor."""
        self._require()
        return self._sensor

    @property
    def pixel_pitch_um(self) -> float:
        """Pitch of the unbinned pixels, as configured, or as the camera says."""
        self._require()
        return self._pitch_um

    @property
    def pixel_formats(self) -> tuple[str, ...]:
        """Formats that can be unpacked, the best for measuring first."""
        self._require()
        return tuple(self._formats)

    # Pixel format ----------------------------------------------------------------------------------
    @property
    def pixel_format(self) -> str:
        """Pixel format by its GenICam name."""
        self._require()
        return self._format_name

    @property
    def significant_bits(self) -> int:
        """Bits of the pixel format."""
        self._require()
        return self._formats[self._format_name].bits

    def set_pixel_format(self, pixel_format: str) -> str:
        """Set the pixel format."""
        self._require_idle("pixel format")
        if pixel_format not in self._formats:
            raise LimitError(
                self.name, f"has no pixel format {pixel_format!r}.", f"It offers {', '.join(self._formats)}."
            )
        self._apply_format(pixel_format)
        self._remember("pixel_format", lambda: self.set_pixel_format(pixel_format))
        return self._format_name

    def _apply_format(self, pixel_format: str) -> None:
        self._format_name = self._features.choose("PixelFormat", pixel_format)
        compile_kernels(self._formats[pixel_format].packing)

    # Region and binning ----------------------------------------------------------------------------
    @property
    def roi(self) -> Roi:
        """Region of interest in sensor pixels."""
        self._require()
        return self._roi

    def set_roi(self, roi: Roi | None) -> Roi:
        """Set the region; its borders fall on the camera's steps inside the one asked for."""
        self._require_idle("region of interest")
        height, width = self._sensor
        asked = Roi(0, 0, height, width) if roi is None else roi
        outside = asked.top < 0 or asked.left < 0
        outside = outside or asked.top + asked.height > height or asked.left + asked.width > width
        if outside or asked.height < 1 or asked.width < 1:
            raise self._refused(asked)
        self._apply_roi(asked)
        self._remember("roi", lambda: self.set_roi(roi))
        return self._roi

    def _refused(self, asked: Roi) -> LimitError:
        smallest = [int(self._features.bounds(name)[0]) * self._binning for name in ("Height", "Width")]
        return LimitError(
            self.name,
            f"cannot read the region (top, left, height, width) = {asked.as_tuple()}.",
            f"The sensor has {self._sensor[0]} x {self._sensor[1]} pixels, "
            f"the smallest region {smallest[0]} x {smallest[1]}.",
        )

    def _apply_roi(self, asked: Roi) -> None:
        """Set the largest region on the camera's steps inside one that lies on the sensor."""
        features, factor = self._features, self._binning
        mosaic = 2 if self._formats[self._format_name].bayer else 1
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
                raise self._refused(asked)
            sides.append((offset, first, size, count, movable))
        for offset, _, _, _, movable in sides:  # the size's limits shrink by the offset
            if movable:
                features.set_number(offset, 0)
        for offset, first, size, count, movable in sides:
            features.set_number(size, count)
            if movable:
                features.set_number(offset, first)
        self._roi = self._read_roi()

    def _read_roi(self) -> Roi:
        with self._features.words("say its region"):
            region = self._camera.get_region()
        factor = self._binning
        return Roi(region.y * factor, region.x * factor, region.height * factor, region.width * factor)

    @property
    def binning(self) -> int:
        """Sensor pixels binned along each axis."""
        self._require()
        return self._binning

    @property
    def binnings(self) -> tuple[int, ...]:
        """The binning factors that the camera's limits allow."""
        self._require()
        if not self._features.find("BinningHorizontal"):
            return (1,)
        highs = [self._features.bounds(f"Binning{axis}")[1] for axis in ("Horizontal", "Vertical")]
        return tuple(n for n in (1, 2, 3, 4, 8, 16) if n <= min(highs))

    def set_binning(self, binning: int) -> int:
        """Set the binning along both axes; the region becomes the whole sensor."""
        self._require_idle("binning")
        if binning not in self.binnings:
            raise LimitError(self.name, f"has no binning {binning}.", f"It offers {self.binnings}.")
        if self._features.find("BinningHorizontal"):
            made = [
                self._features.set_number(f"Binning{axis}", binning) for axis in ("Horizontal", "Vertical")
            ]
            if made[0] != made[1]:
                raise LimitError(
                    self.name, f"bins {made[0]:g} x {made[1]:g} pixels.", f"Asked for {binning}."
                )
            self._binning = int(made[0])
        self._apply_roi(Roi(0, 0, *self._sensor))
        self._forget("roi")
        self._remember("binning", lambda: self.set_binning(binning))
        return self._binning

    # Trigger ---------------------------------------------------------------------------------------
    @property
    def trigger_mode(self) -> TriggerMode:
        """What starts an exposure."""
        self._require()
        return self._trigger_mode

    def set_trigger_mode(self, mode: TriggerMode) -> TriggerMode:
        """Choose what starts an exposure; the line of the hardware trigger is an option."""
        self._require_idle("trigger mode")
        self._set_trigger(mode)
        self._remember("trigger_mode", lambda: self.set_trigger_mode(mode))
        return self._trigger_mode

    def _set_trigger(self, mode: TriggerMode) -> None:
        features = self._features
        if mode not in ("free_run", "software", "hardware"):
            raise LimitError(
                self.name, f"has no trigger mode {mode!r}.", "It offers free_run, software, hardware."
            )
        if not features.find("TriggerMode"):
            if mode != "free_run":
                raise LimitError(self.name, f"has no trigger mode {mode!r}.", "It has no triggers.")
            self._trigger_mode = mode
            return
        selectors = features.entries("TriggerSelector") if features.find("TriggerSelector") else ()
        for selector in selectors or (None,):
            if selector is not None:
                features.choose("TriggerSelector", selector)
            if features.find("TriggerMode"):  # not every selector has it
                features.choose("TriggerMode", "Off")
        if mode != "free_run":
            frame = next((name for name in FRAME_TRIGGERS if name in selectors), None)
            if frame is not None:
                features.choose("TriggerSelector", frame)
            source = "Software" if mode == "software" else self.options.trigger_line
            features.choose("TriggerSource", source)
            if mode == "hardware" and features.find("TriggerActivation"):
                features.choose("TriggerActivation", self.options.trigger_activation)
            features.choose("TriggerMode", "On")
        self._trigger_mode = mode
