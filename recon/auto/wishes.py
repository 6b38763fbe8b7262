"""Choices that the caller makes himself."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from recon.errors import InputError
from recon.volume.model import MODELS, ModelName


@dataclass(frozen=True, slots=True, kw_only=True)
class Wishes:
    """Choices that the caller makes; None leaves them to the program.

    Attributes
    ----------
    model : str or None
        ``"convolution"``, ``"lowrank"`` or ``"local"``.
    planes : str or None
        ``"all"``: every calibrated depth takes part.
    binning : int or None
    channels : str or None
        ``"all"``: no merging; ``"merged"``.
    background : bool or None
    field : str or None
        ``"all"``: everything that can reach the sensor.
    tolerance : float or None
    """

    model: ModelName | None = None
    planes: str | None = None
    binning: int | None = None
    channels: str | None = None
    background: bool | None = None
    field: str | None = None
    tolerance: float | None = None

    @classmethod
    def parse(cls, text: Mapping[str, str]) -> Wishes:
        """Read wishes from words: ``{"model": "local", "binning": "1", "background": "off"}``.

        Raises
        ------
        InputError
            Which wish is not known, and what is.
        """
        known: dict[str, dict[str, Any] | None] = {
            "model": {m: m for m in MODELS if m != "auto"},
            "planes": {"all": "all"},
            "binning": None,
            "channels": {"all": "all", "merged": "merged"},
            "background": {"on": True, "off": False},
            "field": {"all": "all"},
        }
        values: dict[str, Any] = {}
        for name, value in text.items():
            if name not in known:
                raise InputError(f"There is no choice {name!r}; there are {', '.join(known)}.")
            words = known[name]
            if words is None:
                if not value.isdigit() or int(value) < 1:
                    raise InputError(f"{name}={value}: a whole number from 1 is expected.")
                values[name] = int(value)
            elif value not in words:
                raise InputError(f"{name}={value}: one of {', '.join(words)} is expected.")
            else:
                values[name] = words[value]
        return cls(**values)


def require_choice(wishes: Wishes | None, prevented_by: str) -> None:
    """Refuse wishes where nothing, or only the model, is chosen: they would be ignored.

    Raises
    ------
    InputError
        What prevents the choice that they are about.
    """
    if wishes not in (None, Wishes()):
        raise InputError(
            f"Wishes are about everything that model='auto' chooses, which it does not with {prevented_by}. "
            "Leave one of the two out."
        )
