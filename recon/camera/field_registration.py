"""PSFs of one depth brought to lie on one another, wherever over the field they were measured.

Registering is the slowest part of a small problem, and choosing a model, the reconstruction and the next one
with the same calibration ask for the same: what was registered last is remembered, by its content.
"""

from __future__ import annotations

import hashlib
import threading
from collections import OrderedDict
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, BoolArray, Float32Array
from recon.camera.registration import Registration, aligned, expected_shift, moved, register
from recon.camera.varying_psfs import FieldOfPsfs, interpolation_weights
from recon.errors import InputError
from recon.types import Calibration

Group = npt.NDArray[np.intp]

_SEARCH_PX, _SEARCH_PART = 16.0, 0.1
"""A PSF is looked for this many pixels, and this part of its displacement, about where its source says."""
NEAR_AXIS = 0.25
"""A source counts as on the axis up to this part of its distance from the next: of grids with an odd number
of points a side the middle one does, whatever the stage's offset; of even ones none does."""
NOT_ON_AXIS = (
    "No PSF was measured near the axis. The pattern there was put together from what the sensor shows of the "
    "others; measure one on the axis (a grid with an odd number of points a side has one)."
)
LEAST_COMMON = 0.1
"""Part of the sensor that must show the same of two patterns for one to be registered to the other: in
narrower strips, as between a grid's far corners, a chance likeness stands out as much as the true one."""
BY_PLACE = "it was placed by its source's position (Kuo 2020, Eq. 5.2)."
_LAST_RESORT = 1e-6
"""Weight of PSFs far from the axis in its pattern: they count where no nearer one shows anything."""


def registered_field(calibration: Calibration, group: Group) -> tuple[Array, FieldOfPsfs, list[str]]:
    """Register the PSFs of one depth, between pixels.

    They are registered to the one nearest to the axis. Where that is far from it, all are brought to the axis
    by the sources' places (Kuo 2020, Eq. 5.2): else the picture would be centred on that source, with most of
    the field beyond its edge, and patterns at the field's other end would miss all that the sensor's edge cut
    off from that one. The pattern on the axis is then put together from what each photograph shows of it.

    Parameters
    ----------
    calibration : Calibration
    group : ndarray of int
        PSFs of one depth.

    Returns
    -------
    ndarray, float32, (n_channels, height, width)
        The pattern on the axis.
    FieldOfPsfs
        All PSFs, registered to it, and what their photographs do not show filled in from it.
    list of str
        Which PSFs could not be registered by their images, and were by their sources' places; and where none
        stands near the axis.

    Raises InputError when a PSF can be registered neither by its image nor by its source's place.
    """
    if len(group) == 1:
        alone = calibration.psfs[group]
        return alone[0], FieldOfPsfs(alone, [(0.0, 0.0)]), []
    central = calibration.nearest_to_axis(group)
    reference = calibration.psfs[central]
    found, warnings = [], []
    for k in group:
        at, trouble = _found(calibration, int(k), central)
        found.append(at)
        warnings += trouble
    origin = _axis_from(calibration, group, central)
    if origin is None:
        psfs = [
            calibration.psfs[k]
            if k == central
            else filled_in(aligned(calibration.psfs[k], at), reference, at)
            for k, at in zip(group, found, strict=True)
        ]
    else:
        found = [replace(at, rows=at.rows + origin[0], columns=at.columns + origin[1]) for at in found]
        moved = [aligned(calibration.psfs[k], at) for k, at in zip(group, found, strict=True)]
        reference = _on_axis(moved, found)
        psfs = [filled_in(psf, reference, at) for psf, at in zip(moved, found, strict=True)]
        warnings.append(NOT_ON_AXIS)
    points = [(at.rows, at.columns) for at in found]
    return reference, FieldOfPsfs(np.stack(psfs), points), warnings


def one_psf(calibration: Calibration) -> Array:
    """Return the pattern on the axis of PSFs of one depth, (n_channels, height, width).

    The nearest PSF as it is, or put together where none is near (see :func:`registered_field`).
    """
    group = np.arange(len(calibration.psfs))
    central = calibration.nearest_to_axis()
    if _axis_from(calibration, group, central) is None:
        return np.asarray(calibration.psfs[central])
    return registered_field(calibration, group)[0]


def shown(shape: tuple[int, ...], rows: float, columns: float) -> BoolArray:
    """Tell which pixels of a PSF registered from a displacement were photographed.

    Registration between pixels mixes the outermost row and column with the dark beyond: they do not count.
    """
    inside = []
    for n, by in zip(shape, (rows, columns), strict=True):
        place = np.arange(n) + by
        inside.append((place >= (by != round(by))) & (place <= n - 1 - (by != round(by))))
    return np.asarray(inside[0][:, None] & inside[1])


def _found(calibration: Calibration, k: int, central: int) -> tuple[Registration, list[str]]:
    """Return how PSF ``k`` lies on the central one, and what has to be said of it."""
    if k == central:
        return Registration(0.0, 0.0, 1.0, 1.0, np.inf), []
    near = _expected(calibration, k, central)
    psfs = calibration.psfs
    x, y, z = calibration.source_positions_um[k]
    trouble = (
        f"PSF {k} (source at x = {x:g}, y = {y:g}, z = {z:g} um) cannot be registered to PSF {central}: "
    )
    if near is not None and shown(psfs.shape[2:], *near).mean() < LEAST_COMMON:
        placed = f"{trouble}the sensor shows too little that both have in common; {BY_PLACE}"
        return Registration(*near, 1.0, 0.0, 0.0), [placed]
    reach = _SEARCH_PX if near is None else _SEARCH_PX + _SEARCH_PART * float(np.hypot(*near))
    found = register(psfs[k].mean(axis=0), psfs[central].mean(axis=0), near=near, within_px=reach)
    if found.reliable:
        return found, []
    trouble += f"its correlation has no peak that stands out ({found.prominence:.2f} times the next)"
    if near is None:
        raise InputError(f"{trouble}. Leave it out, or take it again with more light or nearer to the axis.")
    return replace(found, rows=near[0], columns=near[1]), [f"{trouble}; {BY_PLACE}"]


def _axis_from(calibration: Calibration, group: Group, central: int) -> tuple[float, float] | None:
    """Return how far the central PSF's pattern lies off the axis; None where it is near, or not known."""
    off = _off_axis(calibration, central)
    away = [_expected(calibration, int(k), central) for k in group if k != central]
    others = [max(map(abs, by)) for by in away if by is not None]
    if off is None or not others or len(others) < len(away) or max(map(abs, off)) <= NEAR_AXIS * min(others):
        return None
    return off


def _on_axis(moved: list[Array], found: list[Registration]) -> Array:
    """Return the pattern on the axis: PSFs as the local model weights them there, each where it shows it."""
    points = np.array([(at.rows, at.columns) for at in found])
    weights = interpolation_weights(points, np.eye(len(points)), [0.0], [0.0])[:, 0, 0]
    light = np.zeros_like(moved[0], np.float64)
    total = np.zeros(moved[0].shape[1:])
    for psf, at, weight in zip(moved, found, weights + _LAST_RESORT, strict=True):
        seen = shown(psf.shape[1:], at.rows, at.columns)
        light += weight * np.where(seen, psf, 0)
        total += weight * seen
    return np.asarray(light / np.where(total > 0, total, 1), np.float32)


def filled_in(psf: Array, reference: Array, found: Registration) -> Array:
    """Fill in what a registered PSF's photograph did not show: the axis's, as bright as the rest says.

    A source at the field's edge throws part of its pattern beside the sensor. Seen from there that part is
    never missed, but sources between it and the axis, which the local model takes from both, throw it onto
    the sensor. How bright it is there is a line through the ratio of both PSFs where both show.
    """
    height, width = psf.shape[1:]
    rows, columns = np.arange(height)[:, None], np.arange(width)
    seen = shown((height, width), found.rows, found.columns)
    if seen.all() or not seen.any():
        return psf
    terms = np.broadcast_arrays(np.ones(()), rows / height - 0.5, columns / width - 0.5, np.zeros(seen.shape))
    completed = psf.copy()
    for image, central in zip(completed, reference, strict=True):
        light = image[seen].astype(np.float64)
        basis = np.stack([t[seen] * central[seen] for t in terms[:3]])
        power = float(basis[0] @ basis[0])
        if power == 0:
            continue
        mean = max(float(basis[0] @ light) / power, 0.0)
        coefficients = np.linalg.lstsq(basis.T, light, rcond=1e-3)[0]
        gain = np.clip(sum(c * t for c, t in zip(coefficients, terms, strict=False)), 0, 1.5 * mean)
        image[~seen] = (gain * central)[~seen]
    return completed


def _expected(calibration: Calibration, k: int, central: int) -> tuple[float, float] | None:
    """Displacement of PSF ``k`` from the central one by the sources' places; None where not known."""
    own, other = _off_axis(calibration, k), _off_axis(calibration, central)
    return None if own is None or other is None else (own[0] - other[0], own[1] - other[1])


def _off_axis(calibration: Calibration, k: int) -> tuple[float, float] | None:
    """Displacement of PSF ``k`` from the axis by its source's place; None where not known."""
    geometry, position = calibration.geometry, calibration.source_positions_um[k]
    if not geometry.diffuser_distance_mm or not geometry.pixel_pitch_um or not np.isfinite(position).all():
        return None
    x, y, z = position.tolist()
    return expected_shift((x, y, z), 1e3 * geometry.diffuser_distance_mm, geometry.pixel_pitch_um)


Registered = tuple[Array, FieldOfPsfs, list[str]]

REMEMBERED_BYTES = 128 * 2**20
"""PSFs that are remembered: 50 of 800 x 800 pixels. Larger calibrations are registered anew: a part of
one would push out the part that is asked for next."""


def remembered_field(calibration: Calibration, group: npt.NDArray[np.intp]) -> Registered:
    """Return what :func:`registered_field` does, registering what is new.

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


_departures: WeakKeyDictionary[FieldOfPsfs, tuple[bytes, float, float]] = WeakKeyDictionary()


def departure(field: FieldOfPsfs, central: Float32Array) -> tuple[float, float]:
    """Return the squares of what a field's PSFs differ by from a central one, and of what that would show.

    ``central``, (n_channels, height, width); what was asked last of a field is remembered.
    """
    key = hashlib.blake2b(central.tobytes(), digest_size=16).digest()
    known = _departures.get(field)
    if known is None or known[0] != key:
        differences = norms = 0.0
        for psf, (rows, columns) in zip(field.psfs, field.points, strict=True):
            # There and back between pixels as the registered one came, so that interpolation is no error.
            seen = moved(moved(central, rows, columns), -rows, -columns)
            there = shown(psf.shape[1:], rows, columns)
            differences += float(np.sum((psf - seen)[:, there].astype(np.float64) ** 2))
            norms += float(np.sum(seen[:, there].astype(np.float64) ** 2))
        known = key, differences, norms
        _departures[field] = known
    return known[1:]


def forget() -> None:
    """Forget what was registered: for timings, of which each is to pay for itself."""
    _fields.clear()
    _departures.clear()


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
