"""Counting the frames that a camera lost, from its frame numbers."""

from __future__ import annotations


class FrameNumberCounter:
    """Counts by the device's own frame numbers: exact.

    Parameters
    ----------
    modulus : int, optional
        Where the numbers start again (``2**16`` for GigE Vision 1 block ids); None when they never do.
    first_after_wrap : int
        The number that follows ``modulus - 1``: 0, or 1 where 0 is reserved (GigE Vision 1).
    """

    def __init__(self, modulus: int | None = None, first_after_wrap: int = 0) -> None:
        self._modulus = modulus
        self._first = first_after_wrap
        self._previous: int | None = None

    def lost(self, number: int) -> int:
        """Return the frames lost between the frame of this number and the one asked for before."""
        previous, self._previous = self._previous, number
        if previous is None:
            return 0
        step = number - previous
        # A step back by less than half the range is no wrap: a number given twice, or frames out of order.
        if self._modulus is not None and step < -self._modulus // 2:
            step += self._modulus - min(self._first, number)  # some use 0 all the same
        if step <= 0:
            raise ValueError(f"frame number {number} came after {previous}")
        return step - 1
