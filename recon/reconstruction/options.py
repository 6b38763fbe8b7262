"""What a reconstruction can be asked for, declared once (see :mod:`recon.base.declare`)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy.typing as npt

from recon.base.declare import option
from recon.base.namespace import DEVICES, Device
from recon.camera.camera_model import ModelName, model_names
from recon.camera.grid import FAR_UM
from recon.errors import InputError
from recon.priors import PRIORS, Prior
from recon.priors.base import refuse_lookalike

Precision = Literal["float32", "float64"]
PRECISIONS: tuple[Precision, ...] = ("float32", "float64")
"""Of all arithmetic in a solver."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Overrides:
    """Choices that the caller makes; None leaves them to the program.

    Attributes
    ----------
    model : str or None
        ``"convolution"``, ``"lowrank"`` or ``"local"``.
    planes : str or tuple of int or None
        ``"all"``: every calibrated depth takes part; or those that do, ascending, counted from 0.
    between : bool or None
        Whether planes are added between all depths that take part.
    beyond : bool or None
        Whether planes are added beyond the farthest depth.
    binning : int or None
    channels : str or None
        ``"all"``: no merging; ``"merged"``.
    background : bool or None
    field : str or None
        ``"all"``: everything that can reach the sensor.
    precision : str or None
        ``"float32"`` or ``"float64"``.
    tolerance : float or None
    """

    model: ModelName | None = None
    planes: Literal["all"] | tuple[int, ...] | None = None
    between: bool | None = None
    beyond: bool | None = None
    binning: int | None = None
    channels: str | None = None
    background: bool | None = None
    field: str | None = None
    precision: Precision | None = None
    tolerance: float | None = None

    @classmethod
    def parse(cls, text: Mapping[str, str]) -> Overrides:
        """Read overrides from words: ``{"model": "local", "binning": "1", "background": "off"}``.

        Raises InputError: which choice is not known, and what is.
        """
        known: dict[str, dict[str, Any] | None] = {
            "model": {m: m for m in model_names() if m != "auto"},
            "planes": None,
            "between": {"on": True, "off": False},
            "beyond": {"on": True, "off": False},
            "binning": None,
            "channels": {"all": "all", "merged": "merged"},
            "background": {"on": True, "off": False},
            "field": {"all": "all"},
            "precision": {p: p for p in PRECISIONS},
        }
        values: dict[str, Any] = {}
        for name, value in text.items():
            if name not in known:
                raise InputError(f"There is no choice {name!r}; there are {', '.join(known)}.")
            words = known[name]
            if name == "planes":
                values[name] = "all" if value == "all" else _indices(value)
            elif words is None:
                if not value.isdigit() or int(value) < 1:
                    raise InputError(f"{name}={value}: a whole number from 1 is expected.")
                values[name] = int(value)
            elif value not in words:
                raise InputError(f"{name}={value}: one of {', '.join(words)} is expected.")
            else:
                values[name] = words[value]
        return cls(**values)


def _indices(text: str) -> tuple[int, ...]:
    """Read ``0-3,7``."""
    chosen: set[int] = set()
    for part in text.split(","):
        first, _, last = part.strip().partition("-")
        if not first.isdigit() or not (last or first).isdigit() or int(last or first) < int(first):
            raise InputError(f"planes={text}: all, or depths counted from 0 as in 0-3,7, is expected.")
        chosen |= set(range(int(first), int(last or first) + 1))
    return tuple(sorted(chosen))


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
        help="Distance of the scene; a PSF is refocused to it. inf: light that comes in parallel.",
        unit="um",
        shown_unit="mm",
        shown_factor=1000.0,
        above=0,
        infinity=FAR_UM,
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
        default_words="200, none with a time",
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
        applies=("picture", "volume", "video", "patterned picture"),
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
        applies=("picture", "volume", "video", "patterned picture"),
        identifies=False,
    )
    stop_at_noise: bool = option(
        False,
        help="Stop as soon as the residual is down to the expected noise.",
        group=_STOP,
        applies=("picture", "volume", "patterned picture"),
        identifies=False,
    )
    model: ModelName = option(
        "auto",
        help="local, lowrank: PSFs that vary over the field; auto: the smallest that explains the data.",
        choices=model_names,
        group=_CHOICE,
        applies=("picture", "volume", "video", "live picture", "patterned picture"),
    )
    choose: Overrides | None = option(
        None,
        help="Overrule one of auto's choices (repeatable): model=, planes=all|0-3,7, between=on|off, "
        "beyond=on|off, field=all, binning=N, channels=all|merged, background=on|off, "
        "precision=float32|float64.",
        metavar="NAME=VALUE",
        group=_CHOICE,
        parse_all=_overrides,
        applies=("picture", "volume", "video"),
    )
    estimate_background: bool | None = option(
        None,
        help="Smooth background, too.",
        default_words="auto decides; else for volumes",
        flags=("--background/--no-background",),
        label="Smooth background",
        group=_CHOICE,
        applies=("picture", "volume", "video", "live picture", "patterned picture"),
    )
    positive_background: bool = option(
        False,
        help="A background that is nowhere negative; up to three more runs.",
        group=_RARE,
        applies=("picture", "volume", "patterned picture"),
    )
    refine_psf: bool = option(
        False,
        help="First fit the PSFs' size, rotation and, of a stack, depth to the photograph.",
        label="Refine the PSF",
        group=_CHOICE,
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
        applies=("picture", "volume", "video", "live picture"),
    )
    precision: Literal["auto"] | Precision = option(
        "auto",
        help="auto: float32 unless it shows; else float64.",
        choices=("auto", *PRECISIONS),
        group=_COMPUTE,
        applies=("picture", "volume", "live picture", "patterned picture"),
    )
    memory_gib: float | None = option(
        None,
        help="Memory that may be taken.",
        label="Memory",
        default_words="what is free",
        unit="GiB",
        above=0,
        flags=("--memory",),
        metavar="GIB",
        group=_COMPUTE,
        recorded=False,
        applies=("picture", "volume", "live picture", "patterned picture"),
    )
    scratch: Path | None = option(
        None,
        help="Where to keep what does not fit into memory, on a fast disk.",
        label="Scratch folder",
        metavar="FOLDER",
        group=_COMPUTE,
        recorded=False,
        applies=("picture", "volume", "live picture"),
    )
    uncertainty: bool = option(
        False,
        help="Also the standard deviation of every pixel; takes about seven times as long.",
        group=_MAIN,
        applies=("picture",),
        identifies=False,
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
        refuse_lookalike(self.prior)
        require(self)
        if self.z_um == math.inf:  # as the command line has it: records hold no infinities
            object.__setattr__(self, "z_um", FAR_UM)


Options = ReconstructionOptions
