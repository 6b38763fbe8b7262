"""What all commands share: options, help texts, opening a bench, running one with its errors as sentences."""

from __future__ import annotations

import difflib
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any
from zlib import crc32

import typer

from drivers.errors import DeviceError, LimitError
from instrument.cli import Command, is_unread
from instrument.cli.options import USAGE_ERROR, GroupedCommand, flat
from instrument.files import kept_times
from instrument.files.errors import BenchError, OperatorNeededError, in_words
from recon.base.declare import option

if TYPE_CHECKING:
    from instrument.bench.bench import Bench
    from instrument.bench.config import BenchConfig
    from instrument.runs.run import Run


BenchOption = Annotated[
    Path | None,
    typer.Option(
        "--bench",
        "-b",
        metavar="FILE",
        help="Bench configuration. Default: bench.toml in this folder, else the built-in simulated bench.",
        show_default=False,
    ),
]


@dataclass(frozen=True, kw_only=True)
class RunFolder:
    """Where a run goes."""

    out: Path | None = option(
        None,
        help="Where the run's folder is made.",
        default_words="data_folder of bench.toml",
        metavar="FOLDER",
        flags=("--out", "-o"),
        group="Files",
    )
    figure: Path | None = option(
        None, help="Also a page: up to twelve of its frames (.png, .pdf, .svg).", group="Files"
    )

    def check(self) -> None:
        """Refuse a page that cannot be written, and a folder within another run, before anything moves."""
        from instrument.files.figures import check_figure
        from instrument.runs.run_files import refuse_within

        if self.out is not None:
            refuse_within(self.out)
        if self.figure is not None:
            check_figure(self.figure, overwrite=None)

    def draw(self, run: Run) -> None:
        """Draw the page where one is wanted."""
        if self.figure is None:
            return
        from instrument.cli.progress import one_task
        from instrument.runs.inspection import contact_sheet

        with one_task("Drawing"):
            drawn = contact_sheet(run, self.figure)
        typer.echo(f"Wrote {self.figure}" if drawn else f"{self.figure} is not drawn: the run has no frames.")


_HELP = ("--help", "-h")


class App(typer.Typer):
    """A typer application whose commands may take options objects, in the house style: plain help.

    ``usual``: of several commands the one that is meant where none is named.
    """

    def __init__(self, help_text: str = "", *, usual: str | None = None) -> None:
        class Group(typer.core.TyperGroup):
            meant = usual

            def names_none(self, first: list[str]) -> bool:
                """Whether there is no command's name to be read, right or wrong."""
                return not first or (first[0].startswith("-") and first[0] not in _HELP)

            def get_command(self, context: Any, name: str) -> Any:
                """Find a command; one that there is not is answered with those that there are."""
                found = super().get_command(context, name)
                if found is None and not context.resilient_parsing:
                    near = difflib.get_close_matches(name, self.commands, 1)
                    self.refuse(context, f"there is no {name!r}", near[0] if near else "")
                return found

            def refuse(self, context: Any, why: str, meant: str) -> None:
                """Say which commands there are, and which is likely to be meant."""
                hint = f" Did you mean {meant}?" if meant else ""
                raise BenchError(
                    f"{context.command_path}: {why}; there are {', '.join(self.commands)}.{hint}"
                )

            def named_by(self, typed: Sequence[str]) -> str:
                """Return the command whose name was typed as an option; else one that has all the options."""
                flags = {word.partition("=")[0] for word in typed if word.startswith("-")}
                named = [name for name in self.commands if f"--{name}" in flags]
                having = [
                    name
                    for name, one in self.commands.items()
                    if flags <= {flag for param in one.params for flag in param.opts}
                ]
                return next(iter([*named, *having]), "")

            def format_commands(self, ctx: Any, formatter: Any) -> None:
                """List the commands with the first sentence of each, whole."""
                rows = [(name, one.get_short_help_str(limit=1000)) for name, one in self.commands.items()]
                with formatter.section("Commands"):
                    formatter.write_dl(rows)

            def parse_args(self, context: Any, arguments: list[str]) -> list[str]:
                if arguments[:1] == ["help"]:
                    arguments = [*arguments[1:], "--help"]
                if self.meant is not None and self.names_none(arguments[:1]):
                    arguments = [self.meant, *arguments]
                if arguments and self.names_none(arguments[:1]):
                    meant = self.named_by(arguments)
                    hint = f"{context.command_path} {meant} ..." if meant else ""
                    self.refuse(context, f"a name comes before {arguments[0]}", hint)
                return super().parse_args(context, arguments)

        super().__init__(
            cls=Group,
            help=help_text or None,
            add_completion=False,
            pretty_exceptions_enable=False,
            rich_markup_mode=None,
            no_args_is_help=bool(help_text) and usual is None,
            context_settings={"help_option_names": list(_HELP), "max_content_width": 110},
        )

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Any], Any]:
        """Register a function as a command; its options classes become flags."""
        register = super().command(name, cls=GroupedCommand, **settings)

        def registered(function: Callable[..., None]) -> Callable[..., None]:
            register(flat(function))
            return function

        return registered


def examples(*lines: str) -> str:
    """Return the examples that end a command's help, one a line, as typer's ``epilog``."""
    return "\b\nExamples:\n" + "\n".join(f"  {line}" for line in lines)


def load_and_say(bench: Path | None) -> BenchConfig:
    """Read the bench configuration; say on stderr when it is the built-in one."""
    from instrument.bench.config_file import DEFAULT_NAME, load_config

    config = load_config(bench)
    if config.path is None:
        typer.echo(
            f"No {DEFAULT_NAME} in this folder: the built-in SIMULATED bench is used (diffuserbench new).",
            err=True,
        )
    return config


def open_and_say(bench: BenchConfig | Path | None, *, as_is: bool = False) -> Bench:
    """Open the bench, ready to ask the operator in a terminal; say on stderr what it is.

    With ``as_is`` nobody is asked: what the operator would have to do is said, and taken for done.
    """
    from instrument.bench.bench import open_bench
    from instrument.cli.progress import one_task

    with one_task("Reading the bench's file"):
        config = load_and_say(bench) if bench is None or isinstance(bench, Path) else bench
    # Whichever command: its devices take the time. A run that goes on has the same text elsewhere.
    of = f"{config.bench.name} {crc32(config.text.encode()):08x}"
    kept_times.about(of)
    with one_task("Opening the bench"):
        opened = open_bench(config, ask=_taken_for_done if as_is else operator())
    opened.foretell(of)
    typer.echo(f"Bench: {opened.label}", err=True)
    return opened


def operator() -> Callable[[str], None] | None:
    """Return what asks the person at the terminal to do something by hand; None where nobody can answer."""
    if not (sys.stdin.isatty() and sys.stderr.isatty()):
        return None

    def ask(request: str) -> None:
        typer.echo(f"{request} Then press Enter (Ctrl-C to stop): ", err=True, nl=False)
        if not sys.stdin.readline():
            raise KeyboardInterrupt  # end of input: nobody is there any more

    return ask


def _taken_for_done(request: str) -> None:
    typer.echo(f"Not asked (--as-is), taken for done: {request}", err=True)


@contextmanager
def naming_as_is() -> Iterator[None]:
    """Let the error of a bench that needs an operator, where none is, name the option that does without."""
    try:
        yield
    except OperatorNeededError as error:
        raise OperatorNeededError(
            f"{error} Or, where the light already is as it must be, add --as-is."
        ) from None


DEBUG_VARIABLE = "DIFFUSERBENCH_DEBUG"
INTERRUPTED = 130


class Terminated(SystemExit):
    """The process was asked to end (SIGTERM, SIGHUP): raised in the main thread so that contexts close."""


def run_command(name: str, command: Command, arguments: Sequence[str], *, debug: bool = False) -> int:
    """Run a command with its arguments and return the exit status."""
    debug = debug or os.environ.get(DEBUG_VARIABLE, "") not in ("", "0")
    logging.basicConfig(
        level=logging.DEBUG if debug else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    for chatty in ("numba", "numcodecs", "matplotlib", "asyncio"):  # numba prints 30,000 lines a kernel
        logging.getLogger(chatty).setLevel(logging.WARNING)
    logging.getLogger("matplotlib.font_manager").setLevel(logging.ERROR)  # the bar says that it is drawn
    _end_on_signals()
    kept_times.about(name)
    try:
        # Not through typer's own main, which would answer Ctrl-C itself before a word is said about it.
        with _starting(name):
            parser = typer.main.get_command(command.load())
        with parser.make_context(f"diffuserbench {name}", list(arguments)) as context:
            parser.invoke(context)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt | Terminated):
            _be_silent_about_half_made_objects()
        if debug and not isinstance(error, USAGE_ERROR | typer.Abort | typer.Exit | SystemExit):
            raise
        return report(error)
    return 0


@contextmanager
def _starting(name: str) -> Iterator[None]:
    """Say in a terminal that a command is on its way while its libraries are read: a second or two."""
    shown = sys.stderr.isatty()
    sys.stderr.write(f"starting {name} ..." if shown else "")
    sys.stderr.flush()
    try:
        yield
    finally:
        sys.stderr.write("\r\x1b[2K" if shown else "")


def _be_silent_about_half_made_objects() -> None:
    """Keep what an interrupted library says of its own half-made objects out of the user's sight.

    Ctrl-C in the middle of a compilation, say, leaves an object without the attribute that its ``__del__``
    releases. Python prints a traceback for that when the exception is let go, after everything was said.
    """
    if sys.unraisablehook is not sys.__unraisablehook__:
        return  # whoever runs this program watches by itself

    def hook(unraisable: sys.UnraisableHookArgs) -> None:
        if not issubclass(unraisable.exc_type, AttributeError):
            sys.__unraisablehook__(unraisable)

    sys.unraisablehook = hook


def report(error: BaseException) -> int:
    """Say on stderr what went wrong and return the exit status; what is no known mistake is raised again."""
    if isinstance(error, typer.Exit):
        return error.exit_code
    if isinstance(error, USAGE_ERROR):
        error.show()  # type: ignore[attr-defined]
        return 2
    if isinstance(error, SystemExit):
        code = error.code if isinstance(error.code, int) else 1
        _say("stopped by a signal." if isinstance(error, Terminated) else "", error)
        return code
    if isinstance(error, KeyboardInterrupt | typer.Abort):
        _say("interrupted.", error)
        return INTERRUPTED
    if is_unread(error):
        _say("", error)
        raise error
    if isinstance(error, BenchError):
        _say(str(error), error)
        return error.exit_code
    if isinstance(error, DeviceError):
        _say(str(error), error)
        return 2 if isinstance(error, LimitError) else 1  # a value to put right, not a device that failed
    if sentence := in_words(error):
        _say(sentence, error)
        return 2
    raise error


def _say(text: str, error: BaseException) -> None:
    for line in dict.fromkeys((text, *getattr(error, "__notes__", ()))):
        if line:
            sys.stderr.write(f"{line}\n")


def _end_on_signals() -> None:
    def end(number: int, _frame: FrameType | None) -> None:
        raise Terminated(128 + number)

    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        # A signal that the parent chose to ignore (nohup) stays ignored.
        if number is not None and signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, end)


@contextmanager
def signals_wait() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM and SIGHUP come when the block has ended.

    For the start of a library that cannot be interrupted: Qt's bindings abort the program.
    """
    came: list[int] = []
    numbers = [getattr(signal, name, None) for name in ("SIGINT", "SIGTERM", "SIGHUP")]
    before = {n: signal.getsignal(n) for n in numbers if n and callable(signal.getsignal(n))}
    for number in before:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    if came:
        signal.raise_signal(came[0])
