"""What ``import diffuserbench`` offers says what it takes, what it returns and what it raises."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import itertools
import re
import textwrap
from collections.abc import Iterator
from typing import Any

import pytest

import diffuserbench as db

OFFERED = {name: getattr(db, name) for name in dir(db) if not name.startswith("_")}
FUNCTIONS = {name: found for name, found in OFFERED.items() if inspect.isfunction(found)}
CLASSES = {name: found for name, found in OFFERED.items() if inspect.isclass(found)}


def unsaid(function: Any) -> Iterator[str]:
    """Yield what a function does not say of itself; its single options by name are declared."""
    text = inspect.getdoc(function) or ""
    signature = inspect.signature(inspect.unwrap(function))
    section = text.partition("Parameters\n----------\n")[2].split("\n\n")[0]
    heads = [line.partition(" : ")[0] for line in section.splitlines() if not line.startswith(" ")]
    named = set(re.findall(r"\w+", " ".join([*heads, *re.findall("``.*?``", text)])))
    yield from (f"parameter {name}" for name in signature.parameters if name not in named)
    if signature.return_annotation != "None" and not re.search(r"^Returns\n-+\n", text, re.MULTILINE):
        yield "what it returns, in a section of its own"
    if not re.search(r"[Rr]aises|[Ee]rrors as", text):
        yield "what it raises"


def told_fields(cls: type) -> set[str]:
    """Return the fields with a docstring of their own, of a class and those that it is made of."""
    found = set()
    for one in cls.__mro__[:-1]:
        tree = ast.parse(textwrap.dedent(inspect.getsource(one)))
        body = next(n for n in ast.walk(tree) if isinstance(n, ast.ClassDef)).body
        for field, after in itertools.pairwise(body):
            if isinstance(field, ast.AnnAssign) and isinstance(after, ast.Expr):
                found.add(ast.unparse(field.target))
    return found


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_says_what_it_takes_returns_and_raises(name: str) -> None:
    assert list(unsaid(FUNCTIONS[name])) == []


@pytest.mark.parametrize("name", CLASSES)
def test_a_class_says_what_it_is_and_what_its_methods_do(name: str) -> None:
    cls = CLASSES[name]
    assert cls.__doc__
    silent = [
        member
        for member, found in inspect.getmembers_static(cls)
        if not member.startswith("_")
        and isinstance(found, property | staticmethod | classmethod | type(unsaid))
        and not inspect.getdoc(found)
    ]
    if dataclasses.is_dataclass(cls):
        words = set(re.findall(r"\w+", " ".join(one.__doc__ or "" for one in cls.__mro__[:-1])))
        fields = {one.name for one in dataclasses.fields(cls) if not one.name.startswith("_")}
        declared = {one.name for one in dataclasses.fields(cls) if "declared" in one.metadata}
        silent = [one for one in silent if one not in fields] + sorted(
            fields - declared - words - told_fields(cls)
        )
    assert silent == []


def test_what_is_not_said_is_found() -> None:
    def silent(psf: object, *, iterations: int = 3) -> float:  # noqa: ARG001
        """Do something with a ``psf``."""
        return 0.0

    assert list(unsaid(silent)) == [
        "parameter iterations",
        "what it returns, in a section of its own",
        "what it raises",
    ]
