"""Plans as files: TOML for people, JSON for programs."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from instrument.files.atomic import write_text
from instrument.files.errors import FileError
from instrument.plan.errors import PlanError
from instrument.plan.model import Plan


def load_plan(path: Path | str) -> Plan:
    """Read a plan from a TOML or JSON file. Relative paths of SLM images are seen from the file's folder.

    Raises
    ------
    FileError
        When there is no such file, or its name ends neither in .toml nor in .json.
    PlanError
        Naming every mistake in it.
    """
    path = Path(path)
    reader = _reader(path)
    if not path.is_file():
        raise FileError(path, "is a folder; a plan is a file." if path.is_dir() else "no such plan file.")
    try:
        data = reader(path.read_text())
    except UnicodeDecodeError:
        raise FileError(path, "is no text file.", "A plan is a TOML or JSON file.") from None
    except ValueError as error:  # of tomllib and json alike; both name the line
        raise PlanError(path, [str(error)]) from None
    return Plan.checked(data, path).with_slm_images(lambda image: path.parent / image)


def save_plan(plan: Plan, path: Path | str) -> None:
    """Write a plan as TOML or JSON, by the file's suffix; :func:`load_plan` reads it back equal."""
    path = Path(path)
    is_toml = _reader(path) is tomllib.loads
    write_text(path, plan_toml(plan) if is_toml else plan.to_json() + "\n")


def plan_toml(plan: Plan) -> str:
    """Return a plan as TOML, without what is as by default."""
    data = plan.model_dump(mode="json", exclude_defaults=True)
    for part, model in zip(data["parts"], plan.parts, strict=True):
        if model.positions is not None:
            part["positions"] = {"kind": model.positions.kind, **part["positions"]}
    lines = [f"label = {_toml(data['label'])}"]
    for part in data["parts"]:
        lines += ["", "[[parts]]", *(f"{key} = {_toml(value)}" for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _reader(path: Path) -> Any:
    readers: Mapping[str, Any] = {".toml": tomllib.loads, ".json": json.loads}
    if path.suffix.lower() not in readers:
        raise FileError(path, f"a plan's name ends in {' or '.join(readers)}.")
    return readers[path.suffix.lower()]


def _toml(value: Any) -> str:
    """Return a JSON value in TOML's notation, inline."""
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{key} = {_toml(item)}" for key, item in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_toml, value)) + "]"
    # Strings, numbers and booleans are written alike in both; a TOML basic string takes JSON's escapes.
    return json.dumps(value, ensure_ascii=False)
