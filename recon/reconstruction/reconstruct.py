"""The one door from a measurement and a calibration to a picture or volume."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import fields, replace
from typing import Any

import numpy.typing as npt

from recon.base.declare import with_overrides
from recon.reconstruction.measurement import Measurement
from recon.reconstruction.options import ReconstructionOptions
from recon.reconstruction.problem import Problem
from recon.reconstruction.result import Reconstruction
from recon.reconstruction.selection import choose
from recon.reconstruction.solve import Progress, judged, solve
from recon.solvers.base import Keeper
from recon.types import Calibration

FACTS = tuple(f.name for f in fields(Measurement) if f.name != "image")
"""What is known of a measurement, by the names that :func:`reconstruct` takes them by."""


def reconstruct(
    measurement: Measurement | npt.ArrayLike,
    calibration: Calibration | npt.ArrayLike,
    options: ReconstructionOptions | None = None,
    *,
    warm: Reconstruction | None = None,
    on_progress: Progress | None = None,
    cancel: threading.Event | None = None,
    keeper: Keeper | None = None,
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
    **overrides
        Single options by their names: ``reconstruct(image, psf, prior="l1", iterations=50)``.

    Raises
    ------
    InputError
        When the input is unusable, or the solver has no way for it; the text says what was found, what was
        expected and what to do.
    """
    known, options = given(overrides, options)
    if not isinstance(measurement, Measurement):
        measurement = Measurement(measurement)
    problem = Problem.of(replace(measurement, **known), calibration, options)
    problem = choose(problem)
    result = solve(problem, warm=warm, on_progress=on_progress, cancel=cancel, keeper=keeper)
    return (
        judged(result, problem, started=warm is not None) if options.judged else replace(result, basis=None)
    )


def given(
    overrides: Mapping[str, Any], options: ReconstructionOptions | None
) -> tuple[dict[str, Any], ReconstructionOptions]:
    """Tell facts about the measurement, by name, from options."""
    known = {name: value for name, value in overrides.items() if name in FACTS}
    asked = {name: value for name, value in overrides.items() if name not in FACTS}
    return known, with_overrides(options or ReconstructionOptions(), asked)
