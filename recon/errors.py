"""What is raised for input that cannot be reconstructed."""

from __future__ import annotations


class InputError(ValueError):
    """Unusable input: the text says what was found, what was expected and what to do."""


class StructureError(InputError, TypeError):
    """A solver has no way for this kind of operator or prior; the text says which solver may."""


class NoSuchNameError(InputError, KeyError):
    """Nothing is registered under a name; the text says what is."""

    __str__ = Exception.__str__


class NoMemoryError(InputError, MemoryError):
    """The memory that may be taken does not hold the problem; the text says how much it needs."""
