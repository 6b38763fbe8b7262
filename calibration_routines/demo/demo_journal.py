"""What a demo left where: its state, its stages and their times, in one file that is always whole."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from instrument.files.atomic import write_text
from instrument.files.errors import FileError

FILE = "demo.json"


def new_folder(parent: Path) -> Path:
    """Make a folder ``demo-DATE-TIME`` in ``parent``, which is made as well where missing.

    Raises
    ------
    FileError
        When it cannot be made.
    """
    name = f"demo-{datetime.now(UTC):%Y-%m-%d-%H%M%S}"
    for suffix in ("", *(f"-{n}" for n in range(2, 100))):
        folder = parent / f"{name}{suffix}"
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            if not parent.is_dir():
                raise FileError(parent, "is no folder.", "Name a folder with --out.") from None
            continue
        except OSError as error:
            raise FileError(folder, f"cannot be made: {error.strerror or error}.") from error
        return folder
    raise FileError(parent / name, "and 98 more of the same second exist already.")


class Journal:
    """The demo's record, ``demo.json`` in its folder; written from the first :meth:`note` on.

    Attributes
    ----------
    seconds : dict
        Name of each stage done to the seconds it took, in order.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self.seconds: dict[str, float] = {}
        self._record: dict[str, Any] = {}

    def note(self, **entries: Any) -> None:
        """Add entries (JSON-compatible) and write the file."""
        self._record |= entries
        self._write()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; while it runs the file names it."""
        self.note(stage=name)
        started = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = round(time.perf_counter() - started, 2)

    def _write(self) -> None:
        write_text(self.path, json.dumps(self._record | {"seconds": self.seconds}, indent=1) + "\n")
