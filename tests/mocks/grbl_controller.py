"""A GRBL 1.1 or grblHAL controller with its motors at the other end of a pseudo-terminal.

Written from the GRBL 1.1 wiki (Interface, Commands, Jogging, Configuration) and grblHAL's. What makes it
difficult is there: a jog cancel that comes before the jog was read is lost, GRBL answers nothing while it
homes and nothing but a reset after a limit alarm, a reset in motion loses steps, WPos needs a WCO that only
some reports carry, reports show thousandths.
"""

from __future__ import annotations

import contextlib
import math
import os
import re
import select
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tests.mocks.pty_device import Answer, PtyDevice

LETTERS = "XYZABC"
STOPPING_S = 0.02
PLANNER_BLOCKS = 15
WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d*)?)")


@dataclass
class Block:
    """A straight line that is being run: from one place to another at a speed."""

    start: list[float]
    target: list[float]
    speed_per_s: float
    began_s: float

    def __post_init__(self) -> None:
        self.way = math.dist(self.start, self.target)

    @property
    def share(self) -> float:
        if self.way == 0:
            return 1.0
        return min(1.0, self.speed_per_s * (time.monotonic() - self.began_s) / self.way)

    @property
    def place(self) -> list[float]:
        share = self.share
        return [a + share * (b - a) for a, b in zip(self.start, self.target, strict=True)]


class GrblController(PtyDevice):
    """``place`` is where the motors truly are, ``reported`` what the controller believes.

    ``fault(line, reply)`` spoils replies; ``?`` is a line of its own.
    """

    def __init__(self, folder: Path, *, axes: int = 3, hal: bool = False, travel: float = 20.0) -> None:
        self.hal = hal
        self.letters = LETTERS[:axes]
        self.settings: dict[int, float] = {
            10: 1, 13: 0, 20: 1, 21: 1, 22: 1, 23: 0, 24: 25.0, 25: 500.0, 27: 1.0,
        }  # fmt: skip
        for axis in range(axes):
            self.settings |= {100 + axis: 250.0, 110 + axis: 1200.0, 120 + axis: 10.0, 130 + axis: travel}
        self.homing_s = 0.05
        self.homing_alarm: int | None = None
        self.fault: Callable[[bytes, bytes], list[Answer]] | None = None
        self.silent = False
        self.line_delay_s = 0.0
        """How long a line lies in the buffer before it is read."""
        self.work_offset = [0.0] * axes
        self._power_on()
        super().__init__(folder, lambda _: [])

    def _power_on(self) -> None:
        self._lost = [0.0] * len(self.letters)
        self._rest = [-3.0] * len(self.letters)
        self._block: Block | None = None
        self._queue: deque[Block] = deque()
        self.state = "Alarm" if self.settings[22] else "Idle"
        self.homed = False
        self._critical = False
        self._homing_until_s: float | None = None
        self._ending: str | None = None
        self._held: Block | None = None
        self._reports = 0
        self._asked_while_homing = False
        self._relative = False
        self._feed = 0.0
        self._text = b""
        self._lines: deque[tuple[float, bytes]] = deque()

    def plug_in(self) -> None:
        self._power_on()
        super().plug_in()
        self.send(self._banner())

    def press_reset(self) -> None:
        """Power glitch: what the controller knew is gone."""
        self._power_on()
        self.send(self._banner())

    def hit_limit_switch(self) -> None:
        """Meet a limit switch: the motors stop dead, within steps of where they are."""
        self._stop_dead()
        self._raise_alarm(1, critical=True)

    @property
    def reported(self) -> list[float]:
        place = self._block.place if self._block is not None else self._rest
        return [round(p * self.settings[100 + i]) / self.settings[100 + i] for i, p in enumerate(place)]

    @property
    def place(self) -> list[float]:
        return [p + lost for p, lost in zip(self.reported, self._lost, strict=True)]

    def _banner(self) -> bytes:
        if self.hal:
            return b"\r\nGrblHAL 1.1f ['$' or '$HELP' for help]\r\n"
        return b"\r\nGrbl 1.1h ['$' for help]\r\n"

    # The firmware's loop ---------------------------------------------------------------------------
    def _run(self, master: int, stopping: threading.Event) -> None:
        while not stopping.is_set():
            ready, _, _ = select.select([master], [], [], 0.002)
            if ready:
                try:
                    self._take(os.read(master, 4096))
                except OSError:  # nobody has the other end open
                    time.sleep(0.005)
            self._advance()
            while self._lines and not self._busy() and time.monotonic() >= self._lines[0][0]:
                self._read_line(self._lines.popleft()[1])
                self._advance()

    def _busy(self) -> bool:
        return self._critical or self._homing_until_s is not None or len(self._queue) >= PLANNER_BLOCKS

    def _take(self, data: bytes) -> None:
        for byte in data:
            if byte in (0x18, 0x85, *b"?!~"):
                self.received.append(bytes([byte]))
                self._realtime(byte)
            elif byte in b"\r\n":
                # Every line is answered, the empty one too; a line feed after a carriage return is none.
                if self._text or byte == 0x0A:
                    self._lines.append((time.monotonic() + self.line_delay_s, self._text))
                self._text = b""
            elif byte < 0x80:
                self._text += bytes([byte])

    def _say(self, asked: bytes, reply: bytes) -> None:
        if self.silent:
            return
        for item in [reply] if self.fault is None else self.fault(asked, reply):
            if isinstance(item, float):
                time.sleep(item)
            elif item is not None:
                with contextlib.suppress(OSError):
                    os.write(self._master, item)

    # Real-time commands ----------------------------------------------------------------------------
    def _realtime(self, byte: int) -> None:
        self._advance()
        if byte == 0x18:
            self._reset()
        elif self._critical:
            pass
        elif byte == ord("?"):
            if self._homing_until_s is not None and not self.hal:
                self._asked_while_homing = True
            else:
                self._say(b"?", self._report())
        elif byte == 0x85 and self.state == "Jog":
            self._slow_down("cancel")
        elif byte == ord("!") and self.state in ("Jog", "Run"):
            self._slow_down("cancel" if self.state == "Jog" else "hold")
        elif byte == ord("~") and self.state == "Hold:0" and self._held is not None:
            self._block, self._held, self.state = self._held, None, "Run"
            self._block.began_s = time.monotonic()

    def _reset(self) -> None:
        homing, moving = self._homing_until_s is not None, self._block is not None
        self._homing_until_s, self._critical, self._held = None, False, None
        self._lines.clear()
        self._text = b""
        self._asked_while_homing = False
        if moving:
            self._stop_dead()
            self._lost[0] += 0.05
        if homing or moving:
            self._raise_alarm(6 if homing else 3)
        elif self.state != "Alarm":
            self.state = "Idle"
        self._reports = 0
        self._say(b"reset", self._banner())
        if self.state == "Alarm":
            self._say(b"reset", b"[MSG:'$H'|'$X' to unlock]\r\n")

    def _raise_alarm(self, code: int, *, critical: bool = False) -> None:
        self.state, self.homed, self._critical = "Alarm", False, critical
        self._say(b"alarm", b"ALARM:%d\r\n" % code)
        if critical:
            self._say(b"alarm", b"[MSG:Reset to continue]\r\n")

    def _report(self) -> bytes:
        self._reports += 1
        state = {"Hold:0": "Hold:0", "Hold:1": "Hold:1"}.get(self.state, self.state)
        if self._homing_until_s is not None:
            state = "Home"
        places = self.reported
        key = "MPos" if int(self.settings[10]) & 1 else "WPos"
        if key == "WPos":
            places = [p - o for p, o in zip(places, self.work_offset, strict=True)]
        text = f"<{state}|{key}:{','.join(f'{p:.3f}' for p in places)}|Bf:15,128|FS:0,0"
        if self._reports % 10 == 1:
            text += f"|WCO:{','.join(f'{o:.3f}' for o in self.work_offset)}"
        elif self._reports % 10 == 2:
            text += "|Ov:100,100,100"
        if self.hal and self._reports == 1:
            text += f"|H:{self.homed:d}|MPG:0"
        return f"{text}>\r\n".encode()

    # Motion ----------------------------------------------------------------------------------------
    def _advance(self) -> None:
        now_s = time.monotonic()
        if self._homing_until_s is not None and now_s >= self._homing_until_s:
            self._end_homing()
        while self._block is not None and self._block.share >= 1.0:
            self._rest = self._block.target
            ended, self._block = self._block, None
            if self._ending == "hold":
                self.state, self._ending = "Hold:0", None
            elif self._ending == "cancel":
                self._ending = None
                self._queue.clear()
                self.state = "Idle"
            elif self._queue:
                self._block = self._queue.popleft()
                self._block.began_s = ended.began_s + ended.way / ended.speed_per_s
            else:
                self.state = "Idle"

    def _slow_down(self, how: str) -> None:
        block = self._block
        if block is None or self._ending is not None:
            return
        here = block.place
        left = math.dist(here, block.target)
        share = min(1.0, block.speed_per_s * STOPPING_S / 2 / left) if left else 1.0
        end = [a + share * (b - a) for a, b in zip(here, block.target, strict=True)]
        if how == "hold":
            self._held = Block(end, block.target, block.speed_per_s, 0.0)
            self.state = "Hold:1"
        self._ending = how
        self._block = Block(here, end, max(block.speed_per_s / 2, 1e-9), time.monotonic())

    def _stop_dead(self) -> None:
        self._rest = self.reported
        self._block, self._ending, self._held = None, None, None
        self._queue.clear()

    def _move(self, target: list[float], feed: float, state: str) -> None:
        start = self._queue[-1].target if self._queue else self._block.target if self._block else self._rest
        way = math.dist(start, target)
        if way == 0:
            return
        speed = feed / 60
        for axis, (a, b) in enumerate(zip(start, target, strict=True)):
            if a != b:
                speed = min(speed, self.settings[110 + axis] / 60 * way / abs(b - a))
        block = Block(list(start), target, speed, time.monotonic())
        if self._block is None:
            self._block, self.state = block, state
        else:
            self._queue.append(block)

    def _end_homing(self) -> None:
        self._homing_until_s = None
        if self.homing_alarm is not None:
            self._raise_alarm(self.homing_alarm)
            return
        for axis in range(len(self.letters)):
            negative = int(self.settings[23]) >> axis & 1
            pull, travel = self.settings[27], self.settings[130 + axis]
            if self.hal and int(self.settings[22]) & 8:
                self._rest[axis] = 0.0
            else:
                self._rest[axis] = pull - travel if negative else -pull
        self._lost = [0.0] * len(self.letters)
        self.state, self.homed = "Idle", True
        self._say(b"$H", b"ok\r\n")
        if self._asked_while_homing:
            self._asked_while_homing = False
            self._say(b"?", self._report())

    def _beyond_travel(self, target: list[float]) -> bool:
        if not self.settings[20] or (self.hal and not self.homed):
            return False
        for axis, place in enumerate(target):
            travel, upwards = self.settings[130 + axis], False
            if self.hal and int(self.settings[22]) & 8:
                upwards = bool(int(self.settings[23]) >> axis & 1)
            low, high = (0.0, travel) if upwards else (-travel, 0.0)
            if not low <= place <= high:
                return True
        return False

    # Lines -----------------------------------------------------------------------------------------
    def _read_line(self, line: bytes) -> None:
        self.received.append(line)
        text = line.decode(errors="replace").upper().replace(" ", "")
        code = self._execute(text)
        if code is not None:
            self._say(line, b"ok\r\n" if code == 0 else b"error:%d\r\n" % code)

    def _execute(self, text: str) -> int | None:
        """Return 0 for ok, an error's code, or None when the answer comes later."""
        if text.startswith("$J="):
            return self._jog(text[3:])
        if text.startswith("$"):
            return self._system(text)
        return self._g_code(text)

    def _system(self, text: str) -> int | None:
        if text == "$G":
            self._say(b"$G", b"[GC:G0 G54 G17 G21 G90 G94 M5 M9 T0 F0 S0]\r\n")
            return 0
        if text == "$X":
            if self.state == "Alarm":
                self._say(b"$X", b"[MSG:Caution: Unlocked]\r\n")
                self.state = "Idle"
            return 0
        if text in ("$$", "$I", "$H", "$#") and self.state not in ("Idle", "Alarm"):
            return 8
        if text == "$$":
            lines = [f"${number}={value:.3f}" for number, value in sorted(self.settings.items())]
            if self.hal:
                lines.append("$300=grblHAL")
            self._say(b"$$", "".join(f"{line}\r\n" for line in lines).encode())
            return 0
        if text == "$I":
            self._say(b"$I", self._info())
            return 0
        if text == "$H":
            if not int(self.settings[22]) & 1:
                return 5
            self._homing_until_s = time.monotonic() + self.homing_s
            return None
        return 0 if text in ("$#", "$N", "$") else 3

    def _info(self) -> bytes:
        if not self.hal:
            return b"[VER:1.1h.20190825:]\r\n[OPT:V,15,128]\r\n"
        n = len(self.letters)
        return (
            f"[VER:1.1f.20240101:]\r\n[OPT:VNMSL,35,1024,{n},0]\r\n[AXS:{n}:{self.letters}]\r\n"
            "[FIRMWARE:grblHAL]\r\n[DRIVER:Simulator]\r\n[BOARD:Bench board]\r\n"
        ).encode()

    def _jog(self, text: str) -> int:
        if self.state not in ("Idle", "Jog"):
            return 9 if self.state == "Alarm" else 8
        words = WORD.findall(text)
        if "".join(a + b for a, b in words) != text:
            return 2
        target = list(
            self._queue[-1].target if self._queue else self._block.target if self._block else self._rest
        )
        feed, named = 0.0, False
        relative = "G91" in text
        for letter, number in words:
            if letter == "F":
                feed = float(number)
            elif letter in self.letters:
                axis, named = self.letters.index(letter), True
                target[axis] = float(number) + (target[axis] if relative else 0.0)
            elif letter != "G":
                return 20 if letter in LETTERS else 16
        if not named:
            return 26
        if feed <= 0:
            return 22
        if self._beyond_travel(target):
            return 15
        self._move(target, feed, "Jog")
        return 0

    def _g_code(self, text: str) -> int:
        if self.state in ("Alarm", "Jog"):
            return 9
        words = WORD.findall(text)
        target = list(
            self._queue[-1].target if self._queue else self._block.target if self._block else self._rest
        )
        motion = False
        for letter, number in words:
            if letter == "G" and number in ("90", "91"):
                self._relative = number == "91"
            elif letter == "F":
                self._feed = float(number)
            elif letter in self.letters:
                axis, motion = self.letters.index(letter), True
                target[axis] = float(number) + (target[axis] if self._relative else 0.0)
        if motion:
            if self._beyond_travel(target):
                self._stop_dead()
                self._raise_alarm(2, critical=True)
                return 0
            self._move(target, 1e6 if "G0" in text else self._feed or 100.0, "Run")
        return 0
