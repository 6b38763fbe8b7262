"""diffuserbench for notebooks and scripts: ``import diffuserbench as db``.

    psf, photo = db.read("psf.tif"), db.read("photo.tif")
    scene = db.reconstruct(photo, psf)
    scene.show()
    scene.save("scene.tif")

It defines nothing: what there is stands in ``__init__.pyi``, name by name with its home, and is imported when
it is first asked for.
"""

from __future__ import annotations

import ast
from importlib import import_module
from pathlib import Path
from typing import Any


def _homes() -> dict[str, tuple[str, str]]:
    """Return module and name there of everything that the stub hands on."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {
        alias.asname or alias.name: (node.module or "", alias.name)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


_HOMES = _homes()
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        import difflib

        near = difflib.get_close_matches(name, _HOMES, 1)
        hint = f" Did you mean {near[0]!r}?" if near else ""
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}.{hint}")
    module, there = _HOMES[name]
    home = import_module(module)
    found = getattr(home, there, None)
    globals()[name] = found = import_module(f"{module}.{there}") if found is None else found
    return found


def __dir__() -> list[str]:
    return __all__
