"""What a reconstruction can be asked for, declared once (see :mod:`recon.base.declare`)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy.typing as npt

from recon.base.declare import option
from recon.base.namespace import DEVICES, Device
from recon.camera.camera_model import ModelName, model_names
from recon.errors import InputError
from recon.priors import PRIORS, Prior
from recon.reconstruction.overrides import PRECISIONS, Overrides, Precision

Field = Literal["sensor", "full"]

_MAIN, _STOP, _CHOICE, _COMPUTE, _RARE = "Scene", "When to stop", "Camera model", "Computing", "Rarely needed"


def _priors() -> tuple[str, ...]:
    return tuple(PRIORS)


def _solvers() -> tuple[str, ...]:
    from recon.reconstruction.solvers import SOLVERS

    return ("auto", *SOLVERS)


def _replaced() -> Mapping[str, str]:
    from recon.reconstruction.solvers import REPLACED

    return REPLACED


def _overrides(words: Sequence[str]) -> Overrides:
    """Read ``NAME=VALUE`` each."""
    pairs = {}
    for word in words:
        name, equals, value = word.partition("=")
        if not equals:
            raise InputError(f"{word!r} is not understood; write NAME=VALUE, say binning=1.")
        pairs[name.strip()] = value.strip()
    return Overrides.parse(pairs)


@dataclass(frozen=True, kw_only=True)
class ReconstructionOptions:
    """How to reconstruct; the defaults need no tuning. ``Options`` for short in :mod:`recon`."""

    prior: str | Prior | None = option(
        None,
        help="What the scene is like.",
        default_words="tv; none for wiener",
        choices=_priors,
        group=_MAIN,
    )
    tau: float | None = option(
        None,
        help="Weight of the prior, relative to max |A^H b| (any exposure).",
        default_words="from the noise",
        least=0,
        below=float("inf"),
        metavar="X",
        group=_MAIN,
    )
    z_um: float | None = option(
        None,
        help="Distance of the scene; a PSF is refocused to it.",
        unit="um",
        shown_unit="mm",
        shown_factor=1000.0,
        above=0,
        flags=("--z-mm",),
        label="Distance",
        group=_MAIN,
        applies=("picture", "video", "live picture", "patterned picture"),
    )
    solver: str = option(
        "auto",
        help="Algorithm.",
        choices=_solvers,
        flags=("--solver", "--method", "-m"),
        group=_MAIN,
        replaced=_replaced,
        applies=("picture", "volume", "video", "live picture"),
    )
    iterations: int | None = option(
        None,
        help="At most so many iterations.",
        default_words="200, or none with a time limit",
        least=1,
        flags=("--iterations", "-n"),
        metavar="N",
        group=_STOP,
        applies=("picture", "volume", "video", "patterned picture"),
        identifies=False,
    )
    time_s: float | None = option(
        None,
        help="At most so many seconds.",
        unit="s",
        above=0,
        flags=("--time",),
        metavar="S",
        group=_STOP,
        applies=("picture", "volume", "video"),
        identifies=False,
    )
    tolerance: float | None = option(
        None,
        help="Stop when the relative change an iteration falls below it (and residuals below ten times it). "
        "0: never.",
        default_words="the solver's own",
        least=0,
        metavar="X",
        group=_STOP,
        applies=("picture", "volume", "video"),
        identifies=False,
    )
    stop_at_noise: bool = option(
        False,
        help="Stop as soon as the residual is down to the expected noise.",
        group=_STOP,
        applies=("picture", "volume"),
        identifies=False,
    )
    model: ModelName = option(
        "auto",
        help="local, lowrank: PSFs that vary over the field; auto: the smallest that explains the data.",
        choices=model_names,
        group=_CHOICE,
        applies=("picture", "volume", "video", "live picture"),
    )
    choose: Overrides | None = option(
        None,
        help="Overrule one of auto's choices (repeatable): model=, planes=all|0-3,7, between=on|off, "
        "field=all, binning=N, channels=all|merged, background=on|off, precision=float32|float64.",
        metavar="NAME=VALUE",
        group=_CHOICE,
        parse_all=_overrides,
        applies=("picture", "volume"),
    )
    estimate_background: bool | None = option(
        None,
        help="Smooth background, too.",
        default_words="auto decides; else for volumes",
        flags=("--background/--no-background",),
        label="Smooth background",
        group=_CHOICE,
        applies=("picture", "volume", "video", "live picture"),
    )
    positive_background: bool = option(
        False,
        help="A background that is nowhere negative; up to three more runs.",
        group=_RARE,
        applies=("picture", "volume"),
    )
    axis_weights: npt.ArrayLike | None = option(
        None,
        help="Weights of the z, y and x differences of TV, (3,) or (n_z, 3).",
        default_words="by the voxels' shape",
        flags=("",),
        group=_RARE,
    )
    field: Field = option(
        "sensor",
        help="Return the part opposite to the sensor, or everything that can reach it.",
        choices=("sensor", "full"),
        flags=("",),
        group=_RARE,
    )
    drop_empty: bool = option(
        True,
        help="With l1: leave out depth planes that stay empty, and certify it.",
        flags=("",),
        group=_RARE,
    )
    device: Device = option(
        "cpu",
        help="Where to compute.",
        choices=DEVICES,
        group=_COMPUTE,
        applies=("picture", "volume", "live picture"),
    )
    precision: Literal["auto"] | Precision = option(
        "auto",
        help="auto: float32, unless that would show. float64: twice the memory, up to twice the time.",
        choices=("auto", *PRECISIONS),
        group=_COMPUTE,
        applies=("picture", "volume", "live picture"),
    )
    memory_gib: float | None = option(
        None,
        help="Memory that may be taken.",
        default_words="what is free",
        unit="GiB",
        above=0,
        flags=("--memory",),
        metavar="GIB",
        group=_COMPUTE,
        recorded=False,
        applies=("picture", "volume", "live picture"),
    )
    scratch: Path | None = option(
        None,
        help="Where to keep what does not fit into memory, on a fast disk.",
        metavar="FOLDER",
        group=_COMPUTE,
        recorded=False,
        applies=("picture", "volume", "live picture"),
    )
    judged: bool = option(
        True,
        help="Say whether the result can be trusted.",
        flags=("",),
        group=_RARE,
        recorded=False,
    )

    def __post_init__(self) -> None:
        """Raise InputError that names all mistakes at once."""
        from recon.base.declare import require
        from recon.reconstruction.solvers import require_solver

        require_solver(self.solver)
        require(self)


Options = ReconstructionOptions
