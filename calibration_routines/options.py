"""What the declared options of routines share: units, headings, sizes, mistakes by name."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

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
        """Read ``ROWSxCOLUMNS``.

        Raises
        ------
        ValueError
            When the text is none.
        """
        return cls(*size(text))

    @property
    def shape(self) -> tuple[int, int]:
        """``(rows, columns)``."""
        return self.rows, self.columns

    def __str__(self) -> str:
        return f"{self.rows}x{self.columns}"


def problems_of(options: object) -> list[tuple[str, str]]:
    """Return what is wrong with declared options: their names, and words, as SettingsError takes them."""
    found = ((o.name, o.mistake(getattr(options, o.name))) for o in options_of(options))
    return [(name, words.rstrip(".")) for name, words in found if words is not None]
