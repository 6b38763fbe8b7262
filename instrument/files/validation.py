"""What pydantic finds wrong with a value, in the words of a file that somebody wrote."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails

_STARTS = (
    ("Input should be a valid ", "must be a "),
    ("Input should be ", "must be "),
    ("Value error, ", ""),
)
_WORDS = (
    ("a array", "an array"),
    ("a integer", "an integer"),
    ("an object", "a table"),
    ("a object", "a table"),
    ("string", "text"),
    ("boolean", "true or false"),
)


def in_words(detail: ErrorDetails) -> str:
    """Return what is wrong, without the place and the value that was found."""
    if detail["type"] == "missing":
        is_item = bool(detail["loc"]) and isinstance(detail["loc"][-1], int)
        return f"this {'value' if is_item else 'key'} is missing"
    message = detail["msg"]
    for start, instead in _STARTS:
        if message.startswith(start):
            message = instead + message.removeprefix(start)
            break
    for word, instead in _WORDS:
        message = message.replace(word, instead)
    return message
