"""The bench as display procedures see it: show an SLM field, photograph it, background subtracted.

The camera is registered by the mask's own speckle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from calibration_routines.display.kept_frames import KeptFrames, question
from drivers.led_array import LedPattern
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.bench.bench import Bench
from instrument.bench.sequence import Wire, take_sequence
from instrument.files.atomic import check_writable
from instrument.files.errors import BenchError
from instrument.files.slm_image import SlmCorrection, field_levels
from instrument.reconstruction.preparation import darkest_block
from instrument.runs.writer import dated_name, free_name
from recon.arrays import Array, BoolArray
from recon.holography import Display
from recon.holography.camera_map import CameraMap, register_camera


class DisplayBench:
    """Shows fields on the bench's SLM and counts the frames taken.

    Parameters
    ----------
    bench : Bench
        Open, with SLM and camera.
    binning : int
        SLM pixels used as one.
    correction : SlmCorrection
        Look-up table and flatness, applied here and nowhere else.
    estimate_background : bool
        For a laser that nobody can switch off: the background is not measured but estimated, the mean of the
        first photograph's darkest 10 x 10 pixels.
    check : callable, optional
        Called before anything is shown or photographed; what it raises ends that, e.g. ``RunControl.check``.
    on_frame : callable, optional
        Called after each frame with how many were taken.
    wavelength_nm : float, optional
        Of the light. Unless it is that of ``[display]``, whose laser is the scene's light, the LED array's
        colour of that wavelength shines, and the SLM's phases are taken for those of the same optical path.
    kept : KeptFrames, optional
        Keeps the frames, and gives those that it has instead of new ones.

    Raises BenchError when the bench has no light of that wavelength.
    """

    def __init__(
        self,
        bench: Bench,
        binning: int,
        correction: SlmCorrection | None = None,
        *,
        estimate_background: bool = False,
        check: Callable[[], object] = lambda: None,
        on_frame: Callable[[int], object] = lambda _: None,
        wavelength_nm: float | None = None,
        kept: KeptFrames | None = None,
    ) -> None:
        self.bench = bench
        self.slm = require_slm(bench)
        self.binning = binning
        own_nm = bench.config.display.wavelength_nm
        self.wavelength_nm = wavelength_nm or own_nm
        self._laser = None if self.wavelength_nm == own_nm else laser_of(bench, self.wavelength_nm)
        self.correction = correction or SlmCorrection.ideal()
        if self._laser is not None:
            self.correction = self.correction.at(own_nm / self.wavelength_nm)
        self.estimates_background = estimate_background
        self._check, self._on_frame = check, on_frame
        self.frames = 0
        self._dark: tuple[tuple[float, ...], Array | float] | None = None
        self._kept, self._lit = kept, False

    def show(self, field: Array) -> None:
        """Show an SLM field, complex (height, width) in binned pixels: its phase, or what mirrors send."""
        self._check()
        levels = field_levels(field, self.binning, mirrors=self.slm.mirrors)
        self.slm.display(levels if self.slm.mirrors else self.correction.apply(levels))

    def show_levels(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels as they are, uncorrected, (height, width) of the whole SLM."""
        self._check()
        self.slm.display(levels)

    def photograph(self, exposure_ms: float) -> Array:
        """Return counts a millisecond, background subtracted, float64: one frame, and a dark one at first.

        The dark level is measured once with the laser off (or estimated with it on), at the first exposure
        asked for; its part that grows with time is small against it.
        """
        exposure = self._expose(exposure_ms)
        return self._signal(self._snap()) / exposure

    def photographs(self, images: Sequence[npt.NDArray[np.uint8]], exposure_ms: float) -> list[Array]:
        """Show grey levels as they are, one after the other, and return the photograph of each.

        By sequences that hardware times, where a trigger wire leads from the SLM to the camera.
        """
        wire = Wire(self.bench)
        most = wire.most if self.bench.trigger_source is self.slm else 0
        if most < 2:
            taken = []
            for levels in images:
                self.show_levels(levels)
                taken.append(self.photograph(exposure_ms))
            return taken
        exposure = self._expose(exposure_ms)
        frames: list[Array] = []
        for first in range(0, len(images), most):
            self._check()
            part = images[first : first + most]
            frames += [self._signal(image) / exposure for image in self._played(wire, part)]
        return frames

    def _expose(self, exposure_ms: float) -> float:
        """Set the exposure, know the background, light the laser; returns the exposure made, milliseconds."""
        self._check()
        camera = self.bench.camera
        low, high = camera.exposure_limits_ms
        exposure = camera.set_exposure_ms(float(np.clip(exposure_ms, low, high)))
        if not self.estimates_background and (self._dark is None or self._dark[0] != self._key):
            self.light(on=False)
            self._dark = self._key, self._snap()
            self._check()
        self.light(on=True)
        return exposure

    @property
    def own_light(self) -> bool:
        """Whether it is the bench's own laser, which is the scene's light."""
        return self._laser is None

    def light(self, *, on: bool) -> None:
        """Switch the laser; another than the bench's own shines alone."""
        bench, self._lit = self.bench, on
        if self._laser is None:
            bench.scene_on() if on else bench.scene_off()
            return
        assert bench.led_array is not None
        if bench.can_switch_scene:
            bench.scene_off()
        if on:
            bench.led_array.set_pattern(self._laser)
        else:
            bench.led_array.off()

    @property
    def _key(self) -> tuple[float, ...]:
        """What the background depends on."""
        camera = self.bench.camera
        return (camera.gain, float(camera.binning), *map(float, camera.roi.as_tuple()))

    def _signal(self, frame: Array) -> Array:
        """Return a frame less the background."""
        if self._dark is None or self._dark[0] != self._key:
            self._dark = self._key, darkest_block(frame)
        return np.asarray(frame - self._dark[1])

    @property
    def full_scale(self) -> int:
        """The camera's largest count."""
        return (1 << self.bench.camera.significant_bits) - 1

    def saturated(self, photograph: Array) -> BoolArray:
        """Return which pixels of the photograph taken last, counts a millisecond, are at full scale."""
        dark = 0.0 if self._dark is None else self._dark[1]
        found: BoolArray = photograph * self.bench.camera.exposure_ms + dark >= self.full_scale - 0.5
        return found

    def exposure_ms(self, mean_per_ms: float) -> float:
        """Return the exposure at which the mean, so many counts a millisecond, is a twelfth of full scale."""
        return self.full_scale / (12 * mean_per_ms)

    def across_px(self, display: Display) -> float:
        """Return camera pixels across the display's field of view."""
        pitch_um = self.bench.camera.pixel_pitch_um * self.bench.camera.binning
        return display.wavelength_nm * display.focal_mm / display.mask_pitch_um / pitch_um

    def _snap(self) -> Array:
        if self._kept is None:
            return self._counted(self.bench.snap().image)
        asked = self._question(self.slm.displayed)
        (image,) = self._kept.answers([asked], lambda _: [self.bench.snap()])
        return self._counted(image)

    def _played(self, wire: Wire, images: Sequence[npt.NDArray[np.uint8]]) -> list[Array]:
        """Return the frames of grey levels that hardware times."""
        if self._kept is None:
            taken = [frame.image for frame in take_sequence(wire, images).frames]
        else:
            asked = [self._question(levels) for levels in images]
            taken = self._kept.answers(asked, lambda first: take_sequence(wire, images[first:]).frames)
        return [self._counted(image) for image in taken]

    def _question(self, shown: Array) -> str:
        stage = self.bench.stage
        place = stage.commanded_position() if stage is not None and stage.is_homed else {}
        places = [(name, round(value, 3)) for name, value in sorted(place.items())]
        return question(shown, self._lit, f"{self.bench.camera.exposure_ms:.6g}", *self._key, *places)

    def _counted(self, image: Array) -> Array:
        self.frames += 1
        self._on_frame(self.frames)
        return np.asarray(image, np.float64)


def approach_from_below(stage: Stage, target: Mapping[str, float]) -> None:
    """Move to a place so that every axis ends upwards: the play of its screw is then always on one side."""
    limits = stage.limits
    play = {name: 5.0 if name.endswith("_um") else 0.1 for name in target}
    stage.move_to({name: max(value - play[name], limits[name][0]) for name, value in target.items()})
    stage.move_to(target)


def bring_mask(bench: Bench, place: Mapping[str, float]) -> None:
    """Bring the mask's stage to where an alignment left it, homing it where it has lost its reference.

    An empty place moves nothing.

    Raises BenchError when there is a place and no stage; DeviceError when the stage refuses or fails.
    """
    if not place:
        return
    if bench.stage is None:
        raise BenchError(f"{bench.label} has no [stage] to bring the mask to its place.")
    if not bench.stage.is_homed:
        bench.stage.home()
    approach_from_below(bench.stage, place)


def find_camera(
    io: DisplayBench, display: Display, turned_rad: float | None = None
) -> tuple[CameraMap, float]:
    """Blank the SLM, register the camera by the mask's speckle, and learn how bright the mean intensity is.

    Returns that in counts a millisecond. Raises InputError when the speckle is not recognised.
    ``turned_rad``: how the camera is turned, where that is known.
    """
    io.show(np.ones(display.slm_shape, complex))
    frame = io.photograph(io.bench.camera.exposure_ms)
    found = register_camera(frame, display, io.across_px(display), turned_rad=turned_rad)
    return found, _inner_mean(frame, found)


def random_brightness(
    io: DisplayBench, display: Display, camera: CameraMap, mean_per_ms: float | None = None
) -> float:
    """Return counts a millisecond of the mean intensity of random phases.

    A blank SLM adds up with light that is not modulated, so that its picture is brighter or darker than that
    of any hologram; ``mean_per_ms``, from :func:`find_camera`, only sets the exposure (the camera's own).
    """
    phases = np.random.default_rng(0).uniform(0, 2 * np.pi, display.slm_shape)
    io.show(np.exp(1j * phases))
    own_ms = io.bench.camera.exposure_ms
    return _inner_mean(io.photograph(own_ms if mean_per_ms is None else io.exposure_ms(mean_per_ms)), camera)


def _inner_mean(frame: Array, camera: CameraMap) -> float:
    """Return the mean over the inner field of view, the mask pixels' envelope divided out."""
    rows, columns = camera.pixels(np.array([-0.3, 0.3]), np.array([-0.3, 0.3]))
    inner = frame[round(rows[0]) : round(rows[1]), round(columns[0]) : round(columns[1])]
    envelope = (np.sinc(np.linspace(-0.3, 0.3, 101)) ** 2).mean() ** 2
    return float(inner.mean() / envelope)


def laser_of(bench: Bench, wavelength_nm: float) -> LedPattern:
    """Return the LED pattern that lights one colour of a display: the point source's LEDs in that colour.

    Raises BenchError when the bench has no LED array, or none of its colours is within 2 % of the wavelength.
    """
    leds = bench.led_array
    if leds is None:
        raise BenchError(
            f"The pattern is for {wavelength_nm:g} nm, the laser of {bench.label} has "
            f"{bench.config.display.wavelength_nm:g} nm. Lasers or LEDs of other colours are an [led_array]; "
            "this bench has none."
        )
    channel = int(np.argmin(np.abs(np.subtract(leds.wavelengths_nm, wavelength_nm))))
    if abs(leds.wavelengths_nm[channel] / wavelength_nm - 1) > 0.02:
        colours = ", ".join(f"{nm:g}" for nm in leds.wavelengths_nm)
        raise BenchError(
            f"The pattern is for {wavelength_nm:g} nm; {leds.name} has {colours} nm. Compute it for these: "
            f"diffuserbench hologram --color --wavelengths {' '.join(colours.split(', '))}"
        )
    rgb = [0, 0, 0]
    rgb[channel] = 255
    lit = tuple((index, (rgb[0], rgb[1], rgb[2])) for index, _ in bench.source_pattern.levels)
    return LedPattern(f"{wavelength_nm:g} nm", lit)


# Files ------------------------------------------------------------------------------------------------
def require_slm(bench: Bench, only_phases: str = "") -> Slm:
    """Return the bench's SLM; BenchError where it has none, or mirrors where ``only_phases`` says why not."""
    if bench.slm is None:
        raise BenchError(f"{bench.label} has no [slm].")
    if only_phases and bench.slm.mirrors:
        raise BenchError(f"{bench.slm.name} has mirrors that send light or not: {only_phases}.")
    return bench.slm


def writable(bench: Bench, folder: Path | None, out: Path | None, label: str) -> Path:
    """Return the file to write in the end, by default one with a date, sure now that it can be written."""
    if out is None:
        where = folder or bench.config.data_folder
        where.mkdir(parents=True, exist_ok=True)
        out = free_name(where, dated_name(label), ".json")
    check_writable(out)
    return out
