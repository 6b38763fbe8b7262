"""Command lines in the documentation, in README and in the commands' own examples are understood."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
import typer

from instrument.cli import COMMANDS

ROOT = Path(__file__).parents[2]
OF_ONES_OWN = {("calibrate", "cross")}
"""Commands that a page shows how to add."""
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LINE = re.compile(r"(?:^\s*(?:\$ )?|`)diffuserbench ([a-z0-9.]+)((?: [^`\n]*)?)", re.MULTILINE)


def options_of(name: str, rest: list[str]) -> set[str]:
    """Return the option names of a command or, where it has some, of the subcommand that ``rest`` names."""
    parser = typer.main.get_command(COMMANDS[name].load())
    inner = getattr(parser, "commands", {})
    asked = rest[0] if rest and rest[0] in inner else getattr(parser, "meant", None)
    if asked is not None:
        parser = inner[asked]
    return {flag for param in parser.params for flag in (*param.opts, *param.secondary_opts)} | {"--help"}


def command_lines(text: str) -> list[tuple[str, list[str]]]:
    found = []
    for name, rest in LINE.findall(text):
        typed = re.split(r"\s{2,}|\s#|\s[|>&]\s|;", rest.strip())[0].rstrip("\\")
        try:
            found.append((name, shlex.split(typed)))
        except ValueError:  # prose with an apostrophe
            continue
    return found


def unknown(name: str, words: list[str]) -> list[str]:
    if (name, *words[:1]) in OF_ONES_OWN:
        return []
    flags = [re.split(r"[=,)]", word)[0] for word in words if re.match(r"--?[a-zA-Z]", word)]
    return [flag for flag in flags if flag not in options_of(name, words) | {"--debug"}]


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_documented_command_lines_have_options_that_exist(page: Path) -> None:
    lines = command_lines(page.read_text("utf-8"))
    if "decisions" not in page.parts:  # what was decided once may be about what was once
        assert [name for name, _ in lines if name not in COMMANDS] == []
        assert [(name, words, wrong) for name, words in lines if (wrong := unknown(name, words))] == []


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_examples_of_help_have_options_that_exist(name: str) -> None:
    parser = typer.main.get_command(COMMANDS[name].load())
    for command in getattr(parser, "commands", {"": parser}).values():
        lines = command_lines((command.epilog or "").replace("\b", ""))
        assert len(lines) > 0
        assert [(words, wrong) for shown, words in lines if (wrong := unknown(shown, words))] == []
