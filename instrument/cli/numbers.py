"""Numbers as options: what no measurement can use is refused where the option is read."""

from __future__ import annotations

import math

import typer


def finite(value: float | None) -> float | None:
    """Let a number through, or an option that was left out; refuse nan and inf (an option's callback)."""
    if value is not None and not math.isfinite(value):
        raise typer.BadParameter(f"a finite number is needed, not {value:g}.")
    return value


def positive(value: float | None) -> float | None:
    """As :func:`finite`; refuses zero and what is below as well."""
    if value is not None and not 0 < value < math.inf:
        raise typer.BadParameter(f"a finite number above 0 is needed, not {value:g}.")
    return value
