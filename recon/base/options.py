"""The options that pictures and volumes share, checked before any work is begun."""

from __future__ import annotations

import math
from numbers import Integral, Real

from recon.base.noise import NoiseModel
from recon.errors import InputError


def require_options(
    *,
    iterations: int | None = None,
    time_s: float | None = None,
    tolerance: float | None = None,
    tau: float | None = None,
    z_um: float | None = None,
    noise: NoiseModel | float | None = None,
) -> None:
    """Check what can be checked without a measurement; None is always allowed. As :func:`recon.reconstruct`.

    Raises
    ------
    InputError
        For the first that cannot be, with what is expected.
    """
    if iterations is not None and (not _is_whole(iterations) or iterations < 1):
        raise InputError(f"iterations must be a whole number, 1 or more, not {iterations!r}.")
    _require(time_s, "time_s", "seconds above 0", above=0)
    _require(tolerance, "tolerance", "0 or more", least=0)
    _require(tau, "tau", "0 or more, and finite", least=0, below=math.inf)
    _require(z_um, "z_um", "above 0", above=0)
    if not isinstance(noise, NoiseModel):
        expected = "a NoiseModel, or a standard deviation in counts, 0 or more"
        _require(noise, "noise", expected, least=0, below=math.inf)


def _is_whole(value: object) -> bool:
    return isinstance(value, Integral) and not isinstance(value, bool)


def _require(
    value: object,
    name: str,
    expected: str,
    *,
    least: float = -math.inf,
    above: float = -math.inf,
    below: float = math.nan,
) -> None:
    if value is None:
        return
    number = isinstance(value, Real) and not isinstance(value, bool)
    if not (number and value >= least and value > above and not value >= below):  # type: ignore[operator]
        raise InputError(f"{name} must be {expected}, not {value!r}.")
