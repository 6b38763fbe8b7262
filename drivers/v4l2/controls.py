"""The controls of a video device: found with their ranges and menus, set, and read back."""

from __future__ import annotations

import errno
import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from drivers.common.camera_settings import GainScale
from drivers.errors import DeviceError, LimitError
from drivers.v4l2 import api
from drivers.v4l2.node import Node

_log = logging.getLogger(__name__)
_SETTABLE = (
    api.CTRL_TYPE_INTEGER,
    api.CTRL_TYPE_BOOLEAN,
    api.CTRL_TYPE_MENU,
    api.CTRL_TYPE_BITMASK,
    api.CTRL_TYPE_INTEGER_MENU,
    api.CTRL_TYPE_BUTTON,
)
_MOST = 2000
_ALL_BITS = 0xFFFFFFFF
_AUTOMATICS = {
    api.CID_AUTOGAIN: 0,
    api.CID_EXPOSURE_AUTO_PRIORITY: 0,  # else the frame rate follows the exposure
    api.CID_AUTO_WHITE_BALANCE: 0,
    api.CID_AUTO_N_PRESET_WHITE_BALANCE: 0,
    api.CID_AUTO_BRIGHTNESS: 0,
    api.CID_HUE_AUTO: 0,
    api.CID_FOCUS_AUTO: 0,  # a lens that moves is another calibration
}


@dataclass(frozen=True, slots=True)
class Control:
    """One control.

    Attributes
    ----------
    id : int
        The kernel's number of it.
    name : str
        Its name as ``v4l2-ctl`` writes it: ``"exposure_time_absolute"``.
    type : int
        The kernel's ``V4L2_CTRL_TYPE``.
    minimum, maximum, step, default : int
    menu : mapping
        Value to text, for menus.
    flags : int
    node : Node
        Where it is read and set.
    """

    id: int
    name: str
    type: int
    minimum: int
    maximum: int
    step: int
    default: int
    menu: Mapping[int, str]
    flags: int
    node: Node

    @property
    def readable(self) -> bool:
        """Whether it has a value to read."""
        return self.type != api.CTRL_TYPE_BUTTON and not self.flags & api.CTRL_FLAG_WRITE_ONLY

    def takes(self, value: int) -> bool:
        """Whether a value is on its menu, among its bits, or in its range."""
        if self.type == api.CTRL_TYPE_BUTTON:
            return True
        if self.type == api.CTRL_TYPE_BITMASK:
            return value >= 0 and value & ~self.maximum == 0
        return value in self.menu if self.menu else self.minimum <= value <= self.maximum

    def on_step(self, number: float) -> int:
        """Return the value on the control's steps that is nearest to a number, inside its range."""
        step = max(self.step, 1)
        value = self.minimum + round((number - self.minimum) / step) * step
        return min(max(value, self.minimum), self.maximum)

    @property
    def range_text(self) -> str:
        """What it takes, in words."""
        if self.menu:
            return ", ".join(f"{value} ({text})" for value, text in self.menu.items())
        if self.type == api.CTRL_TYPE_BUTTON:
            return "any value"
        if self.type == api.CTRL_TYPE_BITMASK:
            return f"bits of {self.maximum:#x}"
        steps = f" in steps of {self.step}" if self.step > 1 else ""
        return f"{self.minimum} to {self.maximum}{steps}"


class Controls:
    """All controls of a camera's open nodes that hold a number; read anew at each opening.

    Where several nodes have the same control the first of them counts: a driver that hands on those of its
    sensor shows them itself.
    """

    def __init__(self, nodes: Sequence[Node]) -> None:
        self._name = nodes[0].name
        self.by_name: dict[str, Control] = {}
        self.by_id: dict[int, Control] = {}
        for node in nodes:
            self._look_at(node)

    def _look_at(self, node: Node) -> None:
        last = 0
        for _ in range(_MOST):
            found = api.QueryControl(id=last | api.CTRL_FLAG_NEXT_CTRL)
            if node.attempt(api.QUERYCTRL, found) or found.id <= last:
                break
            last = found.id
            if (
                found.type in _SETTABLE
                and not found.flags & api.CTRL_FLAG_DISABLED
                and found.id not in self.by_id
            ):
                control = _control(node, found)
                self.by_id[control.id] = control
                self.by_name.setdefault(control.name, control)

    def find(self, *ids: int) -> Control | None:
        """Return the first of some controls that the device has; None when it has none of them."""
        return next((self.by_id[i] for i in ids if i in self.by_id), None)

    def named(self, name: str) -> Control:
        """Return a control by its name; LimitError when there is none of it."""
        try:
            return self.by_name[name]
        except KeyError:
            raise LimitError(
                self._name,
                f"has no control {name!r}.",
                f"It has {', '.join(sorted(self.by_name)) or 'none'}.",
            ) from None

    def settable(self) -> list[Control]:
        """Return the controls that hold a number to be read and set, but for the automatics."""
        barred = api.CTRL_FLAG_READ_ONLY | api.CTRL_FLAG_INACTIVE
        return [
            control
            for control in self.by_name.values()
            if control.readable
            and not control.flags & barred
            and control.id not in (*_AUTOMATICS, api.CID_EXPOSURE_AUTO)
        ]

    def switch_automatics_off(self) -> None:
        """Have nothing set by the camera itself; say what it did set until now.

        Raises DeviceError when its exposure cannot be set by hand.
        """
        off = dict(_AUTOMATICS)
        auto = self.find(api.CID_EXPOSURE_AUTO)
        if auto is not None:
            manual = [
                mode for mode in (api.EXPOSURE_MANUAL, api.EXPOSURE_SHUTTER_PRIORITY) if mode in auto.menu
            ]
            if not manual:
                raise DeviceError(
                    self._name,
                    f"its exposure cannot be set by hand: {auto.name} offers {auto.range_text}.",
                    "Use another camera.",
                )
            off = {api.CID_EXPOSURE_AUTO: manual[0]} | off
        switched = []
        for number, value in off.items():
            control = self.find(number)
            if control is not None and self.get(control) != value:
                self.set(control, value)
                switched.append(control.name)
        if switched:
            _log.warning(
                "%s: switched off what it set by itself (%s); what it had set stays until controls in "
                "bench.toml say otherwise.",
                self._name,
                ", ".join(switched),
            )

    def get(self, control: Control) -> int:
        """Read a control."""
        value = api.ControlValue(id=control.id)
        control.node.call(api.G_CTRL, value, f"read its control {control.name}")
        return value.value & _ALL_BITS if control.type == api.CTRL_TYPE_BITMASK else value.value

    def set(self, control: Control, value: int) -> int:
        """Set a control; returns what it reads afterwards (a button: ``value``).

        Raises LimitError: outside the control's range, or nothing on its menu; DeviceError when the driver
        refuses (read only, or inactive while an automatic is on).
        """
        if not control.takes(value):
            raise LimitError(
                self._name,
                f"control {control.name} does not take {value}.",
                f"It takes {control.range_text}.",
            )
        number = control.node.attempt(api.S_CTRL, api.ControlValue(id=control.id, value=value))
        if number == errno.ERANGE:
            raise LimitError(
                self._name, f"refuses {value} for {control.name}.", f"It takes {control.range_text}."
            )
        if number in (errno.EACCES, errno.EBUSY):
            why = "is read only" if number == errno.EACCES else "cannot be set now"
            raise DeviceError(
                self._name,
                f"control {control.name} {why}.",
                "Is an automatic on, or a sequence running?",
            )
        if number:
            control.node.call(
                api.S_CTRL, api.ControlValue(id=control.id, value=value), f"set its control {control.name}"
            )
        if not control.readable:
            return value
        now = self.get(control)
        if now != value:
            _log.warning("%s: control %s is %d, asked for %d", self._name, control.name, now, value)
        return now

    def text(self, control: Control) -> str | int:
        """Return a control's value as settings list it: menus with their text."""
        value = self.get(control)
        return f"{value} ({control.menu[value]})" if value in control.menu else value


@dataclass(frozen=True, slots=True)
class Quantity:
    """A control as what it sets: exposure in milliseconds, gain as a factor."""

    controls: Controls
    control: Control
    scale: GainScale
    """From the control's counts to the quantity."""

    def read(self) -> float:
        """Read it."""
        return self.scale.factor(self.controls.get(self.control))

    def limits(self, least: int | None = None) -> tuple[float, float]:
        """Return its limits, the lower one of ``least`` counts or more."""
        low = self.control.minimum if least is None else max(self.control.minimum, least)
        return self.scale.factor(low), self.scale.factor(self.control.maximum)

    def write(self, value: float) -> float:
        """Set it to the nearest of its steps; returns what it is afterwards."""
        self.controls.set(self.control, self.control.on_step(self.scale.number(value)))
        return self.read()


def _control(node: Node, found: api.QueryControl) -> Control:
    menu: dict[int, str] = {}
    if found.type in (api.CTRL_TYPE_MENU, api.CTRL_TYPE_INTEGER_MENU):
        for index in range(max(found.minimum, 0), min(found.maximum, _MOST) + 1):
            item = api.QueryMenu(id=found.id, index=index)
            if node.attempt(api.QUERYMENU, item) == 0:  # menus may have gaps
                number = found.type == api.CTRL_TYPE_INTEGER_MENU
                menu[index] = str(item.u.value) if number else item.u.name.decode(errors="replace")
    return Control(
        id=found.id,
        name=re.sub(r"[^a-z0-9]+", "_", found.name.decode(errors="replace").lower()).strip("_"),
        type=found.type,
        minimum=found.minimum,
        maximum=found.maximum & _ALL_BITS if found.type == api.CTRL_TYPE_BITMASK else found.maximum,
        step=found.step,
        default=found.default_value,
        menu=menu,
        flags=found.flags,
        node=node,
    )
