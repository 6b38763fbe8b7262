"""The tutorials as notebooks: a page's blocks carried out as Jupyter does, with what they say and show.

``python -m tests.tutorials NAME ...`` (without names: all) writes ``docs/tutorials/NAME.ipynb`` anew. The
page is the source; notebooks are made from it, and ``tests/test_tutorials.py`` holds them to it.
"""

from __future__ import annotations

import base64
import contextlib
import hashlib
import io
import json
import os
import re
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

FOLDER = Path(__file__).parents[1] / "docs" / "tutorials"
PAGES = sorted(FOLDER.glob("*.md"))

Cell = tuple[str, str]
Outputs = list[dict[str, Any]]


def cells_of(page: Path) -> list[Cell]:
    """Return a page's cells in order: (kind, text). The line about the notebook itself is left out."""
    cells: list[Cell] = []
    for part in re.split(r"^(```python\n.*?^```$)", page.read_text("utf-8"), flags=re.M | re.S):
        code = re.fullmatch(r"```python\n(.*?)\n?```", part, re.S)
        words = re.sub(rf"^.*\({page.stem}\.ipynb\).*\n", "", part, flags=re.M).strip()
        if code or words:
            cells.append(("code", code[1]) if code else ("markdown", words))
    return cells


@contextlib.contextmanager
def _shell() -> Iterator[Any]:
    """Make IPython as a notebook has it, without the processes around; as it was after it."""
    import matplotlib
    from IPython.core.interactiveshell import InteractiveShell
    from IPython.core.pylabtools import select_figure_formats
    from matplotlib import pyplot
    from traitlets.config import Config

    class Shell(InteractiveShell):  # type: ignore[misc]
        def enable_gui(self, gui: str | None = None) -> None: ...

    backend, style = matplotlib.get_backend(), dict(matplotlib.rcParams)
    config = Config({"HistoryManager": {"enabled": False}, "InteractiveShell": {"colors": "nocolor"}})
    shown, shell = sys.displayhook, Shell.instance(config=config)
    pyplot.close("all")  # a cell shows every figure that is open
    try:
        shell.enable_matplotlib("inline")
        select_figure_formats(shell, {"png"})
        matplotlib.rcParams["savefig.dpi"] = 72
        yield shell
    finally:
        pyplot.close("all")
        pyplot.switch_backend(backend)
        matplotlib.rcParams.update(style)
        Shell.clear_instance()
        sys.displayhook = shown


def carried_out(cells: Sequence[Cell], folder: Path) -> list[Outputs]:
    """Carry the code cells out in a folder, one after the other, and return what each says and shows.

    Raises whatever a cell raises; warnings are errors.
    """
    from IPython.utils.capture import capture_output

    said: list[Outputs] = []
    with _shell() as shell, contextlib.chdir(folder), warnings.catch_warnings():
        warnings.simplefilter("error")
        for code in [text for kind, text in cells if kind == "code"]:
            with capture_output() as captured:
                shell.display_trap.hook = sys.displayhook
                shell.run_cell(code, store_history=False).raise_error()
            text = (captured.stdout + captured.stderr).replace(f"{folder}/", "")
            said.append([{"output_type": "stream", "name": "stdout", "text": text}] if text else [])
            said[-1] += [_displayed(output.data, folder) for output in captured.outputs]
    return said


def _displayed(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return an output for a notebook: of several forms the richest, pictures in 128 colours."""
    if "image/png" in data:
        kept = {"image/png": _small(data["image/png"])}
    else:
        kind = "text/html" if "text/html" in data else "text/plain"
        kept = {kind: data[kind].replace(f"{folder}/", "")}
    return {"output_type": "display_data", "metadata": {}, "data": kept}


def _small(png: bytes | str) -> str:
    from PIL import Image

    picture = Image.open(io.BytesIO(png if isinstance(png, bytes) else base64.b64decode(png)))
    made = io.BytesIO()
    picture.convert("RGB").quantize(128, dither=Image.Dither.NONE).save(made, "PNG", optimize=True)
    return base64.b64encode(made.getvalue()).decode()


def notebook_of(cells: Sequence[Cell], outputs: Sequence[Outputs]) -> dict[str, Any]:
    """Return a notebook, nbformat 4.5."""
    left = iter(outputs)
    made: list[dict[str, Any]] = []
    for place, (kind, text) in enumerate(cells):
        digest = hashlib.sha256(f"{place}{text}".encode()).hexdigest()[:8]
        cell = {"cell_type": kind, "id": digest, "metadata": {}, "source": text.splitlines(keepends=True)}
        made.append(cell | ({"execution_count": None, "outputs": next(left)} if kind == "code" else {}))
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    about = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": made, "metadata": about, "nbformat": 4, "nbformat_minor": 5}


def differences(code: str, kept: Outputs, found: Outputs) -> list[str]:
    """Say where what a cell says and shows now differs from what the notebook holds.

    Numbers may differ by 5 %, seconds and dates by anything, pictures by 4 % of full scale in the mean. A
    cell that says of itself that it differs from run to run is carried out, and not compared.
    """
    if "differs from run to run" in code:
        return []
    if len(kept) != len(found):
        return [f"{len(kept)} outputs kept, {len(found)} found"]
    wrong: list[str] = []
    for old, new in zip(map(_parts, kept), map(_parts, found), strict=True):
        if _words(old[0]) != _words(new[0]) or not _close(_numbers(old[0]), _numbers(new[0])):
            wrong.append(f"kept:\n{old[0]}\nfound:\n{new[0]}")
        for before, after in zip(old[1], new[1], strict=True):
            if before.shape != after.shape or np.abs(before - after).mean() > 0.04 * 255:
                wrong.append(f"a picture of {before.shape} pixels, found {after.shape}")
    return wrong


def _parts(output: dict[str, Any]) -> tuple[str, list[np.ndarray]]:
    """Return an output's text, and its pictures as floats."""
    from matplotlib.image import imread

    data = output.get("data", {"text/plain": output.get("text", "")})
    whole = "".join(data.get("text/html") or data.get("text/plain") or "")
    pngs = re.findall(r"base64,([^']+)'", whole) + [data[k] for k in ("image/png",) if k in data]
    pictures = [255 * imread(io.BytesIO(base64.b64decode(png))).astype(float) for png in pngs]
    return re.sub(r"<[^>]+>", " ", whole), pictures


_UNSTEADY = re.compile(r"\d{4}-?\d\d-?\d\d\S*|[\d.]+ (?:ms|s|min|[kKMG]i?B)\b|/\S+")
_NUMBER = re.compile(r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?")


def _words(text: str) -> list[str]:
    return _NUMBER.sub("", _UNSTEADY.sub("", text)).split()


def _numbers(text: str) -> np.ndarray:
    return np.array([float(number) for number in _NUMBER.findall(_UNSTEADY.sub("", text))])


def _close(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=0.05, atol=0.011))


def main(names: Sequence[str]) -> None:
    """Write the notebooks of some pages, or of all."""
    os.environ.setdefault("IPYTHONDIR", tempfile.mkdtemp())
    for page in PAGES:
        if names and page.stem not in names:
            continue
        cells, began = cells_of(page), time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            notebook = notebook_of(cells, carried_out(cells, Path(folder)))
        target = page.with_suffix(".ipynb")
        target.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")
        print(f"{target.name}: {target.stat().st_size / 1e3:.0f} kB, {time.process_time() - began:.1f} CPU s")


if __name__ == "__main__":
    main(sys.argv[1:])
