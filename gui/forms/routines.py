"""The forms of calibration routines and plans: those of routines follow from what is registered."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import MISSING, dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from calibration_routines.plan_procedures import PlanProcedure
from calibration_routines.procedure import Procedure, Routine, routines
from instrument.bench.bench import Bench
from instrument.files.errors import SettingsError
from instrument.plan import Plan
from recon.base.declare import Option, option, options_of


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


def form_of(routine: Routine) -> Form:
    """Return the form of a registered routine."""
    return Form(
        routine.name,
        routine.title,
        routine.help,
        options_of(routine.options),
        lambda values: routine.procedure(routine.options(**values)),
        routine.needs,
        routine.start,
    )


def forms(command: str = "calibrate") -> tuple[Form, ...]:
    """Return the forms of all routines of a command, as registered when this is asked."""
    return tuple(form_of(routine) for routine in routines.values() if routine.command == command)


def _plan(values: Mapping[str, Any]) -> PlanProcedure:
    try:
        data = tomllib.loads(values["text"])
    except tomllib.TOMLDecodeError as error:
        raise SettingsError([("text", str(error))]) from None
    base = Path(values["file"]).parent if values["file"] else Path()
    return PlanProcedure(Plan.checked(data, "plan").with_slm_images(lambda image: base / image))


@dataclass(frozen=True, kw_only=True)
class _PlanOptions:
    file: Path | None = option(
        None,
        help="A plan to read (.toml); relative paths are seen from its folder.",
        default_words="none: what stands below",
    )
    text: str = option(
        (files("instrument.plan") / "example.toml").read_text(),
        label="Plan",
        help="TOML; diffuserbench plan new writes the same example.",
        default_words="the example",
    )


PLAN = Form(
    "plan",
    "Plan",
    "Any acquisition, as a plan in TOML: positions, light, SLM images, exposures",
    options_of(_PlanOptions),
    _plan,
)
