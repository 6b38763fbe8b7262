"""Which camera model a calibration asks for, and why."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt

from recon.arrays import Array, Float32Array, Float64Array
from recon.base.checks import select_psf
from recon.base.registry import Registry
from recon.camera.base import LinearOperator
from recon.camera.convolution import Convolution, field_of
from recon.camera.field_registration import NOT_ON_AXIS, departure, remembered_field
from recon.camera.varying_psfs import FieldOfPsfs, interpolation_weights, principal_psfs
from recon.errors import InputError
from recon.types import Calibration

ModelName = Literal["auto", "convolution", "local", "lowrank"]
MODELS: tuple[ModelName, ...] = ("auto", "convolution", "local", "lowrank")

TOLERATED = 0.05
"""Relative PSF error over the field below which one PSF a depth will do."""
SAME_DEPTH = 1e-3
"""Sources whose z differ by no more, relatively, were calibrated at one depth."""
SAME_PLACE_UM = 1.0
"""Sources nearer to one another in x and y were calibrated at one place."""
LOW_RANK_ERROR = 0.03
"""Relative PSF error that the low-rank model is built to."""


@dataclass(frozen=True, slots=True)
class Extent:
    """How much of the PSFs and of the field a reconstruction models.

    Attributes
    ----------
    psf_window : (int, int) or None
        Height and width of the central part of the PSFs; None: all of them.
    acceptance_px : float or None
        Only object pixels this near to the axis are modelled, where PSFs vary over the field; None: all.
    margin : float or None
        Where PSFs vary over the field only what lies between the outermost ones of each depth is modelled,
        and this part of the distance between these beyond them; None: all.
    left_out : Calibration or None
        PSFs of depths that are not modelled: what is left of the data is searched for light from there.
    beyond : int
        Of the depths, so many at the end stand for light from farther away than any that was calibrated.
    """

    psf_window: tuple[int, int] | None = None
    acceptance_px: float | None = None
    margin: float | None = None
    left_out: Calibration | None = None
    beyond: int = 0


@dataclass(frozen=True)
class Depths:
    """A calibration sorted by depth.

    Attributes
    ----------
    z_um : ndarray, (n_z,)
        Nearest last or first as the calibration has it; NaN where not known.
    central : ndarray, float32, (n_z, n_channels, height, width)
        The PSF nearest to the axis at each depth; where none is near, what the others show of it.
    fields : list of FieldOfPsfs
        All PSFs of each depth, registered to the central one.
    warnings : tuple of str
        Which PSFs could not be registered by their images, and were by their sources' places; depths
        without one near the axis.
    axis_um : ndarray, (n_z, 2), or None
        ``(x, y)`` that the middle of a picture looks at: where the central PSF's source was; 0 where that is
        not known.
    """

    z_um: Float64Array
    central: Float32Array
    fields: list[FieldOfPsfs]
    warnings: tuple[str, ...] = ()
    axis_um: Float64Array | None = None

    @property
    def varies(self) -> bool:
        """Whether any depth was calibrated at more than one place."""
        return any(len(f.points) > 1 for f in self.fields)

    @cached_property
    def field_error(self) -> float:
        """Root mean square difference of the registered PSFs from the central one, relative to it."""
        parts = [departure(*each) for each in zip(self.fields, self.central, strict=True)]
        differences, norms = np.sum(parts, axis=0)
        return float(np.sqrt(differences / norms)) if norms > 0 else 0.0

    def within(self, window: tuple[int, int]) -> Depths:
        """Return the depths with PSFs cut to a central window (height, width)."""
        cut = tuple(
            slice(n // 2 - m // 2, n // 2 - m // 2 + m)
            for n, m in zip(self.central.shape[2:], window, strict=True)
        )
        fields = [FieldOfPsfs(f.psfs[..., cut[0], cut[1]], f.points) for f in self.fields]
        return replace(self, central=self.central[..., cut[0], cut[1]], fields=fields)

    def divided(self, gains: Float32Array) -> Depths:
        """Return the depths with every depth's PSFs divided by a number, (n_z,)."""
        if (gains == 1).all():
            return self
        fields = [FieldOfPsfs(f.psfs / g, f.points) for f, g in zip(self.fields, gains, strict=True)]
        return replace(self, central=self.central / gains[:, None, None, None], fields=fields)


def sort_by_depth(calibration: Calibration) -> Depths:
    """Group a calibration's PSFs by depth and register those of a depth to its central one.

    PSFs whose depths are not known are taken for one depth each, in their order; those of one depth may
    differ by ``SAME_DEPTH`` (see :func:`members_of_depths`).
    """
    psfs, positions = calibration.psfs, calibration.source_positions_um
    if len(psfs) == 0:
        raise InputError("The calibration holds no PSF: a volume needs at least one depth.")
    members = members_of_depths(positions)
    z_um = np.array([float(np.mean(positions[group, 2])) for group in members])
    central, fields, warnings, axis_um = [], [], [], []
    for group in members:
        on_axis, field, trouble = remembered_field(calibration, group)
        central.append(on_axis)
        fields.append(field)
        warnings += trouble
        nearest = positions[calibration.nearest_to_axis(group), :2]
        axis_um.append(np.zeros(2) if NOT_ON_AXIS in trouble else np.nan_to_num(nearest))
    words = tuple(dict.fromkeys(warnings))
    return Depths(z_um, np.stack(central), fields, words, np.array(axis_um))


def members_of_depths(positions_um: Float64Array) -> list[npt.NDArray[np.intp]]:
    """Group sources (n, 3) by depth: index arrays, in the order in which the depths first appear.

    A stage does not come back to exactly the same z. Sources belong to one depth when they lie within
    ``SAME_DEPTH`` of the group's least z, relative to it, each at another place of the field: two at the same
    place were meant as two depths, however fine the steps.
    """
    z = positions_um[:, 2]
    if not np.isfinite(z).all():
        return [np.array([k]) for k in range(len(z))]
    groups: list[list[int]] = []
    for k in np.argsort(z, kind="stable"):
        group = groups[-1] if groups else []
        if group and z[k] - z[group[0]] <= SAME_DEPTH * abs(z[group[0]]):
            apart = np.abs(positions_um[group, :2] - positions_um[k, :2]).max(axis=1)
            # NaN stands for a place that is not known: not certainly another one.
            if (apart > SAME_PLACE_UM).all():
                group.append(int(k))
                continue
        groups.append([int(k)])
    return [np.sort(np.array(g)) for g in sorted(groups, key=min)]


def one_depth(calibration: Calibration, z_um: float | None) -> Calibration:
    """Return the part of a calibration at the depth nearest to ``z_um`` (in 1/z, as PSFs change).

    Raises InputError when there are several depths and none is asked for, or they are not known.
    """
    groups = members_of_depths(calibration.source_positions_um)
    if len(groups) > 1:
        _, chosen = select_psf(calibration, z_um)
        z = calibration.source_positions_um[:, 2]
        groups = [g for g in groups if chosen in z[g]]
    return calibration.part(groups[0])


@dataclass(frozen=True, kw_only=True)
class OfferedCamera:
    """A camera model as it is registered.

    Attributes
    ----------
    name, help : str
        ``name`` is what the option ``model`` takes.
    make : callable
        ``make(central, depths)`` returns the operator of one channel: domain (1, n_z, height, width) and
        range (1, sensor height, sensor width) of ``central``, the convolution with each depth's central PSF
        in the problem's units, which solvers precondition with.
    refuses : callable, optional
        ``refuses(depths)`` returns why a calibration does not give such a camera; None where it does.
    """

    name: str
    help: str
    make: Callable[[Convolution, Depths], LinearOperator]
    refuses: Callable[[Depths], str | None] = lambda _: None


CAMERAS: Registry[OfferedCamera] = Registry("camera model", "diffuserbench.cameras", tuple)
"""Camera models of others. The project's own three share their PSFs' preparation: :data:`MODELS`."""


def model_names() -> tuple[str, ...]:
    """Return the camera models that can be asked for, those of others among them."""
    return (*MODELS, *CAMERAS)


def choose_model(depths: Depths, wanted: ModelName) -> tuple[ModelName, str]:
    """Return the model to use and the reason in words, without comparing what the models cost."""
    if wanted not in model_names():
        raise InputError(f"The model {wanted!r} is not known. Choose one of {', '.join(model_names())}.")
    if wanted in CAMERAS and (reason := CAMERAS[wanted].refuses(depths)) is not None:
        raise InputError(f"The {wanted} model does not take this calibration: {reason}.")
    if wanted in ("local", "lowrank") and not depths.varies:
        raise InputError(
            f"The {wanted} model needs PSFs from several places of the field; this calibration has one "
            "a depth. Calibrate on a grid, or use the convolution model."
        )
    if wanted != "auto":
        return wanted, "as asked"
    if not depths.varies:
        return "convolution", "one PSF a depth was calibrated"
    error = depths.field_error
    if error <= TOLERATED:
        return "convolution", f"PSFs differ by {error:.1%} over the field, no more than {TOLERATED:.0%}"
    densest = max(depths.fields, key=lambda f: len(f.points))
    rank = len(principal_psfs(densest, error=LOW_RANK_ERROR).components)
    # A whole-frame convolution costs about as much as all cells of the local model together.
    if rank <= 3 and rank < len(densest.points):
        return "lowrank", f"PSFs differ by {error:.1%} over the field; {rank} components tell all but 3 %"
    return "local", f"PSFs differ by {error:.1%} over the field, and it would take {rank} components"


LEAST_GAIN = 0.01
"""Least brightness relative to a depth's central PSF that is made up for: below it there is only noise."""


def energies(psfs: Array) -> Float64Array:
    """Return the sum of squares of every PSF, (n_z, n_channels): plane by plane, for memory's sake."""
    return np.array([np.sum(psf.astype(np.float64) ** 2, axis=(1, 2)) for psf in psfs])


def plane_gains(depths: Depths) -> Float32Array:
    """Return the energy of every depth's central PSF, relative to their root mean square, (n_z,)."""
    energy = np.sqrt(np.sum(energies(depths.central), axis=1))
    relative = energy * np.sqrt(len(energy)) / max(float(np.linalg.norm(energy)), 1e-30)
    return np.where(relative > 0, relative, 1.0).astype(np.float32)


def levelled(depths: Depths, sensor_shape: tuple[int, int], *, varying: bool) -> tuple[Depths, Float32Array]:
    """Bring all PSFs to one brightness: what l1 counts is then the light that falls on the sensor.

    A voxel whose PSF is brighter explains the same data with less of itself. Under a prior that counts
    voxels' own brightness it is the cheaper explanation: near planes draw light from far ones, and the
    field's middle from its edge, where the sensor accepts little. So the PSFs of l1 are brought to one
    brightness, and the solution back afterwards. Where the response fell to a twentieth at the field's edge,
    this gained 4 dB on volumes of beads.

    Parameters
    ----------
    depths : Depths
    sensor_shape : (int, int)
    varying : bool
        Whether the PSFs that vary over the field are used; else those of a depth share one factor.

    Returns
    -------
    Depths
        With every PSF divided by its gain.
    ndarray, float32, (n_z, field height, field width) or (n_z, 1, 1)
        The gains, between calibrated places as the models interpolate their PSFs: the solution with the
        levelled PSFs divided by these is one for the PSFs as they were.
    """
    planes = plane_gains(depths)
    if not varying:
        return depths.divided(planes), planes[:, None, None]
    (height, width) = depths.central.shape[2:]
    field_shape, centre = field_of(sensor_shape, (height, width))
    rows, columns = (np.arange(n) - c for n, c in zip(field_shape, centre, strict=True))
    fields, maps = [], []
    for field, central, plane in zip(depths.fields, depths.central, planes, strict=True):
        power = max(float(np.vdot(central, central)), 1e-30)
        seen = np.array([float(np.vdot(psf, central)) / power for psf in field.psfs])
        gains = float(plane) * np.clip(seen, LEAST_GAIN, None)
        fields.append(FieldOfPsfs(field.psfs / gains[:, None, None, None].astype(np.float32), field.points))
        maps.append(interpolation_weights(field.points, gains[:, None], rows, columns)[0])
    even = replace(depths, central=depths.central / planes[:, None, None, None], fields=fields)
    return even, np.stack(maps).astype(np.float32)
