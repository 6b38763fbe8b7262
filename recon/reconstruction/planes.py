"""Which depths take part: where light is, between unlike ones, and back where some was left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from recon.analysis.correlation import similarity
from recon.arrays import Array, BoolArray, Float64Array
from recon.camera.camera_model import Depths, members_of_depths
from recon.camera.refocus import refocus
from recon.camera.refocus_field import refocus_field
from recon.camera.registration import rescaled
from recon.errors import InputError
from recon.priors import PRIORS, Prior, TotalVariation
from recon.reconstruction.choice import Choice, Decision
from recon.reconstruction.options import Overrides
from recon.reconstruction.part import Part
from recon.reconstruction.probe import CoarsePass
from recon.types import Calibration

LEFT_OUT = 0.02
"""Share of the coarse pass's light, of any channel, that all planes together that are left out may hold."""
UNLIKE = 0.8
"""Inner product of the unit-energy PSFs of neighbouring depths below which a plane between them is worth its
time. Beads between planes gained 1.5 dB at 0.66 and nothing at 0.92."""
MADE_ALIKE = 0.9
"""What a PSF made for a depth between them must be expected to agree to with one measured there."""
BEYOND = (0.97, 0.94, 0.88, 0.76, 0.52, 0.25)
"""Sizes of the patterns of light from beyond the farthest depth, relative to that depth's. Thin diffusers
shrink them with distance, down to some 0.9; the smaller ones stand for light scattered or not bent."""
TV_LEAVES = 2.0
"""How many times noise's reach total variation leaves unexplained: up to 1.4 times where planes were left out
rightly, from 2.6 times where wrongly, on two scenes of beads, each with one PSF and with nine a depth."""


def planes_of(
    passed: CoarsePass | None, depths: Depths, overrides: Overrides
) -> tuple[tuple[int, ...], Decision]:
    """Decide which depths take part, by where a coarse pass finds light."""
    n = len(depths.z_um)
    everything = tuple(range(n))
    if n == 1 or passed is None:
        if isinstance(overrides.planes, tuple):
            _within(overrides.planes, n)
        return everything, Decision("planes", "1", "one depth was calibrated", open=False)
    lit = np.any([_most_of(light) for light in passed.light], axis=0)
    # The coarse pass may take a plane for its neighbour: those of lit planes stay.
    order = np.argsort(depths.z_um) if np.isfinite(depths.z_um).all() else np.arange(n)
    near = lit[order].copy()
    near[1:] |= lit[order][:-1]
    near[:-1] |= lit[order][1:]
    kept = np.zeros(n, bool)
    kept[order] = near
    asked = overrides.planes is not None
    planes = tuple(int(z) for z in np.flatnonzero(kept))
    if overrides.planes is not None:
        planes = _within(overrides.planes, n) if isinstance(overrides.planes, tuple) else everything
        kept = np.isin(np.arange(n), planes)
    lost = _share(passed.light, ~kept)
    channel = " of any colour" if len(passed.light) > 1 else ""
    rest = n - int(kept.sum())
    why = (
        f"of {n} calibrated depths a coarse pass puts {lost:.1%} of the light{channel} into the {rest} left "
        f"out ({LEFT_OUT:.0%} may be left out, and neighbours of those that are not stay)"
        if rest
        else f"a coarse pass finds more than {LEFT_OUT:.0%} of the light{channel} in whatever could be left "
        "out, or in its neighbours"
    )
    numbers = {"planes": float(len(planes)), "of": float(n), "light_left_out": lost}
    up = None if len(planes) == n else f"all {n}"
    fewest = tuple(int(z) for z in np.flatnonzero(lit))
    down = f"{len(fewest)} without their neighbours" if len(fewest) < len(planes) else None
    value = f"all {n}" if len(planes) == n else f"{len(planes)} of {n} ({_ranges(planes)})"
    return planes, Decision("planes", value, why, up, down, asked, numbers)


def put_back(choice: Choice, signs: Sequence[float], *, everything: bool) -> Choice | None:
    """Return the choice with planes that show signs of light, and their neighbours; None where none does.

    Parameters
    ----------
    choice : Choice
    signs : sequence of float
        Of every plane that was left out, in order: above 1 where the residual shows light there.
    everything : bool
        Put all back, not only those.
    """
    rest = [z for z in range(choice.n_planes) if z not in choice.planes]
    shown = [z for z, sign in zip(rest, signs, strict=False) if sign > 1]
    if not shown:
        return None
    near = {z + by for z in shown for by in (-1, 0, 1)} & set(rest)
    planes = tuple(sorted({*choice.planes, *(rest if everything else near)}))
    n = choice.n_planes
    value = f"all {n}" if len(planes) == n else f"{len(planes)} of {n} ({_ranges(planes)})"
    why = (
        f"{_ranges(choice.planes)} were tried, and what they left of the data correlates with the PSFs of "
        f"{_ranges(tuple(shown))} {max(signs):.1f} times as much as noise and prior explain"
    )
    decisions = tuple(
        replace(d, value=value, why=why, up=None, down=None) if d.name == "planes" else d
        for d in choice.decisions
    )
    return replace(choice, planes=planes, decisions=decisions)


def _within(asked: tuple[int, ...], n: int) -> tuple[int, ...]:
    if max(asked) >= n:
        raise InputError(f"planes={_ranges(asked)}: the calibrated depths are numbered from 0 to {n - 1}.")
    return asked


def _most_of(light: Float64Array) -> BoolArray:
    """Return the fewest planes that hold all but ``LEFT_OUT`` of the light; all where there is none."""
    if not light.any():
        return np.ones(len(light), bool)
    order = np.argsort(-light, kind="stable")
    left = light.sum() - np.cumsum(light[order])
    chosen = np.zeros(len(light), bool)
    chosen[order[: int(np.argmax(left <= LEFT_OUT * light.sum())) + 1]] = True
    return chosen


def _share(light: Float64Array, planes: BoolArray) -> float:
    """Largest share of any channel's light in some planes."""
    return float(light[:, planes].sum(axis=1).max())


def _ranges(planes: tuple[int, ...]) -> str:
    """Say indices briefly: ``0-2, 5``."""
    parts: list[list[int]] = []
    for z in planes:
        if parts and parts[-1][-1] == z - 1:
            parts[-1].append(z)
        else:
            parts.append([z])
    return ", ".join(f"{p[0]}-{p[-1]}" if len(p) > 1 else str(p[0]) for p in parts)


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

    Raises InputError where planes between are wished for and cannot be made.
    """
    gaps = [k for k in planes if k + 1 in planes]
    prevented = _prevented(calibration, depths)
    asked = overrides.between is not None
    if prevented is not None or not gaps:
        why = prevented or "no two neighbouring depths take part"
        if overrides.between:
            raise InputError(f"Planes cannot be added between depths (between=on): {why}.")
        return (), Decision("between", "no planes", why, overruled=asked, open=False)
    alike = {k: similarity(depths.central[k], depths.central[k + 1]) for k in gaps}
    worst = min(gaps, key=alike.__getitem__)
    unlike = tuple(k for k in gaps if alike[k] < UNLIKE)
    numbers = {"least_likeness": alike[worst]}
    why = f"PSFs of neighbouring depths agree to {alike[worst]:.2f} or more ({UNLIKE:g} is enough)"
    told = not depths.varies
    if depths.varies:
        why += "; of PSFs that vary over the field none are added unless asked for"
    elif unlike or overrides.between:
        made = refocus(calibration, middle(depths.z_um, worst))
        expected = made.expected_similarity
        told = expected is not None and expected >= MADE_ALIKE
        numbers["expected_likeness"] = float("nan") if expected is None else expected
        said = "of unknown likeness" if expected is None else f"expected to agree to {expected:.3f}"
        why = (
            f"PSFs of neighbouring depths agree to {alike[worst]:.2f} only ({UNLIKE:g} would be enough); "
            f"those made for depths between are {said} with measured ones ({MADE_ALIKE:g} is asked of them)"
        )
    added = (tuple(gaps) if overrides.between else ()) if asked else (unlike if told else ())
    if added:
        value = f"{len(added)} plane{'s' if len(added) > 1 else ''}"
        return added, Decision("between", value, why, None, "no planes", asked, numbers)
    more = None if depths.varies and not asked else f"{len(gaps)} planes"
    return (), Decision("between", "no planes", why, more, None, asked, numbers, open=more is not None)


def middle(depths_um: Array, k: int) -> float:
    """Return the depth half way, in 1/z, between two neighbours, micrometres."""
    return float(2 / (1 / depths_um[k] + 1 / depths_um[k + 1]))


def with_planes_between(calibration: Calibration, depths_um: Array, between: tuple[int, ...]) -> Calibration:
    """Return the calibration with PSFs between depths ``k`` and ``k + 1``, as many as these have."""
    if not between:
        return calibration
    parts = []
    for k, group in enumerate(members_of_depths(calibration.source_positions_um)):
        parts.append(calibration.part(group))
        if k in between:
            parts.append(refocus_field(calibration, middle(depths_um, k)))
    psfs = np.concatenate([part.psfs for part in parts])
    positions = np.concatenate([part.source_positions_um for part in parts])
    return replace(calibration, psfs=psfs, source_positions_um=positions)


def _prevented(calibration: Calibration, depths: Depths) -> str | None:
    z = depths.z_um
    steps = np.diff(z)
    if not calibration.geometry.diffuser_distance_mm or not np.isfinite(z).all() or (z <= 0).any():
        return "the depths, or the distance from diffuser to sensor, are not known"
    if not ((steps > 0).all() or (steps < 0).all()):
        return "the depths are not in order"
    return None


def no_beyond(prior: str | Prior, model: str, n_planes: int) -> str | None:
    """Return why no planes can be added beyond the farthest depth, in words; None where they can."""
    if n_planes == 1:
        return "one depth was calibrated"
    if model != "convolution":
        return "PSFs that vary over the field are not brought to other depths"
    if isinstance(prior, Prior) or not PRIORS.is_own(prior):
        return "a prior from outside may tie depths to one another"
    loose = PRIORS[prior].kind == "l1" or not PRIORS[prior].weighted
    if not loose and not any(isinstance(t, TotalVariation) for t in PRIORS[prior](1.0).terms()):
        return f"the prior {prior} ties depths to one another"
    return None


def with_planes_beyond(calibration: Calibration, of: Calibration | None = None) -> Calibration:
    """Return a calibration with :data:`BEYOND` after its depths: the farthest one's light, smaller patterns.

    The farthest depth has the smallest pattern, where depths are not known.

    Parameters
    ----------
    calibration : Calibration
    of : Calibration, optional
        With all depths, where the first has lost some.
    """
    of = of or calibration
    positions = of.source_positions_um
    ends = [_on_axis(of, group) for group in members_of_depths(positions)]
    z_um = positions[ends, 2]
    if np.isfinite(z_um).all():
        end = ends[int(np.argmax(z_um))]
    else:
        end = min((ends[0], ends[-1]), key=lambda k: _spread(of.psfs[k]))
    made = np.stack([rescaled(of.psfs[end], 1 / size) / np.float32(size**2) for size in BEYOND])
    places = np.repeat(positions[end][None], len(BEYOND), axis=0)
    places[:, 2] /= BEYOND  # told apart, and from the others
    return replace(
        calibration,
        psfs=np.concatenate([calibration.psfs, made]),
        source_positions_um=np.concatenate([calibration.source_positions_um, places]),
    )


def _on_axis(calibration: Calibration, group: npt.NDArray[np.intp]) -> int:
    """Return which source of a depth lies nearest to the axis."""
    x, y = calibration.source_positions_um[group, :2].T
    return int(group[int(np.argmin(np.nan_to_num(np.hypot(x, y))))])


def _spread(psf: Array) -> float:
    """Return the mean squared distance of a PSF's light from its middle, pixels squared."""
    light = psf.sum(axis=0, dtype=np.float64)
    light = light / max(float(light.sum()), 1e-30)
    total = 0.0
    for axis, n in enumerate(light.shape):
        profile, places = light.sum(axis=1 - axis), np.arange(n)
        total += float(profile @ (places - profile @ places) ** 2)
    return total


def signs_of_light(
    residual: Array, left_out: Calibration, channel: int, window: tuple[int, int] | None
) -> Float64Array:
    """Return the largest correlation of a residual with every left-out plane's unit-energy central PSF.

    Parameters
    ----------
    residual : ndarray, (height, width)
        In units of the noise, so that white noise alone correlates with deviation 1.
    left_out : Calibration
    channel : int
    window : (int, int) or None
        Central part of the PSFs to take.
    """
    from scipy.signal import fftconvolve

    signs = []
    for group in members_of_depths(left_out.source_positions_um):
        psfs = left_out.psfs[_on_axis(left_out, group)]
        psf = psfs[channel if len(psfs) > 1 else 0].astype(np.float64)
        for axis, m in enumerate(window or psf.shape):
            first = psf.shape[axis] // 2 - m // 2
            psf = np.take(psf, np.arange(first, first + m), axis=axis)
        energy = float(np.linalg.norm(psf))
        correlation = fftconvolve(residual.astype(np.float64), psf[::-1, ::-1] / max(energy, 1e-30))
        signs.append(max(float(correlation.max()), 0.0))
    return np.array(signs)


def limit_of(part: Part) -> float:
    """Return what noise alone reaches, or the prior holds down: no sign of light."""
    noise = float(np.sqrt(2 * np.log(np.prod(part.camera.domain_shape)))) + 1
    return max(noise * (TV_LEAVES if part.problem.prior_name.startswith("tv") else 1.0), part.weight)


def signs_in_words(signs: Sequence[float]) -> list[str]:
    """Return a warning where a plane's sign, relative to its limit, exceeds 1."""
    if not len(signs) or max(signs) <= 1:
        return []
    return [
        "There may be light in the depth planes that were left out: what is left of the data correlates with "
        f"their PSFs {max(signs):.1f} times as much as noise and prior explain. Keep all planes "
        "(--choose planes=all) to see."
    ]
