"""The simulated world: what all simulated devices of one bench share, coupled by physics."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from drivers.device import DriverOptions
from drivers.simulated import kept_light
from drivers.simulated.living import POWER, LivingLight
from drivers.simulated.options import PRESETS, Preset, WorldOptions
from drivers.simulated.scene_light import SceneLight
from drivers.simulated.scenes import make_scene, make_slide, place_of
from drivers.simulated.surroundings import CommonOptions, Surroundings
from recon.arrays import Float32Array
from recon.optics.animal import Animal, draw_animal
from recon.optics.diffuser import Diffuser, microlens_diffuser, smooth_diffuser
from recon.optics.fall_off import (
    FallOff,
    gaussian_fall_off,
    no_fall_off,
    response_on,
    table_fall_off,
)
from recon.optics.grid import PixelGrid, mixed_spectrum
from recon.optics.render import RenderSettings, product, render
from recon.optics.scene import Scene, TruthGrid, true_scene
from recon.optics.wave import WavePropagator
from recon.types import Geometry

Position = tuple[float, float, float]
Rgb = tuple[float, float, float]

CACHE_BYTES = 256 << 20
SOURCES_KEPT = 96
"""Lights of the point source that are kept: 32 places in three bands. A stage comes back to a place within
its play, not to the nanometre, so that old ones would only fill the memory."""
COARSE_PIXELS = 100_000
"""Of a coarse look, about; a sensor of less than four times as many has none."""
COARSE = RenderSettings(
    oversampling=1, node_tolerance=100.0, widest_spacing=1.0, fall_off_tolerance=5.0, most_nodes=9
)
BAND_WEIGHTS: tuple[Rgb, Rgb, Rgb] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class SimulatedWorld(Surroundings):
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
    options: WorldOptions

    def __init__(self, options: DriverOptions) -> None:
        options = WorldOptions.of(options)
        self.preset = preset = PRESETS[options.preset]
        super().__init__(options, preset.sensor)
        self.distance_um = 1e3 * (options.diffuser_distance_mm or preset.diffuser_distance_mm)
        self.aperture_mm = options.aperture_mm or preset.aperture_mm
        self.fall_off = _fall_off(options, preset)
        self.source_diameter_um = (
            preset.source_diameter_um if options.source_diameter_um is None else options.source_diameter_um
        )
        self._propagator: WavePropagator | None = None
        self._cache: OrderedDict[Any, Float32Array] = OrderedDict()
        self._emission: Rgb = (0.0, 0.0, 0.0)
        self._carrier: Callable[[], Position] = lambda: (0.0, 0.0, 1e3 * preset.source_distance_mm)
        self.animal: Animal | None = None
        """What lives, where the scene does."""
        if options.scene == "animal":
            self.animal = draw_animal(*place_of(options, preset, self.distance_um), options.seed)
        self._living: dict[tuple[Rgb, int], LivingLight] = {}
        self._born_s: float | None = None
        alive = self.animal
        self._scene = alive.scene(POWER) if alive else make_scene(options, preset, self.distance_um)
        self._scene_number = 0
        self._scene_light: SceneLight | None = None
        self._screen: tuple[Scene, ...] = ()

    # What the devices do to the world ---
    def carry_source(self, carrier: Callable[[], Position]) -> None:
        """Mount the point source on something that knows its true position ``(x, y, z)`` in micrometres."""
        self._carrier = carrier

    def set_emission(self, rgb: Rgb) -> None:
        """Light the point source; each band relative to one LED at its brightest right behind it."""
        self._emission = self._glow(rgb)

    @property
    def leds_light_scene(self) -> bool:
        """Whether the LED array lights the scene, and nothing the point source."""
        return self.options.led_light == "scene"

    def light_scene(self, light: SceneLight | None) -> None:
        """Light the scene by LEDs (None: by none); besides, it glows while ``scene_lit``."""
        self._scene_light = light

    def light_screen(self, *shown: Scene) -> None:
        """Let a screen glow with all that is given, whatever else is lit; nothing given: it is off.

        What stays the same is best given as the same object: its light is computed once.
        """
        self._screen = shown

    @property
    def source_position_um(self) -> Position:
        """Where the point source truly is now."""
        return self._carrier()

    @property
    def emission(self) -> Rgb:
        """How brightly the point source glows now in red, green and blue."""
        return self._emission

    def _glow(self, light: Rgb) -> Rgb:
        """Return the light that leaves something under this light: itself, or green fluorescence."""
        return (0.0, sum(light) / 3, 0.0) if self.preset.fluorescent else light

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
                )
            return self._propagator

    def sensor_grid(self, binning: int = 1) -> PixelGrid:
        """Return the sensor's pixels after binning; a rest at the lower and right border is left out."""
        height, width = (side // binning for side in self.sensor.shape)
        pitch = self.sensor.pitch_um
        rest_y, rest_x = (side - side // binning * binning for side in self.sensor.shape)
        return PixelGrid((height, width), pitch * binning, (-rest_x / 2 * pitch, -rest_y / 2 * pitch))

    def psf(self, source_um: Position, weights: Rgb, binning: int = 1) -> Float32Array:
        """Light of a point source on the binned pixels, with the sensor's angular response.

        Parameters
        ----------
        source_um : tuple of float
            True position of the source.
        weights : tuple of float
            Of the red, green and blue bands.
        binning : int

        Returns
        -------
        ndarray, float32, (height, width), read only
            Steradians (see :meth:`recon.optics.wave.WavePropagator.psf`).
        """
        # A nanometre decides nothing; without rounding no two visits of a place would share their picture.
        source = (round(source_um[0], 3), round(source_um[1], 3), round(source_um[2], 3))
        return self._mixed(("psf", source), weights, binning, lambda band: self._psf(source, band, binning))

    def _psf(self, source: Position, weights: Rgb, binning: int) -> Float32Array:
        grid = self.sensor_grid(binning)
        spectrum = mixed_spectrum(weights, self.options.spectral_samples)
        # Not the propagator's psf(), which keeps a second copy.
        caustic = self.propagator.caustic(
            source,
            grid,
            spectrum,
            diameter_um=self.source_diameter_um,
            emission="isotropic" if self.preset.fluorescent else "lambertian",
        )
        light = caustic.on(grid)
        light *= response_on(grid, source, self.distance_um, self.fall_off)
        return light

    def _mixed(
        self, what: tuple[Any, ...], weights: Rgb, binning: int, make: Callable[[Rgb], Float32Array]
    ) -> Float32Array:
        """Return light in proportions of the bands; each band's is computed once, whichever pixel asks."""
        total: Float32Array | None = None
        for band, weight in zip(BAND_WEIGHTS, weights, strict=True):
            if weight:
                light = self._cached((*what, band, binning), partial(make, band))
                if weight != 1:
                    light = light * np.float32(weight)
                total = light if total is None else total + light
        return np.zeros(self.sensor_grid(binning).shape, np.float32) if total is None else total

    def photons_per_s(self, weights: Rgb, binning: int = 1) -> Float32Array | None:
        """Photons a second on every binned pixel now, or None when all is dark."""
        light = None
        glow = product(self.emission, weights)
        if any(glow):
            # Cached by colour, not by brightness: dimming the light costs nothing.
            total = sum(glow)
            brightness = total * self.options.source_brightness * self.preset.source_photons_per_s_sr
            hue = (glow[0] / total, glow[1] / total, glow[2] / total)
            light = self.psf(self.source_position_um, hue, binning) * np.float32(brightness)
        with self._lock:
            scene, number = self._scene, self._scene_number
        for shown in self._screen:
            picture = self._picture(("screen", shown), shown, None, weights, binning)
            light = picture if light is None else light + picture
        leds = self._scene_light
        for lit in ((None,) if self.scene_lit else ()) + (() if leds is None else (leds,)):
            if scene is not None:
                seen = product(self._glow(self.options.scene_rgb), weights)
                if lit is None and self.animal is not None:
                    picture = self._alive(self.animal, seen, binning)
                else:
                    picture = self._picture(("scene", number, lit), scene, lit, seen, binning)
                light = picture if light is None else light + picture
        return light

    def coarse_photons_per_s(self, weights: Rgb, binning: int = 1) -> tuple[Float32Array, int] | None:
        """Return the light of a glowing scene in large pixels, of few nodes and one wavelength.

        None where that of every pixel is there, or takes no seconds.
        """
        height, width = (side // binning for side in self.sensor.shape)
        factor = int((height * width / COARSE_PIXELS) ** 0.5)
        scene = self._scene
        if factor < 2 or scene is None or not self.awaits_light(weights, binning):
            return None
        seen = product(self._glow(self.options.scene_rgb), weights)
        return self._render(scene, (0.0, sum(seen), 0.0), factor * binning, COARSE), factor

    def awaits_light(self, weights: Rgb, binning: int = 1) -> bool:
        """Whether the light of a scene that glows now would have to be computed first."""
        with self._lock:
            scene, number = self._scene, self._scene_number
            kept = any(key[:3] == ("scene", number, None) and key[-1] == binning for key in self._cache)
        if kept or scene is None or self.animal is not None or not self.scene_lit:
            return False
        name = self._kept_by(scene, product(self._glow(self.options.scene_rgb), weights), binning)
        return not (name and kept_light.is_kept(name))

    def _picture(
        self, what: tuple[Any, ...], scene: Scene, leds: SceneLight | None, weights: Rgb, binning: int
    ) -> Float32Array:
        """Return light of a scene that glows, or is lit by LEDs: at once where all is grey, else by bands."""

        def render_in(seen: Rgb) -> Float32Array:
            if leds is not None:
                return self._render(leds.on(scene), seen, binning)
            name = self._kept_by(scene, seen, binning) if what[0] == "scene" else None
            light = kept_light.kept(name) if name else None
            if light is None:
                light = self._render(scene, seen, binning)
                if name:
                    kept_light.keep(name, light)
            return light

        if scene.grey and (leds is None or leds.grey):
            return self._cached((*what, weights, binning), lambda: render_in(weights))
        return self._mixed(what, weights, binning, render_in)

    def _render(
        self, scene: Scene, weights: Rgb, binning: int, settings: RenderSettings | None = None
    ) -> Float32Array:
        return render(
            scene,
            weights,
            self.sensor_grid(binning),
            self.propagator,
            self.fall_off,
            layer_photons=self.preset.scene_photons_per_s_mm2_sr,
            bead_photons=self.preset.bead_photons_per_s_sr,
            settings=settings or RenderSettings(spectral_samples=self.options.spectral_samples),
        )

    def _kept_by(self, scene: Scene, weights: Rgb, binning: int) -> str | None:
        """Return the name that a scene's light is kept on disk by; None where it is computed quickly."""
        grid = self.sensor_grid(binning)
        if grid.shape[0] * grid.shape[1] < kept_light.WORTH_PIXELS:
            return None
        # Noise and faults come after the light.
        options = self.options.model_dump(exclude=set(CommonOptions.model_fields) - {"seed"})
        return kept_light.name_of(scene, self.preset, options, weights, grid)

    def _alive(self, animal: Animal, seen: Rgb, binning: int) -> Float32Array:
        with self._lock:
            if (seen, binning) not in self._living:
                # Large, and a camera has one binning at a time.
                self._living = {key: light for key, light in self._living.items() if key[1] == binning}
                self._living[seen, binning] = LivingLight(self, animal, seen, binning)
            return self._living[seen, binning].at(self.alive_s)

    @property
    def alive_s(self) -> float:
        """Simulated seconds since the animal was first seen."""
        if self._born_s is None:
            self._born_s = self.clock.now_s
        return self.clock.now_s - self._born_s

    def alive_at(self, ticks_ns: int) -> float:
        """Return :attr:`alive_s` at a time of the devices' clock, as frames carry it."""
        return self.clock.read_s(ticks_ns) - (self._born_s or 0.0)

    def light_key(self) -> tuple[Any, ...]:
        """Something that changes whenever :meth:`photons_per_s` does."""
        glow = self.emission
        x, y, z = self.source_position_um
        place = (round(x, 3), round(y, 3), round(z, 3)) if any(glow) else None
        key: tuple[Any, ...] = (place, glow, self._scene_number if self.scene_lit else None)
        if self._screen:
            key = (*key, "screen", *self._screen)
        if self.scene_lit and self.animal is not None:
            key = (*key, self.alive_s)
        return key if self._scene_light is None else (*key, self._scene_number, self._scene_light)

    # The scene and the truth about it ---
    @property
    def scene(self) -> Scene | None:
        """What stands in front of the camera."""
        return self._scene

    def set_scene(self, scene: Scene | None) -> None:
        """Put another scene in front of the camera (None: nothing)."""
        with self._lock:
            self._scene, self.animal = scene, None
            self._scene_number += 1
            self._living.clear()
            for key in [key for key in self._cache if key[0] == "scene"]:
                del self._cache[key]

    @property
    def slide_z_um(self) -> float:
        """How far from the diffuser slides of beads are put."""
        return place_of(self.options, self.preset, self.distance_um)[0]

    def change_slide(self, number: int) -> None:
        """Put a slide of beads in front of the camera; each ``number`` has them at other places."""
        self.set_scene(make_slide(self.options, self.preset, self.distance_um, number))

    @property
    def geometry(self) -> Geometry:
        """The optics as they are; the pixel pitch is that of unbinned pixels."""
        return Geometry(self.sensor.pitch_um, self.distance_um * 1e-3, self.aperture_mm)

    def ground_truth(
        self,
        shape: tuple[int, int],
        pitch_um: float,
        z_um: Sequence[float] | None = None,
        *,
        source_um: Position | None = None,
        color: bool = False,
        collected: bool = False,
    ) -> Float32Array:
        """Return the true scene on a reconstruction's grid.

        Parameters
        ----------
        shape : tuple of int
            ``(height, width)`` of the reconstruction. Its pixel ``(height // 2, width // 2)`` looks where the
            calibration source was.
        pitch_um : float
            Pixel pitch of the measurement, after binning.
        z_um : sequence of float, optional
            Depth planes of a volume; everything goes to the plane nearest in ``1 / z``. Left out: one picture
            of all depths.
        source_um : tuple of float, optional
            True position of the calibration source; left out, it was on the axis.
        color : bool
            Red, green and blue as last axis instead of what a monochrome sensor makes of them.
        collected : bool
            Times the share of its light that reaches a pixel through the aperture, relative to the axis
            (oblique incidence, the pixels' angular response). A reconstruction from an on-axis PSF shows
            this; Kuo 2020, Eq. 4.3 defines its object so.

        Returns
        -------
        ndarray, float32, ``shape``, ``(nz, *shape)`` or with a last axis of 3
            Brightness of every pixel's cell as a multiple of the point source's (one LED, white), upside down
            as in :mod:`recon.types`.

        Raises ValueError when there is no scene.
        """
        if self._scene is None:
            raise ValueError("There is no scene, so there is no ground truth.")
        return true_scene(
            self._scene,
            TruthGrid(
                shape,
                pitch_um,
                self.distance_um,
                source_um or (0.0, 0.0, 1.0),
                layer_scale=self.preset.scene_photons_per_s_mm2_sr / self.preset.source_photons_per_s_sr,
                bead_scale=self.preset.bead_photons_per_s_sr / self.preset.source_photons_per_s_sr,
            ),
            z_um=z_um,
            light=self._glow(self.options.scene_rgb),
            sensitivity=None if color else self.sensor.quantum_efficiency,
            fall_off=self.fall_off if collected else None,
        )

    def _cached(self, key: Any, make: Callable[[], Float32Array]) -> Float32Array:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
            image = make()
            image.flags.writeable = False
            self._cache[key] = image
            for old in [kept for kept in self._cache if kept[0] == "psf"][:-SOURCES_KEPT]:
                del self._cache[old]
            while sum(entry.nbytes for entry in self._cache.values()) > CACHE_BYTES and len(self._cache) > 1:
                self._cache.popitem(last=False)
            return image


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
