"""The assembled bench: its devices opened together, made safe and closed together."""

from __future__ import annotations

import atexit
import hashlib
import logging
import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import Protocol, Self, cast, runtime_checkable

import numpy as np
import numpy.typing as npt

from drivers.camera import Camera, Roi
from drivers.claim import Claim
from drivers.device import Device, SharedPart
from drivers.frame import FrameMetadata
from drivers.led_array import LedArray, LedPattern
from drivers.slm import Slm
from drivers.stage import Stage
from instrument.config import BenchConfig, CameraTable, Kind, SlmTable
from instrument.config_file import load_config
from instrument.errors import BenchError, OperatorNeededError
from instrument.safety import StepsFailedError, try_all
from recon.types import Geometry

Ask = Callable[[str], None]
"""Asks the operator to do something by hand and returns when it is done."""

_log = logging.getLogger(__name__)
_open_benches: weakref.WeakSet[Bench] = weakref.WeakSet()


@runtime_checkable
class SceneSwitch(Protocol):
    """A shared part that can light and darken the scene: the simulated world."""

    scene_lit: bool


@runtime_checkable
class KnownOptics(Protocol):
    """A shared part that knows the optics between scene and sensor: the simulated world."""

    distance_um: float
    """From the diffuser to the sensor."""
    aperture_mm: tuple[float, float]
    """``(height, width)``."""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """One photograph: a frame, or the mean of several.

    Attributes
    ----------
    image : ndarray
        ``(height, width)`` or ``(height, width, 3)`` in counts, read only; the camera's uint8 or uint16 for
        a single frame, float32 for a mean.
    metadata : FrameMetadata
        Of the last frame; ``dropped_before`` is summed and ``saturated_fraction`` the largest of all frames.
    average : int
        Number of frames averaged.
    """

    image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16] | npt.NDArray[np.float32]
    metadata: FrameMetadata
    average: int

    @property
    def full_scale(self) -> int:
        """The largest count that the camera can report at its present bit depth."""
        return (1 << self.metadata.significant_bits) - 1


class Bench:
    """Camera and, where the bench has them, stage, LED array and SLM.

    Made by :func:`open_bench`, which opens the devices in this order; ``close`` (or leaving the context)
    makes the bench safe and closes them in reverse order, each even if another fails. ``stop`` may be called
    from any thread at any time.

    Parameters
    ----------
    config : BenchConfig
    ask : callable, optional
        Asks the operator to light or darken something by hand, with a sentence to show; returns when done.
    """

    def __init__(self, config: BenchConfig, ask: Ask | None = None) -> None:
        self.config = config
        self._ask = ask
        self._asked: dict[str, bool] = {}
        self._claims: list[Claim] = []
        self.shared: Mapping[str, SharedPart] = {
            name: shared.part(shared.options) for name, shared in config.shared.items()
        }
        self.devices: Mapping[Kind, Device] = {
            kind: device.driver(
                device.options, self.shared[device.driver.Shared.table] if device.driver.Shared else None
            )
            for kind, device in config.devices.items()
        }

    # Devices -----------------------------------------------------------------------------------
    @property
    def camera(self) -> Camera:
        """The camera; every bench has one."""
        return cast(Camera, self.devices["camera"])

    @property
    def stage(self) -> Stage | None:
        """The stage, if the bench has one."""
        return cast("Stage | None", self.devices.get("stage"))

    @property
    def led_array(self) -> LedArray | None:
        """The LED array, if the bench has one."""
        return cast("LedArray | None", self.devices.get("led_array"))

    @property
    def slm(self) -> Slm | None:
        """The SLM, if the bench has one."""
        return cast("Slm | None", self.devices.get("slm"))

    def open(self) -> Self:
        """Open every device and apply the configured settings; on failure close again what was opened.

        Raises
        ------
        DeviceError
            Naming the device that is missing, refuses, or is in use by another program, and what to check.
        """
        try:
            for kind in self.devices:
                self._claim(kind)
            for kind in self.devices:
                self.open_device(kind)
        except BaseException as error:
            self._close_after(error)
            raise
        return self

    def open_device(self, kind: Kind) -> Device:
        """Open one device and apply its configured settings."""
        _open_benches.add(self)
        self._claim(kind)
        device = self.devices[kind]
        device.open()
        if kind == "camera":
            self._apply_camera_settings(cast(CameraTable, self.config.devices[kind].settings))
        _log.info("%s opened: %s", device.name, device.identity)
        return device

    def _claim(self, kind: Kind) -> None:
        """Keep other programs from a device, before it is touched, until the bench is closed."""
        held = {claim.resource for claim in self._claims}
        device = self.config.devices[kind]
        for resource in device.driver.claims(device.options):
            if resource not in held:
                self._claims.append(Claim(resource, self.devices[kind].name))

    def _apply_camera_settings(self, wanted: CameraTable) -> None:
        camera = self.camera
        if wanted.pixel_format is not None:
            camera.set_pixel_format(wanted.pixel_format)
        if wanted.binning is not None:
            camera.set_binning(wanted.binning)
        if wanted.roi is not None:
            camera.set_roi(Roi(*wanted.roi))
        if wanted.black_level is not None:
            camera.set_black_level(wanted.black_level)
        if wanted.gain is not None:
            camera.set_gain(wanted.gain)
        if wanted.exposure_ms is not None:
            camera.set_exposure_ms(wanted.exposure_ms)

    # What the bench is -------------------------------------------------------------------------
    @property
    def simulated_kinds(self) -> tuple[str, ...]:
        """Kinds of the open devices that have no hardware behind them."""
        return tuple(k for k, device in self.devices.items() if device.is_open and device.identity.simulated)

    @property
    def label(self) -> str:
        """The bench's name, with the word SIMULATED where it applies."""
        simulated = self.simulated_kinds
        if not simulated:
            return self.config.label
        part = "" if len(simulated) == len(self.devices) else f": {', '.join(simulated)}"
        return f"{self.config.label} SIMULATED{part}"

    def __str__(self) -> str:
        lines = [self.label]
        for kind, device in self.devices.items():
            lines.append(f"  {kind}: {device.identity if device.is_open else 'closed'}")
        return "\n".join(lines)

    @property
    def geometry(self) -> Geometry:
        """The optics: as configured, else as the devices know them; the pitch is that of binned pixels."""
        table = self.config.geometry
        known = next((part for part in self.shared.values() if isinstance(part, KnownOptics)), None)
        distance_mm, aperture_mm = (known.distance_um / 1e3, known.aperture_mm) if known else (None, None)
        pitch_um = table.pixel_pitch_um or self.camera.pixel_pitch_um
        return Geometry(
            pixel_pitch_um=pitch_um * self.camera.binning,
            diffuser_distance_mm=table.diffuser_distance_mm or distance_mm,
            aperture_mm=table.aperture_mm or aperture_mm,
            wavelength_nm=table.wavelength_nm,
        )

    # Photographs -------------------------------------------------------------------------------
    def snap(self, average: int = 1, *, on_frame: Callable[[int], None] | None = None) -> Snapshot:
        """Take one photograph, the mean of ``average`` frames, all exposed after this call.

        ``on_frame`` is called with the number of frames taken so far, after each.

        Raises
        ------
        DeviceError
            When the camera fails.
        """
        if average < 1:
            raise BenchError(f"A photograph is the mean of 1 or more frames, not {average}.")
        total = np.zeros((), np.float64)
        dropped, saturated = 0, 0.0
        for taken in range(1, average + 1):
            frame = self.camera.snap()
            dropped += frame.metadata.dropped_before
            saturated = max(saturated, frame.metadata.saturated_fraction)
            if average > 1:
                total = np.add(total, frame.image)
            if on_frame is not None:
                on_frame(taken)
        metadata = replace(frame.metadata, dropped_before=dropped, saturated_fraction=saturated)
        if average == 1:
            return Snapshot(frame.image, self.with_surroundings(metadata), average)
        mean = np.asarray(total / average, np.float32)
        mean.flags.writeable = False
        return Snapshot(mean, self.with_surroundings(metadata), average)

    def with_surroundings(self, metadata: FrameMetadata) -> FrameMetadata:
        """Return a frame's metadata completed with stage position, LED pattern and SLM image as they are."""
        return replace(
            metadata,
            stage_position=self.stage.position() if self.stage else metadata.stage_position,
            led_pattern=self.led_array.pattern.description if self.led_array else metadata.led_pattern,
            slm_image_hash=(
                hashlib.sha256(self.slm.displayed.tobytes()).hexdigest()
                if self.slm
                else metadata.slm_image_hash
            ),
        )

    # The point source --------------------------------------------------------------------------
    @property
    def source_position_um(self) -> tuple[float, float, float]:
        """Where the point source is now, as the stage reads: x, y, z from the diffuser's centre."""
        position = self._stage().position()
        x, y, z = (
            position.get(axis, 0.0) + offset
            for axis, offset in zip(("x_um", "y_um", "z_um"), self.config.source.offset_um, strict=True)
        )
        return (x, y, z)

    def place_source(
        self, x_um: float | None = None, y_um: float | None = None, z_um: float | None = None
    ) -> tuple[float, float, float]:
        """Move the point source to a place given from the diffuser's centre; None keeps a coordinate.

        Returns
        -------
        tuple of float
            The place reached, as the stage reads.

        Raises
        ------
        LimitError
            When the place is out of the stage's reach; nothing moves.
        BenchError
            When there is no stage, or it lacks the axis; nothing moves.
        """
        self._stage().move_to(self.stage_target(x_um, y_um, z_um))
        return self.source_position_um

    def stage_target(
        self, x_um: float | None = None, y_um: float | None = None, z_um: float | None = None
    ) -> dict[str, float]:
        """Return the stage position that brings the point source to a place; errors as ``place_source``."""
        axes = {axis.name for axis in self._stage().axes}
        target = {}
        wanted = {"x_um": x_um, "y_um": y_um, "z_um": z_um}
        for (axis, value), offset in zip(wanted.items(), self.config.source.offset_um, strict=True):
            if value is None:
                continue
            if axis in axes:
                target[axis] = value - offset
            elif abs(value - offset) > 1e-6:
                raise BenchError(
                    f"{self._stage().name} has no axis {axis}, so the source stays at {axis} = {offset:g}; "
                    f"it cannot go to {value:g}. Axes: {', '.join(sorted(axes))}."
                )
        return target

    def _stage(self) -> Stage:
        if self.stage is None:
            raise BenchError(f"{self.config.label} has no [stage], so the source cannot be placed.")
        return self.stage

    def source_on(self) -> None:
        """Light the point source; confirmed when this returns."""
        if self.led_array is None:
            self._ask_once("the point source", lit=True)
            return
        source = self.config.source
        leds = ", ".join(map(str, source.leds))
        self.led_array.set_pattern(
            LedPattern(
                f"point source: LED {leds} rgb {source.rgb}", tuple((led, source.rgb) for led in source.leds)
            )
        )

    def source_off(self) -> None:
        """Darken the point source."""
        if self.led_array is None:
            self._ask_once("the point source", lit=False)
        else:
            self.led_array.off()

    # The scene ---------------------------------------------------------------------------------
    def scene_on(self) -> None:
        """Light the scene: the simulated world does it, or the operator is asked."""
        self._switch_scene(lit=True)

    def scene_off(self) -> None:
        """Darken the scene: the simulated world does it, or the operator is asked."""
        self._switch_scene(lit=False)

    @property
    def can_switch_scene(self) -> bool:
        """Whether the scene can be lit and darkened: by the simulated world, or by asking the operator."""
        if self.config.scene.control == "operator":
            return self._ask is not None
        return self._scene_switch() is not None

    @property
    def can_switch_source(self) -> bool:
        """Whether the point source can be lit and darkened: by the LED array, or by asking the operator."""
        return self.led_array is not None or self._ask is not None

    def _switch_scene(self, *, lit: bool) -> None:
        if self.config.scene.control == "operator":
            self._ask_once("the scene", lit=lit)
            return
        switch = self._scene_switch()
        if switch is None:
            raise BenchError(
                'bench.toml says [scene] control = "simulated", but no device of this bench is simulated. '
                'Set it to "operator".'
            )
        switch.scene_lit = lit

    def _scene_switch(self) -> SceneSwitch | None:
        return next((part for part in self.shared.values() if isinstance(part, SceneSwitch)), None)

    def _ask_once(self, what: str, *, lit: bool) -> None:
        if self._asked.get(what) == lit:
            return
        request = f"Please {'light' if lit else 'darken'} {what}."
        if self._ask is None:
            raise OperatorNeededError(
                f"{request} Nobody can be asked here: run it in a terminal or pass ask=."
            )
        self._ask(request)
        self._asked[what] = lit

    # Safety ------------------------------------------------------------------------------------
    def stop(self) -> None:
        """Stop whatever runs and make the bench safe, from any thread; see ``safe_state``."""
        self.safe_state()

    def safe_state(self) -> None:
        """Light off, motion stopped, exposure ended, SLM blank if so configured: all tried, in this order.

        Raises
        ------
        StepsFailedError
            After every step was tried, naming those that failed.
        """
        try_all(self._safe_steps())

    def close(self) -> None:
        """Make the bench safe and close every device in reverse order, each even if another fails.

        Raises
        ------
        StepsFailedError
            After everything was tried, naming what failed.
        """
        steps = self._safe_steps()
        steps += [(f"close {device.name}", device.close) for device in reversed(list(self.devices.values()))]
        steps += [(f"release {claim.resource}", claim.release) for claim in self._claims]
        self._claims = []
        try:
            try_all(steps)
        finally:
            _open_benches.discard(self)

    def _safe_steps(self) -> list[tuple[str, Callable[[], None]]]:
        steps: list[tuple[str, Callable[[], None]]] = []
        if (led_array := self.led_array) is not None:
            steps.append((f"light off, {led_array.name}", _when_open(led_array, led_array.off)))
        if (switch := self._scene_switch()) is not None:
            steps.append(("scene dark, simulated", lambda: setattr(switch, "scene_lit", False)))
        if (stage := self.stage) is not None:
            steps.append((f"motion stopped, {stage.name}", _when_open(stage, stage.stop)))
        steps.append(
            (f"exposure ended, {self.camera.name}", _when_open(self.camera, self.camera.stop_sequence))
        )
        if (slm := self.slm) is not None and cast(
            SlmTable, self.config.devices["slm"].settings
        ).blank_when_safe:
            steps.append((f"blank, {slm.name}", _when_open(slm, slm.blank)))
        return steps

    def _close_after(self, error: BaseException) -> None:
        """Close on the way out of an error, which stays the error that is raised."""
        try:
            self.close()
        except StepsFailedError as failure:
            _log.error("%s", failure)
            error.add_note(str(failure))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        exc_type: type[BaseException] | None,
        exc: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        if exc is None:
            self.close()
        else:
            self._close_after(exc)


def open_bench(config: BenchConfig | Path | str | None = None, *, ask: Ask | None = None) -> Bench:
    """Open a bench: every device that its configuration names, or none.

    Parameters
    ----------
    config : BenchConfig or path, optional
        None means ``bench.toml`` in the working folder if there is one, otherwise the built-in simulated
        bench, which says SIMULATED wherever it is named.
    ask : callable, optional
        Asks the operator to do something by hand, with a sentence to show; returns when it is done.

    Returns
    -------
    Bench
        Open; use it as a context manager, or call ``close``.

    Raises
    ------
    ConfigError, FileError
        When the configuration is wrong; no device was touched.
    DeviceError
        When a device is missing or refuses; the others were closed again.
    """
    if not isinstance(config, BenchConfig):
        config = load_config(config)
    return Bench(config, ask).open()


def _when_open(device: Device, step: Callable[[], None]) -> Callable[[], None]:
    def run() -> None:
        if device.is_open:
            step()

    return run


def _close_all() -> None:
    """Leave no light on when the interpreter ends with a bench still open."""
    for bench in list(_open_benches):
        try:
            bench.close()
        except StepsFailedError as failure:
            _log.error("%s", failure)


atexit.register(_close_all)
