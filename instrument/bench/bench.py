"""The assembled bench: its devices opened together, made safe and closed together."""

from __future__ import annotations

import hashlib
import logging
import math
from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Self, cast

from drivers.camera import Camera
from drivers.common.answers import STOP_ANSWER_S, within
from drivers.common.checked import checked, given_up, require_ended
from drivers.device import Device, SharedPart
from drivers.errors import DeviceLostError, LimitError
from drivers.frame import Frame, FrameMetadata
from drivers.led_array import LedArray, LedPattern
from drivers.registry.claim import Claim
from drivers.slm import Slm
from drivers.stage import Stage, approached
from instrument.bench.camera_settings import apply_table
from instrument.bench.config import BenchConfig, CameraTable, DeviceConfig, Kind, SlmTable, StageTable
from instrument.bench.config_file import load_config
from instrument.bench.photograph import Progress, Snapshot, photograph
from instrument.bench.safety import (
    ClosingAtExit,
    SafeStep,
    StepsFailedError,
    note_failures,
    safe_steps,
    try_all,
)
from instrument.bench.source_and_scene import Ask, Lights, Position, SceneSwitch, SourceMount, known_geometry
from instrument.files import kept_times
from instrument.files.errors import BenchError
from recon.types import Geometry

_log = logging.getLogger(__name__)
_at_exit = ClosingAtExit()
_hung: dict[str, tuple[Device, Claim]] = {}
"""Claims of closed benches that are kept, since a call of the device had not ended: it may still act."""


class Bench:
    """Camera and, where the bench has them, stage, LED array and SLM.

    Made by :func:`open_bench`, which opens the devices in this order; ``close`` (or leaving the context)
    makes the bench safe and closes them in reverse order, each even if another fails. ``stop`` may be called
    from any thread at any time. ``ask`` asks the operator to light or darken something by hand, with a
    sentence to show, and returns when it is done.
    """

    def __init__(self, config: BenchConfig, ask: Ask | None = None) -> None:
        self.config = config
        self._claims: list[Claim] = []
        self._opened: set[Device] = set()
        """Devices that were opened and not closed again: one that is not open any more was lost."""
        self.shared: Mapping[str, SharedPart] = {
            name: shared.part(shared.options) for name, shared in config.shared.items()
        }
        self.devices: Mapping[Kind, Device] = {
            kind: self._made(kind, device) for kind, device in config.devices.items()
        }
        switch = next((part for part in self.shared.values() if isinstance(part, SceneSwitch)), None)
        self._seated: dict[str, float] = {}
        """Axes that came to where they are from below, and where that is."""
        self.newest_frame: Frame | None = None
        """The last frame of a photograph, whoever took it: what a window shows while a run goes on."""
        self._lights = Lights(config.source, config.scene, self.led_array, switch, ask)

    def _made(self, kind: Kind, device: DeviceConfig) -> Device:
        """Return a device of its driver, which touches no hardware yet, but may load a library that hangs."""
        driver = device.driver
        shared = self.shared[driver.Shared.table] if driver.Shared else None

        def make() -> Device:
            made: Device = checked(driver)(device.options, shared)
            return made

        return within(driver.longest_call_s, f"{kind} ({driver.__name__})", "making it", make)

    def foretell(self, of: str) -> None:
        """Let how long the next steps take be told as this bench's: by its sensor, by what they took last.

        ``of`` names the bench among others. Its camera is open.
        """
        height, width = self.camera.sensor_shape
        kept_times.about(
            of,
            megapixels=1e-6 * height * width,
            simulated="camera" in self.simulated_kinds,
            awaits_light=getattr(self.camera, "awaits_light", bool),
        )

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

        Raises DeviceError naming the device that is missing, refuses, or is in use by another program, and
        what to check.
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
        _at_exit.watch(self)
        self._claim(kind)
        device = self.devices[kind]
        device.open()
        self._opened.add(device)
        if kind == "camera":
            try:
                apply_table(cast(CameraTable, self.config.devices[kind].settings), self.camera)
            except LimitError as error:
                error.add_note(f"The value is from [camera] in {self.config.path}.")
                raise
        self._refuse_wire(device)
        if kind == "led_array":
            self._refuse_missing_leds(cast(LedArray, device))
        _log.info("%s opened: %s", device.name, device.identity)
        return device

    @property
    def trigger_source(self) -> LedArray | Slm | None:
        """The open device that plays sequences with a wire to the camera, by [trigger]; None without one."""
        sent_by = self.config.trigger.sent_by
        device = None if sent_by is None else cast("LedArray | Slm", self.devices[sent_by])
        return device if device is not None and device.is_open else None

    def _refuse_wire(self, device: Device) -> None:
        """Refuse a device that cannot do its part in the sequences of [trigger]."""
        wire = self.config.trigger
        if wire.sent_by is None:
            return
        problem = ""
        if device is self.camera and "hardware" not in self.camera.trigger_modes:
            problem = "takes no hardware trigger"
        elif device is self.devices[wire.sent_by]:
            limits = cast("LedArray | Slm", device).sequence_limits
            if limits is None:
                problem = "plays no sequences with pulses"
            elif wire.output >= limits.outputs:
                problem = f"has trigger outputs 0 to {limits.outputs - 1}, not {wire.output}"
        if problem:
            where = f"[trigger] of {self.config.path or 'the configuration'}"
            raise LimitError(device.name, f"{problem}, which {where} needs.", "Take that table out.")

    def _refuse_missing_leds(self, led_array: LedArray) -> None:
        count = len(led_array.led_positions_mm)
        if missing := [led for led in self.config.source.leds if led >= count]:
            raise LimitError(
                led_array.name,
                f"has LEDs 0 to {count - 1}, but [source] leds in {self.config.path} names "
                f"{', '.join(map(str, missing))}.",
            )

    def _claim(self, kind: Kind) -> None:
        """Keep other programs from a device, before it is touched, until the bench is closed."""
        held = {claim.resource for claim in self._claims}
        device = self.config.devices[kind]
        for resource in device.driver.claims(device.options):
            if resource in held:
                continue
            if (kept := _hung.get(resource)) is not None:
                require_ended(kept[0])
                if _hung.pop(resource, None) is not None:  # another thread may open a bench as well
                    kept[1].release()
            self._claims.append(Claim(resource, self.devices[kind].name))

    def _release(self, claim: Claim) -> None:
        """Give a device free, unless a call of it hangs: what that does late must meet nobody's work."""
        for kind, configured in self.config.devices.items():
            hangs = any(call.is_alive() for call in given_up(self.devices[kind]))
            if hangs and claim.resource in configured.driver.claims(configured.options):
                _hung[claim.resource] = self.devices[kind], claim
                return
        claim.release()

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
        return known_geometry(self.config.geometry, self.camera, self.shared.values())

    # Photographs -------------------------------------------------------------------------------
    def snap(self, average: int = 1, *, on_progress: Progress | None = None) -> Snapshot:
        """Take one photograph, the mean of ``average`` frames, all exposed after this call.

        ``on_progress`` is called after each frame.

        Raises DeviceError when the camera fails, or the LED array was lost meanwhile.
        """

        def take_note(frame: Frame) -> None:
            self.newest_frame = frame
            self.require_light()

        taken = photograph(self.camera, average, on_progress=on_progress, on_frame=take_note)
        return replace(taken, metadata=self.with_surroundings(taken.metadata))

    def require_light(self) -> None:
        """Refuse frames taken since the LED array was lost: nobody knows what lit them.

        Raises DeviceLostError when it was opened and is not open any more.
        """
        leds = self.led_array
        if leds is not None and leds in self._opened and not leds.is_open:
            raise DeviceLostError(
                leds.name,
                "was lost while frames were taken; those since are not kept.",
                "Check its cable and power, then take them again.",
            )

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
    def source_mount(self) -> SourceMount:
        """The point source on its stage.

        Raises BenchError when the bench has no stage.
        """
        if self.stage is None:
            raise BenchError(f"{self.config.label} has no [stage], so the source cannot be placed.")
        return SourceMount(self.stage, self.config.source.offset_um)

    @property
    def source_position_um(self) -> Position:
        """Where the point source is now, as the stage reads: x, y, z from the diffuser's centre."""
        return self.source_mount.position_um

    def place_source(
        self, x_um: float | None = None, y_um: float | None = None, z_um: float | None = None
    ) -> Position:
        """Move the point source to a place given from the diffuser's centre; None keeps a coordinate.

        Raises LimitError when the place is out of the stage's reach; nothing moves. Raises BenchError when
        there is no stage, or it lacks the axis; nothing moves.

        Returns
        -------
        tuple of float
            The place reached, as the stage reads.
        """
        mount = self.source_mount
        stage, target = mount.stage, mount.target(x_um, y_um, z_um)
        here, play = stage.position(), self.play
        seated = {
            axis.name
            for axis in stage.axes
            if abs(self._seated.get(axis.name, math.inf) - here[axis.name]) <= stage.settles_within(axis)
        }
        for place in approached(here, target, play, seated):
            reached = stage.move_to(place)
        self._seated |= {name: reached[name] for name in target if name in play}
        return mount.position_um

    @property
    def play(self) -> Mapping[str, float]:
        """Play of the stage's axes, as configured; those that are left out have none."""
        stage = self.config.devices.get("stage")
        return {} if stage is None else cast(StageTable, stage.settings).play

    @property
    def source_pattern(self) -> LedPattern:
        """The LED pattern that lights the point source."""
        return self._lights.source_pattern

    def source_on(self) -> None:
        """Light the point source; confirmed when this returns."""
        self._lights.switch_source(lit=True)

    def source_off(self) -> None:
        """Darken the point source."""
        self._lights.switch_source(lit=False)

    @property
    def can_switch_source(self) -> bool:
        """Whether the point source can be lit and darkened: by the LED array, or by asking the operator."""
        return self._lights.can_switch_source

    @property
    def no_source(self) -> str:
        """Why the LED array lights no point source here; empty where it does, or there is no array."""
        return self._lights.no_source

    # The scene ---------------------------------------------------------------------------------
    def scene_on(self) -> None:
        """Light the scene: the simulated world does it, or the operator is asked."""
        self._lights.switch_scene(lit=True)

    def scene_off(self) -> None:
        """Darken the scene: the simulated world does it, or the operator is asked."""
        self._lights.switch_scene(lit=False)

    @property
    def can_switch_scene(self) -> bool:
        """Whether the scene can be lit and darkened: by the simulated world, or by asking the operator."""
        return self._lights.can_switch_scene

    @property
    def scene_lit(self) -> bool:
        """Whether the scene is lit, as far as the program knows: an operator's own switching is not seen."""
        return self._lights.scene_lit

    @property
    def knows_scene(self) -> bool:
        """Whether ``scene_lit`` is known: of a scene that the operator lights, once he was asked."""
        return self._lights.knows_scene

    @property
    def source_lit(self) -> bool:
        """Whether the LEDs of [source] alone are lit, by the last pattern that the array confirmed."""
        leds = self.led_array
        return leds is not None and leds.is_open and self._lights.is_source(leds.pattern)

    @property
    def ask(self) -> Ask | None:
        """Asks the operator to do something by hand; None where nobody can be asked."""
        return self._lights.ask

    # Safety ------------------------------------------------------------------------------------
    def stop(self) -> None:
        """Make the bench safe, from any thread and whatever runs.

        Light off, motion stopped, exposure ended, SLM blank if so configured: all tried, in this order.

        Raises StepsFailedError after every step was tried, naming those that failed.
        """
        try_all(self._safe_steps())

    def close(self) -> None:
        """Make the bench safe and close every device in reverse order, each even if another fails.

        Raises StepsFailedError after everything was tried, naming what failed.
        """
        steps = self._safe_steps()
        steps += [
            (f"close {device.name}", partial(self.close_device, kind))
            for kind, device in reversed(list(self.devices.items()))
        ]
        steps += [(f"release {claim.resource}", partial(self._release, claim)) for claim in self._claims]
        self._claims = []
        try:
            try_all(steps)
        finally:
            _at_exit.forget(self)

    def close_device(self, kind: Kind) -> None:
        """Bring one device to its safe state and close it; what it was claimed by stays claimed.

        Raises DeviceError when it fails, or hangs.
        """
        device = self.devices[kind]
        self._opened.discard(device)
        within(2 * STOP_ANSWER_S, device.name, "closing", device.close, left=given_up(device))

    def _safe_steps(self) -> list[SafeStep]:
        blanks = self.slm is not None and cast(SlmTable, self.config.devices["slm"].settings).blank_when_safe
        return safe_steps(
            self.led_array,
            self._lights.scene_switch,
            self.stage,
            self.camera,
            self.slm if blanks else None,
            self._opened,
        )

    def _close_after(self, error: BaseException) -> None:
        """Close on the way out of an error, which stays the error that is raised."""
        try:
            self.close()
        except StepsFailedError as failure:
            note_failures(error, failure)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, _type: object, exc: BaseException | None, _traceback: object) -> None:
        if exc is None:
            self.close()
        else:
            self._close_after(exc)


def open_bench(config: BenchConfig | Path | str | None = None, *, ask: Ask | None = None) -> Bench:
    """Open a bench: every device that its configuration names, or none.

    ``config`` None means ``bench.toml`` in the working folder if there is one, otherwise the built-in
    simulated bench, which says SIMULATED wherever it is named. ``ask`` is as in :class:`Bench`. Use the bench
    as a context manager, or call ``close``.

    Raises ConfigError or FileError when the configuration is wrong (no device was touched); DeviceError when
    a device is missing or refuses (the others were closed again).
    """
    if not isinstance(config, BenchConfig):
        config = load_config(config)
    return Bench(config, ask).open()
