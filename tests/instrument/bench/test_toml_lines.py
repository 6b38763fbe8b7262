"""Every key of a TOML text is found on its line."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

from instrument.bench.config_mistakes import key_lines

TRICKY = '''\
# [not.a.table]
top = 1
"quoted key".inner = """
not = "a key"
[nor.a.table]
"quotes" at the end"""""
literal = \'\'\'
x = 1\'\'\'

[a.b]   # comment with = and [brackets]
dotted.key = { one = 1, two = [ "]", "}" ], "th ree" = { four = 4 } }
escaped = "a \\" quote # no comment"
array = [
  1,  # first
  # nothing = here
  [2, 3],
  { x = 1 },
]
date = 1979-05-27T07:32:00Z
float = -1.5e3

[[list]]
name = 'first'
[list.sub]
deep = true
[[list]]
name = "second"
[[list.nested]]
v = 1
[[list.nested]]
v = 2
'''

EXPECTED = {
    ("top",): 2,
    ("quoted key",): 3,
    ("quoted key", "inner"): 3,
    ("literal",): 7,
    ("a",): 10,
    ("a", "b"): 10,
    ("a", "b", "dotted", "key", "two", 1): 11,
    ("a", "b", "dotted", "key", "th ree", "four"): 11,
    ("a", "b", "escaped"): 12,
    ("a", "b", "array"): 13,
    ("a", "b", "array", 0): 14,
    ("a", "b", "array", 1, 1): 16,
    ("a", "b", "array", 2, "x"): 17,
    ("a", "b", "date"): 19,
    ("a", "b", "float"): 20,
    ("list",): 22,
    ("list", 0, "name"): 23,
    ("list", 0, "sub", "deep"): 25,
    ("list", 1): 26,
    ("list", 1, "name"): 27,
    ("list", 1, "nested", 0, "v"): 29,
    ("list", 1, "nested", 1, "v"): 31,
}


@pytest.mark.parametrize(("path", "line"), EXPECTED.items(), ids=str)
def test_each_key_has_its_line(path: tuple[str | int, ...], line: int) -> None:
    assert key_lines(TRICKY)[path] == line


def _paths(value: Any, path: tuple[str | int, ...] = ()) -> set[tuple[str | int, ...]]:
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    found = {path} if path else set()
    for key, inner in parts:
        found |= _paths(inner, (*path, key))
    return found


def test_exactly_the_keys_that_the_toml_reader_sees_are_found() -> None:
    assert set(key_lines(TRICKY)) == _paths(tomllib.loads(TRICKY))


def test_windows_line_ends_count_once() -> None:
    assert key_lines("a = 1\r\n\r\n[t]\r\nb = 2\r\n")[("t", "b")] == 4


def test_a_broken_text_gives_the_lines_before_its_flaw() -> None:
    assert key_lines("a = 1\nb = [1\nc = = 2") == {("a",): 1, ("b",): 2, ("b", 0): 2}
