"""Volume and background once more where the free background came out negative (Kuo 2020, Eq. 6.2, g >= 0).

Projecting the background's frequencies out of the data term solves Eq. 6.2 without ``g >= 0``. Where the
background found that way is not negative it solves Eq. 6.2 itself. Else background and volume are improved in
turn: the non-negative background nearest to what the volume leaves of the data, then the volume for that
background. The objective falls with every turn, and both halves are feasible after each. A turn starts from
zero, so that it needs no more memory than the first run did.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from recon.camera.base import Array
from recon.solvers import Outcome, Solver, StoppingRules, StopReason
from recon.solvers.base import Callback

TURNS = 3
"""At most so many turns."""
SLIGHT = 1.0
"""What a background may miss zero by, in noise deviations of a pixel: less is no reason for turns."""
SETTLED = 0.1
"""Change of the background in a turn that counts as the last, in noise deviations."""


def is_negative(background: Array) -> bool:
    """Whether a background (in noise deviations) is negative by more than can be overlooked."""
    return bool(background.min() < -SLIGHT)


def may_go_on(outcome: Outcome) -> bool:
    """Whether a run ended by itself: turns follow neither a cancelled nor a timed out run."""
    return outcome.stop_reason in (StopReason.CONVERGED, StopReason.ITERATIONS)


def in_turns(
    background: Array,
    first: Outcome,
    solver_for: Callable[[Array], Solver],
    nearest: Callable[[Array], Array],
    rules: StoppingRules,
    callback: Callback | None,
    cancel: threading.Event | None,
) -> tuple[Outcome, Array, Solver]:
    """Improve volume and background in turn.

    Parameters
    ----------
    background : ndarray, (height, width)
        The non-negative background to begin with, in noise deviations.
    first : Outcome
        The run with a free background; only its history counts, so that its volume need not be kept.
    solver_for : callable
        Returns a solver of what a background leaves of the data.
    nearest : callable
        Returns the non-negative background for a volume.
    rules : StoppingRules
        For every turn; of ``time_s`` it has what is left.

    Returns
    -------
    Outcome
        The last volume, with the history of everything.
    ndarray, (height, width)
        The background, in noise deviations.
    Solver
        The last turn's.
    """
    history, seconds = list(first.history), first.seconds
    for turn in range(TURNS):
        left = None if rules.time_s is None else max(rules.time_s - seconds, 1e-3)
        solver = solver_for(background)
        outcome = solver.run(replace(rules, time_s=left), callback=callback, cancel=cancel)
        for record in outcome.history:
            history.append(replace(record, iteration=len(history) + 1, seconds=seconds + record.seconds))
        seconds += outcome.seconds
        before, background = background, nearest(outcome.solution)
        if float(np.abs(background - before).max()) <= SETTLED or not may_go_on(outcome):
            break
        if turn + 1 < TURNS:
            del solver, outcome
    return Outcome(outcome.solution, tuple(history), outcome.stop_reason, seconds), background, solver
