"""A procedure as lines of Python that carry it out."""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any

from calibration_routines.procedure import Procedure
from instrument.plan import Plan
from instrument.plan.file import plan_toml

_LINE = 100


def script(procedure: Procedure, bench: Path | None) -> str:
    """Return lines that open the bench, say what the procedure will do, and carry it out.

    Parameters
    ----------
    procedure : Procedure
        A dataclass.
    bench : Path, optional
        Its bench.toml; None: the built-in simulated bench.
    """
    imports: set[tuple[str, str]] = {("instrument.bench.bench", "open_bench")}
    plain: set[str] = set()
    made = expression(procedure, imports, plain)
    lines = [f"import {name}" for name in sorted(plain)]
    lines += [f"from pathlib import {name}" for module, name in sorted(imports) if module == "pathlib"]
    lines += [""] if lines else []
    lines += [f"from {module} import {name}" for module, name in sorted(imports) if module != "pathlib"]
    opened = f"open_bench({str(bench)!r})" if bench is not None else "open_bench()"
    lines += [
        "",
        f"procedure = {made}",
        f"with {opened} as bench:",
        "    print(*procedure.outlook(bench).reasons, sep='\\n')",
        "    done = procedure.carry_out(bench)",
        "print(*done.verdict, sep='\\n')",
    ]
    return "\n".join(lines) + "\n"


def expression(value: Any, imports: set[tuple[str, str]], plain: set[str], indent: str = "") -> str:
    """Return Python for a value; what must be imported for it is added to ``imports`` and ``plain``."""
    if isinstance(value, Path):
        imports.add(("pathlib", "Path"))
        return f"Path({str(value)!r})"
    if isinstance(value, Plan):
        imports.add(("instrument.plan", "Plan"))
        plain.add("tomllib")
        return f"Plan.checked(tomllib.loads({plan_toml(value)!r}))"
    if is_dataclass(value) and not isinstance(value, type):
        imports.add((type(value).__module__, type(value).__name__))
        inner = indent + "    "
        parts = [
            f"{field.name}={expression(getattr(value, field.name), imports, plain, inner)}"
            for field in fields(value)
            if getattr(value, field.name) != _default(field)
        ]
        one_line = f"{type(value).__name__}({', '.join(parts)})"
        if len(one_line) + len(indent) < _LINE and "\n" not in one_line:
            return one_line
        listed = "".join(f"{inner}{part},\n" for part in parts)
        return f"{type(value).__name__}(\n{listed}{indent})"
    return repr(value)


def _default(field: Any) -> Any:
    if field.default is not MISSING:
        return field.default
    return field.default_factory() if field.default_factory is not MISSING else MISSING
