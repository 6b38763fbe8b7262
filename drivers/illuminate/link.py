"""The connection to an Illuminate array: who is there, how either firmware says it, refusals."""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from drivers.common.serial_transport import SerialTransport
from drivers.errors import DeviceError
from drivers.illuminate.protocol import (
    Version,
    parse_short,
    parse_version,
    refusal,
    reply_matcher,
    version_matcher,
)
from drivers.led_array import Rgb

OLDEST = Version(1, 16)
"""The first with brightness and a machine mode."""


class Told(NamedTuple):
    """A command, and the machine-mode reply ``KEY.n.n`` expected to it; an empty key is not looked at."""

    words: bytes
    key: str = ""
    echo: tuple[int, ...] = ()


class Dialect(ABC):
    """The commands that differ; a command is bytes without its newline.

    Attributes
    ----------
    properties : bytes
        The command that prints the array's properties.
    longest_line : int
        Longest command in bytes.
    most_arguments : int
        Most arguments of a command.
    """

    properties: bytes
    longest_line: int
    most_arguments: int

    @abstractmethod
    def color(self, rgb: Rgb, channels: int) -> tuple[Told, ...]:
        """Return the commands after which LEDs of so many colours light with exactly these levels."""

    def by_echo(self, rgb: Rgb, echoed: tuple[int, ...]) -> Dialect | None:
        """Return the dialect whose firmware echoes so what this one told it; None when there is none."""
        return None

    @abstractmethod
    def sequence_pattern(self, leds: Sequence[int]) -> bytes:
        """Return the command that appends a pattern to the stored sequence."""

    @abstractmethod
    def run(self, interval_ms: int, repeats: int, outputs: Sequence[int], inputs: Sequence[int]) -> bytes:
        """Return the command that runs the stored sequence with the triggers' modes."""

    prepare: tuple[bytes, ...] = ()
    """Commands that bring a freshly opened array into the state that the others need."""
    prepare_sequence: tuple[bytes, ...] = ()
    """Commands before a sequence is stored."""
    shortest_interval_ms: int = 0
    """Shortest time a pattern of a sequence is shown; zero where triggers alone may pace it."""

    def led_lists(self, leds: Sequence[int]) -> Iterator[bytes]:
        """Yield ``l`` commands for these LEDs, each within what the firmware can take."""
        words: list[bytes] = []
        length = 1
        for led in leds:
            word = b"%d" % led
            if words and (
                length + 1 + len(word) > self.longest_line - 1 or len(words) == self.most_arguments
            ):
                yield b".".join((b"l", *words))
                words, length = [], 1
            words.append(word)
            length += 1 + len(word)
        if words:
            yield b".".join((b"l", *words))


class Firmware1(Dialect):
    """Firmware 1.16 to 1.x.

    It reads a command only as far as the USB packet that has arrived (64 bytes) and forgets the rest of a
    longer one, so that long lists go in pieces. A sequence's pattern is ``COUNT.LED.VALUE.LED.VALUE``.
    """

    properties = b"pp"
    longest_line = 64
    most_arguments = 60
    # Brightness multiplies colours there; at its maximum a colour is what it says.
    prepare = (b"sb.255",)
    prepare_sequence = (b"ssbd.1",)
    shortest_interval_ms = 1

    def color(self, rgb: Rgb, channels: int) -> tuple[Told, ...]:
        """Return one command: this firmware takes colours as they are."""
        return (Told(b"sc.%d.%d.%d" % rgb, "CO", rgb),)

    def by_echo(self, rgb: Rgb, echoed: tuple[int, ...]) -> Dialect | None:
        """Return the dialect of builds that scale a colour to its largest channel, when one has done so."""
        largest = max(rgb)
        scaled = tuple((510 * level + largest) // (2 * largest) for level in rgb)  # halves rounded up
        return NormalisingFirmware1() if echoed == scaled else None

    def sequence_pattern(self, leds: Sequence[int]) -> bytes:
        """Return the count, and a value of one bit behind each LED's number."""
        if not leds:
            return b"ssz.1"
        return b".".join((b"ssv.%d" % len(leds), *(b"%d.1" % led for led in leds)))

    def run(self, interval_ms: int, repeats: int, outputs: Sequence[int], inputs: Sequence[int]) -> bytes:
        """Return outputs first, then inputs: always two places each."""
        padded = [*([*outputs, 0, 0][:2]), *([*inputs, 0, 0][:2])]
        return b".".join((b"rseq.%d.%d" % (interval_ms, repeats), *(b"%d" % mode for mode in padded)))


class NormalisingFirmware1(Firmware1):
    """Builds of firmware 1.32 that scale a colour to its largest channel, as those since 2021 do.

    An LED's level is ``ceil(color / 255 * brightness)`` once the brightness was set after the colour.
    """

    def color(self, rgb: Rgb, channels: int) -> tuple[Told, ...]:
        """Return a colour that scaling leaves alone, and the brightness that makes these levels of it."""
        largest = max(rgb)
        # The largest whose product is below the level, not at it: rounding cannot lift it to the next.
        shares = [level if largest == 255 else max(255 * level - 1, 0) // largest for level in rgb]
        red, green, blue = (
            255 if level == largest else share for level, share in zip(rgb, shares, strict=True)
        )
        color = (red, green, blue)
        return Told(b"sc.%d.%d.%d" % color, "CO", color), Told(b"sb.%d" % largest, "SB", (largest,))


SAFE_LINE = 64
"""Bytes of a line, its end included, that arrive together in one USB packet."""


class Firmware2(Dialect):
    """Firmware 2, which scales a colour to its largest channel; single channels are taken as they are.

    The parser of some builds (2.32) does not wait for a byte that has not arrived: of a line longer than a
    USB packet it may lose some, and light LED 11 for 115.

    Parameters
    ----------
    longest_line : int
        More than ``SAFE_LINE`` for builds that wait; their buffer holds 16 KiB.
    """

    properties = b"pprops"
    most_arguments = 250  # it keeps room for 300 words

    def __init__(self, longest_line: int = SAFE_LINE) -> None:
        self.longest_line = longest_line

    def color(self, rgb: Rgb, channels: int) -> tuple[Told, ...]:
        """Return one command a channel; the last echoes all."""
        commands = [b"ssc.%d.%d" % (channel, level) for channel, level in enumerate(rgb[:channels])]
        return *map(Told, commands[:-1]), Told(commands[-1], "CO", rgb[:channels])

    def sequence_pattern(self, leds: Sequence[int]) -> bytes:
        """Return the LEDs' numbers, or ``none``."""
        return b".".join((b"ssv", *(b"%d" % led for led in leds))) if leds else b"ssv.none"

    def run(self, interval_ms: int, repeats: int, outputs: Sequence[int], inputs: Sequence[int]) -> bytes:
        """Return output and input of each trigger in turn; only those that the array has."""
        words = [b"rseq.%d.%d" % (interval_ms, repeats)]
        for place in range(max(len(outputs), len(inputs))):
            output = outputs[place] if place < len(outputs) else 0
            words.append(b"%d" % output)
            words.append(b"%d" % (inputs[place] if place < len(inputs) else 0))
        return b".".join(words)


def dialect_of(version: Version, longest_line: int = SAFE_LINE) -> Dialect | None:
    """Return how to speak to a firmware; None when it is too old or newer than what is known."""
    if version < OLDEST or version.major > 2:
        return None
    return Firmware1() if version.major == 1 else Firmware2(longest_line)


_log = logging.getLogger(__name__)
BAUD_RATE = 115_200
_POWER_CODES = (3,)
_SHOWN_BYTES = 60
# Any byte interrupts a running sequence; firmware that throws away what came meanwhile may swallow the
# command with it, which is why ``off`` asks for a confirmation.
_DARK_AT_ONCE = b"x\n"


class Link(SerialTransport):
    """A serial port with an Illuminate array at its other end.

    Parameters
    ----------
    port : str
    device : str
        The array as error messages name it.
    timeout_s : float
        For replies.
    longest_line : int
        Longest line for firmware 2, bytes.
    """

    def __init__(self, port: str, device: str, timeout_s: float = 1.0, longest_line: int = SAFE_LINE) -> None:
        super().__init__(
            port,
            device,
            baud_rate=BAUD_RATE,
            probe=(b"version\n", version_matcher()),
            timeout_s=timeout_s,
        )
        self._longest_line = longest_line
        self._version: Version | None = None
        self._dialect: Dialect | None = None

    @property
    def version(self) -> Version:
        """The firmware's version."""
        assert self._version is not None, "connect first"
        return self._version

    @property
    def dialect(self) -> Dialect:
        """How the firmware is spoken to."""
        assert self._dialect is not None, "connect first"
        return self._dialect

    def connect(self) -> None:
        """Open the port, ask for the version and turn the light off.

        Raises DeviceError when nobody answers, or the firmware is one this driver does not know.
        """
        self.open()
        try:
            lines = self.request(b"version\n", version_matcher())
            version = parse_version(lines)
            if version is None:  # the matcher lets no other reply through
                raise DeviceError(self.device, f"answered {lines!r} when asked for its version.")
            dialect = dialect_of(version, self._longest_line)
            if dialect is None:
                raise DeviceError(
                    self.device,
                    f"has Illuminate firmware {version}; known are {OLDEST} to 1.x, and 2.x.",
                    "Update the firmware, or write to the authors of this driver.",
                )
            self._version, self._dialect = version, dialect
            self.command(b"x")
        except BaseException:
            self.close()
            raise

    def command(self, words: bytes, timeout_s: float | None = None) -> list[bytes]:
        """Send a command (without newline) and return the lines of its reply.

        Raises DeviceError when the array refuses it, with the firmware's own words.
        """
        lines = self.request(words + b"\n", reply_matcher, timeout_s)
        refused = refusal(lines)
        if refused is not None:
            code, text = refused
            shown = words.decode(errors="replace")
            if len(shown) > _SHOWN_BYTES:
                shown = shown[:_SHOWN_BYTES] + "..."
            raise DeviceError(
                self.device,
                f"refuses {shown!r}: {text.strip() or 'no reason given'}"
                + (f" (error {code})." if code is not None else "."),
                "Check the array's own power supply."
                if code in _POWER_CODES
                else f"Its firmware is {self._version}.",
            )
        return lines

    def setting(self, words: bytes, key: str, timeout_s: float | None = None) -> tuple[int, ...]:
        """Send a command and return the numbers of its machine-mode reply ``KEY.n.n``.

        Raises DeviceError when there is no such line in the reply.
        """
        lines = self.command(words, timeout_s)
        numbers = parse_short(lines, key)
        if numbers is None:
            raise DeviceError(
                self.device, f"answered {lines!r} to {words.decode()!r}; {key}.NUMBER was expected."
            )
        return numbers

    def set_color(self, rgb: Rgb, channels: int) -> None:
        """Have LEDs of so many colours that are lit next shine with exactly these levels, not all zero.

        A firmware that scales colours is found by what it echoes, and spoken to accordingly from then on.
        Raises DeviceError when the array has other levels than it was told.
        """
        for told in self.dialect.color(rgb, channels):
            if not told.key:
                self.command(told.words)
                continue
            echoed = self.setting(told.words, told.key)
            if echoed == told.echo:
                continue
            other = self.dialect.by_echo(rgb, echoed)
            if other is None:
                raise DeviceError(
                    self.device,
                    f"has levels {echoed} after it was told {told.echo}.",
                    "Another program may be using it; open it again.",
                )
            _log.info(
                "%s: its firmware %s scales colours to their largest channel (%s became %s); colour and "
                "brightness are sent apart.",
                self.device,
                self.version,
                rgb,
                echoed,
            )
            self._dialect = other
            self.set_color(rgb, channels)
            return

    def darken_at_once(self) -> None:
        """Send what turns the light off, ahead of everything; whoever awaits a reply gets a StoppedError."""
        self.overtake(_DARK_AT_ONCE, answered=True)
