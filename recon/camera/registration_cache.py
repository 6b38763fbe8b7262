"""Registered PSFs of the calibrations that were asked for last.

Registering is the slowest part of a small problem, and choosing a model, the reconstruction and the next one
with the same calibration ask for the same: what was registered last is remembered, by its content.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.field_registration import registered_field
from recon.camera.local_convolution import FieldOfPsfs
from recon.types import Calibration

Array = npt.NDArray[Any]
Registered = tuple[Array, FieldOfPsfs, list[str]]

REMEMBERED_BYTES = 128 * 2**20
"""PSFs that are remembered: 50 of 800 x 800 pixels. Larger calibrations are registered anew: a part of
one would push out the part that is asked for next."""


def remembered_field(calibration: Calibration, group: npt.NDArray[np.intp]) -> Registered:
    """Return what :func:`~recon.camera.field_registration.registered_field` does, registering what is new.

    The arrays are shared with whoever asked before, and cannot be written to.
    """
    if len(group) < 2 or calibration.psfs.nbytes > REMEMBERED_BYTES:
        return registered_field(calibration, group)
    key = _content(calibration, group)
    known = _fields.get(key)
    if known is None:
        central, field, warnings = registered_field(calibration, group)
        central = np.array(central)  # no view of the caller's PSFs: he may change them, and they may be many
        for kept in (central, field.psfs, field.points):
            kept.flags.writeable = False
        known = central, field, warnings
        _fields.put(key, known)
    central, field, warnings = known
    return central, field, list(warnings)


def forget() -> None:
    """Forget what was registered: for timings, of which each is to pay for itself."""
    _fields.clear()


class Remembered:
    """The fields that were asked for last, as many as fit; from any thread."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes
        self._lock = threading.Lock()
        self._bytes = 0
        self._known: OrderedDict[bytes, Registered] = OrderedDict()

    def get(self, key: bytes) -> Registered | None:
        """Return what is known, and keep it for longer."""
        with self._lock:
            if key in self._known:
                self._known.move_to_end(key)
            return self._known.get(key)

    def put(self, key: bytes, value: Registered) -> None:
        """Keep something new; what was asked for longest ago goes where it does not fit."""
        with self._lock:
            if key in self._known or _size(value) > self._most_bytes:
                return
            self._known[key] = value
            self._bytes += _size(value)
            while self._bytes > self._most_bytes:
                _, oldest = self._known.popitem(last=False)
                self._bytes -= _size(oldest)

    def clear(self) -> None:
        """Forget everything."""
        with self._lock:
            self._known.clear()
            self._bytes = 0


_fields = Remembered(REMEMBERED_BYTES)


def _size(value: Registered) -> int:
    return int(value[0].nbytes + value[1].psfs.nbytes)


def _content(calibration: Calibration, group: npt.NDArray[np.intp]) -> bytes:
    """Return a digest of everything that registering a depth depends on, and of what its warnings name."""
    psfs, positions = calibration.psfs, calibration.source_positions_um[group]
    words = (psfs.shape[1:], psfs.dtype.str, group.tolist(), calibration.geometry)
    digest = hashlib.blake2b(repr(words).encode(), digest_size=20)
    digest.update(np.ascontiguousarray(positions).data)
    for k in group:
        digest.update(np.ascontiguousarray(psfs[k]).data)
    return digest.digest()
