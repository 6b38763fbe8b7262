"""On which line of a TOML text each key stands; ``tomllib`` keeps no positions."""

from __future__ import annotations

import re

KeyPath = tuple[str | int, ...]
"""Names of tables and keys from the top; integers count the elements of arrays."""

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")
_BLANK = re.compile(r"(?:[ \t\r\n]|#[^\n]*)*")
_SPACE = re.compile(r"[ \t]*")
_SCALAR = re.compile(r"[^,\]}#\n]*")
_STRINGS = tuple(
    re.compile(pattern, re.DOTALL)
    for pattern in (
        r'"""(?:\\.|.)*?"""(?:"{0,2})(?!")',
        r"'''.*?'''(?:'{0,2})(?!')",
        r'"(?:\\.|[^"\\\n])*"',
        r"'[^'\n]*'",
    )
)


def key_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every key, table and array element of a TOML text.

    Parameters
    ----------
    text : str
        A text that ``tomllib`` accepts; of any other text, positions up to its first flaw are returned.

    Returns
    -------
    dict
        ``("camera", "roi", 0)`` to the line where that element begins. A table that several headers or
        dotted keys build up has the line of its first mention.
    """
    return _Scanner(text).scan()


class _FlawError(Exception):
    """The text is no TOML here."""


class _Scanner:
    def __init__(self, text: str) -> None:
        self._text = text
        self._at = 0
        self._line = 1
        self._counted_to = 0
        self._lines: dict[KeyPath, int] = {}
        self._tables_in_array: dict[KeyPath, int] = {}

    def scan(self) -> dict[KeyPath, int]:
        table: KeyPath = ()
        try:
            self._skip(_BLANK)
            while self._at < len(self._text):
                if self._peek("["):
                    table = self._header()
                else:
                    self._key_and_value(table)
                self._skip(_BLANK)
        except _FlawError:
            pass  # the caller reports tomllib's own message; lines found so far stay useful
        return self._lines

    # Statements --------------------------------------------------------------------------------
    def _header(self) -> KeyPath:
        line = self._line_here()
        is_array = self._text.startswith("[[", self._at)
        self._at += 2 if is_array else 1
        names = self._dotted_key()
        self._expect("]]" if is_array else "]")
        path: KeyPath = ()
        for depth, name in enumerate(names):
            path = (*path, name)
            if is_array and depth == len(names) - 1:
                self._lines.setdefault(path, line)
                index = self._tables_in_array.get(path, -1) + 1
                self._tables_in_array[path] = index
                path = (*path, index)
            elif path in self._tables_in_array:
                path = (*path, self._tables_in_array[path])
            self._lines.setdefault(path, line)
        return path

    def _key_and_value(self, table: KeyPath) -> None:
        line = self._line_here()
        path = table
        for name in self._dotted_key():
            path = (*path, name)
            self._lines.setdefault(path, line)
        self._expect("=")
        self._skip(_SPACE)
        self._value(path)

    def _dotted_key(self) -> list[str]:
        names = []
        while True:
            self._skip(_SPACE)
            names.append(self._simple_key())
            self._skip(_SPACE)
            if not self._peek("."):
                return names
            self._at += 1

    def _simple_key(self) -> str:
        if self._peek('"') or self._peek("'"):
            quoted = self._take(_STRINGS[2] if self._peek('"') else _STRINGS[3])
            return quoted[1:-1]
        return self._take(_BARE_KEY)

    # Values ------------------------------------------------------------------------------------
    def _value(self, path: KeyPath) -> None:
        if self._peek("["):
            self._array(path)
        elif self._peek("{"):
            self._inline_table(path)
        elif self._peek('"') or self._peek("'"):
            self._string()
        else:
            self._take(_SCALAR)

    def _array(self, path: KeyPath) -> None:
        self._at += 1
        index = 0
        while True:
            self._skip(_BLANK)
            if self._peek("]"):
                self._at += 1
                return
            self._lines.setdefault((*path, index), self._line_here())
            self._value((*path, index))
            index += 1
            self._separator("]")

    def _inline_table(self, path: KeyPath) -> None:
        self._at += 1
        while True:
            self._skip(_BLANK)
            if self._peek("}"):
                self._at += 1
                return
            self._key_and_value(path)
            self._separator("}")

    def _separator(self, closing: str) -> None:
        self._skip(_BLANK)
        if self._peek(","):
            self._at += 1
        elif not self._peek(closing):
            raise _FlawError

    def _string(self) -> None:
        for pattern in _STRINGS:
            match = pattern.match(self._text, self._at)
            if match:
                self._at = match.end()
                return
        raise _FlawError

    # Characters --------------------------------------------------------------------------------
    def _peek(self, character: str) -> bool:
        return self._text.startswith(character, self._at)

    def _skip(self, pattern: re.Pattern[str]) -> None:
        match = pattern.match(self._text, self._at)
        if match:
            self._at = match.end()

    def _take(self, pattern: re.Pattern[str]) -> str:
        match = pattern.match(self._text, self._at)
        if not match or match.end() == self._at:
            raise _FlawError
        self._at = match.end()
        return match.group()

    def _expect(self, mark: str) -> None:
        self._skip(_SPACE)
        if not self._peek(mark):
            raise _FlawError
        self._at += len(mark)

    def _line_here(self) -> int:
        self._line += self._text.count("\n", self._counted_to, self._at)
        self._counted_to = self._at
        return self._line
