"""Elliptec modules, SMC100, ESP and ASI controllers on a pseudo-terminal, as their drivers expect them."""

from __future__ import annotations

import contextlib
import re
import threading
import time
from pathlib import Path

from tests.mocks.moving_axis import MovingAxis
from tests.mocks.pty_device import Answer, PtyDevice


def commands_of(received: bytes, known: str) -> tuple[list[bytes], bytes]:
    """Cut a stream without ends into commands."""
    found, rest = [], received
    while match := re.match(known.encode(), rest):
        found.append(match[0])
        rest = rest[match.end() :]
    return found, rest


class ElliptecBus:
    """Modules by address, which tell unasked how moves end. ``mute_when_busy``: no place during one."""

    def __init__(self, folder: Path, *, mute_when_busy: bool = False) -> None:
        self.axes = {"0": MovingAxis(0, 60 * 1024, 40_000, 700), "1": MovingAxis(0, 143_360, 90_000, 500)}
        self.about = {"0": (20, 60, 1024), "1": (14, 360, 143_360)}
        self.mute_when_busy = mute_when_busy
        self.status: dict[str, int] = {}
        self.moves = dict.fromkeys(self.axes, 0)
        self.port = PtyDevice(
            folder,
            self.answer,
            lambda got: commands_of(got, "[0-9A-F](in|gs|gp|st|ho[01]|ma[0-9A-F]{8})[\r\n]*"),
        )
        self.link = self.port.link

    def answer(self, command: bytes) -> list[Answer]:
        text = command.decode().strip()
        address, words = text[0], text[1:3]
        axis = self.axes.get(address)
        if axis is None:
            return []
        if words in ("ma", "ho"):
            return self.go(address, axis, words, text[3:])
        return [f"{address}{self.say(address, axis, words)}\r\n".encode()]

    def go(self, address: str, axis: MovingAxis, words: str, value: str) -> list[Answer]:
        if words == "ma" and int(value, 16) > axis.highest:
            return [f"{address}GS0C\r\n".encode()]
        axis.home(0) if words == "ho" else axis.go(int(value, 16))
        self.moves[address] += 1
        end = threading.Thread(target=self.end, args=(address, axis, self.moves[address]), daemon=True)
        end.start()
        return []

    def end(self, address: str, axis: MovingAxis, move: int) -> None:
        while axis.moving and self.moves[address] == move:
            time.sleep(0.001)
        if self.moves[address] == move:
            failure = self.status.pop(address, 0)
            said = f"GS{failure:02X}" if failure else f"PO{axis.place & 0xFFFFFFFF:08X}"
            with contextlib.suppress(OSError):  # unplugged meanwhile
                self.port.send(f"{address}{said}\r\n".encode())

    def say(self, address: str, axis: MovingAxis, words: str) -> str:
        moving = axis.moving
        if words == "in":
            kind, travel, pulses = self.about[address]
            return f"IN{kind:02X}1140TEST2023{'17'}{'81'}{travel:04X}{pulses:08X}"
        if words == "gs":
            return f"GS{9 if moving else self.status.pop(address, 0):02X}"
        if words == "st":
            axis.stop()
            return "GS00"
        if moving and self.mute_when_busy:
            return "GS09"
        return f"PO{axis.place & 0xFFFFFFFF:08X}"


class Smc100Chain:
    """Controllers by number; counts are 0.1 micrometres."""

    def __init__(self, folder: Path) -> None:
        self.axes = {1: MovingAxis(-10_000, 250_000, 400_000, 700), 2: MovingAxis(-100, 90_000, 400_000, 500)}
        self.states = dict.fromkeys(self.axes, 0x0A)
        self.errors = dict.fromkeys(self.axes, 0)
        self.refusal = dict.fromkeys(self.axes, "@")
        self.steppers: set[int] = set()
        """Those that are SMC100PP: they know no encoder."""
        self.port = PtyDevice(folder, self.answer)
        self.link = self.port.link

    def state(self, number: int) -> int:
        axis = self.axes[number]
        _ = axis.place
        if self.states[number] == 0x1E and not axis.homing:
            self.states[number] = 0x32
        if self.states[number] == 0x28 and not axis.moving:
            self.states[number] = 0x33
        return self.states[number]

    def answer(self, line: bytes) -> list[Answer]:
        found = re.fullmatch(r"(\d+)(FR[MS]|[A-Z]{2})(.*)", line.decode().strip())
        if found is None or int(found[1]) not in self.axes:
            return []
        number, words, value = int(found[1]), found[2], found[3]
        said = self.say(number, words, value)
        return [] if said is None else [f"{number}{words}{said}\r\n".encode()]

    def say(self, number: int, words: str, value: str) -> str | None:
        axis, state = self.axes[number], self.state(number)
        fixed = {"ID": "LTA-HS", "VE": " SMC_CC_2.0", "VA": "40", "SU": "0.0001"}
        ends = {"SL": axis.lowest, "SR": axis.highest}
        if number in self.steppers:
            del fixed["SU"]
            fixed |= {"FRM": "20", "FRS": "0.02"}
        if words in fixed:
            return fixed[words]
        if words in ends:
            return f"{ends[words] / 1e4:g}"
        match words:
            case "TS":
                return f"{self.errors[number]:04X}{state:02X}"
            case "TP":
                return f"{axis.place / 1e4:.8g}" if abs(axis.place) > 9 else f"{axis.place / 1e4:.1E}"
            case "TE":
                refused, self.refusal[number] = self.refusal[number], "@"
                return refused
            case "ST" if state != 0x0A:
                axis.stop()
            case "OR" if state == 0x0A:
                axis.home(0)
                self.states[number] = 0x1E
            case "MM" if state in (0x3C, 0x32, 0x33):
                self.states[number] = 0x34 if value == "1" else 0x3C
            case "PA" if state in (0x32, 0x33, 0x34):
                target = round(1e4 * float(value))
                if axis.lowest <= target <= axis.highest:
                    axis.go(target)
                    self.states[number] = 0x28
                else:
                    self.refusal[number] = "G"
            case _:
                self.refusal[number] = "H" if state == 0x0A else "J" if state == 0x3C else "D"
        return None


class EspController:
    """An ESP301: axis 1 in millimetres, axis 2 in degrees; counts are 0.0001 of them."""

    def __init__(self, folder: Path) -> None:
        self.axes = {1: MovingAxis(-10_000, 250_000, 400_000, 700), 2: MovingAxis(-100, 90_000, 400_000, 500)}
        self.units = {1: 2, 2: 7}
        self.powered = dict.fromkeys(self.axes, False)
        self.errors: list[tuple[int, str]] = []
        self.port = PtyDevice(folder, self.answer, lambda got: ((w := got.split(b"\r"))[:-1], w[-1]))
        self.link = self.port.link

    def answer(self, line: bytes) -> list[Answer]:
        found = re.fullmatch(r"(\d*)([A-Z]{2})(\?|[-+.\d]*)", line.decode().strip())
        if found is None:
            self.errors.append((6, "COMMAND DOES NOT EXIST"))
            return []
        said = self.say(int(found[1] or 0), found[2], found[3])
        return [] if said is None else [f"{said}\r\n".encode()]

    def say(self, number: int, words: str, value: str) -> str | None:
        if words == "VE":
            return "ESP301 Version 3.0.1 6/1/99"
        if words == "TB":
            code, text = self.errors.pop(0) if self.errors else (0, "NO ERROR DETECTED")
            return f"{code}, 451322, {text}"
        axis = self.axes.get(number)
        if axis is None:
            self.errors.append((9, "AXIS NUMBER OUT OF RANGE"))
            return None
        asked = {
            **{"SN": self.units[number], "SL": axis.lowest / 1e4, "SR": axis.highest / 1e4, "VA": 40},
            **{"SU": 0.0001, "TP": f"{axis.place / 1e4:.6f}", "MD": int(not axis.moving)},
            **{"MO": int(self.powered[number])},
        }
        if value == "?" or words == "TP":
            return str(asked[words])
        match words:
            case "ST":
                axis.stop()
            case "MO":
                self.powered[number] = True
            case _ if not self.powered[number]:
                self.errors.append((100 * number + 8, "MOTOR NOT ENABLED"))
            case "OR":
                axis.home(0)
            case "PA" if axis.lowest <= round(1e4 * float(value)) <= axis.highest:
                axis.go(round(1e4 * float(value)))
            case _:
                self.errors.append((100 * number + 5, "MAXIMUM VALUE EXCEEDED"))
        return None


class AsiController:
    """Axes X and Z, tenths of micrometres; HOME leads to the upper end."""

    def __init__(self, folder: Path) -> None:
        self.axes = {"X": MovingAxis(-50_000, 50_000, 60_000, 700), "Z": MovingAxis(-9000, 9000, 60_000, 5)}
        self.port = PtyDevice(folder, self.answer, lambda got: ((w := got.split(b"\r"))[:-1], w[-1]))
        self.link = self.port.link

    def answer(self, line: bytes) -> list[Answer]:
        return [f"{self.say(line.decode().strip())}\r\n".encode()]

    def say(self, text: str) -> str:
        if text == "/":
            return "B" if any(axis.moving for axis in self.axes.values()) else "N"
        if text == "\\":
            moved = any(axis.moving for axis in self.axes.values())
            for axis in self.axes.values():
                axis.stop()
            return ":N-21" if moved else ":A"
        if text == "V":
            return ":A Version: USB-9.53"
        found = re.fullmatch(r"(\S+) ([A-Z])(=-?\d+|\?)?", text)
        if found is None:
            return ":N-1"
        words, axis, value = found[1], self.axes.get(found[2]), found[3] or ""
        if axis is None:
            return ":N-2"
        if value == "?":
            asked = {"SL": axis.lowest / 1e4, "SU": axis.highest / 1e4, "S": axis.speed_per_s / 1e4}
            return f":A {found[2]}={asked[words]:.6f}" if words in asked else ":N-1"
        match words:
            case "W":
                return f":A {axis.place} "
            case "M":  # beyond a limit it ends there, without a word
                axis.go(max(axis.lowest, min(axis.highest, int(value[1:]))))
            case "H":  # limits are places of the hardware: their numbers change with the place's
                by = int(value[1:]) - axis.place
                axis.set_place(int(value[1:]))
                axis.lowest, axis.highest = axis.lowest + by, axis.highest + by
            case "!":
                axis.go(axis.highest)
            case _:
                return ":N-1"
        return ":A"
