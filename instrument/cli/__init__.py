"""The command line: the table of commands, and what runs them.

Nothing but the standard library and the table of tasks is imported until a command is chosen. A new command
is one row of the table and one :class:`~instrument.cli.app.App`: ``app`` of its module, or ``module:name``.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

from instrument.tasks import TASKS

if TYPE_CHECKING:
    from instrument.cli.app import App


USAGE = "Usage: diffuserbench [--debug] COMMAND [OPTIONS]"
EXAMPLES = """\
Examples:
  diffuserbench demo                         the main job on the simulated bench
  diffuserbench new                          write bench.toml, with every key explained
  diffuserbench check                        open every device, report, end with the light off
  diffuserbench snap --out photo.tif         take a photograph
  diffuserbench reconstruct --psf psf.tif --image raw.tif --out scene.tif
"""


_TELLING = 3
"""Letters of a command from which it is guessed where several begin so."""


class Command(NamedTuple):
    """A row of the table; ``place``, in this package, is imported only when the command is used."""

    group: str
    help: str
    place: str

    def load(self) -> App:
        """Import the command's application."""
        import importlib

        module, _, name = self.place.partition(":")
        app: App = getattr(importlib.import_module(f"instrument.cli.{module}"), name or "app")
        return app


def _task(group: str, name: str) -> Command:
    """Return the row of a task: the window offers it, too."""
    return Command(group, TASKS[name].help, f"tasks:{name}")


BENCH = "The bench"
ACQUISITION = "Acquisition"
RECONSTRUCTION = "Reconstruction"
ANALYSIS = "Calibration and analysis"
DISPLAY = "Holographic display"

COMMANDS: Mapping[str, Command] = {
    "demo": Command(BENCH, "the main job, start to end, on the simulated bench", "demo"),
    "gui": Command(BENCH, "the desktop program: live view, stage, sweeps, results", "bench:gui_app"),
    "new": Command(BENCH, "write a commented bench.toml (simulated by default)", "bench:new_app"),
    "check": Command(BENCH, "open every device of the bench and report on it", "bench:check_app"),
    "drivers": Command(BENCH, "list the installed drivers by kind of device", "bench:drivers_app"),
    "devices": Command(
        BENCH,
        "list what is connected: USB, HID, serial, video, GenICam, displays",
        "bench:devices_app",
    ),
    "serve": Command(BENCH, "offer the devices to another computer, and a page in the browser", "serve"),
    "test": Command(BENCH, "test this installation: files, cameras, solvers, simulated bench", "selftest"),
    "completion": Command(BENCH, "print completions for bash, zsh and fish", "completion"),
    "calibrate": Command(BENCH, "measure PSFs, the sensor, the diffuser, or an SLM", "calibrate"),
    "snap": Command(BENCH, "take a photograph", "capture:snap_app"),
    "plan": Command(ACQUISITION, "look at a plan before anything moves, or write one", "plan"),
    "run": Command(ACQUISITION, "carry out a plan", "runs:run_app"),
    "resume": Command(ACQUISITION, "go on with a run that did not end", "runs:resume_app"),
    "record": Command(ACQUISITION, "record video at full camera rate", "capture:record_app"),
    "list": Command(ACQUISITION, "list the runs in a folder", "runs:list_app"),
    "show": Command(ACQUISITION, "say what is in a run; or show a hologram on the SLM", "show"),
    "verify": _task(ACQUISITION, "verify"),
    "export": _task(ACQUISITION, "export"),
    "import": _task(ACQUISITION, "import"),
    "reconstruct": Command(
        RECONSTRUCTION, "reconstruct the scene from a PSF and a photograph", "reconstruct"
    ),
    "activity": _task(RECONSTRUCTION, "activity"),
    "points": _task(RECONSTRUCTION, "points"),
    "analyze": _task(ANALYSIS, "analyze"),
    "compare": _task(ANALYSIS, "compare"),
    "optics": _task(ANALYSIS, "optics"),
    "chart": Command(ANALYSIS, "time and memory against error, for every method", "tasks:chart"),
    "stability": _task(ANALYSIS, "stability"),
    "refocus": _task(ANALYSIS, "refocus"),
    "hologram": Command(
        DISPLAY, "compute the SLM phase that shows a picture through the mask", "display:hologram_app"
    ),
    "align": Command(DISPLAY, "find the scattering mask and bring it to its place", "calibrate:align_app"),
    "table7.1": _task(DISPLAY, "table7.1"),
    "etendue": _task(DISPLAY, "etendue"),
}


def console() -> int:
    """Run the command line as the program's whole life; returns the exit status.

    Where a daemon thread goes on (a job of the window, a driver's call that hangs, or only the one that
    closes benches at exit), the process ends here, after all that is done when Python ends: foreign code that
    comes back to an interpreter that is ending aborts it, with a status that says nothing.
    """
    status = main()
    if any(thread.daemon for thread in threading.enumerate()):
        threading._shutdown()  # type: ignore[attr-defined]  # waits for all others
        try:
            atexit._run_exitfuncs()
        except Exception:  # noqa: BLE001 - told by atexit; the process ends all the same
            status = status or 1
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except (OSError, ValueError, AttributeError):  # whoever read it has gone, or never was
                status = status or 1
        os._exit(status)
    return status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status (0 done, 1 device failed, 2 mistake, 130 Ctrl-C)."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in words
    if debug:
        words.remove("--debug")
    if words and words[0] == "help":
        words = [*words[1:], "--help"]  # help COMMAND is COMMAND --help
    try:
        status = _carried_out(words, debug=debug)
        if sys.stdout is not None and not sys.stdout.closed:
            sys.stdout.flush()
    except KeyboardInterrupt:  # so early, or so late, that run_command could not say it
        sys.stderr.write("interrupted.\n")
        return 130
    except BrokenPipeError as error:
        if not is_unread(error):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # where the rest goes
        return 128 + signal.SIGPIPE
    return status


def is_unread(error: BaseException) -> bool:
    """Whether whoever read what the program prints has gone: ``| head`` has seen enough."""
    return isinstance(error, BrokenPipeError) and error.filename is None


def _carried_out(words: Sequence[str], *, debug: bool) -> int:
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
    from instrument.cli.app import run_command

    return run_command(name, command, rest, debug=debug)


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
        begin = [one for one in COMMANDS if one.startswith(name)]
        meant = begin if len(begin) == 1 or len(name) >= _TELLING else []
        close = meant or difflib.get_close_matches(name, COMMANDS)
        hint = f" Did you mean {close[0]!r}?" if close else ""
        problem = f"diffuserbench: there is no command {name!r}.{hint}"
    return f"{problem}\n{USAGE}\nCommands: {', '.join(COMMANDS)}\n"
