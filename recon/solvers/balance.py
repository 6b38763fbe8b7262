"""When a splitting method may change its penalty."""

from __future__ import annotations


def is_due(iteration: int) -> bool:
    """Tell whether to balance after this iteration (counted from 0): 2, 4, 6, 8, 12, 16, 24, 32, 48, ...

    Ever more seldom: a method whose penalty changes finitely often in any stretch that grows converges, and a
    bad guess is still put right late in a long run.
    """
    if iteration in (2, 4, 6):
        return True
    while iteration > 6 and iteration % 2 == 0:
        iteration //= 2
    return iteration in (4, 6)
