"""From a problem to its reconstruction."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.declare import settled
from recon.errors import InputError
from recon.reconstruction.first_look import FirstLook, look_at
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.planes import limit_of, signs_in_words, signs_of_light
from recon.reconstruction.problem import Problem
from recon.reconstruction.reduction import Reduction
from recon.reconstruction.residual import background_in_words, beyond_in_words, residual_in_words
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection import choose
from recon.reconstruction.solvers import OfferedSolver
from recon.reconstruction.weights import is_weighted
from recon.solvers import Outcome, Solver, StoppingRules, StopReason
from recon.solvers.base import Callback, IterationRecord, Keeper
from recon.solvers.douglas_rachford import DouglasRachford, EmptyPlanes

Progress = Callable[[IterationRecord, Callable[[], Float32Array]], object]
"""``on_progress(record, volume)`` after each iteration; ``volume()`` makes the present one, (n_z, height,
width[, n_channels]), of one channel where channels are solved one after the other. It may be called until
``on_progress`` returns."""

ITERATIONS = 200
"""At most so many, where neither iterations nor a time are asked for."""
TURNS = 3
"""At most so many turns."""
SLIGHT = 1.0
"""What a background may miss zero by, in noise deviations of a pixel: less is no reason for turns."""
SETTLED = 0.1
"""Change of the background in a turn that counts as the last, in noise deviations."""


def solve(
    problem: Problem,
    options: ReconstructionOptions | None = None,
    *,
    warm: Reconstruction | None = None,
    on_progress: Progress | None = None,
    cancel: threading.Event | None = None,
    keeper: Keeper | None = None,
) -> Reconstruction:
    """Solve a problem (Kuo 2020, Eqs. 3.11 and 4.2; with a background Eq. 6.2).

    Where the problem was chosen (:func:`~recon.reconstruction.selection.choose`), the result is on the
    measurement's pixels and all calibrated depths whatever was chosen. Depths that were left out are put back
    where what is left of the data shows light there, and the problem is solved again: once with them and
    their neighbours, then with all, as far as the time allows.

    Parameters
    ----------
    problem : Problem
    options : ReconstructionOptions, optional
        Other ones of when to stop, solver and device; default the problem's own.
    warm : Reconstruction, optional
        Start from this one: same calibration, same ``field``.
    on_progress : Progress, optional
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    keeper : Keeper, optional
        Keeps the solvers' state, and has them go on from what was kept of the same problem. Turns for a
        positive background are not kept: they begin anew.

    Raises InputError when the solver has no way for the problem, or it does not fit into memory.
    """
    if options is not None:
        problem = _with_options(problem, options)
    if problem.model == "auto":
        problem = choose(problem)
    if (reduction := problem.reduction) is None:
        return _solve(problem, warm, on_progress, cancel, keeper, "")
    limit, spent, rounds = problem.options.time_s, 0.0, 0
    best: tuple[Reconstruction, Problem, Reduction] | None = None
    while True:
        left = None if limit is None else limit - spent
        result = _solve(
            replace(problem, options=settled(problem.options, time_s=left)),
            None if warm is None else reduction.start(warm),
            None if on_progress is None else _shown(reduction, on_progress),
            cancel,
            keeper,
            f"auto-{reduction.choice.key}",
        )
        spent += result.seconds
        lost = StopReason.NOT_FINITE in result.stop_reasons
        cut_short = {StopReason.TIME, StopReason.CANCELLED} & set(result.stop_reasons)
        if best is None or (not lost and (not cut_short or _objective(result) < _objective(best[0]))):
            best = result, problem, reduction
        if lost:
            break
        more = reduction.with_planes(result, rounds)
        out_of_time = limit is not None and spent >= limit
        if more is None or out_of_time or StopReason.CANCELLED in result.stop_reasons:
            break
        assert more.reduction is not None
        problem, reduction, rounds = more, more.reduction, rounds + 1
    small, solved, reduction = best
    whole = reduction.back(small, solved)
    return replace(whole, seconds=spent, stop_reasons=result.stop_reasons)


def _shown(reduction: Reduction, on_progress: Progress) -> Progress:
    """Return a callback of the smaller problem's iterations."""
    return lambda record, now: on_progress(record, lambda: reduction.volume(now()))


def _objective(result: Reconstruction) -> float:
    """Return misfit and prior together, which a run with more planes can only make smaller in the end."""
    return sum(history[-1].objective for history in result.histories if history)


@dataclass(frozen=True)
class _Solved:
    """What the run of one part gave."""

    volume: Float32Array
    state: Array | None
    background: Array | None
    outcome: Outcome
    tau: float | None
    empty: EmptyPlanes
    signs: Float64Array | None
    memory: str | None
    noise_norm: float
    residual: float
    rest: Array | None
    doubts: list[str]


def _solve(
    problem: Problem,
    warm: Reconstruction | None,
    on_progress: Progress | None,
    cancel: threading.Event | None,
    keeper: Keeper | None,
    prefix: str,
) -> Reconstruction:
    offered = problem.solver
    if problem.options.tau is not None and not offered.one_step and not is_weighted(problem.prior_name):
        raise InputError(f"The prior {problem.prior_name} has no weight: leave tau out.")
    channels = parts_of(problem)
    rules = rules_of(problem, offered, len(channels))
    look = look_at(problem, cancel)
    if look is not None and rules.time_s is not None:
        rules = replace(rules, time_s=max(rules.time_s - look.seconds / len(channels), 1e-9))
    found = []
    for one in channels:
        part = Part(problem, one)
        try:
            channel = f"channel-{one.start}" if len(channels) > 1 or not problem.together else ""
            kept = keeper, "-".join(filter(None, (prefix, channel)))
            part.weigh(problem.options.tau, None if look is None else look.weight(problem.prior_name))
            found.append(_run(part, offered, rules, warm, on_progress, cancel, kept))
        finally:
            part.close()
    return _together(problem, offered, found, look)


def rules_of(problem: Problem, offered: OfferedSolver, runs: int = 1) -> StoppingRules:
    """Return when to stop one of so many runs: time is shared evenly by them.

    Raises InputError when a limit is asked for that a solver in one step does not have.
    """
    options = problem.options
    if offered.one_step:
        given = (options.iterations, options.time_s, options.tolerance, options.stop_at_noise or None)
        if given != (None, None, None, None):
            raise InputError(
                f"{offered.name} is one shot: iterations, time_s, tolerance and stop_at_noise do not apply "
                "to it."
            )
    try:
        return StoppingRules(
            iterations=ITERATIONS
            if options.iterations is None and options.time_s is None
            else options.iterations,
            time_s=None if options.time_s is None else options.time_s / runs,
            tolerance=problem.stop_tolerance,
        )
    except ValueError as error:
        raise InputError(str(error)) from error


_SETTLED = ("model", "z_um", "estimate_background", "positive_background", "precision", "field", "choose")
"""Options that a problem is made with: others than its own would be ignored."""


def _with_options(problem: Problem, options: ReconstructionOptions) -> Problem:
    """Return a problem that is solved with other options; InputError for those that it was made with."""
    reduction = problem.reduction
    made_with = problem.options if reduction is None else reduction.given.options
    changed = [name for name in _SETTLED if getattr(options, name) != getattr(made_with, name)]
    if changed and options != problem.options:
        raise InputError(
            f"{', '.join(changed)}: a problem is made with these. Make another one by "
            "Problem.of(measurement, calibration, options)."
        )
    if reduction is not None:
        own = {name: getattr(problem.options, name) for name in _SETTLED}
        given = replace(
            reduction.given, options=replace(options, **{n: getattr(made_with, n) for n in _SETTLED})
        )
        return replace(problem, options=replace(options, **own), reduction=replace(reduction, given=given))
    return replace(problem, options=options)


def _run(
    part: Part,
    offered: OfferedSolver,
    rules: StoppingRules,
    warm: Reconstruction | None,
    on_progress: Progress | None,
    cancel: threading.Event | None,
    kept: tuple[Keeper | None, str],
) -> _Solved:
    """Solve for some channels."""
    problem, options = part.problem, part.problem.options
    shape = part.camera.domain_shape
    start = None if warm is None else problem.start(warm, part.channels, (shape[2], shape[3]))
    solver = offered.make(part, start)
    if options.stop_at_noise:
        rules = replace(rules, noise_norm=part.noise_norm)
    tell: Callback | None = None
    if on_progress is not None:

        def tell(solver: Any, record: IterationRecord) -> None:
            on_progress(record, lambda: problem.measured(part.lifted(solver.solution), part.channels))

    keeper, name = kept
    outcome = solver.run(rules, callback=tell, cancel=cancel, keeper=keeper, part=name)
    smooth = part.background(part.lifted(outcome.solution)) if problem.smooth else None
    if options.positive_background and smooth is not None and smooth.min() < -SLIGHT:
        smooth = part.positive_background(part.lifted(outcome.solution))
        if may_go_on(outcome):
            first = replace(outcome, solution=np.empty(0))
            del solver, outcome

            def again(background: Array) -> Any:
                part.without(background)
                return offered.make(part, None)

            def nearest(found: Array) -> Array:
                return part.positive_background(part.lifted(found))

            outcome, smooth, solver = in_turns(smooth, first, again, nearest, rules, tell, cancel)
    solution = part.lifted(outcome.solution)
    signs = None
    if problem.extent.left_out is not None:
        rest = part.residual(solution, smooth)[0]
        channel, window = part.channels.start, problem.extent.psf_window
        signs = signs_of_light(rest, problem.extent.left_out, channel, window) / limit_of(part)
    rest = _rest(part, solution, smooth, outcome)
    residual = float("nan") if rest is None else float(np.linalg.norm(rest))
    if outcome.history:
        residual = outcome.history[-1].data_residual
    rows = problem.rows(part.channels)
    doubts = [
        *residual_in_words(problem, outcome, residual, part.noise_norm, (part.tau or 0.0, part.held)),
        *background_in_words(problem, smooth, rows),
    ]
    if problem.n_depths < problem.n_planes:
        beyond = part.from_beyond(solution)
        doubts += beyond_in_words(problem, beyond, rows)
        smooth = beyond if smooth is None else smooth + beyond
    return _Solved(
        volume=problem.measured(solution, part.channels),
        state=_state(part, solution),
        background=None if smooth is None else smooth * problem.noise[rows, None, None],
        outcome=replace(outcome, solution=np.empty(0)),
        tau=part.tau if outcome.tau is None else outcome.tau,
        empty=solver.empty if isinstance(solver, DouglasRachford) else EmptyPlanes(),
        signs=signs,
        memory=part.memory_used(),
        noise_norm=part.noise_norm,
        residual=residual,
        rest=rest,
        doubts=doubts,
    )


def _rest(part: Part, solution: Array, background: Array | None, outcome: Outcome) -> Array | None:
    """Return what a run leaves of the data, in units of the noise; None where nobody judges by it.

    A solution in one step fits whatever there is, with negative light where the model is wrong: without it.
    """
    if not part.problem.options.judged:
        return None
    return part.residual(solution if outcome.history else np.maximum(solution, 0), background)


def _state(part: Part, solution: Array) -> Array | None:
    """Return a picture's whole object in measurement units; of volumes nothing, for memory's sake."""
    problem = part.problem
    if problem.n_planes > 1 or problem.levelled[1].shape[1:] != (1, 1):
        return None
    state: Array = solution * (problem.image_scale[part.channels] / problem.levelled[1])
    return state


def _together(
    problem: Problem, offered: OfferedSolver, found: list[_Solved], look: FirstLook | None
) -> Reconstruction:
    """Return what all parts gave as one result."""
    signs = [f.signs for f in found if f.signs is not None]
    left_out = np.max(signs, axis=0).tolist() if signs else []
    taus = [f.tau for f in found if f.tau is not None]
    states = [f.state for f in found if f.state is not None]
    empty = () if problem.together else tuple(f.empty for f in found)
    memory = found[-1].memory
    return Reconstruction(
        volume=problem.whole([f.volume for f in found]),
        grid=problem.grid,
        model=problem.model,
        reason=problem.reason,
        solver=offered.name,
        prior=problem.prior_name,
        tau=max(taus, default=None),
        noise_norm=found[0].noise_norm,
        residuals=tuple(f.residual for f in found),
        histories=tuple(f.outcome.history for f in found),
        stop_reasons=tuple(f.outcome.stop_reason for f in found),
        seconds=sum(f.outcome.seconds for f in found) + (0.0 if look is None else look.seconds),
        background=_stacked([f.background for f in found if f.background is not None], problem),
        residual=_stacked([f.rest for f in found if f.rest is not None], problem),
        empty_planes=empty,
        warnings=tuple(
            dict.fromkeys(
                (
                    *problem.warnings,
                    *_uncertified(empty),
                    *signs_in_words(left_out),
                    *(w for f in found for w in f.doubts),
                )
            )
        ),
        state=np.concatenate(states) if states else None,
        provenance={
            **problem.provenance(),
            **({} if memory is None else {"memory": memory}),
            **({} if look is None else {"weight": look.in_words(problem.prior_name)}),
            **({"light_in_planes_left_out": left_out} if signs else {}),
        },
    )


def _uncertified(empty: tuple[EmptyPlanes, ...]) -> list[str]:
    return [
        f"Stopped before it was certain that {len(e.planes)} depth planes are empty: on one of them the "
        f"residual's correlation is {e.worst:.2f} tau. Let it run longer (or, in Python, drop_empty=False)."
        for e in empty
        if not e.certified
    ]


def _stacked(images: list[Array], problem: Problem) -> Float32Array | None:
    """Return channels (some, height, width) in the measurement's shape."""
    return problem.as_measured(np.concatenate(images)) if images else None


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
    """Improve volume and background in turn where the free background is negative (Kuo 2020, Eq. 6.2).

    Projecting the background's frequencies out of the data term solves Eq. 6.2 without ``g >= 0``; a
    background found that way that is not negative solves Eq. 6.2 itself. Else in turn: the non-negative
    background nearest to what the volume leaves of the data, then the volume for that background. The
    objective falls with every turn, and both halves are feasible after each. A turn starts from zero, so that
    it needs no more memory than the first run did.

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
