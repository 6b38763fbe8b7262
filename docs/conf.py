"""How Sphinx makes the site of this folder: ``make docs``. The pages are read on their own as well."""

from __future__ import annotations

import base64
import json
import re
from importlib import metadata
from pathlib import Path
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
napoleon_use_ivar = True  # what is listed under Attributes may have a docstring of its own
suppress_warnings = [
    "myst.xref_missing",  # to files of the repository beside this folder, which a reader on GitHub follows
    "misc.highlighting_failure",
    "toc.no_title",  # a table that a benchmark writes
]
exclude_patterns = ["conf.py"]

CHAPTERS = {
    "Begin": (
        *(f"tutorials/{name}" for name in ("own-files", "first-picture", "calibrate-and-analyse", "volumes")),
        *("tutorials/own-methods", "tutorials/*", "gallery"),
    ),
    "How to": ("how-to/*", "how-to/devices/*"),
    "Subjects": ("*",),
    "Reference": ("reference/*",),
    "Measured": ("benchmarks/*",),
    "Decisions": ("decisions/README", "decisions/*"),
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


def with_outputs(page: str, notebook: Path, images: Path) -> str:
    """Return a tutorial with what its notebook says and shows after each block of Python."""
    cells = json.loads(notebook.read_text("utf-8"))["cells"]
    outputs = iter([cell["outputs"] for cell in cells if cell["cell_type"] == "code"])
    images.mkdir(exist_ok=True)

    def shown(output: dict[str, Any], name: str) -> str:
        data = output.get("data", {"text/plain": output.get("text", "")})
        if "image/png" in data:
            (images / name).write_bytes(base64.b64decode(data["image/png"]))
            return f"![What the block above draws](../{images.name}/{name})"
        fence = "```{raw} html" if "text/html" in data else "```text"
        return f"{fence}\n{next(iter(data.values())).rstrip()}\n```"

    def after(block: re.Match[str]) -> str:
        name = f"{notebook.stem}-{block.start()}"
        told = [shown(output, f"{name}-{n}.png") for n, output in enumerate(next(outputs))]
        return "\n\n".join([block[0], *told])

    return re.sub(r"^```python\n.*?^```$", after, page, flags=re.M | re.S)


def on_source(app: Any, docname: str, source: list[str]) -> None:
    """Add to a page what only the site has."""
    if docname.startswith("tutorials/"):
        folder = Path(app.srcdir)
        source[0] = with_outputs(source[0], folder / f"{docname}.ipynb", folder / "_tutorials")
    if docname == root_doc:
        source[0] += contents()
    if docname == "reference/python":
        source[0] = source[0].replace("<!-- names -->", names())


def setup(app: Any) -> None:
    """Let Sphinx call :func:`on_source`."""
    app.connect("source-read", on_source)
