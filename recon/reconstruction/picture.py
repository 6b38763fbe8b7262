"""One call from a measurement and a calibration to a picture, with defaults that need no tuning."""

from __future__ import annotations

import difflib
import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from recon.base.noise import NoiseModel
from recon.base.options import require_options
from recon.camera.camera_model import MODELS, ModelName
from recon.errors import InputError
from recon.priors import PRIORS, Prior
from recon.reconstruction.channel import PRIORS as VOLUME_PRIORS
from recon.reconstruction.preparation import Field, Precision, Prepared, prepare, require_precision
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.varying_picture import model_of, reconstruct_varying
from recon.solvers.base import Keeper, Outcome, Solver
from recon.solvers.methods import Problem, method_named, method_names
from recon.solvers.stopping import IterationRecord, StoppingRules
from recon.types import Calibration
from recon.verdict.collect import evidence_of, not_judged, unsettled_by
from recon.verdict.judge import method_name, verdict_on
from recon.verdict.verdict import Verdict

if TYPE_CHECKING:
    from recon.reconstruction.overrides import Wishes

Array = npt.NDArray[Any]
Progress = Callable[[IterationRecord, Callable[[], npt.NDArray[np.float32]]], object]

NOISE_WEIGHT = 1.0
"""Default weight of a prior in units of the noise (that a unit-energy PSF's adjoint passes on unchanged)."""

LEAST_TAU = 1e-5
"""Least default weight relative to ``max |A^H b|``: what errors of the model ask for when noise does not."""


def reconstruct(
    measurement: npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    *,
    z_um: float | None = None,
    model: ModelName = "auto",
    method: str = "admm",
    prior: str | Prior = "tv",
    tau: float | None = None,
    iterations: int | None = None,
    time_s: float | None = None,
    tolerance: float | None = None,
    stop_at_noise: bool = False,
    noise: NoiseModel | float | None = None,
    background: npt.ArrayLike | None = None,
    erasures: npt.ArrayLike | None = None,
    initial: Reconstruction | None = None,
    field: Field = "sensor",
    wishes: Wishes | None = None,
    callback: Progress | None = None,
    cancel: threading.Event | None = None,
    judged: bool = True,
    keeper: Keeper | None = None,
    precision: Precision = "float32",
) -> Reconstruction:
    """Reconstruct the picture of one depth from a lensless camera's measurement.

    Parameters
    ----------
    measurement : array, (height, width) or (height, width, n_channels)
        Any real dtype, any exposure. Background already subtracted, or given as ``background``.
    calibration : Calibration or array
        PSFs, or one PSF image (height, width[, n_channels]) without background. One channel serves all.
    z_um : float, optional
        Depth of the scene; chooses the nearest calibrated PSF. Needed when there are several.
    model : str
        ``"convolution"`` (one PSF for the whole field), ``"local"`` or ``"lowrank"`` (Kuo 2020, Ch. 5; for
        PSFs from several places of the field). The latter two have a solver of their own, take the priors of
        :func:`recon.reconstruct_volume` and start from zero. ``"auto"``: the smallest model, field, binning
        and colours that explain the data (:func:`recon.reconstruction.decide`), on the measurement's pixels
        whatever was chosen; ``choice`` says what and why. With a bare PSF image, another method, a prior that
        :func:`recon.reconstruct_volume` has not, or a start it is one convolution of everything; with a
        keeper only the model is chosen. (``--psf FILE`` of the command line is a calibration of one PSF.)
    method : str
        A name from :func:`recon.solvers.methods.method_names`: ``"admm"``, ``"admm-sensor"``
        (for dense scenes on many pixels), ``"fista"``, ``"wiener"``.
    prior : str or Prior
        A name from :data:`recon.priors.PRIORS` (all but ``"none"`` include non-negativity), or a prior for
        the scaled problem of :func:`recon.reconstruction.preparation.prepare`. Of these, ``"wiener"`` keeps
        only the bounds.
    tau : float, optional
        Weight of the prior relative to ``max |A^H b|``: the same number works at any exposure and size, and
        for l1 a tau of 1 leaves nothing. Default: from the measurement's noise. For ``"wiener"``: its
        regularisation (see :func:`recon.solvers.wiener`), by default cross-validated.
    iterations, time_s, tolerance : optional
        When to stop: count, wall seconds, relative change an iteration, whichever comes first. Default: the
        method's own tolerance and, without ``time_s``, 200 iterations.
    stop_at_noise : bool
        Also stop as soon as the residual is down to the expected noise.
    noise : NoiseModel or float, optional
        The camera's noise, or its standard deviation in counts; default: estimated from the measurement.
    background : array or number, optional
        Subtracted from the measurement first.
    erasures : array of bool, (height, width[, n_channels]), optional
        True where a pixel tells nothing: dead, saturated, not read (Kuo 2020, Eq. 3.10, has the complement).
    initial : Reconstruction, optional
        Start from this one's ``state``.
    field : "sensor" or "full"
        Return the part opposite to the sensor, or everything that can reach it.
    wishes : recon.reconstruction.overrides.Wishes, optional
        With ``"auto"``: choices that are not to be left to the program. Refused where not all is chosen.
    callback : callable, optional
        ``callback(record, image)`` after each iteration; ``image()`` makes the present picture.
    cancel : threading.Event, optional
        Set it to stop after the iteration in progress.
    judged : bool
        Say whether the result can be trusted (``verdict``), at the cost of about two iterations.
    keeper : Keeper, optional
        Keeps the solver's state, and has it go on from what was kept of the same reconstruction.
    precision : "float32" or "float64"
        Of the solver's arithmetic, with any model; the picture is float32. Float64 takes twice the memory.
        With ``"auto"`` and float64 only the model is chosen; to have all chosen in float64, wish for it.

    Returns
    -------
    Reconstruction
        ``history`` holds residuals in units of the noise' standard deviation, to compare with ``noise_norm``.

    Raises
    ------
    InputError
        When the input is unusable, or the method has no way for the prior; the text says what was found, what
        was expected and what to do.
    """
    if method not in method_names():
        raise InputError(_unknown("method", method, method_names()))
    require_prior(prior)
    require_precision(precision)
    require_options(
        iterations=iterations, time_s=time_s, tolerance=tolerance, tau=tau, z_um=z_um, noise=noise
    )
    prevented = _no_choice(calibration, model, method, prior, initial, keeper, precision)
    if prevented is None:
        from recon.reconstruction.selection_picture import reconstruct_chosen

        assert isinstance(calibration, Calibration)
        return reconstruct_chosen(
            measurement,
            calibration,
            z_um=z_um,
            prior=str(prior),
            tau=tau,
            iterations=iterations,
            time_s=time_s,
            tolerance=tolerance,
            stop_at_noise=stop_at_noise,
            noise=noise,
            background=background,
            erasures=erasures,
            field=field,
            wishes=wishes,
            callback=callback,
            cancel=cancel,
            judged=judged,
        )
    if wishes is not None:
        from recon.reconstruction.overrides import require_choice

        require_choice(wishes, prevented)
    varying = _varying_model(calibration, z_um, model, method, prior, initial)
    if varying is not None and varying[0] != "convolution":
        assert isinstance(calibration, Calibration)
        return reconstruct_varying(
            measurement,
            calibration,
            z_um=z_um,
            model=varying[0],
            reason=varying[1],
            prior=str(prior),
            tau=tau,
            iterations=iterations,
            time_s=time_s,
            tolerance=tolerance,
            noise=noise,
            background=background,
            erasures=erasures,
            field=field,
            stop_at_noise=stop_at_noise,
            callback=callback,
            cancel=cancel,
            judged=judged,
            keeper=keeper,
            precision=precision,
        )
    problem = prepare(
        measurement,
        calibration,
        z_um=z_um,
        noise=noise,
        background=background,
        erasures=erasures,
        precision=precision,
    )
    problem.grid(field, z_um)
    peak = float(np.max(np.abs(problem.operator.adjoint(problem.data))))
    given_tau = tau
    tau = max(NOISE_WEIGHT / peak if peak > 0 else 0.0, LEAST_TAU) if tau is None else float(tau)
    name, penalty = _named(prior, tau * peak)
    try:
        rules = StoppingRules(
            iterations=200 if iterations is None and time_s is None else iterations,
            time_s=time_s,
            tolerance=method_named(method).tolerance if tolerance is None else tolerance,
            noise_norm=problem.noise_norm if stop_at_noise else None,
        )
    except ValueError as error:
        raise InputError(str(error)) from error

    def tell(solver: Solver, record: IterationRecord) -> None:
        if callback is not None:
            callback(record, lambda: problem.picture(solver.solution, field))

    outcome = method_named(method).solve(
        Problem(
            operator=problem.operator,
            data=problem.data,
            prior=penalty,
            tau=given_tau,
            initial=None if initial is None else _start(initial, problem),
            rules=rules,
            callback=None if callback is None else tell,
            cancel=cancel,
            keeper=keeper,
        )
    )
    picture = problem.picture(outcome.solution, field)
    verdict: Verdict | None = None
    failed: list[str] = []
    if judged:
        try:
            verdict = _verdict(
                measurement, problem, picture, outcome, rules, method, name, started=initial is not None
            )
        except Exception as error:  # noqa: BLE001 - the picture is worth more than what is said of it
            failed = [not_judged(error)]
    return Reconstruction(
        image=picture,
        grid=problem.grid(field, z_um),
        method=method,
        prior=name,
        tau=tau if isinstance(prior, str) else None,
        noise_norm=problem.noise_norm,
        history=outcome.history,
        stop_reason=outcome.stop_reason,
        seconds=outcome.seconds,
        warnings=(*problem.warnings, *(() if varying is None else varying[2]), *failed),
        state=outcome.solution * problem.image_scale,
        provenance={
            "noise_deviation": [float(v) for v in problem.noise],
            "psf_z_um": problem.psf_z_um,
            "precision": precision,
            "valid_share": float(problem.noise_norm**2 / problem.data.size),
        },
        verdict=verdict,
    )


def _verdict(
    measurement: npt.ArrayLike,
    problem: Prepared,
    picture: Array,
    outcome: Outcome,
    rules: StoppingRules,
    method: str,
    prior: str,
    *,
    started: bool,
) -> Verdict:
    if outcome.history:
        residual = outcome.history[-1].data_residual
    else:
        # A solution in one step fits whatever there is, with negative light where the model is wrong.
        possible = np.maximum(outcome.solution, 0)
        residual = float(np.linalg.norm(problem.operator.forward(possible) - problem.data))
    evidence = evidence_of(
        measurement,
        problem.data,
        problem.valid,
        problem.noise,
        picture[None],
        problem.psfs[None],
        [residual],
        unsettled_by(outcome.history, outcome.stop_reason, rules.tolerance, started=started),
    )
    return verdict_on(evidence, method_name(method, prior))


def _is_able(method: str, prior: str | Prior, initial: Reconstruction | None) -> bool:
    """Tell whether PSFs may vary over the field: that solver has priors of its own, and starts from zero."""
    return method == "admm" and isinstance(prior, str) and prior in VOLUME_PRIORS and initial is None


def _no_choice(
    calibration: Calibration | npt.ArrayLike,
    model: ModelName,
    method: str,
    prior: str | Prior,
    initial: Reconstruction | None,
    keeper: Keeper | None,
    precision: Precision,
) -> str | None:
    """Return what prevents that everything is chosen; None where nothing does."""
    preventing = {
        f"model={model!r}": model != "auto",
        "a bare PSF image": not isinstance(calibration, Calibration),
        f"method={method!r}": method != "admm",
        f"prior={prior!r}": not (isinstance(prior, str) and prior in VOLUME_PRIORS),
        "a start (initial)": initial is not None,
        "a checkpoint (keeper)": keeper is not None,
        f"precision={precision!r}": precision != "float32",
    }
    return next((what for what, prevents in preventing.items() if prevents), None)


def _varying_model(
    calibration: Calibration | npt.ArrayLike,
    z_um: float | None,
    model: ModelName,
    method: str,
    prior: str | Prior,
    initial: Reconstruction | None,
) -> tuple[ModelName, str, tuple[str, ...]] | None:
    """Return the camera model and why, where there is a choice; None for one convolution."""
    if model not in MODELS:
        raise InputError(_unknown("model", model, MODELS))
    able = _is_able(method, prior, initial)
    if model == "convolution" or (model == "auto" and not able):
        return None
    if not isinstance(calibration, Calibration):
        if model == "auto":
            return None
        raise InputError(f"The {model} model needs a calibration with PSFs from several places of the field.")
    if not able:
        raise InputError(
            f"The {model} model has a solver of its own: leave method at 'admm', take one of the priors "
            f"{', '.join(VOLUME_PRIORS)}, and start from zero."
        )
    if model == "auto" and len(calibration.psfs) == 1:
        return None
    return model_of(calibration, z_um, model)


def require_prior(prior: str | Prior) -> None:
    """Raise InputError for what is neither a prior nor the name of one."""
    if not isinstance(prior, Prior) and prior not in PRIORS:
        raise InputError(_unknown("prior", prior, tuple(PRIORS)))


def _named(prior: str | Prior, weight: float) -> tuple[str, Prior]:
    if isinstance(prior, Prior):
        return "+".join(type(t).__name__ for t in prior.terms()), prior
    return prior, PRIORS[prior](weight)


def _start(initial: Reconstruction, problem: Prepared) -> Array:
    if initial.state is None or initial.state.shape != problem.camera.domain_shape:
        found = "no state" if initial.state is None else f"a state of {initial.state.shape}"
        raise InputError(
            f"The reconstruction to start from has {found}; "
            f"this measurement needs {problem.camera.domain_shape}."
        )
    start: Array = initial.state / problem.image_scale
    return start


def _unknown(what: str, name: str, known: tuple[str, ...]) -> str:
    near = difflib.get_close_matches(str(name), known, 1)
    hint = f" Did you mean {near[0]!r}?" if near else ""
    return f"The {what} {name!r} is not known. Choose one of {', '.join(known)}.{hint}"
