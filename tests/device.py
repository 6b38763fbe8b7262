"""A GPU's array library played by NumPy, as strict as CuPy: its arrays and the host's do not mix.

What CuPy would refuse is refused here: an array of the host as operand, argument or value, and a device's
array where NumPy itself is asked for one. So code that runs on it asks for the right library's functions; how
fast it is, and what only CUDA knows, it does not show.
"""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any
from unittest import mock

import numpy as np

NAME = "played_device"


class DeviceArray(np.ndarray):
    """An array that only the device's library, operators and methods take."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, out: Any = None, **given: Any) -> Any:
        """Compute on the device; refuse the host's arrays."""
        written = None if out is None else tuple(_inner(o) for o in out)
        found = getattr(ufunc, method)(*map(_inner, inputs), out=written, **_all_inner(given))
        return out[0] if out is not None else _outer(found)

    def __array_function__(self, func: Any, _types: Any, args: Any, kwargs: Any) -> Any:
        """NumPy's functions are handed on to the device's library, as CuPy's arrays do."""
        return _outer(func(*_all_inner(args), **_all_inner(kwargs)))

    def __setitem__(self, key: Any, value: Any) -> None:
        """Take values of the device, and numbers."""
        self.view(np.ndarray)[_all_inner(key)] = _inner(value)

    def __getitem__(self, key: Any) -> Any:
        """Give a view, of the device even where it is a number."""
        return _outer(self.view(np.ndarray)[_all_inner(key)])

    def sum(self, *args: Any, **given: Any) -> Any:
        """Return a sum of the device, also where it is a number."""
        return _outer(self.view(np.ndarray).sum(*args, **given))

    def max(self, *args: Any, **given: Any) -> Any:
        """Return a maximum of the device, also where it is a number."""
        return _outer(self.view(np.ndarray).max(*args, **given))

    def mean(self, *args: Any, **given: Any) -> Any:
        """Return a mean of the device, also where it is a number."""
        return _outer(self.view(np.ndarray).mean(*args, **given))

    def __array_namespace__(self, *, api_version: str | None = None) -> Any:
        """Return the device's library."""
        return LIBRARY

    def get(self) -> np.ndarray:
        """Return a copy in the host's memory."""
        return np.array(self.view(np.ndarray))


def _inner(value: Any) -> Any:
    """Return what NumPy computes with; raise for an array of the host."""
    if isinstance(value, DeviceArray):
        return value.view(np.ndarray)
    if isinstance(value, np.ndarray) and value.ndim:
        raise TypeError(f"An array of the host, {value.shape}, where the device's are.")
    return value


def _all_inner(given: Any) -> Any:
    if isinstance(given, tuple | list):
        return type(given)(_all_inner(value) for value in given)
    if isinstance(given, dict):
        return {name: _all_inner(value) for name, value in given.items()}
    return _inner(given)


def _outer(found: Any) -> Any:
    if isinstance(found, tuple):
        return tuple(map(_outer, found))
    if isinstance(found, np.ndarray | np.generic):
        return np.asarray(found).view(DeviceArray)
    return found


def _handed(function: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *args, **given: _outer(function(*_all_inner(args), **_all_inner(given)))


class _Library(types.ModuleType):
    """NumPy's functions, or those of a part of it, for the device's arrays."""

    def __init__(self, name: str, plays: Any) -> None:
        super().__init__(name)
        self._plays = plays

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._plays, name)
        if isinstance(found, types.ModuleType):
            return _Library(f"{NAME}.{name}", found)
        return found if isinstance(found, type) or not callable(found) else _handed(found)

    @staticmethod
    def asarray(values: Any, dtype: Any = None) -> DeviceArray:
        """Take an array of the host, or of the device."""
        host = values.view(np.ndarray) if isinstance(values, DeviceArray) else np.asarray(values)
        return host.astype(dtype or host.dtype, copy=not isinstance(values, DeviceArray)).view(DeviceArray)

    array = asarray


LIBRARY = _Library(NAME, np)


@contextmanager
def played() -> Iterator[types.ModuleType]:
    """Have the GPU's code run on the played library."""
    with ExitStack() as patched:
        patched.enter_context(
            mock.patch("recon.reconstruction.part.array_namespace", {"cpu": np, "gpu": LIBRARY}.__getitem__)
        )
        patched.enter_context(
            mock.patch("recon.holography.model.array_namespace", {"cpu": np, "gpu": LIBRARY}.__getitem__)
        )
        for solver in ("volume_admm", "douglas_rachford", "operator_admm"):
            patched.enter_context(mock.patch(f"recon.solvers.{solver}.require_memory"))
        yield LIBRARY
