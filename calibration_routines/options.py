"""Options that routines share: lengths in millimetres, rows and columns, one error of all that is wrong."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from instrument.files.errors import SettingsError
from recon.base.declare import options_of
from recon.base.option_text import size

MM: dict[str, Any] = {"unit": "um", "shown_unit": "mm", "shown_factor": 1e3}
"""For ``option``: lengths in micrometres, which people think of in millimetres."""


@dataclass(frozen=True, slots=True)
class Size:
    """Rows and columns, written as ``5x5``."""

    rows: int
    columns: int

    @classmethod
    def of(cls, text: str) -> Size:
        """Read ``ROWSxCOLUMNS``; ValueError when the text is none."""
        return cls(*size(text))

    @property
    def shape(self) -> tuple[int, int]:
        """``(rows, columns)``."""
        return self.rows, self.columns

    def __str__(self) -> str:
        return f"{self.rows}x{self.columns}"


class Checked:
    """Base of a routine's options: all that is wrong with them is one SettingsError when they are made."""

    def __post_init__(self) -> None:
        found = ((o.name, o.mistake(getattr(self, o.name))) for o in options_of(self))
        problems = [(name, words.rstrip(".")) for name, words in found if words is not None]
        problems += self.disagreements({name for name, _ in problems})
        if problems:
            raise SettingsError(problems)

    def disagreements(self, wrong: Collection[str]) -> list[tuple[str, str]]:
        """Return what does not fit together: a setting's name, and words; ``wrong`` are named already."""
        return []
