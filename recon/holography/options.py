"""How to compute a hologram, declared once (see :mod:`recon.base.declare`)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from recon.arrays import Array
from recon.base.declare import option, require
from recon.base.namespace import DEVICES, Device
from recon.errors import InputError
from recon.holography.display import Display
from recon.holography.losses import LOSSES, Loss, loss_of
from recon.holography.target import Grid, foveal_weights

Method = Literal["lbfgs", "nesterov", "one-step"]
Fit = Literal["cover", "contain", "stretch"]
Envelope = Literal["shade", "correct", "ignore"]
Mirrored = Literal["optimised", "lee", "off-axis"]

LIGHT = 0.1
"""Of the light on a complex SLM: at 16x a tenth is 2.5 to 7 dB better than a phase SLM, and a hundredth
0.4 dB more (benchmarks/hologram_limits.py)."""

MOST_MIRRORED = 1 / np.pi**2
"""Of the light on mirrors, in one first order of fringes half as wide as their period (Lee 1979)."""
LIGHT_MIRRORED = 0.08
"""The noise of two states stays the same: 0.01 to 0.03 of the light cost 4 to 10 dB."""

_OF_PICTURES, _LIMITED = ("picture",), ("picture", "limit")
_PICTURE, _COUNTS, _STOP, _SLM, _RARE = "Picture", "What counts", "When to stop", "Display", "Rarely needed"


@dataclass(frozen=True, kw_only=True)
class HologramOptions:
    """How to compute a hologram; the defaults need no tuning.

    Loss, weights, grid and frames make the model; ``fit``, ``srgb`` and ``envelope`` are about turning a
    picture into a target, ``expansion`` about the display; the rest is about the search.
    """

    fit: Fit = option(
        "cover",
        help="How a picture that is not square fills the square field: it loses its sides, gets black "
        "borders, or is stretched.",
        choices=get_args(Fit),
        group=_PICTURE,
        applies=_LIMITED,
    )
    srgb: bool = option(
        False,
        help="The picture's values are sRGB-coded and are decoded to intensities; else they are intensities.",
        label="sRGB-coded",
        group=_PICTURE,
        applies=_LIMITED,
    )
    lift: float = option(
        0.0,
        help="Lift the picture's black to this part of white: what the mask and a phase SLM cannot make "
        "dark costs the rest of the picture less.",
        least=0,
        below=1,
        metavar="PART",
        group=_PICTURE,
        applies=_LIMITED,
    )
    loss: str | Loss = option(
        "frequency",
        help="Which differences count (Kuo 2020, Eqs. 7.16, 7.17 and 7.19).",
        choices=LOSSES.names,
        group=_COUNTS,
        applies=_OF_PICTURES,
    )
    centre: tuple[float, float] = option(
        (0.5, 0.5),
        help="Of the fovea, the part of the field that counts fully with a weighted loss, from the top left.",
        unit="fractions of the field",
        metavar="Y,X",
        label="Fovea's centre",
        group=_COUNTS,
        applies=_OF_PICTURES,
    )
    radius: float = option(
        0.28,
        help="Of the fovea.",
        unit="fraction of the field",
        above=0,
        metavar="R",
        label="Fovea's radius",
        group=_COUNTS,
        applies=_OF_PICTURES,
    )
    periphery: float = option(
        0.1,
        help="Weight far outside the fovea.",
        least=0,
        most=1,
        metavar="W",
        label="Elsewhere",
        group=_COUNTS,
        applies=_OF_PICTURES,
    )
    weights: Array | None = option(
        None,
        help="Weights over the whole field, (height, width), any size, not negative, instead of the fovea.",
        flags=("",),
        group=_COUNTS,
        recorded=False,
        applies=_OF_PICTURES,
    )
    envelope: Envelope = option(
        "shade",
        help="What becomes of the mask pixels' envelope: the target gets it too (a picture darker at the "
        "border), the hologram works against it, or it is left out of the model.",
        choices=get_args(Envelope),
        group=_COUNTS,
    )
    expansion: int | None = option(
        None,
        help="Étendue expansion: 4, 16, 36 ..., a square; 1: without a mask.",
        default_words="the bench's",
        least=1,
        flags=("--expansion", "-q"),
        metavar="Q",
        group=_SLM,
    )
    distance_mm: float | None = option(
        None,
        help="Without a Fourier lens: the picture is so far behind the mask, or the SLM where there is none; "
        "planes are counted from there.",
        default_words="behind the Fourier lens",
        unit="mm",
        above=0,
        metavar="MM",
        label="Distance",
        group=_SLM,
        applies=("picture", "limit", "spots"),
    )
    frames: int = option(
        1,
        help="Time-multiplexed frames, whose intensities average.",
        least=1,
        metavar="N",
        group=_SLM,
        applies=("picture", "spots"),
    )
    complex_slm: bool = option(
        False,
        help="For an SLM that sets amplitude, at most 1, and phase.",
        flags=("--complex",),
        label="Complex SLM",
        group=_SLM,
        applies=_OF_PICTURES,
    )
    mirrors: Mirrored | None = option(
        None,
        help="For a device of mirrors that send light or not. The picture is in the upper right of the "
        "field, its twin opposite. optimised: every mirror for itself; lee, off-axis: a carrier's fringes, "
        "whose places are the phase and (lee) widths the amplitude; without a mask only.",
        choices=get_args(Mirrored),
        default_words="a phase SLM",
        group=_SLM,
        applies=_OF_PICTURES,
    )
    light: float | None = option(
        None,
        help="How much of the light that falls on it goes into the picture. Of a complex SLM: the less, the "
        "better the picture. Of mirrors: at most 0.1. A phase SLM always sends all of it.",
        default_words="0.1 complex, 0.08 mirrors",
        above=0,
        most=1,
        metavar="SHARE",
        label="Light",
        group=_SLM,
        applies=_OF_PICTURES,
    )
    phase_levels: int | None = option(
        None,
        help="The SLM shows so many equidistant phases only: the last iterations round more and more pixels "
        "and let the others make up for it.",
        default_words="continuous, written in 256",
        least=2,
        flags=("--levels",),
        metavar="N",
        group=_SLM,
        applies=("picture", "spots"),
    )
    iterations: int = option(
        100, help="At most so many.", least=0, flags=("--iterations", "-n"), metavar="N", group=_STOP
    )
    time_s: float | None = option(
        None,
        help="At most so many seconds; of a limit, its searches together (bounds and what frames gain on "
        "top).",
        default_words="no limit",
        unit="s",
        above=0,
        flags=("--time",),
        metavar="S",
        group=_STOP,
    )
    psnr_db: float | None = option(
        None,
        help="Stop when the seen image, through the eye's low-pass, is that good over the whole field.",
        default_words="no limit",
        unit="dB",
        above=0,
        flags=("--psnr",),
        metavar="DB",
        label="PSNR",
        group=_STOP,
        applies=_OF_PICTURES,
    )
    tolerance: float | None = option(
        None,
        help="Stop when the loss fell by less than this fraction in each of five iterations in a row. "
        "0: never.",
        default_words="1e-05; of a limit 0.001",
        least=0,
        metavar="X",
        group=_STOP,
        applies=_LIMITED,
    )
    method: Method = option(
        "lbfgs",
        help="L-BFGS; projected gradient with Nesterov acceleration (Kuo 2020, A.6); back-propagated in one "
        "step (Eqs. 7.11 to 7.13).",
        choices=get_args(Method),
        flags=("--method", "-m"),
        group=_RARE,
        applies=_OF_PICTURES,
    )
    grid: Grid = option(
        "alias-free",
        help="Grid that is optimised on; dissertation: the mask's own, which aliases.",
        choices=get_args(Grid),
        group=_RARE,
        applies=_OF_PICTURES,
    )
    seed: int = option(0, help="Of the random start.", group=_RARE)
    device: Device = option(
        "cpu",
        help="Where to compute: far pictures through a mask in its place, by the method lbfgs.",
        choices=DEVICES,
        group=_RARE,
        applies=_OF_PICTURES,
    )

    def __post_init__(self) -> None:
        """Raise InputError that names all mistakes at once."""
        require(self)
        if not all(0 <= at <= 1 for at in self.centre):
            raise InputError(f"centre must lie in 0 to 1 of the field, not {self.centre}.")
        if self.light is not None and not self.complex_slm and self.mirrors is None:
            raise InputError("light is of a complex SLM or mirrors: a phase SLM sends all into the field.")
        if self.mirrors is not None:
            self._require_mirrors()
        if self.weights is None:
            return
        if not loss_of(self.loss).takes_weights:
            weighted = ", ".join(repr(loss.name) for loss in LOSSES.values() if loss.takes_weights)
            raise InputError(f"Weights need a loss that takes them: {weighted}.")
        weights = self.weights
        if weights.ndim != 2 or not np.isfinite(weights).all() or weights.min() < 0 or weights.max() <= 0:
            raise InputError("Weights must be a (height, width) image, finite, not negative, not all zero.")

    def _require_mirrors(self) -> None:
        if self.complex_slm or self.phase_levels is not None:
            raise InputError("Mirrors send light or not: leave --complex and --levels out.")
        if self.method != "lbfgs":
            raise InputError("Mirrors need the method 'lbfgs'.")
        if self.light is not None and self.light > MOST_MIRRORED:
            raise InputError(
                f"Mirrors send at most {MOST_MIRRORED:.3f} of the light into a picture, not {self.light:g}."
            )

    @property
    def share(self) -> float:
        """How much of the light on the SLM the target asks for."""
        if not self.complex_slm and self.mirrors is None:
            return 1.0
        if self.light is not None:
            return self.light
        return LIGHT if self.complex_slm else LIGHT_MIRRORED

    def field_weights(self) -> Array | None:
        """Return the weights over the field, (height, width); None where the loss takes none."""
        if not loss_of(self.loss).takes_weights:
            return None
        if self.weights is not None:
            return self.weights
        return foveal_weights((256, 256), centre=self.centre, radius=self.radius, periphery=self.periphery)

    def display_of(self, display: Display) -> Display:
        """Return the display as it is modelled: without an envelope that is ignored, without its lens.

        A display that has none by itself stays as it is where no distance is given.
        """
        fill = 0.0 if self.envelope == "ignore" else display.mask_fill
        away_mm = display.distance_mm if self.distance_mm is None else self.distance_mm
        return replace(display, mask_fill=fill, distance_mm=away_mm)
