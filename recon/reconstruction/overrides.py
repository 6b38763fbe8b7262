"""Choices that the caller makes himself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from recon.camera.camera_model import ModelName, model_names
from recon.errors import InputError

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
    binning: int | None = None
    channels: str | None = None
    background: bool | None = None
    field: str | None = None
    precision: Precision | None = None
    tolerance: float | None = None

    @classmethod
    def parse(cls, text: Mapping[str, str]) -> Overrides:
        """Read overrides from words: ``{"model": "local", "binning": "1", "background": "off"}``.

        Raises
        ------
        InputError
            Which choice is not known, and what is.
        """
        known: dict[str, dict[str, Any] | None] = {
            "model": {m: m for m in model_names() if m != "auto"},
            "planes": None,
            "between": {"on": True, "off": False},
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
