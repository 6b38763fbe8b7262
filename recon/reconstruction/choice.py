"""What was chosen, in words and numbers."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from typing import Any, Literal

import numpy as np

from recon.camera.camera_model import ModelName
from recon.reconstruction.options import Precision

Name = Literal[
    "model", "planes", "between", "beyond", "field", "binning", "channels", "background", "iterations",
    "precision",
]  # fmt: skip


@dataclass(frozen=True, slots=True)
class Decision:
    """One choice.

    Attributes
    ----------
    name : str
    value : str
    why : str
        With the numbers that decided.
    up, down : str or None
        The next larger and the next smaller choice; None at the end of the scale. What a step would cost is
        not foretold: estimates of time and error did not come true (``docs/benchmarks/explain.md``).
    overruled : bool
        Whether the caller chose.
    numbers : mapping of str to float
        What ``why`` says, to compute with.
    open : bool
        Whether there was anything to decide; what was not is told only where everything is.
    """

    name: Name
    value: str
    why: str
    up: str | None = None
    down: str | None = None
    overruled: bool = False
    numbers: Mapping[str, float] = field(default_factory=dict)
    open: bool = True


@dataclass(frozen=True, slots=True)
class Choice:
    """Everything that was chosen for one measurement and one calibration.

    Attributes
    ----------
    model : str
        ``"convolution"``, ``"lowrank"`` or ``"local"``.
    planes : tuple of int
        Depths that take part, as indices into the calibration's, in its order.
    n_planes : int
        Depths that the calibration has.
    between : tuple of int
        Planes added half way between depths ``k`` and ``k + 1``; the result has their light on these.
    beyond : bool
        Whether planes are added beyond the farthest depth; the result has their light in its background.
    binning : int
        Pixels to average along each axis.
    merged : bool
        Whether colour channels are reconstructed as one.
    background : bool
        Whether a smooth background is estimated as well.
    precision : "float32" or "float64"
    psf_window : (int, int)
        Central part of the PSFs that holds their light: the object extends half of it beyond the sensor.
    acceptance_px : float or None
        Distance from the axis, in object pixels, beyond which the sensor accepts nothing; None: no limit
        within the field.
    margin : float or None
        As of :class:`~recon.camera.camera_model.Extent`.
    decisions : tuple of Decision
    seconds : float
        Wall time that choosing took.
    """

    model: ModelName
    planes: tuple[int, ...]
    n_planes: int
    between: tuple[int, ...]
    binning: int
    merged: bool
    background: bool
    precision: Precision
    psf_window: tuple[int, int]
    acceptance_px: float | None
    tolerance: float
    """Change an iteration at which to stop."""
    decisions: tuple[Decision, ...]
    seconds: float
    beyond: bool = False
    margin: float | None = None

    @property
    def key(self) -> str:
        """What tells the problem that was chosen from others: kept work of another is not gone on with."""
        chosen = (
            self.model, self.planes, self.between, self.binning, self.merged, self.background,
            self.precision, self.psf_window, self.acceptance_px, *(["beyond"] if self.beyond else []),
            *([f"margin {self.margin:g}"] if self.margin is not None else []),
        )  # fmt: skip
        return hashlib.sha256(repr(chosen).encode()).hexdigest()[:8]

    def lines(self, *, steps: bool = True) -> list[str]:
        """Return what was chosen and why, a line a choice, and one step up and down.

        Without ``steps`` only what there was to decide.
        """
        text = []
        for d in self.decisions:
            if not (steps or d.open or d.overruled):
                continue
            asked = (" (as asked)" if d.why else "as asked") if d.overruled else ""
            text.append(f"{d.name.capitalize():<12}{d.value}: {d.why}{asked}")
            if steps:
                ways = (("up", d.up), ("down", d.down))
                text += [f"{'':<12}  one step {way}: {o}" for way, o in ways if o is not None]
        return text

    def to_json(self) -> dict[str, Any]:
        """Return all of it, JSON-compatible (numbers that are not known are None)."""
        recorded: dict[str, Any] = _recorded(self)
        return recorded


_RECORDED = {
    "between": "planes_between",
    "merged": "channels_merged",
    "up": "one_step_up",
    "down": "one_step_down",
}
"""Fields that are recorded under another name."""


def _recorded(value: Any) -> Any:
    if is_dataclass(value):
        return {_RECORDED.get(f.name, f.name): _recorded(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {name: _recorded(one) for name, one in value.items()}
    if isinstance(value, tuple):
        return [_recorded(one) for one in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
