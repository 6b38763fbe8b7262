"""The simulated holographic display: its world, and the camera, six-axis stage, SLM and lasers in it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from math import pi
from typing import Any

import numpy as np
from pydantic import Field

from drivers.common.stage_axes import AXIS_NAMES
from drivers.device import DriverOptions, SharedPart
from drivers.led_array import LedPattern
from drivers.simulated.camera import SimulatedCamera
from drivers.simulated.led_array import LedArrayOptions, SimulatedLedArray
from drivers.simulated.mechanics import AxisSpec
from drivers.simulated.slm import SimulatedSlm, SlmOptions
from drivers.simulated.stage import AxisOptions, CarriageStage, StageOptions, axis_spec
from drivers.simulated.surroundings import CommonOptions, Surroundings
from recon.arrays import Float32Array
from recon.base.blocks import block_sum
from recon.optics.scattering_display import DisplaySpec, MaskPose, ScatteringDisplay
from recon.optics.sensor import SensorSpec

SENSOR = SensorSpec(
    name="display camera",
    shape=(1088, 1088),
    pitch_um=5.5,
    quantum_efficiency=(0.6, 0.6, 0.6),
    full_well_e=30_000,
    read_noise_e=3.0,
    dark_current_e_per_s=5.0,
    prnu=0.005,
    dsnu_e=1.0,
    bits=12,
    exposure_limits_ms=(0.02, 10_000.0),
)


class DisplayOptions(CommonOptions):
    """Options of the simulated holographic display; what is off is off as on a bench just put together."""

    light: float = Field(
        2e5, gt=0, description="Mean electrons a second in a camera pixel inside the field of view."
    )
    mask_seed: int = Field(0, ge=0, description="Of the random binary mask.")
    masked: bool = Field(
        True,
        description="Whether there is a mask; without one mask_pitch_um is the SLM's pitch, and where the "
        "mask is (shift_um, z_um, roll_mrad, pitch_mrad, yaw_mrad, the stage) changes nothing.",
    )
    mask_pitch_um: float = Field(4.0, gt=0, description="Pitch of the mask's pixels.")
    wavelength_nm: float = Field(660.0, gt=0, description="Of the laser; the mask is made for it.")
    focal_mm: float = Field(35.0, gt=0, description="Focal length of the Fourier lens.")
    oversampling: int = Field(2, ge=1, le=4, description="Samples per mask pixel along each axis.")
    shift_um: tuple[float, float] = Field(
        (120.0, -70.0), description="Where the mask is when the stage reads zero: x, y from its right place."
    )
    z_um: float = Field(300.0, description="The same along the optical axis.")
    roll_mrad: float = Field(1.5, description="Rotation of the mask about the optical axis.")
    pitch_mrad: float = Field(2.0, description="Tilt of the mask about x.")
    yaw_mrad: float = Field(-1.5, description="Tilt of the mask about y.")
    magnification: float = Field(0.001, description="Of the relay, less one.")
    relay_distortion_um: float = Field(3.0, description="Displacement of the SLM's image at its corners.")
    relay_centre_um: tuple[float, float] = Field(
        (0.0, 0.0), description="x, y of the relay's axis, which its distortion is centred on."
    )
    lens_distortion: float = Field(
        0.002, ge=-0.05, le=0.05, description="Of the Fourier lens at the middle of the field's border."
    )
    sensor_offset_um: tuple[float, float] = Field(
        (18.0, -11.0), description="Of the camera's centre from the optical axis, y, x."
    )
    sensor_roll_mrad: float = Field(2.0, description="Rotation of the camera.")
    dc_power: float = Field(0.1, ge=0, lt=1, description="Share of the light that the SLM does not modulate.")
    dc_phase_rad: float = Field(0.6, description="Its phase.")
    fill: float = Field(0.93, gt=0, le=1, description="Modulating part of an SLM pixel's area.")
    flatness_rad: float = Field(0.0, ge=0, description="Peak of the SLM's flatness error.")
    amplitude_swing: float = Field(
        0.0, ge=0, lt=1, description="Part of the amplitude that the SLM loses at a phase of pi; none at 0."
    )
    mirrors: bool = Field(
        False, description="Mirrors in the SLM's place: levels are amplitudes, 0 is dark, 255 is 1."
    )
    crosstalk_px: float = Field(
        0.0, ge=0, le=2, description="Width of what smooths the phase across pixel borders, SLM pixels."
    )
    beam_mm: float = Field(
        0.0, ge=0, description="Radius of the laser's beam on the SLM, to exp(-2) of its peak; 0 is even."
    )
    beam_centre_um: tuple[float, float] = Field((0.0, 0.0), description="x, y of the beam's peak.")
    wavefront_rad: float = Field(
        0.0, ge=0, description="Root mean square of the Fourier lens' aberrations over the mask."
    )
    wavefront_seed: int = Field(0, ge=0, description="Of these aberrations.")
    vignetting: float = Field(
        0.0, ge=0, le=1, description="Light lost by lens and camera at the middle of the field's border."
    )
    source_mrad: float = Field(
        0.0,
        ge=0,
        le=10,
        description="Angular size of the light source seen from the SLM, standard deviation: partly coherent "
        "light; 0 is a laser's.",
    )
    mask_depth: float = Field(
        1.0, gt=0, description="Depth of the mask's steps over the one that it was made for."
    )
    mask_roughness_rad: float = Field(
        0.0,
        ge=0,
        description="Of the phase of the mask's pixels, standard deviation.",
    )


class DisplayWorld(Surroundings):
    """What the simulated SLM, stage and camera of a holographic display share, coupled by physics.

    The laser shines while ``scene_lit``. The mask rides on the stage; its place when the stage reads zero is
    off by what the options say and nobody else is told.

    Parameters
    ----------
    options : DisplayOptions
        The table ``[simulated_display]`` of ``bench.toml``.
    """

    table = "simulated_display"
    Options = DisplayOptions
    options: DisplayOptions

    def __init__(self, options: DriverOptions) -> None:
        super().__init__(DisplayOptions.of(options), SENSOR)
        self._slm: DisplaySlm | None = None
        self._stage: Callable[[], Mapping[str, float]] = dict
        self._slm_pitch_um = 8.0
        self._optics: dict[float, ScatteringDisplay] = {}
        self._lasers: tuple[tuple[float, float], ...] = ()
        self._flatness: Float32Array | None = None
        self._image: tuple[Any, Float32Array] | None = None

    # What the devices do to the world ---
    def mount_slm(self, slm: DisplaySlm) -> None:
        """Put an SLM in the beam."""
        self._slm, self._slm_pitch_um = slm, slm.options.pixel_pitch_um

    def mount_mask(self, position: Callable[[], Mapping[str, float]]) -> None:
        """Put the mask on a stage: what tells the carriage's true position by axis name."""
        self._stage = position

    def shine(self, lasers: tuple[tuple[float, float], ...]) -> None:
        """Let lasers of other colours shine: of each the wavelength (nm) and its share of full light."""
        self._lasers = lasers

    # What there is to see ---
    def pose(self) -> MaskPose:
        """Return where the mask truly is; no place is wrong where there is none."""
        stage, options = self._stage(), self.options
        if not options.masked:
            return MaskPose()
        return MaskPose(
            options.shift_um[0] + stage.get("x_um", 0.0),
            options.shift_um[1] + stage.get("y_um", 0.0),
            options.z_um + stage.get("z_um", 0.0),
            options.roll_mrad + stage.get("roll_mrad", 0.0),
            options.pitch_mrad + stage.get("pitch_mrad", 0.0),
            options.yaw_mrad + stage.get("yaw_mrad", 0.0),
        )

    def photons_per_s(self, weights: tuple[float, float, float], binning: int = 1) -> Float32Array | None:
        """Return electrons a second on every binned camera pixel now, or None when all lasers are off."""
        if not self._shining or self._slm is None:
            return None
        with self._lock:
            key = self.light_key()
            if self._image is None or self._image[0] != key:
                light = np.zeros(self.sensor.shape, np.float32)
                for wavelength_nm, share in self._shining:
                    light += np.float32(self.options.light * share) * self._seen(self._slm, wavelength_nm)
                self._image = (key, light)
            image = self._image[1]
        return image if binning == 1 else block_sum(image, binning)

    @property
    def _shining(self) -> tuple[tuple[float, float], ...]:
        """Wavelength and share of full light of every laser that is on."""
        own = ((self.options.wavelength_nm, 1.0),) if self.scene_lit else ()
        return own + self._lasers

    def _seen(self, slm: DisplaySlm, wavelength_nm: float) -> Float32Array:
        """Return the light of one laser, 1 in the mean of the field without losses."""
        # The same optical path at every wavelength; glass and liquid crystal without dispersion.
        turns = self.options.wavelength_nm / wavelength_nm
        phase, amplitude = self._modulation(slm)
        optics = self._scattering_display(phase.shape, wavelength_nm)
        return optics.irradiance((phase + self._flatness_map(phase.shape)) * turns, self.pose(), amplitude)

    def _modulation(self, slm: DisplaySlm) -> tuple[Float32Array, Float32Array]:
        """Return the phase that light gains at each pixel, and the part of its amplitude that returns."""
        if self.options.mirrors:
            return np.zeros(slm.shape, np.float32), (slm.displayed / 255).astype(np.float32)
        phase = slm.phase_rad
        lost = self.options.amplitude_swing * np.sin(phase / 2) ** 2
        return phase, (1 - lost).astype(np.float32)

    def light_key(self) -> tuple[Any, ...]:
        """Return something that changes whenever :meth:`photons_per_s` does."""
        if not self._shining or self._slm is None:
            return (False,)
        return (*self._shining, hash(self._slm.displayed.tobytes()), self.pose())

    def _scattering_display(self, slm_shape: tuple[int, ...], wavelength_nm: float) -> ScatteringDisplay:
        if wavelength_nm not in self._optics:
            options = self.options
            height, width = (round(n * self._slm_pitch_um / options.mask_pitch_um) for n in slm_shape)
            bits = np.random.default_rng(options.mask_seed).integers(0, 2, (height, width), dtype=np.uint8)
            own = options.model_dump(include={field.name for field in fields(DisplaySpec)})
            turns = options.wavelength_nm / wavelength_nm
            own |= {"wavelength_nm": wavelength_nm, "wavefront_rad": options.wavefront_rad * turns}
            spec = DisplaySpec(
                slm_pitch_um=self._slm_pitch_um,
                sensor_shape=self.sensor.shape,
                sensor_pitch_um=self.sensor.pitch_um,
                **own,
            )
            phase = (pi * options.mask_depth * options.masked) * bits
            if options.mask_roughness_rad > 0:
                rough = np.random.default_rng(options.seed + 4).normal(size=phase.shape)
                phase += options.mask_roughness_rad * rough
            self._optics[wavelength_nm] = ScatteringDisplay(spec, phase * turns)
        return self._optics[wavelength_nm]

    def _flatness_map(self, shape: tuple[int, ...]) -> Float32Array:
        """Return a smooth phase error of the SLM: random polynomials up to third order, radians."""
        if self._flatness is None:
            rng = np.random.default_rng(self.options.seed + 3)
            y, x = (np.linspace(-1, 1, n) for n in shape)
            error = np.zeros(shape)
            for i in range(4):
                for j in range(4 - i):
                    if i + j >= 2:
                        error += rng.normal() * np.multiply.outer(y**i, x**j)
            error -= error.mean()
            self._flatness = (error * (self.options.flatness_rad / np.abs(error).max())).astype(np.float32)
        return self._flatness


class DisplayStageOptions(StageOptions):
    """Options of the simulated stage that carries the mask."""

    axis_names: tuple[str, ...] = Field(
        AXIS_NAMES, description="One to six of x_um, y_um, z_um, roll_mrad, pitch_mrad, yaw_mrad."
    )


class DisplayStage(CarriageStage):
    """The stage that carries the mask: a flexure stage with goniometers, zero where homing ends."""

    Shared = DisplayWorld
    Options = DisplayStageOptions
    model = "six-axis stage"
    world: DisplayWorld

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.world.mount_mask(self.carriage.true)

    def _axis_spec(self, name: str, options: AxisOptions) -> AxisSpec:
        linear = name.endswith("_um")
        own = options.model_dump(exclude_none=True)
        fine = {"resolution": 0.05, "backlash": 1.0, "repeatability": 0.1}
        if not linear:
            fine = {"resolution": 0.002, "backlash": 0.03, "repeatability": 0.005}
        reach = 2000.0 if linear else 20.0
        return axis_spec(name, AxisOptions(**(fine | own)), -reach, reach, 0.0)


class DisplaySlm(SimulatedSlm):
    """The SLM whose image falls onto the mask."""

    Shared = DisplayWorld
    world: DisplayWorld
    options: SlmOptions

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self.mirrors = self.world.options.mirrors
        self.world.mount_slm(self)


class DisplayCamera(SimulatedCamera):
    """The camera behind the Fourier lens."""

    Shared = DisplayWorld


class LaserOptions(LedArrayOptions):
    """Options of the simulated display's lasers in ``bench.toml``."""

    leds: int = Field(1, ge=1, le=1, description="One place, on the axis.")
    wavelengths_nm: tuple[float, float, float] = Field(
        (638.0, 520.0, 450.0), description="Of the red, the green and the blue one."
    )


class DisplayLasers(SimulatedLedArray):
    """Three lasers on the axis of ``[simulated_display]``'s own, for pictures in colour: an array of one LED.

    Their power is 0 to 255; full power is the light of the own laser.
    """

    Shared = DisplayWorld
    Options = LaserOptions
    model = "red, green and blue laser"
    world: DisplayWorld  # type: ignore[assignment]  # which Shared makes sure of

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__(options, shared)
        self._wavelengths_nm = LaserOptions.of(options).wavelengths_nm

    @property
    def wavelengths_nm(self) -> tuple[float, float, float]:
        """Wavelengths of red, green and blue."""
        return self._wavelengths_nm

    def _show(self, pattern: LedPattern) -> None:
        self._pattern = pattern
        powers = dict(pattern.levels).get(0, (0, 0, 0))
        lit = zip(self._wavelengths_nm, powers, strict=True)
        self.world.shine(tuple((nm, power / 255) for nm, power in lit if power))
