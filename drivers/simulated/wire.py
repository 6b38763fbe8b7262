"""Trigger wires of the simulated bench: pulses from LED array and SLM to the camera, and what befalls them.

Time on a wire is counted from the beginning of a sequence and runs as a perfect clock does: a computer that
is busy with an exposure's picture makes the simulation slower, and no frame late.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drivers.camera import TriggerEdge

Show = Callable[[], object]
PULSE_S = 100e-6
LED_LINE, SLM_LINE = "Line1", "Line2"
"""The camera's inputs that the LED array's and the SLM's output are wired to."""


@dataclass(frozen=True, slots=True)
class WireFaults:
    """What befalls pulses: jitter as a standard deviation, and shares of pulses missed and added."""

    jitter_s: float
    missed: float
    extra: float


@dataclass(frozen=True, slots=True)
class Pulse:
    """One pulse that reaches the camera.

    Attributes
    ----------
    at_s : float
        When, seconds from the beginning of its sequence.
    time_ns : int
        The same by the clock of all simulated devices.
    shown : sequence of callable
        What the sequence shows, each for ``period_s`` from the beginning on; ``dark`` is before and after.
    """

    at_s: float
    time_ns: int
    shown: Sequence[Show]
    period_s: float
    dark: Show

    def during(self, exposure_s: float) -> list[tuple[float, Show]]:
        """Return what is shown during an exposure that begins with the pulse, and for which share of it."""
        first = int(self.at_s // self.period_s)
        last = int((self.at_s + exposure_s) // self.period_s)
        parts = []
        for place in range(first, last + 1):
            begin = max(self.at_s, place * self.period_s)
            end = min(self.at_s + exposure_s, (place + 1) * self.period_s)
            show = self.shown[place] if 0 <= place < len(self.shown) else self.dark
            if end > begin:
                parts.append(((end - begin) / exposure_s, show))
        return parts


Receive = Callable[[Pulse], object]


class Wires:
    """The wires between a simulated bench's LED array, SLM and camera.

    ``listen`` plugs the camera in: it is called with each pulse on its line, in the thread of what plays, and
    returns when it has seen what it needs.
    """

    def __init__(self, time_scale: float, faults: WireFaults, seed: int) -> None:
        self._time_scale = time_scale
        self._faults = faults
        self._rng = np.random.default_rng((seed, 7))
        self._listener: tuple[str, TriggerEdge, Receive] | None = None
        self._clock_ns = 0

    def listen(self, line: str, edge: TriggerEdge, receive: Receive) -> None:
        """Have pulses on a line received."""
        self._listener = (line, edge, receive)

    def deaf(self) -> None:
        """Have no pulses received."""
        self._listener = None

    def play(
        self,
        line: str,
        shown: Sequence[Show],
        dark: Show,
        *,
        period_s: float,
        settle_s: float,
        ended: threading.Event,
    ) -> bool:
        """Show one thing after the other, with a pulse on ``line`` for each; False when ``ended`` was set."""
        started_s = time.monotonic()
        self._clock_ns = max(self._clock_ns, time.monotonic_ns())
        began_ns = self._clock_ns

        def wait_until(at_s: float) -> bool:
            return not ended.wait(max(0.0, started_s + at_s * self._time_scale - time.monotonic()))

        pulses = self._pulses(len(shown), period_s, settle_s)
        for place, show in enumerate(shown):
            if not wait_until(place * period_s):
                return False
            show()
            for at_s in pulses[(pulses >= place * period_s) & (pulses < (place + 1) * period_s)]:
                listener = self._listener
                if listener is None or listener[0] != line:
                    continue
                begins_s = float(at_s) + (PULSE_S if listener[1] == "falling" else 0.0)
                if not wait_until(begins_s):
                    return False
                listener[2](Pulse(begins_s, began_ns + round(begins_s * 1e9), shown, period_s, dark))
                if ended.is_set():
                    return False
                show()
        self._clock_ns = began_ns + round(len(shown) * period_s * 1e9)
        return wait_until(len(shown) * period_s)

    def _pulses(self, count: int, period_s: float, settle_s: float) -> np.ndarray:
        """Return when pulses come, in order."""
        faults, rng = self._faults, self._rng
        at_s = np.arange(count) * period_s + settle_s
        at_s = at_s + np.abs(rng.normal(0.0, faults.jitter_s, count)) if faults.jitter_s else at_s
        at_s = at_s[rng.random(count) >= faults.missed]
        extra = rng.random(count) < faults.extra
        added = (np.flatnonzero(extra) + rng.random(int(extra.sum()))) * period_s
        return np.sort(np.concatenate([at_s, added]))
