"""What can go wrong above the devices, and numbers, in words for people."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from drivers.errors import DeviceError

if TYPE_CHECKING:
    from pydantic_core import ErrorDetails


class BenchError(Exception):
    """A mistake that the person at the bench can put right; its text is all that the command line shows.

    Attributes
    ----------
    exit_code : int
        Exit status of the command line: 2 for a user's mistake (configuration, files, arguments).
    """

    exit_code = 2


class FileError(BenchError):
    """A file or folder that cannot be used as asked.

    Parameters
    ----------
    path : path
        The file or folder.
    problem : str
        What was found and what was expected, as a sentence that follows the path.
    remedy : str, optional
        What to do about it.
    """

    def __init__(self, path: Path | str, problem: str, remedy: str = "") -> None:
        self.path = Path(path)
        self.problem = problem
        self.remedy = remedy
        super().__init__(f"{path}: {problem}" + (f" {remedy}" if remedy else ""))

    def __reduce__(self) -> tuple[type[FileError], tuple[Path, str, str]]:
        """Travel whole from a worker process: an exception is otherwise made again from its text alone."""
        return type(self), (self.path, self.problem, self.remedy)


class SettingsError(BenchError):
    """Settings that make no sense: every mistake at once, each with the name of its setting.

    Parameters
    ----------
    problems : sequence of (str, str)
        The setting's name as the code has it (``"z_min_um"``), and what is wrong in words, without a full
        stop.
    """

    def __init__(self, problems: Sequence[tuple[str, str]]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(text for _, text in self.problems) + ".")


class OperatorNeededError(BenchError):
    """A step needs a person's hand (a lamp, a screen) and nobody can be asked."""


@dataclass(frozen=True, slots=True)
class ConfigProblem:
    """One mistake in a configuration file.

    ``line`` counts from 1 and is None for what is missing as a whole; ``where`` names the key, e.g.
    ``[camera] exposure_ms``.
    """

    line: int | None
    where: str
    text: str


class ConfigError(BenchError):
    """A configuration file with mistakes: all of them, in the order of their lines.

    ``path`` is the file, or a name for a text that is no file.
    """

    def __init__(self, path: Path | str, problems: Sequence[ConfigProblem]) -> None:
        self.path = path
        self.problems = tuple(sorted(problems, key=lambda p: (p.line is None, p.line or 0)))
        count = len(self.problems)
        lines = [f"{path}: {count} mistake{'s' if count != 1 else ''}. Nothing was opened."]
        for problem in self.problems:
            place = f"{path}:{problem.line}" if problem.line is not None else f"{path}"
            lines.append(f"  {place}: {problem.where}: {problem.text}")
        super().__init__("\n".join(lines))


_REASONS = {
    errno.EACCES: "no permission. Check who owns it, or choose another place.",
    errno.EPERM: "not permitted. Check who owns it, or choose another place.",
    errno.EROFS: "the disk is read-only. Choose another place.",
    errno.ENOSPC: "no space left on the disk. Free some, or choose another place.",
    errno.EDQUOT: "your disk quota is used up. Free some, or choose another place.",
    errno.ENOENT: "there is no such file or folder.",
    errno.EISDIR: "it is a folder; a file is expected.",
    errno.ENOTDIR: "a part of this path is a file, not a folder.",
    errno.ENAMETOOLONG: "the name is too long.",
}


def os_reason(error: OSError) -> str:
    """Return what the operating system refused, as a sentence without the path, and what to do about it."""
    return _REASONS.get(error.errno or 0, f"{error.strerror or error}.")


def in_words(error: BaseException) -> str | None:
    """Return what a person is told of a known mistake or failure; None for an error of the program itself.

    Notes that were added to the error on its way are not included.
    """
    if isinstance(error, BenchError | DeviceError):
        return str(error)
    if isinstance(error, ValueError) and _is_input_error(error):
        return str(error)
    if isinstance(error, MemoryError):
        return f"There is not enough memory for that. {error}".strip()
    if isinstance(error, OSError):
        if error.filename is not None:
            return f"{os.fsdecode(error.filename)}: {os_reason(error)}"
        if error.errno == errno.ENOSPC:
            return os_reason(error)
    return None


def _is_input_error(error: ValueError) -> bool:
    from recon.errors import InputError  # costs half a second, which only an error has to wait

    return isinstance(error, InputError)


def size(n_bytes: float) -> str:
    """Return a number of bytes for people."""
    for unit in ("bytes", "kB", "MB", "GB", "TB"):
        if n_bytes < 1000 or unit == "TB":
            return f"{n_bytes:.0f} {unit}" if unit == "bytes" else f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    raise AssertionError


def percent(share: float) -> str:
    """Return a share for people; a little is never called nothing, nor nearly all all."""
    if 0 < share < 1e-5:
        return "less than 0.001 %"
    if 0.9995 <= share < 1:
        return "more than 99.9 %"
    return f"{100 * share:.3g} %" if share < 9.995 else f"{100 * share:.0f} %"


def count(number: int, noun: str) -> str:
    """Return how many of something there are: ``1 frame``, ``2 frames``."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def ranges(numbers: Sequence[int], most: int | None = None) -> str:
    """Return ascending numbers for people: ``0-7, 9``; of more than ``most`` pieces only how many follow."""
    runs: list[list[int]] = []
    for number in numbers:
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs[:most])
    left = sum(b - a + 1 for a, b in runs[len(runs) if most is None else most :])
    return f"{text} and {left} more" if left else text


def frames_in_words(numbers: Sequence[int]) -> str:
    """Return frames by their ascending numbers: ``frame 2``, ``frames 0-7, 9``."""
    return f"frame{'s' if len(numbers) > 1 else ''} {ranges(numbers, 8)}"


def duration(seconds: float) -> str:
    """Return a time for people."""
    if seconds < 120:
        return f"{seconds:.1f} s"
    minutes = seconds / 60
    return f"{minutes:.0f} min" if minutes < 120 else f"{minutes / 60:.1f} h"


_STARTS = (
    ("Input should be a valid ", "must be a "),
    ("Input should be ", "must be "),
    ("Value error, ", ""),
)
_WORDS = (
    ("a array", "an array"),
    ("a integer", "an integer"),
    ("an object", "a table"),
    ("a object", "a table"),
    ("string", "text"),
    ("boolean", "true or false"),
)


def mistake_in_words(detail: ErrorDetails) -> str:
    """Return what pydantic finds wrong, without place and value, in the words of who wrote the file."""
    if detail["type"] == "missing":
        is_item = bool(detail["loc"]) and isinstance(detail["loc"][-1], int)
        return f"this {'value' if is_item else 'key'} is missing"
    message = detail["msg"]
    for start, instead in _STARTS:
        if message.startswith(start):
            message = instead + message.removeprefix(start)
            break
    for word, instead in _WORDS:
        message = message.replace(word, instead)
    return message
