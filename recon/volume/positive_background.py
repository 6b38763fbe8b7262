"""Volume and background once more where the free background came out negative (Kuo 2020, Eq. 6.2, g >= 0).

Projecting the background's frequencies out of the data term solves Eq. 6.2 without ``g >= 0``. Where the
background found that way is not negative it solves Eq. 6.2 itself. Else background and volume are improved in
turn: the non-negative background nearest to what the volume leaves of the data, then the volume for that
background. The objective falls with every turn, and both halves are feasible after each.
"""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np

from recon.operators.base import Array
from recon.solvers import Outcome, Solver, StoppingRules, StopReason
from recon.solvers.base import Callback
from recon.volume.channel import ChannelProblem

TURNS = 4
"""At most so many turns, each with a warm start."""
SLIGHT = 1.0
"""What a background may miss zero by, in noise deviations of a pixel: less is no reason for turns."""
SETTLED = 0.1
"""Change of the background in a turn that counts as the last, in noise deviations."""


def is_negative(background: Array) -> bool:
    """Whether a background (in noise deviations) is negative by more than can be overlooked."""
    return bool(background.min() < -SLIGHT)


def in_turns(
    run: ChannelProblem,
    outcome: Outcome,
    rules: StoppingRules,
    callback: Callback | None,
    cancel: threading.Event | None,
) -> tuple[Outcome, Array, Solver | None]:
    """Improve background and volume in turn; without turns where the run was ended early or memory is short.

    Parameters
    ----------
    run : ChannelProblem
        With a background; becomes one whose background is given.
    outcome : Outcome
        What was found with a free background.
    rules : StoppingRules
        For every turn; of ``time_s`` it has what is left.

    Returns
    -------
    Outcome
        The last volume, with the history of everything.
    ndarray, (height, width)
        The background, in noise deviations.
    Solver or None
        The last turn's; None where there was none.
    """
    history, seconds = list(outcome.history), outcome.seconds
    background = run.positive_background(outcome.solution)
    solver: Solver | None = None
    for _ in range(TURNS if run.has_room_for_turns else 0):
        if outcome.stop_reason not in (StopReason.CONVERGED, StopReason.ITERATIONS):
            break
        left = None if rules.time_s is None else max(rules.time_s - seconds, 1e-3)
        solver = run.with_background(background, outcome.solution)
        outcome = solver.run(replace(rules, time_s=left), callback=callback, cancel=cancel)
        for record in outcome.history:
            history.append(replace(record, iteration=len(history) + 1, seconds=seconds + record.seconds))
        seconds += outcome.seconds
        before, background = background, run.positive_background(outcome.solution)
        if float(np.abs(background - before).max()) <= SETTLED:
            break
    return Outcome(outcome.solution, tuple(history), outcome.stop_reason, seconds), background, solver
