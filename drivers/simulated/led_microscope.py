"""The simulated LED array microscope: a diffuser as the sample, an objective, a camera (Kuo 2020, A.2)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field
from scipy import fft

from drivers.device import DriverOptions
from drivers.led_array import LedPattern
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.led_array import LedArrayOptions, SimulatedLedArray
from drivers.simulated.surroundings import CommonOptions, Surroundings
from recon.arrays import Float32Array, Float64Array
from recon.base.blocks import block_sum
from recon.optics.diffuser import Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.grid import BANDS
from recon.optics.sensor import SensorSpec
from recon.types import Geometry


def led_image(
    phase: npt.NDArray[np.floating],
    pitch_um: float,
    sines: Float64Array,
    weights: Float64Array,
    *,
    wavelength_nm: float,
    na: float,
    defocus_um: float = 0.0,
    workers: int = 2,
) -> Float32Array:
    """Image of a thin phase sample, relative to no sample and all the LEDs' light through the pupil.

    Partially coherent imaging, wave by wave: every LED is a point far away and incoherent with the others. It
    sends a plane wave through the sample, whose spectrum the objective's pupil cuts; the image is the sum of
    all LEDs' intensities. Nothing is assumed about how strong or how slow the sample's phase is.

    Parameters
    ----------
    phase : ndarray, (height, width)
        Radians. Taken as periodic: give a rim that is not looked at.
    pitch_um : float
        Of the samples, in the object.
    sines : ndarray, (n_leds, 2)
        Of each LED's direction as seen from the sample, x and y; its light travels the other way.
    weights : ndarray, (n_leds,)
        Light of each LED; they add up.
    wavelength_nm, na : float
        Of the light; of the objective.
    defocus_um : float
        Distance of the focal plane from the sample.

    Returns
    -------
    ndarray, float32, (height, width)
    """
    spectrum = fft.fft2(np.exp(1j * np.asarray(phase, np.float64)).astype(np.complex64), workers=workers)
    height, width = phase.shape
    qy, qx = fft.fftfreq(height, pitch_um)[:, None], fft.fftfreq(width, pitch_um)
    wavelength_um = 1e-3 * wavelength_nm
    total = np.zeros(phase.shape, np.float32)
    for (sine_x, sine_y), weight in zip(sines, weights, strict=True):
        y, x = qy - sine_y / wavelength_um, qx - sine_x / wavelength_um
        squared = y**2 + x**2
        passed = squared <= (na / wavelength_um) ** 2
        if not passed.any():
            continue
        field = np.where(passed, spectrum, 0)
        if defocus_um:
            along = np.sqrt(np.maximum(wavelength_um**-2 - squared, 0.0))
            field = field * np.exp(2j * np.pi * defocus_um * along)
        amplitude = fft.ifft2(field.astype(np.complex64), workers=workers)
        total += np.float32(weight) * (amplitude.real**2 + amplitude.imag**2)
    return total


Rgb = tuple[float, float, float]
RIM_UM = 80.0
"""Of the sample beyond the field of view on each side: what the propagation wraps around stays out of it."""


class LedMicroscopeOptions(CommonOptions):
    """Options of the simulated LED array microscope."""

    pixels: int = Field(384, ge=64, le=1024, description="Of the camera along each side.")
    light: float = Field(2e4, gt=0, description="Electrons a second that one LED gives a camera pixel.")
    magnification: float = Field(4.0, gt=0, description="Of the objective.")
    objective_na: float = Field(0.1, gt=0, lt=0.9, description="Its numerical aperture.")
    defocus_um: float = Field(0.0, description="Of the sample.")
    diffuser: Literal["smooth", "random_microlens"] = Field("smooth", description="The sample.")
    feature_size_um: float = Field(140.0, gt=20, description="Feature size of the smooth diffuser.")
    mean_slope_deg: float = Field(0.7, gt=0, lt=20, description="Mean slope of the smooth diffuser.")
    lenslet_um: float = Field(250.0, gt=20, description="Spacing of the microlenses.")
    focal_length_um: float = Field(10_000.0, gt=500, description="Focal length of the microlenses.")


class LedMicroscopeWorld(Surroundings):
    """What the microscope's LED array and camera share: the sample between them.

    Parameters
    ----------
    options : LedMicroscopeOptions
        The table ``[simulated_led_microscope]`` of ``bench.toml``.
    """

    table = "simulated_led_microscope"
    Options = LedMicroscopeOptions
    options: LedMicroscopeOptions

    def __init__(self, options: DriverOptions) -> None:
        options = LedMicroscopeOptions.of(options)
        sensor = SensorSpec(
            name="microscope camera",
            shape=(options.pixels, options.pixels),
            pitch_um=6.5,
            quantum_efficiency=(0.6, 0.6, 0.6),
            full_well_e=30_000,
            read_noise_e=2.0,
            dark_current_e_per_s=1.0,
            prnu=0.005,
            dsnu_e=1.0,
            bits=12,
        )
        super().__init__(options, sensor)
        self._sines = np.zeros((0, 2))
        self._levels = np.zeros((0, 3))
        self._sample: Diffuser | None = None
        self._images: dict[bytes, Float32Array] = {}

    @property
    def geometry(self) -> Geometry:
        """What is known of the optics: the camera's pixels."""
        return Geometry(self.sensor.pitch_um)

    @property
    def object_pitch_um(self) -> float:
        """Of the camera's pixels, in the sample."""
        return self.sensor.pitch_um / self.options.magnification

    @property
    def sample(self) -> Diffuser:
        """The diffuser, with a rim beyond the field of view (made on first use)."""
        with self._lock:
            if self._sample is None:
                options, pitch = self.options, self.object_pitch_um
                side = (options.pixels + 2 * self._rim) * pitch
                if options.diffuser == "smooth":
                    self._sample = smooth_diffuser(
                        (side, side),
                        pitch,
                        feature_size_um=options.feature_size_um,
                        mean_slope_deg=options.mean_slope_deg,
                        seed=options.seed,
                    )
                else:
                    self._sample = microlens_diffuser(
                        (side, side),
                        pitch,
                        lenslet_um=options.lenslet_um,
                        focal_length_um=options.focal_length_um,
                        seed=options.seed,
                    )
            return self._sample

    def true_height_um(self) -> Float32Array:
        """Return the diffuser's surface in the camera's field of view, ``(pixels, pixels)`` float32."""
        return self.sample.heights_um[self._view]

    def light_leds(self, sines: Float64Array, levels: Float64Array) -> None:
        """Light LEDs: ``(n, 2)`` sines of their directions, ``(n, 3)`` levels of each band, 0 to 1."""
        self._sines, self._levels = sines, levels

    def photons_per_s(self, weights: Rgb, binning: int = 1) -> Float32Array | None:
        """Electrons a second on every binned camera pixel now, or None when all LEDs are dark."""
        sines, levels = self._sines, self._levels
        if not (levels * np.array(weights)).any():
            return None
        with self._lock:
            key = sines.tobytes() + levels.tobytes() + np.array(weights).tobytes()
            if key not in self._images:
                if len(self._images) >= 8:
                    self._images.pop(next(iter(self._images)))
                self._images[key] = self._render(sines, levels, weights)
            image = self._images[key]
        return image if binning == 1 else block_sum(image, binning)

    def _render(self, sines: Float64Array, levels: Float64Array, weights: Rgb) -> Float32Array:
        sample, total = self.sample, np.zeros((self.options.pixels, self.options.pixels), np.float32)
        for band, (line, weight) in enumerate(zip(BANDS, weights, strict=True)):
            lit = levels[:, band] > 0
            if weight <= 0 or not lit.any():
                continue
            contrast = sample.glass.at(line.center_nm) - sample.ambient.at(line.center_nm)
            image = led_image(
                sample.heights_um * (2e3 * np.pi * contrast / line.center_nm),
                sample.pitch_um,
                sines[lit],
                levels[lit, band],
                wavelength_nm=line.center_nm,
                na=self.options.objective_na,
                defocus_um=self.options.defocus_um,
            )
            total += np.float32(weight * self.options.light) * image[self._view]
        return total

    @property
    def _rim(self) -> int:
        return int(np.ceil(RIM_UM / self.object_pitch_um))

    @property
    def _view(self) -> tuple[slice, slice]:
        inside = slice(self._rim, self._rim + self.options.pixels)
        return inside, inside

    def light_key(self) -> tuple[Any, ...]:
        """Return something that changes whenever :meth:`photons_per_s` does."""
        return (self._sines.tobytes(), self._levels.tobytes())


class MicroscopeLedOptions(LedArrayOptions):
    """Options of the microscope's LED array."""

    leds: int = Field(317, ge=1, le=10_000, description="Number of LEDs.")
    led_pitch_mm: float = Field(2.0, gt=0, description="Spacing of the LEDs.")
    distance_mm: float = Field(150.0, gt=0, description="From the array to the sample.")


class MicroscopeLedArray(SimulatedLedArray):
    """The LED array behind the sample; each LED lights it from its own direction."""

    Shared = LedMicroscopeWorld
    Options = MicroscopeLedOptions
    world: LedMicroscopeWorld  # type: ignore[assignment]  # which Shared makes sure of

    def _show(self, pattern: LedPattern) -> None:
        levels: Mapping[int, tuple[int, int, int]] = dict(pattern.levels)
        index = np.array(sorted(levels), np.intp)
        bright = np.array([levels[int(i)] for i in index], np.float64).reshape(-1, 3) / 255
        sines = self.led_na[index]
        # An LED seen at an angle is farther away, and turned away: cosine to the fourth.
        cosine = np.sqrt(1 - (sines**2).sum(axis=1))
        self._pattern = pattern
        self.world.light_leds(sines, bright * cosine[:, None] ** 4)


class MicroscopeCamera(SimulatedCamera):
    """The camera behind the objective."""

    Shared = LedMicroscopeWorld
