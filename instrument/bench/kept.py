"""Small things that people keep with a bench: settings of its camera by name, places of its stage."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

from instrument.files.atomic import write_json
from instrument.files.errors import FileError

FILE = "kept-with-bench.json"


class KeptWithBench:
    """Values by kind and name, in a JSON file of the bench's data folder.

    Parameters
    ----------
    folder : Path
        The bench's data folder; made when something is kept first.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / FILE
        self._kept: dict[str, dict[str, Any]] = {}
        self._lock = threading.Lock()
        self._problem: FileError | None = None
        self._was_read = False

    def read(self) -> None:
        """Read what was kept, once; nothing where there is no file. From any thread.

        Raises FileError when the file is damaged; it is left as it is, and nothing is kept over it.
        """
        with self._lock:
            if not self._was_read:
                self._was_read = True
                try:
                    self._read()
                except FileError as error:
                    self._problem = error
                    raise

    def _read(self) -> None:
        try:
            kept = json.loads(self.path.read_text("utf-8"))
        except FileNotFoundError:
            return
        except (OSError, ValueError) as error:
            raise FileError(self.path, f"cannot be read: {error}.", "Move it away to begin anew.") from error
        if not isinstance(kept, dict) or not all(isinstance(values, dict) for values in kept.values()):
            raise FileError(self.path, "holds no values by kind and name.", "Move it away to begin anew.")
        self._kept = kept

    def of(self, kind: str) -> dict[str, Any]:
        """Return what is kept of a kind, by name."""
        return dict(self._kept.get(kind, {}))

    def put(self, kind: str, name: str, value: Any) -> None:
        """Keep a value under a name; None: keep nothing there. In memory, until ``write``."""
        values = self._kept.setdefault(kind, {})
        if value is None:
            values.pop(name, None)
        else:
            values[name] = value

    def write(self) -> None:
        """Write everything, whole or not at all.

        Raises FileError, OSError when it cannot be written.
        """
        if self._problem is not None:
            raise self._problem
        self.path.parent.mkdir(parents=True, exist_ok=True)
        write_json(self.path, self._kept)
