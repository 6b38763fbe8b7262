"""The reference page of ``bench.toml``, made from the models that check it.

``python -m instrument.bench.config_reference`` prints it; a test holds ``docs/reference/bench-toml.md`` to
it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from typing import Any

from pydantic import BaseModel

from drivers.registry.registry import KINDS, driver_names, load_driver
from instrument.bench.config import DEVICE_TABLES, PLAIN_TABLES

_INTRODUCTION = """\
# bench.toml

One file describes a bench. `diffuserbench new` writes one to start from; `diffuserbench check` opens what it
names. All its mistakes are reported at once, each with its line. Units are in the names of the keys.

This page is made from the models that check the file (`python -m instrument.bench.config_reference`).
"""

_DEVICES = """\
## Devices: [camera], [stage], [led_array], [slm]

Each device table names its `driver`; a bench without a device leaves its table out (`[camera]` is needed).
Other keys are those common to the kind, and those of the driver.
"""


def reference() -> str:
    """Return the whole page as Markdown."""
    parts = [_INTRODUCTION]
    for name, model in PLAIN_TABLES.items():
        parts.append(_section(f"## [{name}]", model))
    parts.append(_DEVICES)
    shared: dict[str, type[BaseModel]] = {}
    for kind in KINDS:
        table = next(model for name, model in DEVICE_TABLES.items() if name == kind)
        parts.append(_section(f"### [{kind}]", table))
        for driver_name in driver_names(kind):
            driver = load_driver(kind, driver_name)
            if not driver.__module__.startswith("drivers."):
                continue  # another package's driver: its own documentation tells
            parts.append(_section(f'#### [{kind}] with driver = "{driver_name}"', driver.Options))
            if driver.Shared is not None:
                shared[driver.Shared.table] = driver.Shared.Options
    for name, options in shared.items():
        parts.append(_section(f"## [{name}]", options))
    return "\n".join(parts)


def _section(title: str, model: type[BaseModel]) -> str:
    schema = model.model_json_schema()
    lines = [title, "", *_sentences(model), *_table(schema, schema)]
    for name, inner in schema.get("$defs", {}).items():
        if inner.get("type") == "object":
            text = " ".join(inner.get("description", "").split())
            lines += [f"Each `{name}`: {text}".replace("``", "`"), "", *_table(inner, schema)]
    return "\n".join(lines)


def _sentences(model: type[BaseModel]) -> Iterator[str]:
    text = (model.__doc__ or "").strip().split("\n\n")[0]
    if text:
        yield from (" ".join(text.split()).replace("``", "`"), "")


def _table(schema: dict[str, Any], root: dict[str, Any]) -> Iterator[str]:
    if not schema.get("properties"):
        yield from ("No keys of its own.", "")
        return
    yield "| key | value | default | meaning |"
    yield "| --- | --- | --- | --- |"
    for key, field in schema["properties"].items():
        default = "" if field.get("default") is None else f"`{_toml(field['default'])}`"
        value = _type(field, root).replace("|", "\\|")
        yield f"| `{key}` | {value} | {default} | {field.get('description', '')} |"
    yield ""


def _type(field: dict[str, Any], root: dict[str, Any]) -> str:
    if "$ref" in field:
        name = field["$ref"].rsplit("/", 1)[-1]
        inner = root["$defs"][name]
        return f"`{name}`" if inner.get("type") == "object" else _type(inner, root)
    if "anyOf" in field:
        return " or ".join(_type(part, root) for part in field["anyOf"] if part.get("type") != "null")
    if "enum" in field:
        return ", ".join(f"`{_toml(value)}`" for value in field["enum"])
    if "const" in field:
        return f"`{_toml(field['const'])}`"
    kind = field.get("type")
    if kind == "array":
        return _array(field, root)
    if kind == "object":
        inner = field.get("additionalProperties")
        return f"table of {_type(inner, root)}" if isinstance(inner, dict) else "table"
    names = {"string": "text", "integer": "whole number", "number": "number", "boolean": "true or false"}
    return names.get(str(kind), "any") + _bounds(field)


def _array(field: dict[str, Any], root: dict[str, Any]) -> str:
    if "prefixItems" in field:
        parts = [_type(part, root) for part in field["prefixItems"]]
        same = len(set(parts)) == 1
        return f"[{len(parts)} x {parts[0]}]" if same else f"[{', '.join(parts)}]"
    items = field.get("items", {})
    return f"[{_type(items, root)}, ...]"


def _bounds(field: dict[str, Any]) -> str:
    words = {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to", "exclusiveMaximum": "below"}
    found = [f"{word} {field[name]:g}" for name, word in words.items() if name in field]
    return f" {' '.join(found)}" if found else ""


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key} = {_toml(entry)}" for key, entry in value.items()) + "}"
    return str(value)


if __name__ == "__main__":
    sys.stdout.write(reference())
