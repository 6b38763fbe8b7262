"""What is wrong with a plan."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pydantic import ValidationError

from instrument.files.errors import BenchError


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


def plan_problems(error: ValidationError) -> tuple[str, ...]:
    """Return a validation's findings as sentences that name the place."""
    mistakes = error.errors(include_url=False)
    places = [found["loc"] for found in mistakes]
    return tuple(
        f"{_place(found['loc'])}: {found['msg'].removeprefix('Value error, ')}"
        + (f" (found {found['input']!r:.80})" if not isinstance(found["input"], Mapping) else "")
        for found in mistakes
        # A list whose every item is wrong counts as empty too; its items' own mistakes say it better.
        if found["type"] != "too_short"
        or not any(place[: len(found["loc"])] == found["loc"] != place for place in places)
    )


def _place(location: tuple[int | str, ...]) -> str:
    return (
        "".join(f"[{item}]" if isinstance(item, int) else f".{item}" for item in location).lstrip(".")
        or "plan"
    )
