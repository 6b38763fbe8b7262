"""Compiled kernels with their Python types kept for the type checker."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with numba on first use (kept on disk), releasing the interpreter lock while it runs.

    What is kept on disk is renewed when the function's own file changes, and only then: compiled functions
    that call each other belong in one file.
    """
    return cast("Callable[P, R]", numba.njit(cache=True, nogil=True)(function))
