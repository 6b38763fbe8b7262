"""The connection to an Illuminate array: who is there, commands and refusals."""

from __future__ import annotations

from drivers.common.serial_transport import SerialTransport
from drivers.errors import DeviceError
from drivers.illuminate.dialect import OLDEST, Dialect, dialect_of
from drivers.illuminate.protocol import (
    Version,
    parse_short,
    parse_version,
    refusal,
    reply_matcher,
    version_matcher,
)

BAUD_RATE = 115_200
_POWER_CODES = (3,)
_SHOWN_BYTES = 60
# Any byte interrupts a running sequence; firmware that throws away what came meanwhile may swallow the
# command with it, which is why ``off`` asks for a confirmation.
_DARK_AT_ONCE = b"x\n"


class Link:
    """A serial port with an Illuminate array at its other end.

    Parameters
    ----------
    port : str
    device : str
        The array as error messages name it.
    timeout_s : float
        For replies.
    """

    def __init__(self, port: str, device: str, timeout_s: float = 1.0) -> None:
        self.device = device
        self._transport = SerialTransport(
            port,
            device,
            baud_rate=BAUD_RATE,
            probe=(b"version\n", version_matcher()),
            timeout_s=timeout_s,
        )
        self._version: Version | None = None
        self._dialect: Dialect | None = None

    @property
    def is_open(self) -> bool:
        """Whether the port is open and was not lost."""
        return self._transport.is_open

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

        Raises
        ------
        DeviceError
            When nobody answers, or the firmware is one this driver does not know.
        """
        self._transport.open()
        try:
            lines = self._transport.request(b"version\n", version_matcher())
            version = parse_version(lines)
            if version is None:  # the matcher lets no other reply through
                raise DeviceError(self.device, f"answered {lines!r} when asked for its version.")
            dialect = dialect_of(version)
            if dialect is None:
                raise DeviceError(
                    self.device,
                    f"has Illuminate firmware {version}; known are {OLDEST} to 1.x, and 2.x.",
                    "Update the firmware, or write to the authors of this driver.",
                )
            self._version, self._dialect = version, dialect
            self.command(b"x")
        except BaseException:
            self._transport.close()
            raise

    def close(self) -> None:
        """Close the port."""
        self._transport.close()

    def command(self, words: bytes, timeout_s: float | None = None) -> list[bytes]:
        """Send a command (without newline) and return the lines of its reply.

        Raises
        ------
        DeviceError
            When the array refuses it, with the firmware's own words.
        """
        lines = self._transport.request(words + b"\n", reply_matcher, timeout_s)
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

        Raises
        ------
        DeviceError
            When there is no such line in the reply.
        """
        lines = self.command(words, timeout_s)
        numbers = parse_short(lines, key)
        if numbers is None:
            raise DeviceError(
                self.device, f"answered {lines!r} to {words.decode()!r}; {key}.NUMBER was expected."
            )
        return numbers

    def darken_at_once(self) -> None:
        """Send what turns the light off, ahead of everything; whoever awaits a reply gets a StoppedError."""
        self._transport.overtake(_DARK_AT_ONCE, answered=True)
