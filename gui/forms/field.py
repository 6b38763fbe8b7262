"""A setting as a form asks for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from typing import Any, Literal

from calibration_routines.procedure import Procedure
from instrument.bench.bench import Bench

Kind = Literal["number", "whole", "switch", "choice", "file", "text"]
MM = 1e3
"""Settings are in micrometres, people think of distances in millimetres."""


@dataclass(frozen=True, slots=True)
class Field:
    """One setting.

    Attributes
    ----------
    name : str
        As the settings' class has it, which also names it in a ``SettingsError``.
    label, tip : str
    kind : str
    default : object
        In the setting's own unit; None: empty.
    unit : str
        As it is shown.
    scale : float
        The setting's own unit over the shown one.
    optional : str
        What happens when it is left empty; empty where it is needed.
    choices : tuple of str
    advanced : bool
        Whether it is shown among those that seldom change.
    """

    name: str
    label: str
    tip: str
    kind: Kind = "number"
    default: Any = None
    unit: str = ""
    scale: float = 1.0
    optional: str = ""
    choices: tuple[str, ...] = ()
    advanced: bool = False


@dataclass(frozen=True, slots=True)
class Form:
    """All settings of a procedure.

    Attributes
    ----------
    name, title, tip : str
    fields : tuple of Field
    make : callable
        Makes the procedure of values by name; raises SettingsError or another BenchError.
    needs : tuple of str
        Devices that it needs besides the camera.
    start : callable, optional
        Gives values to begin with that follow from the bench.
    """

    name: str
    title: str
    tip: str
    fields: tuple[Field, ...]
    make: Callable[[Mapping[str, Any]], Procedure]
    needs: tuple[str, ...] = ()
    start: Callable[[Bench], Mapping[str, Any]] | None = None

    def defaults(self) -> dict[str, Any]:
        """Return the values that fields begin with."""
        return {field.name: field.default for field in self.fields}


def field_of(
    settings: type,
    name: str,
    label: str,
    tip: str,
    kind: Kind = "number",
    *,
    default: Any = MISSING,
    unit: str = "",
    scale: float = 1.0,
    optional: str = "",
    choices: tuple[str, ...] = (),
    advanced: bool = False,
) -> Field:
    """Return the field of a dataclass' setting, which begins with the class' own default."""
    (known,) = (field for field in fields(settings) if field.name == name)
    if default is MISSING:
        default = None if known.default is MISSING else known.default
    return Field(name, label, tip, kind, default, unit, scale, optional, choices, advanced)
