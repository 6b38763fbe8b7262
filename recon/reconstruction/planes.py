"""Which depths take part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from recon.camera.camera_model import Depths
from recon.errors import InputError
from recon.reconstruction.choice import Choice, Decision, Option
from recon.reconstruction.estimates import left_out_db
from recon.reconstruction.overrides import Overrides
from recon.reconstruction.probe import CoarsePass

LEFT_OUT = 0.02
"""Share of the coarse pass's light, of any channel, that all planes together that are left out may hold."""


def planes_of(passed: CoarsePass, depths: Depths, overrides: Overrides) -> tuple[tuple[int, ...], Decision]:
    """Decide which depths take part, by where a coarse pass finds light."""
    n = len(depths.z_um)
    everything = tuple(range(n))
    if n == 1:
        if isinstance(overrides.planes, tuple):
            _within(overrides.planes, n)
        return everything, Decision("planes", "1", "one depth was calibrated")
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
    loss = left_out_db(lost)
    numbers = {"planes": float(len(planes)), "of": float(n), "light_left_out": lost}
    up = None if len(planes) == n else Option(f"all {n}", n / len(planes), -loss)
    fewest = tuple(int(z) for z in np.flatnonzero(lit))
    down = None
    if len(fewest) < len(planes):
        down = Option(
            f"{len(fewest)} without their neighbours",
            len(fewest) / len(planes),
            left_out_db(_share(passed.light, ~lit)) - loss,
        )
    value = f"all {n}" if len(planes) == n else f"{len(planes)} of {n} ({_ranges(planes)})"
    return planes, Decision("planes", value, why, loss, up, down, asked, numbers)


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
        replace(d, value=value, why=why, error_db=0.0, up=None, down=None) if d.name == "planes" else d
        for d in choice.decisions
    )
    return replace(choice, planes=planes, decisions=decisions)


def _within(asked: tuple[int, ...], n: int) -> tuple[int, ...]:
    if max(asked) >= n:
        raise InputError(f"planes={_ranges(asked)}: the calibrated depths are numbered from 0 to {n - 1}.")
    return asked


def _most_of(light: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Return the fewest planes that hold all but ``LEFT_OUT`` of the light; all where there is none."""
    if not light.any():
        return np.ones(len(light), bool)
    order = np.argsort(-light, kind="stable")
    left = light.sum() - np.cumsum(light[order])
    chosen = np.zeros(len(light), bool)
    chosen[order[: int(np.argmax(left <= LEFT_OUT * light.sum())) + 1]] = True
    return chosen


def _share(light: npt.NDArray[np.float64], planes: npt.NDArray[np.bool_]) -> float:
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
