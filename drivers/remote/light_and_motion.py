"""Stage, LED array and SLM on another computer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from drivers.led_array import LedArray
from drivers.remote.device import RemoteDevice, filled_in
from drivers.remote.wire import LONGEST_ARRAYS
from drivers.sequence import SequenceLimits
from drivers.slm import Slm, read_only
from drivers.stage import Stage

_HEADER_BYTES = 1 << 10
"""What an array's file begins with is shorter."""


@filled_in
class RemoteStage(RemoteDevice, Stage):
    """A stage that another computer serves."""

    kind = "stage"


@filled_in
class RemoteLedArray(RemoteDevice, LedArray):
    """An LED array that another computer serves; where its LEDs are is asked once an opening."""

    kind = "led_array"

    def open(self) -> None:
        """Have the server open the array; it is dark then."""
        if not self.is_open:
            self._places: dict[str, npt.NDArray[np.float64]] = {}
        super().open()

    @property
    def led_positions_mm(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 3)`` positions in millimetres."""
        return self._once("led_positions_mm")

    @property
    def led_na(self) -> npt.NDArray[np.float64]:
        """``(n_leds, 2)`` sines of the illumination angles."""
        return self._once("led_na")

    def _once(self, name: str) -> npt.NDArray[np.float64]:
        self._link.require()
        if name not in self._places:
            self._places[name] = self._ask(name)
        return self._places[name]


@filled_in
class RemoteSlm(RemoteDevice, Slm):
    """An SLM that another computer serves, which compares what it shows with what it was sent."""

    kind = "slm"

    def open(self) -> None:
        """Have the server open the SLM; it is blank then."""
        was_open = self.is_open
        super().open()
        if not was_open:
            self._shown: npt.NDArray[np.uint8] = self._ask("displayed")

    def display(self, levels: npt.NDArray[np.uint8]) -> None:
        """Show grey levels; the server has them confirmed when this returns."""
        self._ask("display", levels)
        self._shown = levels.copy()

    @property
    def sequence_limits(self) -> SequenceLimits | None:
        """What sequences the SLM plays, and of these what a server keeps for one."""
        limits: SequenceLimits | None = self._ask("sequence_limits")
        if limits is None:
            return None
        fits = (LONGEST_ARRAYS - _HEADER_BYTES) // int(np.prod(self.shape))
        return replace(limits, most=min(limits.most, fits))

    def arm(self, patterns: Sequence[npt.NDArray[np.uint8]], period_ms: float, output: int = 0) -> float:
        """Have the server arm a sequence; LimitError when it is longer than a server keeps, too."""
        self._check_sequence(len(patterns), period_ms, output)
        for levels in patterns:
            self._check(levels)
        made: float = self._ask("arm", patterns, period_ms, output)
        return made

    def blank(self) -> None:
        """Show all zeros."""
        self._ask("blank")
        self._shown = np.zeros_like(self._shown)

    @property
    def displayed(self) -> npt.NDArray[np.uint8]:
        """The grey levels that the server confirmed last: they are not sent back for every frame."""
        self._link.require()
        return read_only(self._shown)
