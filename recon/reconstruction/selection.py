"""The smallest model that explains the data (docs/decisions/0010-smallest-model.md)."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np

from recon.arrays import Array
from recon.base.blocks import whole_blocks
from recon.base.shared_lines import shared_lines
from recon.camera.camera_model import CAMERAS, Extent, ModelName
from recon.errors import InputError
from recon.reconstruction.background import (
    BELOW_ZERO,
    DARKEST,
    DARKEST_PERCENTILE,
    FLOOR,
    Trial,
    background_of,
    beyond_of,
    floor,
    trial_of,
)
from recon.reconstruction.choice import Choice
from recon.reconstruction.colours import channels_of, merged
from recon.reconstruction.measurement import LINES_FOUND, Measurement, OfOnePhotograph
from recon.reconstruction.mending.restored_light import EXPLAINS, with_light_restored
from recon.reconstruction.options import Overrides, ReconstructionOptions
from recon.reconstruction.planes import BEYOND, between_of, no_beyond, planes_of, with_planes_beyond
from recon.reconstruction.probe import COARSE_PX, camera_cost, coarse_copy, coarse_passes, within_of
from recon.reconstruction.problem import Problem, Stage
from recon.reconstruction.reduction import on_blocks, reduced, reduced_calibration
from recon.reconstruction.rules import (
    SETTLED,
    USUAL_ITERATIONS,
    binning_of,
    candidates,
    field_of,
    is_stray,
    iterations_of,
    model_of,
    precision_of,
)
from recon.reconstruction.solvers import SOLVERS, require_solver, volume_priors
from recon.reconstruction.weights import kind_of
from recon.types import Calibration


def choose(
    problem: Problem,
    options: ReconstructionOptions | None = None,
    *,
    on_stage: Stage | None = None,
) -> Problem:
    """Return the smallest problem that explains the data as well: model ``"auto"``.

    What is chosen: the camera model, the depths that take part and planes between them, the field, binning,
    whether colours are one picture, a smooth background, when to stop, and the precision; each by itself
    unless the options say it. Solver, device, memory, checkpoints and a start do not hinder it: where a
    solver has no way for a model or a background, that one is not chosen, and its reason is said.

    Parameters
    ----------
    problem : Problem
    options : ReconstructionOptions, optional
        Default the problem's own.
    on_stage : callable, optional
        ``on_stage(share, what)`` as it goes on.

    Returns
    -------
    Problem
        With ``choice`` (the reasons, and what one step up and down would cost) and ``reduction`` (the way
        back). Where the options ask for a model the same problem, in pictures with a background if it helps.

    Raises InputError when the input is unusable, or a choice was asked for that cannot be had.
    """
    if options is not None:
        problem = replace(problem, options=options)
    problem = without_shared_lines(problem)
    if problem.model != "auto":
        if problem.options.choose not in (None, Overrides()):
            raise InputError(
                f"Choices are about what model='auto' chooses; they do not go with model={problem.model!r}. "
                "Leave one of the two out."
            )
        return with_background(problem, problem.calibration) if problem.n_planes == 1 else problem
    problem, choice = _chosen(problem, on_stage)
    return reduced(choice, problem)


def _chosen(problem: Problem, on_stage: Stage | None = None) -> tuple[Problem, Choice]:
    """Return what is chosen, and the problem: with the light that it lacks where no light explains that."""
    choice = choice_for(problem, on_stage)
    (smooth,) = (d for d in choice.decisions if d.name == "background")
    is_light = choice.background and smooth.numbers.get("least", 0.0) > -BELOW_ZERO
    if is_light and smooth.numbers.get("held_out_without", 0.0) <= EXPLAINS:
        return problem, choice
    restored = with_light_restored(problem, offset=not is_light)
    if restored is problem:
        return problem, choice
    added = restored.measurement.background
    choice = choice_for(restored, on_stage)
    if added is None:
        return restored, choice
    why = f"an even offset of {-float(np.asarray(added)):.3g} counts is added instead"
    told = tuple(replace(d, why=why) if d.name == "background" else d for d in choice.decisions)
    return restored, replace(choice, decisions=told)


def without_shared_lines(problem: Problem) -> Problem:
    """Return a problem whose photograph is less the offsets that whole rows or columns share, which is told.

    The problem itself where there are none, where somebody gave them or said that there is no background, and
    in patterned light.
    """
    measurement = problem.measurement
    said = measurement.lines is not None or problem.options.estimate_background is False
    if said or problem.patterned:
        return problem
    counts = measurement.counts()
    psfs, one = problem.depths.central, len(problem.depths.central[0]) == 1
    found = [
        shared_lines(data, valid, float(noise), psfs[:, 0 if one else c])
        for c, (data, valid, noise) in enumerate(zip(counts.data, counts.valid, problem.noise, strict=True))
    ]
    if not any(found):
        return problem
    offsets = np.stack([np.zeros(problem.sensor_shape, np.float32) if f is None else f.image for f in found])
    each = [{} if f is None else f.deviations for f in found]
    most = {
        name: max(one.get(name, 0.0) for one in each) for name in sorted({k for one in each for k in one})
    }
    lines = " and ".join(
        f"{'columns' if name == 'columns' else 'rows'} by {d:.3g}" for name, d in most.items()
    )
    measurement = replace(
        measurement,
        lines=offsets[0] if problem.flat else np.moveaxis(offsets, 0, -1),
        found={**measurement.found, LINES_FOUND: most},
    )
    counts = measurement.counts()
    deviation = measurement.deviations(counts).astype(np.float32)
    told = OfOnePhotograph(
        f"Whole lines of the photograph differ from their neighbours: {lines} counts (standard deviation; "
        f"a pixel's noise is {float(problem.noise.max()):.3g}), as light through its PSF does not. That was "
        "taken off as far as it can be told from light. As a rule the camera reads whole lines with a noise "
        "of their own: more light, or several frames averaged, make it less. --no-background leaves it."
    )
    return replace(
        problem,
        measurement=measurement,
        data=np.where(counts.valid, counts.data / deviation[:, None, None], 0).astype(np.float32),
        noise=deviation,
        warnings=(*problem.warnings, told),
    )


def with_background(problem: Problem, calibration: Calibration, *, restoring: bool = True) -> Problem:
    """Return a problem of a given model with a smooth background where ``auto`` would have one; nobody said.

    All of the calibration's PSFs tell whether there is one. ``restoring``: light that is missing may be given
    back (:func:`with_light_restored`); not of streams, whose other frames are solved as they come.
    """
    options, model = problem.options, problem.model
    said = options.estimate_background is not None or problem.measurement.background is not None
    if said or problem.patterned or model in CAMERAS:
        return problem
    asked = replace(
        options, model="auto", choose=Overrides(model=model, binning=1, channels="all", beyond=False)
    )
    seen = Problem.of(problem.measurement, calibration, asked)
    restored, choice = _chosen(seen) if restoring else (seen, choice_for(seen))
    if restored is not seen:
        problem = Problem.of(restored.measurement, problem.calibration, options)
        problem = replace(problem, warnings=tuple(dict.fromkeys((*problem.warnings, *restored.warnings))))
    if choice.background != problem.smooth:
        options = replace(options, estimate_background=choice.background)
        told = problem.warnings
        problem = Problem.of(problem.measurement, problem.calibration, options)
        problem = replace(problem, warnings=tuple(dict.fromkeys((*told, *problem.warnings))))
    if not choice.background:
        return problem
    (why,) = (d.why for d in choice.decisions if d.name == "background")
    said_so = f"A smooth background is estimated as well: {why}."
    return replace(problem, warnings=(*problem.warnings, said_so))


def choice_for(problem: Problem, on_stage: Stage | None = None, *, film: bool = False) -> Choice:
    """Choose what to reconstruct a problem with; errors as :func:`choose`.

    Of a ``film`` held-out pixels also say whether its object is shut in where PSFs were measured: in
    photographs that gains nothing that they can tell (docs/decisions/0239-films-alone-are-shut-in.md).
    """
    began = time.perf_counter()
    tell = on_stage or (lambda *_: None)
    tell(0.0, "choosing: camera models")
    overrides, held = _held(problem, _settled(problem))
    measurement, calibration = problem.measurement, problem.calibration
    counts = measurement.counts()
    data, valid = counts.data, counts.valid
    deviation = measurement.deviations(counts)
    merge, tint = channels_of(data, deviation, valid, calibration.psfs, overrides)
    one = merge.value == "merged"
    if tint is not None and one:
        data, valid, calibration = merged(data, valid, calibration, tint)
    depths = problem.depths
    if one and problem.calibration.psfs.shape[1] > 1:
        depths = Problem.of(
            Measurement(data[0]), calibration, ReconstructionOptions(z_um=problem.options.z_um)
        ).depths
    kind = kind_of(problem.prior_name)
    picture = problem.n_planes == 1
    scale = candidates(depths)
    looked = not picture or len(scale) > 1  # else one PSF is all there is
    given = measurement.background is not None
    unsaid = not given and overrides.background is None
    coarse = _coarse(data, valid, calibration, problem.options.z_um) if looked or unsaid else []
    lit = unsaid and (looked or all(floor(c.data[0][c.valid[0]]) >= FLOOR for c in coarse))
    costs = {m: camera_cost(coarse[0], m) for m in scale} if len(scale) > 1 else {}
    tell(0.2, "choosing: where light is")
    contrast = None if kind == "l1" or picture else _contrast(counts.data, counts.valid, deviation)
    model, by_model = model_of(depths, overrides, contrast, costs)
    sparse = coarse_passes(coarse) if looked else None
    tell(0.4, "choosing: a background")
    trial = _trial(problem, coarse, model) if lit else None
    if trial is not None and not looked:
        dim = min(floor(c.data[0][c.valid[0]], DARKEST_PERCENTILE) for c in coarse) < DARKEST
        trial = replace(trial, dim=dim)
    again = None
    prevented = no_beyond(problem.prior, model, len(depths.z_um))
    looks = trial is not None and (trial.explains if overrides.beyond is None else overrides.beyond)
    if looks and prevented is None:
        farther = with_planes_beyond(calibration)
        coarser = _coarse(data, valid, farther, problem.options.z_um, beyond=len(BEYOND))
        again = _trial(problem, coarser, model, whole=True)
    beyond = beyond_of(trial, again, overrides, prevented)
    if beyond.value != "none" and again is not None:
        trial = again
    smooth = background_of(trial, overrides, given=given)
    estimated = smooth.value == "estimated"
    planes, dropped = planes_of(sparse, depths, overrides)
    between, added = between_of(calibration, depths, planes, overrides)
    binning = binning_of(depths, overrides, valid)
    # A background of a few numbers takes what light from beyond the field has of them, not all of it.
    stray = sparse is not None and is_stray(sparse.smooth_share)
    haze = stray and not given and not (estimated and kind == "l1")
    plain = picture and model == "convolution" and not estimated
    within = None
    if film and overrides.field is None and model in ("local", "lowrank") and coarse:
        tell(0.7, "choosing: the field")
        prior = _trial_prior(problem)
        within = within_of([coarse_copy(c, model, prior, background=estimated) for c in coarse])
    extent, field = field_of(depths, overrides, model, within, haze=haze, plain=plain)
    usual = USUAL_ITERATIONS["convolution" if model == "convolution" else "varying"]
    side = max(data.shape[1:]) // int(binning.numbers["binning"])
    precise = precision_of(overrides, usual, side)
    tolerance = overrides.tolerance
    if tolerance is None and plain:
        solved = replace(problem, model="convolution", smooth=False)
        tolerance = solved.solver.tolerance_for(solved)
    elif tolerance is None:
        shown = "picture" if picture else "points" if kind == "l1" else "volume"
        varying = "merged" if one and picture else f"varying {shown}"
        tolerance = SETTLED["convolution" if model == "convolution" else varying]
    decisions = (
        by_model,
        dropped,
        *([added, beyond] if len(depths.z_um) > 1 else []),
        field,
        binning,
        merge,
        smooth,
        iterations_of(tolerance, overrides, plain=plain),
        precise,
    )
    return Choice(
        model=model,
        planes=planes,
        n_planes=len(depths.z_um),
        between=between,
        binning=int(binning.numbers["binning"]),
        merged=one,
        background=estimated,
        precision="float64" if precise.value == "float64" else "float32",
        psf_window=extent.psf_window or (data.shape[1], data.shape[2]),
        acceptance_px=extent.acceptance_px,
        margin=extent.margin,
        tolerance=tolerance,
        decisions=tuple(
            replace(d, why=held[d.name], overruled=False) if d.name in held else d for d in decisions
        ),
        seconds=time.perf_counter() - began,
        beyond=beyond.value != "none",
    )


def _settled(problem: Problem) -> Overrides:
    """Return the choices that the caller makes: those asked for, and what the other options say."""
    options = problem.options
    overrides = options.choose or Overrides()
    if options.precision != "auto":
        if overrides.precision not in (None, options.precision):
            raise InputError(
                f"precision={options.precision} and the choice precision={overrides.precision} contradict "
                "each other: leave one of them out."
            )
        overrides = replace(overrides, precision=options.precision)
    if overrides.background is None:
        asked = True if options.positive_background else options.estimate_background
        overrides = replace(overrides, background=asked)
    if overrides.tolerance is None:
        overrides = replace(overrides, tolerance=options.tolerance)
    if options.field == "full":  # what can reach the sensor is asked for, on its pixels
        overrides = replace(overrides, field="all", binning=1)
    if options.axis_weights is not None and np.ndim(options.axis_weights) == 2:  # one row a depth
        overrides = replace(overrides, planes="all", between=False)
    return overrides


def _held(problem: Problem, overrides: Overrides) -> tuple[Overrides, dict[str, str]]:
    """Settle what the solver and its device leave no choice in; return why, by the decisions' names."""
    options = problem.options
    require_solver(options.solver)
    offered = [SOLVERS.named(options.solver)] if options.solver != "auto" else list(SOLVERS.values())

    def refused(model: ModelName, smooth: bool) -> str | None:
        """Return why no solver takes such a problem; None where one does."""
        reasons = [o.accepts(replace(problem, model=model, smooth=smooth)) for o in offered]
        return None if None in reasons else str(reasons[0])

    held = {}
    smooth = bool(overrides.background)
    if overrides.model is None and candidates(problem.depths) != ("convolution",):
        reason = refused("local", smooth) or refused("lowrank", smooth)
        if reason is not None:
            overrides = replace(overrides, model="convolution")
            held["model"] = f"one PSF a depth, as of the solver: {reason}"
    if overrides.background is None:
        reason = refused(overrides.model or "convolution", True)
        if reason is not None:
            overrides = replace(overrides, background=False)
            held["background"] = f"none, as of the solver: {reason}"
    return overrides, held


def _coarse(
    data: Array, valid: Array, calibration: Calibration, z_um: float | None, *, beyond: int = 0
) -> list[Problem]:
    """Return small copies of every channel; the calibration's last planes may be beyond its depths."""
    factor = whole_blocks(valid, -(-max(data.shape[1:]) // COARSE_PX))
    options = ReconstructionOptions(z_um=z_um, estimate_background=False)
    several = calibration.psfs.shape[1] > 1
    coarse = []
    for c in range(len(data)):
        own = calibration.psfs[:, c : c + 1] if several else calibration.psfs
        small = reduced_calibration(replace(calibration, psfs=own, background=None), factor, None)
        photograph = on_blocks(data[c : c + 1], valid[c : c + 1], None, factor, flat=True)
        coarse.append(Problem.of(photograph, small, options, extent=Extent(beyond=beyond)))
    return coarse


def _contrast(data: Array, valid: Array, deviation: Array) -> float:
    """Return the largest channel's standard deviation in units of its noise."""
    spread = [float(d[v].std(dtype=np.float64)) for d, v in zip(data, valid, strict=True)]
    return max(s / max(float(n), 1e-30) for s, n in zip(spread, deviation, strict=True))


def _trial_prior(problem: Problem) -> str:
    """Return the problem's prior, or what it counts where ADMM has no way for it."""
    name = problem.prior_name
    return name if name in volume_priors() else kind_of(name)


def _trial(problem: Problem, coarse: list[Problem], model: ModelName, *, whole: bool = False) -> Trial:
    """Try the coarse copies with the problem's prior; one that ADMM has no way for by what it counts.

    Where PSFs vary the central ones are tried first, in a fraction of the time: what they explain without a
    background the true camera explains as well, and its passes are less finished, which looks like light
    that a background would take (four dense pictures without stray light lost 3.0 to 4.8 dB by one).
    """
    prior = _trial_prior(problem)

    def tried(model: ModelName) -> Trial:
        return trial_of([coarse_copy(c, model, prior, background=True) for c in coarse], whole=whole)

    first = tried("convolution")
    return tried(model) if first.helps and model != "convolution" else first
