"""An LED array with Illuminate firmware at the other end of a pseudo-terminal.

Written from the firmware's command list and README; it has the firmware's traps on purpose: errors without a
terminator (2.x), a command longer than a USB packet lost and what came during a command thrown away (1.x), no
bounds check (``corrupted`` lists what was written beyond the LEDs), single-digit ``na``, commas missing in
its JSON, colours scaled to their largest channel (2.x, and 1.32 as built since 2021), and a byte lost
wherever a line goes on in another USB packet (2.x).
"""

from __future__ import annotations

import contextlib
import math
import os
import select
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tests.mocks.pty_device import Answer, PtyDevice

PACKET_BYTES = 64
ERRORS = {
    2: "Wrong number of arguments.",
    3: "(LedArray::sourceConnected): Source Disconnected",
    8: "Invalid argument.",
    10: "Invalid argument range.",
    11: "Triggering not configured.",
    13: "Sequence period was shorter than LED update rate.",
    14: "Trigger timeout.",
    15: "Command interrupted.",
    16: "Invalid command.",
    19: "Sequence is full.",
}


class RefusedError(Exception):
    """A command is answered by an error."""


class IlluminateEmulator(PtyDevice):
    """``lit`` is what shines: ``(n_leds, 3)`` levels. ``fault(command, reply)`` spoils what is sent."""

    def __init__(
        self,
        folder: Path,
        version: str = "2.32",
        *,
        n_leds: int = 257,
        channels: int = 3,
        lines: int = 2,
        normalises: bool = False,
        waits: bool = False,
    ) -> None:
        self.version = version
        self.old = version.startswith("1.")
        self.normalises = normalises or not self.old
        self.waits = waits
        """Whether firmware 2 waits for a line's next packet."""
        self.channels, self.lines = channels, lines
        self.places_mm = round_array(n_leds)
        self.fault: Callable[[bytes, bytes], list[Answer]] | None = None
        self.silent = False
        self.pulses = [0] * lines
        self.input_levels = [False] * lines
        self.shown: list[tuple[int, ...]] = []
        """LEDs of each pattern that a sequence showed."""
        self._in = bytearray()
        self._power_on()
        super().__init__(folder, lambda _: [])

    def _power_on(self) -> None:
        self.lit = np.zeros((len(self.places_mm), self.channels), np.uint8)
        self.corrupted: list[int] = []
        self.human, self.auto_clear = True, True
        self.color, self.brightness = [8] * self.channels, 255
        self.value = [8] * self.channels
        self.na, self.distance_mm = 0.25, 60.0
        self.sequence: list[tuple[int, ...]] = []
        self.sequence_length, self.bit_depth = 0, 8
        self.widths_us, self.delays_us = [1000] * self.lines, [0] * self.lines
        self._in.clear()

    def plug_in(self) -> None:
        self._power_on()
        super().plug_in()

    # The firmware's loop ---------------------------------------------------------------------------
    def _run(self, master: int, stopping: threading.Event) -> None:
        while not stopping.is_set():
            if not self._available(master, 0.02):
                continue
            if self.silent:
                self._in.clear()
            elif self.old:
                self._old_command(master, stopping)
            else:
                self._new_command(master, stopping)

    def _available(self, master: int, wait_s: float = 0.0) -> bool:
        ready, _, _ = select.select([master], [], [], wait_s)
        if ready:
            try:
                self._in += os.read(master, 4096)
            except OSError:  # nobody has the other end open
                time.sleep(0.005)
        return bool(self._in)

    def _new_command(self, master: int, stopping: threading.Event) -> None:
        while (
            end := min((i for i in (self._in.find(b"\n"), self._in.find(b"\r")) if i >= 0), default=-1)
        ) < 0:
            if stopping.is_set():
                return
            self._available(master, 0.02)
        line = bytes(self._in[:end])
        del self._in[: end + 1]
        if not line:
            return
        self.received.append(line)
        if not self.waits:
            line = b"".join(
                line[at + bool(at) : at + PACKET_BYTES] for at in range(0, len(line) + 1, PACKET_BYTES)
            )
        words = [word for word in line.decode(errors="replace").split(".") if word]
        try:
            reply = self._execute(words, master, stopping) + b"-==-\n"
        except RefusedError as error:
            code = int(str(error))
            reply = b"ERROR[%d]: %s\n" % (code, ERRORS[code].encode())
        self._send_reply(master, line, reply)

    def _old_command(self, master: int, stopping: threading.Event) -> None:
        packet = bytes(self._in[:PACKET_BYTES])
        if b"\n" not in packet:
            if len(packet) == PACKET_BYTES:
                del self._in[:PACKET_BYTES]  # the command so far is forgotten
            else:
                self._available(master, 0.02)
            return
        line = packet.split(b"\n")[0]
        del self._in[: len(line) + 1]
        self.received.append(line)
        words = line.decode(errors="replace").split(".")
        try:
            reply = self._execute(words, master, stopping)
        except RefusedError as error:
            text = f"Command [{words[0]}] is not implemented yet."
            reply = (
                text if str(error) == "16" else f"ERROR (LedArray): {ERRORS[int(str(error))]}\n"
            ).encode()
        self._available(master)
        self._in.clear()  # what came meanwhile is thrown away
        self._send_reply(master, line, reply + b"-==-\n")

    def _send_reply(self, master: int, line: bytes, reply: bytes) -> None:
        for item in [reply] if self.fault is None else self.fault(line, reply):
            if isinstance(item, float):
                time.sleep(item)
            elif item is not None:
                self._write(master, item)

    def _write(self, master: int, data: bytes) -> None:
        with contextlib.suppress(OSError):
            while data:
                data = data[os.write(master, data) :]

    # Commands --------------------------------------------------------------------------------------
    def _execute(self, words: list[str], master: int, stopping: threading.Event) -> bytes:
        name, *rest = words or [""]
        if name == ("pp" if self.old else "pprops"):
            return self._properties()
        if name in ("rseq",):
            return self._run_sequence(rest, master, stopping)
        if name == ("ssc" if not self.old else "ssbd"):
            return self._set_single_color(rest) if name == "ssc" else self._set_bit_depth(rest)
        commands: dict[str, Callable[[list[str]], bytes]] = {
            "version": lambda _: f"{self.version}\n".encode(),
            "machine": self._set_machine,
            "x": self._clear,
            "ac": self._set_auto_clear,
            "na": self._set_na,
            "sb": self._set_brightness,
            "sc": self._set_color,
            "l": self._draw,
            "pledpos": lambda _: self._positions(cosines=False),
            "pledposna": lambda _: self._positions(cosines=True),
            "ssl": self._set_length,
            "ssv": self._append_pattern,
            "tr": self._pulse,
            "trs": self._set_trigger,
        }
        if self.old:
            commands["setMaxCurrent"] = lambda _: b""
            commands["ssz"] = lambda rest: self._append([()] * int(rest[0]))
        if name not in commands:
            raise RefusedError(16)
        return commands[name](rest)

    def _say(self, short: str, long: str) -> bytes:
        return f"{long if self.human else short}\n".encode()

    def _set_machine(self, _: list[str]) -> bytes:
        self.human = False
        return b""

    def _clear(self, _: list[str]) -> bytes:
        self.lit[:] = 0
        return b""

    def _set_auto_clear(self, rest: list[str]) -> bytes:
        self.auto_clear = bool(int(rest[0])) if rest else not self.auto_clear
        return self._say(f"AC.{self.auto_clear:d}", f"Auto clear is {self.auto_clear}.")

    def _set_na(self, rest: list[str]) -> bytes:
        if rest:
            na = int(rest[0]) / 100 * (10 if len(rest[0]) == 1 else 1)
            if not 0 < na <= 1:
                raise RefusedError(10)
            self.na = na
        return self._say(f"NA.{round(self.na * 100):02d}", f"Current NA is {self.na:.2f}.")

    def _set_brightness(self, rest: list[str]) -> bytes:
        if rest:
            self.brightness = 255 if rest[0] == "max" else int(rest[0]) % 256
        self.value = [
            math.ceil(np.float32(color) / np.float32(255) * self.brightness) for color in self.color
        ]
        return self._say(f"SB.{self.brightness}", f"Current brightness value is {self.brightness}.")

    def _set_color(self, rest: list[str]) -> bytes:
        if self.channels == 1 or len(rest) not in (0, 3):
            raise RefusedError(8)
        if rest:
            self.color = [int(word) % 256 for word in rest]
        if self.normalises:
            largest = max(self.color) or 1
            self.color = [math.floor(255 * color / largest + 0.5) for color in self.color]
        self.value = [int(np.float32(color) / np.float32(255) * self.brightness) for color in self.color]
        numbers = ".".join(map(str, self.color))
        return self._say(f"CO.{numbers}", f"Current color value is {numbers}")

    def _set_single_color(self, rest: list[str]) -> bytes:
        if len(rest) not in (0, 2):
            raise RefusedError(2)
        if rest:
            if int(rest[0]) >= self.channels:
                raise RefusedError(10)
            self.value[int(rest[0])] = int(rest[1]) % 256
        numbers = ".".join(map(str, self.value))
        return self._say(f"CO.{numbers}", f"Current color balance values are {numbers}")

    def _light(self, led: int) -> None:
        if led < len(self.lit):
            self.lit[led] = self.value
        else:
            self.corrupted.append(led)

    def _draw(self, rest: list[str]) -> bytes:
        if self.auto_clear:
            self.lit[:] = 0
        for word in rest:
            self._light(int(word))
        return b""

    # What it says of itself ------------------------------------------------------------------------
    def _properties(self) -> bytes:
        names, waves = ["r", "g", "b"][: self.channels], [0.625, 0.525, 0.48][: self.channels]
        quoted = ", ".join(f'"{name}"' for name in names)
        colors = ", ".join(f'"{name}" : {wave:.3f}' for name, wave in zip(names, waves, strict=True))
        text = f"""{{
    "device_name" : "sci-round",
    "led_count" : {len(self.lit)},
    "color_channels" : [{quoted}],
    "color_channel_center_wavelengths" : {{{colors}}},
    "trigger_input_count" : {self.lines},
    "trigger_output_count" : {self.lines},
    "bit_depth" : 8,
    "serial_number" : 12,
    "color_channel_count" : {self.channels},
    "part_number" : 7,
    "mac_address" : "04:e9:e5:04:17:29",
    "interface_version" : {self.version}
}}"""
        return text.encode()  # no newline: the terminator follows on the brace's line

    def _positions(self, *, cosines: bool) -> bytes:
        places = self.places_mm + np.array([0.0, 0.0, self.distance_mm])
        rows = []
        for led, place in enumerate(places):
            x, y = place[:2] / np.sqrt((place**2).sum())
            text = f"{x:.3f}, {y:.3f}" if cosines else ", ".join(f"{side:.2f}" for side in place)
            rows.append(f'        "{led}" : [{text}]')
        key = "led_position_list_na" if cosines else "led_position_list_cartesian"
        colon = "=" if self.old and cosines else ":"
        body = ",\n".join(rows)
        return f'{{\n    "{key}" {colon} {{\n{body}\n    }}\n}}'.encode()

    # Sequences and triggers ------------------------------------------------------------------------
    def _set_length(self, rest: list[str]) -> bytes:
        if len(rest) != 1:
            raise RefusedError(2)
        self.sequence, self.sequence_length = [], int(rest[0])
        return self._say(f"SEQ_LEN.{rest[0]}", f"New sequence length is: {rest[0]}")

    def _set_bit_depth(self, rest: list[str]) -> bytes:
        self.bit_depth = int(rest[0])
        return self._say(f"BD.{self.bit_depth}", f"Sequence bit depth is now: {self.bit_depth}.")

    def _append_pattern(self, rest: list[str]) -> bytes:
        if self.old:
            count, numbers = int(rest[0]), [int(word) for word in rest[1:]]
            if len(numbers) != 2 * count or self.bit_depth != 1:
                raise RefusedError(2)
            return self._append([tuple(numbers[::2])])
        if not rest:
            raise RefusedError(2)
        return self._append([() if rest[0] == "none" else tuple(map(int, rest))])

    def _append(self, patterns: list[tuple[int, ...]]) -> bytes:
        if len(self.sequence) + len(patterns) > self.sequence_length:
            raise RefusedError(19)
        self.sequence += patterns
        return b""

    def _run_sequence(self, rest: list[str], master: int, stopping: threading.Event) -> bytes:
        interval_ms, repeats, *modes = (int(word) for word in rest)
        modes += [0] * (4 - len(modes))
        outputs, inputs = (modes[:2], modes[2:]) if self.old else (modes[::2], modes[1::2])
        if (self.old or interval_ms) and interval_ms < 2:
            raise RefusedError(13)
        if not self.old:
            self._write(master, self._say("RSEQ.START", "Starting Sequence!"))
        self._in.clear()
        for _ in range(repeats):
            for place, leds in enumerate(self.sequence):
                if self._available(master) or stopping.is_set():
                    return self._interrupted()
                self.lit[:] = 0
                for led in leds:
                    self._light(led)
                self.shown.append(leds)
                for line in range(self.lines):
                    if outputs[line] and place % outputs[line] == 0:
                        self.pulses[line] += 1
                    if inputs[line] and place % inputs[line] == 0:
                        self._await_trigger(line, master, stopping)
                time.sleep(interval_ms / 1e3)
        self.lit[:] = 0
        return b"Finished sending sequence.\n"

    def _interrupted(self) -> bytes:
        if self.old:
            return b""  # and the last pattern goes on shining
        self.lit[:] = 0
        raise RefusedError(15)

    def _await_trigger(self, line: int, master: int, stopping: threading.Event) -> None:
        while not self.input_levels[line]:
            if self._available(master, 0.005) or stopping.is_set():
                self._in.clear()  # swallowed, a command for darkness too
                self.lit[:] = 0
                self._write(master, b"WARNING (LedArray::wait_for_trigger_state): Cancelling\n")
                raise RefusedError(14)

    def _pulse(self, rest: list[str]) -> bytes:
        line = int(rest[0]) if rest else 0
        if line >= self.lines:
            raise RefusedError(8)
        self.pulses[line] += 1
        return b""

    def _set_trigger(self, rest: list[str]) -> bytes:
        if len(rest) == 3:
            line, width, delay = map(int, rest)
            self.widths_us[line], self.delays_us[line] = width, delay
            return b""
        if rest:
            raise RefusedError(2)
        outputs = "\n".join(  # the comma between them is forgotten
            f'        {{"channel": {line}, "pin": {20 + line}, "pulse_width_us": {self.widths_us[line]}, '
            f'"start_delay_us": {self.delays_us[line]}}}'
            for line in range(self.lines)
        )
        return f'{{\n    "input": [\n    ],\n    "output": [\n{outputs}\n    ]\n}}\n'.encode()


def round_array(count: int, pitch_mm: float = 4.0) -> np.ndarray:
    """The ``count`` places of a square grid nearest to its middle, from the middle outwards."""
    reach = math.ceil(math.sqrt(count))
    side = np.arange(-reach, reach + 1)
    y, x = (axis.ravel() for axis in np.meshgrid(side, side, indexing="ij"))
    order = np.lexsort((np.arctan2(y, x), x**2 + y**2))[:count]
    return np.stack([x[order] * pitch_mm, y[order] * pitch_mm, np.zeros(count)], axis=1)
