"""The Python that makes a value: what "Copy as Python" puts together."""

from __future__ import annotations

import dataclasses
import enum
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from recon.base.declare import same

_LINE = 100
Made = Callable[[Any, "Imports"], str]
"""Returns the Python that makes a value, and adds what must be imported for it."""


@dataclass
class Imports:
    """What lines of Python need: ``from module import name`` pairs and plain modules."""

    names: set[tuple[str, str]] = field(default_factory=set)
    modules: set[str] = field(default_factory=set)

    def lines(self) -> list[str]:
        """Return the import lines: the standard library, an empty line, the project's."""
        standard = [f"import {name}" for name in sorted(self.modules)]
        standard += [
            f"from pathlib import {name}" for module, name in sorted(self.names) if module == "pathlib"
        ]
        own = [f"from {module} import {name}" for module, name in sorted(self.names) if module != "pathlib"]
        return [*standard, *([""] if standard and own else []), *own]


def expression(
    value: Any,
    imports: Imports | None = None,
    *,
    special: Mapping[type, Made] | None = None,
    indent: str = "",
) -> str:
    """Return the Python that makes a value, without what is default: "Copy as Python".

    Parameters
    ----------
    value
        Plain values, paths, enumerations, sequences of them, dataclasses.
    imports : Imports, optional
        Gets what must be imported.
    special : mapping of type to callable, optional
        How values of other types are made.
    indent : str
        Of the line that the expression stands in; a dataclass that does not fit into it is folded.
    """
    imports = Imports() if imports is None else imports
    for kind, made in (special or {}).items():
        if isinstance(value, kind):
            return made(value, imports)
    if isinstance(value, Path):
        imports.names.add(("pathlib", "Path"))
        return f"Path({str(value)!r})"
    if isinstance(value, enum.Enum):
        imports.names.add((type(value).__module__, type(value).__name__))
        return f"{type(value).__name__}.{value.name}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        imports.names.add((type(value).__module__, type(value).__name__))
        inner = indent + "    "
        parts = [
            f"{f.name}={expression(getattr(value, f.name), imports, special=special, indent=inner)}"
            for f in dataclasses.fields(value)
            if f.init and not _is_default(f, getattr(value, f.name))
        ]
        line = f"{type(value).__name__}({', '.join(parts)})"
        if len(line) + len(indent) < _LINE and "\n" not in line:
            return line
        listed = "".join(f"{inner}{part},\n" for part in parts)
        return f"{type(value).__name__}(\n{listed}{indent})"
    if isinstance(value, list | tuple):
        inside = [expression(one, imports, special=special, indent=indent) for one in value]
        if isinstance(value, list):
            return f"[{', '.join(inside)}]"
        return f"({inside[0]},)" if len(inside) == 1 else f"({', '.join(inside)})"
    return repr(value)


def _is_default(f: dataclasses.Field[Any], value: Any) -> bool:
    made = f.default_factory() if f.default_factory is not dataclasses.MISSING else f.default
    return value is made or same(value, made)
