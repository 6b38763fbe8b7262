"""What the program says, as Python names things: `prior` for ``--prior``, `overwrite=True` for ``--force``.

Everywhere else sentences name options as they are typed in a terminal; so they stand in records and files.
"""

from __future__ import annotations

import functools
import inspect
import re
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import ParamSpec, TypeVar

from instrument.files.errors import BenchError
from instrument.reconstruction import stored_result
from instrument.reconstruction.job import Job
from instrument.reconstruction.stored_result import StoredResult
from recon.base.arguments import require_argument
from recon.base.declare import Option, in_other_words, options_of
from recon.errors import InputError
from recon.reconstruction.result import Reconstruction
from recon.verdict.judge import Verdict

P = ParamSpec("P")
R = TypeVar("R")

_FURTHER = {
    "--force": "`overwrite=True`",
    "--out": "another name",
    "--image": "`image`",
    "--psf": "`psf`",
    "--volume": "`psf`",
    "--calibration": "`psf`",
    "--alignment": "`alignment`",
    "--budget": "`budget_s`",
}
"""Of the terminal only, and what does the same in Python."""
_VALUE = re.compile(r"`(\w+)` ([\w.+-]*\w)")


def in_python(text: str) -> str:
    """Return a message with options, and values that are given for them, as Python names them."""
    options = _options()
    words = {o.name: set(o.words) for o in options}

    def with_value(found: re.Match[str]) -> str:
        name, value = found.groups()
        if value.replace(".", "").isdigit() or re.fullmatch(r"[\d.]+e[+-]?\d+", value):
            return f"`{name}={value}`"
        return f"`{name}={value!r}`" if value in words.get(name, ()) else found[0]

    def named(option: Option) -> str:
        return f"`{option.name}`"

    said = in_other_words(text, options, named, lambda flag: _FURTHER.get(flag, flag))
    return text if said == text else _VALUE.sub(with_value, said)


@functools.cache
def _options() -> tuple[Option, ...]:
    """Return the options that a notebook meets; where two have the same flag, reconstructions' counts."""
    from instrument.reconstruction.options import InputOptions
    from recon.analysis.settings import AnalysisSettings
    from recon.holography.options import HologramOptions
    from recon.reconstruction.options import ReconstructionOptions

    classes = AnalysisSettings, HologramOptions, InputOptions, ReconstructionOptions
    return tuple(option for cls in classes for option in options_of(cls))


def speaking(function: Callable[P, R]) -> Callable[P, R]:
    """Return a function whose refusals name options as Python does, and that says how it is called."""
    called = inspect.signature(function)

    @functools.wraps(function)
    def speaks(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            called.bind(*args, **kwargs)
        except TypeError as error:
            raise TypeError(f"{error}: {_call_of(function.__name__, called)}.") from None
        try:
            return function(*args, **kwargs)
        except (BenchError, InputError) as error:
            error.args = tuple(in_python(said) if isinstance(said, str) else said for said in error.args)
            raise

    return speaks


def _call_of(name: str, called: inspect.Signature) -> str:
    """Return how a function is called: what it must be given, and the names of what it may."""
    given = [p for p in called.parameters.values() if p.name != "self"]
    must = [p.name for p in given if p.default is p.empty and p.kind is p.POSITIONAL_OR_KEYWORD]
    may = [f"{p.name}=..." for p in given if p.default is not p.empty]
    return f"it is called {name}({', '.join((*must, *may))})"


class VerdictInPython(Verdict):
    """A verdict that names options as Python does."""

    __slots__ = ()

    @classmethod
    def of(cls, verdict: Verdict) -> VerdictInPython:
        """Return the same verdict in Python's words."""
        values = {f.name: getattr(verdict, f.name) for f in fields(verdict)}
        findings = (replace(f, help=in_python(f.help)) for f in verdict.findings)
        return cls(**values | {"findings": tuple(findings)})

    @property
    def sentences(self) -> tuple[str, ...]:
        """The verdict in plain words: what, which stress limits it, what would help."""
        told = Verdict.sentences.fget(self)  # type: ignore[attr-defined]
        return tuple(map(in_python, told))


def result_in_python(found: Reconstruction) -> Reconstruction:
    """Return a result whose verdict and warnings name options as Python does."""
    verdict = None if found.verdict is None else VerdictInPython.of(found.verdict)
    return replace(found, verdict=verdict, warnings=tuple(map(in_python, found.warnings)))


def job_in_python(job: Job) -> Job:
    """Return a job whose notes and warnings name options as Python does."""
    notes = {name: in_python(text) for name, text in job.notes.items()}
    return replace(job, notes=notes, warnings=tuple(map(in_python, job.warnings)))


@speaking
def open_result(path: Path | str) -> StoredResult:
    """Open a picture or volume, by its own file or by the JSON record or preview beside it: ``path``.

    An image or volume from elsewhere opens too; nothing is known of it then.

    Returns
    -------
    StoredResult
        ``image`` float32, (height, width[, 3]); or ``volume``, whose voxels are read when they are looked at.

    Raises FileError when it is none, or its record is damaged.
    """
    require_argument("path", path, Path)
    found = stored_result.open_result(path)
    record = dict(found.record)
    if warnings := record.get("warnings"):
        record["warnings"] = [in_python(str(said)) for said in warnings]
    if verdict := record.get("verdict"):
        record["verdict"] = verdict | {"sentences": [in_python(str(s)) for s in verdict.get("sentences", ())]}
    return replace(found, record=record)
