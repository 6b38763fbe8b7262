"""What is raised for input that cannot be reconstructed."""

from __future__ import annotations


class InputError(ValueError):
    """Unusable input: the text says what was found, what was expected and what to do."""
