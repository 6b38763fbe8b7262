"""What LED arrays and SLMs can do by themselves: one pattern after the other, with a pulse for each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from drivers.device import Device
from drivers.errors import DeviceError, LimitError

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class SequenceLimits:
    """What sequences a device plays.

    Attributes
    ----------
    most : int
        Patterns in one sequence.
    shortest_ms : float
        Shortest time from one pattern to the next.
    outputs : int
        Lines that a pulse can leave on, counted from 0.
    settle_ms : float
        From the change of the pattern to its pulse, which is sent when the pattern has settled.
    """

    most: int
    shortest_ms: float
    outputs: int
    settle_ms: float = 0.0


class PlaysSequences(Device, Generic[T]):
    """A device that may play a sequence of its patterns, timed by itself.

    A device without overrides plays none: ``sequence_limits`` is None.
    """

    @property
    def sequence_limits(self) -> SequenceLimits | None:
        """What sequences it plays; None: none, or none that sends pulses."""
        return None

    def arm(self, patterns: Sequence[T], period_ms: float, output: int = 0) -> float:
        """Store a sequence; nothing is shown yet.

        Parameters
        ----------
        patterns : sequence
            What the device shows, in order.
        period_ms : float
            From one pattern to the next, milliseconds.
        output : int
            The line that sends a pulse as each pattern begins.

        Returns
        -------
        float
            The period that the device made of it, never shorter.

        Raises LimitError when the device cannot play it; nothing was changed.
        """
        raise LimitError(self.name, "plays no sequences.", "Show its patterns one by one.")

    def play(self) -> None:
        """Show the armed sequence once; returns when it has ended and the device is dark (an SLM: as before).

        Raises StoppedError when ``off`` (of an SLM: ``blank``) ended it; DeviceError when nothing is armed.
        """
        raise DeviceError(self.name, "has no sequence to play.", "Arm one first.")

    def _check_sequence(self, count: int, period_ms: float, output: int) -> None:
        """Refuse a sequence beyond the limits, for drivers."""
        limits = self.sequence_limits
        if limits is None:
            raise LimitError(self.name, "plays no sequences.", "Show its patterns one by one.")
        if not 1 <= count <= limits.most:
            raise LimitError(self.name, f"plays 1 to {limits.most} patterns, not {count}.", "Split them.")
        if not period_ms >= limits.shortest_ms:
            raise LimitError(
                self.name,
                f"cannot change patterns every {period_ms:g} ms.",
                f"It needs {limits.shortest_ms:g} ms or more.",
            )
        if not 0 <= output < limits.outputs:
            raise LimitError(
                self.name, f"has no trigger output {output}.", f"It has {limits.outputs}, counted from 0."
            )
