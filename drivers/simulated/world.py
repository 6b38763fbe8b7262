"""The simulated world: what all simulated devices of one bench share, coupled by physics."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.device import DriverOptions, SharedPart
from drivers.errors import DeviceError
from drivers.simulated.clock import Clock
from drivers.simulated.options import WorldOptions
from drivers.simulated.presets import PRESETS, Preset
from recon.optics.diffuser import Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.fall_off import (
    FallOff,
    gaussian_fall_off,
    no_fall_off,
    response_on,
    table_fall_off,
)
from recon.optics.grid import PixelGrid
from recon.optics.sensor import FixedPattern, SensorSpec, fixed_pattern
from recon.optics.spectrum import BLUE, GREEN, RED, Band
from recon.optics.wave import WavePropagator

Position = tuple[float, float, float]
Rgb = tuple[float, float, float]
Image = npt.NDArray[np.float32]

BANDS: tuple[Band, Band, Band] = (RED, GREEN, BLUE)
CACHE_BYTES = 256 << 20


class SimulatedWorld(SharedPart):
    """A point source on a stage, a scene, a diffuser, a sensor.

    The simulated devices act on it and look at it: the stage carries the point source, the LED array lights
    it, the camera sees what falls on the sensor. Nothing else connects them.

    Parameters
    ----------
    options : WorldOptions
        The table ``[simulated]`` of ``bench.toml``.
    """

    table = "simulated"
    Options = WorldOptions

    def __init__(self, options: DriverOptions) -> None:
        if not isinstance(options, WorldOptions):
            raise TypeError(f"The simulated world takes WorldOptions, not {type(options).__name__}.")
        self.options = options
        self.clock = Clock(options.time_scale)
        preset = PRESETS[options.preset]
        self.preset: Preset = preset
        self.sensor: SensorSpec = preset.sensor
        self.distance_um = 1e3 * (options.diffuser_distance_mm or preset.diffuser_distance_mm)
        self.aperture_mm = options.aperture_mm or preset.aperture_mm
        self.fall_off = _fall_off(options, preset)
        self.source_diameter_um = (
            preset.source_diameter_um if options.source_diameter_um is None else options.source_diameter_um
        )
        self._lock = threading.RLock()
        self._propagator: WavePropagator | None = None
        self._pattern: FixedPattern | None = None
        self._cache: OrderedDict[Any, Image] = OrderedDict()
        self._emission: Rgb = (0.0, 0.0, 0.0)
        self._carrier: Callable[[], Position] = lambda: (0.0, 0.0, 1e3 * preset.source_distance_mm)
        self._unplugged: set[str] = set()

    # What the devices do to the world ---
    def carry_source(self, carrier: Callable[[], Position]) -> None:
        """Mount the point source on something that knows its true position ``(x, y, z)`` in micrometres."""
        self._carrier = carrier

    def set_emission(self, rgb: Rgb) -> None:
        """Light the point source; each band relative to one LED at its brightest right behind it."""
        self._emission = rgb

    @property
    def source_position_um(self) -> Position:
        """Where the point source truly is now."""
        return self._carrier()

    @property
    def emission(self) -> Rgb:
        """How brightly the point source glows now in red, green and blue."""
        return self._emission

    # What the camera sees ---
    @property
    def diffuser(self) -> Diffuser:
        """The diffuser's surface (made on first use)."""
        return self.propagator.diffuser

    @property
    def propagator(self) -> WavePropagator:
        """Wave optics from the source to the sensor (made on first use)."""
        with self._lock:
            if self._propagator is None:
                self._propagator = WavePropagator(
                    _diffuser(self.options, self.preset, self.aperture_mm),
                    self.distance_um,
                    spectral_samples=self.options.spectral_samples,
                )
            return self._propagator

    def fixed_pattern(self) -> FixedPattern:
        """Return the sensor's pixels: response, dark current, offset."""
        with self._lock:
            if self._pattern is None:
                if self.options.fixed_pattern:
                    self._pattern = fixed_pattern(self.sensor, self.options.seed + 1)
                else:
                    ones = np.ones(self.sensor.shape, np.float32)
                    dark = np.float32(self.sensor.dark_current_e_per_s) * ones
                    self._pattern = FixedPattern(ones, dark, np.zeros_like(ones))
            return self._pattern

    def sensor_grid(self, binning: int = 1) -> PixelGrid:
        """Return the sensor's pixels after binning; a rest at the lower and right border is left out."""
        height, width = (side // binning for side in self.sensor.shape)
        pitch = self.sensor.pitch_um
        rest_y, rest_x = (side - side // binning * binning for side in self.sensor.shape)
        return PixelGrid((height, width), pitch * binning, (-rest_x / 2 * pitch, -rest_y / 2 * pitch))

    def psf(self, source_um: Position, band: int, binning: int = 1) -> Image:
        """Light of a point source on the binned pixels, with the sensor's angular response.

        Parameters
        ----------
        source_um : tuple of float
            True position of the source.
        band : int
            0, 1, 2: red, green, blue.
        binning : int

        Returns
        -------
        ndarray, float32, (height, width)
            Steradians (see :meth:`recon.optics.wave.WavePropagator.psf`).
        """
        # A nanometre decides nothing; without rounding no two visits of a place would share their picture.
        source = (round(source_um[0], 3), round(source_um[1], 3), round(source_um[2], 3))
        return self._cached(("psf", source, band, binning), lambda: self._psf(source, band, binning))

    def _psf(self, source: Position, band: int, binning: int) -> Image:
        grid = self.sensor_grid(binning)
        light = self.propagator.psf(source, grid, BANDS[band], diameter_um=self.source_diameter_um)
        return light * response_on(grid, source, self.distance_um, self.fall_off)

    def photons_per_s(self, binning: int = 1) -> tuple[Image | None, Image | None, Image | None]:
        """Photons a second on every binned pixel now, in red, green and blue (None: dark).

        Quantum efficiency and fixed pattern are not included, the pixels' angular response is.
        """
        source = self.source_position_um
        brightness = self.options.source_brightness * self.preset.source_photons_per_s_sr
        bands: list[Image | None] = []
        for band, glow in enumerate(self.emission):
            light = None
            if glow > 0:
                light = self.psf(source, band, binning) * np.float32(glow * brightness)
            bands.append(light)
        return bands[0], bands[1], bands[2]

    def light_key(self) -> tuple[Any, ...]:
        """Something that changes whenever :meth:`photons_per_s` does."""
        glow = self.emission
        x, y, z = self.source_position_um
        place = (round(x, 3), round(y, 3), round(z, 3)) if any(glow) else None
        return (place, glow)

    def _cached(self, key: Any, make: Callable[[], Image]) -> Image:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
            image = make()
            image.flags.writeable = False
            self._cache[key] = image
            while sum(entry.nbytes for entry in self._cache.values()) > CACHE_BYTES and len(self._cache) > 1:
                self._cache.popitem(last=False)
            return image

    # Faults, for tests ---
    def unplug(self, kind: str) -> None:
        """Pull the plug of a device (``"camera"``, ``"stage"``, ``"led_array"``, ``"slm"``)."""
        self._unplugged.add(kind)

    def plug_in(self, kind: str) -> None:
        """Plug a device in again."""
        self._unplugged.discard(kind)

    def check_plugged(self, kind: str, name: str) -> None:
        """Raise :class:`DeviceError` when the device is unplugged."""
        if kind in self._unplugged:
            raise DeviceError(name, "was unplugged.", "Plug it in and open the bench again.")


def _diffuser(options: WorldOptions, preset: Preset, aperture_mm: tuple[float, float]) -> Diffuser:
    aperture_um = (1e3 * aperture_mm[0], 1e3 * aperture_mm[1])
    seed = options.seed if options.diffuser_seed is None else options.diffuser_seed
    kind = options.diffuser or preset.diffuser
    if kind == "smooth":
        return smooth_diffuser(
            aperture_um,
            preset.height_map_pitch_um,
            feature_size_um=options.feature_size_um,
            mean_slope_deg=options.mean_slope_deg,
            seed=seed,
        )
    return microlens_diffuser(
        aperture_um,
        preset.height_map_pitch_um,
        lenslet_um=options.lenslet_um or preset.lenslet_um,
        focal_length_um=options.focal_length_um or preset.focal_length_um,
        regular=kind == "regular_microlens",
        seed=seed,
    )


def _fall_off(options: WorldOptions, preset: Preset) -> FallOff:
    if options.fall_off == "gaussian":
        return gaussian_fall_off(options.fall_off_sigma_deg)
    if options.fall_off == "table":
        angles, responses = zip(*options.fall_off_table, strict=True)
        return table_fall_off(angles, responses)
    if options.fall_off == "preset" and preset.fall_off_sigma_deg is not None:
        return gaussian_fall_off(*preset.fall_off_sigma_deg)
    return no_fall_off
