"""What happens to a file: each takes it, and the file of its name in another run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path


def deleted(path: Path, _: Path) -> None:
    path.unlink()


def truncated(path: Path, _: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def one_bit(path: Path, _: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 3] ^= 1
    path.write_bytes(data)


def zeroed(path: Path, _: Path) -> None:
    path.write_bytes(bytes(path.stat().st_size))


def anothers(path: Path, other: Path) -> None:
    shutil.copyfile(other, path)


def newer(path: Path, _: Path) -> None:
    """As a later version of this program writes it: with a field more, and its own number."""
    text = path.read_text("latin-1")
    text = re.sub(r'("(?:version|format|zarr_format)": )\d+', r"\g<1>99", text)
    path.write_text(re.sub(r"^\{", '{"later": 1, ', text, count=1), "latin-1")


def older(path: Path, _: Path) -> None:
    """As it was when the run began: its first half, or its first line, or (an array) of fewer frames."""
    text = path.read_text("latin-1")
    text = re.sub(r'"shape": \[\s*3,', '"shape": [1,', text.replace("completed", "running"))
    path.write_text(text.partition("\n")[0] + "\n" if path.suffix == ".jsonl" else text, "latin-1")


DAMAGES = (deleted, truncated, one_bit, zeroed, anothers, newer, older)
