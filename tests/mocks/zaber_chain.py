"""Zaber devices on a pseudo-terminal, from the ASCII Protocol Manual; Zaber's own client tests them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from tests.mocks.moving_axis import MovingAxis
from tests.mocks.pty_device import Answer, PtyDevice

SPEED_FACTOR = 1.6384
SERIOUS = ("FF", "FD", "FQ", "FS", "FE", "WL", "WT", "WS", "WM", "WR", "WH", "NC", "NI")
LONGEST = 80
_HEAD = re.compile(r"/(?:(?P<device>\d+)(?: (?P<axis>\d+)(?: (?P<number>\d+|--))?)?)? ?(?P<text>.*)")


def lrc(text: str) -> str:
    return f"{(256 - sum(text.encode()) % 256) % 256:02X}"


@dataclass
class ZaberDevice:
    """One device; positions before homing mean nothing, as with the real ones."""

    axes: list[MovingAxis]
    settings: dict[str, str] = field(default_factory=dict)
    flags: list[set[str]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.flags = [{"WR"} for _ in self.axes]
        self.settings = {
            "deviceid": "50419",
            "version": "7.14",
            "system.serial": "123456",
            "system.access": "1",
            "system.axiscount": str(len(self.axes)),
            "comm.checksum": "0",
            "comm.alert": "0",
            "resolution": "64",
        } | self.settings

    def flags_of(self, axis: int) -> set[str]:
        state, flags = self.axes[axis], self.flags[axis]
        _ = state.place
        if state.homed:
            flags -= {"WR", "WH"}
        return flags


def two_devices() -> dict[int, ZaberDevice]:
    """A device of two axes and one of one axis, numbered 1 and 2."""
    xy = ZaberDevice([MovingAxis(0, 12_000, 60_000, 700), MovingAxis(0, 12_000, 60_000, 500)])
    z = ZaberDevice([MovingAxis(-3_000, 9_000, 60_000, 100)], {"deviceid": "50081", "system.serial": "777"})
    return {1: xy, 2: z}


class ZaberChain:
    """Answers commands; ``spoil`` holds what is to be done to the next replies, first come first served."""

    def __init__(self, folder: Path, devices: dict[int, ZaberDevice] | None = None) -> None:
        self.devices = devices or two_devices()
        self.spoil: list[Callable[[bytes], list[Answer]]] = []
        self.port = PtyDevice(folder, self.answer)

    def close(self) -> None:
        self.port.unplug()

    # Faults ---
    def stall(self, device: int, axis: int) -> None:
        self.devices[device].axes[axis - 1].halt()
        self.devices[device].flags[axis - 1].add("FS")

    def alert(self, device: int, axis: int) -> None:
        self.port.send(self._signed(f"!{device:02d} {axis} IDLE --", self.devices[device]))

    # The protocol ---
    def answer(self, line: bytes) -> list[Answer]:
        text = line.decode("ascii", "replace").strip("\r")
        if len(text) > LONGEST:
            return []
        if ":" in text:
            text, _, found = text.rpartition(":")
            if lrc(text[1:]) != found:
                return []
        head = _HEAD.fullmatch(text)
        if head is None:
            return []
        asked = int(head["device"] or 0)
        numbers = sorted(self.devices) if asked == 0 else [asked] if asked in self.devices else []
        answers: list[Answer] = []
        for number in numbers:
            reply = self._reply(number, int(head["axis"] or 0), head["number"], head["text"].strip())
            answers += self.spoil.pop(0)(reply) if self.spoil else [reply]
        return answers

    def _reply(self, number: int, axis: int, message: str | None, text: str) -> bytes:
        device = self.devices[number]
        chosen = list(range(len(device.axes))) if axis == 0 else [axis - 1]
        if axis > len(device.axes):
            accepted, data, chosen = False, "BADAXIS", []
        else:
            accepted, data = self._do(device, axis, chosen, text.split())
        flags = {flag for index in chosen for flag in device.flags_of(index)}
        flag = next((flag for flag in SERIOUS if flag in flags), "--")
        busy = any(device.axes[index].moving for index in chosen)
        tag = f"{int(message):02d} " if message and message != "--" else ""
        verdict, status = "OK" if accepted else "RJ", "BUSY" if busy else "IDLE"
        return self._signed(f"@{number:02d} {axis} {tag}{verdict} {status} {flag} {data}", device)

    def _signed(self, text: str, device: ZaberDevice) -> bytes:
        if device.settings["comm.checksum"] == "1":
            text += f":{lrc(text[1:])}"
        return f"{text}\r\n".encode()

    def _do(self, device: ZaberDevice, axis: int, chosen: list[int], words: list[str]) -> tuple[bool, str]:
        axes = [device.axes[index] for index in chosen]
        match words:
            case []:
                return True, "0"
            case ["get", name]:
                return self._get(device, axes, name)
            case ["set", name, value]:
                return self._set(device, axes, name, value)
            case ["home"]:
                for index in chosen:
                    device.flags[index] -= {"FS", "NI"}
                    device.axes[index].home()
                return True, "0"
            case ["move", how, *value]:
                return self._move(device, chosen, how, value)
            case ["stop" | "estop" as how]:
                for index in chosen:
                    if device.axes[index].moving:
                        device.flags[index].add("NI")
                    device.axes[index].stop() if how == "stop" else device.axes[index].halt()
                return True, "0"
            case ["warnings", *clear] if clear in ([], ["clear"]):
                flags = sorted(
                    {flag for index in chosen for flag in device.flags_of(index)}, key=SERIOUS.index
                )
                if clear:
                    for index in chosen:
                        device.flags[index] -= {"FS", "WL", "WS", "WM", "NC", "NI"}
                return True, " ".join([f"{len(flags):02d}", *flags])
            case _:
                return False, "BADCOMMAND"

    def _get(self, device: ZaberDevice, axes: list[MovingAxis], name: str) -> tuple[bool, str]:
        of_axes: dict[str, Callable[[MovingAxis], float]] = {
            "pos": lambda axis: axis.place,
            "limit.min": lambda axis: axis.lowest,
            "limit.max": lambda axis: axis.highest,
            "maxspeed": lambda axis: round(axis.speed_per_s * SPEED_FACTOR),
        }
        if name in of_axes:
            return True, " ".join(str(of_axes[name](axis)) for axis in axes)
        if name in device.settings:
            return True, device.settings[name]
        return False, "BADCOMMAND"

    def _set(self, device: ZaberDevice, axes: list[MovingAxis], name: str, value: str) -> tuple[bool, str]:
        if name == "maxspeed":
            if not 1 <= int(value) <= 1_000_000:
                return False, "BADDATA"
            for axis in axes:
                axis.speed_per_s = int(value) / SPEED_FACTOR
        elif name in ("comm.checksum", "comm.alert"):
            device.settings[name] = value
        else:
            return False, "BADCOMMAND"
        return True, "0"

    def _move(self, device: ZaberDevice, chosen: list[int], how: str, value: list[str]) -> tuple[bool, str]:
        for index in chosen:
            axis = device.axes[index]
            target = {
                "abs": lambda: int(value[0]),
                "rel": lambda axis=axis: axis.target + int(value[0]),
                "min": lambda axis=axis: axis.lowest,
                "max": lambda axis=axis: axis.highest,
            }.get(how, lambda: None)()
            if target is None or not axis.lowest <= target <= axis.highest:
                return False, "BADDATA"
            device.flags[index] -= {"FS", "NI"}
            axis.go(target)
        return True, "0"
