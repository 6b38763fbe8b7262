"""The driver of stages on GRBL 1.1 and grblHAL controllers."""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Mapping

from drivers.common.polled_stage import PolledStage, StageState
from drivers.device import DeviceIdentity, DriverOptions, FoundDevice, Setting, SharedPart, port_claim
from drivers.errors import DeviceError, DeviceTimeoutError, StoppedError
from drivers.grbl.link import GrblLink
from drivers.grbl.protocol import (
    CRITICAL_ALARMS,
    FEED_HOLD,
    JOG_CANCEL,
    MOVING_STATES,
    Report,
    jog,
    parse_error,
    parse_info,
    parse_settings,
)
from drivers.grbl.settings import REPORTED_STEP, ControllerSettings, GrblAxis, GrblOptions
from drivers.registry.buses import lasting_name
from drivers.stage import StageAxis

_log = logging.getLogger(__name__)
_OLDEST = (1, 1)
_UNUSABLE = {
    "Door": "its safety door is open",
    "Sleep": "it sleeps",
    "Check": "it only checks G-code and does not move ($C ends that)",
    "Tool": "it waits for a tool change",
}


class GrblStage(PolledStage):
    """Three to six axes on a GRBL 1.1 or grblHAL controller.

    Moves are jogs to absolute machine positions: they can be cancelled without losing steps, which programs
    of G-code cannot, and leave the controller's own modes as they are. STOP cancels the jog; homing can only
    be ended by a reset, after which, as after every alarm and every reset by others, it must home again.
    """

    Options = GrblOptions
    reply_s = 1.0
    """What a reply may take."""
    meet_s = 2.0
    """How long a controller may be silent after its port was opened."""

    def __init__(self, options: DriverOptions, shared: SharedPart | None = None) -> None:
        super().__init__()
        self.options = options = GrblOptions.of(options)
        self._maps = {name: axis.axis_map(name) for name, axis in options.axes.items()}
        self._link = GrblLink(options.port, self.name, options.baud_rate, self.reply_s)
        self._controller = ControllerSettings({}, {})
        self._places: tuple[float, ...] = ()
        self._zero: tuple[float, ...] = ()
        self._planned: dict[str, float] = {}
        self._banners = 0
        self._homed = self._homing = self._halting = self._locked = False
        self._fault = ""
        """What happened since the last homing that ended it."""

    @classmethod
    def claims(cls, options: DriverOptions) -> tuple[str, ...]:
        """Claim the serial port."""
        return (port_claim(GrblOptions.of(options).port),)

    @classmethod
    def probe(cls, port: str) -> FoundDevice | None:
        """Ask whether a GRBL controller answers at 115200 baud; nothing moves."""
        link = GrblLink(port, f"port {port}", 115_200, cls.reply_s)
        link.open()
        try:
            link.meet(cls.meet_s, reset=False)
            axes = len(link.report().places)
            settings = ControllerSettings({}, parse_info(link.command(b"$I\n")))
        except DeviceError:
            return None
        finally:
            link.close()
        firmware = (
            f"{'grblHAL' if settings.is_hal else 'GRBL'} {settings.info.get('VER', '').rstrip(':')}".strip()
        )
        return FoundDevice(
            "serial",
            port,
            f"{firmware}, {axes} axes",
            product=settings.info.get("BOARD", ""),
            driver="grbl",
            kind="stage",
            options={"port": lasting_name(port)},
        )

    @property
    def name(self) -> str:
        """The stage as error messages name it."""
        return f"stage (grbl, {self.options.port})"

    def settings(self) -> Mapping[str, Setting]:
        """Read position, limits, speeds; what the controller's settings mean; and all of them by number."""
        found = dict(super().settings())
        for name in self.options.axes:
            axis, unit = self._index(name), abs(self._maps[name].scale)
            found[f"acceleration_{name}_per_s2"] = self._acceleration_per_s2(name)
            found[f"resolution_{name}"] = unit / self._controller.steps_per_unit(axis)
            backlash = self._controller.backlash(axis)
            if backlash is not None:
                found[f"backlash_compensated_{name}"] = unit * backlash
        found["controller_soft_limits"] = self._controller.soft_limits
        found["controller_hard_limits"] = self._controller.hard_limits
        return found | {f"${number}": value for number, value in self._controller.values.items()}

    # Connecting ------------------------------------------------------------------------------------
    @property
    def _is_connected(self) -> bool:
        return self._link.is_open

    def _connect(self) -> tuple[DeviceIdentity, tuple[StageAxis, ...]]:
        self._homed = self._homing = self._halting = False
        self._fault = ""
        self._link.open()
        report = self._first_report()
        info = parse_info(self._link.command(b"$I\n"))
        version = re.match(r"(\d{1,3})\.(\d{1,3})", info.get("VER", ""))
        if version is None or (int(version[1]), int(version[2])) < _OLDEST:
            raise DeviceError(
                self.name,
                f"says its version is {info.get('VER', 'unknown')!r}; GRBL 1.1 or grblHAL was expected.",
                "Older versions cannot jog: update the firmware.",
            )
        self._controller = ControllerSettings(parse_settings(self._link.command(b"$$\n")), info)
        self._controller.check(self.name, len(report.places))
        self._places, self._zero = report.places, (0.0,) * len(report.places)
        axes = tuple(self._axis(name, axis) for name, axis in self.options.axes.items())
        if not self._controller.soft_limits and self.options.homing == "switches":
            _log.warning("%s: the controller's own soft limits are off ($20=0).", self.name)
        self._link.take_alarm()
        self._banners = self._link.banners
        return self._identify(), axes

    def _first_report(self) -> Report:
        """Return a report of a controller at rest: others are refused their questions."""
        self._link.meet(self.meet_s, reset=True)
        report = self._link.report()
        deadline_s = time.monotonic() + self.stop_s
        self._halting = True
        while report.state in MOVING_STATES or report.state == "Hold:0":
            if time.monotonic() > deadline_s:
                raise DeviceTimeoutError(
                    self.name, f"is in state {report.state} and does not stop.", "Switch off its power."
                )
            self._press_on(report.state)
            time.sleep(self.poll_s)
            report = self._link.report()
        self._halting = False
        return report

    def _disconnect(self) -> None:
        self._link.close()

    def _identify(self) -> DeviceIdentity:
        info = self._controller.info
        return DeviceIdentity(
            kind="stage",
            driver="grbl",
            vendor="grblHAL" if self._controller.is_hal else "GRBL",
            model=info.get("BOARD") or f"controller of {len(self._places)} axes",
            serial_number="",
            firmware=info["VER"].rstrip(":"),
            simulated=False,
        )

    def _axis(self, name: str, axis: GrblAxis) -> StageAxis:
        index = self._index(name)
        fastest = self._controller.rate_per_s(index)
        wanted = (
            fastest if axis.speed_per_s is None else abs(self._maps[name].to_controller(axis.speed_per_s))
        )
        if wanted > fastest:
            raise DeviceError(
                self.name,
                f"{name} ({self._maps[name].label}) goes at most {abs(self._maps[name].to_bench(fastest)):g} "
                f"a second (${110 + index}), not {axis.speed_per_s:g}.",
                "Lower speed_per_s in bench.toml, or raise the controller's setting.",
            )
        here = self.options.homing == "here"
        return self._maps[name].stage_axis(
            self.name,
            axis,
            ends=(-math.inf, math.inf) if here else self._controller.travel(index),
            speed_per_s=wanted,
            resolution=max(1 / self._controller.steps_per_unit(index), REPORTED_STEP),
        )

    def _acceleration_per_s2(self, name: str) -> float:
        return abs(self._maps[name].scale) * self._controller.acceleration_per_s2(self._index(name))

    def _letter(self, name: str) -> str:
        return self._maps[name].label.removeprefix("axis ")

    def _index(self, name: str) -> int:
        letters = self._controller.letters[: len(self._places)]
        index = letters.find(self._letter(name))
        if index < 0:
            raise DeviceError(
                self.name,
                f"has no {self._maps[name].label} for {name}; it has {', '.join(letters)}.",
                f"Set letter in [stage.axes.{name}].",
            )
        return index

    # Moving ----------------------------------------------------------------------------------------
    def _state(self) -> StageState:
        self._note_what_happened()
        if self._homing:
            end = self._link.ended()
            if end is None and self._link.is_open:
                return self._seen(moving=True)  # GRBL answers nothing while it homes
            self._homing = False
            code = None if end is None else parse_error(end)
            self._homed = end is not None and code is None
            if code is not None:
                self._fault = self._link.refused(b"$H", code).problem
        try:
            report = self._link.report()
        except (DeviceTimeoutError, StoppedError) as error:
            self._note_what_happened()
            if isinstance(error, DeviceTimeoutError) and not self._fault:
                raise
            # After a critical alarm it is heard again since it was reset; STOP overtook the question.
            report = self._link.report()
        self._note_what_happened()  # whatever was said before this report
        if len(report.places) != len(self._zero):
            raise DeviceError(
                self.name, f"reports {len(report.places)} axes, not {len(self._zero)}.", "Open it again."
            )
        self._locked = report.state == "Alarm"
        if self._locked and self._homed:
            self._homed, self._fault = False, self._fault or "it is in alarm"
        if self._halting:
            self._press_on(report.state)
        self._places = report.places
        moving = report.state in MOVING_STATES or (self._halting and report.state == "Hold:0")
        if not moving:
            self._planned.clear()
        return self._seen(moving=moving, unusable=_UNUSABLE.get(report.state.partition(":")[0], ""))

    def _seen(self, *, moving: bool, unusable: str = "") -> StageState:
        position = {}
        for name, axis in self._maps.items():
            index = self._index(name)
            position[name] = axis.to_bench(self._places[index] - self._zero[index])
        faults = tuple(fault for fault in (self._fault, unusable) if fault)
        return StageState(position, moving, self._homed, faults)

    def _note_what_happened(self) -> None:
        """Take note of an alarm or a reset that nobody here asked for."""
        alarm = self._link.take_alarm()
        if alarm is not None:
            self._homed = self._homing = False
            self._fault = self._link.alarm_words(alarm)
            if alarm in CRITICAL_ALARMS:
                try:
                    self._link.reset()
                except DeviceTimeoutError as error:  # an emergency stop that is still pressed
                    _log.warning("%s", error)
            self._banners = self._link.banners
        elif self._link.banners != self._banners:
            self._banners = self._link.banners
            if self._homed or self._homing:
                self._fault = (
                    "was reset (its button, its supply, another program): its position is not to be trusted"
                )
            self._homed = self._homing = False

    def _start(self, target: Mapping[str, float]) -> None:
        self._halting = False
        self.stuck_s = type(self).stuck_s
        words, way_squared, duration_s = {}, 0.0, 0.0
        for axis in self._axes:
            if axis.name not in target:
                continue
            index, axis_map = self._index(axis.name), self._maps[axis.name]
            place = axis_map.to_controller(target[axis.name]) + self._zero[index]
            way = abs(place - self._planned.get(axis.name, self._places[index]))
            way_squared += way**2
            duration_s = max(duration_s, way * abs(axis_map.scale) / axis.speed_per_s)
            words[self._letter(axis.name)] = place
            self._planned[axis.name] = place
        if duration_s > 0:
            # Along the path: the slowest axis takes this long, the others go slower for it.
            self._link.command(jog(words, 60 * math.sqrt(way_squared) / duration_s))

    def _start_homing(self) -> None:
        self._halting = False
        self._alarmed, self._fault = self._fault, ""
        if self.options.homing == "here":
            if self._locked:
                raise DeviceError(
                    self.name,
                    f"is locked by an alarm{f' ({self._alarmed})' if self._alarmed else ''}, and nothing but "
                    "unlocking ends that where it has no homing; what it knew of its position is lost then.",
                    "Look what the alarm was for and free the axes by hand; then unlock it (in the window: "
                    "Stage, Unlock; in Python: bench.stage.unlock()), and home.",
                )
            self._zero, self._homed = self._places, True
            return
        if not self._controller.homing:
            raise DeviceError(
                self.name,
                "has homing switched off ($22=0).",
                'Send $22=1 if it has switches; if not, set homing = "here" in bench.toml. '
                "Unlocking releases it after an alarm (in the window: Stage, Unlock; in Python: "
                "bench.stage.unlock()).",
            )
        self._homed = False
        self.stuck_s = self.options.homing_timeout_s
        self._link.begin(b"$H\n")
        self._homing = True

    @property
    def needs_unlocking(self) -> bool:
        """Whether an alarm holds it that homing does not end."""
        return self._locked and not self._homes_by_switches

    @property
    def _homes_by_switches(self) -> bool:
        return self.options.homing == "switches" and self._controller.homing

    def unlock(self) -> None:
        """Release the lock of an alarm (``$X``) where no homing does; the position has no reference after it.

        Raises DeviceError where the stage homes by switches, which is its way out of an alarm.
        """
        self._require()
        if self._homes_by_switches:
            raise DeviceError(self.name, "homes by its switches, which ends an alarm too.", "Home it.")
        with self._commanding:
            self._state()  # a critical alarm is ended by a reset before
            self._link.command(b"$X\n")
            self._homed, self._fault = False, "was unlocked: its position has no reference until it is homed"
            _log.warning("%s: %s", self.name, self._fault)

    def _halt(self) -> None:
        self._halting = True
        if not self._homing:
            self._link.overtake(JOG_CANCEL)
            return
        self._homed = self._homing = False
        try:
            self._link.reset()  # nothing else ends homing
        finally:
            self._link.take_alarm()  # it says that homing was interrupted
            self._banners = self._link.banners

    def _press_on(self, state: str) -> None:
        """Go on stopping what the first jog cancel did not: it may have come before the jog was read."""
        if state == "Jog":
            self._link.send_now(JOG_CANCEL)
        elif state == "Run":
            self._link.send_now(FEED_HOLD)
        elif state == "Hold:0":
            self._link.reset()  # at rest a reset loses no steps
            self._banners = self._link.banners
