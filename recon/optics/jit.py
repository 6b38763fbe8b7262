"""Compiled kernels with their Python types kept for the type checker."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba
from numba.core import entrypoints

P = ParamSpec("P")
R = TypeVar("R")


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile with numba on first use (kept on disk), releasing the interpreter lock while it runs.

    What is kept on disk is renewed when the function's own file changes, and only then: compiled functions
    that call each other belong in one file.
    """
    return cast("Callable[P, R]", numba.njit(cache=True, nogil=True)(function))


def extensions_put_off() -> Callable[[], None]:
    """Have the first compiled function not wait for numba's installed extensions; return what loads them.

    They take 0.25 s of the processor (rocket-fft, with SciPy). What is compiled here imports those
    that it needs; kernels of other packages may rely on their being loaded: that is to be done soon.
    """
    if getattr(entrypoints, "_already_initialized", True):  # loaded, or a numba that keeps it elsewhere
        return lambda: None
    entrypoints._already_initialized = True

    def load() -> None:
        if not loaded:
            loaded.append(True)
            entrypoints._already_initialized = False
            entrypoints.init_all()  # type: ignore[no-untyped-call]

    loaded: list[bool] = []
    return load
