"""What a task is: a function of declared options and a desk, where progress, sentences and tables go."""

from __future__ import annotations

import inspect
import sys
import typing
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, Protocol

from instrument.files.atomic import is_content, is_same, protecting
from instrument.files.errors import BenchError, FileError
from instrument.files.orientation import AS_IT_IS, Kind, Orientation
from recon.base.declare import Option, changed, option, options_of

if TYPE_CHECKING:
    from instrument.bench.config import BenchConfig


class Advance(Protocol):
    """Tells how far a step is."""

    def __call__(self, done: float, total: float | None = None, *, note: str | None = None) -> None:
        """Tell how much is done, how much there is to do, and a word beside it; None leaves it as it was."""


class Desk(ABC):
    """Where a task tells how it goes on; in its own thread.

    Where somebody ends the work, ``say``, ``table`` or what advances a step may raise KeyboardInterrupt.
    """

    @abstractmethod
    def say(self, text: str) -> None:
        """Tell a result, in words."""

    @abstractmethod
    def warn(self, text: str) -> None:
        """Tell what people should look at."""

    @abstractmethod
    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Tell a table of results."""

    @abstractmethod
    def step(
        self, what: str, total: float | None = None, *, done: int = 0
    ) -> AbstractContextManager[Advance]:
        """Show how a step goes on while the block runs; gives what advances it."""

    @abstractmethod
    def interruptible(self) -> AbstractContextManager[Event]:
        """Give an event that is set where somebody ends the work; what there is by then is to be kept."""

    def seen(self, kind: Kind) -> Orientation:
        """Return how pictures of a kind are turned where one looks at them: what is exported is turned so."""
        del kind
        return AS_IT_IS

    def fact(self, name: str, text: str) -> None:
        """Tell a result with its name."""
        self.say(f"{name:<12}{text}")


class Printed(Desk):
    """Prints, without bars: for scripts."""

    def say(self, text: str) -> None:
        """Print it."""
        sys.stdout.write(f"{text}\n")

    def warn(self, text: str) -> None:
        """Print it on stderr."""
        sys.stderr.write(f"{text}\n")

    def table(self, headings: Sequence[str], rows: Sequence[Sequence[str]], title: str = "") -> None:
        """Print it, a line a row."""
        for row in (*([(title,)] if title else []), headings, *rows):
            self.say("  ".join(f"{text:>12}" for text in row))

    @contextmanager
    def step(self, what: str, total: float | None = None, *, done: int = 0) -> Iterator[Advance]:
        """Show nothing."""

        def advance(done: float, total: float | None = None, *, note: str | None = None) -> None:
            pass

        yield advance

    @contextmanager
    def interruptible(self) -> Iterator[Event]:
        """Give an event that nobody sets."""
        yield Event()


@dataclass(frozen=True, slots=True)
class Done:
    """How a task ended.

    Attributes
    ----------
    files : tuple of Path
        What was written.
    good : bool
        Whether what was looked for is as it should be.
    kept : str
        Where it was interrupted: what is left, and how to go on; empty where it is whole.
    """

    files: tuple[Path, ...] = ()
    good: bool = True
    kept: str = ""


@dataclass(frozen=True)
class Only:
    """Beside an options class (``Annotated[InputOptions, Only("dark", "crop")]``): the fields offered."""

    names: tuple[str, ...]

    def __init__(self, *names: str) -> None:
        object.__setattr__(self, "names", names)


@dataclass(frozen=True)
class Given:
    """The declared options that were given, by the names of their fields, and as they were typed."""

    options: Mapping[str, Option]
    typed: Mapping[str, str]

    @classmethod
    def of(cls, *objects: object) -> Given:
        """Return those of options objects that are not as declared."""
        options = {o.name: o for one in objects for o, _ in changed(one)}
        return cls(options, {name: o.flag for name, o in options.items()})

    def __contains__(self, name: str) -> bool:
        """Whether an option was typed, be it with its default value."""
        return name in self.options

    def flags(self, *names: str) -> list[str]:
        """Return the flags of the options among ``names`` (none: of all) that were given."""
        return [flag for name, flag in self.typed.items() if not names or name in names]

    def refuse(self, title: str, *subjects: str) -> None:
        """Refuse what was given and applies to none of these subjects, as the options declare it.

        Raises BenchError: which options, with the title ("--video"), and what they are for.
        """
        applies = {name: o.declaration.applies for name, o in self.options.items()}
        wrong = [name for name, about in applies.items() if about and not set(about) & set(subjects)]
        if wrong:
            what = "; ".join(f"{self.typed[name]} (for a {' or a '.join(applies[name])})" for name in wrong)
            raise BenchError(f"With {title} these do not apply: {what}. Leave them out.")


@dataclass(frozen=True, kw_only=True)
class BenchFile:
    """Which bench is meant."""

    bench: Path | None = option(
        None,
        help="Bench configuration.",
        default_words="bench.toml here, else the built-in one",
        flags=("--bench", "-b"),
        group="Bench",
    )


def bench_of(desk: Desk, bench: BenchFile) -> BenchConfig:
    """Return the configuration that is meant; says so where it is the built-in one."""
    from instrument.bench.config_file import DEFAULT_NAME, load_config

    config = load_config(bench.bench)
    if config.path is None:
        desk.warn(
            f"No {DEFAULT_NAME} in this folder: the built-in SIMULATED bench is used (diffuserbench new)."
        )
    return config


Part = tuple[type, tuple[Option, ...]]
"""An options class that a function takes, and those of its options that are offered."""


def part_of(hint: Any) -> Part | None:
    """Return the options class that a parameter's annotation names; None where it names something else."""
    cls, *extras = typing.get_args(hint) if typing.get_origin(hint) is typing.Annotated else (hint,)
    if not (isinstance(cls, type) and hasattr(cls, "__dataclass_fields__")):
        return None
    options = options_of(cls)
    for extra in extras:
        if isinstance(extra, Only):
            known = {o.name: o for o in options}
            options = tuple(known[name] for name in extra.names)
    return cls, options


@dataclass(frozen=True)
class Task:
    """A function of a desk and options objects (and :class:`Given`) that returns how it ended."""

    do: Callable[..., Done]
    examples: tuple[str, ...]
    """Command lines."""
    subject: str = ""
    """Of the options that apply to some things only, those that apply to this are offered by forms."""
    out: Path | None = None
    """Where its result goes when nothing else is said, where the option ``out`` does not say it."""
    needed: tuple[str, ...] = ()
    """Options that must be given here, although their declarations let them be left out."""

    @property
    def hints(self) -> dict[str, Any]:
        """The annotations of what it takes besides the desk, by name."""
        hints = typing.get_type_hints(self.do, include_extras=True)
        return {name: hints[name] for name in inspect.signature(self.do).parameters if name != "desk"}

    @property
    def parts(self) -> dict[str, Part]:
        """Its options classes, by the names of its parameters."""
        found = {name: part_of(hint) for name, hint in self.hints.items() if hint is not Given}
        return {name: part for name, part in found.items() if part is not None}

    def carry_out(self, desk: Desk, **objects: object) -> Done:
        """Do it with options objects, by the names of its parameters; what it reads is not overwritten."""
        given = {name: Given.of(*objects.values()) for name, hint in self.hints.items() if hint is Given}
        with guarded(objects):
            return self.do(desk, **objects, **given)


def task(
    *examples: str, subject: str = "", out: Path | None = None, needed: tuple[str, ...] = ()
) -> Callable[[Callable[..., Done]], Task]:
    """Make a task of a function; ``examples`` are command lines, the others as :class:`Task` has them."""
    return lambda function: Task(function, examples, subject, out, needed)


# Files -------------------------------------------------------------------------------------------------
WRITTEN = ("out", "figure", "checkpoint", "capture", "picture")
"""Options that name what is written; every other path is an input."""


@contextmanager
def guarded(values: Mapping[str, object]) -> Iterator[None]:
    """Keep what is read from being overwritten, and refuse to write over a run's or calibration's own files.

    ``values`` are paths, lists of them and options objects, by the names of a function's parameters.
    """
    paths = list(_paths(values))
    if outputs := [path for name, path in paths if name in WRITTEN]:
        from instrument.runs.run_files import refuse_own_files

        folders = [path for name, path in paths if name not in (*WRITTEN, "scratch") and path.is_dir()]
        for output in outputs:
            refuse_own_files(output)
            _refuse_one_more_image(output, folders)
    with protecting([path for name, path in paths if name not in WRITTEN]):
        yield


def _refuse_one_more_image(output: Path, folders: Sequence[Path]) -> None:
    """Refuse a result, or one with a preview, that the next reading of a folder would take for an image.

    Raises FileError.
    """
    from instrument.files.image_folders import SUFFIXES, images_in

    name = output.name.lower()
    if output.exists() or not name.endswith((*SUFFIXES, ".ome.zarr")):
        return
    for folder in folders:
        if is_content(folder) and is_same(output.parent, folder) and images_in(folder):
            problem = f"would be read as one more image of {folder}, an input."
            raise FileError(output, problem, "Choose another folder for it.")


def _paths(values: object, called: str = "") -> Iterator[tuple[str, Path]]:
    """Give every path in a function's parameters with the parameter's name."""
    if isinstance(values, Path):
        yield called, values
    elif isinstance(values, list | tuple):
        for entry in values:
            yield from _paths(entry, called)
    else:  # an options object may have slots
        declared = () if isinstance(values, Given) else getattr(type(values), "__dataclass_fields__", ())
        named = values if isinstance(values, dict) else {name: getattr(values, name) for name in declared}
        for name, value in named.items():
            yield from _paths(value, name)


@contextmanager
def saying_what_is_left(*files: Path, kept: Callable[[], str] = str) -> Iterator[None]:
    """Let an interruption (Ctrl-C, SIGTERM, a button) say which of the files to be written are there.

    ``kept`` says what else is, to go on with.
    """
    before = {file: _changed_ns(file) for file in files}
    try:
        yield
    except (KeyboardInterrupt, SystemExit) as interruption:
        written = [str(file) for file in files if _changed_ns(file) != before[file]]
        words = f"Written: {', '.join(written)}." if written else "Nothing was written."
        interruption.add_note(kept() or words)
        raise


def _changed_ns(file: Path) -> int | None:
    return file.stat().st_mtime_ns if file.exists() else None
