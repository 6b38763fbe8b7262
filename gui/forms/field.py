"""A setting as a form asks for it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass, fields
from pathlib import Path
from typing import Any, Literal

from calibration_routines.procedure import Procedure
from instrument.bench.bench import Bench
from recon.base.declare import Declaration, Option

Kind = Literal["number", "whole", "switch", "choice", "file", "text"]
_TYPES: dict[Kind, type] = {
    "number": float,
    "whole": int,
    "switch": bool,
    "choice": str,
    "file": Path,
    "text": str,
}
MM = 1e3
"""Settings are in micrometres, people think of distances in millimetres."""


@dataclass(frozen=True, slots=True)
class Form:
    """All settings of a procedure.

    Attributes
    ----------
    name, title, tip : str
    fields : tuple of Option
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
    fields: tuple[Option, ...]
    make: Callable[[Mapping[str, Any]], Procedure]
    needs: tuple[str, ...] = ()
    start: Callable[[Bench], Mapping[str, Any]] | None = None

    def defaults(self) -> dict[str, Any]:
        """Return the values that fields begin with."""
        return {field.name: None if field.default is MISSING else field.default for field in self.fields}


def field_of(settings: type, name: str, label: str, tip: str, kind: Kind = "number", **said: Any) -> Option:
    """Return a dataclass' setting as a declared option, which begins with the class' own default."""
    (known,) = (field for field in fields(settings) if field.name == name)
    default = said.pop("default", None if known.default is MISSING else known.default)
    return setting(name, label, tip, kind, default, **said)


def setting(
    name: str, label: str, tip: str, kind: Kind = "number", default: Any = None, **said: Any
) -> Option:
    """Return a setting as a declared option.

    ``unit`` is the one that is shown and ``scale`` how much of the setting's own it is; ``optional`` says
    what happens when it is left empty, empty where it is needed; ``choices`` and ``advanced`` as they say.
    """
    optional, kind_of_value = said.get("optional", ""), _TYPES[kind]
    return Option(
        name,
        kind_of_value | None if optional else kind_of_value,
        default if optional or default is not None else MISSING,
        Declaration(
            help=f"{tip}.",
            shown_unit=said.get("unit", ""),
            shown_factor=said.get("scale", 1.0),
            choices=said.get("choices", ()),
            group="Rarely needed" if said.get("advanced") else "",
            label=label,
            default_words=optional,
        ),
    )
