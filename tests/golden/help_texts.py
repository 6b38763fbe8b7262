"""The help of every command, at a fixed width and without colours."""

from __future__ import annotations

import os
import re
from pathlib import Path
from unittest import mock

from tests.golden import adapter

FOLDER = Path(__file__).parent / "help"
_PLAIN = {"COLUMNS": "110", "TERMINAL_WIDTH": "110", "NO_COLOR": "1", "TERM": "dumb"}


def path_of(words: tuple[str, ...]) -> Path:
    """Return the file of a command's help."""
    return FOLDER / ("-".join(words or ("diffuserbench",)) + ".txt")


def text_of(words: tuple[str, ...]) -> str:
    """Return a command's help; trailing blanks are cut."""
    with mock.patch.dict(os.environ, _PLAIN):
        code, said = adapter.command(*words, "--help")
    assert code == 0, said
    return re.sub(r"[ \t]+\n", "\n", said)


def record() -> list[str]:
    """Write all help texts; return which changed."""
    FOLDER.mkdir(exist_ok=True)
    said, paths = [], set()
    for words in adapter.command_names():
        path, text = path_of(words), text_of(words)
        paths.add(path)
        if not path.exists() or path.read_text() != text:
            said.append(f"{path.name}: {'changed' if path.exists() else 'new'}")
            path.write_text(text)
    for path in sorted(set(FOLDER.glob("*.txt")) - paths):
        path.unlink()
        said.append(f"{path.name}: removed")
    return said
