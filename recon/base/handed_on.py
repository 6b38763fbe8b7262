"""Packages that define nothing: names stand in ``__init__.pyi`` with their homes, and come when asked for.

So importing one name of a package, or a module in it, imports nothing else of it: ``import recon`` took 0.3 s
of the processor, which every command and the window paid for ``recon.types`` alone.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, MutableMapping
from importlib import import_module
from pathlib import Path
from typing import Any


def handed_on(names: MutableMapping[str, Any]) -> tuple[dict[str, tuple[str, str]], Callable[[str], Any]]:
    """Return module and name there of everything that a package's stub hands on, and its ``__getattr__``.

    The package's own modules come when asked for, too.

    Parameters
    ----------
    names : mutable mapping
        The package's own ``globals()``; a name that was found is kept there.
    """
    stub = ast.parse(Path(names["__file__"]).with_suffix(".pyi").read_text(encoding="utf-8"))
    homes = {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }

    def found(name: str) -> Any:
        if name not in homes:
            import difflib
            from importlib.util import find_spec

            own = f"{names['__name__']}.{name}"
            if not name.startswith("_") and find_spec(own) is not None:
                return import_module(own)

            near = difflib.get_close_matches(name, homes, 1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            raise AttributeError(f"module {names['__name__']!r} has no attribute {name!r}.{hint}")
        module, there = homes[name]
        home = import_module(module)
        value = getattr(home, there, None)
        names[name] = value = import_module(f"{module}.{there}") if value is None else value
        return value

    return homes, found


def lacking(owner: object, name: str) -> AttributeError:
    """Return the error of an object that lacks an attribute, with the nearest one: IPython names none."""
    import difflib

    public = [known for known in dir(type(owner)) if known[0] != "_"]
    near = difflib.get_close_matches(name, public, 1) if name[:1] != "_" else []
    hint = f" Did you mean {near[0]!r}?" if near else ""
    said = f"{type(owner).__name__!r} object has no attribute {name!r}.{hint}"
    return AttributeError(said, name=name, obj=owner)
