"""How Sphinx makes the site of this folder: ``make docs``. The pages are read on their own as well."""

from __future__ import annotations

from importlib import metadata
from typing import Any

project = "diffuserbench"
try:
    release = metadata.version("diffuserbench")
except metadata.PackageNotFoundError:
    release = ""
root_doc = "README"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
myst_heading_anchors = 4
html_theme = "furo"
html_title = "diffuserbench"
html_static_path: list[str] = []
autodoc_typehints = "none"
autodoc_class_signature = "separated"
napoleon_google_docstring = False
suppress_warnings = [
    "myst.xref_missing",  # to files of the repository beside this folder, which a reader on GitHub follows
    "misc.highlighting_failure",
]
exclude_patterns = ["conf.py"]

CHAPTERS = {
    "Begin": ("tutorials/*", "gallery"),
    "How to": ("how-to/*", "how-to/devices/*"),
    "Subjects": ("*",),
    "Reference": ("reference/*",),
    "Measured": ("benchmarks/*",),
    "Decisions": ("decisions/*",),
}


def contents() -> str:
    """Return the tables of contents of the whole site, which a reader of single files needs not."""
    lines = [""]
    for caption, places in CHAPTERS.items():
        lines += ["```{toctree}", ":hidden:", ":glob:", f":caption: {caption}", "", *places, "```", ""]
    return "\n".join(lines)


def names() -> str:
    """Return a directive for everything that ``import diffuserbench`` offers."""
    import diffuserbench

    return "\n".join(["```{eval-rst}", *map(_directive, dir(diffuserbench)), "```"])


def _directive(name: str) -> str:
    import types

    import diffuserbench

    found, home = getattr(diffuserbench, name), ".".join(diffuserbench._HOMES[name])
    if isinstance(found, type):
        return f".. autoclass:: {home}\n   :members:\n"
    if isinstance(found, types.FunctionType):
        return f".. autofunction:: {home}\n"
    return f".. {'automodule' if isinstance(found, types.ModuleType) else 'autodata'}:: {home}\n"


def on_source(_app: Any, docname: str, source: list[str]) -> None:
    """Add to a page what only the site has."""
    if docname == root_doc:
        source[0] += contents()
    if docname == "reference/python":
        source[0] = source[0].replace("<!-- names -->", names())


def setup(app: Any) -> None:
    """Let Sphinx call :func:`on_source`."""
    app.connect("source-read", on_source)
