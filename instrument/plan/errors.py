"""What is wrong with a plan."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from instrument.errors import BenchError


class PlanError(BenchError):
    """A plan that cannot be carried out: every reason at once. Nothing has moved.

    Parameters
    ----------
    name : path or str
        The plan's file or label.
    problems : sequence of str
    """

    def __init__(self, name: Path | str, problems: Sequence[str]) -> None:
        self.name = name
        self.problems = tuple(problems)
        count = len(self.problems)
        head = f"{name}: {count} problem{'s' if count != 1 else ''} in the plan. Nothing has moved."
        super().__init__("\n  ".join((head, *self.problems)))
