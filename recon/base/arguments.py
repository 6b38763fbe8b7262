"""What functions are given in Python: a sentence where it is nothing that they take."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.arrays import Array
from recon.base.declare import Declaration, Option
from recon.errors import InputError
from recon.types import numbers_of, plain_array, plain_number


def require_argument(name: str, value: object, kind: Any, remedy: str = "", **limits: float) -> Any:
    """Return an argument, of an array without axes its number; raises InputError where it is not of its kind.

    The error says what it must be, what it is, and the ``remedy``.

    ``kind`` is its type as a parameter is annotated (``float | None``; ``Path`` takes text, too), ``limits``
    are those of a :class:`~recon.base.declare.Declaration`.
    """
    value = plain_number(value)
    asked = Option(name, kind, dataclasses.MISSING, Declaration(help="", **limits))  # type: ignore[arg-type]
    if (mistake := asked.mistake(value)) is None:
        return value
    if value is None:
        mistake = f"{name} must be {asked.expected()}, not None."
    if name == "folder":
        mistake = mistake.replace("the name of a file", "the name of a folder")
    raise InputError(f"{mistake} {remedy}".strip())


def is_several(value: object) -> bool:
    """Whether it is a sequence, or an array with an axis; a text is none, nor a set, which has no order."""
    return bool(getattr(value, "shape", ())) or (
        isinstance(value, Sequence) and not isinstance(value, str | bytes)
    )


def require_shape(name: str, value: Any) -> tuple[int, int]:
    """Return height and width; raises InputError for what is not two whole numbers, 1 or more."""
    if not is_several(value) or len(value) != 2:
        given = f"an array of shape {np.shape(value)}" if isinstance(value, np.ndarray) else repr(value)
        raise InputError(f"{name} must be (height, width), two whole numbers, not {given}.")
    whole = [int(n) if isinstance(n, float) and n.is_integer() else n for n in map(plain_number, value)]
    height, width = (require_argument(name, n, int, "It is (height, width).", least=1) for n in whole)
    return int(height), int(width)


def require_numbers(
    name: str, array: npt.ArrayLike, expected: str, *, kinds: str = "uifb", least_axes: int = 1
) -> Array:
    """Return an array of numbers as it is, NaN where one is masked.

    ``kinds`` are NumPy's letters for them: real ones. Raises InputError for anything else: what is
    ``expected``, and what it is.
    """
    try:
        found = plain_array(array)
    except (TypeError, ValueError):
        found = np.asarray(None)
    if found.dtype.kind not in kinds or found.ndim < least_axes:
        given = (
            type(array).__name__ if not found.ndim else f"an array of {found.dtype}{numbers_of(found.dtype)}"
        )
        raise InputError(f"{name} must be {expected}, not {given}.")
    return found
