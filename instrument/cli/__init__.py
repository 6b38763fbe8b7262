"""The command line. Nothing but the standard library is imported until a command is chosen."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from instrument.cli.commands import COMMANDS, Command

USAGE = "Usage: diffuserbench [--debug] COMMAND [OPTIONS]"
EXAMPLES = """\
Examples:
  diffuserbench demo                         the main job on the simulated bench
  diffuserbench new                          write bench.toml, with every key explained
  diffuserbench check                        open every device, report, end with the light off
  diffuserbench snap --out photo.tif         take a photograph
  diffuserbench reconstruct --psf psf.tif --image raw.tif --out scene.tif
"""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (0 done, 1 device failed, 2 mistake, 130 Ctrl-C)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    if debug:
        words.remove("--debug")
    if words and words[0] == "help":
        words = [*words[1:2], "--help"]  # help COMMAND is COMMAND --help
    if not words or words[0] in ("--help", "-h"):
        sys.stdout.write(overview())
        return 0
    if words[0] in ("--version", "-V", "version"):
        from importlib.metadata import version

        sys.stdout.write(f"diffuserbench {version('diffuserbench')}\n")
        return 0
    name, *rest = words
    command = COMMANDS.get(name)
    if command is None:
        sys.stderr.write(_unknown(name))
        return 2
    try:
        from instrument.cli.dispatch import run_command

        return run_command(name, command, rest, debug=debug)
    except KeyboardInterrupt:  # so early, or so late, that run_command could not say it
        sys.stderr.write("interrupted.\n")
        return 130


def overview() -> str:
    """Return what ``diffuserbench`` alone prints: what one can do, with examples."""
    width = max(len(name) for name in COMMANDS) + 2
    lines = [
        "diffuserbench runs a computational-optics bench: cameras behind a diffuser, and what they see.",
        "Without hardware it runs on the built-in simulated bench.",
        "",
        USAGE,
    ]
    group = ""
    for name, command in COMMANDS.items():
        if command.group != group:
            group = command.group
            lines += ["", f"{group}:"]
        lines.append(f"  {name:<{width}}{command.help}")
    lines += [
        "",
        "Options:",
        f"  {'--help':<{width}}  this page; diffuserbench COMMAND --help for one command",
        f"  {'--version':<{width}}  the program's version",
        f"  {'--debug':<{width}}  show the traceback of an error (or set DIFFUSERBENCH_DEBUG=1)",
        "",
        EXAMPLES,
    ]
    return "\n".join(lines)


def _unknown(name: str) -> str:
    import difflib

    if name.startswith("-"):
        problem = f"diffuserbench: there is no option {name!r} before a command."
    else:
        close = difflib.get_close_matches(name, COMMANDS, n=1)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        problem = f"diffuserbench: there is no command {name!r}.{hint}"
    return f"{problem}\n{USAGE}\nCommands: {', '.join(COMMANDS)}\n"


__all__ = ["COMMANDS", "Command", "main", "overview"]
