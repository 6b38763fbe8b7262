"""A procedure as lines of Python that carry it out."""

from __future__ import annotations

from pathlib import Path

from calibration_routines.procedure import Procedure
from instrument.plan import Plan
from instrument.plan.file import plan_toml
from recon.base.declare import Imports, expression


def script(procedure: Procedure, bench: Path | None) -> str:
    """Return lines that open the bench, say what the procedure will do, and carry it out.

    Parameters
    ----------
    procedure : Procedure
        A dataclass.
    bench : Path, optional
        Its bench.toml; None: the built-in simulated bench.
    """
    imports = Imports({("instrument.bench.bench", "open_bench")})
    made = expression(procedure, imports, special={Plan: _plan})
    opened = f"open_bench({str(bench)!r})" if bench is not None else "open_bench()"
    lines = [
        *imports.lines(),
        "",
        f"procedure = {made}",
        f"with {opened} as bench:",
        "    print(*procedure.outlook(bench).reasons, sep='\\n')",
        "    done = procedure.carry_out(bench)",
        "print(*done.verdict, sep='\\n')",
    ]
    return "\n".join(lines) + "\n"


def _plan(plan: Plan, imports: Imports) -> str:
    imports.names.add(("instrument.plan", "Plan"))
    imports.modules.add("tomllib")
    return f"Plan.checked(tomllib.loads({plan_toml(plan)!r}))"
