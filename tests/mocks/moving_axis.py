"""An axis that moves at a constant speed, for emulators of motion controllers."""

from __future__ import annotations

import time


class MovingAxis:
    """Counts in its controller's units; ``place`` is where it is now."""

    def __init__(
        self, lowest: int, highest: int, speed_per_s: float, place: int = 0, stopping_s: float = 0.01
    ):
        self.lowest, self.highest = lowest, highest
        self.speed_per_s = speed_per_s
        self.stopping_s = stopping_s
        self.homed = False
        self.homing = False
        self.blocked = False
        self._from = self._to = float(place)
        self._began_s = time.monotonic()

    @property
    def target(self) -> int:
        return round(self._to)

    @property
    def place(self) -> int:
        way = self._to - self._from
        reach = 0.0 if self.blocked else self.speed_per_s * (time.monotonic() - self._began_s)
        if reach >= abs(way):
            if self.homing:
                self.homing, self.homed = False, True
            return round(self._to)
        return round(self._from + (reach if way > 0 else -reach))

    @property
    def moving(self) -> bool:
        return self.place != self.target

    @property
    def forward(self) -> bool:
        return self._to > self._from

    def go(self, target: int) -> None:
        place = self.place
        self.homing = False
        self._from, self._to, self._began_s = float(place), float(target), time.monotonic()

    def home(self, at: int = 0) -> None:
        self.go(at)
        self.homed, self.homing = False, True

    def stop(self) -> None:
        """Slow down: a little way further, never beyond the target."""
        place, target = self.place, self.target
        way = min(abs(target - place), round(self.speed_per_s * self.stopping_s))
        self.go(place + way if target > place else place - way)

    def halt(self) -> None:
        self.go(self.place)

    def set_place(self, place: int) -> None:
        self.go(place)
        self._from = float(place)
