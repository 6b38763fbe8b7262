"""Depths between the calibrated ones, where something is and no calibrated PSF is like what it throws."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from recon.camera.camera_model import Depths
from recon.camera.refocus import refocus
from recon.errors import InputError
from recon.reconstruction.choice import Decision, Option
from recon.reconstruction.estimates import loss_db
from recon.reconstruction.overrides import Overrides
from recon.types import Calibration

Array = npt.NDArray[Any]

UNLIKE = 0.8
"""Inner product of the unit-energy PSFs of neighbouring depths below which a plane between them is worth its
time. Beads between planes gained 1.5 dB at 0.66 and nothing at 0.92."""
TOLD = 0.9
"""What a PSF made for a depth between them must be expected to agree to with one measured there."""


def between_of(
    calibration: Calibration, depths: Depths, planes: tuple[int, ...], overrides: Overrides
) -> tuple[tuple[int, ...], Decision]:
    """Decide between which depths a plane is added.

    Parameters
    ----------
    calibration : Calibration
    depths : Depths
        The calibration's.
    planes : tuple of int
        Depths that take part: nothing is added beside those that are left out.
    overrides : Overrides

    Returns
    -------
    tuple of int
        ``k`` for a plane half way, in 1/z, between depths ``k`` and ``k + 1``.
    Decision

    Raises
    ------
    InputError
        Where planes between are wished for and cannot be made.
    """
    gaps = [k for k in planes if k + 1 in planes]
    prevented = _prevented(calibration, depths)
    asked = overrides.between is not None
    if prevented is not None or not gaps:
        why = prevented or "no two neighbouring depths take part"
        if overrides.between:
            raise InputError(f"Planes cannot be added between depths (between=on): {why}.")
        return (), Decision("between", "no planes", why, overruled=asked)
    alike = {k: likeness(depths.central[k], depths.central[k + 1]) for k in gaps}
    worst = min(gaps, key=alike.__getitem__)
    unlike = tuple(k for k in gaps if alike[k] < UNLIKE)
    numbers = {"least_likeness": alike[worst]}
    why = f"PSFs of neighbouring depths agree to {alike[worst]:.2f} or more ({UNLIKE:g} is enough)"
    told = True
    if unlike or overrides.between:
        made = refocus(calibration, middle(depths, worst))
        expected = made.expected_similarity
        told = expected is not None and expected >= TOLD
        numbers["expected_likeness"] = float("nan") if expected is None else expected
        said = "of unknown likeness" if expected is None else f"expected to agree to {expected:.3f}"
        why = (
            f"PSFs of neighbouring depths agree to {alike[worst]:.2f} only ({UNLIKE:g} would be enough); "
            f"those made for depths between are {said} with measured ones ({TOLD:g} is asked of them)"
        )
    added = (tuple(gaps) if overrides.between else ()) if asked else (unlike if told else ())
    # An object half way is as far from each neighbour as these are from half way: half of their difference.
    loss = loss_db(0.5 * float(np.sqrt(2 * max(1 - alike[worst], 0.0))))
    n = len(planes)
    if added:
        down = Option("no planes", n / (n + len(added)), loss)
        value = f"{len(added)} plane{'s' if len(added) > 1 else ''}"
        return added, Decision("between", value, why, 0.0, None, down, asked, numbers)
    up = Option(f"{len(gaps)} planes", (n + len(gaps)) / n, -loss if told else float("nan"))
    return (), Decision("between", "no planes", why, loss if told else 0.0, up, None, asked, numbers)


def likeness(first: Array, second: Array) -> float:
    """Return the inner product of two images of unit energy."""
    a, b = (np.asarray(image, np.float64).ravel() for image in (first, second))
    return float(a @ b / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-300))


def middle(depths: Depths, k: int) -> float:
    """Return the depth half way, in 1/z, between two neighbours, micrometres."""
    return float(2 / (1 / depths.z_um[k] + 1 / depths.z_um[k + 1]))


def with_planes_between(calibration: Calibration, depths_um: Array, between: tuple[int, ...]) -> Calibration:
    """Return the calibration of one PSF a depth with refocused PSFs between depths ``k`` and ``k + 1``."""
    if not between:
        return calibration
    psfs, positions = [], []
    for k, (psf, position) in enumerate(zip(calibration.psfs, calibration.source_positions_um, strict=True)):
        psfs.append(psf)
        positions.append(position)
        if k in between:
            made = refocus(calibration, float(2 / (1 / depths_um[k] + 1 / depths_um[k + 1])))
            psfs.append(made.psf)
            positions.append(np.array([*made.source_um, made.z_um]))
    return replace(calibration, psfs=np.stack(psfs), source_positions_um=np.stack(positions))


def _prevented(calibration: Calibration, depths: Depths) -> str | None:
    z = depths.z_um
    steps = np.diff(z)
    if depths.varies or len(z) != len(calibration.psfs):
        return "PSFs that vary over the field are not brought to other depths"
    if not calibration.geometry.diffuser_distance_mm or not np.isfinite(z).all() or (z <= 0).any():
        return "the depths, or the distance from diffuser to sensor, are not known"
    if not ((steps > 0).all() or (steps < 0).all()):
        return "the depths are not in order"
    return None
