"""The one door, from a measurement and a calibration to a picture or volume, and what it is worth."""

from __future__ import annotations

import functools
import threading
from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.base.checks import require_photograph
from recon.base.declare import with_overrides
from recon.base.threads import linear_algebra_on_one_thread
from recon.base.unseen import seen_window
from recon.camera.camera_model import CAMERAS
from recon.errors import InputError
from recon.priors import PRIORS
from recon.reconstruction.course import Course
from recon.reconstruction.decoys import check_calibration
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.part import Part, parts_of
from recon.reconstruction.pilot import HELD_OUT
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.psf_refinement import refined
from recon.reconstruction.residual import is_below_zero
from recon.reconstruction.result import Reconstruction, window_of
from recon.reconstruction.selection import choose
from recon.reconstruction.solve import Progress, rules_of, solve
from recon.reconstruction.solvers import SOLVERS
from recon.reconstruction.uncertainty import refused, uncertain
from recon.solvers.base import IterationRecord, Keeper
from recon.types import Calibration
from recon.verdict.evidence import evidence_of, not_judged, observations, unsettled_by
from recon.verdict.judge import Verdict, method_name, unlike_any, verdict_on
from recon.verdict.missing_light import Missing, missing_light

FACTS = tuple(f.name for f in fields(Measurement) if f.name not in ("image", "found"))
"""What is known of a measurement, by the names that :func:`reconstruct` takes them by."""


@linear_algebra_on_one_thread()
def reconstruct(
    measurement: Measurement | npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions | None = None,
    *,
    warm: Reconstruction | None = None,
    on_progress: Progress | None = None,
    cancel: threading.Event | None = None,
    keeper: Keeper | None = None,
    on_stage: Stage | None = None,
    **overrides: Any,
) -> Reconstruction:
    """Reconstruct a picture or a volume from a lensless camera's measurement.

    Parameters
    ----------
    measurement : Measurement or array, (height, width) or (height, width, n_channels)
        Any real dtype, any exposure. What is known of it (noise, background, erasures: see
        :class:`~recon.reconstruction.measurement.Measurement`) may be given by name as well.
    calibration : Calibration or array
        PSFs, or one PSF image (height, width[, n_channels]) without background, which is taken as it is: one
        convolution of everything. One channel serves all.
    options : ReconstructionOptions, optional
        How to reconstruct; the defaults need no tuning. With ``z_um`` the picture of one depth, else all
        depths that were calibrated: a volume where there are several.
    warm : Reconstruction, optional
        Start from this one.
    on_progress : callable, optional
        ``on_progress(record, volume)`` after each iteration; ``volume()`` makes the present one.
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    keeper : Keeper, optional
        Keeps the solvers' state, and has them go on from what was kept of the same reconstruction.
    on_stage : callable, optional
        ``on_stage(share, what)``: how much of all is done, 0 to 1, which never falls: fitting the PSF
        (``refine_psf``), choosing, the iterations, the repetitions of ``uncertainty``, judging.
    **overrides
        Single options by their names: ``reconstruct(image, psf, prior="l1", iterations=50)``.

    Raises InputError when the input is unusable, or the solver has no way for it; the text says what was
    found, what was expected and what to do.
    """
    measurement, options = measured(measurement, options, overrides)
    course = Course(options, on_stage)
    problem = Problem.of(measurement, calibration, options)
    require_two_images(problem)
    if options.uncertainty and (reason := refused(problem)) is not None:
        raise InputError(f"{reason[0].upper()}{reason[1:]}.")
    refinement = None
    if options.refine_psf:
        problem, refinement = refined(problem, on_stage=course.stage("refine"), cancel=cancel)
    problem = choose(problem, on_stage=course.stage("choose"))
    watch = course.iterations(on_progress, len(parts_of(problem)), problem)
    result = solve(problem, warm=warm, on_progress=watch, cancel=cancel, keeper=keeper)
    if options.uncertainty:
        result = uncertain(result, problem, on_stage=course.stage("uncertainty"), cancel=cancel)
    if refinement is not None:
        provenance = {**result.provenance, "psf_refinement": refinement.to_json()}
        result = replace(result, refinement=refinement, provenance=provenance)
    if not options.judged:
        return replace(result, basis=None)
    stage = course.stage("judge")
    return judged(result, problem, started=warm is not None, on_stage=stage, cancel=cancel)


def require_two_images(problem: Problem) -> None:
    """Raise InputError where a photograph is its own PSF, or the two are swapped."""
    if not problem.patterned:
        require_photograph(problem.data, problem.depths.central, problem.valid)


def measured(
    image: Measurement | npt.ArrayLike,
    options: ReconstructionOptions | None,
    overrides: Mapping[str, Any],
) -> tuple[Measurement, ReconstructionOptions]:
    """Return a measurement with the facts that were given by name, and options with those that were."""
    known, options = given(overrides, options)
    measurement = image if isinstance(image, Measurement) else Measurement(image)
    return replace(measurement, **known), options


def given(
    overrides: Mapping[str, Any], options: ReconstructionOptions | None
) -> tuple[dict[str, Any], ReconstructionOptions]:
    """Tell facts about the measurement, by name, from options."""
    known = {name: value for name, value in overrides.items() if name in FACTS}
    asked = {name: value for name, value in overrides.items() if name not in FACTS}
    return known, with_overrides(options or _defaults(), asked)


@functools.cache
def _defaults() -> ReconstructionOptions:
    return ReconstructionOptions()


SHARE, LEAST = 3, 20
"""Of a result's iterations a third are run without held-out pixels, and so many at least."""


def held_out_error(
    result: Reconstruction,
    problem: Problem,
    *,
    on_stage: Stage | None = None,
    cancel: threading.Event | None = None,
) -> float | None:
    """Return the root mean square error of a tenth of the pixels by a shorter run without them.

    Parameters
    ----------
    result : Reconstruction
    problem : Problem
        That was solved; of several channels that are solved one by one the one with most signal counts.
    on_stage : callable, optional
        ``on_stage(share, what)`` after each iteration.
    cancel : threading.Event, optional
        Set it to do without.

    Returns
    -------
    float or None
        In units of the noise, which it holds itself: 1 is as good as can be. None where it was cancelled.
    """
    stopped = cancel or threading.Event()
    if stopped.is_set():
        return None
    unseen = problem.valid & (np.random.default_rng(0).random(problem.valid.shape) < HELD_OUT)
    spread = [float(d[v].std()) for d, v in zip(problem.data, problem.valid, strict=True)]
    channels = next(c for c in parts_of(problem) if c.start <= int(np.argmax(spread)) < c.stop)
    seen = replace(problem, data=np.where(unseen, 0, problem.data), valid=problem.valid & ~unseen)
    offered = SOLVERS.named(result.solver)
    if offered.accepts(seen) is not None:
        offered = SOLVERS.named("admm")
    seen = replace(seen, options=replace(seen.options, solver=offered.name))
    rules = rules_of(seen, offered)
    if not offered.one_step:
        rules = replace(rules, iterations=max(len(result.history) // SHARE, LEAST))
    part = Part(seen, channels)
    try:
        part.weigh(result.tau)
        solver = offered.make(part, None)

        def tell(_: object, record: IterationRecord) -> None:
            if on_stage is not None:
                share = record.iteration / (rules.iterations or record.iteration)
                on_stage(share, "judging: pixels held out")

        solution = part.lifted(solver.run(rules, callback=tell, cancel=stopped).solution)
        if stopped.is_set():
            return None
        told = part.camera.forward(solution)
        if part.removal is not None:
            told = told + part.background(solution)
    finally:
        part.close()
    missed = (problem.data[channels] - told)[unseen[channels]].astype(np.float64)
    return float(np.sqrt(np.mean(missed**2)))


def lacking(result: Reconstruction, problem: Problem) -> Missing | None:
    """Return what a picture's PSF lacks, cut by the sensor's edges; None where that is not known.

    So it is of several depths, of PSFs that vary over the field, and of a result without its whole object.

    Parameters
    ----------
    result : Reconstruction
    problem : Problem
        That was solved.
    """
    if result.state is None or problem.n_planes > 1 or problem.patterned or problem.model != "convolution":
        return None
    psfs = problem.depths.central[0]
    if psfs.shape[1:] != problem.sensor_shape:
        return None  # it was cut to where it has light
    rows, columns = seen_window(psfs.mean(axis=0))
    return missing_light(
        psfs[:, rows, columns], result.state[:, 0], *window_of("sensor", problem.sensor_shape, psfs.shape[1:])
    )


def _smooth_share(result: Reconstruction, problem: Problem) -> float:
    """Return a picture's smooth background relative to the data's light; 0 of volumes."""
    if result.background is None or problem.n_planes > 1:
        return 0.0
    light = float(np.mean((problem.data * problem.noise[:, None, None])[problem.valid], dtype=np.float64))
    return float(np.mean(result.background)) / max(abs(light), 1e-30)


def judged(
    result: Reconstruction,
    problem: Problem,
    *,
    started: bool = False,
    on_stage: Stage | None = None,
    cancel: threading.Event | None = None,
) -> Reconstruction:
    """Return the result with a verdict on whether to trust it and whether the calibration is its own.

    Where the PSF seems to go on beyond the sensor and the scene needs what it lacks, the result is doubtful.
    At the cost of about two iterations, and of a hundred on few pixels; where no known case tells, of a third
    of the iterations more, for pixels that are held out.

    Parameters
    ----------
    result : Reconstruction
    problem : Problem
        That was solved.
    started : bool
        Whether it was started from another result.
    on_stage : callable, optional
        ``on_stage(share, what)`` as it goes on.
    cancel : threading.Event, optional
        Set it to do without held-out pixels.
    """
    problem, small = result.basis or (problem, result)
    tell = on_stage or (lambda *_: None)
    tell(0.0, "judging the result")
    verdict, said = _verdict(small, problem, started=started)
    if verdict is not None:
        looks: tuple[tuple[str, Callable[[Verdict], Verdict]], ...] = (
            (
                "The calibration was not checked",
                functools.partial(_with_decoys, problem=problem, on_stage=tell),
            ),
            (
                "Whether the PSF lacks light that the picture needs was not looked at",
                functools.partial(_with_missing_light, result=small, problem=problem),
            ),
            (
                "Whether the background explains what the picture should was not looked at",
                functools.partial(_with_background, result=small, problem=problem),
            ),
            (
                "No pixels were held out",
                functools.partial(
                    _with_held_out, result=small, problem=problem, on_stage=tell, cancel=cancel
                ),
            ),
        )
        for not_told, look in looks:
            try:
                verdict = look(verdict)
            except Exception as error:  # noqa: BLE001 - the verdict says what it says without it
                said = (*said, f"{not_told}: {error}")
    tell(1.0, "judged")
    uncertainty = result.uncertainty
    if uncertainty is not None and verdict is not None and verdict.calibration is not None:
        uncertainty = replace(uncertainty, wrong_calibration=verdict.calibration.wrong)
        said = (*said, *(doubt for doubt in uncertainty.doubt if doubt not in result.warnings))
    residual = result.residual if verdict is None or unlike_any(verdict) else None
    warnings = (*result.warnings, *said)
    return replace(
        result,
        verdict=verdict,
        residual=residual,
        uncertainty=uncertainty,
        warnings=warnings,
        basis=None,
    )


def _with_decoys(verdict: Verdict, *, problem: Problem, on_stage: Stage) -> Verdict:
    check = check_calibration(problem, on_stage=on_stage)
    return verdict if check is None else verdict.with_calibration(check)


def _with_missing_light(verdict: Verdict, *, result: Reconstruction, problem: Problem) -> Verdict:
    missing = lacking(result, problem)
    if missing is None or not missing.much:
        return verdict
    return verdict.with_cut_psf(missing.of_all / (1 + missing.of_all))


def _with_background(verdict: Verdict, *, result: Reconstruction, problem: Problem) -> Verdict:
    smooth = _smooth_share(result, problem)
    return verdict.with_background_below_zero(smooth) if is_below_zero(smooth) else verdict


def _with_held_out(
    verdict: Verdict,
    *,
    result: Reconstruction,
    problem: Problem,
    on_stage: Stage,
    cancel: threading.Event | None,
) -> Verdict:
    if not unlike_any(verdict):
        return verdict
    return replace(verdict, held_out=held_out_error(result, problem, on_stage=on_stage, cancel=cancel))


def _verdict(
    result: Reconstruction, problem: Problem, *, started: bool
) -> tuple[Verdict | None, tuple[str, ...]]:
    foreign = [
        f"the {what} {name}"
        for what, name, own in (
            ("solver", result.solver, SOLVERS.is_own(result.solver)),
            ("prior", result.prior, PRIORS.is_own(result.prior)),
        )
        if not own
    ]
    if problem.n_planes > 1 and result.solver != "admm" and not foreign:
        foreign.append(f"volumes by the solver {result.solver}")
    if problem.model in CAMERAS:
        foreign.append(f"the camera model {problem.model}")
    if problem.patterned:
        foreign.append("patterned light")
    if foreign:
        return None, (f"Not judged: there are no known cases of {' and '.join(foreign)}.",)
    if not problem.options.judged and not result.history:
        return None, ("Not judged: it was solved with judged=False.",)
    try:
        picture = problem.n_planes == 1
        # One plane is a picture: it fails as pictures do, by a wrong depth for one.
        evidence = evidence_of(
            observations(problem.measurement.image, problem.data, problem.valid, problem.noise),
            result.volume[: problem.n_depths],
            problem.depths.central[: problem.n_depths],
            list(result.residuals),
            max(
                unsettled_by(h, r, problem.stop_tolerance, started=started)
                for h, r in zip(result.histories, result.stop_reasons, strict=True)
            ),
            points=not picture,
        )
        return verdict_on(evidence, method_name(result.solver, result.prior, volume=not picture)), ()
    except Exception as error:  # noqa: BLE001 - the result may be hours of work: it is worth more than this
        return None, (not_judged(error),)
